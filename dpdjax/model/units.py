"""Units: what one DPD unit is in SI, and the water preset.

A unit system is mechanical: energy = mass length^2 / time^2. Three scales can be chosen
and the fourth follows, so whoever fixes the time by a transport coefficient no longer
has both the mass and the energy of the real liquid.
"""

import dataclasses
import math
from typing import Any

import jax
from jax.typing import ArrayLike

from dpdjax.checks import is_concrete, number, plain, positive
from dpdjax.model.fluid import Fluid, fluid
from dpdjax.model.laws import central_drag, soft_repulsion
from dpdjax.model.term import term

BOLTZMANN = 1.380649e-23
"""Boltzmann constant [J/K]."""
MOLECULE_MASS = 18.0e-3 / 6.02214076e23
"""One water molecule, at 18 g/mol [kg]."""
MOLECULE_VOLUME = 30.0e-30
"""One water molecule in the liquid [m^3]."""

DIMENSIONS = {
    "length": (1, 0, 0),
    "mass": (0, 1, 0),
    "time": (0, 0, 1),
    "volume": (3, 0, 0),
    "velocity": (1, 0, -1),
    "acceleration": (1, 0, -2),
    "force": (1, 1, -2),
    "energy": (2, 1, -2),
    "density": (-3, 1, 0),
    "number_density": (-3, 0, 0),
    "pressure": (-1, 1, -2),
    "surface_tension": (0, 1, -2),
    "friction": (0, 1, -1),
    "viscosity": (-1, 1, -1),
    "kinematic_viscosity": (2, 0, -1),
    "diffusion": (2, 0, -1),
    "shear_rate": (0, 0, -1),
}
"""Powers of (length, mass, time); ``density`` is mass per volume, ``viscosity`` the dynamic one."""

FORMAL = "the mass unit is formal, so inertia and sound are not"
NOTES = {
    "thermal": "length, bead mass and kT are those of water; diffusion (too fast) and viscosity "
    "(too low) are not",
    "diffusion": f"length, kT and diffusion are those of water; {FORMAL}",
    "viscosity_energy": f"length, kT and viscosity are those of water; {FORMAL}",
    "viscosity_mass": "length, bead mass and viscosity are those of water; the energy unit is not "
    "kT: nothing thermal is",
}


@dataclasses.dataclass(frozen=True)
class Units:
    """One DPD unit in SI. Plain numbers of the host, not leaves of a run.

    Attributes:
        length: [m].
        mass: [kg].
        time: [s].
        note: what the units match and what they give up.

    Raises ValueError for a unit that is not finite and above zero.

    Example:
        >>> units = dpd.Units(length=1e-9, mass=1e-22, time=1e-11)  # of any liquid
        >>> round(units.to_si(0.85, "viscosity") * 1e3, 3)  # mPa s
        8.5
        >>> round(units.from_si(300 * 1.380649e-23, "energy"), 5)  # kT at 300 K
        0.00414
    """

    length: float
    mass: float
    time: float
    note: str = ""

    def __post_init__(self):
        for name in ("length", "mass", "time"):
            value = float(getattr(self, name))
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} unit is {value}; it must be finite and above zero")
            object.__setattr__(self, name, value)

    @property
    def energy(self) -> float:
        """``mass length^2 / time^2`` [J]."""
        return self.scale("energy")

    def scale(self, dimension: str) -> float:
        """One DPD unit of ``dimension`` in SI; ValueError lists the names for an unknown one."""
        if dimension not in DIMENSIONS:
            raise ValueError(f"no dimension {dimension!r}; there are {', '.join(DIMENSIONS)}")
        length, mass, time = DIMENSIONS[dimension]
        return self.length**length * self.mass**mass * self.time**time

    def to_si(self, value: Any, dimension: str) -> Any:
        """A number, array or ``Estimate`` in SI, ``to_si(0.85, "viscosity")`` [Pa s]."""
        return _times(value, self.scale(dimension))

    def from_si(self, value: Any, dimension: str) -> Any:
        """A number, array or ``Estimate`` in SI as DPD units, ``from_si(1e-3, "viscosity")``."""
        return _times(value, 1.0 / self.scale(dimension))


