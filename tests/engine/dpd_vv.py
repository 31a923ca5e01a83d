"""An integrator written from the documentation alone, by one who had not seen the package."""

import dataclasses
from typing import Any, ClassVar

import jax
import numpy as np

from dpdjax import integrators
from dpdjax.theory import damping_rate


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class DPDVV(integrators.Integrator):
    """DPD-VV: velocity-Verlet that keeps the drag of the velocity it ends at for the next step.

    Besold, Vattulainen, Karttunen & Polson, Phys. Rev. E 62, R7611 (2000).

    Attributes:
        renewed: share of the kept drag that is of that velocity; 0 is velocity-Verlet.
    """

    ranks = {"renewed": 0}
    cost: ClassVar[float] = 2.0

    renewed: Any = 1.0

    def check(self, fluid):
        if not isinstance(self.renewed, jax.core.Tracer):
            share = np.asarray(self.renewed)
            if not np.all((share >= 0) & (share <= 1)):
                raise ValueError(f"renewed is a share, 0 to 1, not {self.renewed}")

    def dt_errors(self, fluid, density, error=0.005):
        """Those of velocity-Verlet, and a temperature that falls by 0.2 dt times the damping rate
        (measured, a 0 to 25, gamma 4.5 to 142)."""
        rate = damping_rate(fluid, density) * float(np.max(self.renewed))
        cold = [("temperature: drag taken anew", error / (0.2 * rate))] if rate > 0 else []
        return super().dt_errors(fluid, density, error) + cold

    def step(self, system, state, key, tally):
        moved, drift = integrators.drifted(system, state, 0.5)
        on = lambda state, velocity, kinds: integrators.forces_on(
            system, state, velocity, key, tally, kinds
        )
        still = on(moved, moved.velocity, ("conservative", "random", "driven"))
        first = on(moved, drift.predicted(0.5), ("drag",))
        end = integrators.settled(system, state, moved, drift, still + first)
        last = on(end, end.velocity, ("drag",))
        return integrators.with_forces(
            end, still + (1.0 - self.renewed) * first + self.renewed * last
        )
