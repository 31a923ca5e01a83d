"""What is known of parameters before any data."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from dpdjax.measure.statistics import Estimate

UNITS = ("length", "mass", "time")
"""Parameters that are no numbers of a fluid: one unit of it in those of the data."""
WIDE = 3.0
"""Standard deviations around a known number within which models are run."""


@dataclasses.dataclass(frozen=True)
class Prior:
    """Of the logarithm of one parameter.

    Attributes:
        low, high: even between; or where ``spread`` is given, what models are run within.
        centre, spread: of a normal distribution; NaN for an even one.
    """

    low: float
    high: float
    centre: float = math.nan
    spread: float = math.nan

    @classmethod
    def of(cls, name: str, told: Any) -> "Prior":
        """From two ends, or from an estimate; ValueError for what is neither."""
        if isinstance(told, Prior):
            return told
        if isinstance(told, Estimate):
            return cls._around(name, told)
        ends = np.asarray(told, float)
        if ends.shape != (2,) or not 0 < ends[0] < ends[1] < math.inf:
            raise ValueError(
                f"the prior of {name} is {told!r}; give two ends above zero, (low, high), even in "
                "the logarithm between, or dpd.Estimate(value, error)"
            )
        return cls(*np.log(ends))

    @classmethod
    def _around(cls, name: str, told: Estimate) -> "Prior":
        if not (told.value > 0 and 0 < told.error < math.inf):
            raise ValueError(f"the prior of {name} is {told}; give a value and an error above zero")
        centre, spread = math.log(told.value), told.error / told.value
        return cls(centre - WIDE * spread, centre + WIDE * spread, centre, spread)

    @property
    def is_even(self) -> bool:
        return math.isnan(self.spread)

    @property
    def deviation(self) -> float:
        """Standard deviation."""
        return (self.high - self.low) / math.sqrt(12) if self.is_even else self.spread


def priors_of(told: Mapping[str, Any]) -> dict[str, Prior]:
    """Priors by name; TypeError, ValueError for what is none."""
    if not isinstance(told, Mapping) or not told:
        raise TypeError(f"priors is {told!r}; give ends by name, {{'gamma': (1.0, 100.0)}}")
    return {str(name): Prior.of(str(name), each) for name, each in told.items()}
