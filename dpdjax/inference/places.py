"""Where a model is run next."""

import dataclasses

import numpy as np
from scipy.stats import qmc

from dpdjax.inference.data import OF_MODELS
from dpdjax.inference.sampling import Question
from dpdjax.inference.surrogates import Free, Surrogate
from dpdjax.surrogate.process import Process, Rows

CANDIDATES = 300
"""Draws of the posterior among which places are chosen."""


def first(question: Question, count: int, seed: int) -> np.ndarray:
    """Places all over the priors (count, d), spread more evenly than at random; controls are those
    of the data."""
    names = question.names
    cube = qmc.Halton(len(names) + 1, seed=np.random.default_rng(seed)).random(count)
    low, high = np.array([(p.low, p.high) for p in question.priors.values()]).T
    z = low + cube[:, :-1] * (high - low)
    data = question.data
    which = np.minimum((cube[:, -1] * len(data)).astype(int), len(data) - 1)
    return question.places(z, data.control[which])


def doubt(question: Question, surrogate: Surrogate, z) -> np.ndarray:
    """Error of the surrogate over that of each datum, at draws (n, names): (n, data)."""
    data = question.data
    return question.foretold(surrogate, z)[1] * data.value / data.error


def following(question: Question, surrogate: Surrogate, z, count: int, noise: dict) -> np.ndarray:
    """Places (count, d) at which runs tell most of what matters: the next one where the error of
    the surrogate is largest, over that of the data, once those before are run.

    Args:
        z: draws of the posterior (n, names).
        noise: relative errors that runs have, by quantity.
    """
    z = z[:: max(1, len(z) // CANDIDATES)]
    data = question.data
    at = question.places_of_all(z, np.unique(data.control))
    if not isinstance(surrogate, Free):
        return at[np.linspace(0, len(at) - 1, count).astype(int)]
    weights = _weights(question)
    processes, chosen = dict(surrogate.processes), []
    for _ in range(count):
        doubts = [weights[name] * processes[name].at(at)[1] for name in question.quantities]
        place = at[int(np.argmax(np.max(doubts, axis=0)))]
        chosen.append(place)
        processes = {name: _believed(p, place, noise[name]) for name, p in processes.items()}
    return np.array(chosen)


def _weights(question: Question) -> dict[str, float]:
    """Of each quantity of the model the inverse of the smallest relative error it is measured
    with."""
    relative, found = question.data.error / question.data.value, {}
    for name, error in zip(question.data.names, relative):
        own = OF_MODELS.get(name, name)
        found[own] = max(found.get(own, 0.0), 1.0 / error)
    return found


def _believed(process: Process, place, noise: float) -> Process:
    """The process, had a run at a place told what it expects: its errors do not depend on what."""
    x = place[None]
    return process.with_more(Rows.of(x), process.mean(x), np.array([noise]))


@dataclasses.dataclass(frozen=True)
class AtPlaces:
    """An experiment for scans: a model at places by their number.

    Attributes:
        model: an experiment.
        points: what it is given at each.
    """

    model: object
    points: tuple[dict, ...]

    def __call__(self, key, place: int):
        """Ask for the runs at a place."""
        return self.model(key, **self.points[place])
