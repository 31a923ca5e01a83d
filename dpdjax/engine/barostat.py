"""A box whose sides fluctuate about what a pressure and a surface tension ask for."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.checks import choice, number, positive
from dpdjax.engine.answers import check_part
from dpdjax.engine.integrator import Integrator, VelocityVerlet
from dpdjax.engine.multistep import MultipleTimeStep
from dpdjax.engine.observables import STATIC, pressure_tensor
from dpdjax.engine.state import State
from dpdjax.model import advice
from dpdjax.model.fluid import Fluid
from dpdjax.pairs import noise

COUPLINGS = {
    "isotropic": ((0, 1, 2),),
    "semi-isotropic": ((0, 1), (2,)),
    "normal": ((2,),),
}
"""Which sides change by one factor; those left out stay as they are."""
PLANE = (0, 1)
"""The sides of the area that a tension pulls at."""
SLOW = 10.0
"""Steps at least in the relaxation time of the box."""
LIMIT = f"barostat: the relaxation time of the box is to be {SLOW:g} steps at least"
ERRING = "fluctuations of the volume"
CHECKS = {
    "pressure": number,
    "relaxation": positive,
    "compressibility": positive,
    "tension": number,
}
TALLIED = 1.2
"""A step with the sums over pairs, in units of one without."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class CellRescaling(Integrator):
    """A barostat: stochastic cell rescaling, by which the sides of the box fluctuate as in the
    ensemble of constant pressure, tension and temperature (Bernetti & Bussi 2020; in the plane and
    across it Del Tatto, Bernetti, Campomanes & Bussi 2022).

    For each group of k sides that change by one factor, ``e`` the logarithm of their product,
    ``de = -k beta / (3 tau) (p - gamma / L_z - P) dt + sqrt(2 k kT beta / (3 V tau)) dW``,
    P the mean of the pressure along them and ``gamma / L_z`` for x and y alone. All three sides
    together (k = 3) are eq. 7 of 2020, the plane (k = 2) and its normal (k = 1) eqs. 5 of 2022. It
    is a gradient descent with noise in the free energy, so that states come with the weight
    ``exp(-(H + p V - gamma A) / kT)``.

    ==========================================================  ===================================
    in a step                                                   here
    ==========================================================  ===================================
    e' = e + de, of the pressure before the step                ``stretch``
    velocities half kicked, beads moved                         :func:`dpdjax.integrators.drifted`
    sides and positions times s, velocities by 1 / s            :func:`dpdjax.integrators.drifted`
    forces in the new box, the other half kick                  the ``base``
    ==========================================================  ===================================

    So no force is ever one of another box, and a step costs what the sums over pairs at every step
    cost. P is what the free energy has for a slope: the kinetic and the conservative part. Drag and
    noise between pairs belong to the thermostat, which keeps the ensemble of any fixed box; their
    stress is the slope of no energy, and the volume would answer it by fluctuations that are not
    its own. Total momentum is fixed at zero, so that the kinetic part lacks three freedoms: P is by
    ``kT / V`` more than :func:`dpdjax.observe.pressure_tensor` tells, whose mean then is
    ``p - kT <1/V>``.

    In equilibrium any ``relaxation`` and any ``compressibility`` give the same ensemble: they say
    only, by their quotient, how fast the volume moves. The variance of the volume errs by
    ``dt / 2 tau``. A box that shrinks below twice the reach of its lists is refused, as a start is.

    Attributes:
        pressure: wanted along all sides that change [energy / volume].
        relaxation: time ``tau`` in which a volume relaxes, if the compressibility is right [time].
        compressibility: ``beta``, isothermal, roughly [volume / energy]; by default that of the
            usual fluid (a = 25 kT, density 3).
        tension: ``gamma`` of the box, of all interfaces that lie across z together; 0 for a
            membrane without tension [energy / area]. Meant for the coupling "semi-isotropic".
        coupling: which sides change by one factor (static): "isotropic", all; "semi-isotropic", x
            and y, and z for itself, of a box with an interface or a membrane across z: nothing
            holds the shape of a fluid without; "normal", z alone.
        base: the integrator that moves the beads: any whose step begins with
            :func:`dpdjax.integrators.drifted`.

    Example:
        >>> how = dpd.integrators.CellRescaling(pressure=23.65)
        >>> after = dpd.step(water, state, key, 0.01, integrator=how)
        >>> float(state.box.volume), bool(0.0 < abs(after.box.volume - 64.0) < 1.0)
        (64.0, True)
        >>> membrane = dpd.integrators.CellRescaling(23.65, tension=0.0, coupling="semi-isotropic")
    """

    ranks = {"pressure": 0, "relaxation": 0, "compressibility": 0, "tension": 0}
    changes_box = True

    pressure: Any
    relaxation: Any = 1.0
    compressibility: Any = 0.02
    tension: Any = 0.0
    coupling: str = dataclasses.field(default="isotropic", metadata={"static": True})
    base: Integrator = VelocityVerlet()

    @property
    def kinds(self):
        """Those of the base."""
        return self.base.kinds

    @property
    def cost(self):
        """That of the base, with sums over pairs at every step."""
        return TALLIED * self.base.cost

    def step(self, system, state: State, key: jax.Array, tally: bool) -> State:
        """A step of the base, in which the sides of the box change; always with sums over pairs."""
        stretch = self.stretch(system, state, key)
        within = dataclasses.replace(system, integrator=self.base, stretch=stretch)
        after = self.base.step(within, state, key, True)
        if after.box.lengths is state.box.lengths:
            raise TypeError(
                f"the step of {type(self.base).__name__} leaves the box as it is: begin it with "
                "dpd.integrators.drifted(...), which changes the box that a barostat asks it to"
            )
        return after

    def stretch(self, system, state: State, key: jax.Array) -> jax.Array:
        """Factors (3,) that the sides change by in the step that follows a state."""
        fluid, volume = system.fluid, state.box.volume
        pressure = jnp.diagonal(pressure_tensor(fluid, state, STATIC)) + fluid.kT / volume
        excess = pressure - self._wanted(state.box)
        groups = COUPLINGS[self.coupling]
        step = system.dt * self.compressibility / (3.0 * self.relaxation)
        xi = noise.box_noise(key, state.step, len(groups), state.position.dtype)
        logarithm = jnp.zeros_like(excess)
        for sides, x in zip(groups, xi):
            k, sides = len(sides), np.array(sides)
            change = k * step * jnp.mean(excess[sides])
            change += jnp.sqrt(2.0 * k * step * fluid.kT / volume) * x
            logarithm = logarithm.at[sides].set(change / k)
        return jnp.exp(logarithm)

    def _wanted(self, box):
        """The pressure wanted along each side (3,)."""
        in_plane = self.tension / box.lengths[2]
        return jnp.stack([self.pressure - (in_plane if k in PLANE else 0.0) for k in range(3)])

    def forces(self, system, state, key, tally):
        return self.base.forces(system, state, key, tally)

    def mark_of(self, fluid: Fluid) -> int:
        """That of the base, whose states it goes on with."""
        return self.base.mark_of(fluid)

    def batch_axes(self):
        own, base = super().batch_axes(), self.base.batch_axes()
        if base is None:
            return own
        none = dict.fromkeys(self.ranks)
        axes = dataclasses.replace(self, **none) if own is None else own
        return dataclasses.replace(axes, base=base)

    def check(self, fluid: Fluid) -> None:
        """Raise TypeError for a base that is no integrator, ValueError for one that moves beads in
        a box that stays, another coupling, and numbers that cannot be."""
        choice(self.coupling, COUPLINGS, "coupling of CellRescaling")
        for name, check in CHECKS.items():
            check(getattr(self, name), f"{name} of CellRescaling")
        check_part(self.base, (Integrator,), "base of CellRescaling", "an integrator")
        if isinstance(self.base, (MultipleTimeStep, CellRescaling)):
            raise ValueError(
                f"the base of CellRescaling is {type(self.base).__name__}, in which the box cannot "
                "change; use dpd.integrators.VelocityVerlet() or ImplicitDrag()"
            )
        self.base.check(fluid)

    def check_flow(self, flow) -> None:
        """Raise ValueError for a flow that deforms the box."""
        if flow.deforms:
            raise ValueError(
                f"{type(flow.deformation).__name__} deforms the box that CellRescaling stretches, "
                "and the two have not been tried together: shear at constant volume, "
                "integrator=dpd.integrators.VelocityVerlet()"
            )
        self.base.check_flow(flow)

    def dt_limits(self, fluid, density, sizes):
        """Those of the base, and a tenth of the relaxation time."""
        fastest = float(np.min(np.asarray(self.relaxation)))
        return [*self.base.dt_limits(fluid, density, sizes), (LIMIT, fastest / SLOW)]

    def dt_errors(self, fluid, density, error=advice.ERROR):
        """Those of the base, and that of the variance of the volume, ``dt / 2 tau``."""
        fastest = float(np.min(np.asarray(self.relaxation)))
        return [*self.base.dt_errors(fluid, density, error), (ERRING, 2.0 * error * fastest)]
