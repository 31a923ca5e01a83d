"""The same matter in several systems of units: every answer is the same number of reduced units."""

import dataclasses
import functools
import math

import jax
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.calibration import experiment
from dpdjax.calibration.calibrate import calibrate, drag_guess, measure_viscosity, rough_viscosity
from dpdjax.calibration.goal import suggest_rate
from dpdjax.checks import positive
from dpdjax.model.rates import drag_viscosity, thermal_time
from dpdjax.surrogate.foresight import Foresight

GAMMA, A, DENSITY = 12.0, 25.0, 3.0


@dataclasses.dataclass(frozen=True)
class System:
    """One length, mass and kT in its own numbers; powers of two scale without rounding."""

    length: float
    mass: float
    kT: float

    @property
    def time(self):
        return self.length * math.sqrt(self.mass / self.kT)

    @property
    def viscosity(self):
        return math.sqrt(self.mass * self.kT) / self.length**2

    @property
    def density(self):
        return DENSITY / self.length**3

    def water(self):
        gamma, a = GAMMA * self.mass / self.time, A * self.kT / self.length
        return dpd.water(a=a, gamma=gamma, kT=self.kT, r_c=self.length, mass=self.mass)


REDUCED = System(1.0, 1.0, 1.0)
SYSTEMS = {
    "mass 54": System(1.0, 54.0, 1.0),
    "length 6.46": System(6.46, 1.0, 0.1),
    "large": System(2.0**10, 2.0**20, 2.0**12),
    "SI": System(6.46e-10, 9e-26, 4.1e-21),
    "SI, powers of two": System(2.0**-30, 2.0**-84, 2.0**-68),
}
every_system = pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS)


def advice(system) -> dict:
    """What is advised for the fluid, in reduced units."""
    fluid, density = system.water(), system.density
    dt = dpd.suggest_dt(fluid, density)
    weak = experiment.weakly_damped(fluid, density)
    rough = rough_viscosity(fluid, density)
    return {
        "dt": dt / system.time,
        "skin": dpd.theory.suggest_skin(fluid, dt) / system.length,
        "thermal": thermal_time(fluid) / system.time,
        "rate": suggest_rate(fluid, density, rough) * system.time,
        "largest rate": suggest_rate(fluid, density, rough, 10.0) * system.time,
        "rough": rough / system.viscosity,
        "drag": drag_viscosity(fluid, density) / system.viscosity,
        "guess": drag_guess(fluid, "gamma", 1.3 * system.viscosity, density)
        * system.time
        / system.mass,
        "window": experiment.window_time(fluid, density) / system.time,
        "weak": float(weak.value("gamma")) * system.time / system.mass,
    }


@every_system
def test_advice(system):
    assert advice(system) == pytest.approx(advice(REDUCED), rel=1e-9)


def test_advice_without_kT_or_drag():
    """Zero limits nothing; a floor under it would be a number in some unit."""
    cold = dpd.water(a=A, gamma=GAMMA, kT=0.0)
    assert 0 < dpd.suggest_dt(cold, 3.0) < 0.05
    with pytest.raises(
        ValueError,
        match="nothing limits the time step: the fluid has neither kT nor a force; give dt=",
    ):
        dpd.suggest_dt(dpd.water(a=0.0, gamma=0.0, kT=0.0), 3.0)


def test_drag_viscosity_of_any_friction():
    """2 pi gamma rho^2 r_c^5/1575 where zeta = gamma w^2, in any power of it by its integral."""
    water = dpd.water(gamma=4.5, r_c=1.5)
    assert drag_viscosity(water, 2.0) == pytest.approx(
        2 * math.pi * 4.5 * 4 * 1.5**5 / 1575, rel=1e-4
    )
    linear = dpd.fluid(
        drag=[dpd.term(lambda h, *, zeta0, r_c: zeta0 * (1 - h / r_c), zeta0=2.0, r_c=1.0)], kT=1.0
    )
    assert drag_viscosity(linear, 3.0) == pytest.approx(2 * math.pi / 15 * 9 * 2.0 / 30, rel=1e-4)
    assert drag_guess(linear, "zeta0", 1.3, 3.0) == pytest.approx(
        1.3 / (2 * math.pi / 15 * 9 / 30), rel=1e-4
    )
    assert drag_guess(water, "a", 1.3, 3.0) is None and drag_guess(water, "r_c", 1.3, 3.0) is None


