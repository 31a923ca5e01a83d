"""Units and the water preset against the published numbers."""

import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.measure.statistics import Estimate
from dpdjax.model.units import (
    BOLTZMANN,
    DIMENSIONS,
    Units,
    repulsion_from_compressibility,
    water_units,
)

TIMES = ["thermal", "diffusion", "viscosity_energy", "viscosity_mass"]
BEAD, THERMAL = 8.967e-26, BOLTZMANN * 298.0


def test_size_and_mass_of_a_water_bead():
    units = water_units()
    assert units.length == pytest.approx(6.463e-10, rel=1e-4)
    assert units.mass == pytest.approx(BEAD, rel=1e-4)
    assert units.energy == pytest.approx(THERMAL, rel=1e-12)
    assert units.to_si(3.0, "density") == pytest.approx(996.3, abs=0.1)


@pytest.mark.parametrize(
    "time, seconds", list(zip(TIMES, [3.02e-12, 88.2e-12, 77.2e-12, 0.118e-12]))
)
def test_time_unit_by_what_is_matched(time, seconds):
    assert water_units(time).time == pytest.approx(seconds, rel=2e-3)


def test_diffusion_match_with_the_measured_value():
    assert water_units("diffusion", diffusion=0.3).time == pytest.approx(155e-12, rel=5e-3)


@pytest.mark.parametrize("time, mass, energy", list(zip(TIMES, [1, 854, 654, 1], [1, 1, 1, 655])))
def test_what_each_match_gives_up(time, mass, energy):
    units = water_units(time)
    assert units.mass / BEAD == pytest.approx(mass, rel=3e-3)
    assert units.energy / THERMAL == pytest.approx(energy, rel=3e-3)
    assert units.energy == pytest.approx(units.mass * units.length**2 / units.time**2, rel=1e-12)
    assert units.note


def test_matched_properties_are_those_of_water():
    assert water_units("diffusion").to_si(0.171, "diffusion") == pytest.approx(2.43e-9 / 3)
    for time in ("viscosity_energy", "viscosity_mass"):
        assert water_units(time).to_si(0.85, "viscosity") == pytest.approx(1e-3)
    thermal = water_units("thermal")
    assert 1e-3 / thermal.to_si(0.85, "viscosity") == pytest.approx(26, rel=0.02)
    assert thermal.to_si(0.171, "diffusion") / (2.43e-9 / 3) == pytest.approx(29, rel=0.02)


def test_kT_of_the_fluid_sets_the_energy_unit():
    assert water_units(kT=0.1).to_si(0.1, "energy") == pytest.approx(THERMAL)


@pytest.mark.parametrize("dimension", DIMENSIONS)
def test_round_trip(dimension):
    units = water_units("viscosity_mass")
    assert units.from_si(units.to_si(0.7, dimension), dimension) == pytest.approx(0.7, rel=1e-12)


def test_dimensions_agree_with_each_other():
    s = Units(length=2.0, mass=3.0, time=5.0).scale
    assert s("force") == pytest.approx(s("mass") * s("acceleration"))
    assert s("pressure") == pytest.approx(s("energy") / s("volume"))
    assert s("viscosity") == pytest.approx(s("pressure") * s("time"))
    assert s("kinematic_viscosity") == pytest.approx(s("viscosity") / s("density"))
    assert s("surface_tension") == pytest.approx(s("energy") / s("length") ** 2)
    assert s("friction") == pytest.approx(s("force") / s("velocity"))
    assert s("diffusion") == pytest.approx(s("energy") / s("friction"))
    assert s("shear_rate") == pytest.approx(s("velocity") / s("length"))
    assert s("density") == pytest.approx(s("mass") * s("number_density"))


def test_arrays_and_estimates_convert():
    units = Units(length=2.0, mass=1.0, time=1.0)
    assert np.allclose(units.to_si(jnp.array([1.0, 2.0]), "length"), [2.0, 4.0])
    estimate = units.to_si(Estimate(1.0, 0.1, 5), "diffusion")
    assert (estimate.value, estimate.error, estimate.blocks) == (4.0, pytest.approx(0.4), 5)


def test_errors_name_the_choices():
    with pytest.raises(ValueError, match="no dimension 'speed'.*velocity.*viscosity"):
        water_units().to_si(1.0, "speed")
    with pytest.raises(ValueError, match="no time unit 'fast'.*thermal.*viscosity_mass"):
        water_units("fast")
    with pytest.raises(ValueError, match="diffusion is -1"):
        water_units("diffusion", diffusion=-1.0)
    with pytest.raises(ValueError, match="mass unit is 0"):
        Units(length=1.0, mass=0.0, time=1.0)


def test_water_is_the_standard_fluid():
    water = dpd.water()
    assert (float(water.value("a")), float(water.value("gamma")), float(water.kT)) == (
        25.0,
        4.5,
        1.0,
    )
    assert float(dpd.water(kT=0.1).value("a")) == pytest.approx(2.5)
    assert float(dpd.water(a=15.0, kT=0.1).value("a")) == 15.0
    with pytest.raises(ValueError, match="gamma"):
        dpd.water(gamma=-1.0)


def test_repulsion_from_compressibility():
    assert float(repulsion_from_compressibility(16.0)) == pytest.approx(25.0)
    assert float(repulsion_from_compressibility(3 * 16.0)) == pytest.approx(78.3, abs=0.1)
    assert float(repulsion_from_compressibility(16.0, kT=0.1, density=5.0)) == pytest.approx(1.5)
    with pytest.raises(ValueError, match="ideal gas"):
        repulsion_from_compressibility(0.5)
