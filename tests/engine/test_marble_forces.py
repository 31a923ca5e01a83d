"""Forces and torques of marbles against sums over all pairs by hand, and what they conserve; the
stress of what rubs across."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marble import COUPLINGS, DT, FLOW, FORTY, GAMMA, GAMMA_CS, GAMMA_T, R, relisted, rub

import dpdjax as dpd
from dpdjax.pairs import box as boxes
from dpdjax.pairs import kernels, laws, noise
from dpdjax.pairs.forces import pair_force

KINDS = ("ss", "cs", "cc")


# ------------------------------------------------------------ forces


def frictions_by_hand(kind, h):
    """Friction along and across the line of centres, numpy."""
    # A surface drags alike inside and out; what marbles rub each other with goes on growing in
    # overlap.
    distance = np.abs(h) if kind == "cs" else h
    w2 = np.where(distance < 1, 1 - distance, 0) ** 2
    along, across = {
        "ss": (GAMMA, GAMMA_T),
        "cs": (GAMMA_CS, GAMMA_CS),
        "cc": (4.0 + 1.0, 4.0 + 2.0),
    }[kind]
    return along * w2, across * w2


def repulsion_by_hand(kind, r):
    x = r - {"cs": R - 1.0, "cc": 2 * R - 1.0}[kind] if kind != "ss" else np.full_like(r, 9.0)
    return np.where(x < 2 ** (1 / 6), 24 * (2 / x**13 - 1 / x**7), 0.0)


def forces_by_hand(fluid, state, rate, key):
    """Force on all beads and torque on the marbles by a sum over all pairs, with the engine's own
    noise for each."""
    x, v, first = np.asarray(state.position), np.asarray(state.velocity), state.rotation.begin
    omega = np.zeros_like(x)
    omega[first:] = state.rotation.velocity
    radius = np.where(np.arange(state.n) < first, 0.0, R)
    i, j = np.triu_indices(state.n, 1)
    d = np.asarray(boxes.displacement(state.box, state.position[i], state.position[j]))
    r = np.linalg.norm(d, axis=1)
    e = d / r[:, None]
    arm_i, arm_j = -radius[i, None] * e, radius[j, None] * e
    u = v[i] - v[j] + np.cross(omega[i], arm_i) - np.cross(omega[j], arm_j)
    u[:, 0] += rate * d[:, 1]
    h = r - radius[i] - radius[j]
    force, torque, residual = np.zeros_like(x), np.zeros_like(x), np.zeros(3)
    for channel, kind in enumerate(KINDS):
        mine = (np.add(i >= first, j >= first, dtype=int) == channel) & (h < 1)
        a, b, n = i[mine], j[mine], e[mine]
        along, across = frictions_by_hand(kind, h[mine])
        words = laws.Words.of(key, state.step, channel, state.id, True)
        xi = np.asarray(noise.pair_noise(words.step, words.bead[a], words.bead[b], np.float64))
        vector = np.stack(
            noise.pair_vector(words.vector, words.bead[a], words.bead[b], np.float64), axis=1
        )
        P = np.eye(3) - n[:, :, None] * n[:, None, :]
        f = (repulsion_by_hand(kind, r[mine]) + np.sqrt(2 * along / DT) * xi)[:, None] * n
        f -= along[:, None] * np.sum(u[mine] * n, axis=1, keepdims=True) * n + across[
            :, None
        ] * np.einsum("pab,pb->pa", P, u[mine])
        f += np.sqrt(2 * across / DT)[:, None] * np.einsum("pab,pb->pa", P, vector)
        np.add.at(force, a, f)
        np.subtract.at(force, b, f)
        np.add.at(torque, a, np.cross(arm_i[mine], f))
        np.subtract.at(torque, b, np.cross(arm_j[mine], f))
        # What angular momentum gains: each force acts at the end of its arm, the two ends are
        # apart.
        residual += np.sum(np.cross(d[mine] + arm_i[mine] - arm_j[mine], f), axis=0)
    return force, torque[first:], residual


def test_forces_and_torques_equal_the_sum_over_all_pairs(marbled, settled_marbles, key):
    assert np.min(np.linalg.norm(settled_marbles.rotation.velocity, axis=1)) > 0.05
    force, torque, tally = jax.jit(
        lambda s: pair_force(marbled.fluid, s, s.velocity, 1.0, key, DT, tally=True)
    )(settled_marbles)
    by_hand, turned_by, _ = forces_by_hand(marbled.fluid, settled_marbles, 1.0, key)
    np.testing.assert_allclose(force, by_hand, atol=1e-10 * np.abs(by_hand).max())
    np.testing.assert_allclose(torque, turned_by, atol=1e-10 * np.abs(turned_by).max())
    assert jnp.max(jnp.abs(torque)) > 1.0
    assert set(tally.virial) == {"conservative", "drag", "random", "surface", "contact"}


def test_blocks_of_pairs_turn_as_the_whole_list(marbled, settled_marbles, key, monkeypatch):
    go = lambda: jax.jit(lambda s: pair_force(marbled.fluid, s, s.velocity, 1.0, key, DT))(
        settled_marbles
    )
    force, torque, _ = go()
    monkeypatch.setattr(kernels, "BLOCK", 100)
    monkeypatch.setattr(kernels, "BLOCKED_FROM", 101)
    in_blocks, torque_in_blocks, _ = go()
    np.testing.assert_allclose(in_blocks, force, atol=1e-9)
    np.testing.assert_allclose(torque_in_blocks, torque, atol=1e-9)


def test_pairs_of_marbles_act_on_each_other(settled_marbles):
    i, j = settled_marbles.neighbours[2].list.idx
    d = boxes.displacement(
        settled_marbles.box, settled_marbles.position[-2], settled_marbles.position[-1]
    )
    assert jnp.any(i < settled_marbles.n) and jnp.linalg.norm(d) < 2 * R + 1


def test_angular_momentum_is_lost_by_the_arms_alone(marbled, settled_marbles, key):
    """The gain of angular momentum is ``sum (r_A - r_i) x F``, to rounding."""
    state = dataclasses.replace(settled_marbles, box=boxes.box(settled_marbles.box.lengths))
    state = dataclasses.replace(state, position=boxes.wrap(state.box, state.position)[0])
    state = relisted(dpd.grow(state))
    force, torque, _ = pair_force(marbled.fluid, state, state.velocity, 0.0, key, DT)
    by_hand, _, residual = forces_by_hand(marbled.fluid, state, 0.0, key)
    i, j = np.triu_indices(state.n, 1)
    # Orbital part pair by pair, by the nearest image.
    x = np.asarray(state.position)
    d = np.asarray(boxes.displacement(state.box, state.position[i], state.position[j]))
    wraps = x[i] - x[j] - d
    np.testing.assert_allclose(force, by_hand, atol=1e-10 * np.abs(by_hand).max())
    assert np.any(np.abs(wraps) > 1), "some pairs meet across the boundary"
    orbital, spin = orbital_by_hand(marbled.fluid, state, key), np.sum(np.asarray(torque), axis=0)
    np.testing.assert_allclose(orbital + spin, residual, atol=1e-9 * np.abs(by_hand).max())
    assert np.max(np.abs(residual)) > 1.0, "and it is not conserved"


def orbital_by_hand(fluid, state, key):
    """``sum r_ij x F_ij`` from the antisymmetric part of the virial, which the engine adds up on
    its own."""
    _, _, tally = pair_force(fluid, state, state.velocity, 0.0, key, DT, tally=True)
    W = sum(np.asarray(v) for v in tally.virial.values())
    return np.array([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]])


def test_momentum_is_conserved_exactly(marbled, settled_marbles, simulate, key):
    momentum = simulate(marbled.fluid, settled_marbles.restarted(), key, DT, FORTY, FLOW).frames[
        "momentum"
    ]
    np.testing.assert_allclose(momentum, momentum[:1] + 0 * momentum, atol=1e-10)


@pytest.mark.parametrize("projector", COUPLINGS)
def test_noise_has_the_covariance_of_its_friction(projector):
    """``2 kT zeta P / dt`` for a pair at a fixed place, over many keys."""
    fluid = dpd.fluid(drag=[dpd.term(rub, gamma_cc=3.0, r_c=1.0, projector=projector)], kT=0.7)
    state = dpd.initial_state(fluid, jax.random.key(0), box=3.0, n=2, skin=0.1)
    e = np.array([0.48, 0.6, 0.64])
    state = dataclasses.replace(
        state, position=jnp.asarray([1.0 + 0.4 * e, [1.0, 1.0, 1.0]]), velocity=jnp.zeros((2, 3))
    )
    state = relisted(state)
    keys = jax.random.split(jax.random.key(1), 40_000)
    f = np.asarray(
        jax.jit(jax.vmap(lambda key: pair_force(fluid, state, state.velocity, 0.0, key, DT)[0][0]))(
            keys
        )
    )
    along = np.outer(e, e)
    P = {"central": along, "transverse": np.eye(3) - along, "full": np.eye(3)}[projector]
    expected = 2 * 0.7 * 3.0 * 0.6**2 / DT * P
    np.testing.assert_allclose(
        f.T @ f / len(f), expected, atol=5 * np.max(expected) * math.sqrt(2 / len(f))
    )


# ------------------------------------------------------------ what rubs across in a solvent


def test_the_stress_across_is_the_flux_of_momentum(key):
    """``P[a, b]``: momentum a carried along b. Two beads past each other along x, apart in y."""
    fluid = dpd.fluid(drag=[dpd.term(dpd.laws.transverse_drag, gamma_t=2.0, r_c=1.0)], kT=0.0)
    state = dpd.initial_state(fluid, key, box=3.0, n=2, skin=0.1)
    state = dataclasses.replace(
        state,
        position=jnp.array([[1.0, 1.5, 1.0], [1.0, 1.0, 1.0]]),
        velocity=jnp.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]),
    )
    state = relisted(state)
    force, _, tally = pair_force(fluid, state, state.velocity, 0.0, key, DT, tally=True)
    np.testing.assert_allclose(force, [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(
        tally.virial["drag"], [[0.0, -0.5, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    )
    # Along xy, yx, ... the pair answers a shear with zeta r^2 e_b^2 (1 - e_a^2); here e = y.
    np.testing.assert_allclose(
        dpd.observe.instantaneous_viscosity(fluid, state), 0.5 * 0.25 / 3 / 27.0
    )
