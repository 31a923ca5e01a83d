"""How much to run, and what a run leaves behind."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax import drawing
from dpdjax.checks import Numbers, whole
from dpdjax.engine.batching import chosen
from dpdjax.engine.flow import Flow
from dpdjax.engine.joining import joined
from dpdjax.engine.state import State
from dpdjax.engine.system import System
from dpdjax.engine.tables import to_pandas, to_xarray
from dpdjax.model import summary
from dpdjax.model.colloids import diffusion_time
from dpdjax.model.fluid import Fluid

LAST_STEP = 2**31 - 1
"""Steps are counted in 32 bits."""


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Plan:
    """How much to run and how much to keep; static, so that it may go through ``jax.jit``.

    Attributes:
        frames: recorded frames.
        every: steps between two frames; None where they are not evenly spaced.
        schedule: the steps, counted from the start, at which frames are that are not evenly spaced;
            see ``Plan.at`` and ``Plan.logarithmic``.

    Raises ValueError for numbers below 1 and steps that do not rise.

    Example:
        >>> plan = dpd.Plan(frames=40, every=5)
        >>> plan.steps, plan.every
        (200, 5)
        >>> dpd.Plan.over(time=10.0, dt=0.01, frames=100)
        Plan(frames=100, every=10, schedule=())
        >>> dpd.Plan.logarithmic(1000, per_decade=3).schedule
        (1, 2, 5, 10, 22, 46, 100, 215, 464, 1000)
    """

    frames: int
    every: int | None = 1
    schedule: tuple[int, ...] = ()

    def __post_init__(self):
        if self.schedule:
            _check_schedule(self)
            return
        for name in ("frames", "every"):
            object.__setattr__(self, name, whole(getattr(self, name), f"Plan {name}"))

    @classmethod
    def at(cls, steps: Numbers) -> "Plan":
        """Frames after these numbers of steps from the start, which rise; of times they are
        ``np.unique(np.rint(times / dt))``.

        Measures of moments (structure, contacts, sizes) take such runs; those that follow beads or
        average over time need evenly spaced frames and refuse them.
        """
        steps = [whole(step, "a step of Plan.at") for step in np.ravel(np.asarray(steps)).tolist()]
        if not steps:
            raise ValueError("Plan.at has no steps; give one or more")
        if steps == list(range(steps[0], steps[-1] + 1, steps[0])):
            return cls(len(steps), steps[0])
        return cls(len(steps), None, tuple(steps))

    @classmethod
    def over(cls, time: float, dt: float, frames: int) -> "Plan":
        """So many frames, evenly over a time [time] in steps of ``dt``, a step apart at least."""
        return cls(frames, max(1, round(time / dt / frames)))

    @classmethod
    def logarithmic(cls, steps: int, *, first: int = 1, per_decade: int = 10) -> "Plan":
        """Frames at steps that grow by a factor, ``per_decade`` in each ten, from ``first`` to
        ``steps``: for what ages, such as a gel. Where two fall upon one step there is one."""
        steps, first = whole(steps, "steps"), whole(first, "first")
        per_decade = min(whole(per_decade, "per_decade"), steps)
        if steps > LAST_STEP:
            raise ValueError(f"steps is {steps}; they are counted up to {LAST_STEP}")
        if first >= steps:
            raise ValueError(f"first is {first}; it must be below steps, {steps}")
        count = max(2, 1 + round(per_decade * math.log10(steps / first)))
        return cls.at(np.unique(np.rint(np.geomspace(first, steps, count)).astype(int)))

    @property
    def steps(self) -> int:
        """Steps in all."""
        return self.until(self.frames)

    @property
    def intervals(self) -> np.ndarray:
        """Steps before each frame since the one before it (frames,)."""
        if self.schedule:
            return np.diff(np.asarray(self.schedule), prepend=0)
        return np.full(self.frames, self.every)

    @property
    def longest(self) -> int:
        """Most steps before a frame."""
        return int(np.max(self.intervals)) if self.schedule else self.every

    def until(self, frames: int) -> int:
        """Steps up to a frame, by its number from 1 on; 0 for none."""
        if not self.schedule:
            return frames * self.every
        return self.schedule[frames - 1] if frames else 0

    def part(self, begin: int, frames: int) -> "Plan":
        """That of some frames in turn, from number ``begin`` on."""
        if not self.schedule:
            return Plan(frames, self.every)
        some = np.asarray(self.schedule[begin : begin + frames])
        return Plan.at(some - self.until(begin))


def _check_schedule(plan: Plan):
    rising = all(b > a for a, b in zip((0, *plan.schedule), plan.schedule))
    if not rising or plan.every is not None or len(plan.schedule) != plan.frames:
        raise ValueError(
            f"the frames are at the steps {plan.schedule[:8]}; give steps that rise from 1 or "
            "more, dpd.Plan.at([...])"
        )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, repr=False)
class Trajectory:
    """What a run leaves behind.

    Attributes:
        final: the state after the last step.
        frames: recorded values by name, each with a leading axis of frames; always with
            ``time`` and ``step``. A batched run has the batch in front of the frames.
        system: what was run, for the measurements that need it; ``fluid``, ``flow`` and ``dt`` are
            its own.
        every: steps between two frames (static); None where they are not evenly spaced.
        complete: whether all planned frames are there (static).
        means: names of those frames that are means over their interval (static).
        failed: of a batch, the members that failed and why (static); their frames are NaN from then
            on, and their final state is the last that was sound.

    Example:
        >>> rest.frames["temperature"].shape, rest.frames["position"].shape
        ((40,), (40, 192, 3))
        >>> round(float(rest.interval), 3), rest.complete, rest.is_batch
        (0.05, True, False)
        >>> rest.final
        State(192 beads, box 4 x 4 x 4, step 400, time 4)
        >>> rest.last(10).frames["time"].shape
        (10,)
    """

    final: State
    frames: dict[str, Any]
    system: System
    every: int | None = dataclasses.field(default=1, metadata={"static": True})
    complete: bool = dataclasses.field(default=True, metadata={"static": True})
    means: tuple[str, ...] = dataclasses.field(default=(), metadata={"static": True})
    failed: tuple[tuple[int, str], ...] = dataclasses.field(default=(), metadata={"static": True})

    def __repr__(self):
        recorded = self.shapes
        count = recorded.get("step", (0,))[-1:]
        often = "unevenly spaced" if self.every is None else f"one in {self.every} steps"
        head = f"Trajectory({count[0] if count else 0} frames, {often} of {summary.span(self.dt)}"
        told = [
            "" if self.complete else "interrupted",
            f"members {[k for k, _ in self.failed]} failed" if self.failed else "",
        ]
        head = ", ".join([head, *filter(None, told)])
        values = ", ".join(f"{name} {shape}" for name, shape in recorded.items())
        return f"{head}: {values}; final {self.final!r})"

    def _repr_html_(self):
        title = repr(self).partition(":")[0].replace("(", ", ", 1)
        return summary.as_table(title, [*self.shapes.items(), ("final", repr(self.final))])

    @property
    def shapes(self) -> dict[str, tuple]:
        """Shapes of what was recorded, by name; it may be in a file, and is not read."""
        if hasattr(self.frames, "shapes"):
            return self.frames.shapes
        return {name: jnp.shape(x) for name, x in self.frames.items() if hasattr(x, "shape")}

    def plot(self, name: str | None = None, ax: Any = None) -> Any:
        """Draw a number that was recorded of each frame against time, of each member a line.

        Args:
            name: of what was recorded; by default the temperature, with kT, or else the first
                number there is.
            ax: matplotlib axes, or None for new ones.

        Returns the axes. Raises ValueError where nothing recorded under the name is one number a
        frame.
        """
        time, clocks = np.asarray(self.frames.get("time", ())), ("time", "step")
        numbers = [k for k, shape in self.shapes.items() if shape == time.shape and k not in clocks]
        first = "temperature" if "temperature" in numbers else next(iter(numbers), None)
        name = first if name is None else name
        if name not in numbers:
            raise ValueError(
                f"{name!r} is no number that was recorded of each frame; those are "
                f"{', '.join(numbers)}"
            )
        ax = drawing.axes(ax)
        ax.plot(np.atleast_2d(time).T, np.atleast_2d(self.frames[name]).T, lw=1)
        if name == "temperature":
            for kT in np.unique(np.asarray(self.fluid.kT)):
                ax.axhline(kT, color="0.4", ls="--", lw=1)
        ax.set(xlabel="t [time]", ylabel=drawing.labelled(name))
        return ax

    def to_xarray(self) -> Any:
        """All that was recorded as an ``xarray.Dataset``: dimension ``frame``, in a batch
        ``member`` before it, with ``time`` and ``step`` as coordinates; further dimensions of
        ``name`` are ``name_0``, ``name_1``.

        Raises ImportError, with the cure, where xarray is missing.
        """
        return to_xarray(self)

    def to_pandas(self) -> Any:
        """The numbers, vectors and tensors of each frame as a ``pandas.DataFrame``, a column for
        each component (``pressure_tensor_xy``), by ``time``; of a batch by ``member`` and ``time``.

        What was recorded of each bead is left out, ``to_xarray`` has it. Raises ImportError, with
        the cure, where pandas is missing.
        """
        return to_pandas(self)

    def __add__(self, later: "Trajectory") -> "Trajectory":
        """This run and one that went on from its final state, with the same numbers, records and
        steps between frames, as one; ValueError for what does not fit."""
        return joined(self, later) if isinstance(later, Trajectory) else NotImplemented

    @property
    def fluid(self) -> Fluid:
        """The matter that was run."""
        return self.system.fluid

    @property
    def flow(self) -> Flow:
        """What drove it."""
        return self.system.flow

    @property
    def dt(self) -> Any:
        """The time step [time]."""
        return self.system.dt

    @property
    def interval(self) -> Any:
        """Time between two frames; ValueError where they are not evenly spaced."""
        if self.every is None:
            raise ValueError(
                "the frames of this run are not evenly spaced, and this measure follows them "
                "through time: run it with dpd.Plan(frames, every)"
            )
        return self.dt * self.every

    @property
    def tau(self) -> Any:
        """Bare diffusion time ``6 pi eta_0 R^3 / kT`` of the colloids that were run [time], of each
        member of a scan; ValueError for a fluid without colloids, or whose laws tell no
        viscosity."""
        try:
            tau = np.asarray(diffusion_time(self.fluid), float)
        except TypeError as error:
            raise ValueError(
                f"this run has no diffusion time: {error}; or give a time of your own, "
                "6 pi eta R^3 / kT"
            ) from error
        if not np.all(np.isfinite(tau) & (tau > 0)):
            raise ValueError(
                f"the diffusion time is {tau}: kT and eta_0 of the fluid must be above zero"
            )
        return tau if tau.ndim else float(tau)

    @property
    def is_batch(self) -> bool:
        """Whether there are several members, each with its own frames and final state."""
        return jnp.ndim(self.final.position) == 3

    def __getitem__(self, which) -> "Trajectory":
        """Members of a batch with their own numbers: one by its number, or a batch by a slice or a
        list of numbers."""
        if not self.is_batch:
            raise TypeError(
                "this trajectory is no batch and has no members to choose from; its frames are in "
                ".frames, and trajectory.last(count) has the last of them"
            )
        members = self.final.position.shape[0]
        slots = np.arange(members)[which]
        if np.ndim(slots) > 1 or not np.size(slots):
            raise IndexError(
                f"{which!r} chooses no members of the {members} of this batch; give a number, a "
                "slice or a list"
            )
        final, frames = chosen((self.final, self.frames), 0, slots)
        failed = tuple(
            (k, why)
            for k, member in enumerate(np.ravel(slots))
            for n, why in self.failed
            if n == member
        )
        new = {"final": final, "frames": frames, "system": self.system.member(slots)}
        complete = self.complete and not (failed and np.ndim(slots) == 0)
        return dataclasses.replace(self, **new, complete=complete, failed=failed)

    def last(self, count: int) -> "Trajectory":
        """The run with the last frames alone, for measures that average over frames: of one that
        ages, its end. ValueError for more than there are."""
        axis = 1 if self.is_batch else 0
        frames = np.shape(self.frames["time"])[axis]
        if whole(count, "count") > frames:
            raise ValueError(f"count is {count}, and the run has {frames} frames")
        if hasattr(self.frames, "last"):
            return dataclasses.replace(self, frames=self.frames.last(count))
        later = lambda values: values[:, -count:] if axis else values[-count:]
        return dataclasses.replace(
            self, frames={name: later(values) for name, values in self.frames.items()}
        )

    @property
    def survivors(self) -> "Trajectory":
        """The members of a batch that did not fail, as a batch; ValueError where all did."""
        if not self.failed:
            return self
        lost = dict(self.failed)
        left = [k for k in range(self.final.position.shape[0]) if k not in lost]
        if not left:
            raise ValueError(f"all {len(lost)} members failed: {next(iter(lost.values()))}")
        return self[left]

    def members(self) -> list["Trajectory"]:
        """The trajectories of a batch one by one, each with its own numbers; of one run, that
        alone."""
        return [self[k] for k in range(self.final.position.shape[0])] if self.is_batch else [self]
