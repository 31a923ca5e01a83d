"""Experiments at work: each asks for runs and is given them, alone or many in one batch."""

import dataclasses
import inspect
import math
import re
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.engine.flow import Driving
from dpdjax.engine.integrator import Integrator
from dpdjax.engine.members import cores
from dpdjax.engine.record import Observing
from dpdjax.engine.state import State
from dpdjax.engine.trajectory import Plan, Trajectory
from dpdjax.errors import DPDError
from dpdjax.host.run import run
from dpdjax.measure.statistics import Estimate
from dpdjax.model.fluid import Fluid
from dpdjax.scans.notes import noted

FAILURES = (DPDError, ValueError, RuntimeError, ArithmeticError)
"""What a point may fail by, while the others go on; anything else is a mistake in the experiment,
and ends the scan."""
SHARE, COPIES = 0.5, 8
"""Of the memory of an accelerator, what a batch may fill, counting a state so many times."""


@dataclasses.dataclass(frozen=True)
class Run:
    """A run that an experiment asks for, ``trajectory = yield dpd.Run(...)``; what it is made of is
    as for :func:`dpdjax.run`.

    Example:
        >>> def heat(key, gamma):
        ...     fluid, plan = water.set(gamma=gamma), dpd.Plan(40, 5)
        ...     ran = yield dpd.Run(fluid, state, key, 0.01, plan, observe=seen)
        ...     return {"temperature": dpd.measure.block_average(ran.frames["temperature"])}
        >>> table = dpd.scan(heat, {"gamma": [4.5, 9.0]}, key=key, **quiet)
        >>> table.temperature.shape
        (2,)
    """

    fluid: Fluid
    state: State
    key: jax.Array
    dt: Any
    plan: Plan
    flow: Driving = None
    observe: Observing = None
    integrator: Integrator | None = None

    @property
    def particle_steps(self) -> int:
        """What it costs."""
        return self.state.n * self.plan.steps

    def alone(self, callback: Callable | None = None) -> Trajectory:
        """Run it; Cancelled where it was broken off, which is no run to be measured."""
        trajectory = run(
            self.fluid, self.state, self.key, self.dt, self.plan, self.flow,
            observe=self.observe, integrator=self.integrator, callback=callback, progress=False,
        )  # fmt: skip
        if not trajectory.complete:
            raise Cancelled
        return trajectory


@dataclasses.dataclass
class Outcome:
    """What a replica of a point came to.

    Attributes:
        values: estimates by name; empty where it failed.
        reason: why it failed; empty where it did not.
        note: what was warned of.
        particle_steps, seconds: what it took.
    """

    values: dict[str, Estimate] = dataclasses.field(default_factory=dict)
    reason: str = ""
    note: str = ""
    particle_steps: int = 0
    seconds: float = 0.0


class Cancelled(BaseException):
    """The scan ends, and this run with it."""


def driven(experiment: Callable, key, point: dict, is_over: Callable = lambda: False) -> Outcome:
    """One experiment at one point, its runs one after another; ``is_over()`` is asked at each piece
    of a run whether to give up, by :class:`Cancelled`."""

    def give_up_when_over(_):
        if is_over():
            raise Cancelled

    outcome, began = Outcome(), time.monotonic()
    with noted() as notes:
        try:
            asked = _Asking(experiment, key, point)
            while asked.wanted is not None:
                outcome.particle_steps += asked.wanted.particle_steps
                asked.give(_attempted(asked.wanted, give_up_when_over))
            outcome.values = asked.values
        except FAILURES as error:
            outcome.reason = str(error) or type(error).__name__
    outcome.note = "; ".join(notes)
    outcome.seconds = time.monotonic() - began
    return outcome


def _attempted(one: Run, callback: Callable):
    """The trajectory of a run, or the error it ended by."""
    try:
        return one.alone(callback)
    except FAILURES as error:
        return error


def driven_together(experiment: Callable, keys: Sequence, points: Sequence[dict]) -> list[Outcome]:
    """Experiments at several points, with the runs of equal shapes in one batch: for an
    accelerator, which is filled by many boxes side by side."""
    outcomes, asking = [Outcome() for _ in points], {}
    notes: list[list[str]] = [[] for _ in points]

    def attempt(k: int, what: Callable):
        with noted() as said:
            try:
                what()
            except FAILURES as error:
                asking.pop(k, None)
                outcomes[k].reason = str(error) or type(error).__name__
        notes[k] += said

    def begin(k):
        asking[k] = _Asking(experiment, keys[k], points[k])

    for k in range(len(points)):
        attempt(k, lambda: begin(k))
    while True:
        wanted = {k: a.wanted for k, a in asking.items() if a.wanted is not None}
        if not wanted:
            break
        for group in _alike(wanted):
            began = time.monotonic()
            with noted() as said:
                try:
                    given = _batch_of([wanted[k] for k in group])
                except FAILURES as error:
                    given = [error] * len(group)
            for place, (k, trajectory) in enumerate(zip(group, given)):
                notes[k] += _of_member(said, place)
                outcomes[k].particle_steps += wanted[k].particle_steps
                outcomes[k].seconds += (time.monotonic() - began) / len(group)
                attempt(k, lambda: asking[k].give(trajectory))
    for k, ended in asking.items():
        outcomes[k].values = ended.values
    for outcome, said in zip(outcomes, notes):
        outcome.note = "; ".join(dict.fromkeys(said))
    return outcomes


