"""Find the parameter that gives a wanted number, with an error bar."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax

from dpdjax.calibration import experiment, wishes
from dpdjax.calibration.curve import Curve, Point, propose
from dpdjax.calibration.gauges import Gauge, steps_of
from dpdjax.calibration.goal import likely_viscosity, rough_viscosity
from dpdjax.calibration.joint import SIGMAS, JointCalibration, several
from dpdjax.calibration.picture import draw_calibration
from dpdjax.checks import positive, prng_key
from dpdjax.engine.compiling import Clock
from dpdjax.engine.flow import Driving
from dpdjax.engine.integrator import Integrator
from dpdjax.engine.state import State
from dpdjax.errors import TargetError, warn
from dpdjax.measure.statistics import Estimate
from dpdjax.model.fluid import Fluid
from dpdjax.model.rates import drag_viscosity, thermal_time
from dpdjax.model.summary import as_table
from dpdjax.pairs.noise import Domain
from dpdjax.surrogate.atlas import QUANTITIES
from dpdjax.surrogate.foresight import Foresight, foretold, is_of_atlas

MAX_POINTS = 10
NEAR = 0.1
"""A root or a minimum counts once a value was measured this near in ``ln parameter``: slopes alone
may be biased."""


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
        particle_steps: what it took.
        seconds: wall time.
        compile_seconds: what of it was making programs.
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
    diffusion: float | None = None,
    schmidt: float | None = None,
    pressure: float | None = None,
    compressibility: float | None = None,
    target: float | None = None,
    observe: Callable | None = None,
    flow: Driving = None,
    density: float | None = None,
    tolerance: float = 0.02,
    branch: str | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    guess: float | None = None,
    dt: float | None = None,
    rate: float | None = None,
    integrator: Integrator | None = None,
    box: float | None = None,
    boxes: int = 2,
    state: State | None = None,
    memory: float | None = None,
    max_particle_steps: float = 2e9,
    optimiser: Any = None,
    atlas: bool = True,
    report: Callable[[str], None] | None = None,
) -> Calibration | JointCalibration:
    """The value of ``parameter`` at which the fluid has the wanted viscosity (or other number).

    A batch of boxes is run at a guess; a value (unbiased, with its error) and a slope are
    measured; all points so far are fitted together and the next run goes to the root of the fit,
    until its error bar is met. A fresh run at the answer checks it. Slopes are those of the atlas
    where it covers the fluid; else by forward mode through a short window, or of diffusion, Schmidt
    number and compressibility by runs at both sides.

    Args:
        fluid: what to calibrate; its present value of ``parameter`` is the first guess
            where ``guess`` gives none.
        parameter: a positive scalar of the fluid: ``"gamma"``, ``"a"``, ``"kT"``, ...; or a
            sequence of them, for as many wanted numbers, e.g. ``("gamma", "a")`` with
            ``viscosity=`` and ``pressure=``. Several parameters follow an optax optimiser from
            where the atlas has the numbers, or else their present values, and give a
            ``JointCalibration``.
        key: a PRNG key.
        viscosity, diffusion, schmidt, pressure, compressibility: the wanted number [energy
            time/length^3], [length^2/time] in a large system, viscosity over mass density and
            diffusion, [energy/length^3], [length^3/energy]; or ``target`` with
            ``observe(fluid, state)`` and the ``flow`` it is measured in.
        density: beads per volume; by default 3 in the cube of the longest reach.
        tolerance: relative; the standard error of the wanted number at the answer, in the
            fit and in the fresh run, is at most a third of it.
        branch: ``"upper"`` where the number rises with the parameter, ``"lower"`` where it
            falls: viscosity has a minimum in gamma, and two gammas above it. By default where it
            rises, but of diffusion and compressibility where they fall; for a fluid that the atlas
            covers the other where there is but that.
        bounds: of several parameters, two ends by name; by default a factor of a thousand around
            where they begin.
        dt: time step; by default ``suggest_dt``, following the drag.
        integrator: how the boxes move on in time; by default velocity-Verlet, or where no dt is
            given ``dpd.integrators.ImplicitDrag`` if that covers more time at the same accuracy: at
            strong drag between beads that hardly repel each other.
        rate: shear rate; by default the largest that changes the viscosity by less than half the
            tolerance, by heat and by structure.
        box: side of each box; by default 10 interaction ranges, and fewer, to 6, at tolerances
            above 0.05.
        boxes: boxes in the batch.
        state: of molecules or colloids, that the boxes begin as, in place of one filled at random:
            for ``viscosity=``, ``pressure=`` and ``target=``; slopes are by runs at both sides.
        memory: how long that state remembers [time], by default the longest relaxation of its
            molecules as the model of Rouse has it: boxes settle and blocks last as long, and the
            shear is slower than 0.3 over it unless ``rate=`` is given.
        max_particle_steps: give up beyond.
        optimiser: an ``optax.GradientTransformation``, for several parameters.
        atlas: begin where the atlas of DPD fluids has the number, and take slopes from there, for a
            fluid that it covers; what is answered rests on the runs alone. A run that contradicts
            the atlas is warned of.
        report: ``report(text)`` is told of the progress.

    Raises:
        TargetError: a target below the measured minimum, which it states; its ``history``
            holds the points.
        ValueError, TypeError: arguments that cannot work, before anything runs.

    Example:
        >>> found = dpd.calibrate(water, viscosity=1.5, key=key, tolerance=0.5, box=4.0)
        >>> found.parameter, found.name, found.target
        ('gamma', 'viscosity', 1.5)
        >>> found.measured.error < 0.5 * 1.5 / 3  # of a fresh run at the answer
        True
        >>> thick = found.fluid  # water with that gamma
        >>> bool(thick.value("gamma") > water.value("gamma"))
        True
    """
    clock = Clock()
    key = prng_key(key)
    _check_branch(branch)
    positive(tolerance, "tolerance")
    asked = dict(
        viscosity=viscosity, diffusion=diffusion, schmidt=schmidt, pressure=pressure,
        compressibility=compressibility, target=target,
    )  # fmt: skip
    wishes.refuse_unused(asked, observe, flow, rate)
    wishes.refuse_of_state(asked, state, memory, density, box)
    density = _density(fluid, density, state)
    atlas = atlas and state is None
    names = (parameter,) if isinstance(parameter, str) else tuple(parameter)
    wanted = wishes.wanted_of(asked, observe, len(names))
    say = report or (lambda text: None)
    setup = wishes.Setup(
        density, tolerance, box, boxes, dt, integrator, rate, observe, flow, say, state, memory
    )
    if isinstance(parameter, str):
        start = _start(fluid, parameter, wanted, density, branch, guess, atlas)
        found = _one(fluid, parameter, wanted, key, setup, start, int(max_particle_steps))
    else:
        _refuse_of_one(branch, guess)
        ahead = atlas and all(name in QUANTITIES for name in wanted)
        how = (bounds or {}, optimiser, ahead, int(max_particle_steps))
        found = several(fluid, names, wanted, jax.random.fold_in(key, Domain.GOAL), setup, *how)
    return dataclasses.replace(found, seconds=clock.seconds, compile_seconds=clock.compile_seconds)


@dataclasses.dataclass(frozen=True)
class _Start:
    """Where a calibration of one parameter begins.

    Attributes:
        guess: the value.
        sign: of the slope on the branch.
        ahead: what the atlas says along the parameter; None of what it does not know.
        is_known: whether the guess is that of the atlas.
    """

    guess: float
    sign: int
    ahead: Foresight | None
    is_known: bool


def _start(fluid, parameter, wanted, density, branch, guess, atlas: bool) -> _Start:
    ((name, target),) = wanted.items()
    present = wishes.scalar(fluid, parameter)
    sign = {"upper": 1, "lower": -1, None: _usual_sign(name, parameter)}[branch]
    ahead = Foresight(fluid, density, parameter, name)
    if not (atlas and name in QUANTITIES and is_of_atlas(fluid, density)):
        ahead = None
    if guess is not None:
        return _Start(float(positive(guess, "guess")), sign, ahead, False)
    for side in (sign,) if branch else (sign, -sign):
        known = None if ahead is None else ahead.root(target, side)
        if known is not None:
            return _Start(known, side, ahead, True)
    # Of chains most of the viscosity is their own.
    by_drag = name == "viscosity" and not fluid.bonded
    rough = drag_guess(fluid, parameter, target, density) if by_drag else None
    rough = float(positive(present, parameter, "give guess=")) if rough is None else rough
    return _Start(rough, sign, ahead, False)


def _usual_sign(name: str, parameter: str) -> int:
    return -1 if name in wishes.FALLING and parameter in ("gamma", "a") else 1


def _one(fluid, parameter, wanted, key, setup, start: _Start, most: int) -> Calibration:
    """One parameter for one number."""
    at = lambda value: fluid.set(energies="keep", **{parameter: value})
    setup.say(f"equilibrating {setup.boxes} boxes")
    (gauge,) = wishes.gauges_of(wanted, at(start.guess), key, setup)
    error = setup.tolerance * abs(gauge.target) / SIGMAS
    if start.is_known:
        setup.say(f"the atlas has {gauge.name} {gauge.target:g} at {parameter} {start.guess:.4g}")
    point = _Pointing(gauge, parameter, start.ahead, most, setup.say)
    points, proposal = _followed(at, point, start, error)
    value = math.exp(proposal.x)
    answer = proposal.curve.at(proposal.x)
    off = value * answer.error / abs(float(proposal.curve.slope(proposal.x)))
    fluid = at(value)
    gauge.begin_afresh()
    fresh = gauge.measure(fluid, error, 0.5 * thermal_time(fluid), most, setup.say)
    if start.ahead is not None:
        tell_contradiction(fluid, setup, gauge.name, fresh.estimate)
    return Calibration(
        parameter,
        gauge.name,
        gauge.target,
        Estimate(value, off, len(points)),
        fresh.estimate,
        fluid,
        tuple(points),
        proposal.curve,
        fresh.dt,
        fresh.rate,
        steps_of([gauge]),
        math.nan,
        fresh.temperature,
    )


def _followed(at, point: "_Pointing", start: _Start, wanted: float):
    """Points that lead to the root, and what is proposed there."""
    gauge, parameter = point.gauge, point.parameter
    x, points, proposal = math.log(start.guess), [], None
    while True:
        coarse = proposal.why == "search" if points else not start.is_known
        error = 3.0 * wanted if coarse else 0.9 * wanted
        points.append(point.measured(at(math.exp(x)), x, error, first=not points))
        proposal = propose(points, gauge.target, start.sign)
        _refuse_unreachable(points, proposal, gauge, parameter)
        answer = proposal.curve.at(proposal.x)
        if proposal.why == "root" and _is_near(points, proposal) and answer.error <= wanted:
            return points, proposal
        if len(points) >= MAX_POINTS or steps_of([gauge]) > point.most:
            raise TargetError(_gave_up(points, gauge, parameter), tuple(points))
        x = proposal.x


@dataclasses.dataclass(frozen=True)
class _Pointing:
    """How a point is measured: its value by a gauge, its slope by the atlas or the gauge.

    Attributes:
        gauge, parameter: what is measured, along what.
        ahead: what the atlas says along the parameter, or None.
        most: particle-steps at most.
        say: ``say(text)`` is told of the progress.
    """

    gauge: Gauge
    parameter: str
    ahead: Foresight | None
    most: int
    say: Callable[[str], None]

    def measured(self, fluid, x: float, error: float, first: bool) -> Point:
        value = f"{self.parameter} {math.exp(x):.4g}"
        self.say(f"{value}: measuring")
        settle = (1.0 if first else 0.5) * thermal_time(fluid)
        read = self.gauge.measure(fluid, error, settle, self.most, self.say, experiment.FAR)
        slope = None if self.ahead is None else self.ahead.slope(math.exp(x))
        if slope is None:
            coarse = 2.0 * error
            names = (self.parameter,)
            (slope,) = self.gauge.slopes(fluid, names, coarse, self.most, self.say)
        self.say(f"{value}: {self.gauge.name} {read.estimate}, slope {slope}")
        return Point(x, read.estimate, slope)


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
    state: State | None = None,
    memory: float | None = None,
    max_particle_steps: float = 2e9,
    atlas: bool = True,
    report: Callable[[str], None] | None = None,
) -> experiment.Measurement:
    """The viscosity of a fluid in homogeneous shear, to a standard error of a third of the
    tolerance.

    Starts from nothing: equilibrates a batch of boxes, shears them and goes on until the
    error bar is met. Arguments as in :func:`dpdjax.calibrate`.

    Returns a ``Measurement``, the viscosity in its ``estimate`` [energy time/length^3]. Raises
    ValueError, TypeError for arguments that cannot work, RuntimeError for a fluid that the shear
    heats.

    Example:
        >>> found = dpd.measure_viscosity(water, key=key, tolerance=0.5, box=4.0)
        >>> abs(found.estimate.value - 0.85) < 0.4
        True
        >>> found.series.shape[0]  # boxes
        2
    """
    clock = Clock()
    key = prng_key(key)
    positive(tolerance, "tolerance")
    wishes.refuse_of_state({}, state, memory, density, box)
    density = _density(fluid, density, state)
    atlas = atlas and state is None
    rough = (likely_viscosity if atlas else rough_viscosity)(fluid, density)
    say = report or (lambda text: None)
    how = {"say": say, "state": state, "memory": memory}
    setup = wishes.Setup(density, tolerance, box, boxes, dt, integrator, rate, **how)
    say(f"equilibrating {boxes} boxes")
    ensemble = setup.ensemble(fluid, setup.viscosity_goal(fluid, rough), key)
    settle = thermal_time(fluid)
    wanted = tolerance * rough / SIGMAS
    most = int(max_particle_steps)
    first = experiment.measure(ensemble, fluid, wanted, settle, most, say)
    result = first
    wanted = tolerance * abs(first.estimate.value) / SIGMAS
    if first.estimate.error > wanted:
        result = experiment.measure(ensemble, fluid, wanted, 0.0, most, say)
    if atlas:
        tell_contradiction(fluid, setup, "viscosity", result.estimate)
    spent = {
        "particle_steps": ensemble.steps,
        "seconds": clock.seconds,
        "compile_seconds": clock.compile_seconds,
    }
    return dataclasses.replace(result, **spent)


CONTRADICTS = 3.0
"""Standard errors off the atlas at which a run contradicts it."""


def tell_contradiction(fluid, setup: wishes.Setup, name: str, measured: Estimate):
    """Warn where a run and the atlas differ by more than their errors, and what the shear rate may
    do to it."""
    known = foretold(fluid, setup.density, name)
    if known is None:
        return
    apart = abs(measured.value - known.value) - 0.5 * setup.tolerance * abs(known.value)
    if apart > CONTRADICTS * math.hypot(measured.error, known.error):
        warn(
            f"the {name} {measured} of this run contradicts the atlas, which has {known}: look at "
            "its dt, rate and box; where they are as suggested, trust the run",
        )


def _density(fluid, density, state=None) -> float:
    if state is not None:
        return state.n / float(state.box.volume)
    return (
        3.0 / max(fluid.reaches()) ** 3 if density is None else float(positive(density, "density"))
    )


def _check_branch(branch):
    if branch not in ("upper", "lower", None):
        raise ValueError(f'branch is {branch!r}; it is "upper" (rising) or "lower" (falling)')


def _refuse_of_one(branch, guess):
    """Raise where an argument for one parameter would be ignored without a word."""
    for name, value in (("branch", branch), ("guess", guess)):
        if value is not None:
            raise ValueError(
                f"{name}= is of one parameter; several begin at the values of the fluid, or where "
                "the atlas has them"
            )


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


def _refuse_unreachable(points, proposal, gauge, parameter):
    """Raise where the measured minimum lies above the target."""
    if proposal.why != "minimum":
        return
    lowest = proposal.curve.at(proposal.x)
    if (
        len(points) >= 3
        and _is_near(points, proposal)
        and lowest.value - gauge.target > 3 * lowest.error
    ):
        raise TargetError(
            f"{gauge.name} {gauge.target:g} cannot be reached with {parameter}: the smallest "
            f"measured is {lowest} at {parameter} = {math.exp(proposal.x):.3g}; ask for more than "
            "that, or lower kT",
            tuple(points),
        )


def _is_near(points, proposal) -> bool:
    return min(abs(p.x - proposal.x) for p in points) < NEAR


def _gave_up(points, gauge, parameter) -> str:
    best = min(points, key=lambda p: abs(p.value.value - gauge.target))
    spent = f"{len(points)} points and {steps_of([gauge]):.2g} particle-steps"
    nearest = f"{gauge.name} {best.value} at {parameter} = {math.exp(best.x):.3g}"
    return (
        f"no answer after {spent}: nearest is {nearest}, wanted {gauge.target:g}; allow more "
        "max_particle_steps, a larger tolerance, or give a guess"
    )
