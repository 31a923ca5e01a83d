"""A scan: an experiment at every point of a grid, wherever there are workers."""

import concurrent.futures as futures
import contextlib
import itertools
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence

import jax
import numpy as np

import dpdjax
from dpdjax.checks import prng_key, whole
from dpdjax.engine.members import cores
from dpdjax.errors import RunError
from dpdjax.files.told import told
from dpdjax.host.stops import stopping
from dpdjax.scans.drive import Cancelled, Outcome, driven, driven_together
from dpdjax.scans.grid import Grid, Unit
from dpdjax.scans.progress import Progress
from dpdjax.scans.table import Store, Table, told_failures, xarray_module
from dpdjax.xla import on_cpu

AT_ONCE = 256
"""Experiments that are under way together on an accelerator."""


def scan(
    experiment: Callable,
    grid: Mapping[str, Sequence],
    *,
    key: jax.Array,
    replicas: int = 1,
    store: str | os.PathLike | None = None,
    executor: futures.Executor | None = None,
    shard: tuple[int, int] | None = None,
    hours: float | None = None,
    about: Mapping[str, str] | None = None,
    progress: bool = True,
):
    """An experiment at every point of a grid, as one table.

    An experiment is a function ``experiment(key, **point)`` that returns estimates or numbers by
    name. It asks for its runs by ``trajectory = yield dpd.Run(fluid, state, key, dt, plan, ...)``,
    so that they are run beside those of other points: on an accelerator all of one shape in one
    batch, on a CPU each on a core of its own. One that returns at once, or calls
    :func:`dpdjax.run`, will do too. Ready ones are in ``dpd.experiments``.

    The numbers of a replica depend on the key and the values of its point alone: not on the rest of
    the grid, on what runs beside it, on workers or devices of a kind; on a CPU to the last bit.

    A point that fails, by a run that could not go on or numbers that cannot be, is marked with the
    reason, and the others go on. A mistake in the experiment, such as an unknown name, ends the
    scan.

    Args:
        experiment: what is done at a point.
        grid: values by name; arguments of the experiment, numbers or words.
        key: a PRNG key, from which each replica has its own.
        replicas: runs at each point with keys of their own; their scatter is the standard error.
        store: a netCDF file that holds the table at every moment. The same call does what is
            missing in it, one with a larger grid or more replicas what is new.
        executor: runs the replicas elsewhere, such as ``ProcessPoolExecutor(4,
            mp_context=get_context("spawn"))`` or ``dask.distributed.Client(...).get_executor()``;
            the experiment is sent there, and must be one that ``pickle`` takes.
        shard: ``(i, n)``, part ``i`` of ``n`` from 1 on, for arrays of jobs with a store each;
            :func:`dpdjax.merge_scans` makes one table of them.
        hours: of wall time after which the scan ends; Ctrl-C and SIGTERM end it too, with all that
            is done in the store.
        about: texts that the table is to hold as attributes.

    Returns an ``xarray.Dataset``: of each number the mean and its standard error (``..._error``),
    each replica (``..._each``), status and reason; units and provenance as attributes.

    Raises TypeError or ValueError for what is no grid, FileError for a store of another scan.
    """
    xarray_module()
    if not callable(experiment):
        raise TypeError(f"experiment is {experiment!r}; give a function experiment(key, **point)")
    grid = Grid.of(grid, replicas)
    made = {"experiment": told(experiment), "key": told(prng_key(key))} | _settings()
    table = Table(grid, made, dict(about or {}))
    units = _shard(grid.units(), shard)
    saved = Store(store)
    saved.begin(table)
    open_ones = set(table.left())
    units = [unit for unit in units if unit in open_ones]
    with stopping(hours, True) as stop, Progress(len(units), progress) as line:
        doing = (
            _elsewhere(executor, experiment, grid, key, units)
            if executor
            else _here(experiment, grid, key, units, stop)
        )
        try:
            with contextlib.closing(doing):
                for unit, outcome in doing:
                    table.put(unit, outcome)
                    saved.save(table)
                    line.advance(outcome)
                    if stop.is_due():
                        break
        finally:
            saved.save(table, now=True)
        if stop.why and table.left():
            line.say(f"ended by {stop.why}: the same call does what is missing")
    if stop.is_terminated:
        raise dpdjax.Stopped
    told_failures(table)
    return table.dataset()


def _settings() -> dict:
    return {"version": dpdjax.__version__, "float64": bool(jax.config.jax_enable_x64)}


def _shard(units: list[Unit], shard) -> list[Unit]:
    """Part of the units, of all kinds alike."""
    if shard is None:
        return units
    is_pair = isinstance(shard, tuple | list) and len(shard) == 2
    i, n = (whole(x, "shard") for x in shard) if is_pair else (0, 0)
    if not 1 <= i <= n:
        raise ValueError(f"shard is {shard}; give (i, n) with i from 1 to n")
    return units[i - 1 :: n]


def _here(experiment, grid: Grid, key, units, stop) -> Iterator[tuple[Unit, Outcome]]:
    """Replicas and what they came to, as they end, in this process."""
    if on_cpu():
        yield from _on_cores(experiment, grid, key, units, stop)
        return
    for begin in range(0, len(units), AT_ONCE):
        some = units[begin : begin + AT_ONCE]
        keys = [grid.key_of(key, unit) for unit in some]
        points = [grid.point(place) for place, _ in some]
        yield from zip(some, driven_together(experiment, keys, points))


def _on_cores(experiment, grid: Grid, key, units, stop):
    """Each on a core of its own."""
    over = threading.Event()
    is_over = lambda: over.is_set() or bool(stop.why)
    do = lambda unit: driven(experiment, grid.key_of(key, unit), grid.point(unit[0]), is_over)
    waiting, pool = iter(units), futures.ThreadPoolExecutor(cores())
    try:
        running = {pool.submit(do, unit): unit for unit in itertools.islice(waiting, cores())}
        while running:
            # Now and then the main thread must wake, or it hears no signal.
            ended = futures.wait(running, 0.5, futures.FIRST_COMPLETED).done
            for future in ended:
                unit = running.pop(future)
                with contextlib.suppress(Cancelled):
                    yield unit, future.result()
                for unit in waiting if not is_over() else ():
                    running[pool.submit(do, unit)] = unit
                    break
    finally:
        over.set()
        pool.shutdown(cancel_futures=True)


def _elsewhere(executor, experiment, grid: Grid, key, units):
    """By the workers of an executor."""
    pending = {
        executor.submit(
            _remote,
            experiment,
            np.asarray(jax.random.key_data(grid.key_of(key, unit))),
            grid.point(unit[0]),
            bool(jax.config.jax_enable_x64),
        ): unit
        for unit in units
    }
    try:
        while pending:
            for future in futures.wait(pending, 0.5, futures.FIRST_COMPLETED).done:
                unit = pending.pop(future)
                try:
                    outcome = future.result()
                except futures.BrokenExecutor as error:
                    raise RunError(
                        f"the workers are gone, {len(pending) + 1} runs were not done: the same "
                        f"call with a new executor does what is missing ({error})"
                    ) from error
                yield unit, outcome
    finally:
        for future in pending:
            future.cancel()


def _remote(experiment, key, point: dict, float64: bool) -> Outcome:
    """A replica in a worker, with the precision of where it was asked for."""
    jax.config.update("jax_enable_x64", float64)
    return driven(experiment, jax.random.wrap_key_data(key), point)
