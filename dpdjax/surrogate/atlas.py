"""The atlas: viscosity, diffusion and pressure of one-species fluids, at once.

Measured all over a box of densities, repulsions, frictions and exponents; between the states that
were measured a Gaussian process, over what theory without correlations has, tells numbers, slopes
and their errors.
"""

import dataclasses
import functools
import json
import math
from collections.abc import Collection
from importlib import resources

import numpy as np

from dpdjax.checks import plain, positive
from dpdjax.measure.statistics import Estimate
from dpdjax.model.fluid import Fluid
from dpdjax.model.summary import as_table
from dpdjax.surrogate import reduced
from dpdjax.surrogate.process import VALUE, Kernel, Process, Rows, namespace
from dpdjax.surrogate.reduced import Reduced, scale_of

AXES = ("density", "a", "gamma", "s")
"""Numbers of a state, as its slopes are named."""
NAMES = ("density r_c^3", "a r_c/kT", "gamma r_c/sqrt(m kT)", "exponent")
"""They in thermal units."""
QUANTITIES = ("viscosity", "diffusion", "schmidt", "pressure", "compressibility")
"""What is told of a state."""
SOFT = 10.0
"""Repulsion [kT/r_c] from which on the logarithm of it counts."""
STEP = 1e-4
"""Of a logarithm, over which slopes of theory are taken."""
FOURFOLD = 4.0
"""How many times what a shear rate changes is in the viscosity at twice the rate, while that is
little."""


@dataclasses.dataclass(frozen=True, repr=False)
class Properties:
    """What a fluid is like at a density, in its own units.

    Attributes:
        viscosity: at small shear rates [energy time/length^3].
        diffusion: self-diffusion in a large system [length^2/time].
        schmidt: viscosity over mass density and diffusion.
        pressure: [energy/length^3].
        compressibility: ``1/(density dp/d density)``, isothermal [length^3/energy].
        inverse_compressibility: ``(dp/d density)/kT``, 1 of an ideal gas, 16 of water in molecules.
        slopes: of each number of these but the compressibility ``d ln number / d ln parameter``, by
            the name of the number and of the parameter, ``density``, ``a``, ``gamma``, ``s``.
        numbers: density, a, gamma in thermal units, and s.
    """

    viscosity: Estimate
    diffusion: Estimate
    schmidt: Estimate
    pressure: Estimate
    compressibility: Estimate
    inverse_compressibility: Estimate
    slopes: dict[str, dict[str, Estimate]]
    numbers: dict[str, float]

    @property
    def _rows(self) -> list[tuple[str, str]]:
        return [(name, str(getattr(self, name))) for name in QUANTITIES]

    def __str__(self):
        return "\n".join(f"{name:16s} {value}" for name, value in self._rows)

    __repr__ = __str__

    def _repr_html_(self):
        return as_table("Properties", self._rows)


def atlas(fluid: Fluid, density: float) -> Properties:
    """What a fluid of one species is like, at once: viscosity, self-diffusion, Schmidt number,
    pressure, compressibility.

    From a table of measured states, by exact scaling to any kT, mass and reach; its ranges are
    those of :func:`ranges`. Viscosity is that of small rates, diffusion that of a large system.

    Args:
        fluid: beads with ``dpd.soft_repulsion``, or none, and ``dpd.central_drag`` or
            ``dpd.laws.power_drag``, of one reach.
        density: beads per volume [1/length^3].

    Returns :class:`Properties`, each number with its standard error. Raises ValueError for another
    kind of fluid, and for a state outside of the table, naming what is.

    Example:
        >>> known = dpd.atlas(dpd.water(), density=3.0)
        >>> 0.8 < known.viscosity.value < 0.95
        True
        >>> known.slopes["diffusion"]["gamma"].value < 0  # more drag, less diffusion
        True
    """
    state = Reduced.of(fluid, plain(density, "density", positive))
    refuse_outside(state)
    return properties(state)


