"""The same matter in several systems of units: every answer is the same number of reduced units."""

import dataclasses
import math

import pytest

import dpdjax as dpd
from dpdjax.calibration import experiment
from dpdjax.calibration.calibrate import drag_guess, rough_viscosity
from dpdjax.calibration.goal import suggest_rate
from dpdjax.engine.advice import drag_viscosity, thermal_time

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
        "skin": dpd.suggest_skin(fluid, dt) / system.length,
        "thermal": thermal_time(fluid) / system.time,
        "rate": suggest_rate(fluid, density, rough) * system.time,
        "largest rate": suggest_rate(fluid, density, rough, 10.0) * system.time,
        "rough": rough / system.viscosity,
        "drag": drag_viscosity(fluid, density) / system.viscosity,
        "guess": drag_guess(fluid, "gamma", 1.3 * system.viscosity, density) * system.time / system.mass,
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
    with pytest.raises(ValueError, match="nothing limits the time step: the fluid has neither kT nor a force; give dt="):
        dpd.suggest_dt(dpd.water(a=0.0, gamma=0.0, kT=0.0), 3.0)


def test_drag_viscosity_of_any_friction():
    """2 pi gamma rho^2 r_c^5/1575 where zeta = gamma w^2, in any power of it by its integral."""
    water = dpd.water(gamma=4.5, r_c=1.5)
    assert drag_viscosity(water, 2.0) == pytest.approx(2 * math.pi * 4.5 * 4 * 1.5**5 / 1575, rel=1e-4)
    linear = dpd.fluid(drag=[dpd.term(lambda h, *, zeta0, r_c: zeta0 * (1 - h / r_c), zeta0=2.0, r_c=1.0)], kT=1.0)
    assert drag_viscosity(linear, 3.0) == pytest.approx(2 * math.pi / 15 * 9 * 2.0 / 30, rel=1e-4)
    assert drag_guess(linear, "zeta0", 1.3, 3.0) == pytest.approx(1.3 / (2 * math.pi / 15 * 9 / 30), rel=1e-4)
    assert drag_guess(water, "a", 1.3, 3.0) is None and drag_guess(water, "r_c", 1.3, 3.0) is None
