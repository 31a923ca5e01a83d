"""Where the atlas has wanted numbers: all states, along as many parameters as numbers."""

import dataclasses
import functools
import itertools

import numpy as np

from dpdjax.surrogate.atlas import NAMES, SOFT, Table, outside
from dpdjax.surrogate.reduced import Reduced, strength

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
INDEPENDENT = ("viscosity", "diffusion", "pressure", "compressibility")
"""What the atlas tells apart, with errors that are no one another's."""
PARTS = {
    "viscosity": (1, 0, 0, 0),
    "diffusion": (0, 1, 0, 0),
    "schmidt": (1, -1, 0, 0),
    PRODUCT: (1, 1, 0, 0),
    "pressure": (0, 0, 1, 0),
    "compressibility": (0, 0, 0, 1),
}
"""What may be wanted as a product of powers of these."""
POINTS = {1: 400, 2: 64, 3: 26}
"""Of a grid along each knob, by how many are found."""
ROUNDS, CLOSE, SAME = 30, 1e-7, 1e-3
"""Steps to a root, how near it is a root, and how near each other two are one."""


def knobs_for(wanted: dict, given: dict) -> tuple[str, ...]:
    """What is to be found for what is wanted; ValueError where there is nothing left to find."""
    if {"viscosity", "diffusion", "schmidt"} <= set(wanted):
        raise ValueError(
            "viscosity, diffusion and schmidt are wanted, and any two of them make the third; "
            "leave one out"
        )
    found: list[str] = []
    # Those that turn one knob alone come first.
    for name in sorted(wanted, key=lambda name: len(WANTS[name])):
        left = [k for k in WANTS[name] if k not in given and k not in found and _turns(k)]
        if not left:
            raise ValueError(
                f"nothing is left that {name} could be reached by: it turns "
                f"{', '.join(WANTS[name])}, and given or used already are "
                f"{', '.join([*given, *found])}; leave one out"
            )
        found.append(left[0])
    return tuple(found)


def _turns(knob: str) -> bool:
    """Whether the atlas has more than one value of it."""
    low, high = Table.shipped().bounds[:, PLACES[knob]]
    return high > low


