"""Advice on time steps and skins, and cautions: against rates written out by hand."""

import dataclasses
import math
import sys
import warnings
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine.refusals import check_dt
from dpdjax.engine.system import System
from dpdjax.host.cautions import cautions as cautions_of
from dpdjax.model import advice, rates

DENSITY = np.array([3.0, 0.05])
"""Solvent beads and colloids per volume."""
DRAG, REPULSION, LUBRICATION, CONTACT = range(4)
"""What limits the time step, in the order of ``dt_limits``."""


def limits(density=DENSITY, **numbers):
    return [limit for _, limit in advice.dt_limits(dpd.colloid_fluid(**numbers), density)]


def spread_evenly(fluid, density=DENSITY, side=30.0):
    """What the checks read of a state of this density."""
    counts = np.round(density * side**3).astype(int)
    box = SimpleNamespace(lengths=np.full(3, side))
    return SimpleNamespace(
        box=box, species=np.repeat(np.arange(2), counts), size=np.ones(sum(counts))
    )


@pytest.mark.parametrize("eta_0, rate", [(0.3, 225.0), (1.1, 825.0), (3.0, 2250.0), (10.0, 7500.0)])
@pytest.mark.parametrize("noise", ["exact", "literal"])
def test_touching_colloids_are_damped_at_the_rates_of_the_page(eta_0, rate, noise):
    """R 1, delta 0.001, m_c 12.57; a colloid with six close neighbours feels three times the rate
    of a pair."""
    assert limits(eta_0=eta_0, gamma=0.0, noise=noise)[LUBRICATION] == pytest.approx(
        1 / (3 * rate), rel=1e-6
    )


def test_drag_of_colloids_adds_to_lubrication():
    rates = [1 / limits(eta_0=0.3, gamma=gamma)[LUBRICATION] for gamma in (0.0, 45.0)]
    assert rates[1] - rates[0] == pytest.approx(3 * 45.0 / (2 * math.pi), rel=1e-4)


def test_friction_without_a_limit_at_contact_counts_from_where_it_is_sampled():
    bare = dpd.term(lambda h, *, q: q / h, q=1.0, reach=1.0)
    fluid = dpd.fluid(
        interactions=[dpd.interaction((0, 0), drag=bare)], kT=1.0, mass=2.0, radius=(1.0,)
    )
    assert 100 < 1 / advice.dt_limits(fluid, 0.1)[LUBRICATION][1] / 3 < 1e4


def test_touching_colloids_oscillate_as_fast_as_their_contact_is_stiff():
    """``sqrt(3 f / (Delta mu))`` at contact, which 2.5 kT reach."""
    assert limits()[CONTACT] == pytest.approx(
        math.sqrt(1e-3 * 2 * math.pi / (3 * 1000.0)), rel=0.005
    )


def test_solvent_is_damped_by_solvent_and_colloids():
    fluid, r = dpd.colloid_fluid(gamma=45.0), np.linspace(1.0, 2 ** (1 / 3), 10_001)
    solvent = 3.0 * 4 * np.pi * 45.0 / 30
    weight = ((2 ** (1 / 3) - r) / (2 ** (1 / 3) - 1)) ** 2
    colloids = 0.05 * np.trapezoid(4 * np.pi * r**2 * 45.0 * weight, r)
    assert rates.damping_rate(fluid, DENSITY) == pytest.approx((solvent + colloids) / 3, rel=1e-4)
    assert rates.damping_rate(fluid, 3.0) == pytest.approx(solvent / 3, rel=1e-4)
    assert limits(gamma=45.0)[DRAG] == pytest.approx(1.5 / (solvent + colloids), rel=1e-4)


def test_suggested_dt_suits_what_is_fastest(water):
    suggested = lambda density=DENSITY, **numbers: advice.suggest_dt(
        dpd.colloid_fluid(**numbers), density
    )
    for numbers, what in (({"eta_0": 10.0}, LUBRICATION), ({"modulus": 1e5}, CONTACT)):
        assert suggested(**numbers) == pytest.approx(0.7 * limits(**numbers)[what])
    rubbing = dict(eta_0=0.0, modulus=1.0, Delta=0.1, gamma=450.0, kT=1e-3)
    slower = limits(**rubbing)[DRAG] / limits(density=3.0, **rubbing)[DRAG]
    assert (
        suggested(**rubbing) / suggested(3.0, **rubbing) == pytest.approx(slower) and slower < 0.99
    )
    assert suggested(3.0, **rubbing) == suggested([3.0, 0.0], **rubbing), (
        "one number is that of the solvent"
    )
    assert dpd.suggest_dt(water, 3.0) == dpd.suggest_dt(water, np.array([3.0]))


LIMITED = {
    "drag": dict(gamma=4500.0, eta_0=0.0, kT=1e-3),
    "conservative force": dict(modulus=1.0, Delta=0.1, eta_0=0.0),
    "lubrication": dict(eta_0=10.0),
    "contact force": dict(modulus=1e5),
}