HEAVY_AND_COLD = System(1.0, 64.0, 0.25)
"""Of the same lengths, so that whole calibrations run in the same compiled programs."""


def reduced(system, state, frames) -> dict:
    """Where beads are and how fast, and what they recorded, in reduced units."""
    speed, stress = system.length / system.time, system.kT / system.length**3
    return {
        "position": state.position / system.length,
        "velocity": state.velocity / speed,
        "temperature": frames["temperature"] / system.kT,
        "pressure": frames["pressure_tensor"] / stress,
        "energy": frames["potential_energy"] / system.kT,
    }


def agree(ours, theirs, rounding=1e-9):
    for name in theirs:
        scale = np.max(np.abs(theirs[name]))
        assert np.max(np.abs(ours[name] - theirs[name])) < rounding * scale, name


@pytest.fixture(scope="module")
def moved(key, simulate, ten):
    """``moved(system)``: ten sheared steps of 222 beads, in reduced units."""

    @functools.cache
    def run(system):
        box, skin = 4.2 * system.length, 0.2 * system.length
        state = dpd.initial_state(system.water(), key, box=box, density=system.density, skin=skin)
        after = simulate(
            system.water(), state, key, 0.01 * system.time, ten, dpd.shear(0.5 / system.time)
        )
        assert after.final.status == 0
        return reduced(system, after.final, after.frames)

    return run


@every_system
def test_run(moved, system):
    agree(moved(system), moved(REDUCED))


def test_run_in_single_precision(key):
    """SI numbers and their products are within what 32 bits hold: ten steps are those of units of
    one, to rounding."""
    plan = dpd.Plan(2, 5)
    with jax.enable_x64(False):
        found = []
        for system in (REDUCED, SYSTEMS["SI"]):
            box = 4.2 * system.length
            state = dpd.initial_state(
                system.water(), key, box=box, density=system.density, skin=0.2 * system.length
            )
            run = dpd.run(
                system.water(),
                state,
                key,
                0.01 * system.time,
                plan,
                dpd.shear(0.5 / system.time),
                progress=False,
            )
            found.append(reduced(system, run.final, run.frames))
    agree(found[1], found[0], 1e-3)


def small_suspension(system, key):
    units = {
        "kT": system.kT,
        "r_c": system.length,
        "solvent_mass": system.mass,
        "gamma": GAMMA * system.mass / system.time,
    }
    box, eta_0 = 6.2 * system.length, 0.9 * system.viscosity
    return dpd.suspension(
        key, phi=0.1, box=box, D0=2.0 * system.kT, eta_0=eta_0, sheared=False, report=None, **units
    )


def one_marble(system, key):
    units = {"kT": system.kT, "r_c": system.length, "solvent_mass": system.mass}
    frictions = {name: GAMMA * system.mass / system.time for name in ("gamma", "gamma_cs")}
    return dpd.marbles(
        key, box=6.0 * system.length, radius=1.5 * system.length, report=None, **units, **frictions
    )


def rest_slow(*quick):
    """Every system, those not named among the slow tests: each length is a program of its own."""
    marks = lambda name: () if name in quick else pytest.mark.slow
    everything = {"heavy and cold": HEAVY_AND_COLD} | SYSTEMS
    return pytest.mark.parametrize(
        "system", [pytest.param(s, id=name, marks=marks(name)) for name, s in everything.items()]
    )