@dataclasses.dataclass
class Search:
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

    @property
    def besides(self) -> tuple[str, ...]:
        """What of a state is not known to be inside before the search: what is found; and with the
        exponent gamma, whose ends move with it."""
        moved = ("gamma",) if "exponent" in self.knobs else ()
        return tuple(NAMES[PLACES[knob]] for knob in (*self.knobs, *moved))

    def is_inside(self, x) -> np.ndarray:
        """Whether the atlas covers the states at coordinates (n, knobs)."""
        return np.array([not outside(Reduced(*numbers)) for numbers in self.numbers(x)])

    def residuals(self, x) -> np.ndarray:
        """Logarithms of what is there over what is wanted (n, goals)."""
        values = self.values(x)
        return np.stack([np.log(values[n] / goal) for n, goal in self.goals.items()], axis=1)

    @functools.cached_property
    def grid(self) -> tuple[list[np.ndarray], np.ndarray]:
        """Coordinates along each knob, and residuals at all their products (..., goals): NaN
        outside of the atlas, and ValueError where all are."""
        along = [np.linspace(a, b, POINTS[len(self.knobs)]) for a, b in self.bounds.T]
        places = np.stack(np.meshgrid(*along, indexing="ij"), axis=-1)
        places = places.reshape(-1, len(along))
        found = self.residuals(places)
        if "exponent" in self.knobs and "gamma" not in self.knobs:
            is_inside = self.is_inside(places)
            if not is_inside.any():
                raise ValueError(
                    f"outside of the atlas: {NAMES[2]} is {self.state[2]:.4g}, which it has at no "
                    "exponent"
                )
            found[~is_inside] = np.nan
        return along, found.reshape(*map(len, along), -1)

    def roots(self) -> list[np.ndarray]:
        """Coordinates at which everything is as wanted."""
        along, residuals = self.grid
        inside = _changes_sign(residuals)
        starts = [[0.5 * (x[k] + x[k + 1]) for x, k in zip(along, c)] for c in np.argwhere(inside)]
        found: list[np.ndarray] = []
        for start in starts:
            root = self._root(np.array(start))
            is_new = root is not None and all(np.max(np.abs(root - r)) > SAME for r in found)
            if is_new and self.is_inside(root[None])[0]:
                found.append(root)
        return found

    def jacobian(self, x, step: float = 1e-5) -> np.ndarray:
        """Slopes of the residuals (goals, knobs)."""
        steps = step * np.eye(len(x))
        up, down = self.residuals(x + steps), self.residuals(x - steps)
        return (up - down).T / (2 * step)

    def errors(self, x) -> np.ndarray:
        """Of what is found at a root what the errors of the atlas leave it (knobs,): of the
        logarithms of gamma and exponent, and of that of a repulsion with ``SOFT`` added."""
        numbers = self.numbers(x)
        found = Table.shipped().at(numbers)
        own = np.array([found[name][1][0] for name in INDEPENDENT])
        goals = np.array([PARTS[name] for name in self.goals]) * own
        moved = np.linalg.pinv(self.jacobian(x)) @ goals
        return np.linalg.norm(self._of_knobs(x) @ moved, axis=1)

    def _of_knobs(self, x, step: float = 1e-6) -> np.ndarray:
        """Slopes of what is found in the coordinates (knobs, knobs): gamma follows the exponent
        where its coordinate is that of the damping."""
        places = [PLACES[knob] for knob in self.knobs]
        ends = [self.numbers(x + sign * step * np.eye(len(x)))[:, places] for sign in (1, -1)]
        own = [
            np.stack([_coordinate(values, knob) for values, knob in zip(end.T, self.knobs)])
            for end in ends
        ]
        return (own[0] - own[1]) / (2 * step)

    def _root(self, x) -> np.ndarray | None:
        """The root that Newton's method leads to from ``x``; None where it leads out."""
        low, high = self.bounds
        width = (high - low) / POINTS[len(self.knobs)]
        for _ in range(ROUNDS):
            residual = self.residuals(x)[0]
            step = np.linalg.lstsq(self.jacobian(x), -residual, rcond=None)[0]
            x = np.clip(x + np.clip(step, -width, width), low, high)
            if np.max(np.abs(residual)) < CLOSE:
                return x
        return None

    def reach(self) -> dict[str, tuple[float, float, bool]]:
        """Of each goal its least and largest value in thermal units, and whether they are where the
        others are as wanted, which there may be none."""
        _, residuals = self.grid
        found = {}
        for k, (name, goal) in enumerate(self.goals.items()):
            chosen, others = residuals[..., k], np.delete(residuals, k, axis=-1)
            with_others = _changes_sign(others) if others.shape[-1] else np.array(False)
            if with_others.any():
                chosen = chosen[tuple(slice(0, -1) for _ in range(chosen.ndim))][with_others]
            low, high = goal * np.exp([np.nanmin(chosen), np.nanmax(chosen)])
            found[name] = float(low), float(high), bool(with_others.any())
        return found


def _changes_sign(residuals) -> np.ndarray:
    """Cells of a grid (..., goals) within which every residual is zero somewhere."""
    axes = residuals.ndim - 1
    ends = [
        residuals[tuple(slice(k, -1 if k == 0 else None) for k in corner)]
        for corner in itertools.product((0, 1), repeat=axes)
    ]
    # A cell that is not all inside has NaN, and compares as nothing.
    low, high = np.min(ends, axis=0), np.max(ends, axis=0)
    return np.all((low <= 0) & (high >= 0), axis=-1)


def _coordinate(number, knob: str):
    """A knob in coordinates in which grids are even."""
    return np.log1p(number / SOFT) if knob == "repulsion" else np.log(number)


def _number(coordinate, knob: str):
    return SOFT * np.expm1(coordinate) if knob == "repulsion" else np.exp(coordinate)