@pytest.mark.parametrize("what", LIMITED)
def test_dt_above_a_limit_is_refused_by_name_and_the_suggested_one_passes(what):
    fluid = dpd.colloid_fluid(**LIMITED[what])
    state = spread_evenly(fluid)
    least = min(limit for _, limit in advice.dt_limits(fluid, DENSITY))
    check_dt(System.of(fluid, 0.99 * least), state)
    with pytest.raises(
        ValueError, match=f"dt .* is too large for the {what}: .* use dt = "
    ) as refused:
        check_dt(System.of(fluid, 1.01 * least), state)
    passes = float(str(refused.value).split("use dt = ")[1].split()[0])
    check_dt(System.of(fluid, passes), state)
    assert passes == pytest.approx(advice.suggest_dt(fluid, DENSITY), rel=0.05)


def test_a_scan_is_limited_by_its_extreme():
    scan = dpd.colloid_fluid().set(eta_0=jnp.array([0.3, 10.0]))
    assert (
        advice.dt_limits(scan, DENSITY)[LUBRICATION]
        == advice.dt_limits(dpd.colloid_fluid(eta_0=10.0), DENSITY)[LUBRICATION]
    )


def test_each_list_has_a_skin_that_suits_its_beads():
    fluid, counts = dpd.colloid_fluid(), (81_000, 1350)
    skins = advice.suggest_skins(fluid, 0.01, counts, 30.0**3)
    assert len(skins) == 3
    assert skins[1] > advice.suggest_skin(fluid, 0.01, 1), (
        "building the list of many and few costs sorting the many"
    )
    assert skins[1] < advice.suggest_skins(fluid, 0.01, (81_000, 10), 30.0**3)[1]
    wider = advice.suggest_skins(fluid, 0.04, counts, 30.0**3)
    assert all(a < b for a, b in zip(skins, wider)), "fast beads leave their lists sooner"


# Cautions.


def cautions(fluid, side=30.0, dt=1e-3, every=100):
    return cautions_of(fluid, spread_evenly(fluid, side=side), dt, dpd.Plan(2, every))


def test_no_caution_where_all_is_well_or_no_colloid_is(water):
    assert cautions(dpd.colloid_fluid(D0=1.2)) == []
    assert cautions(water, side=5.0, dt=0.01, every=10**6) == []


def test_caution_about_a_small_box():
    (said,) = cautions(dpd.colloid_fluid(), side=29.0)
    assert said.startswith("box side 29 is small") and "use 30 or more" in said


def test_caution_about_a_morse_potential_cut_short():
    short = dpd.term(dpd.laws.morse, D0=1.2, kappa=30.0, r0=0.1, reach=0.25)
    (said,) = cautions(dpd.colloid_fluid(attraction=short))
    assert (
        "cut off at h = 0.25" in said
        and "short of the reach that its law declares: give it a reach of 0.3" in said
    )
    (said,) = cautions(dpd.colloid_fluid(D0=1.2, kappa=4.0))
    assert "cut off at h = 1," in said and "reach of 1.5" in said
    for attraction in (
        dpd.term(dpd.laws.morse, D0=1.2, kappa=30.0, r0=0.1),
        dataclasses.replace(short, cut=0.3),
    ):
        assert cautions(dpd.colloid_fluid(attraction=attraction)) == []
    assert cautions(dpd.colloid_fluid().set(kappa=jnp.array([4.0, 30.0]))), "the widest of a scan"


def test_caution_about_frames_further_apart_than_the_diffusion_time():
    """tau is 56.55 for kT 0.1, eta_0 0.3 and R 1."""
    (said,) = cautions(dpd.colloid_fluid(), every=60_000)
    assert said.startswith(
        "frames are 60 apart, more than the diffusion time 56.55: use Plan(every=56548)"
    )
    assert cautions(dpd.colloid_fluid(), every=56_548) == []
    assert cautions(dpd.colloid_fluid(eta_0=0.0), every=10**9) == [], (
        "no viscosity, no diffusion time"
    )


def test_cautions_of_fluids_without_a_diffusion_time():
    """A temperature of zero, and spheres that are not the last species."""
    squeeze = dpd.term(dpd.laws.squeezing_lubrication, eta_0=0.3, delta=1e-3, reach=1.0)
    pairs = [
        dpd.interaction((0, 0), drag=squeeze),
        dpd.interaction((1, 1), dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)),
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (
            cautions(dpd.fluid(interactions=pairs, kT=1.0, radius=(1.0, None)), every=10**6) == []
        )
        assert cautions(dpd.colloid_fluid().set(kT=0.0), every=10**6) == []


# The same through the doors.


@pytest.fixture(scope="module")
def made(key):
    return dpd.suspension(
        key, phi=0.1, box=7.0, density=1.0, report=None, sheared=False, eta_0=1.1, gamma=45.0
    )