def _of_member(notes: list[str], place: int) -> list[str]:
    """What a batch warned of that is said of all its members, or of one."""
    mine = f"member {place}: "
    return [
        note.removeprefix(mine)
        for note in notes
        if note.startswith(mine) or not re.match(r"member \d+: ", note)
    ]


class _Asking:
    """An experiment under way: the run it asks for, or the values it ended with."""

    def __init__(self, experiment, key, point):
        self.wanted: Run | None = None
        self.values: dict[str, Estimate] = {}
        self._work = experiment(key, **point)
        if inspect.isgenerator(self._work):
            self.give(None)
        else:
            self.values = _estimates(self._work)

    def give(self, trajectory):
        """Go on with a run, or with the error that it ended by, which the experiment may catch."""
        self.wanted = None
        is_error = isinstance(trajectory, Exception)
        go_on = self._work.throw if is_error else self._work.send
        try:
            self.wanted = go_on(trajectory)
        except StopIteration as end:
            self.values = _estimates(end.value)
            return
        if not isinstance(self.wanted, Run):
            raise TypeError(f"the experiment yields {self.wanted!r}; yield dpd.Run(...)")


def _estimates(found) -> dict[str, Estimate]:
    """What an experiment returns, as estimates by name; TypeError with what to give."""
    wanted = "return estimates or numbers by name, such as {'viscosity': dpd.shear_viscosity(ran)}"
    if not isinstance(found, dict) or not found:
        raise TypeError(f"the experiment returns {found!r}; {wanted}")
    made = {}
    for name, value in found.items():
        if not isinstance(value, Estimate):
            if np.ndim(value) or not np.issubdtype(np.asarray(value).dtype, np.number):
                raise TypeError(f"the experiment returns {value!r} as {name!r}; {wanted}")
            value = Estimate(float(value), math.nan)
        if not math.isfinite(value.value):
            raise ValueError(f"{name} is {value.value}")
        made[str(name)] = value
    return made


def _alike(wanted: dict[int, Run]) -> list[list[int]]:
    """Groups of runs that fit into one batch, and into memory."""
    groups: dict = {}
    for k, one in wanted.items():
        groups.setdefault(_shape(one), []).append(k)
    return [
        group[a : a + most]
        for group in groups.values()
        for most in [_most(wanted[group[0]])]
        for a in range(0, len(group), most)
    ]


def _shape(one: Run):
    """What runs of one batch have in common."""
    numbers = one.fluid, one.state, one.flow, one.integrator
    leaves, tree = jax.tree.flatten(numbers)
    observe = tuple(one.observe) if isinstance(one.observe, list) else one.observe
    return tree, tuple((jnp.shape(x), jnp.result_type(x)) for x in leaves), one.plan, observe


def _most(one: Run) -> int:
    """Runs in a batch that the memory of a device holds."""
    stats = jax.devices()[0].memory_stats() or {}
    if "bytes_limit" not in stats:
        return max(cores(), 1) * 16
    size = sum(
        np.size(x) * np.dtype(jnp.result_type(x)).itemsize for x in jax.tree.leaves(one.state)
    )
    return max(1, int(SHARE * stats["bytes_limit"] / (COPIES * size)))


def _batch_of(runs: Sequence[Run]) -> list:
    """The trajectories of runs of equal shapes, or the error that each ended by."""
    if len(runs) == 1:
        return [runs[0].alone()]
    together = _stacked(runs)
    trajectory = together.alone()
    failed = dict(trajectory.failed)
    return [RuntimeError(failed[k]) if k in failed else trajectory[k] for k in range(len(runs))]


def _stacked(runs: Sequence[Run]) -> Run:
    """Runs as one, a batch: numbers that differ with an axis of their own."""
    one = runs[0]

    def join(*leaves):
        same = all(np.array_equal(leaves[0], leaf) for leaf in leaves[1:])
        return leaves[0] if same else jnp.stack([jnp.asarray(leaf) for leaf in leaves])

    numbers = [(r.fluid, r.flow, r.integrator, r.dt) for r in runs]
    fluid, flow, integrator, dt = jax.tree.map(join, *numbers)
    state = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[r.state for r in runs])
    key = jnp.stack([r.key for r in runs])
    return Run(fluid, state, key, dt, one.plan, flow, one.observe, integrator)
