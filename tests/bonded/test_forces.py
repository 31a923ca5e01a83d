"""Bonds, angles and dihedrals: their forces and stresses are derivatives of their energy."""

import dataclasses

import chains
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.bonded.coordinates import cosine, dihedral_cosine
from dpdjax.bonded.forces import bonded_force, bonded_laplacian, measured
from dpdjax.pairs.box import Box


def energy_of(fluid, state):
    return sum(jnp.sum(measured(fluid, state, b)[1]) for b in fluid.bonded)


@pytest.mark.parametrize("strain", [0.0, 0.3])
def test_force_is_minus_the_slope_of_the_energy(strain):
    fluid = chains.fluid()
    state = chains.state(fluid, strain=strain)
    slope = jax.grad(lambda x: energy_of(fluid, dataclasses.replace(state, position=x)))
    found = bonded_force(fluid, state, True)
    np.testing.assert_allclose(found.force, -slope(state.position), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.tally.energy, energy_of(fluid, state), rtol=1e-12)
    np.testing.assert_allclose(np.sum(found.force, axis=0), 0.0, atol=1e-9)


@pytest.mark.parametrize("strain", [0.0, 0.3])
def test_virial_is_minus_the_slope_of_the_energy_with_the_box(strain):
    """All beads and the box deformed by I + E: U'(E) is minus the virial."""
    fluid = chains.fluid()
    state = chains.state(fluid, strain=strain)

    def deformed(E):
        """By the diagonal and the xy entry, which the box can follow."""
        lengths = state.box.lengths * (1 + jnp.diag(E))
        tilt = (
            state.box.strain * (1 + E[0, 0]) * state.box.lengths[1] + E[0, 1] * state.box.lengths[1]
        )
        position = state.position + state.position @ E.T
        return dataclasses.replace(state, box=Box(lengths, tilt / lengths[1]), position=position)

    slope = jax.grad(lambda E: energy_of(fluid, deformed(E)))(jnp.zeros((3, 3)))
    virial = sum(bonded_force(fluid, state, True).tally.virial.values())
    free = np.array([[1, 1, 0], [0, 1, 0], [0, 0, 1]], bool)
    np.testing.assert_allclose(
        np.asarray(virial)[free], -np.asarray(slope)[free], rtol=1e-8, atol=1e-8
    )
    np.testing.assert_allclose(virial, np.asarray(virial).T, rtol=1e-8, atol=1e-8)