@pytest.fixture(scope="module")
def in_reduced_units():
    """``in_reduced_units(of, *arguments)``: what a function of a system and a key gives in units of
    one, computed once."""
    return functools.cache(lambda of, *arguments: of(REDUCED, *arguments))


def ten_steps(system, make, simulate, ten):
    key = jax.random.key(7)
    made = make(system, key)
    after = simulate(made.fluid, made.state, key, made.dt, ten)
    assert after.final.status == 0
    numbers = {"dt": made.dt / system.time, "mass": np.asarray(made.fluid.mass) / system.mass}
    return numbers | reduced(system, after.final, after.frames)


@pytest.mark.parametrize(
    "make", [small_suspension, pytest.param(one_marble, marks=pytest.mark.slow)]
)
@rest_slow("SI, powers of two")
def test_spheres(in_reduced_units, simulate, ten, make, system):
    """Numbers left out are lengths in r_c and energies in kT, so the same spheres are built and
    move alike."""
    # Packing compares rounded distances: in systems that are not powers of two apart they part by
    # as much.
    agree(
        ten_steps(system, make, simulate, ten),
        in_reduced_units(ten_steps, make, simulate, ten),
        1e-6,
    )


@pytest.fixture
def short_pieces(monkeypatch):
    monkeypatch.setattr(experiment, "PIECE", dpd.Plan(8, 3))


def measured_viscosity(system):
    wish = {"density": system.density, "tolerance": 3.0, "box": 3.0 * system.length, "boxes": 4}
    measured = measure_viscosity(system.water(), key=jax.random.key(7), **wish)
    advised = measured.rate * system.time, measured.dt / system.time
    assert measured.temperature / system.kT == pytest.approx(1.0, abs=0.1)
    return measured.estimate.scaled(1 / system.viscosity), advised


def calibrated(system):
    wish = {
        "viscosity": 1.5 * system.viscosity,
        "density": system.density,
        "box": 3.0 * system.length,
    }
    # A guess of the atlas is the same to rounding only, which runs would blow up.
    wish |= {"atlas": False}
    fit = calibrate(system.water(), key=jax.random.key(7), tolerance=1.0, boxes=4, **wish)
    return fit.estimate.scaled(system.time / system.mass), (
        fit.rate * system.time,
        fit.dt / system.time,
    )


@pytest.mark.parametrize("answer", [measured_viscosity, calibrated])
@rest_slow("heavy and cold")
def test_answers(in_reduced_units, short_pieces, monkeypatch, answer, system):
    """Where all factors are powers of two the same to rounding; else long runs part, and agree
    within their errors."""
    if answer is calibrated:
        # Its frictions are exponentials, equal to rounding: blocks as short as pieces, before that
        # has grown.
        monkeypatch.setattr(experiment, "remembered", lambda *_: 1e-9)
    (ours, advice), (theirs, due) = answer(system), in_reduced_units(answer)
    if system is HEAVY_AND_COLD:
        assert (ours.value, ours.error, *advice) == pytest.approx(
            (theirs.value, theirs.error, *due), rel=1e-6
        )
    else:
        assert ours.deviation(theirs) < 4
        assert advice == pytest.approx(due, rel=1e-6 if answer is measured_viscosity else 0.5)


@every_system
def test_where_the_atlas_begins(system):
    def guess(system):
        ahead = Foresight(system.water(), system.density, "gamma", "viscosity")
        return ahead.root(1.5 * system.viscosity, 1) * system.time / system.mass

    assert guess(system) == pytest.approx(guess(REDUCED), rel=1e-5)


def test_numbers_that_float32_cannot_hold():
    """A moment of inertia of 1e-44 became 0 without a word."""
    with pytest.raises(
        ValueError, match="inertia is 1e-44, which float32 cannot hold .*: choose units in which kT"
    ):
        with jax.enable_x64(False):
            positive(1e-44, "inertia")
