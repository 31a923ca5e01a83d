"""Designs: truths come back, all branches, ranges of what cannot be, SI units."""

import dataclasses
import itertools
import json

import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.surrogate.atlas import NAMES, QUANTITIES, Table, ranges


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
        (
            dict(viscosity=0.9, diffusion=5.0),
            "give another exponent or density|diffusion goes from",
        ),
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
        (dict(viscosity=1.0, diffusion=0.3, schmidt=1.1), "any two of them make the third"),
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


def test_units_that_cannot_be():
    with pytest.raises(TypeError, match="units is 'SI'"):
        dpd.design(viscosity=1.0, units="SI")
    odd = dpd.water_units("viscosity_mass")
    with pytest.raises(ValueError, match="takes the energy of units for that of heat"):
        dpd.design(viscosity=0.9e-3, diffusion=2e-9, units=odd, find_time=True)


def test_the_same_asked_in_three_ways_has_the_same_errors():
    """Two of viscosity, diffusion and Schmidt number tell the third, errors and all."""
    told = dpd.atlas(dpd.water(a=40.0, gamma=30.0), 3.0)
    asked = {name: getattr(told, name).value for name in ("viscosity", "diffusion", "schmidt")}
    pairs = itertools.combinations(asked, 2)
    found = [
        min(
            dpd.design(**{n: asked[n] for n in pair}, exponent=2.0),
            key=lambda branch: abs(branch.gamma.value - 30.0),
        )
        for pair in pairs
    ]
    for one in found[1:]:
        for name in ("gamma", "repulsion"):
            value, other = getattr(one, name), getattr(found[0], name)
            assert value.value == pytest.approx(other.value, rel=1e-4)
            assert value.error == pytest.approx(other.error, rel=0.01)


def wide(monkeypatch):
    """The atlas as it would be with exponents from 0.5 to 2, by theory alone."""
    table = Table.shipped()
    states = table.states.copy()
    states[::2, 3] = 0.5
    wider = dataclasses.replace(table, states=states)
    monkeypatch.setattr(Table, "shipped", classmethod(lambda cls: wider))


def test_what_is_found_with_an_exponent_is_inside(monkeypatch):
    wide(monkeypatch)
    low, high = ranges(1.0)[NAMES[2]]
    for viscosity in (1.5, 3.0, 6.0, 12.0):
        for gamma in (0.9 * high, 1.1 * low):
            try:
                found = dpd.design(viscosity=viscosity, gamma=gamma)
            except dpd.TargetError:
                continue
            for branch in found:
                has_same = dpd.atlas(branch.fluid, 3.0).viscosity.value
                assert has_same == pytest.approx(viscosity, rel=1e-5)
    with pytest.raises(ValueError, match="which it has at no exponent"):
        dpd.design(viscosity=3.0, gamma=1e5)


def test_errors_of_gamma_and_exponent_together(monkeypatch):
    """By a Jacobian of its own, in gamma and the exponent."""
    wide(monkeypatch)
    asked = dpd.atlas(dpd.fluid(
        [dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)],
        [dpd.term(dpd.laws.power_drag, gamma=20.0, s=1.2, r_c=1.0)], kT=1.0), 3.0)  # fmt: skip
    wanted = {name: getattr(asked, name).value for name in ("viscosity", "diffusion")}
    found = dpd.design(**wanted)
    branch = min(found, key=lambda branch: abs(branch.gamma.value - 20.0))
    numbers = np.array([[3.0, 25.0, branch.gamma.value, branch.exponent.value]])
    step = 1e-4
    logarithms = lambda factors: np.log(
        [Table.shipped().values(numbers * factors)[name][0] for name in wanted]
    )
    ends = [[np.exp(step * sign * np.eye(4)[k]) for sign in (1, -1)] for k in (2, 3)]
    slopes = np.stack([(logarithms(up) - logarithms(down)) / (2 * step) for up, down in ends], 1)
    errors = [getattr(asked, name).error / getattr(asked, name).value for name in wanted]
    own = np.sqrt(np.linalg.inv(slopes) ** 2 @ np.array(errors) ** 2)
    for name, error in zip(("gamma", "exponent"), own):
        value = getattr(branch, name)
        assert value.error == pytest.approx(error * value.value, rel=0.01)