def test_stress_of_one_bond_by_hand():
    """Two beads 0.8 apart along a diagonal of the face, k 10, r0 0.5: 3 along the bond."""
    fluid = dpd.fluid(
        drag=[dpd.term(dpd.central_drag, gamma=1.0, r_c=1.0)],
        kT=0.0,
        bonds=dpd.term(dpd.laws.harmonic_bond, k=10.0, r0=0.5),
    )
    state = dpd.initial_state(fluid, jax.random.key(0), box=4.0, n=2)
    ahead = 0.8 / np.sqrt(2)
    x = jnp.array([[3.9, 3.9, 1.0], [3.9 + ahead - 4.0, 3.9 + ahead - 4.0, 1.0]])
    state = dataclasses.replace(state, position=x).bonded({"bond": np.array([[0, 1]])})
    found = bonded_force(fluid, state, True)
    pull = 10.0 * (0.8 - 0.5)
    np.testing.assert_allclose(
        found.force[0], [pull / np.sqrt(2), pull / np.sqrt(2), 0], rtol=1e-12
    )
    wanted = -pull * 0.8 / 2 * np.array([[1, 1, 0], [1, 1, 0], [0, 0, 0]])
    np.testing.assert_allclose(found.tally.virial["bond"], wanted, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(found.tally.energy, 5.0 * 0.3**2, rtol=1e-12)


def test_laplacian_is_that_of_the_energy():
    fluid = chains.fluid()
    state = chains.state(fluid)
    few = {k: np.asarray(v)[:3] for k, v in state.topology.beads.items()}
    state = state.bonded(few)
    moved = lambda x: energy_of(fluid, dataclasses.replace(state, position=x))
    hessian = jax.hessian(moved)(state.position).reshape(3 * state.n, -1)
    np.testing.assert_allclose(bonded_laplacian(fluid, state), jnp.trace(hessian), rtol=1e-8)


@pytest.mark.parametrize("angle", [0.0, 1e-4, np.pi - 1e-4, np.pi])
def test_a_straight_angle_has_finite_forces_and_gradients(angle):
    law = dpd.term(dpd.laws.cosine_angle, k=20.0)
    fluid = dpd.fluid(drag=[dpd.term(dpd.central_drag, gamma=1.0, r_c=1.0)], kT=0.0, angles=law)
    state = dpd.initial_state(fluid, jax.random.key(0), box=6.0, n=3)
    x = jnp.array(
        [
            [2.0, 2.0, 2.0],
            [2.5, 2.0, 2.0],
            [2.5 - 0.5 * np.cos(angle), 2.0 + 0.5 * np.sin(angle), 2.0],
        ]
    )
    state = dataclasses.replace(state, position=x).bonded({"angle": np.array([[0, 1, 2]])})
    force = lambda x: bonded_force(fluid, dataclasses.replace(state, position=x)).force
    assert np.all(np.isfinite(force(x)))
    assert np.all(np.isfinite(jax.jacfwd(force)(x)))
    # Bent by d from straight the energy is k d^2 / 2, the torque k sin(d).
    np.testing.assert_allclose(np.linalg.norm(force(x)[0]), 20.0 * np.sin(angle) / 0.5, atol=1e-7)


def test_dihedral_is_that_of_its_angle():
    """Four beads with phi between the outer ones, for n 1 to 6."""
    for n in range(1, 7):
        for phi in (0.3, 2.0, np.pi):
            law = dpd.term(dpd.laws.cosine_dihedral, k=3.0, n=n, d=-1.0)
            fluid = dpd.fluid(
                drag=[dpd.term(dpd.central_drag, gamma=1.0, r_c=1.0)], kT=0.0, dihedrals=law
            )
            state = dpd.initial_state(fluid, jax.random.key(0), box=8.0, n=4)
            x = [[1, 0, 0], [0, 0, 0], [0, 0, 1], [np.cos(phi), np.sin(phi), 1]]
            state = dataclasses.replace(state, position=jnp.array(x) * 0.9 + 3.0)
            state = state.bonded({"dihedral": np.array([[0, 1, 2, 3]])})
            energy = bonded_force(fluid, state, True).tally.energy
            np.testing.assert_allclose(energy, 1.5 * (1 - np.cos(n * phi)), atol=1e-9)


def test_pair_potentials_end_in_bonds_as_elsewhere():
    """A soft repulsion along a bond is zero beyond its reach."""
    fluid = chains.fluid()
    soft = dpd.fluid(
        drag=[dpd.term(dpd.central_drag, gamma=1.0, r_c=1.0)],
        kT=1.0,
        bonds=dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0),
    )
    state = chains.state(fluid)
    state = state.bonded({"bond": state.topology.beads["strong"]})
    r, energy, slope = measured(soft, state, soft.bonded[0])
    np.testing.assert_allclose(energy, np.where(r < 1, 12.5 * (1 - r) ** 2, 0.0), atol=1e-4)
    np.testing.assert_allclose(slope, np.where(r < 1, -25.0 * (1 - r), 0.0), atol=1e-4)


@pytest.mark.parametrize("unit", [1e-10, 1e-9, 1e9, 1e12])
@pytest.mark.parametrize("coordinate, beads", [(cosine, 3), (dihedral_cosine, 4)])
def test_angles_know_no_unit(coordinate, beads, unit):
    """In single precision too, whose range the squares of products of small lengths leave."""
    v = np.random.default_rng(0).normal(size=(3, beads - 1, 5)).astype(np.float32)
    value = lambda v: (coordinate(v), jax.grad(lambda v: jnp.sum(coordinate(v)))(v))
    (q, slope), (scaled, small) = value(jnp.asarray(v)), value(jnp.asarray(np.float32(unit) * v))
    np.testing.assert_allclose(scaled, q, atol=1e-5)
    np.testing.assert_allclose(small * np.float32(unit), slope, rtol=1e-4, atol=1e-5)