def water_units(
    time: str = "thermal",
    *,
    molecules: float = 3.0,
    density: float = 3.0,
    temperature: float = 298.0,
    kT: float = 1.0,
    diffusion: float = 0.171,
    viscosity: float = 0.85,
    water_diffusion: float = 2.43e-9,
    water_viscosity: float = 1.0e-3,
) -> Units:
    """Units in which a DPD fluid is water, ``molecules`` to a bead (Groot & Rabone 2001).

    The length is ``r_c = (density molecules 30 A^3)^(1/3)``, 6.463 A; beads at ``density``
    then weigh 996 kg/m^3. The time depends on what is to be matched:

    ====================  ===============================  =======  ============  ============
    ``time``              one time unit                             mass unit     energy unit
    ====================  ===============================  =======  ============  ============
    "thermal"             ``r_c sqrt(m / E)``              3.02 ps  bead m        E
    "diffusion"           ``molecules D r_c^2 / D_water``  88 ps    850 beads     E
    "viscosity_energy"    ``eta_water r_c^3 / (eta E)``    77 ps    650 beads     E
    "viscosity_mass"      ``eta m / (eta_water r_c)``      0.12 ps  bead m        650 E
    ====================  ===============================  =======  ============  ============

    with ``E = k_B temperature / kT``. What each gives up:

    * "thermal": sizes, energies and inertia keep their meaning; transport does not. Beads
      diffuse some 30 times too fast and the fluid is some 26 times too thin.
    * "diffusion": a bead diffuses like the centre of its molecules, ``D_water /
      molecules``. Forces, pressures and energies keep their meaning. The mass unit follows
      formally, so SI values of mass, mass density, kinematic viscosity, sound speed and
      Reynolds number are not those of water. Viscosity is right as far as ``eta D`` is.
    * "viscosity_energy": the same with the viscosity matched instead of diffusion.
    * "viscosity_mass": flow with inertia (density, viscosity, Reynolds number, viscous stress)
      is that of water. The energy unit is not thermal: kT = 1 stands for hundreds of times
      k_B T, so thermodynamic pressure, surface tension, Brownian motion and diffusion are not.

    The Schmidt number ``eta / (density m D)`` of the fluid is about 1, that of water 400;
    no unit system mends it.

    Args:
        time: what is matched, one of the four names.
        molecules: water molecules to a bead.
        density: beads per cubic length unit.
        temperature: of the water [K].
        kT: thermal energy of the fluid in its own units.
        diffusion: D of the fluid in its own units; 0.171 is Groot & Rabone's. The value
            measured at a = 25, gamma = 4.5 is near 0.3, which makes 150 ps.
        viscosity: eta of the fluid in its own units.
        water_diffusion: of water molecules [m^2/s]; Groot & Rabone's, measured ones are near
            2.3e-9.
        water_viscosity: [Pa s]; rounded, it is 0.89e-3 at 298 K.

    Returns :class:`dpdjax.model.units.Units`. Raises ValueError for another name of ``time`` or a
    number not above zero.

    Example:
        >>> units = dpd.water_units()
        >>> round(units.to_si(1.0, "length") * 1e10, 3), round(units.to_si(1.0, "time") * 1e12, 2)
        (6.463, 3.02)
        >>> round(dpd.water_units("diffusion").to_si(1.0, "time") * 1e12, 1)
        88.2
    """
    if not isinstance(time, str) or time not in NOTES:
        raise ValueError(f"no time unit {time!r}; there are {', '.join(NOTES)}")
    given = {
        "molecules": molecules,
        "density": density,
        "temperature": temperature,
        "kT": kT,
        "diffusion": diffusion,
    }
    given |= {
        "viscosity": viscosity,
        "water_diffusion": water_diffusion,
        "water_viscosity": water_viscosity,
    }
    for name, value in given.items():
        positive(value, name)
    length = (density * molecules * MOLECULE_VOLUME) ** (1 / 3)
    mass = molecules * MOLECULE_MASS
    energy = BOLTZMANN * temperature / kT
    seconds = {
        "thermal": length * math.sqrt(mass / energy),
        "diffusion": molecules * diffusion * length**2 / water_diffusion,
        "viscosity_energy": water_viscosity * length**3 / (viscosity * energy),
        "viscosity_mass": viscosity * mass / (water_viscosity * length),
    }[time]
    if time in ("diffusion", "viscosity_energy"):
        mass = energy * seconds**2 / length**2
    return Units(length, mass, seconds, NOTES[time])


