"""Fluids of wanted properties: the atlas read backwards."""

import dataclasses
import itertools
import math

import numpy as np

from dpdjax.checks import not_negative, plain, positive
from dpdjax.engine.choice import suited
from dpdjax.engine.integrator import Integrator
from dpdjax.errors import TargetError
from dpdjax.measure.statistics import Estimate
from dpdjax.model.fluid import Fluid
from dpdjax.model.summary import as_table
from dpdjax.model.units import BOLTZMANN, FORMAL, NOTES, Units
from dpdjax.surrogate.atlas import (
    QUANTITIES,
    SOFT,
    Properties,
    properties,
    refuse_outside,
)
from dpdjax.surrogate.reduced import QUADRATIC, Reduced, scale_of
from dpdjax.surrogate.search import KNOBS, PLACES, PRODUCT, Search, knobs_for

NEAR = "Some of these are not apart by their errors: what lies between may do as well."
SI = {
    "viscosity": "Pa s",
    "diffusion": "m^2/s",
    "schmidt": "",
    "pressure": "Pa",
    "compressibility": "1/Pa",
}
REPULSION, FRICTION = 25.0, 4.5
"""Where they are neither given nor found, in kT over reach, and in thermal units."""


@dataclasses.dataclass(frozen=True, repr=False)
class Branch:
    """A fluid that has what is wanted.

    Attributes:
        gamma: its friction, in its units; where it was found with the error that the atlas leaves.
        exponent: that of the weight of the friction, likewise.
        repulsion: ``a``, likewise.
        density: beads per volume.
        fluid: it, for :func:`dpdjax.simulate`, :func:`dpdjax.calibrate`, ...
        integrator: that suits it.
        dt: its step.
        properties: all that the atlas says of it, in its units.
        units: what these are in SI; None where nobody said.
    """

    gamma: Estimate
    exponent: Estimate
    repulsion: Estimate
    density: float
    fluid: Fluid
    integrator: Integrator
    dt: float
    properties: Properties
    units: Units | None = None

    @property
    def _rows(self) -> list[tuple[str, str]]:
        told = [(name, _written(getattr(self, name))) for name in KNOBS]
        told += [("density", f"{self.density:.6g}"), ("kT", f"{float(self.fluid.kT):.6g}")]
        step = f"{self.dt:.3g} ({type(self.integrator).__name__})"
        return [*told, ("dt", step), *self._properties, *self._units]

    @property
    def _properties(self) -> list[tuple[str, str]]:
        if self.units is None:
            return self.properties._rows
        own = [(name, getattr(self.properties, name)) for name in QUANTITIES]
        in_si = lambda name, value: value.scaled(scale_of(name, self.units))
        return [
            (name, f"{value} = {in_si(name, value)} {SI[name]}" if SI[name] else str(value))
            for name, value in own
        ]

    @property
    def _units(self) -> list[tuple[str, str]]:
        if self.units is None:
            return []
        formal = "kg, formal" if self.units.note == FORMAL else "kg"
        each = [("length", "m"), ("mass", formal), ("time", "s")]
        told = [(f"unit of {n}", f"{getattr(self.units, n):.4g} {unit}") for n, unit in each]
        temperature = float(self.fluid.kT) * self.units.energy / BOLTZMANN
        return [*told, ("temperature", f"{temperature:.4g} K")]

    def told(self) -> dict:
        """All numbers, as what JSON holds; those with errors as pairs."""
        pair = lambda value: [value.value, value.error]
        found = {name: pair(getattr(self, name)) for name in KNOBS}
        found |= {name: pair(getattr(self.properties, name)) for name in QUANTITIES}
        (drag,) = self.fluid.interactions[0].drag
        more = {
            "density": self.density,
            "kT": float(self.fluid.kT),
            "mass": float(np.ravel(self.fluid.mass)[0]),
            "r_c": float(drag.coefficients["r_c"]),
            "dt": self.dt,
            "integrator": type(self.integrator).__name__,
        }
        if self.units is not None:
            more["units"] = {n: getattr(self.units, n) for n in ("length", "mass", "time")}
        return found | more

    def __str__(self):
        return "\n".join(f"{name:16s} {value}" for name, value in self._rows)

    __repr__ = __str__


