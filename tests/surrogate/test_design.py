"""Designs: truths come back, all branches, ranges of what cannot be, SI units."""

import itertools
import json

import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.surrogate.atlas import QUANTITIES


def has(branch, name: str, value: float, rel=1e-6):
    assert getattr(branch.properties, name).value == pytest.approx(value, rel=rel), name


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("wanted", [("viscosity",), ("viscosity", "pressure")], ids="+".join)
def test_truths_come_back(wanted, seed):
    random = np.random.default_rng(seed)
    kT = random.uniform(0.2, 2.0)
    gamma, a = np.exp(random.uniform(0.5, 4.5)) * kT**0.5, random.uniform(5, 80) * kT
    told = dpd.atlas(dpd.water(a=a, gamma=gamma, kT=kT), 3.0)
    how = {"repulsion": a} if "pressure" not in wanted else {}
    found = dpd.design(**{n: getattr(told, n).value for n in wanted}, kT=kT, **how)
    for branch in found:
        for name in wanted:
            has(branch, name, getattr(told, name).value)
    nearest = min(found, key=lambda branch: abs(branch.gamma.value / gamma - 1))
    assert nearest.gamma.value == pytest.approx(gamma, rel=1e-3)
    assert nearest.repulsion.value == pytest.approx(a, rel=1e-3)


def test_two_gammas_of_one_viscosity():
    found = dpd.design(viscosity=0.9, repulsion=2.5, density=3.0, kT=0.1)
    lowest = dpd.design(viscosity=0.9, repulsion=2.5, density=3.0, kT=0.1)
    assert len(found) == len(lowest) >= 1
    ideal = dpd.design(viscosity=1.2, repulsion=0.0)
    assert len(ideal) == 2 and ideal[0].gamma.value > 10 > ideal[1].gamma.value
    for branch in ideal:
        has(branch, "viscosity", 1.2)


def test_errors_are_those_of_the_value_over_the_slope():
    branch = dpd.design(viscosity=1.1, kT=0.1, repulsion=2.5)[0]
    told = branch.properties
    slope = told.slopes["viscosity"]["gamma"].value
    relative = told.viscosity.error / told.viscosity.value
    assert branch.gamma.error / branch.gamma.value == pytest.approx(relative / slope, rel=1e-3)
    assert branch.repulsion.error == 0.0


@pytest.mark.parametrize(
    "asked, told",
    [
        (dict(viscosity=1e-3), "viscosity goes from"),
        (dict(viscosity=50.0), "viscosity goes from"),
        (dict(pressure=1.0), "pressure goes from"),
        (dict(viscosity=0.9, diffusion=5.0), "where the rest is as wanted"),
        (dict(viscosity=0.9, schmidt=400.0, exponent=2.0), "schmidt goes from"),
    ],
    ids=str,
)
def test_what_cannot_be_is_told_with_what_can(asked, told):
    with pytest.raises(dpd.TargetError, match=told):
        dpd.design(**asked)


def test_ends_that_are_told_can_be_reached():
    with pytest.raises(dpd.TargetError) as caught:
        dpd.design(viscosity=50.0, repulsion=10.0)
    high = float(str(caught.value).split(" to ")[1].split(";")[0])
    has(dpd.design(viscosity=0.999 * high, repulsion=10.0)[0], "viscosity", 0.999 * high)


@pytest.mark.parametrize(
    "asked, told",
    [
        ({}, "nothing is wanted"),
        (dict(viscosity=-1.0), "viscosity"),
        (dict(viscosity=1.0, gamma=4.5, exponent=1.0, repulsion=25.0), "nothing is left"),
        (dict(pressure=23.6, repulsion=25.0), "nothing is left that pressure"),
        (dict(viscosity=1.0, density=20.0), "density r_c\\^3 is 20"),
        (dict(viscosity=1.0, repulsion=2500.0), "a r_c/kT is 2500"),
        (dict(viscosity=1.0, diffusion=0.3, find_time=True), "give units too"),
    ],
    ids=str,
)
def test_what_does_not_go_together_is_refused(asked, told):
    with pytest.raises(ValueError, match=told):
        dpd.design(**asked)


def test_in_si_units_it_is_the_same_fluid():
    units = dpd.water_units("viscosity_energy", viscosity=0.86)
    plain = dpd.design(viscosity=1.1, kT=1.0)
    si = dpd.design(viscosity=units.to_si(1.1, "viscosity"), units=units)
    for one, other in itertools.zip_longest(plain, si):
        assert one.gamma.value == pytest.approx(other.gamma.value)
    assert "Pa s" in str(si) and si[0].units == units and plain[0].units is None


def test_a_unit_of_time_makes_viscosity_and_diffusion_right():
    units = dpd.water_units(molecules=1.0, temperature=298.0)
    found = dpd.design(viscosity=0.89e-3, diffusion=2.3e-9, units=units, find_time=True)
    for branch in found:
        told, own = branch.properties, branch.units
        assert own.to_si(told.viscosity.value, "viscosity") == pytest.approx(0.89e-3)
        assert own.to_si(told.diffusion.value, "diffusion") == pytest.approx(2.3e-9)
        assert own.length == units.length and own.energy == pytest.approx(units.energy)
        assert branch.repulsion.error > 0 == branch.gamma.error
    with pytest.raises(ValueError, match="a viscosity and a diffusion"):
        dpd.design(viscosity=0.89e-3, units=units, find_time=True)


def test_what_comes_back_runs_and_prints():
    found = dpd.design(viscosity=1.2, repulsion=0.0)
    json.dumps(found.told())
    assert "2 fluids of viscosity 1.2" in str(found) and "<table" in found._repr_html_()
    assert set(QUANTITIES) <= set(found.told()["branches"][0])
    branch = found[1]
    assert branch.dt == pytest.approx(
        dpd.suggest_dt(branch.fluid, branch.density, integrator=branch.integrator)
    )