def properties(state: Reduced) -> Properties:
    """:class:`Properties` of a state inside."""
    table, x = Table.shipped(), state.numbers[None]
    relative = {name: (v[0], e[0]) for name, (v, e) in table.at(x).items()}
    estimates = {
        name: Estimate(float(v), float(v * e)).scaled(scale_of(name, state.units))
        for name, (v, e) in relative.items()
    }
    return Properties(
        **estimates, slopes=table.slopes(x), numbers=dict(zip(NAMES, state.numbers.tolist()))
    )


def ranges(exponent: float = reduced.QUADRATIC) -> dict[str, tuple[float, float]]:
    """What the atlas covers: two ends by the name of each number in thermal units.

    Of frictions at an exponent they are those that damp as strongly as the ones at 2.

    Example:
        >>> from dpdjax.surrogate.atlas import ranges
        >>> ranges()["a r_c/kT"]
        (0.0, 100.0)
    """
    low, high = Table.shipped().bounds
    share = reduced.moment(reduced.QUADRATIC, 3) / reduced.moment(exponent, 3)
    factors = np.array([1.0, 1.0, share, 1.0])
    return dict(zip(NAMES, zip((low * factors).tolist(), (high * factors).tolist())))


def outside(state: Reduced, besides: Collection[str] = ()) -> str:
    """What of a state the atlas does not cover, ``besides`` some of its numbers, in words; nothing
    where it is inside."""
    return ", ".join(
        f"{name} is {value:.4g} and it has {low:g} to {high:g}"
        for value, (name, (low, high)) in zip(state.numbers, ranges(state.exponent).items())
        if name not in besides and not low * (1 - 1e-6) <= value <= high * (1 + 1e-6)
    )


def refuse_outside(state: Reduced, besides: Collection[str] = ()):
    """ValueError for a state that the atlas does not cover, ``besides`` some of its numbers."""
    told = outside(state, besides)
    if told:
        raise ValueError(
            f"outside of the atlas: {told}; measure there, dpd.measure_viscosity(fluid, ...)"
        )


