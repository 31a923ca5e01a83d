"""Parameters behind measured numbers: posteriors by runs, a surrogate through them, and NUTS."""

import dataclasses
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dpdjax.checks import prng_key, whole
from dpdjax.errors import RunError
from dpdjax.inference import places
from dpdjax.inference.data import observations
from dpdjax.inference.posterior import Fit
from dpdjax.inference.priors import UNITS, Prior, priors_of
from dpdjax.inference.sampling import Question, drawn
from dpdjax.inference.surrogates import Free, OfAtlas, Surrogate, Told
from dpdjax.measure.statistics import Estimate
from dpdjax.model.units import Units
from dpdjax.pairs.noise import Domain
from dpdjax.scans.scan import scan
from dpdjax.surrogate.atlas import QUANTITIES, Table, outside
from dpdjax.surrogate.foresight import ALONG, Along, reduced_of
from dpdjax.surrogate.reduced import Reduced

FIRST = 6
"""Places of the first batch for each parameter and the control."""
ENOUGH = 0.4
"""Error of the surrogate, over that of the data, at which it does not matter any more: it widens a
posterior by 8 %."""
LEAST = 3
"""Replicas of a scan that may fail, out of all, before a fit gives up: more than one in so many."""
DRAWS = 1000
"""Draws of each of four chains."""


def fit(
    model: Callable,
    data: Any,
    priors: Mapping[str, Any],
    *,
    key: jax.Array,
    error: float | None = None,
    units: Units | None = None,
    batch: int = 8,
    batches: int = 6,
    checks: int = 4,
    store: str | os.PathLike | None = None,
    executor: Any = None,
    hours: float | None = None,
    progress: bool = True,
    report: Callable[[str], None] | None = None,
) -> Fit:
    """The posterior of a model's parameters, given measured numbers with their errors.

    Runs of the model at places all over the priors, then where they matter, feed a surrogate of
    everything it tells; NUTS draws from the posterior that surrogate and data leave, errors of both
    in it. Fresh runs at draws of the posterior check it.

    Of a fluid that the atlas covers (:class:`dpdjax.experiments.Solvent`) the atlas is the
    surrogate to begin with, and the checks are often all that is run.

    Args:
        model: an experiment, such as :class:`dpdjax.experiments.Solvent`,
            :class:`dpdjax.experiments.SuspensionViscosity` or a function of one's own,
            ``model(key, **parameters)``, which is given ``rate`` or ``frequency`` too where the
            data have it, and returns estimates by name.
        data: numbers by name ``{"viscosity": (1.10, 0.01), "diffusion": dpd.Estimate(...)}``; a
            DataFrame or a CSV file with columns such as ``rate``, ``stress`` and ``stress_error``,
            or ``frequency``, ``storage_modulus``, ``loss_modulus``; a dataset with ``x`` and ``y``,
            as RheoJAX has them; or several of these in a list.
        priors: by parameter two ends, even in the logarithm between; or an Estimate.
            ``length``, ``mass`` and ``time`` are one unit of the model in those of the data, where
            they are not known.
        key: a PRNG key.
        error: relative, of data that state none.
        units: in which the data are SI; without, they are in units of the model.
        batch: runs of one batch after the first.
        batches: of runs at most.
        checks: draws of the posterior at which fresh runs are made; 0 for none.
        store: a folder for what is run; the same call goes on with what is there.
        executor, hours, progress: as for :func:`dpdjax.scan`.
        report: ``report(text)`` is told of the progress.

    Returns a ``Fit``: the posterior in ``estimates``, ``interval(name)`` and ``draws``. Raises
    ValueError, TypeError for data, priors and models that do not go together, before anything runs;
    RunError where most runs fail or time is up.

    Example:
        >>> def thickness(key, gamma):
        ...     eta = 0.5 * gamma**0.5
        ...     return {"viscosity": dpd.Estimate(eta, 0.02 * eta)}
        >>> measured, prior = {"viscosity": (1.5, 0.03)}, {"gamma": (1.0, 30.0)}
        >>> found = dpd.fit(thickness, measured, prior, key=key, batches=1, checks=0, **quiet)
        >>> abs(found.estimates["gamma"].value - 9.0) < 1.0
        True
    """
    key = prng_key(key)
    batch, batches = whole(batch, "batch"), whole(batches, "batches")
    checks = whole(checks, "checks", least=0)
    priors, data = priors_of(priors), observations(data, error)
    scales = (1.0, 1.0, 1.0) if units is None else (units.length, units.mass, units.time)
    question = Question(priors, data, scales)
    _refuse_units(priors, units)
    running = _Running(model, question, key, store, executor, hours, progress, report)
    surrogate = _begun(model, question)
    if isinstance(surrogate, Free):
        count = FIRST * (len(question.of_model) + (data.controlled is not None))
        at = places.first(question, max(count, batch), _seed(key))
        surrogate = surrogate.given(running.told(at))
    while True:
        draws = drawn(question, surrogate, running.key_of_draws(), DRAWS)
        z = np.stack([draws[name].ravel() for name in question.names], axis=1)
        doubt = float(np.sqrt(np.mean(places.doubt(question, surrogate, z[::20]) ** 2)))
        running.say(f"the surrogate errs by {doubt:.2f} of the errors of the data")
        if doubt <= ENOUGH or running.count >= batches:
            break
        at = places.following(question, surrogate, z, batch, running.noise())
        surrogate = surrogate.given(running.told(at))
    fresh = running.fresh(z, checks) if checks else []
    found = Fit(
        question, surrogate, draws, tuple(running.done), tuple(fresh), doubt,
        running.particle_steps, running.seconds,
    )  # fmt: skip
    found.tell()
    return found


