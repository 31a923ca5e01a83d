"""Gauges: what a wanted number is read off, in boxes that go on from one point to the next."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from dpdjax.calibration import experiment
from dpdjax.calibration.experiment import Ensemble
from dpdjax.calibration.goal import Goal, rough_viscosity
from dpdjax.engine.observables import positions
from dpdjax.engine.trajectory import Plan
from dpdjax.measure.statistics import Estimate, from_replicas
from dpdjax.measure.transport import einstein, large_system_diffusion, squared_displacement
from dpdjax.model.rates import damping_rate, repulsion_energy
from dpdjax.surrogate.foresight import foretold

SLOPE_SAMPLES = 8
"""Tangent windows per point, over all boxes."""
CHORD = 0.15
"""Of ``ln parameter``, to both sides, where slopes are differences of two measurements."""
PART = 0.05
"""Relative step of density to both sides for a compressibility."""
SURE = 0.05
"""Relative error of a viscosity that a diffusion is corrected with."""


class Gauge(Protocol):
    """What measures one wanted number.

    Attributes:
        name: of the number.
        target: its wanted value.
    """

    name: str
    target: float

    @property
    def ensembles(self) -> list[Ensemble]:
        """The boxes."""
        ...

    def measure(
        self, fluid, error: float, settle: float, most: int, say, far=math.inf
    ) -> "Reading":
        """The number of a fluid to a standard error, or ``far`` of them off the target."""
        ...

    def slopes(self, fluid, names: tuple[str, ...], error: float, most: int, say) -> list[Estimate]:
        """Its slopes in the logarithms of parameters; ``error`` is that of values."""
        ...

    def begin_afresh(self):
        """Go on with noise that no earlier measurement has seen."""
        ...


def steps_of(gauges) -> int:
    """Particle-steps spent so far, of boxes that several share once."""
    return sum({id(e): e.steps for gauge in gauges for e in gauge.ensembles}.values())


@dataclasses.dataclass(frozen=True)
class Reading:
    """A measured number.

    Attributes:
        estimate: it.
        dt, rate: time step and shear rate.
        temperature: mean kinetic temperature; NaN where it is not recorded.
    """

    estimate: Estimate
    dt: float
    rate: float = 0.0
    temperature: float = math.nan


@dataclasses.dataclass
class Mean:
    """A number that is the mean of something in a stationary state.

    Attributes:
        ensemble: the boxes.
        goal_of: what is wanted, and the flow it is measured in, of a fluid.
    """

    ensemble: Ensemble
    goal_of: Callable[[Any], Goal]
    _last: tuple = (None, None)

    @property
    def name(self) -> str:
        return self.ensemble.goal.name

    @property
    def target(self) -> float:
        return self.ensemble.goal.target

    @property
    def ensembles(self) -> list[Ensemble]:
        return [self.ensemble]

    def measure(self, fluid, error, settle, most, say, far=math.inf) -> Reading:
        last, found = self._last
        # Several numbers may rest on one.
        if last is fluid and found.estimate.error <= error:
            return found
        self.ensemble.goal = self.goal_of(fluid)
        ran = experiment.measure(self.ensemble, fluid, error, settle, most, say, far)
        found = Reading(ran.estimate, ran.dt, ran.rate, ran.temperature)
        self._last = fluid, found
        return found

    def slopes(self, fluid, names, error, most, say) -> list[Estimate]:
        """By forward mode through short windows."""
        windows = max(1, -(-SLOPE_SAMPLES // self.ensemble.state.position.shape[0]))
        return experiment.measure_slopes(self.ensemble, fluid, names, windows)

    def begin_afresh(self):
        self._last = None, None
        experiment.begin_afresh(self.ensemble)


class _ByChords:
    """Slopes as differences of measurements at both sides."""

    def slopes(self, fluid, names, error, most, say) -> list[Estimate]:
        found = []
        for name in names:
            at = float(fluid.value(name))
            ends = [
                self.measure(
                    fluid.set(energies="keep", **{name: at * math.exp(step)}), error, 0.0, most, say
                ).estimate
                for step in (-CHORD, CHORD)
            ]
            low, high = ends
            slope = (high.value - low.value) / (2 * CHORD)
            found.append(Estimate(slope, math.hypot(low.error, high.error) / (2 * CHORD)))
        return found


@dataclasses.dataclass
class SlowMean(_ByChords, Mean):
    """A mean whose memory outlasts a tangent."""


class _OfParts(_ByChords):
    """What follows from other gauges, its ``parts``."""

    parts: tuple[Gauge, ...]

    @property
    def ensembles(self) -> list[Ensemble]:
        return [ensemble for part in self.parts for ensemble in part.ensembles]

    def begin_afresh(self):
        for part in self.parts:
            part.begin_afresh()


EACH, LAGS, LEAST_RUNS = 6, 4, 8
"""Frames of a lag, lags of a run that displacements are read off, and such runs at least, over all
boxes."""


@dataclasses.dataclass
class Diffusion(_ByChords):
    """Self-diffusion in a large system, from displacements at rest.

    Attributes:
        ensemble: the boxes, at rest.
        target: wanted value.
        viscosity: makes the gauge of the viscosity, which says what the box takes of it, for fluids
            that the atlas does not cover.
    """

    ensemble: Ensemble
    target: float
    viscosity: Callable[[], Mean]
    name: str = "diffusion"

    @property
    def ensembles(self) -> list[Ensemble]:
        return [self.ensemble]

    def measure(self, fluid, error, settle, most, say, far=math.inf) -> Reading:
        ensemble, dt = self.ensemble, self.ensemble.step_for(fluid)
        system = ensemble.system_of(fluid, dt)
        viscosity = self._viscosity(fluid, settle, most, say)
        plan = self._plan(fluid, viscosity, dt)
        in_large = lambda found: large_system_diffusion(
            found, viscosity=viscosity, density=ensemble.density, kT=float(fluid.kT),
            mass=_mass(fluid), side=self._side,
        )  # fmt: skip
        runs, spent, samples = -(-LEAST_RUNS // self._boxes), 0, []
        # What a new friction changes is forgotten within a run.
        self._displaced(system, plan)
        while True:
            samples.append(self._displaced(system, plan))
            spent += plan.steps * ensemble.beads
            if len(samples) < runs and spent < most:
                continue
            found = in_large(experiment.widened(from_replicas(np.concatenate(samples))))
            enough = max(error, abs(found.value - self.target) / far)
            say(f"diffusion {found}, wanted error {enough:.2g}")
            if found.error <= enough or spent >= most:
                return Reading(found, dt)
            runs = experiment.planned(len(samples), found.error / enough)

    @property
    def _boxes(self) -> int:
        return self.ensemble.state.position.shape[0]

    @property
    def _side(self) -> float:
        return float(np.asarray(self.ensemble.state.box.lengths).reshape(-1)[0])

    def _viscosity(self, fluid, settle, most, say) -> float:
        known = foretold(fluid, self.ensemble.density, "viscosity")
        if known is not None:
            return known.value
        error = SURE * rough_viscosity(fluid, self.ensemble.density)
        return self.viscosity().measure(fluid, error, settle, most, say).estimate.value

    def _plan(self, fluid, viscosity: float, dt: float) -> Plan:
        """Runs of so many lags: after one beads have forgotten their velocity, the flow that they
        stirred up in the box, and the friction where they were."""
        density, mass, kT = self.ensemble.density, _mass(fluid), float(fluid.kT)
        known = foretold(fluid, density, "diffusion")
        D = kT / (mass * damping_rate(fluid, density)) if known is None else known.value
        reach, stiff = max(fluid.reaches()), 1.0 + repulsion_energy(fluid, density) / kT
        spreading = viscosity / (density * mass) + D
        lag = max(
            5.0 * mass * D / kT,
            3.0 * self._side**2 / (4 * math.pi**2 * spreading),
            0.5 * reach**2 / (D * stiff),
        )
        return Plan(LAGS * EACH, max(1, round(lag / (EACH * dt))))

    def _displaced(self, system, plan: Plan) -> np.ndarray:
        """One run; D of each box (boxes,)."""
        ensemble = self.ensemble
        ensemble.state, frames = experiment.replay(ensemble, system, plan, positions)
        ensemble.steps += plan.steps * ensemble.beads
        places = (
            np.asarray(frames["position"], float) + np.asarray(frames["image"], float) * self._side
        )
        time = float(system.dt) * plan.every * np.arange(2 * EACH + 1)
        window = time >= 0.999 * time[EACH]
        # All beads weigh the same.
        relative = places - places.mean(axis=2, keepdims=True)
        curves = np.array([squared_displacement(box, 2 * EACH) for box in relative])
        return einstein(time, curves, window)

    def begin_afresh(self):
        experiment.begin_afresh(self.ensemble)


def _mass(fluid) -> float:
    return float(np.asarray(fluid.mass).ravel()[0])


@dataclasses.dataclass
class Schmidt(_OfParts):
    """Viscosity over mass density and diffusion.

    Attributes:
        target: wanted value.
        viscosity, diffusion: gauges of both.
    """

    target: float
    viscosity: Mean
    diffusion: Diffusion
    name: str = "schmidt"

    @property
    def parts(self) -> tuple[Gauge, ...]:
        return self.viscosity, self.diffusion

    def measure(self, fluid, error, settle, most, say, far=math.inf) -> Reading:
        density = self.viscosity.ensemble.density
        # As far as is known before; the rest follows from what comes out.
        relative = error / self.target / math.sqrt(2.0)
        while True:
            eta = self._part(self.viscosity, fluid, relative, settle, most, say)
            D = self._part(self.diffusion, fluid, relative, settle, most, say)
            heavy = eta.estimate.scaled(1.0 / (density * _mass(fluid)))
            found = heavy.over(D.estimate)
            enough = max(error, abs(found.value - self.target) / far)
            if found.error <= 1.1 * enough or steps_of([self]) > most:
                return Reading(found, eta.dt, eta.rate, eta.temperature)
            relative *= 0.9 * enough / found.error

    @staticmethod
    def _part(gauge, fluid, relative, settle, most, say) -> Reading:
        known = foretold(fluid, gauge.ensemble.density, gauge.name)
        if known is None:
            rough = gauge.measure(fluid, 4 * relative * abs(gauge.target), settle, most, say)
            known, settle = rough.estimate, 0.0
        return gauge.measure(fluid, relative * known.value, settle, most, say)


@dataclasses.dataclass
class Compressibility(_OfParts):
    """``1/(density dp/d density)`` from the pressures at two densities.

    Attributes:
        target: wanted value.
        thin, dense: gauges of the pressure at both.
    """

    target: float
    thin: Mean
    dense: Mean
    name: str = "compressibility"

    @property
    def parts(self) -> tuple[Gauge, ...]:
        return self.thin, self.dense

    def measure(self, fluid, error, settle, most, say, far=math.inf) -> Reading:
        low, high = self.thin.ensemble.density, self.dense.ensemble.density
        density, apart = 0.5 * (low + high), high - low
        stiffness, relative = 1.0 / (density * self.target), error / self.target
        while True:
            each = relative * stiffness * apart / math.sqrt(2.0)
            ends = [g.measure(fluid, each, settle, most, say) for g in (self.thin, self.dense)]
            thin, dense = (end.estimate for end in ends)
            slope = (dense.value - thin.value) / apart
            off = math.hypot(thin.error, dense.error) / apart
            found = Estimate(1.0 / (density * slope), off / slope / (density * slope))
            enough = max(error, abs(found.value - self.target) / far)
            if found.error <= 1.1 * enough or steps_of([self]) > most:
                return Reading(found, ends[0].dt)
            stiffness, relative = slope, 0.9 * enough / found.value
