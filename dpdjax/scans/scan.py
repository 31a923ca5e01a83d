"""A scan: an experiment at every point of a grid, wherever there are workers."""

import concurrent.futures as futures
import contextlib
import dataclasses
import itertools
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence

import jax
import numpy as np

import dpdjax
from dpdjax.checks import prng_key, whole
from dpdjax.engine.members import cores
from dpdjax.engine.tables import xarray_module
from dpdjax.errors import RunError
from dpdjax.files.told import told
from dpdjax.host.stops import Stop, stopping
from dpdjax.scans.drive import Cancelled, Outcome, driven, driven_together
from dpdjax.scans.grid import Grid, Unit
from dpdjax.scans.progress import Progress
from dpdjax.scans.table import OWN, Store, Table, tell
from dpdjax.xla import on_cpu

WAKE = 0.5
"""Seconds between two looks at whether the scan is to end."""
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
    retry: bool = False,
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
        replicas: runs at each point with keys of their own. The standard error of their mean is
            the larger of what their own errors come to and of their scatter, widened for few.
        store: a netCDF file that holds the table at every moment. The same call does what is
            missing in it, one with a larger grid or more replicas what is new.
        executor: runs the replicas elsewhere, such as ``ProcessPoolExecutor(4,
            mp_context=get_context("spawn"))`` or ``dask.distributed.Client(...).get_executor()``;
            the experiment is sent there, and must be one that ``pickle`` takes.
        shard: ``(i, n)``, part ``i`` of ``n`` from 1 on, for arrays of jobs with a store each;
            :func:`dpdjax.merge_scans` makes one table of them.
        hours: of wall time after which the scan ends; Ctrl-C and SIGTERM end it too, with all that
            is done in the store.
        retry: do again what failed.
        about: texts that the table is to hold as attributes.

    Returns an ``xarray.Dataset``: of each number the mean and its standard error (``..._error``),
    each replica (``..._each``), status (0 open, 1 done, 2 failed), reason of a failure and note
    of what was warned of; units and provenance as attributes, and ``complete``: 0 after an early
    end, when some means are of fewer replicas.

    Raises TypeError or ValueError for what is no grid, FileError for a store of another scan.

    Example:
        >>> def thinning(key, rate, gamma):
        ...     return {"viscosity": dpd.Estimate(0.2 * gamma / (1 + rate), 0.01)}
        >>> grid = {"rate": [0.1, 1.0], "gamma": [4.5, 9.0, 18.0]}
        >>> table = dpd.scan(thinning, grid, key=key, **quiet)
        >>> table.viscosity.sel(rate=1.0).values.round(3).tolist()
        [0.45, 0.9, 1.8]
        >>> table.attrs["complete"]
        1
    """
    xarray_module()
    if not callable(experiment):
        raise TypeError(f"experiment is {experiment!r}; give a function experiment(key, **point)")
    grid = Grid.of(grid, replicas)
    made = {"experiment": told(experiment), "key": told(prng_key(key))} | _settings()
    table = Table(grid, made, _texts(about or {}))
    saved = Store(store)
    with saved.held(), stopping(hours, True) as stop:
        saved.begin(table)
        if retry:
            table.forget_failures()
        left = set(table.left())
        units = [unit for unit in _shard(grid.units(), shard) if unit in left]
        do = _Doing(experiment, grid, key, units, stop)
        doing = do.elsewhere(executor) if executor else do.here()
        with contextlib.closing(doing), Progress(len(units), progress) as line:
            try:
                for unit, outcome in doing:
                    if stop.is_interrupted:
                        break
                    table.put(unit, outcome)
                    saved.save(table)
                    line.advance(outcome)
            except (Cancelled, KeyboardInterrupt):
                pass
            finally:
                saved.save(table, now=True)
            if stop.why and table.left():
                line.say(f"ended by {stop.why}: the same call does what is missing")
    if stop.is_terminated:
        raise dpdjax.Stopped
    tell(table)
    return table.dataset()


def _texts(about: Mapping[str, str]) -> dict[str, str]:
    for name, text in about.items():
        if not isinstance(text, str) or name in OWN:
            raise TypeError(f"about has {name} = {text!r}; give texts, not under {', '.join(OWN)}")
    return dict(about)


def _settings() -> dict:
    return {"version": dpdjax.__version__, "float64": bool(jax.config.jax_enable_x64)}


def _shard(units: list[Unit], shard) -> list[Unit]:
    """Part of the units, of all kinds alike."""
    if shard is None:
        return units
    is_pair = isinstance(shard, tuple | list) and len(shard) == 2
    i, n = (whole(x, "shard", least=0) for x in shard) if is_pair else (0, 0)
    if not 1 <= i <= n:
        raise ValueError(f"shard is {shard}; give (i, n) with i from 1 to n")
    return units[i - 1 :: n]


@dataclasses.dataclass
class _Doing:
    """Replicas that are to be done; both ways of doing them give each and what it came to, as they
    end, until ``stop`` is over."""

    experiment: Callable
    grid: Grid
    key: jax.Array
    units: list[Unit]
    stop: Stop

    def here(self) -> Iterator[tuple[Unit, Outcome]]:
        """In this process."""
        return self._on_cores() if on_cpu() else self._side_by_side()

    def _side_by_side(self):
        for begin in range(0, len(self.units), AT_ONCE):
            if self.stop.is_over():
                return
            some = self.units[begin : begin + AT_ONCE]
            keys = [self.grid.key_of(self.key, unit) for unit in some]
            points = [self.grid.point(place) for place, _ in some]
            yield from zip(some, driven_together(self.experiment, keys, points))

    def _on_cores(self):
        """Each on a core of its own."""
        waiting, pool = iter(self.units), futures.ThreadPoolExecutor(cores())
        over, settings = threading.Event(), _Settings.of_caller()
        is_over = lambda: over.is_set() or self.stop.is_over()

        def one(unit):
            with settings.entered():
                key, point = self.grid.key_of(self.key, unit), self.grid.point(unit[0])
                return driven(self.experiment, key, point, is_over)

        try:
            begin = lambda some: {pool.submit(one, unit): unit for unit in some}
            running = begin(itertools.islice(waiting, cores()))
            while running:
                # Now and then the main thread must wake, or it hears no signal.
                for future in futures.wait(running, WAKE, futures.FIRST_COMPLETED).done:
                    unit = running.pop(future)
                    if not is_over():
                        running |= begin(itertools.islice(waiting, 1))
                    with contextlib.suppress(Cancelled):
                        yield unit, future.result()
        finally:
            over.set()
            pool.shutdown(cancel_futures=True)

    def elsewhere(self, executor):
        """By the workers of an executor."""
        settings = _Settings.of_caller()

        def submitted(unit):
            key = self.grid.key_of(self.key, unit)
            told_key = np.asarray(jax.random.key_data(key)), str(jax.random.key_impl(key))
            point = self.grid.point(unit[0])
            return executor.submit(_remote, self.experiment, told_key, point, settings)

        pending = {submitted(unit): unit for unit in self.units}
        try:
            while pending and not self.stop.is_over():
                for future in futures.wait(pending, WAKE, futures.FIRST_COMPLETED).done:
                    yield pending.pop(future), self._result(future, len(pending))
            for future in [future for future in pending if future.done()]:
                yield pending.pop(future), self._result(future, len(pending))
        finally:
            for future in pending:
                future.cancel()

    @staticmethod
    def _result(future, left: int) -> Outcome:
        try:
            return future.result()
        except futures.BrokenExecutor as error:
            raise RunError(
                f"the workers are gone, {left + 1} runs were not done: the same call with a new "
                f"executor does what is missing ({error})"
            ) from error


@dataclasses.dataclass(frozen=True)
class _Settings:
    """How the caller computes, for threads and processes that compute for it."""

    float64: bool
    matmul_precision: str | None

    @classmethod
    def of_caller(cls) -> "_Settings":
        return cls(bool(jax.config.jax_enable_x64), jax.config.jax_default_matmul_precision)

    @contextlib.contextmanager
    def entered(self):
        """Compute so until the end."""
        with jax.enable_x64(self.float64), jax.default_matmul_precision(self.matmul_precision):
            yield


def _remote(experiment, key, point: dict, settings: _Settings) -> Outcome:
    """A replica in a worker. A Ctrl-C that reaches it too is for whom it works."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    data, implementation = key
    with settings.entered():
        return driven(experiment, jax.random.wrap_key_data(data, impl=implementation), point)
