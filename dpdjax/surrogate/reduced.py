"""One-species fluids in thermal units, in which four numbers say all there is to say of them.

With kT, the mass of a bead and the reach as units, a fluid of ``a`` and ``gamma w^s`` at a density
is that of ``a r_c/kT``, ``gamma r_c/sqrt(m kT)``, ``s`` and ``density r_c^3``: an exact scaling.
"""

import dataclasses
import math

import numpy as np

from dpdjax.checks import is_concrete
from dpdjax.model.declare import CENTRAL
from dpdjax.model.fluid import Fluid, fluid
from dpdjax.model.laws import central_drag, power_drag, soft_repulsion
from dpdjax.model.term import Term, term
from dpdjax.model.units import Units

WHAT = (
    "the atlas is of beads of one species with dpd.soft_repulsion and dpd.central_drag or "
    "dpd.laws.power_drag of one reach"
)
QUADRATIC = 2.0
"""Exponent of ``central_drag``."""


def scale_of(quantity: str, units: Units) -> float:
    """One thermal unit of a quantity in those of a fluid, or of what units are."""
    if quantity == "compressibility":
        return 1.0 / units.scale("pressure")
    return 1.0 if quantity in ("schmidt", "inverse_compressibility") else units.scale(quantity)


@dataclasses.dataclass(frozen=True)
class Reduced:
    """A fluid in thermal units, and these units.

    Attributes:
        density: beads per reach cubed.
        repulsion: ``a r_c / kT``.
        friction: ``gamma r_c / sqrt(m kT)``.
        exponent: of the weight, ``s``.
        units: what one unit is in those of the fluid.
    """

    density: float
    repulsion: float
    friction: float
    exponent: float = QUADRATIC
    units: Units = Units(1.0, 1.0, 1.0)

    @classmethod
    def of(cls, matter: Fluid, density: float) -> "Reduced":
        """That of a fluid at a density; ValueError for one that is none of these."""
        repulsion, drag = _laws(matter)
        kT, mass = _plain(matter.kT, "kT"), _plain(matter.mass, "mass")
        if kT <= 0:
            raise ValueError("the fluid has kT 0, and without it there are no thermal units")
        r_c = _plain(drag.coefficients["r_c"], "r_c")
        a = 0.0 if repulsion is None else _plain(repulsion.coefficients["a"], "a")
        reach = r_c if repulsion is None else _plain(repulsion.coefficients["r_c"], "r_c")
        if a and reach != r_c:
            raise ValueError(f"the repulsion reaches to {reach:g}, the drag to {r_c:g}; {WHAT}")
        gamma = _plain(drag.coefficients["gamma"], "gamma")
        exponent = _plain(drag.coefficients.get("s", QUADRATIC), "s")
        units = Units(r_c, mass, r_c * math.sqrt(mass / kT))
        friction = gamma * r_c / math.sqrt(mass * kT)
        return cls(density * r_c**3, a * r_c / kT, friction, exponent, units)

    @property
    def numbers(self) -> np.ndarray:
        """The four of them (4,)."""
        return np.array([self.density, self.repulsion, self.friction, self.exponent])

    @property
    def fluid(self) -> Fluid:
        """The fluid, in the units that it had."""
        law, more = (
            (central_drag, {}) if self.exponent == QUADRATIC else (power_drag, {"s": self.exponent})
        )
        drag = term(law, gamma=self.gamma, r_c=self.units.length, **more)
        repulsion = term(soft_repulsion, a=self.a, r_c=self.units.length)
        return fluid([repulsion], [drag], kT=self.units.energy, mass=self.units.mass)

    @property
    def a(self) -> float:
        """Repulsion in units of the fluid [energy/length]."""
        return self.repulsion * self.units.scale("force")

    @property
    def gamma(self) -> float:
        """Friction in units of the fluid [mass/time]."""
        return self.friction * self.units.scale("friction")


def _laws(matter: Fluid):
    """Repulsion, None where there is none, and drag."""
    if not isinstance(matter, Fluid):
        raise TypeError(
            f"the fluid is a {type(matter).__name__}; give dpd.water() or dpd.fluid(...)"
        )
    if len(matter.interactions) != 1 or matter.species != 1 or matter.has_radii:
        raise ValueError(f"the fluid has colloids, groups or species; {WHAT}")
    if matter.bonded:
        raise ValueError(f"the fluid has bonds; {WHAT}")
    (among,) = matter.interactions
    laws = [t.law for t in among.conservative], [t.law for t in among.drag]
    if (
        laws[0] not in ([], [soft_repulsion])
        or laws[1] not in ([central_drag], [power_drag])
        or among.random is not None
    ):
        names = ", ".join(dict.fromkeys(law.__name__ for law in laws[0] + laws[1])) or "no drag"
        raise ValueError(f"the fluid has {names}; {WHAT}")
    for one in among.terms:
        _refuse_changed(one)
    return (among.conservative or (None,))[0], among.drag[0]


def _refuse_changed(one: Term):
    """ValueError for a term that is cut before its end, or acts across the line of centres."""
    name = one.law.__name__
    if one.projector != CENTRAL:
        raise ValueError(f"the {name} of the fluid has projector={one.projector!r}; {WHAT}")
    r_c = _plain(one.coefficients["r_c"], "r_c")
    cut = r_c if one.cut is None else _plain(one.cut, "reach")
    if cut != r_c:
        raise ValueError(f"the {name} of the fluid has reach={cut:g} and r_c={r_c:g}; {WHAT}")


def _plain(value, name: str) -> float:
    if not is_concrete(value):
        raise TypeError(f"{name} is being traced by jit, vmap or grad; the atlas needs to know it")
    value = np.asarray(value, float)
    if value.size != 1:
        raise ValueError(f"{name} is an array of shape {value.shape}; the atlas is asked of one")
    return float(value.reshape(()))


# ------------------------------------------------------------ theory, of numbers (n, 4)


def moment(s, power: int):
    """Integral of ``(1 - r)^s r^(power - 1)`` from 0 to 1."""
    found = float(math.factorial(power - 1))
    for k in range(1, power + 1):
        found = found / (s + k)
    return found


def damping(numbers):
    """Rate at which drag damps a bead, ``density/3`` times the integral of the friction (n,)."""
    density, _, friction, s = numbers.T
    return 4 * math.pi / 3 * density * friction * moment(s, 3)


def diffusion(numbers):
    """Self-diffusion without correlations or repulsion, ``kT/(m damping)`` (n,)."""
    return 1.0 / damping(numbers)


def viscosity(numbers):
    """Viscosity without correlations or repulsion, that of Marsh et al. (1997) (n,)."""
    density, _, friction, s = numbers.T
    drag = 2 * math.pi / 15 * density**2 * friction * moment(s, 5)
    return 0.5 * density * diffusion(numbers) + drag


def repulsive_pressure(numbers):
    """What repulsion adds to the pressure without correlations, ``pi/30 a density^2`` (n,)."""
    density, repulsion, *_ = numbers.T
    return math.pi / 30 * repulsion * density**2


def strength(numbers):
    """Friction that damps as much at exponent 2 (n,)."""
    _, _, friction, s = numbers.T
    return friction * moment(s, 3) / moment(QUADRATIC, 3)
