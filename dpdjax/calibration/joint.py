"""Several parameters for several wanted numbers: an optax descent, and a fit for the error bars."""

import dataclasses
import math
from typing import Any

import numpy as np
import optax

from dpdjax.calibration import experiment
from dpdjax.measure.statistics import Estimate
from dpdjax.model.rates import thermal_time

SIGMAS = 3.0
"""Standard errors that fit into a tolerance."""
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
        particle_steps, seconds, compile_seconds: what it took, and what of it was making programs.
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


def descend(
    fluid, parameters, ensembles, tolerance, optimiser, most_points, say
) -> JointCalibration:
    """Follow an optimiser to the parameters at which every goal is met, then fit and check.

    The gradient handed to the optimiser is that of ``sum ((value - target)/target)^2 / 2`` in the
    logarithms, preconditioned by its Gauss-Newton matrix; it is made of measured residuals
    (unbiased) and of short-window slopes. All points near the end are fitted together.

    Raises RuntimeError where the error bars are not met after ``most_points``.
    """
    goals = [ensemble.goal for ensemble in ensembles]
    optimiser = default_optimiser() if optimiser is None else optimiser
    x = np.array([math.log(float(fluid.value(name))) for name in parameters])
    state, points = optimiser.init(x), []
    wanted = [tolerance * abs(goal.target) / SIGMAS for goal in goals]
    while len(points) < most_points:
        points.append(
            _measure(
                fluid,
                parameters,
                ensembles,
                x,
                [1.5 * w for w in wanted],
                first=not points,
                say=say,
            )
        )
        say(
            ", ".join(f"{n} {math.exp(v):.4g}" for n, v in zip(parameters, x))
            + f": {points[-1].values}"
        )
        answer, covariance, predicted = solve(points, goals)
        settled = len(points) > 1 and np.max(np.abs(answer - points[-1].x)) < 0.1
        if settled and all(p <= w for p, w in zip(predicted, wanted)):
            break
        updates, state = optimiser.update(gradient(points[-1], goals), state, x)
        x = np.asarray(optax.apply_updates(x, updates), float)
    else:
        raise RuntimeError(
            f"no answer after {most_points} points, the last at {dict(zip(parameters, np.exp(x)))}"
        )
    fluid = fluid.set(energies="keep", **{n: math.exp(v) for n, v in zip(parameters, answer)})
    fresh = _fresh(fluid, ensembles, wanted, say)
    errors = np.exp(answer) * np.sqrt(np.diag(covariance))
    estimates = {
        n: Estimate(math.exp(v), float(e), len(points))
        for n, v, e in zip(parameters, answer, errors)
    }
    measured = {goal.name: f for goal, f in zip(goals, fresh)}
    return JointCalibration(
        estimates, measured, fluid, tuple(points), sum(b.steps for b in ensembles)
    )


def gradient(point: JointPoint, goals) -> np.ndarray:
    """Gauss-Newton preconditioned gradient of the squared relative residuals, (parameters,)."""
    targets = np.array([goal.target for goal in goals])
    residual = np.array([v.value for v in point.values]) / targets - 1.0
    jacobian = np.array([[s.value for s in row] for row in point.slopes]) / targets[:, None]
    square = jacobian.T @ jacobian
    damping = 1e-3 * np.trace(square) * np.eye(len(square))
    return np.linalg.solve(square + damping, jacobian.T @ residual)


def solve(points, goals):
    """The parameters at which linear fits of all goals meet their targets.

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
    return last + step, inverse @ np.diag(np.square(errors)) @ inverse.T, errors


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


def _measure(fluid, parameters, ensembles, x, errors, first, say) -> JointPoint:
    fluid = fluid.set(energies="keep", **{n: math.exp(v) for n, v in zip(parameters, x)})
    settle = (1.0 if first else 0.5) * thermal_time(fluid)
    values, slopes = [], []
    for ensemble, error in zip(ensembles, errors):
        values.append(experiment.measure(ensemble, fluid, error, settle, int(1e9), say).estimate)
        windows = max(1, -(-8 // ensemble.state.position.shape[0]))
        slopes.append(tuple(experiment.measure_slopes(ensemble, fluid, tuple(parameters), windows)))
    return JointPoint(np.asarray(x), tuple(values), tuple(slopes))


def _fresh(fluid, ensembles, wanted, say):
    settle = 0.5 * thermal_time(fluid)
    for ensemble in ensembles:
        experiment.begin_afresh(ensemble)
    return [
        experiment.measure(b, fluid, w, settle, int(1e9), say).estimate
        for b, w in zip(ensembles, wanted)
    ]
