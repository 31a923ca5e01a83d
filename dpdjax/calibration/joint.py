"""Several parameters for several wanted numbers: an optax descent, and a fit for the error bars."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import optax

from dpdjax.calibration.gauges import Gauge, steps_of
from dpdjax.calibration.wishes import gauges_of, scalar
from dpdjax.checks import positive
from dpdjax.errors import TargetError
from dpdjax.measure.statistics import Estimate
from dpdjax.model.rates import thermal_time
from dpdjax.surrogate.foresight import Foresight, Foresights

SIGMAS = 3.0
"""Standard errors that fit into a tolerance."""
MAX_POINTS, SETTLED = 16, 0.1
"""Points at most, and how near the last one the answer is to be."""
WIDE = 1e3
"""Factor around its present value within which a parameter is looked for."""
UNSEEN, PARALLEL = 0.02, 0.02
"""Share of a number by which a parameter changes it that counts as none; and of the largest slope
that the smallest of a combination is, where numbers pull in one direction."""
NEAR = 0.5
"""Points within this distance in ln parameter enter the final linear fit."""
CURVATURE = 0.3


@dataclasses.dataclass(frozen=True)
class JointPoint:
    """Values and slopes of all goals at one point.

    Attributes:
        x: logarithms of the parameters (parameters,).
        values: one estimate for each goal.
        slopes: estimates by goal and parameter.
    """

    x: np.ndarray
    values: tuple[Estimate, ...]
    slopes: tuple[tuple[Estimate, ...], ...]


@dataclasses.dataclass(frozen=True)
class JointCalibration:
    """The answer for several parameters.

    Attributes:
        estimates: parameter name -> value with its error.
        measured: goal name -> that number in a fresh run, with its error.
        fluid: the fluid with all of them set.
        history: the measured points.
        particle_steps: what it took.
        seconds: wall time.
        compile_seconds: what of it was making programs.
    """

    estimates: dict[str, Estimate]
    measured: dict[str, Estimate]
    fluid: Any
    history: tuple[JointPoint, ...]
    particle_steps: int
    seconds: float = math.nan
    compile_seconds: float = math.nan

    def __str__(self):
        found = ", ".join(f"{k} = {v}" for k, v in self.estimates.items())
        return f"{found} give " + ", ".join(f"{k} {v}" for k, v in self.measured.items())

    __repr__ = __str__


def default_optimiser() -> optax.GradientTransformation:
    """Damped steps of at most 0.4 in ln parameter; the gradients come preconditioned."""
    return optax.chain(optax.clip(0.4), optax.sgd(0.8))


def several(
    fluid,
    names: tuple[str, ...],
    wanted: dict,
    key,
    setup,
    bounds,
    optimiser,
    ahead: bool,
    most: int,
) -> JointCalibration:
    """Several parameters for as many wanted numbers.

    An optimiser is followed to where every goal is met, then planes through all points near are
    solved, and a fresh run checks. The gradient that it is handed is that of ``sum ((value -
    target)/target)^2 / 2`` in the logarithms, preconditioned by its Gauss-Newton matrix; it is made
    of measured residuals (unbiased) and of slopes.

    Args:
        fluid, names, wanted, key: what is varied for what.
        setup: how boxes are made.
        bounds: two ends of parameters by name.
        optimiser: an optax transformation, or None for damped steps.
        ahead: whether the atlas may say where to begin, and what the slopes are.
        most: particle-steps at most.

    Raises ValueError where no wanted number sees a parameter, TargetError where the numbers
    contradict each other, are out of reach, or error bars are not met after ``MAX_POINTS``.
    """
    box = Bounds.of(fluid, names, bounds)
    x = _begun(fluid, names, wanted, setup.density, box, ahead)
    at = lambda x: fluid.set(energies="keep", **dict(zip(names, map(float, np.exp(x)))))
    setup.say(f"equilibrating {len(wanted)} batches of {setup.boxes} boxes")
    gauges = gauges_of(wanted, at(x), key, setup)
    survey = _Survey(gauges, names, at, setup, ahead, most)
    optimiser = default_optimiser() if optimiser is None else optimiser
    state, points = optimiser.init(x), []
    errors = [setup.tolerance * abs(gauge.target) / SIGMAS for gauge in gauges]
    while True:
        points.append(survey.measured(x, [1.5 * e for e in errors], first=not points))
        _refuse_unseen(points[-1], gauges, names)
        answer, covariance, predicted = solve(points, gauges, box)
        settled = np.max(np.abs(answer - points[-1].x)) < SETTLED
        met = all(p <= e for p, e in zip(predicted, errors))
        is_over = len(points) >= MAX_POINTS or survey.steps > most
        _refuse_contradiction(points, gauges, names, box, is_over or (settled and met))
        if settled and met:
            break
        if is_over:
            raise TargetError(_gave_up(points, gauges, names, survey.steps), tuple(points))
        updates, state = optimiser.update(gradient(points[-1], gauges), state, x)
        x = box.clipped(np.asarray(optax.apply_updates(x, updates), float))
    fluid = at(answer)
    fresh = survey.fresh(fluid, errors)
    off = np.exp(answer) * np.sqrt(np.diag(covariance))
    return JointCalibration(
        {n: Estimate(math.exp(v), float(e), len(points)) for n, v, e in zip(names, answer, off)},
        {gauge.name: found for gauge, found in zip(gauges, fresh)},
        fluid,
        tuple(points),
        survey.steps,
    )


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Ends of logarithms of parameters (names,)."""

    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, fluid, names, told) -> "Bounds":
        """From ends by name, a factor of ``WIDE`` around the present values where none are
        given."""
        odd = set(told) - set(names)
        if odd:
            raise ValueError(f"bounds has {', '.join(sorted(odd))}; the parameters are {names}")
        ends = []
        for name in names:
            around = float(
                positive(scalar(fluid, name), name, "give the fluid a value to begin with")
            )
            low, high = told.get(name, (around / WIDE, around * WIDE))
            if not 0 < low <= around <= high:
                raise ValueError(
                    f"bounds of {name} are ({low}, {high}); give two above zero around {around:g}, "
                    "where it begins"
                )
            ends.append((math.log(low), math.log(high)))
        return cls(*np.array(ends).T)

    def clipped(self, x):
        return np.clip(x, self.low, self.high)

    def touched(self, x) -> np.ndarray:
        """Which parameters are at an end (names,)."""
        return (x <= self.low + 1e-9) | (x >= self.high - 1e-9)


