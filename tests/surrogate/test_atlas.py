"""The atlas: exact scaling, what follows from what, slopes, published pressures, refusals."""

import math

import jax
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.surrogate import reduced
from dpdjax.surrogate.atlas import AXES, NAMES, QUANTITIES, Table, features, ranges
from dpdjax.surrogate.foresight import foretold
from dpdjax.surrogate.reduced import Reduced

STATES = np.array([[3.0, 25.0, 4.5, 2.0], [5.0, 5.0, 80.0, 2.0], [2.6, 90.0, 2.0, 2.0]])


def fluid_of(a=25.0, gamma=4.5, s=2.0, kT=1.0, mass=1.0, r_c=1.0):
    how = {} if s == 2.0 else {"s": s}
    law = dpd.laws.power_drag if how else dpd.central_drag
    repulsion = dpd.term(dpd.soft_repulsion, a=a, r_c=r_c)
    return dpd.fluid([repulsion], [dpd.term(law, gamma=gamma, r_c=r_c, **how)], kT=kT, mass=mass)


def test_scaling_is_exact():
    kT, mass, r_c = 0.3, 2.0, 1.7
    time = r_c * math.sqrt(mass / kT)
    own = fluid_of(25.0 * kT / r_c, 4.5 * mass / time, 2.0, kT, mass, r_c)
    here, thermal = dpd.atlas(own, 3.0 / r_c**3), dpd.atlas(fluid_of(), 3.0)
    scales = {
        "viscosity": mass / (r_c * time),
        "diffusion": r_c**2 / time,
        "schmidt": 1.0,
        "pressure": kT / r_c**3,
        "compressibility": r_c**3 / kT,
    }
    for name, scale in scales.items():
        one, other = getattr(here, name), getattr(thermal, name)
        assert one.value == pytest.approx(scale * other.value, rel=1e-6)
        assert one.error == pytest.approx(scale * other.error, rel=1e-6)
    assert here.numbers == pytest.approx(thermal.numbers)


@pytest.mark.parametrize("numbers", STATES, ids=str)
def test_what_follows_from_what(numbers):
    density, a, gamma, s = numbers
    told = dpd.atlas(fluid_of(a, gamma, s), density)
    assert told.schmidt.value == pytest.approx(
        told.viscosity.value / (density * told.diffusion.value)
    )
    pressure = lambda rho: dpd.atlas(fluid_of(a, gamma, s), rho).pressure.value
    rise = (pressure(density * 1.001) - pressure(density * 0.999)) / (0.002 * density)
    assert told.inverse_compressibility.value == pytest.approx(rise, rel=1e-4)
    assert told.compressibility.value == pytest.approx(1 / (density * rise), rel=1e-4)


@pytest.mark.parametrize("numbers", STATES, ids=str)
@pytest.mark.parametrize("k", range(4), ids=AXES)
def test_slopes_are_those_of_the_values(numbers, k):
    step = 1e-3
    factors = np.exp(step * np.outer([1, -1], np.eye(4)[k]))
    # Beyond exponent 2 there is no atlas for users; the processes go on.
    up, down = (Table.shipped().values(numbers[None] * f) for f in factors)
    slopes = Table.shipped().slopes(numbers[None])
    for name in slopes:
        slope = math.log(up[name][0] / down[name][0]) / (2 * step)
        assert slopes[name][AXES[k]].value == pytest.approx(slope, abs=1e-3), name


def test_pressure_of_water_is_that_of_monte_carlo():
    """P. Warren's 23.65(2), who made no steps in time."""
    told = dpd.atlas(fluid_of(), 3.0).pressure
    assert told.deviation(dpd.Estimate(23.65, 0.02)) < 3


def test_repulsive_pressure_rises_to_the_mean_field():
    """``pi/30 a density^2``, which holds without correlations: the denser, the fewer there are."""
    densities = np.linspace(*ranges()[NAMES[0]], 12)
    told = np.array([dpd.atlas(fluid_of(), rho).pressure.value for rho in densities])
    share = (told - densities) / (math.pi / 30 * 25.0 * densities**2)
    assert np.all(np.diff(share) > 0) and 0.8 < share[0] < share[-1] < 1


def test_an_ideal_gas_has_its_pressure():
    told = dpd.atlas(dpd.fluid([], [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)], kT=1.0), 4.0)
    assert told.pressure.value == pytest.approx(4.0, rel=1e-6)
    assert told.inverse_compressibility.value == pytest.approx(1.0, rel=1e-3)


def test_viscosity_of_water_is_what_runs_measured():
    """Of ``tests/physics/RESULTS.md``; the atlas knows nothing of these runs."""
    told = dpd.atlas(fluid_of(), 3.0)
    assert told.viscosity.deviation(dpd.Estimate(0.860, 0.007)) < 3
    strong = dpd.atlas(fluid_of(2.5, 49.65, kT=0.1), 3.0)
    assert strong.viscosity.deviation(dpd.Estimate(1.1, 0.005)) < 3


def test_errors_grow_away_from_what_was_measured():
    table = Table.shipped()
    near, far = table.states[:1], table.states[:1] * [0.7, 1.0, 3.0, 1.0]
    assert table.viscosity.at(features(far))[1] > 2 * table.viscosity.at(features(near))[1]


