"""Find the parameter that gives a wanted number, with an error bar."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from dpdjax.calibration import experiment
from dpdjax.calibration.curve import Curve, Point, propose
from dpdjax.calibration.goal import (
    ONE_NUMBER,
    Goal,
    custom_goal,
    damped,
    pressure_goal,
    rough_viscosity,
    viscosity_goal,
    viscosity_goal_at,
)
from dpdjax.calibration.joint import SIGMAS, JointCalibration, descend
from dpdjax.calibration.picture import draw_calibration
from dpdjax.checks import number, positive, prng_key
from dpdjax.engine.compiling import Clock
from dpdjax.engine.flow import Driving
from dpdjax.engine.integrator import Integrator
from dpdjax.errors import TargetError
from dpdjax.measure.statistics import Estimate
from dpdjax.model.fluid import Fluid
from dpdjax.model.rates import drag_viscosity, thermal_time
from dpdjax.model.summary import as_table
from dpdjax.pairs.noise import Domain

MAX_POINTS = 10
NEAR = 0.1
"""A root or a minimum counts once a value was measured this near in ``ln parameter``: slopes alone
may be biased."""
SLOPE_SAMPLES = 8
"""Tangent windows per point, over all boxes."""


@dataclasses.dataclass(frozen=True)
class Calibration:
    """The answer of a calibration.

    Attributes:
        parameter: what was varied.
        name: what was aimed at, e.g. ``"viscosity"``.
        target: its wanted value.
        estimate: the parameter that gives it, with its error.
        measured: the wanted number in a fresh run at that parameter, with its error.
        fluid: the fluid with the parameter set.
        history: the measured points; ``x`` is the logarithm of the parameter.
        curve: the fit through them.
        dt, rate: time step and shear rate of the fresh run.
        particle_steps, seconds, compile_seconds: what it took, and what of it was making programs.
        temperature: mean kinetic temperature of the fresh run; NaN where the goal does not record
            it.
    """

    parameter: str
    name: str
    target: float
    estimate: Estimate
    measured: Estimate
    fluid: Any
    history: tuple[Point, ...]
    curve: Curve
    dt: float
    rate: float
    particle_steps: int
    seconds: float
    temperature: float = math.nan
    compile_seconds: float = math.nan

    @property
    def value(self) -> float:
        return self.estimate.value

    @property
    def error(self) -> float:
        return self.estimate.error

    def plot(self, ax=None):
        """Draw the points with their slopes, the curve through them, the target and the fresh run;
        returns the axes."""
        return draw_calibration(self, ax)

    def _repr_html_(self):
        rows = {
            self.parameter: self.estimate,
            f"wanted {self.name}": f"{self.target:g}",
            "of a fresh run": self.measured,
            "dt, shear rate": f"{self.dt:.3g}, {self.rate:.3g}",
            "cost": f"{self.particle_steps:.2g} particle-steps, {self.seconds:.0f} s",
        }
        return as_table(f"Calibration of {self.parameter}", rows.items())

    def __str__(self):
        return (
            f"{self.parameter} = {self.estimate} gives {self.name} {self.target:g}: "
            f"a fresh run measured {self.measured}"
        )

    __repr__ = __str__


def calibrate(
    fluid: Fluid,
    parameter: str | Sequence[str] = "gamma",
    *,
    key: jax.Array,
    viscosity: float | None = None,
    pressure: float | None = None,
    target: float | None = None,
    observe: Callable | None = None,
    flow: Driving = None,
    density: float | None = None,
    tolerance: float = 0.02,
    branch: str = "upper",
    guess: float | None = None,
    dt: float | None = None,
    rate: float | None = None,
    integrator: Integrator | None = None,
    box: float | None = None,
    boxes: int = 2,
    max_particle_steps: float = 2e9,
    optimiser: Any = None,
    report: Callable[[str], None] | None = None,
) -> Calibration | JointCalibration:
    """The value of ``parameter`` at which the fluid has the wanted viscosity (or other number).

    A batch of boxes is run at a guess; a value (unbiased, with its error) and a slope (by
    forward mode through a short window) are measured; all points so far are fitted together
    and the next run goes to the root of the fit, until its error bar is met. A fresh run at
    the answer checks it.

    Args:
        fluid: what to calibrate; its present value of ``parameter`` is the first guess
            where ``guess`` gives none.
        parameter: a positive scalar of the fluid: ``"gamma"``, ``"a"``, ``"kT"``, ...; or a
            sequence of them, for as many wanted numbers, e.g. ``("gamma", "a")`` with
            ``viscosity=`` and ``pressure=``. Several parameters follow an optax optimiser from
            their present values, and give a :class:`JointCalibration`.
        key: a PRNG key.
        viscosity, pressure: the wanted number; or ``target`` with ``observe(fluid, state)``
            and the ``flow`` it is measured in.
        density: beads per volume; by default 3 in the cube of the longest reach.
        tolerance: relative; the standard error of the wanted number at the answer, in the
            fit and in the fresh run, is at most a third of it.
        branch: ``"upper"`` where the number rises with the parameter, ``"lower"`` where it
            falls: viscosity has a minimum in gamma, and two gammas above it.
        dt: time step; by default ``suggest_dt``, following the drag.
        integrator: how the boxes move on in time; by default velocity-Verlet, or where no dt is
            given ``dpd.integrators.ImplicitDrag`` if that covers more time at the same accuracy: at
            strong drag between beads that hardly repel each other.
        rate: shear rate; by default ``suggest_rate``.
        box: side of each box; by default 10 interaction ranges, and fewer, to 6, at tolerances
            above 0.05.
        boxes: boxes in the batch.
        max_particle_steps: give up beyond.
        optimiser: an ``optax.GradientTransformation``, for several parameters.
        report: ``report(text)`` is told of the progress.

    Raises:
        TargetError: a target below the measured minimum, which it states; its ``history``
            holds the points.
        ValueError, TypeError: arguments that cannot work, before anything runs.
    """
    clock = Clock()
    key = prng_key(key)
    sign = _branch_sign(branch)
    positive(tolerance, "tolerance")
    density = _density(fluid, density)
    _refuse_unused(viscosity, target, observe, flow, rate)
    say = report or (lambda text: None)
    if not isinstance(parameter, str):
        wishes = {"viscosity": viscosity, "pressure": pressure, "target": target}
        setup = (observe, flow, rate, density, tolerance, box, boxes, dt, integrator)
        found = _several(fluid, tuple(parameter), wishes, key, setup, optimiser, say)
        return dataclasses.replace(
            found, seconds=clock.seconds, compile_seconds=clock.compile_seconds
        )
    _check_goal(viscosity, pressure, target, observe)
    guess = _first_guess(fluid, parameter, guess, viscosity, density)
    fluid = fluid.set(energies="keep", **{parameter: guess})
    goal = _goal(fluid, viscosity, pressure, target, observe, flow, rate, density, tolerance)
    say(f"equilibrating {boxes} boxes")
    ensemble = _ensemble(fluid, goal, key, density, tolerance, box, boxes, dt, integrator, say)
    wanted = tolerance * abs(goal.target) / SIGMAS

    x, points, proposal = math.log(guess), [], None
    while True:
        fluid = fluid.set(energies="keep", **{parameter: math.exp(x)})
        ensemble.goal = _goal(
            fluid, viscosity, pressure, target, observe, flow, rate, density, tolerance
        )
        say(f"{parameter} {math.exp(x):.4g}: measuring")
        coarse = not points or proposal.why == "search"
        error = 3.0 * wanted if coarse else 0.9 * wanted
        points.append(
            _measure_point(
                ensemble,
                fluid,
                parameter,
                x,
                error,
                first=not points,
                most=max_particle_steps,
                say=say,
            )
        )
        say(
            f"{parameter} {math.exp(x):.4g}: {goal.name} {points[-1].value}, slope "
            f"{points[-1].slope}"
        )
        proposal = propose(points, goal.target, sign)
        _refuse_unreachable(points, proposal, goal, parameter)
        answer = proposal.curve.at(proposal.x)
        if proposal.why == "root" and _is_near(points, proposal) and answer.error <= wanted:
            break
        if len(points) >= MAX_POINTS or ensemble.steps > max_particle_steps:
            raise TargetError(_gave_up(points, goal, parameter, ensemble), tuple(points))
        x = proposal.x

    value = math.exp(proposal.x)
    error = value * answer.error / abs(float(proposal.curve.slope(proposal.x)))
    fluid = fluid.set(energies="keep", **{parameter: value})
    experiment.begin_afresh(ensemble)
    settle = 0.5 * thermal_time(fluid)
    fresh = experiment.measure(ensemble, fluid, wanted, settle, int(max_particle_steps), say)
    return Calibration(
        parameter,
        goal.name,
        goal.target,
        Estimate(value, error, len(points)),
        fresh.estimate,
        fluid,
        tuple(points),
        proposal.curve,
        ensemble.step_for(fluid),
        float(ensemble.goal.flow.rate),
        ensemble.steps,
        clock.seconds,
        fresh.temperature,
        clock.compile_seconds,
    )


def measure_viscosity(
    fluid: Fluid,
    *,
    key: jax.Array,
    density: float | None = None,
    tolerance: float = 0.02,
    dt: float | None = None,
    rate: float | None = None,
    integrator: Integrator | None = None,
    box: float | None = None,
    boxes: int = 2,
    max_particle_steps: float = 2e9,
    report: Callable[[str], None] | None = None,
) -> experiment.Measurement:
    """The viscosity of a fluid in homogeneous shear, to a standard error of a third of the
    tolerance.

    Starts from nothing: equilibrates a batch of boxes, shears them and goes on until the
    error bar is met. Arguments as in :func:`calibrate`.

    Returns a :class:`Measurement`, the viscosity in its ``estimate``.
    """
    clock = Clock()
    key = prng_key(key)
    positive(tolerance, "tolerance")
    density = _density(fluid, density)
    rough = rough_viscosity(fluid, density)
    goal = _goal(fluid, rough, None, None, None, None, rate, density, tolerance)
    say = report or (lambda text: None)
    say(f"equilibrating {boxes} boxes")
    ensemble = _ensemble(fluid, goal, key, density, tolerance, box, boxes, dt, integrator, say)
    settle = thermal_time(fluid)
    wanted = tolerance * rough / SIGMAS
    most = int(max_particle_steps)
    first = experiment.measure(ensemble, fluid, wanted, settle, most, say)
    result = first
    wanted = tolerance * abs(first.estimate.value) / SIGMAS
    if first.estimate.error > wanted:
        result = experiment.measure(ensemble, fluid, wanted, 0.0, most, say)
    spent = {
        "particle_steps": ensemble.steps,
        "seconds": clock.seconds,
        "compile_seconds": clock.compile_seconds,
    }
    return dataclasses.replace(result, **spent)


def _several(fluid, parameters, wishes, key, setup, optimiser, say) -> JointCalibration:
    """Several parameters: one batch of boxes for each wanted number."""
    observe, flow, rate, density, tolerance, box, boxes, dt, integrator = setup
    wishes = {name: value for name, value in wishes.items() if value is not None}
    if len(wishes) != len(parameters):
        raise ValueError(
            f"{len(parameters)} parameters {parameters} for {len(wishes)} wanted numbers "
            f"{tuple(wishes)}; give as many of viscosity=, pressure=, target="
        )
    for name in parameters:
        _first_guess(fluid, name, None, None, density)
    ensembles, key = [], jax.random.fold_in(key, Domain.GOAL)
    for k, (name, value) in enumerate(wishes.items()):
        one = {name: value}
        _check_goal(one.get("viscosity"), one.get("pressure"), one.get("target"), observe)
        wish = (one.get("viscosity"), one.get("pressure"), one.get("target"))
        goal = _goal(fluid, *wish, observe, flow, rate, density, tolerance)
        own = jax.random.fold_in(key, k)
        ensembles.append(
            _ensemble(fluid, goal, own, density, tolerance, box, boxes, dt, integrator, say)
        )
    return descend(fluid, parameters, ensembles, tolerance, optimiser, MAX_POINTS, say)


def _measure_point(ensemble, fluid, parameter, x, error, first, most, say) -> Point:
    settle = (1.0 if first else 0.5) * thermal_time(fluid)
    far = experiment.FAR
    value = experiment.measure(ensemble, fluid, error, settle, int(most), say, far).estimate
    windows = max(1, -(-SLOPE_SAMPLES // ensemble.state.position.shape[0]))
    (slope,) = experiment.measure_slopes(ensemble, fluid, (parameter,), windows)
    return Point(x, value, slope)


def _density(fluid, density) -> float:
    return (
        3.0 / max(fluid.reaches()) ** 3 if density is None else float(positive(density, "density"))
    )


SIDES, LOOSE = (6.0, 10.0), 0.05
"""Least and largest side of a box in interaction ranges, and the tolerance from which on the
shortest runs in the largest one are better than was asked for."""


def suggest_box(fluid: Fluid, tolerance: float) -> float:
    """Side of the boxes for a tolerance: half the beads for twice the tolerance."""
    least, largest = SIDES
    side = max(least, largest * min(1.0, LOOSE / tolerance) ** (1 / 3))
    return side * max(fluid.reaches())


def _ensemble(fluid, goal, key, density, tolerance, box, boxes, dt, integrator, say):
    side = suggest_box(fluid, tolerance) if box is None else box
    return experiment.prepare(
        fluid,
        goal,
        key,
        density=density,
        side=side,
        boxes=boxes,
        dt=dt,
        integrator=integrator,
        report=say,
    )


def _check_goal(viscosity, pressure, target, observe):
    """Raise unless just one number is wanted, and one that can be."""
    asked = {"viscosity": viscosity, "pressure": pressure, "target": target}
    given = {name: value for name, value in asked.items() if value is not None}
    if len(given) != 1:
        names = " and ".join(given) or "none"
        raise ValueError(f"give one of viscosity=, pressure= or target= with observe=; got {names}")
    ((name, value),) = given.items()
    if name == "viscosity":
        positive(value, name)
    if number(value, name) == 0:
        raise ValueError(
            f"{name} is 0, and no error bar is small relative to it; shift the number that is "
            "observed"
        )
    if name == "target" and observe is None:
        raise ValueError(
            "target= needs observe=, a function observe(fluid, state) of which it is the mean"
        )
    if name == "target" and not callable(observe):
        raise TypeError(f"observe is a {type(observe).__name__}; {ONE_NUMBER}")


def _refuse_unused(viscosity, target, observe, flow, rate):
    """Raise where an argument would be ignored without a word."""
    for name, value, goes_with, wanted in (
        ("observe", observe, "target", target),
        ("flow", flow, "target", target),
        ("rate", rate, "viscosity", viscosity),
    ):
        if value is not None and wanted is None:
            raise ValueError(
                f"{name}= is used with {goes_with}= only; give {goes_with}= or leave {name}= out"
            )


def _goal(fluid, viscosity, pressure, target, observe, flow, rate, density, tolerance) -> Goal:
    if viscosity is not None:
        damped(fluid, density)
        if rate is None:
            return viscosity_goal_at(fluid, density, viscosity, tolerance)
        return viscosity_goal(viscosity, float(positive(rate, "rate")))
    return pressure_goal(pressure) if pressure is not None else custom_goal(target, observe, flow)


def _branch_sign(branch) -> int:
    if branch not in ("upper", "lower"):
        raise ValueError(f'branch is {branch!r}; it is "upper" (rising) or "lower" (falling)')
    return 1 if branch == "upper" else -1


def _first_guess(fluid, parameter, guess, viscosity, density) -> float:
    present = fluid.value(parameter)
    if np.ndim(present) != 0:
        raise ValueError(
            f"{parameter} is a table of shape {np.shape(present)}; only a scalar can be calibrated"
        )
    if guess is not None:
        return float(positive(guess, "guess"))
    by_drag = None if viscosity is None else drag_guess(fluid, parameter, viscosity, density)
    return float(positive(present, parameter, "give guess=")) if by_drag is None else by_drag


def drag_guess(fluid, parameter: str, viscosity: float, density: float) -> float | None:
    """The number whose drag alone gives the viscosity; None for one in which the drag is not
    linear.

    Kinetic theory (Marsh et al. 1997); 30-40 % off, and good enough to begin with.
    """
    base = float(fluid.value(parameter)) or 1.0
    drag = lambda share: drag_viscosity(fluid.set(**{parameter: share * base}), density)
    one, two, four = (drag(share) for share in (1.0, 2.0, 4.0))
    if not two > one * (1 + 1e-4) or not math.isclose(four - two, 2 * (two - one), rel_tol=1e-3):
        return None
    share = (viscosity - (2 * one - two)) / (two - one)
    return share * base if share > 0 else None


def _refuse_unreachable(points, proposal, goal, parameter):
    """Raise where the measured minimum lies above the target."""
    if proposal.why != "minimum":
        return
    lowest = proposal.curve.at(proposal.x)
    if (
        len(points) >= 3
        and _is_near(points, proposal)
        and lowest.value - goal.target > 3 * lowest.error
    ):
        raise TargetError(
            f"{goal.name} {goal.target:g} cannot be reached with {parameter}: the smallest "
            f"measured is {lowest} at {parameter} = {math.exp(proposal.x):.3g}; ask for more than "
            "that, or lower kT",
            tuple(points),
        )


def _is_near(points, proposal) -> bool:
    return min(abs(p.x - proposal.x) for p in points) < NEAR


def _gave_up(points, goal, parameter, ensemble) -> str:
    best = min(points, key=lambda p: abs(p.value.value - goal.target))
    return (
        f"no answer after {len(points)} points and {ensemble.steps:.2g} particle-steps: nearest is "
        f"{goal.name} {best.value} at {parameter} = {math.exp(best.x):.3g}, wanted "
        f"{goal.target:g}; allow more max_particle_steps, a larger tolerance, or give a guess"
    )