def _begun(fluid, names, wanted, density, box: Bounds, ahead: bool) -> np.ndarray:
    """Where the atlas has all numbers as wanted, else the present values."""
    present = np.log([float(fluid.value(name)) for name in names])
    known = Foresights(fluid, density, names, tuple(wanted)).root(wanted, box) if ahead else None
    return present if known is None else known


@dataclasses.dataclass
class _Survey:
    """How points are measured.

    Attributes:
        gauges, names: what is measured, along what.
        at: the fluid of logarithms of the parameters.
        setup: how boxes are made.
        ahead: whether slopes may be those of the atlas.
        most: particle-steps at most.
    """

    gauges: Sequence[Gauge]
    names: tuple[str, ...]
    at: Callable
    setup: Any
    ahead: bool
    most: int

    @property
    def steps(self) -> int:
        return steps_of(self.gauges)

    def measured(self, x, errors, first: bool) -> JointPoint:
        fluid = self.at(x)
        settle = (1.0 if first else 0.5) * thermal_time(fluid)
        values = [
            gauge.measure(fluid, error, settle, self.most, self.setup.say).estimate
            for gauge, error in zip(self.gauges, errors)
        ]
        slopes = [self._slopes(g, fluid, e) for g, e in zip(self.gauges, errors)]
        told = ", ".join(f"{n} {math.exp(v):.4g}" for n, v in zip(self.names, x))
        found = ", ".join(f"{g.name} {v}" for g, v in zip(self.gauges, values))
        self.setup.say(f"{told}: {found}")
        return JointPoint(np.asarray(x), tuple(values), tuple(slopes))

    def _slopes(self, gauge, fluid, error: float) -> tuple[Estimate, ...]:
        known = [
            Foresight(fluid, self.setup.density, name, gauge.name).slope(float(fluid.value(name)))
            if self.ahead
            else None
            for name in self.names
        ]
        if None not in known:
            return tuple(known)
        return tuple(gauge.slopes(fluid, self.names, 2 * error, self.most, self.setup.say))

    def fresh(self, fluid, errors) -> list[Estimate]:
        for gauge in self.gauges:
            gauge.begin_afresh()
        settle = 0.5 * thermal_time(fluid)
        return [
            gauge.measure(fluid, error, settle, self.most, self.setup.say).estimate
            for gauge, error in zip(self.gauges, errors)
        ]


def _refuse_unseen(point: JointPoint, gauges, names):
    """ValueError for a parameter that no wanted number changes with."""
    for j, name in enumerate(names):
        sizes = [
            (abs(row[j].value) + 2 * row[j].error) / abs(gauge.target)
            for row, gauge in zip(point.slopes, gauges)
        ]
        if max(sizes) < UNSEEN:
            told = " and ".join(gauge.name for gauge in gauges)
            raise ValueError(
                f"{told} do not change with {name}, by no more than {max(sizes):.1g} of themselves "
                "in the logarithm; calibrate another parameter, or want another number"
            )


