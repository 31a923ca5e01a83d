"""What a model would say, without running it: Gaussian processes through what it said elsewhere.

All of logarithms: of parameters, of rates or frequencies, and of what is told. Asked in numpy or
traced by JAX.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from dpdjax.measure.statistics import Estimate
from dpdjax.surrogate.atlas import Table
from dpdjax.surrogate.foresight import PROCESSES, Along
from dpdjax.surrogate.process import Process, Rows, fitted, namespace


@dataclasses.dataclass(frozen=True)
class Told:
    """What a model told at one place.

    Attributes:
        x: logarithms of the parameters, and of the control where there is one (d,).
        found: estimates by name.
    """

    x: np.ndarray
    found: Mapping[str, Estimate]


class Surrogate(Protocol):
    """What a model is expected to tell."""

    def given(self, told: list[Told]) -> "Surrogate":
        """What is expected after more of it is known."""
        ...

    def at(self, name: str, x) -> tuple[Any, Any]:
        """Logarithm of a quantity and its standard error at places (n, d)."""
        ...


@dataclasses.dataclass(frozen=True)
class Free:
    """Of a model of which nothing is known but what it told.

    Attributes:
        told: all it told.
        processes: by name of quantity.
    """

    told: tuple[Told, ...] = ()
    processes: Mapping[str, Process] = dataclasses.field(default_factory=dict)

    def given(self, told: list[Told]) -> "Free":
        told = [*self.told, *told]
        names = dict.fromkeys(name for one in told for name in one.found)
        return Free(tuple(told), {name: _process(name, told) for name in names})

    def at(self, name: str, x):
        return self.processes[name].at(x)


def _process(name: str, told: list[Told]) -> Process:
    """Through what was told of a quantity; its errors are made to cover what each point says of
    the others."""
    points = [(one.x, one.found[name]) for one in told if name in one.found]
    x = np.array([x for x, _ in points])
    y, noise = _logarithms([found for _, found in points])
    process = fitted(Rows.of(x), y, noise)
    off, deviation = process.left_out()
    wide = max(1.0, float(np.sqrt(np.mean((off / deviation) ** 2))))
    return dataclasses.replace(
        process,
        noise=wide * noise,
        nugget=wide * process.nugget,
        kernel=dataclasses.replace(process.kernel, amplitude=wide * process.kernel.amplitude),
    )


def _logarithms(found: list[Estimate]) -> tuple[np.ndarray, np.ndarray]:
    value = np.array([one.value for one in found], float)
    error = np.array([one.error for one in found], float)
    return np.log(value), error / value


@dataclasses.dataclass(frozen=True)
class OfAtlas:
    """Of a fluid that the atlas covers, which its runs add to.

    Attributes:
        along: how parameters become numbers of the atlas, whose control counts for nothing.
        table: the atlas, with what the model told.
    """

    along: Along
    table: Table

    def given(self, told: list[Told]) -> "OfAtlas":
        table = self.table
        for name in PROCESSES:
            some = [one for one in told if name in one.found]
            if some:
                table = table.with_more(name, *self._numbers(name, some))
        return dataclasses.replace(self, table=table)

    def _numbers(self, name: str, told: list[Told]):
        """Numbers of the atlas, values in thermal units and their relative errors."""
        x = np.array([one.x for one in told])
        value, error = _logarithms([one.found[name] for one in told])
        return self.along.numbers(x), np.exp(value - self.along.scale(name, x)), error

    def at(self, name: str, x):
        xp = namespace(x)
        value, error = self.table.at(self.along.numbers(x))[name]
        return xp.log(value) + self.along.scale(name, x), error
