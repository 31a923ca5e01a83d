"""Fluids of wanted properties: the atlas read backwards."""

import dataclasses
import functools
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
from dpdjax.model.units import FORMAL, Units
from dpdjax.surrogate.atlas import (
    NAMES,
    QUANTITIES,
    SOFT,
    Properties,
    Table,
    properties,
    refuse_outside,
)
from dpdjax.surrogate.reduced import QUADRATIC, Reduced, scale_of, strength

KNOBS = ("gamma", "exponent", "repulsion")
"""What may be found, in the order in which it is."""
PLACES = {"repulsion": 1, "gamma": 2, "exponent": 3}
"""Of them among the numbers of a state."""
PRODUCT = "viscosity times diffusion"
"""What is wanted of both where the unit of time is to be found: there is none in it."""
WANTS = {
    "viscosity": ("gamma", "exponent", "repulsion"),
    "diffusion": ("gamma", "exponent", "repulsion"),
    "schmidt": ("gamma", "exponent", "repulsion"),
    PRODUCT: ("repulsion", "gamma", "exponent"),
    "pressure": ("repulsion",),
    "compressibility": ("repulsion",),
}
"""What may be wanted, and which knobs it turns."""
SI = {
    "viscosity": "Pa s",
    "diffusion": "m^2/s",
    "schmidt": "",
    "pressure": "Pa",
    "compressibility": "1/Pa",
}
REPULSION, FRICTION = 25.0, 4.5
"""Where they are neither given nor found, in kT over reach, and in thermal units."""
POINTS = {1: 400, 2: 64, 3: 26}
"""Of a grid along each knob, by how many are found."""
ROUNDS, CLOSE, SAME = 30, 1e-9, 1e-3
"""Steps to a root, how near it is a root, and how near each other two are one."""


