"""How much to run, and what a run leaves behind."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax import drawing
from dpdjax.engine.batching import chosen
from dpdjax.engine.flow import Flow
from dpdjax.engine.state import State
from dpdjax.engine.system import System
from dpdjax.model import summary
from dpdjax.model.fluid import Fluid


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Plan:
    """How much to run and how much to keep; static, so that it may go through ``jax.jit``.

    Attributes:
        frames: recorded frames.
        every: steps between two frames.
    """

    frames: int
    every: int = 1

    def __post_init__(self):
        for name in ("frames", "every"):
            value = getattr(self, name)
            whole = isinstance(value, (int, float, np.number)) and value % 1 == 0
            if isinstance(value, bool) or not whole or value < 1:
                raise ValueError(
                    f"Plan {name} is {value!r}; it must be a whole number of at least 1"
                )
            object.__setattr__(self, name, int(value))

    @property
    def steps(self) -> int:
        return self.frames * self.every


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
        every: steps between two frames (static).
        complete: whether all planned frames are there (static).
        means: names of those frames that are means over their interval (static).
        failed: of a batch, the members that failed and why (static); their frames are NaN from then
            on, and their final state is the last that was sound.
    """

    final: State
    frames: dict[str, Any]
    system: System
    every: int = dataclasses.field(default=1, metadata={"static": True})
    complete: bool = dataclasses.field(default=True, metadata={"static": True})
    means: tuple[str, ...] = dataclasses.field(default=(), metadata={"static": True})
    failed: tuple[tuple[int, str], ...] = dataclasses.field(default=(), metadata={"static": True})

    def __repr__(self):
        recorded = {name: jnp.shape(x) for name, x in self.frames.items() if hasattr(x, "shape")}
        count = recorded.get("step", (0,))[-1:]
        head = (
            f"Trajectory({count[0] if count else 0} frames, one in {self.every} steps of "
            f"{summary.span(self.dt)}"
        )
        told = [
            "" if self.complete else "interrupted",
            f"members {[k for k, _ in self.failed]} failed" if self.failed else "",
        ]
        head = ", ".join([head, *filter(None, told)])
        values = ", ".join(f"{name} {shape}" for name, shape in recorded.items())
        return f"{head}: {values}; final {self.final!r})"

    def _repr_html_(self):
        recorded = [(k, jnp.shape(x)) for k, x in self.frames.items() if hasattr(x, "shape")]
        title = repr(self).partition(":")[0].replace("(", ", ", 1)
        return summary.as_table(title, [*recorded, ("final", repr(self.final))])

    def plot(self, name: str | None = None, ax: Any = None) -> Any:
        """Draw a number that was recorded of each frame against time, of each member a line.

        Args:
            name: of what was recorded; by default the temperature, with kT, or else the first
                number there is.
            ax: matplotlib axes, or None for new ones.

        Returns the axes. Raises ValueError where nothing recorded under the name is one number a
        frame.
        """
        time = np.asarray(self.frames.get("time", ()))
        clocks = ("time", "step")
        numbers = [
            k for k, x in self.frames.items() if np.shape(x) == np.shape(time) and k not in clocks
        ]
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
        ax.set(xlabel="t [time]", ylabel=name)
        return ax

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
        """Time between two frames."""
        return self.dt * self.every

    @property
    def is_batch(self) -> bool:
        return jnp.ndim(self.final.position) == 3

    def __getitem__(self, which) -> "Trajectory":
        """Members of a batch with their own numbers: one by its number, or a batch by a slice or a
        list of numbers."""
        if not self.is_batch:
            raise TypeError(
                "this trajectory is no batch and has no members to choose from; its frames are in "
                ".frames"
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