def water(
    *,
    a: ArrayLike | None = None,
    gamma: ArrayLike = 4.5,
    kT: ArrayLike = 1.0,
    r_c: ArrayLike = 1.0,
    mass: ArrayLike = 1.0,
) -> Fluid:
    """The standard DPD fluid, to be used at a density of 3 beads per ``r_c^3``.

    Groot & Warren (1997). Its sizes in SI: :func:`dpdjax.water_units`.

    Args:
        a: repulsion [energy / length]; 25 kT / r_c by default, so it follows ``kT``.
        gamma: friction [mass / time].
        kT: thermal energy [energy].
        r_c: cut-off [length].
        mass: of a bead [mass].

    Returns a :class:`dpdjax.Fluid`. Raises ValueError for numbers no fluid can have.

    Example:
        >>> print(dpd.water(kT=0.5, gamma=9.0))
        kT 0.5, mass [1.]
        0-0  soft_repulsion, a 12.5, r_c 1: 12.5 kT at contact
        0-0  central_drag, gamma 9, r_c 1
    """
    if a is None:
        a = 25.0 * positive(kT, "kT", "or give a=...") / positive(r_c, "r_c")
    conservative, drag = (
        term(soft_repulsion, a=a, r_c=r_c),
        term(central_drag, gamma=gamma, r_c=r_c),
    )
    return fluid(conservative=[conservative], drag=[drag], kT=kT, mass=mass)


CHI = {3.0: 0.286, 5.0: 0.689}
"""Flory-Huggins parameter over the excess repulsion in kT, by density (Groot & Warren 1997, eqs. 22
and 23)."""


def flory_huggins(excess: ArrayLike, *, density: float = 3.0, kT: ArrayLike = 1.0) -> jax.Array:
    """The parameter chi of beads of two kinds, from how much more they repel each other than
    themselves, ``a_AB - a_AA`` [energy / length], of reach 1.

    Fitted to profiles of demixed fluids with chi of 3 and more (Groot & Warren 1997, eqs. 22 and
    23). Raises ValueError for densities other than 3 and 5, which were fitted.

    Example:
        >>> round(float(dpd.theory.flory_huggins(40.0 - 25.0)), 2)
        4.29
    """
    density = plain(density, "density", positive)
    if density not in CHI:
        known = " and ".join(f"{known:g}" for known in CHI)
        raise ValueError(f"chi was fitted at densities {known}, not at {density:g}")
    return CHI[density] * number(excess, "excess") / positive(kT, "kT")


def repulsion_from_compressibility(
    inverse_compressibility: ArrayLike, kT: ArrayLike = 1.0, density: ArrayLike = 3.0
) -> Any:
    """The repulsion ``a = kT (1/kappa - 1) / (0.2 density)`` [energy / length], for r_c = 1.

    Groot & Warren (1997), a fit that holds for density above 2. ``1/kappa`` is
    ``(dp/d density) / kT``, counted in beads: water has 16 per molecule, which makes a = 25
    for beads of one molecule. Beads of N molecules need 16 N, a = 78 for three (Groot &
    Rabone 2001); with a = 25 they are that much softer than water.

    Raises ValueError for a number not above zero, or ``1/kappa`` below 1, which is that of
    an ideal gas.

    Example:
        >>> [round(float(dpd.theory.repulsion_from_compressibility(n * 16.0)), 1) for n in (1, 3)]
        [25.0, 78.3]
    """
    stiffness = positive(inverse_compressibility, "inverse_compressibility")
    if is_concrete(stiffness) and (stiffness < 1).any():
        raise ValueError(
            f"inverse_compressibility is {inverse_compressibility}; an ideal gas has 1, repulsion "
            "adds to it"
        )
    return positive(kT, "kT") * (stiffness - 1.0) / (0.2 * positive(density, "density"))


def _times(value, factor):
    # An Estimate scales its error too; naming the type here would import measure into model.
    return value.scaled(factor) if hasattr(value, "scaled") else value * factor
