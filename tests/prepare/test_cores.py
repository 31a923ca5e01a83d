"""Random starts of potentials that diverge: no two beads closer than a few kT; soft ones start as
they did."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.pairs import box as boxes
from dpdjax.prepare.cores import START_ENERGY, closest, start_radii


def lennard_jones(h, *, epsilon, sigma):
    x = (sigma / h) ** 6
    return 4.0 * epsilon * (x * x - x)


def rubbing():
    return dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)


def hard(sigma=1.0, **how):
    return dpd.fluid(
        [dpd.term(lennard_jones, epsilon=1.0, sigma=sigma, reach=2.5)], [rubbing()], kT=1.0, **how
    )


def distances(state):
    d = boxes.displacement(state.box, state.position[:, None], state.position[None])
    return np.asarray(jnp.linalg.norm(d, axis=-1)) + 99.0 * np.eye(state.n)


def test_lennard_jones_starts_apart_and_does_not_explode(key):
    state = dpd.initial_state(hard(), key, box=6.0, density=0.6, skin=0.2, sheared=False)
    closest = distances(state).min()
    assert lennard_jones(closest, epsilon=1.0, sigma=1.0) <= START_ENERGY
    run = dpd.run(hard(), state, key, 0.005, dpd.Plan(2, 20), progress=False)
    assert np.all(run.frames["temperature"] < 2)


def test_tables_keep_every_two_species_apart(key):
    fluid = hard([[1.0, 0.8], [0.8, 0.5]])
    state = dpd.initial_state(fluid, key, box=6.0, n=[60, 60], skin=0.2, sheared=False)
    r, species = distances(state), np.asarray(state.species)
    for a, b, sigma in ((0, 0, 1.0), (0, 1, 0.8), (1, 1, 0.5)):
        assert (
            lennard_jones(r[species == a][:, species == b].min(), epsilon=1.0, sigma=sigma)
            <= START_ENERGY
        )


def test_points_next_to_spheres_with_a_law_that_diverges():
    """The spheres grow by what the points keep away from them; the points stay points."""
    among = [
        dpd.interaction((0, 0), drag=rubbing()),
        dpd.interaction((0, 1), dpd.term(lennard_jones, epsilon=1.0, sigma=0.3, reach=0.75)),
        dpd.interaction((1, 1), dpd.term(dpd.laws.contact, f=1e4, Delta=1e-3, r_c=1.0)),
    ]
    points, spheres = start_radii(
        dpd.fluid(interactions=among, kT=1.0, mass=[1.0, 12.0], radius=(None, 1.0))
    )
    assert points == 0 and 0.25 < spheres - 1 < 0.3
    assert lennard_jones(spheres - 1, epsilon=1.0, sigma=0.3) <= START_ENERGY


def test_too_dense_is_refused_with_the_cure(key):
    with pytest.raises(
        ValueError,
        match='potential of this fluid diverges.*0.9.* apart.*lower density, or start="lattice"',
    ):
        dpd.initial_state(hard(), key, box=6.0, density=1.8)
    assert dpd.initial_state(hard(), key, box=6.0, density=1.0, start="lattice").n == 216


def test_soft_laws_start_where_they_did(water, key):
    """Bit for bit: uniform for points, whatever the temperature, and packed spheres with points
    outside."""
    for kT in (1.0, 1e-4, 0.0):
        assert not start_radii(water.set(kT=kT, energies="keep")).any()
    state = dpd.initial_state(water, key, box=4.2, density=3.0, skin=0.2)
    uniform = (
        jax.random.uniform(jax.random.fold_in(key, 2), (state.n, 3), dtype=state.position.dtype)
        * 4.2
    )
    np.testing.assert_array_equal(state.position, uniform)
    assert start_radii(dpd.colloid_fluid(D0=1.2)).tolist() == [0.0, 1.0]
    assert start_radii(dpd.marble_fluid(a=25.0, is_several=True)).tolist() == [0.0, 3.0]


def test_marbles_start_outside_a_wide_wall():
    """At a radius of 1 the wall begins at 0.5: the clearance is where its energy is thermal, and 0
    for the usual wall."""
    gap = closest(dpd.marble_fluid(radius=1.0, r_0=0.5))[0, 1]
    assert 0.3 < gap < 0.5
    assert (
        float(dpd.laws.shifted_repulsion(gap, epsilon=1.0, sigma=1.0, r_0=0.5, R_i=0.0, R_j=1.0))
        <= START_ENERGY
    )
    assert closest(dpd.marble_fluid())[0, 1] == 0