@dataclasses.dataclass(frozen=True, repr=False)
class Design:
    """The fluids that have what is wanted, of the largest friction first.

    Attributes:
        wanted: the numbers, as they were given.
        branches: the fluids, each a :class:`Branch`.
    """

    wanted: dict[str, float]
    branches: tuple[Branch, ...]

    @property
    def fluid(self) -> Fluid:
        """That of the first branch."""
        return self.branches[0].fluid

    def __getitem__(self, k: int) -> Branch:
        return self.branches[k]

    def __len__(self):
        return len(self.branches)

    def told(self) -> dict:
        """All numbers, as what JSON holds; those with errors as pairs."""
        return {"wanted": self.wanted, "branches": [branch.told() for branch in self.branches]}

    def __str__(self):
        unit = lambda name: "" if self.branches[0].units is None else f" {SI[name]}".rstrip()
        wanted = ", ".join(f"{name} {x:.6g}{unit(name)}" for name, x in self.wanted.items())
        count = f"{len(self)} fluid{'s' if len(self) > 1 else ''}"
        near = [NEAR] if self._are_near else []
        return "\n\n".join([f"{count} of {wanted}", *map(str, self.branches), *near])

    @property
    def _are_near(self) -> bool:
        """Whether some branches are one within the errors of what was found."""
        near = lambda one, other: all(
            getattr(one, name).deviation(getattr(other, name)) < 2.0
            for name in KNOBS
            if getattr(one, name).error > 0
        )
        return any(near(*pair) for pair in itertools.pairwise(self.branches))

    __repr__ = __str__

    def _repr_html_(self):
        columns = [branch._rows for branch in self.branches]
        rows = [(row[0][0], *(cell for _, cell in row)) for row in zip(*columns)]
        return as_table("Design", rows, ("", *(str(k) for k in range(len(self)))))


def design(
    *,
    viscosity: float | None = None,
    diffusion: float | None = None,
    schmidt: float | None = None,
    pressure: float | None = None,
    compressibility: float | None = None,
    density: float = 3.0,
    kT: float = 1.0,
    mass: float = 1.0,
    r_c: float = 1.0,
    gamma: float | None = None,
    exponent: float | None = None,
    repulsion: float | None = None,
    units: Units | None = None,
    find_time: bool = False,
) -> Design:
    """The fluids that have wanted properties, at once, by the atlas.

    As many of ``gamma``, ``exponent`` and ``repulsion`` are found as numbers are wanted, of those
    that are not given: pressure and compressibility turn the repulsion, the others gamma first and
    the exponent next; but viscosity and diffusion of a time that is found as well the repulsion.
    What is neither found nor given is 2 for the exponent, ``25 kT/r_c`` for the repulsion and
    ``4.5 sqrt(mass kT)/r_c`` for gamma.

    Args:
        viscosity: at small shear rates [energy time/length^3].
        diffusion: self-diffusion in a large system [length^2/time].
        schmidt: viscosity over mass density and diffusion.
        pressure: [energy/length^3].
        compressibility: ``1/(density dp/d density)`` [length^3/energy].
        density: beads per volume [1/length^3].
        kT, mass, r_c: thermal energy, mass of a bead, reach.
        gamma: friction of ``gamma (1 - r/r_c)^exponent`` [mass/time].
        exponent: of the weight of the drag.
        repulsion: ``a`` of the force ``a (1 - r/r_c)`` [energy/length].
        units: with them the wanted numbers are in SI, such as :func:`dpdjax.water_units` of the
            same ``kT`` and ``density``; what else is given stays in units of the fluid.
        find_time: take the length and the energy of ``units`` and find the time, for a viscosity
            and a diffusion together: what the fluid has to have is their product, and a unit of
            time then makes both right. The unit of mass follows, and is formal.

    Returns a :class:`Design` with all branches: of one viscosity there are often two gammas, and
    more where several numbers are found. Raises TargetError where there is none, with what can be
    reached; ValueError for what does not go together.

    Example:
        >>> found = dpd.design(viscosity=1.1, kT=0.1, repulsion=2.5)
        >>> found[0].gamma.value / found[0].gamma.error > 20
        True
        >>> fluid, dt = found.fluid, found[0].dt
        >>> liquid = dpd.water_units(molecules=1.0, temperature=298.0)
        >>> in_si = dpd.design(viscosity=0.9e-3, diffusion=2.3e-9, units=liquid, find_time=True)
    """
    asked = dict(
        viscosity=viscosity, diffusion=diffusion, schmidt=schmidt,
        pressure=pressure, compressibility=compressibility,
    )  # fmt: skip
    asked = _asked(asked)
    if units is not None and not isinstance(units, Units):
        raise TypeError(f"units is {units!r}; give dpd.water_units(...) or dpd.Units(...)")
    wanted = _wanted(asked, units, find_time)
    kT, mass = _exact(kT, "kT", positive), _exact(mass, "mass", positive)
    r_c = _exact(r_c, "r_c", positive)
    thermal = Units(r_c, mass, r_c * math.sqrt(mass / kT))
    given = _given(dict(gamma=gamma, exponent=exponent, repulsion=repulsion), thermal)
    state = np.array(
        [_exact(density, "density", positive) * r_c**3, REPULSION, FRICTION, QUADRATIC]
    )
    for name, value in given.items():
        state[PLACES[name]] = value
    goals = {name: value / _scale(name, thermal) for name, value in wanted.items()}
    search = Search(state, knobs_for(wanted, given), goals)
    refuse_outside(Reduced(*state), search.besides)
    roots = search.roots()
    if not roots:
        raise TargetError(_unreached(search, thermal, units, find_time), ())
    found = [_branch(root, search, thermal) for root in roots]
    if units is not None:
        found = [_in_si(branch, asked, units, find_time) for branch in found]
    return Design(asked, tuple(sorted(found, key=lambda branch: -branch.gamma.value)))


