"""What a run needs beside a state and a key: a fluid, what drives it, a time step, a method."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from dpdjax.checks import number
from dpdjax.engine.batching import chosen, differing, lengths_of, named
from dpdjax.engine.flow import Flow
from dpdjax.engine.integrator import Integrator, VelocityVerlet
from dpdjax.model.fluid import Fluid


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class System:
    """The numbers of a run, one or a batch.

    Attributes:
        fluid: what the matter is.
        dt: time step [time].
        flow: what drives it from outside.
        integrator: how it moves on in time.
        stretch: factors (3,) that the sides of the box change by in the step that is being made, or
            None where they do not.
    """

    fluid: Fluid
    dt: Any
    flow: Flow
    integrator: Integrator
    stretch: Any = None

    @classmethod
    def of(cls, fluid, dt, flow=None, integrator=None) -> "System":
        """With no flow and velocity-Verlet unless others are given; ``flow`` as :meth:`Flow.of`
        takes it."""
        integrator = VelocityVerlet() if integrator is None else integrator
        dt = dt if isinstance(dt, float) else number(dt, "dt")
        return cls(fluid, dt, Flow.of(flow), integrator)

    def as_type(self, dtype) -> "System":
        """All numbers as arrays of a dtype."""
        return jax.tree.map(lambda x: jnp.asarray(x, dtype), self)

    def batch_axes(self) -> "System":
        """The ``in_axes`` for ``jax.vmap``: 0 for numbers with an axis of their own, a batch."""
        dt = 0 if jnp.ndim(self.dt) else None
        parts = (self.fluid, self.flow, self.integrator)
        fluid, flow, integrator = (part.batch_axes() for part in parts)
        return System(fluid, dt, flow, integrator)

    @property
    def is_batch(self) -> bool:
        """Whether any number carries a batch axis."""
        return bool(self.lengths())

    def lengths(self) -> set[int]:
        """The numbers of members that batches among the numbers speak of; one, if all agree."""
        return lengths_of(self, self.batch_axes())

    def member(self, which) -> "System":
        """The numbers of a member, or of several by a slice or a list."""
        return chosen(self, self.batch_axes(), which)

    def differing(self) -> dict:
        """Numbers that differ from member to member, by name: (members, ...) each, known values."""
        return differing(self, self.batch_axes())

    def named(self, member: int) -> str:
        """A member by its number, with those of its numbers that differ from the others'."""
        return named(member, self.differing())
