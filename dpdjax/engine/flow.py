"""What drives a fluid from outside: at most one deformation of the box, any number of drivers."""

import dataclasses
from collections.abc import Sequence

import jax

from dpdjax.engine.answers import check_part
from dpdjax.engine.deformation import Deformation, Still
from dpdjax.engine.drivers import Driver

KNOWN = (
    "dpd.shear(rate), dpd.oscillatory_shear(...), dpd.flows.body_force(...), dpd.drive(...), a "
    "list of them, an object of a class derived from dpd.flows.Deformation or dpd.flows.Driver"
)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Flow:
    """All that drives a run, one or a batch.

    Attributes:
        deformation: of the box.
        drivers: forces and torques on beads, which add up.
    """

    deformation: Deformation = Still()
    drivers: tuple[Driver, ...] = ()

    @classmethod
    def of(cls, flow) -> "Flow":
        """That of None, a deformation, a driver, a list of them, or a flow.

        Raises TypeError for anything else, ValueError for two deformations.
        """
        if isinstance(flow, Flow):
            return flow
        parts = () if flow is None else flow if isinstance(flow, (list, tuple)) else (flow,)
        for part in parts:
            check_part(part, (Deformation, Driver), "flow", KNOWN)
        deformations = [part for part in parts if isinstance(part, Deformation)]
        if len(deformations) > 1:
            kinds = " and ".join(type(part).__name__ for part in deformations)
            raise ValueError(f"{kinds} both deform the box, and it can follow one: give one")
        drivers = tuple(part for part in parts if isinstance(part, Driver))
        return cls(*deformations, drivers=drivers)

    @property
    def rate(self):
        """The shear rate; the largest where it changes [1/time]."""
        return self.deformation.rate

    @property
    def deforms(self) -> bool:
        """Whether it can tilt the box."""
        return self.deformation.deforms

    @property
    def is_steady(self) -> bool:
        """Whether the shear rate never changes."""
        return self.deformation.is_steady

    def driver(self, kind: type):
        """The driver of a kind, or None; ValueError for several."""
        found = [driver for driver in self.drivers if isinstance(driver, kind)]
        if len(found) > 1:
            raise ValueError(f"{len(found)} drivers of this run are a {kind.__name__}; which one?")
        return found[0] if found else None

    def check(self, fluid, state):
        """Raise TypeError or ValueError, before a run of one state, for what cannot work there."""
        for part in (self.deformation, *self.drivers):
            part.check(fluid, state)

    def rate_at(self, time):
        """Shear rate at a time [1/time]."""
        return self.deformation.rate_at(time)

    def strain_in(self, time, dt):
        """Shear strain of the step that begins at ``time``."""
        return self.deformation.strain_in(time, dt)

    def force(self, state, mass):
        """Force of all drivers on each bead (n, 3), or None; ``mass`` is (n, 1)."""
        return _sum(driver.force(state, mass) for driver in self.drivers)

    def torque(self, state):
        """Torque of all drivers on each bead that rotates (m, 3), or None."""
        return _sum(driver.torque(state) for driver in self.drivers)

    def batch_axes(self):
        """The ``in_axes`` for ``jax.vmap``: numbers with an axis of their own are a batch."""
        parts = self.deformation.batch_axes(), tuple(d.batch_axes() for d in self.drivers)
        return Flow(*parts) if jax.tree.leaves(parts) else None


def _sum(parts):
    """The sum of those that are not None, or None."""
    there = [part for part in parts if part is not None]
    return sum(there[1:], there[0]) if there else None


Driving = Flow | Deformation | Driver | Sequence[Deformation | Driver] | None
"""What ``flow=`` takes."""
