"""What a calibration aims at: a number a stationary run measures, and the flow it needs."""

import dataclasses
import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from dpdjax.checks import plain, positive
from dpdjax.engine.deformation import shear
from dpdjax.engine.flow import Flow
from dpdjax.engine.observables import STATIC, pressure_tensor, temperature
from dpdjax.model.fluid import Fluid
from dpdjax.model.rates import (
    damping_rate,
    kinetic_theory_viscosity,
    over,
    repulsion_energy,
    thermal_time,
)
from dpdjax.surrogate.foresight import foretold


@dataclasses.dataclass(frozen=True)
class Goal:
    """A wanted number.

    Attributes:
        name: what it is, for messages.
        target: its wanted value.
        observe: ``observe(fluid, state) -> dict`` with ``value``; with ``noise`` where a
            quantity of mean zero goes along with it (a control variate); with ``temperature``
            where the flow may heat.
        flow: the flow of the runs.
        scale: the wanted number is ``scale`` times the recorded ``value``.
    """

    name: str
    target: float
    observe: Callable
    flow: Flow
    scale: float = 1.0


def viscosity_goal(target: float, rate: float) -> Goal:
    """Viscosity ``-<P_xy>/rate`` in homogeneous shear."""
    return Goal("viscosity", float(target), _shear_stress, Flow.of(shear(rate)), -1.0 / rate)


def _shear_stress(fluid, state):
    return {
        "value": pressure_tensor(fluid, state)[0, 1],
        "noise": state.tally.virial["random"][0, 1] / state.box.volume,
        "temperature": temperature(fluid, state),
    }


def viscosity_goal_at(fluid, density: float, target: float, tolerance: float) -> Goal:
    """:func:`viscosity_goal` at the rate that suits this fluid, thin as it may be in drag and thick
    in kinetics."""
    viscosity = max(target, rough_viscosity(fluid, density))
    return viscosity_goal(target, suggest_rate(fluid, density, viscosity, tolerance))


def pressure_goal(target: float) -> Goal:
    """Pressure ``trace/3`` of the kinetic part and all potentials in equilibrium."""
    return Goal("pressure", float(target), _pressure, Flow())


def _pressure(fluid, state):
    return {"value": jnp.trace(pressure_tensor(fluid, state, STATIC)) / 3.0}


def custom_goal(target: float, observe: Callable, flow=None, name: str = "value") -> Goal:
    """Any number ``observe(fluid, state)`` whose mean in a stationary run is wanted."""
    return Goal(name, float(target), _named(observe), Flow.of(flow))


@functools.cache
def _named(observe):
    return lambda fluid, state: {"value": observe(fluid, state)}


ONE_NUMBER = "give a function of one number, such as observe=dpd.observe.temperature"


def check_observed(goal: Goal, fluid, state):
    """Raise TypeError unless what is observed of one state is one real number."""
    found = jax.eval_shape(goal.observe, fluid, state)["value"]
    if getattr(found, "shape", None) != () or jnp.issubdtype(found.dtype, jnp.complexfloating):
        kind = (
            f"an array of shape {found.shape}"
            if hasattr(found, "shape")
            else f"a {type(found).__name__}"
        )
        raise TypeError(f"observe returns {kind} where the target is one number; {ONE_NUMBER}")


def damped(fluid, density: float) -> float:
    """:func:`damping_rate`; raises ValueError where it is zero: shear would heat such a fluid for
    ever."""
    omega = damping_rate(fluid, density)
    if omega <= 0:
        raise ValueError(
            "this fluid has no drag, so no steady viscosity; give it a gamma above zero"
        )
    return omega


def rough_viscosity(fluid, density: float) -> float:
    """:func:`kinetic_theory_viscosity` of a fluid with drag, and ValueError as :func:`damped`."""
    damped(fluid, density)
    return kinetic_theory_viscosity(fluid, density)


def likely_viscosity(fluid, density: float) -> float:
    """That of the atlas; :func:`rough_viscosity` of a fluid that it does not cover."""
    known = foretold(fluid, density, "viscosity")
    return rough_viscosity(fluid, density) if known is None else known.value


HEATING = 2.5
"""Measured viscous heating over its mean-field estimate (2.2 at a = 0, 2.7 for the colloid
solvent)."""
RATE_LIMIT = 0.8
"""Largest shear rate in units of the inverse thermal time ``sqrt(kT / m) / r_c``.

Beyond, structure has no time to relax: at (a 2.5, kT 0.1, gamma 51) LAMMPS gives 1.2 +- 0.8 % less
at a rate of 1.12 than at 0.32 of these units (tests/physics/lammps.json).
"""


