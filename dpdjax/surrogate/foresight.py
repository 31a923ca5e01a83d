"""What the atlas says of a fluid along one of its parameters, before anything is run."""

import dataclasses
import math

import numpy as np

from dpdjax.measure.statistics import Estimate
from dpdjax.model.fluid import Fluid
from dpdjax.model.units import Units
from dpdjax.surrogate.atlas import Table, features, outside
from dpdjax.surrogate.process import namespace
from dpdjax.surrogate.reduced import Reduced, scale_of

STEP = 1e-3
"""Of a parameter, relative, over which slopes are taken."""
SLOPE = 0.02
"""Share of the value by which a slope may be off besides its error: runs are made at rates above
zero."""
ROUNDS, CLOSE = 40, 1e-6
"""Steps of Newton's method at most, and how near it is to come, in logarithms."""
STARTS, TRIES = 0.8, 20
"""Spread of the places it begins at besides the present one, in logarithms, and their number."""
ALONG = ("gamma", "a", "s", "kT", "density")
"""Parameters that change the numbers of a state."""
FAR, POINTS = 1e4, 241
"""Factor around the present value within which a parameter is looked for, and at how many
places."""


def foretold(fluid: Fluid, density: float, quantity: str) -> Estimate | None:
    """A number of :class:`dpdjax.surrogate.atlas.Properties`; None of what the atlas does not
    cover."""
    state = _covered(fluid, density)
    if state is None:
        return None
    value, error = Table.shipped().at(state.numbers[None])[quantity]
    return Estimate(float(value[0]), float(value[0] * error[0])).scaled(
        scale_of(quantity, state.units)
    )


def _covered(fluid: Fluid, density: float) -> Reduced | None:
    state = reduced_of(fluid, density)
    return None if state is None or outside(state) else state


def is_of_atlas(fluid: Fluid, density: float) -> bool:
    """Whether a fluid is of the kind that the atlas is of, covered or not."""
    return reduced_of(fluid, density) is not None


def reduced_of(fluid: Fluid, density: float) -> Reduced | None:
    """A fluid in thermal units; None of a kind that the atlas is not of."""
    try:
        return Reduced.of(fluid, density)
    except (ValueError, TypeError):
        return None


@dataclasses.dataclass(frozen=True)
class Foresight:
    """A quantity along a parameter.

    Attributes:
        fluid: with any value of the parameter.
        density: beads per volume.
        parameter, quantity: their names.
    """

    fluid: Fluid
    density: float
    parameter: str
    quantity: str

    def state(self, value: float) -> Reduced | None:
        """The state at a value of the parameter; None where the atlas does not cover it."""
        fluid = self.fluid.set(energies="keep", **{self.parameter: value})
        return _covered(fluid, self.density)

    def slope(self, value: float) -> Estimate | None:
        """``d quantity / d ln parameter``; None where the atlas does not cover it."""
        ends = [self.state(value * math.exp(step)) for step in (-STEP, STEP)]
        if None in ends:
            return None
        numbers = np.array([state.numbers for state in ends])
        values = Table.shipped().values(numbers)[self.quantity]
        low, high = (v * scale_of(self.quantity, s.units) for v, s in zip(values, ends))
        along = np.diff(features(numbers), axis=0)[0] / (2 * STEP)
        mean = 0.5 * float(low + high)
        error = math.hypot(SLOPE, self._error(numbers[:1], along))
        return Estimate(float(high - low) / (2 * STEP), abs(mean) * error)

    def _error(self, numbers, along) -> float:
        """Of a slope along a direction of the features, relative to the value."""
        table, x = Table.shipped(), features(numbers)
        parts = {"schmidt": ("viscosity", "diffusion")}.get(self.quantity, (self.quantity,))
        processes = [
            table.pressure if name not in PROCESSES else getattr(table, name) for name in parts
        ]
        of = lambda process, k: along[k] * process.at(x[:, : process.axes], k)[1][0]
        axes = [range(process.axes) for process in processes]
        return math.hypot(*(of(p, k) for p, own in zip(processes, axes) for k in own))

    def root(self, target: float, sign: int) -> float | None:
        """The value of the parameter nearest to the present one at which the quantity is as wanted,
        rising with it or falling by ``sign``; None where there is none."""
        present = float(np.asarray(self.fluid.value(self.parameter)).reshape(())) or 1.0
        x = math.log(present) + np.linspace(-math.log(FAR), math.log(FAR), POINTS)
        states = [(k, self.state(math.exp(each))) for k, each in enumerate(x)]
        states = [(k, state) for k, state in states if state is not None]
        if len(states) < 2:
            return None
        values = Table.shipped().values(np.array([s.numbers for _, s in states]))[self.quantity]
        scales = np.array([scale_of(self.quantity, s.units) for _, s in states])
        off, x = np.log(values * scales / target), x[[k for k, _ in states]]
        crossed = np.flatnonzero(np.sign(off[1:]) - np.sign(off[:-1]) == 2 * sign)
        roots = [x[k] - off[k] * (x[k + 1] - x[k]) / (off[k + 1] - off[k]) for k in crossed]
        return math.exp(min(roots, key=lambda r: abs(r - math.log(present)))) if roots else None