@dataclasses.dataclass(frozen=True, repr=False)
class Branch:
    """A fluid that has what is wanted.

    Attributes:
        gamma, exponent, repulsion: its numbers, in its units; of those found with the error that
            the atlas leaves them.
        density: beads per volume.
        fluid: it, for :func:`dpdjax.simulate`, :func:`dpdjax.calibrate`, ...
        integrator, dt: that suit it.
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
        each = [("length", "m"), ("mass", "kg"), ("time", "s")]
        return [
            (f"unit of {name}", f"{getattr(self.units, name):.4g} {unit}") for name, unit in each
        ]

    def told(self) -> dict:
        """All numbers, as what JSON holds; those with errors as pairs."""
        pair = lambda value: [value.value, value.error]
        found = {name: pair(getattr(self, name)) for name in KNOBS}
        found |= {name: pair(getattr(self.properties, name)) for name in QUANTITIES}
        more = {"density": self.density, "kT": float(self.fluid.kT), "dt": self.dt}
        more |= {"integrator": type(self.integrator).__name__}
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
        wanted = ", ".join(f"{name} {value:.6g}" for name, value in self.wanted.items())
        count = f"{len(self)} fluid{'s' if len(self) > 1 else ''}"
        return "\n\n".join([f"{count} of {wanted}", *map(str, self.branches)])

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
        units: with them the wanted numbers are in SI, such as :func:`dpdjax.water_units`; what else
            is given stays in units of the fluid.
        find_time: take the length and the energy of ``units`` and find the time, for a viscosity
            and a diffusion together: what the fluid has to have is their product, and a unit of
            time then makes both right. The unit of mass follows, and is formal.

    Returns a :class:`Design` with all branches: of one viscosity there are often two gammas, and
    more where several numbers are found. Raises TargetError where there is none, with what can be
    reached; ValueError for what does not go together.

    Example:
        >>> found = dpd.design(viscosity=1.1, kT=0.1, repulsion=2.5)
        >>> found[0].gamma  # doctest: +SKIP
        >>> fluid, dt = found.fluid, found[0].dt
        >>> liquid = dpd.water_units(molecules=1.0, temperature=298.0)
        >>> in_si = dpd.design(viscosity=0.9e-3, diffusion=2.3e-9, units=liquid, find_time=True)
    """
    asked = dict(
        viscosity=viscosity, diffusion=diffusion, schmidt=schmidt,
        pressure=pressure, compressibility=compressibility,
    )  # fmt: skip
    asked = _asked(asked)
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
    search = _Search(state, _knobs(wanted, given), goals)
    refuse_outside(Reduced(*state), [NAMES[PLACES[knob]] for knob in search.knobs])
    roots = search.roots()
    if not roots:
        raise TargetError(search.unreached(thermal, units), ())
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
    if not {"viscosity", "diffusion"} <= set(asked) or "schmidt" in asked:
        raise ValueError(
            "find_time is for a viscosity and a diffusion, and no Schmidt number, whose mass is "
            f"real; wanted are {', '.join(asked)}"
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


def _given(knobs: dict, thermal: Units) -> dict[str, float]:
    """Numbers that are given, in thermal units."""
    kinds = {"gamma": positive, "exponent": positive, "repulsion": not_negative}
    scales = {"gamma": thermal.scale("friction"), "repulsion": thermal.scale("force")}
    return {
        name: _exact(value, name, kinds[name]) / scales.get(name, 1.0)
        for name, value in knobs.items()
        if value is not None
    }


def _knobs(wanted: dict, given: dict) -> tuple[str, ...]:
    """What is to be found for what is wanted; ValueError where there is nothing left to find."""
    found: list[str] = []
    # Those that turn one knob alone come first.
    for name in sorted(wanted, key=lambda name: len(WANTS[name])):
        left = [knob for knob in WANTS[name] if knob not in given and knob not in found]
        if not left:
            raise ValueError(
                f"nothing is left that {name} could be reached by: it turns "
                f"{', '.join(WANTS[name])}, and given or used already are "
                f"{', '.join([*given, *found])}; leave one out"
            )
        found.append(left[0])
    return tuple(found)


@dataclasses.dataclass
class _Search:
    """A search for states.

    Attributes:
        state: density, repulsion, friction, exponent in thermal units, of what is not found.
        knobs: names of what is found.
        goals: wanted numbers in thermal units.
    """

    state: np.ndarray
    knobs: tuple[str, ...]
    goals: dict[str, float]

    @property
    def bounds(self) -> np.ndarray:
        """Of the coordinates of what is found (2, knobs)."""
        ends = np.array([_coordinate(Table.shipped().bounds[:, PLACES[k]], k) for k in self.knobs])
        return ends.T

    def numbers(self, x) -> np.ndarray:
        """States (n, 4) of coordinates (n, knobs)."""
        x = np.atleast_2d(x)
        states = np.repeat(self.state[None], len(x), axis=0)
        for k, knob in enumerate(self.knobs):
            states[:, PLACES[knob]] = _number(x[:, k], knob)
        if "gamma" in self.knobs:
            # The coordinate is that of a friction that damps as much at exponent 2.
            states[:, 2] *= states[:, 2] / strength(states)
        return states

    def values(self, x) -> dict[str, np.ndarray]:
        """The quantities that are wanted, in thermal units, at coordinates (n, knobs)."""
        found = Table.shipped().values(self.numbers(x))
        found[PRODUCT] = found["viscosity"] * found["diffusion"]
        return {name: found[name] for name in self.goals}

    def residuals(self, x) -> np.ndarray:
        """Logarithms of what is there over what is wanted (n, goals)."""
        values = self.values(x)
        return np.stack([np.log(values[n] / goal) for n, goal in self.goals.items()], axis=1)

    @functools.cached_property
    def grid(self) -> tuple[list[np.ndarray], np.ndarray]:
        """Coordinates along each knob, and residuals at all their products (..., goals)."""
        along = [np.linspace(a, b, POINTS[len(self.knobs)]) for a, b in self.bounds.T]
        places = np.stack(np.meshgrid(*along, indexing="ij"), axis=-1)
        found = self.residuals(places.reshape(-1, len(along)))
        return along, found.reshape(*places.shape[:-1], -1)

    def roots(self) -> list[np.ndarray]:
        """Coordinates at which everything is as wanted."""
        along, residuals = self.grid
        inside = _changes_sign(residuals)
        starts = [[0.5 * (x[k] + x[k + 1]) for x, k in zip(along, c)] for c in np.argwhere(inside)]
        found: list[np.ndarray] = []
        for start in starts:
            root = self._root(np.array(start))
            if root is not None and all(np.max(np.abs(root - r)) > SAME for r in found):
                found.append(root)
        return found

    def jacobian(self, x, step: float = 1e-5) -> np.ndarray:
        """Slopes of the residuals (goals, knobs)."""
        steps = step * np.eye(len(x))
        up, down = self.residuals(x + steps), self.residuals(x - steps)
        return (up - down).T / (2 * step)

    def _root(self, x) -> np.ndarray | None:
        """The root that Newton's method leads to from ``x``; None where it leads out."""
        low, high = self.bounds
        width = (high - low) / POINTS[len(self.knobs)]
        for _ in range(ROUNDS):
            residual = self.residuals(x)[0]
            if np.max(np.abs(residual)) < CLOSE:
                return x
            step = np.linalg.lstsq(self.jacobian(x), -residual, rcond=None)[0]
            x = np.clip(x + np.clip(step, -width, width), low, high)
        return None

    def unreached(self, thermal: Units, units: Units | None) -> str:
        """What can be reached instead, in words and in the units in which it was asked."""
        _, residuals = self.grid
        scale = lambda n: _scale(n, thermal) * (1.0 if units is None else _scale(n, units))
        told = []
        for k, (name, goal) in enumerate(self.goals.items()):
            others = np.delete(residuals, k, axis=-1)
            with_others = _changes_sign(others) if others.shape[-1] else None
            told.append(_reach(name, residuals[..., k], goal * scale(name), with_others))
        wanted = ", ".join(f"{n} {v * scale(n):.4g}" for n, v in self.goals.items())
        return (
            f"no fluid of the atlas has {wanted} by {' and '.join(self.knobs)}: "
            f"{'; '.join(told)}; give another density, kT, exponent or repulsion"
        )


def _reach(name: str, residuals, goal: float, with_others) -> str:
    """What values there are of a number, where the others are as wanted if that can be."""
    if with_others is None or not with_others.any():
        chosen, where = residuals, ""
    else:
        corners = residuals[tuple(slice(0, -1) for _ in range(residuals.ndim))]
        chosen, where = corners[with_others], " where the rest is as wanted"
    low, high = goal * np.exp([chosen.min(), chosen.max()])
    return f"{name} goes from {low:.4g} to {high:.4g}{where}"


def _changes_sign(residuals) -> np.ndarray:
    """Cells of a grid (..., goals) within which every residual is zero somewhere."""
    axes = residuals.ndim - 1
    ends = [
        residuals[tuple(slice(k, -1 if k == 0 else None) for k in corner)]
        for corner in itertools.product((0, 1), repeat=axes)
    ]
    low, high = np.min(ends, axis=0), np.max(ends, axis=0)
    return np.all((low <= 0) & (high >= 0), axis=-1)


def _coordinate(number, knob: str):
    """A knob in coordinates in which grids are even."""
    return np.log1p(number / SOFT) if knob == "repulsion" else np.log(number)


def _number(coordinate, knob: str):
    return SOFT * np.expm1(coordinate) if knob == "repulsion" else np.exp(coordinate)


def _branch(x, search: _Search, thermal: Units) -> Branch:
    """The fluid of a root."""
    numbers = search.numbers(x)
    state = Reduced(*numbers[0], units=thermal)
    found = Table.shipped().at(numbers)
    # Of a product and of a ratio errors are the same.
    relative = np.array([found["schmidt" if n == PRODUCT else n][1][0] for n in search.goals])
    inverse = np.linalg.pinv(search.jacobian(x))
    errors = dict(zip(search.knobs, np.sqrt(inverse**2 @ relative**2)))
    own = {"gamma": state.gamma, "exponent": state.exponent, "repulsion": state.a}
    shares = {"gamma": state.gamma, "exponent": state.exponent}
    shares["repulsion"] = state.a + SOFT * thermal.scale("force")
    told = {
        name: Estimate(float(own[name]), float(shares[name] * errors.get(name, 0.0)))
        for name in KNOBS
    }
    density = state.density / thermal.length**3
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