STRUCTURE = 2.8e-5
"""What a shear rate of :func:`structure_rate` changes the viscosity by (measured at a 0: rates of
0.8 against 0.4 give 1.9 +- 0.5 % at gamma 90, 0.2 +- 0.5 % at gamma 20)."""


STIFF, STIFF_POWER, CROWDED = 1.75, 1.2, 0.5
"""How long stiff beads remember a shear in thermal times: ``1.75 (a/100)^1.2 (2.5/density)^0.5``,
``a`` their repulsion in kT over reach. Of viscosities at rates of 0.2, 0.4 and 0.8 (density 2.5, a
100, gamma 7.4: 2.410(14), 2.280(8), 1.985(3), as ``asinh(x)/x`` has it with x this time the rate)
and at twice a rate over once: 0.97 (2.5, 50, 7.4), 0.951(6) (8, 100, 400)."""


def thinning_time(fluid, density: float) -> float:
    """How long stiff beads remember a shear [time]: viscosities at a rate are those at none times
    ``asinh(x)/x``, with x this time the rate, as of Eyring (1936)."""
    reach = max(fluid.reaches())
    crowd = density * reach**3
    # The mean field of a (1 - r)^2/2 is pi/15 density a.
    a = repulsion_energy(fluid, density) / float(fluid.kT) / (math.pi / 15 * crowd)
    return STIFF * (a / 100.0) ** STIFF_POWER * (2.5 / crowd) ** CROWDED * thermal_time(fluid)


def suggest_rate(
    fluid: Fluid, density: float, viscosity: float | None = None, tolerance: float = 0.02
) -> float:
    """The largest shear rate whose bias stays below half the tolerance [1/time].

    Of a fluid of one kind of beads; colloids and chains relax more slowly than they do, and need
    smaller rates.

    One bias is viscous heating, ``eta rate^2 / (3 rho kT omega)`` times ``HEATING``, and it
    acts on the kinetic share of the viscosity, estimated as ``rho m D / 2`` of kinetic theory
    (Marsh et al. 1997) and taken as a third at least. The drag share does not feel it:
    at gamma 42, kT 0.1 an excess temperature of 10 % changed the viscosity by 1 %. The other is
    the structure that shear makes faster than it relaxes, ``STRUCTURE (rate / structure_rate)^2``.
    A third is that stiff beads thin, by ``(rate thinning_time)^2 / 6``.

    Args:
        fluid: with drag.
        density: beads per volume.
        viscosity: about; by default that of the atlas, or of kinetic theory where it has none.
        tolerance: relative, of the viscosity.

    Raises ValueError for a fluid without drag, and for numbers not above zero.

    Example:
        >>> rate = dpd.suggest_rate(water, density=3.0, tolerance=0.05)
        >>> 0.1 < dpd.suggest_rate(water, density=3.0) < rate < 1.0
        True
    """
    density, tolerance = (
        plain(density, "density", positive),
        plain(tolerance, "tolerance", positive),
    )
    kT, omega = float(fluid.kT), damped(fluid, density)
    viscosity = likely_viscosity(fluid, density) if viscosity is None else viscosity
    kinetic = 0.5 * density * kT / omega
    share = min(1.0, max(kinetic / viscosity, 1.0 / 3.0))
    heating = min(0.5 * tolerance / share, 0.03)
    rate = math.sqrt(heating / HEATING * 3 * density * kT * omega / viscosity)
    ordered = math.sqrt(0.5 * tolerance / STRUCTURE) * structure_rate(fluid, density)
    thin = over(math.sqrt(3.0 * tolerance), thinning_time(fluid, density))
    return min(rate, ordered, thin, RATE_LIMIT / thermal_time(fluid))


def structure_rate(fluid, density: float) -> float:
    """How fast the structure of beads relaxes over their reach, ``D (1 + u)/r_c^2`` [1/time]: D of
    kinetic theory, ``kT/(m omega)``, and the mean-field repulsion u of a bead in kT, which makes
    the fluid so much less compressible."""
    kT, omega = float(fluid.kT), damped(fluid, density)
    repulsion = 1.0 + repulsion_energy(fluid, density) / kT
    return kT / (float(jnp.min(fluid.mass)) * omega) * repulsion / max(fluid.reaches()) ** 2
