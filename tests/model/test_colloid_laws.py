"""Laws of colloids: each against its formula, and two colloids alone in the engine."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine.state import assemble
from dpdjax.pairs import box as boxes
from dpdjax.pairs.forces import pair_force
from dpdjax.pairs.neighbours import plan_grid

EQUAL = {"R_i": 1.0, "R_j": 1.0}
BEAD = {"R_i": 0.0, "R_j": 1.5}
H = np.linspace(0.01, 0.9, 40)
SIDE, DT = 8.0, 1e-3


def force(law, **numbers):
    """Minus the slope of a potential, at many gaps."""
    return jax.vmap(jax.grad(lambda h: -law(h, **numbers)))


def test_balanced_cut_makes_shells_of_equal_volume():
    for R in (0.5, 1.0, 3.0):
        cut = dpd.laws.balanced_cut(r_c=1.2, R_i=0.0, R_j=R)
        assert (R + cut) ** 3 - R**3 == pytest.approx(1.2**3)
    assert dpd.laws.balanced_cut(r_c=1.0, R_i=0.0, R_j=1.0) == pytest.approx(2 ** (1 / 3) - 1)


def test_solvent_is_pushed_out_of_colloids_and_rubbed():
    cut = (1 + 1.5**3) ** (1 / 3) - 1.5
    h = jnp.asarray(np.linspace(-0.5, 0.9, 15) * cut)
    push = force(dpd.laws.balanced_repulsion, strength=2.5, r_c=1.0, **BEAD)(h)
    np.testing.assert_allclose(push, 2.5 / cut * (1 - h / cut), rtol=1e-12)
    assert np.all(np.diff(push) < 0), "goes on growing inside"
    np.testing.assert_allclose(
        dpd.laws.balanced_drag(h, gamma=4.5, r_c=1.0, **BEAD), 4.5 * (1 - h / cut) ** 2, rtol=1e-12
    )


def test_strength_of_the_repulsion_in_the_page_and_in_the_scripts():
    """kT 0.1, R 1: 9.62 by the cut from the surface, 1.98 by that from the centre."""
    at_surface = lambda law: float(
        force(law, strength=2.5, r_c=1.0, R_i=0.0, R_j=1.0)(jnp.zeros(1))[0]
    )
    assert at_surface(dpd.laws.balanced_repulsion) == pytest.approx(9.62, abs=0.005)
    assert at_surface(dpd.laws.scripts_repulsion) == pytest.approx(1.98, abs=0.005)
    assert at_surface(dpd.laws.scripts_repulsion) == pytest.approx(2.5 / 2 ** (1 / 3))


CONTACT = {"f": 1000.0, "Delta": 1e-3, "r_c": 1.2}


def test_contact_has_its_two_branches():
    push = force(dpd.laws.contact, **CONTACT)
    inside, outside = np.linspace(-0.3, 0.0, 7), np.linspace(1e-5, 9.9e-4, 9)
    np.testing.assert_allclose(push(jnp.asarray(inside)), 1000 * (1 - inside / 1.2), rtol=1e-12)
    np.testing.assert_allclose(
        push(jnp.asarray(outside)), 1000 * (1 - outside / 1e-3) ** 3, rtol=1e-9
    )


def test_contact_is_continuous_where_its_branches_meet():
    near = 1e-10
    for law in (lambda h: dpd.laws.contact(h, **CONTACT), force(dpd.laws.contact, **CONTACT)):
        below, above = law(jnp.array([-near])), law(jnp.array([near]))
        np.testing.assert_allclose(below, above, rtol=1e-6)
    end = jnp.array([1e-3])
    assert (
        dpd.laws.contact(end, **CONTACT)[0] == 0 and force(dpd.laws.contact, **CONTACT)(end)[0] == 0
    )


def test_scaled_contact_goes_as_the_cube_of_the_mean_radius():
    h = jnp.array([-0.1, 5e-4])
    ratio = dpd.laws.scaled_contact(h, **CONTACT, R_i=2.0, R_j=3.0) / dpd.laws.contact(h, **CONTACT)
    np.testing.assert_allclose(ratio, 2.5**3)
    assert jnp.array_equal(
        dpd.laws.scaled_contact(h, **CONTACT, **EQUAL), dpd.laws.contact(h, **CONTACT)
    )


def test_morse_has_its_depth_place_and_curvature():
    well = lambda h: dpd.laws.morse(h, D0=1.2, kappa=30.0, r0=0.05)
    assert well(0.05) == -1.2
    assert jax.grad(well)(0.05) == pytest.approx(0.0, abs=1e-12)
    assert jax.grad(jax.grad(well))(0.05) == pytest.approx(2 * 1.2 * 30**2)
    np.testing.assert_allclose(
        well(H), 1.2 * (np.exp(-60 * (H - 0.05)) - 2 * np.exp(-30 * (H - 0.05))), atol=1e-14
    )
    assert well(0.05 + 3 / 30) == pytest.approx(-0.1 * 1.2, rel=0.05), "a tenth is left at 3/kappa"
    _, reach = dpd.term(dpd.laws.morse, D0=1.2, kappa=30.0, r0=0.05).between()
    assert reach == pytest.approx(0.05 + 0.2)


def overlap(A, B, r):
    """Volume common to two spheres, by integration over discs across the line of centres."""
    x = np.linspace(-A, r + B, 400_001)
    disc = np.minimum(A**2 - x**2, B**2 - (r - x) ** 2)
    return np.trapezoid(np.pi * np.maximum(disc, 0.0), x)


@pytest.mark.parametrize("R_i, R_j", [(1.0, 1.0), (0.6, 1.7)], ids=["equal", "unequal"])
def test_depletion_is_osmotic_pressure_times_overlap(R_i, R_j):
    kT, phi_p, r_g = 0.3, 0.25, 0.2
    pressure = kT * phi_p / (4 / 3 * np.pi * r_g**3)
    for h in (0.0, 0.05, 0.2, 0.35):
        expected = -pressure * overlap(R_i + r_g, R_j + r_g, h + R_i + R_j)
        found = dpd.laws.asakura_oosawa(h, phi_p=phi_p, r_g=r_g, kT=kT, R_i=R_i, R_j=R_j)
        assert found == pytest.approx(expected, rel=1e-6)


def test_depletion_at_contact_and_at_its_end():
    depletion = lambda h: dpd.laws.asakura_oosawa(h, phi_p=0.25, r_g=0.2, kT=0.3, R_i=1.4, R_j=1.4)
    assert depletion(0.0) == pytest.approx(-0.3 * 0.25 * (1 + 1.5 * 1.4 / 0.2))
    assert depletion(0.4) == pytest.approx(0.0, abs=1e-12)
    assert jax.grad(depletion)(0.4) == pytest.approx(0.0, abs=1e-12)
    assert dpd.term(dpd.laws.asakura_oosawa, phi_p=0.25, r_g=0.2).between(kT=0.3)[
        1
    ] == pytest.approx(0.4)


def test_yukawa_is_screened():
    law = lambda h: dpd.laws.yukawa(h, epsilon=-0.7, kappa=5.0, R_i=0.6, R_j=1.7)
    np.testing.assert_allclose(law(H), -0.7 * 2.3 / (2.3 + H) * np.exp(-5 * H), rtol=1e-13)
    assert law(0.0) == -0.7
    assert dpd.term(dpd.laws.yukawa, epsilon=1.0, kappa=5.0).between()[1] == pytest.approx(1.6)


LUBRICATION = {"eta_0": 0.3, "delta": 1e-3}


def test_squeezing_goes_as_one_over_the_gap():
    squeeze = lambda h: dpd.laws.squeezing_lubrication(h, **LUBRICATION, R_i=1.4, R_j=1.4)
    np.testing.assert_allclose(squeeze(H), 3 * np.pi * 0.3 * 1.4**2 / (2 * H), rtol=1e-13)
    closest = float(squeeze(1e-3))
    assert closest == pytest.approx(3 * np.pi * 0.3 * 1.4**2 / 2e-3)
    assert all(squeeze(h) == closest for h in (-0.2, 0.0, 5e-4)), (
        "constant below delta, overlap included"
    )
    assert squeeze(1e-3 * (1 + 1e-9)) == pytest.approx(closest, rel=1e-8)


def test_lubrication_of_unequal_spheres():
    """The published form is 1.27 times too large at size ratio 1:2, 2.4 times at 1:4."""
    for R, ratio in ((1.0, 1.0), (2.0, 1.27), (4.0, 2.44)):
        both = [
            law(H, **LUBRICATION, R_i=1.0, R_j=R)
            for law in (dpd.laws.squeezing_lubrication, dpd.laws.unequal_lubrication)
        ]
        np.testing.assert_allclose(both[0] / both[1], ratio, atol=0.005)
    exact = dpd.laws.unequal_lubrication(H, **LUBRICATION, R_i=0.6, R_j=1.7)
    np.testing.assert_allclose(exact, 6 * np.pi * 0.3 * (0.6 * 1.7 / 2.3) ** 2 / H, rtol=1e-13)
    assert dpd.laws.unequal_lubrication(-0.1, **LUBRICATION, **EQUAL) == pytest.approx(
        3 * np.pi * 0.3 / 2e-3
    )


COLD = ((0.01, 0.98), (0.1, 0.85), (0.5, 0.46))
"""Gap, and T_pair over T of the noise as first published."""


@pytest.mark.parametrize("h, coldness", COLD)
def test_literal_noise_cools_close_pairs(h, coldness):
    numbers = dict(gamma=4.5, r_c=1.0, **LUBRICATION, **EQUAL)
    drag, noise = dpd.laws.literal_drag(h, **numbers), dpd.laws.literal_noise(h, **numbers)
    assert drag == pytest.approx(4.5 * (1 - h) ** 2 + 1.5 * np.pi * 0.3 / h)
    assert noise == pytest.approx((4.5 + 1.5 * np.pi * 0.3 / h) * (1 - h) ** 2)
    assert noise / drag == pytest.approx(coldness, abs=0.005)


def test_literal_drag_and_noise_end_in_overlap():
    numbers = dict(gamma=4.5, r_c=1.0, **LUBRICATION, **EQUAL)
    assert dpd.laws.literal_drag(-0.01, **numbers) == dpd.laws.literal_noise(0.0, **numbers) == 0


# Two colloids and nothing else.


@pytest.fixture(scope="module")
def colloids():
    """``colloids(fluid, h, speed=0, sizes=(1, 1))``: force on the first, away from the second, and
    sums over the pair."""
    box = boxes.box(SIDE)
    grid = plan_grid(2, box.lengths, 3.5, 0.1, sheared=False)
    start = jnp.array([[0.1, 1.0, 1.0], [SIDE - 1.9, 1.0, 1.0]])
    state = assemble(box, start, jnp.zeros((2, 3)), jnp.zeros(2, jnp.int32), (grid,))

    @jax.jit
    def at(fluid, gaps, speed, sizes):
        def one(h):
            r = h + jnp.sum(sizes)
            position = start.at[1, 0].set(SIDE + 0.1 - r)
            velocity = jnp.zeros((2, 3)).at[0, 0].set(speed)
            placed = dataclasses.replace(state, position=position, size=sizes)
            force, _, tally = pair_force(fluid, placed, velocity, 0.0, jax.random.key(0), DT, True)
            return force, tally

        return jax.vmap(one)(gaps)

    def check(fluid, h, speed=0.0, sizes=(1.0, 1.0)):
        force, tally = at(fluid, jnp.atleast_1d(jnp.asarray(h, float)), speed, jnp.asarray(sizes))
        assert jnp.array_equal(force[:, 0], -force[:, 1])
        assert not jnp.any(force[:, 0, 1:])
        return np.asarray(force[:, 0, 0]), tally

    return check


def alone(conservative=(), drag=(), random=None, kT=0.0):
    """A fluid of colloids of radius 1."""
    return dpd.fluid(
        interactions=[dpd.interaction((0, 0), conservative, drag, random)],
        kT=kT,
        mass=12.57,
        radius=(1.0,),
    )


def lubricated(**how):
    return alone(drag=dpd.term(dpd.laws.squeezing_lubrication, **LUBRICATION, reach=1.0), **how)


def test_approach_at_fixed_gap_is_resisted_by_lubrication(colloids):
    gaps = np.array([2e-3, 0.01, 0.1, 0.5, 0.99])
    force, tally = colloids(lubricated(), gaps, speed=-0.7)
    np.testing.assert_allclose(force / 0.7, 3 * np.pi * 0.3 / (2 * gaps), rtol=1e-11)
    np.testing.assert_allclose(tally.virial["drag"][:, 0, 0], force * (2 + gaps), rtol=1e-12)
    assert colloids(lubricated(), [1.001], speed=-0.7)[0] == 0, "ends at its reach"


def test_lubrication_of_each_pair_of_sizes(colloids):
    exact = alone(drag=dpd.term(dpd.laws.unequal_lubrication, **LUBRICATION, reach=1.0))
    published, right = (
        colloids(fluid, [0.05], 1.0, (0.5, 1.0))[0] for fluid in (lubricated(), exact)
    )
    assert right == pytest.approx(-6 * np.pi * 0.3 * (0.5 / 1.5) ** 2 / 0.05)
    assert published / right == pytest.approx(1.266, abs=0.001)


def test_approach_is_continuous_at_the_ends_of_contact_and_lubrication(colloids):
    hard = dpd.term(dpd.laws.contact, f=1000.0, Delta=2e-3, r_c=1.0)
    fluid = alone(hard, dpd.term(dpd.laws.squeezing_lubrication, **LUBRICATION, reach=1.0))
    near = 1e-9
    for place in (0.0, 1e-3, 2e-3):
        (below, above), tally = colloids(fluid, [place - near, place + near], speed=-0.2)
        assert below == pytest.approx(above, rel=1e-5) and above > 10
        np.testing.assert_allclose(*tally.energy, atol=1e-5)


ATTRACTIONS = {
    "contact": dpd.term(dpd.laws.contact, f=30.0, Delta=0.1, r_c=1.0, origin="contact"),
    "scaled": dpd.term(dpd.laws.scaled_contact, f=30.0, Delta=0.1, r_c=1.0, origin="scaled"),
    "morse": dpd.term(dpd.laws.morse, D0=1.2, kappa=8.0, r0=0.05, origin="morse"),
    "depletion": dpd.term(dpd.laws.asakura_oosawa, phi_p=0.2, r_g=0.25, origin="depletion"),
    "yukawa": dpd.term(dpd.laws.yukawa, epsilon=0.7, kappa=10.0, origin="yukawa"),
}  # fmt: skip


def test_force_is_minus_the_slope_of_the_energy_for_spheres_of_any_size(colloids):
    fluid, sizes = alone(ATTRACTIONS.values(), kT=0.3), (0.6, 1.4)
    gaps, step = np.array([-0.05, 0.03, 0.07, 0.15, 0.3, 0.45, 0.7]), 1e-5
    force, tally = colloids(fluid, gaps, sizes=sizes)
    ahead, behind = (colloids(fluid, gaps + d, sizes=sizes)[1].energy for d in (step, -step))
    np.testing.assert_allclose(force, -(ahead - behind) / (2 * step), rtol=1e-6)
    along = {name: np.asarray(tally.virial[name][:, 0, 0]) / (gaps + 2) for name in ATTRACTIONS}
    np.testing.assert_allclose(sum(along.values()), force, rtol=1e-12)
    R = {"R_i": 0.6, "R_j": 1.4}
    depletion = jax.vmap(
        jax.grad(lambda h: -dpd.laws.asakura_oosawa(h, phi_p=0.2, r_g=0.25, kT=0.3, **R))
    )(jnp.asarray(gaps))
    np.testing.assert_allclose(along["depletion"], np.where(gaps < 0.5, depletion, 0), rtol=1e-9)
    np.testing.assert_allclose(along["scaled"], along["contact"], rtol=1e-12)


def test_potentials_are_shifted_to_zero_at_their_reach(colloids):
    for reach in (0.2, 0.8):
        fluid = alone(dpd.term(dpd.laws.morse, D0=1.2, kappa=8.0, r0=0.05, reach=reach))
        energy = colloids(fluid, [0.05, reach - 1e-12, reach + 1e-12])[1].energy
        well = lambda h: 1.2 * (math.exp(-16 * (h - 0.05)) - 2 * math.exp(-8 * (h - 0.05)))
        assert energy[0] == pytest.approx(-1.2 - well(reach))
        assert energy[1] == pytest.approx(0.0, abs=1e-10) and energy[2] == 0


def test_temperature_of_a_law_is_that_of_the_fluid(colloids):
    fluid = alone(dpd.term(dpd.laws.asakura_oosawa, phi_p=0.2, r_g=0.25), kT=0.3)
    warm, hot = (colloids(fluid.set(kT=kT), [0.1]) for kT in (0.3, 0.9))
    assert warm[0] < 0 and hot[0] == pytest.approx(3 * warm[0])
    np.testing.assert_allclose(hot[1].energy, 3 * warm[1].energy)


@pytest.mark.parametrize("h, coldness", COLD)
def test_exact_noise_is_warm_and_literal_noise_cold(h, coldness, colloids):
    """The same random number, times the root of twice kT times a friction over dt."""
    numbers = dict(gamma=4.5, r_c=1.0, **LUBRICATION)
    drag, noise = (
        dpd.term(dpd.laws.literal_drag, **numbers),
        dpd.term(dpd.laws.literal_noise, **numbers),
    )
    exact, literal = (
        colloids(alone(drag=drag, random=r, kT=0.1), [h])[1].virial["random"][0, 0, 0]
        for r in (None, noise)
    )
    assert float(literal / exact) ** 2 == pytest.approx(coldness, abs=0.005)
    zeta = 4.5 * (1 - h) ** 2 + 1.5 * np.pi * 0.3 / h
    assert 0 < abs(exact) <= (2 + h) * math.sqrt(3 * 2 * 0.1 * zeta / DT)
    slope = colloids(alone(drag=drag, random=noise), [h], speed=-1.0)[0]
    assert slope == pytest.approx(zeta), "the drag is the same"