PROCESSES = ("viscosity", "diffusion")
"""Quantities with a process of their own; the others follow from them and the pressure."""


@dataclasses.dataclass(frozen=True)
class Foresights:
    """Quantities along several parameters.

    Attributes:
        fluid: with any values of the parameters.
        density: beads per volume.
        parameters, quantities: their names.
    """

    fluid: Fluid
    density: float
    parameters: tuple[str, ...]
    quantities: tuple[str, ...]

    def root(self, targets: dict[str, float], bounds) -> np.ndarray | None:
        """Logarithms of the parameters, within ``bounds.low`` and ``bounds.high``, at which all
        quantities are as wanted, nearest to the present ones; None where the atlas has no such
        state."""
        if not (is_of_atlas(self.fluid, self.density) and set(self.parameters) <= set(ALONG)):
            return None
        along = Along(Reduced.of(self.fluid, self.density), self.parameters)
        present = [float(self.fluid.value(name)) for name in self.parameters]
        present = np.log([value or 1.0 for value in present])
        wanted = np.log([targets[name] for name in self.quantities])
        starts = present + STARTS * np.random.default_rng(0).standard_normal((TRIES, len(present)))
        found = [self._solved(along, wanted, start, bounds) for start in (present, *starts)]
        found = [x for x in found if x is not None]
        return min(found, key=lambda x: float(np.sum((x - present) ** 2)), default=None)

    def _logarithms(self, along: "Along", x) -> np.ndarray | None:
        """Of the quantities at places (n, parameters); None where one is outside."""
        numbers = along.numbers(x)
        if any(outside(Reduced(*each)) for each in numbers):
            return None
        values = Table.shipped().values(numbers)
        return np.stack([np.log(values[n]) + along.scale(n, x) for n in self.quantities], axis=1)

    def _solved(self, along, wanted, x, bounds) -> np.ndarray | None:
        """The root that Newton's method leads to; None where it leads out of the atlas."""
        for _ in range(ROUNDS):
            steps = np.concatenate([np.zeros((1, len(x))), STEP * np.eye(len(x))])
            found = self._logarithms(along, x + steps)
            if found is None:
                return None
            residual = found[0] - wanted
            if np.max(np.abs(residual)) < CLOSE:
                return x
            jacobian = (found[1:] - found[0]).T / STEP
            step = np.linalg.lstsq(jacobian, -residual, rcond=None)[0]
            x = np.clip(x + np.clip(step, -0.7, 0.7), bounds.low, bounds.high)
        return None


@dataclasses.dataclass(frozen=True)
class Along:
    """States of the atlas along several parameters of a fluid; traced by JAX, or in numpy.

    Attributes:
        base: the fluid with any values of them.
        names: of ``gamma``, ``a``, ``s``, ``kT``, ``density``; others change nothing.
    """

    base: Reduced
    names: tuple[str, ...]

    def _own(self, x) -> dict:
        """Numbers of the fluid in its own units, of logarithms of the parameters (n, names)."""
        units, one = self.base.units, 0.0 * x[:, 0] + 1.0
        own = {
            "gamma": self.base.gamma,
            "a": self.base.a,
            "s": self.base.exponent,
            "kT": units.energy,
            "density": self.base.density / units.length**3,
        }
        xp = namespace(x)
        given = {name: xp.exp(x[:, k]) for k, name in enumerate(self.names) if name in own}
        return {name: given.get(name, value * one) for name, value in own.items()}

    def numbers(self, x):
        """States (n, 4) at logarithms of the parameters (n, names)."""
        own, units, xp = self._own(x), self.base.units, namespace(x)
        return xp.stack(
            [
                own["density"] * units.length**3,
                own["a"] * units.length / own["kT"],
                own["gamma"] * units.length / xp.sqrt(units.mass * own["kT"]),
                own["s"],
            ],
            axis=1,
        )

    def scale(self, quantity: str, x):
        """Logarithm of a thermal unit of a quantity in those of the fluid (n,)."""
        units = self.base.units
        unit = lambda kT: scale_of(quantity, _thermal(units, kT))
        # All units are powers of kT.
        power = math.log(unit(4.0 * units.energy) / unit(units.energy)) / math.log(4.0)
        kT = self._own(x)["kT"]
        return math.log(unit(units.energy)) + power * namespace(x).log(kT / units.energy)


def _thermal(units: Units, kT: float) -> Units:
    """Thermal units of the same mass and reach at another kT."""
    return Units(units.length, units.mass, units.length * math.sqrt(units.mass / kT))