def test_table_holds_what_it_says():
    table = Table.shipped()
    assert len(table.states) >= 150 and np.all(np.isfinite(table.states))
    assert {"date", "dpdjax", "jax", "made_by"} <= set(table.provenance)
    values = table.at(table.states)
    for name in ("viscosity", "diffusion"):
        assert np.median(values[name][1]) < 0.015


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_all_of_it_is_finite(quantity):
    low, high = Table.shipped().bounds
    u = np.random.default_rng(0).uniform(size=(200, 4))
    numbers = low + (high - low) * u
    numbers[:, 2] *= reduced.moment(2.0, 3) / np.array(
        [reduced.moment(s, 3) for s in numbers[:, 3]]
    )
    value, error = Table.shipped().at(numbers)[quantity]
    assert np.all(value > 0) and np.all(error >= 0)


@pytest.mark.parametrize(
    "change, named",
    [
        (dict(density=9.0), "density r_c^3 is 9"),
        (dict(density=1.0), "density r_c^3 is 1"),
        (dict(a=120.0), "a r_c/kT is 120"),
        (dict(gamma=0.5), "gamma r_c/sqrt(m kT) is 0.5"),
        (dict(gamma=500.0), "gamma r_c/sqrt(m kT) is 500"),
        (dict(s=3.0), "exponent is 3"),
        (dict(a=50.0, kT=0.1), "a r_c/kT is 500"),
    ],
    ids=str,
)
def test_a_state_outside_is_named(change, named):
    density = change.pop("density", 3.0)
    with pytest.raises(ValueError, match="outside of the atlas") as caught:
        dpd.atlas(fluid_of(**change), density)
    assert named in str(caught.value)


def test_of_other_fluids_it_says_what_it_is_of():
    two = dpd.fluid(
        [dpd.term(dpd.soft_repulsion, a=[[25.0, 40.0], [40.0, 25.0]], r_c=1.0)],
        [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)],
        kT=1.0,
        mass=[1.0, 1.0],
    )
    with pytest.raises(ValueError, match="one species"):
        dpd.atlas(two, 3.0)
    other = dpd.fluid(
        [dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)],
        [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.2)],
        kT=1.0,
    )
    with pytest.raises(ValueError, match="reaches to 1"):
        dpd.atlas(other, 3.0)


DRAG, SOFT = dpd.central_drag, dpd.soft_repulsion


@pytest.mark.parametrize(
    "changed, told",
    [
        (dict(drag=[dpd.term(DRAG, gamma=4.5, r_c=1.0, projector="full")]), "projector='full'"),
        (dict(conservative=[dpd.term(SOFT, a=25.0, r_c=1.0, reach=0.5)]), "reach=0.5"),
        (dict(bonds=dpd.term(dpd.laws.harmonic_bond, k=100.0, r0=0.5)), "has bonds"),
        (dict(drag=[dpd.term(dpd.laws.transverse_drag, gamma_t=4.5, r_c=1.0)]), "transverse_drag"),
    ],
    ids=["across", "cut", "bonds", "transverse"],
)
def test_a_fluid_that_only_looks_like_it_is_refused(changed, told):
    terms = dict(
        conservative=[dpd.term(SOFT, a=25.0, r_c=1.0)],
        drag=[dpd.term(DRAG, gamma=4.5, r_c=1.0)],
    )
    other = dpd.fluid(**(terms | changed), kT=1.0)
    with pytest.raises(ValueError, match=told):
        dpd.atlas(other, 3.0)
    assert foretold(other, 3.0, "viscosity") is None


def test_no_fluid_and_no_number():
    with pytest.raises(TypeError, match="the fluid is a float"):
        dpd.atlas(3.0, 3.0)
    with pytest.raises(TypeError, match="is being traced"):
        jax.jit(lambda gamma: dpd.atlas(dpd.water(gamma=gamma), 3.0).viscosity.value)(4.5)


def test_ranges_of_frictions_follow_the_exponent():
    """Those that damp alike: of a smaller exponent a smaller one."""
    low, high = ranges(2.0)[NAMES[2]]
    lower, higher = ranges(0.5)[NAMES[2]]
    damping = lambda gamma, s: reduced.damping(np.array([[3.0, 0.0, gamma, s]]))[0]
    assert damping(lower, 0.5) == pytest.approx(damping(low, 2.0))
    assert damping(higher, 0.5) == pytest.approx(damping(high, 2.0))


def test_it_prints_and_draws_itself():
    told = dpd.atlas(fluid_of(), 3.0)
    assert str(told).startswith("viscosity ") and "<table" in told._repr_html_()
    ax = dpd.plot_atlas(fluid_of(), 3.0, label="a 25")
    line = ax.lines[0]
    gamma, viscosity = line.get_xdata(), line.get_ydata()
    at = np.interp(math.log(4.5), np.log(gamma), np.log(viscosity))
    assert math.exp(at) == pytest.approx(told.viscosity.value, rel=1e-3)
    with pytest.raises(ValueError, match="quantity"):
        dpd.plot_atlas(fluid_of(), 3.0, "colour")


def test_numbers_of_a_state_come_back():
    state = Reduced.of(fluid_of(7.0, 12.0, 0.5, 0.4, 2.0, 1.3), 2.0)
    again = Reduced.of(state.fluid, 2.0)
    assert again.numbers == pytest.approx(state.numbers)
