"""The answer of a fit: draws of parameters, what they foretell, and what fresh runs say of it."""

import dataclasses
import functools
import math
import warnings
from typing import Any

import numpy as np

from dpdjax import drawing
from dpdjax.checks import plain, positive
from dpdjax.errors import warn
from dpdjax.inference.data import OF_MODELS
from dpdjax.inference.priors import UNITS
from dpdjax.inference.sampling import NEEDS, Question
from dpdjax.inference.surrogates import Surrogate, Told
from dpdjax.measure.statistics import Estimate
from dpdjax.model.summary import as_table

OPEN = 0.5
"""Width of a posterior over that of the prior, as standard deviations, from which on the data say
next to nothing."""
SHOWN = 0.15
"""Least power of a parameter in a combination that is named."""
CONTRADICTS = 2.0
"""Root mean square of standard errors by which fresh runs differ from what was expected of them, at
which they contradict it."""


@dataclasses.dataclass(frozen=True, repr=False)
class Fit:
    """A posterior.

    Attributes:
        question: priors and data.
        surrogate: what the model is expected to tell.
        draws: logarithms of the parameters by name, (chains, draws).
        told: what the model told, and where.
        fresh: what fresh runs at draws told.
        doubt: error of the surrogate over that of the data, root mean square.
        particle_steps, seconds: what the runs took.
    """

    question: Question
    surrogate: Surrogate
    draws: dict[str, np.ndarray]
    told: tuple[Told, ...]
    fresh: tuple[Told, ...]
    doubt: float
    particle_steps: float
    seconds: float

    @functools.cached_property
    def estimates(self) -> dict[str, Estimate]:
        """Mean and standard deviation of each parameter."""
        own = {name: np.exp(z) for name, z in self.draws.items()}
        return {name: Estimate(float(x.mean()), float(x.std()), x.size) for name, x in own.items()}

    def interval(self, name: str, share: float = 0.68) -> tuple[float, float]:
        """The middle of the posterior that holds a share of it."""
        share = plain(share, "share", positive)
        ends = [0.5 * (1 - share), 0.5 * (1 + share)]
        return tuple(float(x) for x in np.exp(np.quantile(self.draws[name], ends)))

    @functools.cached_property
    def _z(self) -> np.ndarray:
        """Draws (n, names)."""
        return np.stack([self.draws[name].ravel() for name in self.question.names], axis=1)

    @functools.cached_property
    def undetermined(self) -> tuple[str, ...]:
        """Combinations of parameters that the data say next to nothing about, so that the posterior
        is at least half as wide as the prior."""
        open_to = [k for k, p in enumerate(self.question.priors.values()) if p.is_even]
        names = [self.question.names[k] for k in open_to]
        priors = list(self.question.priors.values())
        wide = np.array([priors[k].deviation for k in open_to])
        scaled = np.atleast_2d(np.cov((self._z[:, open_to] / wide).T))
        sizes, directions = np.linalg.eigh(scaled)
        left = directions[:, np.sqrt(np.maximum(sizes, 0.0)) > OPEN] * wide[:, None]
        return tuple(_named(names, powers) for powers in _reduced(left.T))

    @functools.cached_property
    def contradiction(self) -> float:
        """Root mean square of the standard errors by which fresh runs differ from what was
        expected of them; NaN without any."""
        off = []
        for one in self.fresh:
            for name, found in one.found.items():
                value, error = (
                    float(np.asarray(x)[0]) for x in self.surrogate.at(name, one.x[None])
                )
                both = math.hypot(error, found.error / found.value)
                off.append((math.log(found.value) - value) / both)
        return float(np.sqrt(np.mean(np.square(off)))) if off else math.nan

    def tell(self):
        """Warn of what the data leave open, and of fresh runs that contradict."""
        if self.undetermined:
            warn(
                f"the data leave open {' and '.join(self.undetermined)}: what is told of it is the "
                "prior; give other data, or what is known of it as a prior",
            )
        if self.contradiction > CONTRADICTS:
            warn(
                f"fresh runs differ from what was expected of them by {self.contradiction:.1f} "
                "standard errors: give more batches, or narrower priors",
            )

    def foretold(self) -> np.ndarray:
        """What the draws foretell of each datum (n, data), without its error."""
        return np.exp(self.question.foretold(self.surrogate, self._z)[0])

    def fresh_of(self, name: str) -> list[tuple[float, float, float]]:
        """Of fresh runs control, value and error in units of the data, at the mean of the
        posterior's units."""
        own, data = OF_MODELS.get(name, name), self.question.data
        z = self._z.mean(axis=0)[None]
        unit = math.exp(float(self.question.scale(name, z)[0]))
        scale = math.exp(float(self.question.scale(data.controlled, z)[0]))
        found = []
        for one in (one for one in self.fresh if own in one.found):
            control = math.exp(one.x[-1])
            factor = unit * (control if name in OF_MODELS else 1.0)
            told = one.found[own].scaled(factor)
            found.append((control * scale, told.value, told.error))
        return found

    @functools.cached_property
    def idata(self) -> Any:
        """As an ``InferenceData`` of ArviZ: posterior with units, what it foretells, the data."""
        try:
            import arviz
        except ImportError as error:
            raise ImportError(NEEDS) from error
        shape = next(iter(self.draws.values())).shape
        data = self.question.data
        groups = {
            "posterior": {name: np.exp(z) for name, z in self.draws.items()},
            "posterior_predictive": {"y": self.foretold().reshape(*shape, len(data))},
            "observed_data": {"y": data.value},
            "constant_data": {"error": data.error, "control": data.control},
        }
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            # One dictionary of groups since version 1, groups by name before.
            is_old = int(arviz.__version__.split(".")[0]) < 1
            found = arviz.from_dict(**groups) if is_old else arviz.from_dict(groups)
        for name in self.question.names:
            found["posterior"][name].attrs["units"] = _unit(name)
        return found

    def plot(self, axes: Any = None) -> Any:
        """Draw the data, the posterior of them, and fresh runs: curves in two panels, the lower one
        over the middle of the posterior; numbers in one.

        Args:
            axes: matplotlib axes, one for each panel, or None for new ones.

        Returns the axes.
        """
        from dpdjax.inference.picture import draw_fit

        return draw_fit(self, axes)

    def plot_corner(self) -> Any:
        """Draw the posterior of each parameter and of each two; returns the axes (names, names)."""
        from dpdjax.inference.picture import draw_corner

        return draw_corner(self)

    @property
    def _rows(self) -> list[tuple[str, str]]:
        rows = []
        for name, found in self.estimates.items():
            low, high = self.interval(name)
            rows.append((name, f"{found}, 68 % between {low:.4g} and {high:.4g}"))
        rows += [("left open", text) for text in self.undetermined]
        if self.fresh:
            rows.append(("fresh runs", f"off by {self.contradiction:.1f} standard errors"))
        cost = f"{self.particle_steps:.2g} particle-steps, {len(self.told) + len(self.fresh)} runs"
        return [*rows, ("cost", cost)]

    def __str__(self):
        return "\n".join(f"{name:12s} {text}" for name, text in self._rows)

    __repr__ = __str__

    def _repr_html_(self):
        return as_table("Fit", self._rows)


def _reduced(rows) -> np.ndarray:
    """Rows that span the same, each with a parameter of its own to the power of 1."""
    rows, taken = np.array(rows, float), []
    for k in range(len(rows)):
        free = np.where(np.isin(np.arange(rows.shape[1]), taken), 0.0, np.abs(rows[k]))
        taken.append(int(np.argmax(free)))
        rows[k] /= rows[k, taken[-1]]
        for other in range(len(rows)):
            if other != k:
                rows[other] -= rows[other, taken[-1]] * rows[k]
    return rows


def _named(names, powers) -> str:
    """A combination of parameters as a product of powers."""
    parts = [(n, p) for n, p in zip(names, powers) if abs(p) > SHOWN]
    return " ".join(n if abs(p - 1) < 0.005 else f"{n}^{p:.2g}" for n, p in parts)


def _unit(name: str) -> str:
    return "of the data" if name in UNITS else drawing.UNITS.get(name, "")