def _refuse_contradiction(points, gauges, names, box: Bounds, is_last: bool):
    """TargetError where planes through the points meet no answer: a parameter is at an end of its
    bounds; or at the end of the way, where the numbers pull in one direction as far as slopes
    tell."""
    off = [abs(v.value - g.target) > 4 * v.error for v, g in zip(points[-1].values, gauges)]
    stuck = len(points) > 2 and all(box.touched(p.x).any() for p in points[-2:])
    if is_last and (along := _same_direction(points, gauges)) is not None:
        why = f"they stay along {' '.join(f'{n}^{p:.2g}' for n, p in zip(names, along))}"
    elif any(off) and stuck:
        why = "the parameters are at an end of their bounds"
    else:
        return
    nearest = min(points, key=lambda p: _distance(p, gauges))
    wanted = " and ".join(f"{g.name} {g.target:g}" for g in gauges)
    raise TargetError(
        f"{wanted} contradict each other by {' and '.join(names)}: {why}; nearest is "
        f"{_told(nearest, gauges, names)}",
        tuple(points),
    )


def _same_direction(points, gauges) -> np.ndarray | None:
    """The direction of the parameters in which none of the numbers changes, as far as the slopes at
    all points tell; None where there is none."""
    targets = np.array([g.target for g in gauges])[:, None]
    slopes = np.array([[[s.value for s in row] for row in p.slopes] for p in points]) / targets
    errors = np.array([[[s.error for s in row] for row in p.slopes] for p in points]) / targets
    mean, error = slopes.mean(axis=0), np.sqrt((errors**2).sum(axis=0)) / len(points)
    left, sizes, right = np.linalg.svd(mean)
    off = math.sqrt(float(left[:, -1] ** 2 @ error**2 @ right[-1] ** 2))
    is_none = sizes[-1] < max(PARALLEL * sizes[0], 3 * off)
    return right[-1] / np.max(np.abs(right[-1])) if is_none else None


def _told(point: JointPoint, gauges, names) -> str:
    found = ", ".join(f"{g.name} {v}, wanted {g.target:g}" for g, v in zip(gauges, point.values))
    return f"{found} at {', '.join(f'{n} = {math.exp(v):.3g}' for n, v in zip(names, point.x))}"


def _distance(point: JointPoint, gauges) -> float:
    return sum((v.value / g.target - 1.0) ** 2 for v, g in zip(point.values, gauges))


def _gave_up(points, gauges, names, steps) -> str:
    nearest = min(points, key=lambda p: _distance(p, gauges))
    return (
        f"no answer after {len(points)} points and {steps:.2g} particle-steps: nearest is "
        f"{_told(nearest, gauges, names)}; allow more max_particle_steps, a larger tolerance, or "
        "other bounds"
    )


def gradient(point: JointPoint, goals) -> np.ndarray:
    """Gauss-Newton preconditioned gradient of the squared relative residuals, (parameters,)."""
    targets = np.array([goal.target for goal in goals])
    residual = np.array([v.value for v in point.values]) / targets - 1.0
    jacobian = np.array([[s.value for s in row] for row in point.slopes]) / targets[:, None]
    square = jacobian.T @ jacobian
    damping = 1e-3 * np.trace(square) * np.eye(len(square))
    return np.linalg.solve(square + damping, jacobian.T @ residual)


def solve(points, goals, bounds: Bounds):
    """The parameters, within bounds, at which linear fits of all goals meet their targets.

    Returns (ln parameters, their covariance, standard error of each goal there).
    """
    last = points[-1].x
    near = [p for p in points if np.max(np.abs(p.x - last)) <= NEAR]
    fits = [_plane(near, k, last) for k in range(len(goals))]
    jacobian = np.array([c[1:] for c, _ in fits])
    residual = np.array([goal.target - c[0] for goal, (c, _) in zip(goals, fits)])
    inverse = np.linalg.pinv(jacobian)
    step = np.clip(inverse @ residual, -NEAR, NEAR)
    at = np.concatenate([[1.0], step])
    errors = [float(np.sqrt(at @ covariance @ at)) for _, covariance in fits]
    return bounds.clipped(last + step), inverse @ np.diag(np.square(errors)) @ inverse.T, errors


def _plane(points, k, centre):
    """Weighted least squares of value and gradient of goal ``k`` around ``centre``."""
    rows, wanted = [], []
    for p in points:
        d = p.x - centre
        missing = CURVATURE * abs(p.values[k].value) * float(np.max(np.abs(d)))
        sigma = math.hypot(p.values[k].error, missing * float(np.max(np.abs(d))))
        rows.append(np.concatenate([[1.0], d]) / sigma)
        wanted.append(p.values[k].value / sigma)
        for axis, slope in enumerate(p.slopes[k]):
            sigma = math.hypot(slope.error, missing) or 1e-12 * abs(p.values[k].value)
            rows.append(np.eye(len(d) + 1)[axis + 1] / sigma)
            wanted.append(slope.value / sigma)
    design = np.array(rows)
    covariance = np.linalg.pinv(design.T @ design)
    return covariance @ design.T @ np.array(wanted), covariance