def _told_by(table) -> list[str]:
    """The quantities of a table."""
    return [str(name) for name in table if f"{name}_each" in table]


def _seed(key) -> int:
    return int(jax.random.randint(jax.random.fold_in(key, Domain.FRESH_RUN), (), 0, 2**31 - 1))


def _refuse_units(priors: dict[str, Prior], units: Units | None):
    free = [name for name in UNITS if name in priors]
    if free and units is not None:
        raise ValueError(
            f"units are given, and {', '.join(free)} has a prior; give one of both: without units= "
            "those that have no prior are one"
        )
    if len(free) == len(priors):
        raise ValueError("only units have priors; give one of a parameter of the model too")


def _begun(model, question: Question) -> Surrogate:
    """The atlas where it covers all that may be, else nothing yet."""
    matter, density = getattr(model, "fluid", None), getattr(model, "density", None)
    is_known = set(question.quantities) <= set(QUANTITIES) and set(question.of_model) <= set(ALONG)
    if matter is None or question.data.controlled is not None or not is_known:
        return Free()
    base = reduced_of(matter, density)
    if base is None:
        return Free()
    along = Along(base, question.of_model)
    ends = [question.priors[name] for name in question.of_model]
    corners = np.array(np.meshgrid(*[(p.low, p.high) for p in ends])).reshape(len(ends), -1).T
    inside = all(not outside(Reduced(*n)) for n in along.numbers(corners))
    return OfAtlas(along, Table.shipped()) if inside else Free()


@dataclasses.dataclass
class _Running:
    """Batches of runs, each a scan with a store of its own.

    Attributes:
        model, question, key, store, executor, hours, progress, report: as for :func:`fit`.
        count: batches so far.
        done: all that was told.
        particle_steps, seconds: what it took.
    """

    model: Callable
    question: Question
    key: jax.Array
    store: Any
    executor: Any
    hours: float | None
    progress: bool
    report: Callable | None
    count: int = 0
    done: list[Told] = dataclasses.field(default_factory=list)
    particle_steps: float = 0.0
    seconds: float = 0.0

    def __post_init__(self):
        self._began = time.monotonic()
        if self.store is not None:
            Path(self.store).mkdir(parents=True, exist_ok=True)

    def say(self, text: str):
        if self.report is not None:
            self.report(text)

    def key_of_draws(self):
        """Of draws after so many batches."""
        return jax.random.fold_in(jax.random.fold_in(self.key, Domain.GOAL), self.count)

    def _key_of(self, batch: int):
        """Of a batch of runs, those of the checks being batch 0."""
        return jax.random.fold_in(jax.random.fold_in(self.key, Domain.FIT), batch)

    def told(self, at: np.ndarray) -> list[Told]:
        """What the model tells at places (n, d)."""
        self.count += 1
        self.say(f"batch {self.count}: {len(at)} runs")
        found = self._scanned(at, f"batch-{self.count}", self._key_of(self.count))
        self.done += found
        return found

    def fresh(self, z, count: int) -> list[Told]:
        """What fresh runs tell at some draws (n, names), at each control of the data."""
        some = z[np.linspace(0, len(z) - 1, count).astype(int)]
        data = self.question.data
        controls = np.unique(data.control) if data.controlled else np.array([np.nan])
        at = np.concatenate([self.question.places(some, c) for c in controls])
        self.say(f"checks: {len(at)} fresh runs")
        return self._scanned(at, "checks", self._key_of(0))

    def _scanned(self, at, name: str, key) -> list[Told]:
        points = tuple(self._point(x) for x in at)
        store = None if self.store is None else Path(self.store) / f"{name}.nc"
        table = scan(
            places.AtPlaces(self.model, points), {"place": tuple(range(len(points)))}, key=key,
            store=store, executor=self.executor, hours=self._hours(), progress=self.progress,
        )  # fmt: skip
        if not table.attrs["complete"]:
            raise RunError("time is up; the same call with this store goes on", None)
        self.particle_steps += float(table.particle_steps.sum())
        self.seconds += float(table.seconds.sum())
        return self._read(table, at)

    def _hours(self) -> float | None:
        """What is left of them."""
        spent = (time.monotonic() - self._began) / 3600
        return None if self.hours is None else max(self.hours - spent, 1e-6)

    def _point(self, x) -> dict[str, float]:
        names = list(self.question.of_model)
        if self.question.data.controlled is not None:
            names.append(self.question.data.controlled)
        return {name: float(v) for name, v in zip(names, np.exp(x))}

    def _read(self, table, at) -> list[Told]:
        status = table.status.values[:, 0]
        failed = [str(r) for r in table.reason.values[status == 2, 0]]
        if LEAST * len(failed) > len(at):
            raise RunError(f"{len(failed)} of {len(at)} runs failed, such as by: {failed[0]}", None)
        for name in self.question.quantities:
            if name not in table:
                raise ValueError(
                    f"the model tells {', '.join(_told_by(table))}, the data have {name}"
                )
        told = []
        for k in np.flatnonzero(status == 1):
            each = {
                name: Estimate(float(table[name][k]), float(table[f"{name}_error"][k]))
                for name in self.question.quantities
            }
            each = {n: e for n, e in each.items() if e.value > 0 and e.error > 0}
            told.append(Told(at[k], each))
        return told

    def noise(self) -> dict[str, float]:
        """Relative errors of runs, by quantity."""
        of = lambda name: [
            t.found[name].error / t.found[name].value for t in self.done if name in t.found
        ]
        return {name: float(np.median(of(name) or [0.02])) for name in self.question.quantities}