def _exact(value, name: str, check) -> float:
    """A number of Python in its own precision."""
    plain(value, name, check)
    return float(value)


def _asked(asked: dict) -> dict[str, float]:
    """What is wanted at all."""
    found = {n: _exact(v, n, positive) for n, v in asked.items() if v is not None}
    if not found:
        raise ValueError(f"nothing is wanted; give {', '.join(asked)}, one or more")
    return found


def _wanted(asked: dict, units: Units | None, find_time: bool) -> dict[str, float]:
    """What is wanted, in units of the fluid."""
    if find_time:
        asked = _without_time(asked, units)
    return {n: v / (1.0 if units is None else _scale(n, units)) for n, v in asked.items()}


def _without_time(asked: dict, units: Units | None) -> dict[str, float]:
    """What is wanted, with the product of viscosity and diffusion in place of both."""
    if units is None:
        raise ValueError("find_time finds a unit of time in seconds; give units too")
    if units.note == NOTES["viscosity_mass"]:
        raise ValueError("find_time takes the energy of units for that of heat, and theirs is not")
    if not {"viscosity", "diffusion"} <= set(asked) or "schmidt" in asked:
        raise ValueError(
            "a unit of time is found for a viscosity and a diffusion together, and no Schmidt "
            f"number, whose mass is real; wanted are {', '.join(asked)}"
        )
    rest = {n: v for n, v in asked.items() if n not in ("viscosity", "diffusion")}
    return {PRODUCT: asked["viscosity"] * asked["diffusion"]} | rest


def _scale(name: str, units: Units) -> float:
    """One thermal unit of what is wanted in those of a fluid, or of what units are."""
    return units.scale("force") if name == PRODUCT else scale_of(name, units)


def _in_si(branch: "Branch", asked: dict, units: Units, find_time: bool) -> "Branch":
    """The branch with its units in SI, the time among them where it is to be found."""
    if find_time:
        here = branch.properties.viscosity.value * units.energy / units.length**3
        time = asked["viscosity"] / here
        units = Units(units.length, units.energy * (time / units.length) ** 2, time, FORMAL)
    return dataclasses.replace(branch, units=units)


def _unreached(search: Search, thermal: Units, units: Units | None, find_time: bool) -> str:
    """What can be reached instead, in words and in the units in which it was asked."""
    scale = lambda n: _scale(n, thermal) * (1.0 if units is None else _scale(n, units))
    told = []
    for name, (low, high, with_others) in search.reach().items():
        low, high = low * scale(name), high * scale(name)
        near, far = f"is near {math.sqrt(low * high):.3g}", f"goes from {low:.4g} to {high:.4g}"
        # Of a grid of cells, so that a wanted number may lie between the ends and not be there.
        where = " about where the rest is as wanted" if with_others else ""
        told.append(f"{name} {near if high < 1.05 * low else far}{where}")
    others = [name for name in KNOBS if name not in search.knobs]
    if units is not None and not find_time and {"viscosity", "diffusion"} <= set(search.goals):
        others.append("find_time=True, which leaves the unit of time open,")
    wanted = ", ".join(f"{n} {v * scale(n):.4g}" for n, v in search.goals.items())
    return (
        f"no fluid of the atlas has {wanted} by {' and '.join(search.knobs)}: {'; '.join(told)}; "
        f"give another {', '.join(others)} or density"
    )


def _given(knobs: dict, thermal: Units) -> dict[str, float]:
    """Numbers that are given, in thermal units."""
    kinds = {"gamma": positive, "exponent": positive, "repulsion": not_negative}
    scales = {"gamma": thermal.scale("friction"), "repulsion": thermal.scale("force")}
    return {
        name: _exact(value, name, kinds[name]) / scales.get(name, 1.0)
        for name, value in knobs.items()
        if value is not None
    }


def _branch(x, search: Search, thermal: Units) -> Branch:
    """The fluid of a root."""
    state = Reduced(*search.numbers(x)[0], units=thermal)
    own = {"gamma": state.gamma, "exponent": state.exponent, "repulsion": state.a}
    # Errors are of logarithms; that of a repulsion is of the logarithm with SOFT added.
    shares = own | {"repulsion": state.a + SOFT * thermal.scale("force")}
    errors = dict(zip(search.knobs, search.errors(x)))
    told = {n: Estimate(float(own[n]), float(shares[n] * errors.get(n, 0.0))) for n in KNOBS}
    density = float(state.density) / thermal.length**3
    how, dt = suited(state.fluid, density)
    return Branch(
        **told,
        density=density,
        fluid=state.fluid,
        integrator=how,
        dt=dt,
        properties=properties(state),
    )


def _written(value: Estimate) -> str:
    return str(value) if value.error > 0 else f"{value.value:.6g}"