def test_default_dt_of_a_suspension_passes(made, key):
    """For the integrator it is of, and for no other; the refusal names both cures."""
    check_dt(System.of(made.fluid, made.dt, None, made.integrator), made.state)
    cures = r"too large for the lubrication.* use dt = .* or integrator=dpd.integrators.Multiple"
    with pytest.raises(ValueError, match=cures):
        dpd.simulate(made.fluid, made.state, key, made.dt, dpd.Plan(1))
    plain = dpd.suggest_dt(made.fluid, [0.9, 0.024])
    check_dt(System.of(made.fluid, plain), made.state)
    with pytest.raises(ValueError, match="too large for the lubrication.* use dt = "):
        dpd.simulate(made.fluid, made.state, key, plain / 0.69, dpd.Plan(1))


def test_the_integrator_that_covers_most_time(made):
    """Of a suspension, of strong drag without repulsion, of water; none that cannot move it."""
    fluid, density = made.fluid, [0.9, 0.024]
    cheapest, suggested = dpd.integrators.cheapest, dpd.suggest_dt
    how = cheapest(fluid, density)
    assert how == dpd.integrators.MultipleTimeStep.suited_to(fluid, density)
    # No fewer short steps would do, and more would not help.
    step = lambda inner: suggested(fluid, density, integrator=dataclasses.replace(how, inner=inner))
    assert step(how.inner - 1) < step(how.inner) == step(64)
    gas = dpd.fluid([], [dpd.term(dpd.central_drag, gamma=90.0, r_c=1.0)], kT=1.0)
    assert isinstance(cheapest(gas, 3.0), dpd.integrators.ImplicitDrag)
    assert isinstance(cheapest(dpd.water(), 3.0), dpd.integrators.VelocityVerlet)
    (among,) = gas.interactions
    loud = dpd.term(dpd.central_drag, gamma=90.0, r_c=1.0)
    literal = dpd.fluid(interactions=[dpd.interaction((0, 0), [], among.drag, loud)], kT=1.0)
    assert isinstance(cheapest(literal, 3.0), dpd.integrators.VelocityVerlet)
    # Nothing limits the implicit step of beads at rest, which is no reason to refuse them.
    assert isinstance(cheapest(gas.set(kT=0.0), 3.0), dpd.integrators.VelocityVerlet)


def test_a_run_warns_and_goes_on(made, key, monkeypatch):
    began = []

    def replayed(*_):
        began.append(None)
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules[dpd.stream.__module__], "replayed", replayed)
    with pytest.warns(UserWarning, match="box side 7 is small") as seen:
        dpd.run(
            made.fluid,
            made.state,
            key,
            made.dt,
            dpd.Plan(2, 10),
            integrator=made.integrator,
            progress=False,
        )
    assert began and len(seen) == 1 and seen[0].filename == __file__


def test_the_smallest_colloid_beside_the_largest_limits_the_step():
    """Rates of lubrication by hand: ``6 zeta / m`` of the small one, zeta as the square of the mean
    radius."""
    fluid = dpd.colloid_fluid(gamma=0.0)
    limit = lambda *sizes: dict(
        (name.split(":")[0], dt) for name, dt in advice.dt_limits(fluid, [2.4, 0.05], sizes)
    )
    for small, large in ((1.0, 1.0), (0.3, 1.0), (0.5, 2.0)):
        rate = lambda other: (
            6 * 1.5 * math.pi * 0.3 / 1e-3 * ((small + other) / 2) ** 2 / (4 * math.pi * small**3)
        )
        assert limit(small, large)["lubrication"] == pytest.approx(
            1 / max(rate(small), rate(large)), rel=1e-5
        )
    assert limit(0.5, 1.0)["contact force"] == pytest.approx(
        0.5**1.5 * limit(1.0, 1.0)["contact force"]
    )
    assert dpd.suggest_dt(fluid, [2.4, 0.05], (0.3, 1.0)) < dpd.suggest_dt(fluid, [2.4, 0.05])


@pytest.mark.parametrize("name", ["delta", "Delta"])
def test_a_scan_is_judged_by_the_member_that_needs_the_shortest_step(name):
    fluid = dpd.colloid_fluid()
    least = lambda value: min(
        dt for _, dt in advice.dt_limits(fluid.set(**{name: value}), [2.4, 0.05])
    )
    assert least(jnp.array([1e-4, 1e-3])) == pytest.approx(least(1e-4))


def test_deep_overlap_is_no_well():
    """Laws of two spheres are looked at outside contact alone: far inside, a Yukawa repulsion is an
    attraction."""
    limit = lambda law: advice.dt_limits(dpd.colloid_fluid(attraction=law), (2.4, 0.05))[3][1]
    hard = limit(dpd.term(dpd.laws.yukawa, epsilon=0.0, kappa=8.0))
    assert limit(dpd.term(dpd.laws.yukawa, epsilon=2.0, kappa=2.0, reach=1.0)) <= hard < 0.01
    assert limit(dpd.term(dpd.laws.asakura_oosawa, phi_p=0.3, r_g=1.2)) == hard