@dataclasses.dataclass(frozen=True)
class Table:
    """Measured states, and the processes through them.

    Attributes:
        states: numbers of the states in thermal units (n, 4).
        viscosity, diffusion, pressure: processes of the logarithms of what was measured over
            theory.
        provenance: what it was measured with.
    """

    states: np.ndarray
    viscosity: Process
    diffusion: Process
    pressure: Process
    provenance: dict

    @classmethod
    @functools.cache
    def shipped(cls) -> "Table":
        """That of the package."""
        folder = resources.files("dpdjax.surrogate")
        with (folder / "atlas.csv").open() as file:
            rows = np.genfromtxt(file, names=True, delimiter=",")
        told = json.loads((folder / "atlas.json").read_text())
        return cls.of(rows, told["processes"], told["provenance"])

    @classmethod
    def of(cls, rows, processes: dict, provenance: dict) -> "Table":
        """From rows of numbers by name, and amplitudes, lengths and nuggets."""
        data = told_by(rows)
        made = {
            name: Process(*data[name], **_kernels(numbers)) for name, numbers in processes.items()
        }
        return cls(states_of(rows), **made, provenance=provenance)

    @functools.cached_property
    def bounds(self) -> np.ndarray:
        """Smallest and largest densities, repulsions, strengths and exponents (2, 4)."""
        states = self.states.copy()
        states[:, 2] = reduced.strength(states)
        return np.array([states.min(axis=0), states.max(axis=0)])

    def at(self, numbers) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Values and relative errors of everything at numbers (n, 4), in thermal units (n,)."""
        xp, x, values = namespace(numbers), features(numbers), self.values(numbers)
        eta, D = self.viscosity.at(x)[1], self.diffusion.at(x)[1]
        # What repulsion adds to the pressure, and how it rises with density, and their errors.
        _, p = self.pressure.at(x[:, :2])
        slope, slope_error = self.pressure.at(x[:, :2], 0)
        share = 1.0 - numbers[:, 0] / values["pressure"]
        stiff = 1.0 - 1.0 / values["inverse_compressibility"]
        stiffness = stiff * xp.hypot(p, slope_error / (2.0 + slope))
        errors = {
            "viscosity": eta,
            "diffusion": D,
            "schmidt": xp.hypot(eta, D),
            "pressure": share * p,
            "compressibility": stiffness,
            "inverse_compressibility": stiffness,
        }
        return {name: (value, errors[name]) for name, value in values.items()}

    def with_more(self, name: str, numbers, value, error) -> "Table":
        """The table that knows more viscosities or diffusions: at numbers (n, 4), values in thermal
        units and their relative errors (n,)."""
        theory = {"viscosity": reduced.viscosity, "diffusion": reduced.diffusion}[name]
        process = getattr(self, name)
        more = process.with_more(Rows.of(features(numbers)), np.log(value / theory(numbers)), error)
        return dataclasses.replace(self, **{name: more})

    def values(self, numbers) -> dict[str, np.ndarray]:
        """As :meth:`at`, without errors."""
        xp, x, density = namespace(numbers), features(numbers), numbers[:, 0]
        eta = reduced.viscosity(numbers) * xp.exp(self.viscosity.mean(x))
        D = reduced.diffusion(numbers) * xp.exp(self.diffusion.mean(x))
        excess = reduced.repulsive_pressure(numbers) * xp.exp(self.pressure.mean(x[:, :2]))
        # ln excess rises with ln density by 2, as theory has it, and the slope of the process.
        stiffness = 1.0 + excess / density * (2.0 + self.pressure.mean(x[:, :2], 0))
        return {
            "viscosity": eta,
            "diffusion": D,
            "schmidt": eta / (density * D),
            "pressure": density + excess,
            "compressibility": 1.0 / (density * stiffness),
            "inverse_compressibility": stiffness,
        }

    def slopes(self, numbers) -> dict[str, dict[str, Estimate]]:
        """``d ln number / d ln parameter`` at one state (1, 4)."""
        of = {
            "viscosity": self._slopes(self.viscosity, reduced.viscosity, numbers),
            "diffusion": self._slopes(self.diffusion, reduced.diffusion, numbers),
        }
        of["schmidt"] = {
            axis: Estimate(
                of["viscosity"][axis].value - of["diffusion"][axis].value - (axis == "density"),
                math.hypot(of["viscosity"][axis].error, of["diffusion"][axis].error),
            )
            for axis in AXES
        }
        # Of the pressure, what motion adds rises with density alone.
        excess = self._slopes(self.pressure, reduced.repulsive_pressure, numbers)
        share = 1.0 - numbers[0, 0] / self.values(numbers)["pressure"][0]
        of["pressure"] = {
            axis: Estimate(
                float((1.0 - share) * (axis == "density") + share * found.value),
                float(share * found.error),
            )
            for axis, found in excess.items()
        }
        return of

    @staticmethod
    def _slopes(process: Process, theory, numbers) -> dict[str, Estimate]:
        """Of one process over a theory."""
        x, found = features(numbers)[:, : process.axes], {}
        told = [process.at(x, k) for k in range(process.axes)]
        value, error = (np.array([one[j][0] for one in told]) for j in (0, 1))
        for axis, step in zip(AXES, STEP * np.eye(4)):
            up, down = numbers * np.exp(step), numbers * np.exp(-step)
            along = (features(up) - features(down))[0, : process.axes] / (2 * STEP)
            # Of no repulsion at all both are zero, and do not change by any factor.
            of_theory = _ratio(theory(up), theory(down)) / (2 * STEP)
            slope, off = of_theory + along @ value, np.linalg.norm(along * error)
            found[axis] = Estimate(float(slope), float(off))
        return found


def _ratio(up, down) -> float:
    """``ln(up/down)`` of one number each (1,); 0 of zeros."""
    return math.log(up[0] / down[0]) if down[0] > 0 else 0.0


def features(numbers) -> np.ndarray:
    """Coordinates in which the processes are smooth, of numbers (n, 4)."""
    xp = namespace(numbers)
    density, repulsion, _, exponent = numbers.T
    soft, drag = xp.log1p(repulsion / SOFT), xp.log(reduced.strength(numbers))
    return xp.stack([xp.log(density), soft, drag, xp.log(exponent)], axis=1)


def states_of(rows) -> np.ndarray:
    """Numbers of the states of a table (n, 4)."""
    return np.stack([rows[name] for name in AXES], axis=1)


def told_by(rows) -> dict[str, tuple[Rows, np.ndarray, np.ndarray]]:
    """What a table says to the process of each quantity: rows, numbers and their errors."""
    states = states_of(rows)
    x = features(states)
    logarithm = lambda name, theory: (
        np.log(rows[name] / theory),
        rows[f"{name}_error"] / rows[name],
    )
    slow = logarithm("viscosity", reduced.viscosity(states))
    fast = logarithm("viscosity_fast", reduced.viscosity(states))
    twice = np.concatenate([x, x])
    bias = np.concatenate([np.ones(len(x)), thinning(rows["viscosity_fast"] / rows["viscosity"])])
    y, noise = (np.concatenate(both) for both in zip(slow, fast))
    repels = states[:, 1] > 0
    pressure = _pressure_told(states[repels], rows[repels])
    return {
        "viscosity": (Rows.of(twice, VALUE, bias), y, noise),
        "diffusion": (Rows.of(x), *logarithm("diffusion", reduced.diffusion(states))),
        "pressure": pressure,
    }


def thinning(ratio) -> np.ndarray:
    """How many times what a shear rate changes of the logarithm of a viscosity is in that at twice
    the rate, of the ratio of the two viscosities (n,).

    Four while it is little; less of a fluid that thins, as ``asinh(x)/x`` with ``x`` proportional
    to the rate (Eyring 1936), which stiff states follow over a factor of four in rate.
    """
    x = np.linspace(1e-3, 4.0, 4000)
    once, twice = np.log(np.arcsinh(x) / x), np.log(np.arcsinh(2 * x) / (2 * x))
    return np.interp(-np.log(ratio), once - twice, twice / once, left=FOURFOLD)


def _pressure_told(states, rows):
    """Of pressures, which depend on density and repulsion alone, a mean over the states that have
    the same; what repulsion adds is that of theory where there is next to none of it."""
    x = features(states)[:, :2]
    excess = rows["pressure"] - states[:, 0]
    y = np.log(excess / reduced.repulsive_pressure(states))
    noise = rows["pressure_error"] / excess
    places, which = np.unique(np.round(x, 9), axis=0, return_inverse=True)
    weight = np.bincount(which, 1 / noise**2)
    mean = np.bincount(which, y / noise**2) / weight
    # Steps in time err alike in states of one friction: a mean is as good as its states agree.
    count = np.bincount(which)
    chance = np.bincount(which, ((y - mean[which]) / noise) ** 2) / np.maximum(count - 1, 1)
    error = weight**-0.5 * np.sqrt(np.maximum(chance, 1.0))
    edge = np.unique(x[:, 0])
    free = np.stack([edge, np.zeros_like(edge)], axis=1)
    return (
        Rows.of(np.concatenate([places, free])),
        np.concatenate([mean, np.zeros(len(free))]),
        np.concatenate([error, np.full(len(free), 1e-4)]),
    )


def _kernels(numbers: dict) -> dict:
    """Of what is told of a process, its kernels and its nugget."""
    kernel = lambda given: Kernel(given["amplitude"], np.array(given["lengths"]))
    bias = numbers.get("bias")
    return {
        "kernel": kernel(numbers),
        "bias": None if bias is None else kernel(bias),
        "nugget": numbers["nugget"],
    }
