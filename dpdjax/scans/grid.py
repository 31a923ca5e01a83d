"""The points of a scan and the keys of their replicas, which depend on nothing but themselves."""

import dataclasses
import hashlib
import itertools
import json
import numbers
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from dpdjax.checks import prng_key

REPLICA, ERROR, EACH = "replica", "_error", "_each"
TAKEN = (REPLICA, "status", "reason", "note", "particle_steps", "seconds")
ENDINGS = (ERROR, EACH)
"""Names, and ends of names, of the columns of a table."""
Unit = tuple[tuple[int, ...], int]
"""A replica of a point: the place of the point along each axis, and its number."""


@dataclasses.dataclass(frozen=True)
class Grid:
    """Named axes, every combination of whose values is a point, and replicas of each.

    Attributes:
        axes: values by name, numbers or words.
        replicas: of each point.
    """

    axes: dict[str, tuple]
    replicas: int = 1

    @classmethod
    def of(cls, grid: Mapping[str, Sequence], replicas: int) -> "Grid":
        """Raise TypeError or ValueError, naming the axis, for what is no grid."""
        if not isinstance(grid, Mapping) or not all(isinstance(name, str) for name in grid):
            raise TypeError(f"grid is {grid!r}; give values by name, such as {{'gamma': [4.5, 9]}}")
        if isinstance(replicas, bool) or not isinstance(replicas, int) or replicas < 1:
            raise ValueError(f"replicas is {replicas!r}; it must be a whole number of at least 1")
        for name in grid:
            if name in TAKEN or name.endswith(ENDINGS):
                raise ValueError(
                    f"an axis of the grid is called {name!r}, a name of the table: give another"
                )
        return cls({name: _values(name, values) for name, values in grid.items()}, replicas)

    @property
    def shape(self) -> tuple[int, ...]:
        """Values along each axis, and replicas."""
        return (*map(len, self.axes.values()), self.replicas)

    def units(self) -> list[Unit]:
        """All replicas of all points, in turn."""
        places = itertools.product(*map(range, self.shape[:-1]))
        return [(place, replica) for place in places for replica in range(self.replicas)]

    def point(self, place: tuple[int, ...]) -> dict[str, Any]:
        """The values at a place, by name."""
        return {name: values[k] for (name, values), k in zip(self.axes.items(), place)}

    def key_of(self, key: jax.Array, unit: Unit) -> jax.Array:
        """The key of a replica, by the values of its point: it stays what it is when the grid
        grows, or its axes are given in another order."""
        place, replica = unit
        # A whole number is what it is as a real one.
        values = {k: x if isinstance(x, str) else float(x) for k, x in self.point(place).items()}
        digest = hashlib.sha256(json.dumps(values, sort_keys=True).encode()).digest()
        key = prng_key(key)
        for word in np.frombuffer(digest[:16], np.uint32):
            key = jax.random.fold_in(key, word)
        return jax.random.fold_in(key, replica)

    def named(self, unit: Unit) -> str:
        """A replica in words."""
        place, replica = unit
        shown = lambda x: f"{x:g}" if isinstance(x, float) else str(x)
        values = [f"{name} = {shown(value)}" for name, value in self.point(place).items()]
        return ", ".join(values + ([f"replica {replica}"] if self.replicas > 1 else []))


def _values(name: str, values) -> tuple:
    if isinstance(values, str | numbers.Number):
        raise TypeError(f"the axis {name} of the grid is {values!r}; give a list of values")
    plain = [
        x.item() if isinstance(x, np.generic | np.ndarray | jax.Array) and np.ndim(x) == 0 else x
        for x in values
    ]
    if not plain:
        raise ValueError(f"the axis {name} of the grid has no values")
    for value in plain:
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise TypeError(f"the axis {name} of the grid has {value!r}; give numbers or words")
        if isinstance(value, str) and "\0" in value:
            raise ValueError(f"the axis {name} of the grid has {value!r}; give words without NUL")
    if any(isinstance(value, float) for value in plain):
        plain = [float(value) for value in plain]
        if not np.all(np.isfinite(plain)):
            raise ValueError(f"the axis {name} of the grid is {plain}; give finite numbers")
    if len({type(value) for value in plain}) > 1 or len(set(plain)) < len(plain):
        raise ValueError(
            f"the axis {name} of the grid is {plain}; give each value once, of one kind"
        )
    return tuple(plain)
