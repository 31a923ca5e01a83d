"""Marbles: rotation, frictions of three kinds, drives; against sums over all pairs by hand and
exact laws of motion."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine import order
from dpdjax.engine.rotation import Rotation, axis_of, rotation_step
from dpdjax.model import advice, declare
from dpdjax.model.beads import inertias, masses
from dpdjax.pairs import box as boxes
from dpdjax.pairs import kernels, laws, noise, sums
from dpdjax.pairs import neighbours as lists
from dpdjax.pairs.forces import pair_force

DT, R, GAMMA, GAMMA_CS, GAMMA_T = 5e-3, 1.5, 5.0, 8.0, 3.0
COUPLINGS = ("central", "transverse", "full")
FLOW, TWENTY, FORTY = dpd.shear(1.0), dpd.Plan(2, 10), dpd.Plan(4, 10)
KINDS = ("ss", "cs", "cc")


def rub(h, *, gamma_cc, r_c):
    return gamma_cc * (1.0 - h / r_c) ** 2


def relisted(state):
    """The state with lists of where its beads are now."""
    neighbours = tuple(lists.allocate(n.grid, state.box, state.position) for n in state.neighbours)
    return dataclasses.replace(state, neighbours=neighbours)


@pytest.fixture(scope="module")
def marbled(key):
    """Three marbles that rub each other too, in a solvent with transverse drag; the smallest box
    that takes them."""
    friction = [
        dpd.term(rub, gamma_cc=g, r_c=1.0, projector=p)
        for g, p in ((4.0, "full"), (2.0, "transverse"), (1.0, "central"))
    ]
    return dpd.marbles(
        key,
        box=9.6,
        count=3,
        radius=R,
        density=0.7,
        gamma_t=GAMMA_T,
        gamma=GAMMA,
        gamma_cs=GAMMA_CS,
        friction=friction,
        skin=0.2,
        dt=DT,
        sheared=True,
        report=None,
    )


@pytest.fixture(scope="module")
def settled(marbled, simulate, key):
    """The same after 40 steps of shear, two marbles a small gap apart."""
    position = np.array(marbled.state.position)
    position[-1] = position[-2] + (2 * R + 0.2) * np.array([0.48, 0.6, 0.64])
    # Solvent where the marble is now goes to its surface: left inside, it would run away.
    away = np.asarray(
        boxes.displacement(
            marbled.state.box, jnp.asarray(position[:-3]), jnp.asarray(position[-1:])
        )
    )
    r = np.linalg.norm(away, axis=1, keepdims=True)
    position[:-3] += np.where(r < R + 0.2, away / r * (R + 0.2 - r), 0.0)
    position = jnp.asarray(position)
    state = dataclasses.replace(marbled.state, position=boxes.wrap(marbled.state.box, position)[0])
    state = relisted(dpd.grow(state))
    final = simulate(marbled.fluid, state, key, 1e-3, FORTY, FLOW).final
    assert final.status == 0
    return final


# ------------------------------------------------------------ laws


def test_repulsion_is_that_of_the_source():
    law = dpd.term(dpd.laws.shifted_repulsion, epsilon=2.0, sigma=0.9, r_0=2.0)
    function, reach = law.between(R_i=3.0, R_j=0.0)
    np.testing.assert_allclose(reach, 2.0 + 2 ** (1 / 6) * 0.9 - 3.0)
    x = np.linspace(0.5, 1.1, 7) * 0.9
    np.testing.assert_allclose(
        function(x + 2.0 - 3.0), 8.0 * ((0.9 / x) ** 12 - (0.9 / x) ** 6 + 0.25), rtol=1e-12
    )
    np.testing.assert_allclose(function(reach), 0.0, atol=1e-12)
    np.testing.assert_allclose(jax.grad(function)(reach), 0.0, atol=1e-12)


def test_repulsion_pushes_out_what_is_inside():
    function, _ = dpd.term(dpd.laws.shifted_repulsion, epsilon=1.0, sigma=1.0, r_0=2.0).between(
        R_i=0.0, R_j=3.0
    )
    edge = -0.5
    np.testing.assert_allclose(function(edge - 1e-9), function(edge + 1e-9), rtol=1e-6)
    np.testing.assert_allclose(
        jax.grad(function)(edge - 1e-9), jax.grad(function)(edge + 1e-9), rtol=1e-6
    )
    assert jax.grad(function)(-2.9) == jax.grad(function)(edge - 1e-6) < 0


def test_surface_drag_is_the_same_inside_and_out():
    term = dpd.term(dpd.laws.surface_drag, gamma_cs=5.0, r_c=1.0)
    function, reach = term.between()
    h = np.array([0.0, 0.25, 0.5, 1.0])
    np.testing.assert_allclose(function(h), 5.0 * (1 - h) ** 2)
    np.testing.assert_allclose(function(-h), function(h))
    assert reach == 1.0 and term.projector == "full" and function(-1.5) == 0


def test_projectors_are_declared_or_given():
    assert dpd.term(dpd.central_drag, gamma=1.0, r_c=1.0).projector == "central"
    assert dpd.term(dpd.laws.transverse_drag, gamma_t=1.0, r_c=1.0).projector == "transverse"
    assert (
        dpd.term(dpd.laws.surface_drag, gamma_cs=1.0, r_c=1.0, projector="central").projector
        == "central"
    )
    with pytest.raises(
        ValueError, match="projector is 'sideways'; it is one of central, transverse, full"
    ):
        dpd.term(dpd.central_drag, gamma=1.0, r_c=1.0, projector="sideways")
    with pytest.raises(ValueError, match="projector is 'up'"):
        dpd.laws.projected("up")
    with pytest.raises(
        ValueError, match="soft_repulsion is full, and the force of a potential is central"
    ):
        dpd.fluid([dpd.term(dpd.soft_repulsion, a=1.0, r_c=1.0, projector="full")], kT=1.0)


# ------------------------------------------------------------ noise


@pytest.fixture(scope="module")
def vectors():
    """Vector noise of all pairs of 600 beads at two steps, and of the pairs the other way round:
    (3, pairs) each."""
    i, j = map(jnp.asarray, np.triu_indices(600, 1))

    def at(step, i, j):
        words = laws.Words.of(jax.random.key(3), step, 1, jnp.arange(600), True)
        return np.stack(noise.pair_vector(words.vector, words.bead[i], words.bead[j], np.float64))

    words = laws.Words.of(jax.random.key(3), 5, 1, jnp.arange(600), True)
    scalar = np.asarray(noise.pair_noise(words.step, words.bead[i], words.bead[j], np.float64))
    return at(5, i, j), at(6, i, j), at(5, j, i), scalar


def test_vector_noise_is_white(vectors):
    now, later, _, scalar = vectors
    count = now.shape[1]
    all_of_them = np.stack([*now, *later, scalar, scalar**2 - 1.0])
    covariance = all_of_them @ all_of_them.T / count
    expected = np.diag([1.0] * 7 + [0.8])
    np.testing.assert_allclose(covariance, expected, atol=4.5 / math.sqrt(count))
    assert np.abs(now.mean(axis=1)).max() < 4.5 / math.sqrt(count)


def test_vector_noise_changes_sign_with_the_order(vectors):
    np.testing.assert_array_equal(vectors[2], -vectors[0])


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


def test_forces_and_torques_equal_the_sum_over_all_pairs(marbled, settled, key):
    assert np.min(np.linalg.norm(settled.rotation.velocity, axis=1)) > 0.05
    force, torque, tally = jax.jit(
        lambda s: pair_force(marbled.fluid, s, s.velocity, 1.0, key, DT, tally=True)
    )(settled)
    by_hand, turned_by, _ = forces_by_hand(marbled.fluid, settled, 1.0, key)
    np.testing.assert_allclose(force, by_hand, atol=1e-10 * np.abs(by_hand).max())
    np.testing.assert_allclose(torque, turned_by, atol=1e-10 * np.abs(turned_by).max())
    assert jnp.max(jnp.abs(torque)) > 1.0
    assert set(tally.virial) == {"conservative", "drag", "random", "surface", "contact"}


def test_blocks_of_pairs_turn_as_the_whole_list(marbled, settled, key, monkeypatch):
    go = lambda: jax.jit(lambda s: pair_force(marbled.fluid, s, s.velocity, 1.0, key, DT))(settled)
    force, torque, _ = go()
    monkeypatch.setattr(kernels, "BLOCK", 100)
    monkeypatch.setattr(kernels, "BLOCKED_FROM", 101)
    in_blocks, torque_in_blocks, _ = go()
    np.testing.assert_allclose(in_blocks, force, atol=1e-9)
    np.testing.assert_allclose(torque_in_blocks, torque, atol=1e-9)


def test_pairs_of_marbles_act_on_each_other(settled):
    i, j = settled.neighbours[2].list.idx
    d = boxes.displacement(settled.box, settled.position[-2], settled.position[-1])
    assert jnp.any(i < settled.n) and jnp.linalg.norm(d) < 2 * R + 1


def test_angular_momentum_is_lost_by_the_arms_alone(marbled, settled, key):
    """The gain of angular momentum is ``sum (r_A - r_i) x F``, to rounding."""
    state = dataclasses.replace(settled, box=boxes.box(settled.box.lengths))
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


def test_momentum_is_conserved_exactly(marbled, settled, simulate, key):
    momentum = simulate(marbled.fluid, settled.restarted(), key, DT, FORTY, FLOW).frames["momentum"]
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


# ------------------------------------------------------------ motion


def test_a_turning_sphere_comes_round():
    omega = jnp.array([[0.3, -0.5, 0.2]])
    q = Rotation.of(omega, 0).orientation
    steps = 2000
    angle = 2 * math.pi / jnp.linalg.norm(omega)
    for _ in range(2):
        q = jax.lax.fori_loop(
            0, steps // 2, lambda _, q: q + rotation_step(q, omega * angle / steps), q
        )
    np.testing.assert_allclose(jnp.abs(q[0, 0]), 1.0, atol=1e-5)
    level = Rotation.of(omega, 0).orientation
    half = level + rotation_step(level, jnp.array([[1e-3, 0.0, 0.0]]))
    np.testing.assert_allclose(axis_of(half)[0], [0.0, -1e-3, 1.0], atol=1e-6)


def test_without_friction_spins_stay_and_energy_does_not_drift(key):
    """10^5 steps; the error of energy goes as dt^2."""
    made = dpd.marbles(
        key,
        box=5.6,
        radius=1.5,
        density=0.15,
        gamma=0.0,
        gamma_cs=0.0,
        skin=0.25,
        dt=0.01,
        report=None,
    )
    fluid, weights = made.fluid, masses(made.fluid, made.state)

    def energy(fluid, state):
        spin = 0.5 * jnp.sum(inertias(fluid, state)[:, None] * state.rotation.velocity**2)
        return {
            "E": 0.5 * jnp.sum(weights[:, None] * state.velocity**2) + spin + state.tally.energy,
            "w": state.rotation.velocity,
        }

    def of(dt, frames, every):
        run = jax.jit(
            lambda s: dpd.simulate(fluid, s, key, dt, dpd.Plan(frames, every), observe=energy)
        )(made.state)
        assert run.final.status == 0
        return run.frames

    long = of(0.01, 500, 200)
    np.testing.assert_allclose(long["w"], long["w"][:1] + 0 * long["w"], rtol=1e-12)
    drift = np.polyfit(np.arange(500), np.asarray(long["E"]), 1)[0] * 500
    assert abs(drift) < 5 * np.std(long["E"]) < 0.01 * long["E"][0]
    errors = [np.std(of(dt, 200, round(0.04 / dt))["E"]) for dt in (0.01, 0.005, 0.0025)]
    slope = np.polyfit(np.log([0.01, 0.005, 0.0025]), np.log(errors), 1)[0]
    assert 1.7 < slope < 2.6


@pytest.fixture(scope="module")
def touching(key):
    """Two spheres a small gap apart that rub each other and nothing else, spinning; and what they
    are."""
    fluid = dpd.fluid(
        drag=[dpd.term(rub, gamma_cc=4.0, r_c=1.0, projector="full")],
        kT=0.0,
        mass=2.0,
        radius=(1.0,),
        inertia=(0.5,),
    )
    state = dpd.initial_state(fluid, key, box=6.5, n=2, skin=0.2, dt=DT, sheared=False)
    position = jnp.array([[3.0, 3.0, 3.0], [3.0, 3.0, 5.3]])
    spins = dataclasses.replace(
        state.rotation, velocity=jnp.array([[2.0, -1.0, 0.5], [1.0, 2.0, -3.0]])
    )
    velocity = jnp.array([[0.3, 0.2, 0.1], [-0.3, -0.2, -0.1]])
    return fluid, relisted(
        dataclasses.replace(state, position=position, velocity=velocity, rotation=spins)
    )


def order_of(outcome, steps, exact):
    """Minus the slope of the error with the number of steps."""
    errors = [np.linalg.norm(outcome(s) - exact) for s in steps]
    return -np.polyfit(np.log(steps), np.log(errors), 1)[0]


@pytest.mark.parametrize("lam, order", [(1.0, 2.0), (0.5, 1.0)])
def test_order_of_rotation(lam, order, touching, key):
    """With drag and without noise: error over a fixed time at dt, dt/2, dt/4 against a much smaller
    step.

    Of second order where the predicted velocity is that at the end of the step, of first with half
    of the kick.
    """
    fluid, start = touching

    def spins(steps, lam=lam):
        how = dpd.integrators.VelocityVerlet(lam)
        final = jax.jit(
            lambda s: dpd.simulate(
                fluid,
                s,
                key,
                0.3 / steps,
                dpd.Plan(2, steps // 2),
                integrator=how,
            )
        )(start).final
        assert final.status == 0
        return np.concatenate(
            [np.ravel(final.rotation.velocity), np.ravel(final.rotation.orientation)]
        )

    found = order_of(spins, np.array([32, 64, 128]), spins(4096, 1.0))
    assert abs(found - order) < 0.2


def test_order_of_orientation_under_a_torque(touching, key):
    """Without friction: the error of the directions that driven spheres point in goes as dt^2."""
    fluid, start = touching
    drive = dpd.drive(torque=(3.0, 1.0, 0.0), species=0)

    def axis(steps):
        run = jax.jit(
            lambda s: dpd.simulate(
                fluid.set(gamma_cc=0.0), s, key, 0.5 / steps, dpd.Plan(2, steps // 2), drive
            )
        )
        return np.asarray(run(start).final.rotation.axis)

    assert abs(order_of(axis, np.array([20, 40, 80]), axis(4000)) - 2.0) < 0.1


def spin_energy(fluid, state):
    return {"T": dpd.observe.rotational_temperature(fluid, state)}


def rotational_temperature_after(made, key, steps=6000):
    run = jax.jit(
        lambda s: dpd.simulate(
            made.fluid, s, key, made.dt, dpd.Plan(steps // 100, 100), observe=dpd.mean(spin_energy)
        )
    )
    return np.asarray(run(dpd.grow(made.state)).frames["T"])


@pytest.fixture(scope="module")
def light(key):
    """Eight light marbles, whose spins are soon forgotten."""
    return lambda coupling: dpd.marbles(
        key,
        box=7.0,
        count=8,
        radius=1.0,
        density=1.5,
        mass=2.0,
        inertia=0.5,
        coupling=coupling,
        dt=DT,
        skin=0.25,
        report=None,
    )


@pytest.mark.parametrize("coupling", ["transverse", "full"])
def test_spins_have_the_temperature(coupling, light, key):
    T = rotational_temperature_after(light(coupling), key)
    late = T[5:].reshape(11, -1).mean(1)
    assert abs(late.mean() - 1) < max(0.05, 4 * late.std() / math.sqrt(len(late)))


def test_central_drag_turns_nothing(light, key):
    T = rotational_temperature_after(light("central"), key, 200)
    np.testing.assert_allclose(T, T[0] + 0 * T, rtol=1e-12)


def test_the_printed_sign_of_the_torque_runs_away(light, key, monkeypatch):
    right = sums.torque_add
    monkeypatch.setattr(
        sums, "torque_add", lambda torque, *a: torque - (right(torque, *a) - torque)
    )
    T = rotational_temperature_after(light("full"), key, 1000)
    assert not np.all(np.isfinite(T)) or T[-1] > 100


# ------------------------------------------------------------ invariances


def same_bits(a, b):
    same = jax.tree.map(lambda x, y: bool(jnp.array_equal(x, y)), a.rotation, b.rotation)
    names = ("position", "velocity", "force", "image", "id")
    return all(jax.tree.leaves(same)) and all(
        jnp.array_equal(getattr(a, k), getattr(b, k)) for k in names
    )


@pytest.fixture(scope="module")
def run(simulate, marbled, key):
    return lambda state, plan=TWENTY: simulate(marbled.fluid, state, key, DT, plan, FLOW)


def test_chunks_capacity_and_files_are_bitwise_invisible(run, settled, tmp_path):
    whole = run(settled, FORTY).final
    assert same_bits(whole, run(run(settled).final).final)
    assert same_bits(whole, run(dpd.grow(settled), FORTY).final)
    dpd.save_state(tmp_path / "state.npz", settled)
    assert same_bits(whole, run(dpd.load_state(tmp_path / "state.npz"), FORTY).final)


def test_sorting_marbles_is_bitwise_invisible(monkeypatch, marbled, settled, key):
    def go(smallest):
        monkeypatch.setattr(order, "SMALLEST", smallest)
        monkeypatch.setattr(order, "LASTS", 3)
        assert order.is_kept(settled) == (smallest == 2)
        return jax.jit(lambda s: dpd.simulate(marbled.fluid, s, key, DT, dpd.Plan(3, 5), FLOW))(
            settled
        ).final

    assert same_bits(go(2), go(10**9))
    turn = jnp.arange(settled.n).at[-3:].set(settled.n - 3 + jnp.array([2, 0, 1]))
    moved = order.permuted(settled, turn)
    np.testing.assert_array_equal(
        moved.rotation.velocity, settled.rotation.velocity[jnp.array([2, 0, 1])]
    )
    np.testing.assert_array_equal(
        moved.rotation.orientation, settled.rotation.orientation[jnp.array([2, 0, 1])]
    )


def test_gradients_equal_central_differences(marbled, settled, key):
    """Over ten steps, with respect to four numbers at once, by forward and by reverse mode."""
    names = ("gamma_cs", "gamma_t", "inertia", "epsilon")
    values = jnp.array([marbled.fluid.value(name) for name in names])

    def outcome(x):
        fluid = marbled.fluid.set(**dict(zip(names, x)))
        final = dpd.simulate(fluid, settled.restarted(), key, 1e-4, dpd.Plan(2, 5)).final
        return jnp.sum(final.rotation.velocity * jnp.array([[1.0, -0.5, 0.3]])) + jnp.sum(
            final.velocity[-3:, 0]
        )

    steps = 1e-4 * jnp.diag(values)
    at = jax.jit(jax.vmap(outcome))(jnp.concatenate([values[None] + steps, values[None] - steps]))
    central = (at[:4] - at[4:]) / (2e-4 * values)
    assert jnp.all(jnp.abs(central) > 1e-9)
    np.testing.assert_allclose(jax.jit(jax.grad(outcome))(values), central, rtol=1e-5)
    forward = jax.jit(lambda x: jax.jvp(outcome, (x,), (values,))[1])(values)
    np.testing.assert_allclose(forward, jnp.sum(central * values), rtol=1e-5)


def test_a_scan_over_couplings_strengths_and_inertia(marbled, settled, key):
    scan = dict(gamma_cs=jnp.array([1.0, 10.0]), inertia=jnp.array([10.0, 40.0]))
    both = dpd.run(
        marbled.fluid.set(**scan),
        settled,
        jax.random.split(key, 2),
        DT,
        dpd.Plan(2, 3),
        progress=False,
    )
    for k in range(2):
        fluid = marbled.fluid.set(**{name: values[k] for name, values in scan.items()})
        alone = dpd.run(
            fluid, settled, jax.random.split(key, 2)[k], DT, dpd.Plan(2, 3), progress=False
        )
        np.testing.assert_allclose(
            both.final.rotation.velocity[k], alone.final.rotation.velocity, atol=1e-10
        )
    assert [m.fluid.value("inertia") for m in both.members()] == [10.0, 40.0]


def test_starts_are_thermal_and_repeat(key):
    make = lambda key: dpd.marbles(
        key, box=40.0, count=300, radius=1.0, density=0.05, inertia=2.0, kT=0.5, report=None
    )
    some, again = make(key), make(key)
    assert same_bits(some.state, again.state)
    omega = np.asarray(some.state.rotation.velocity)
    assert abs(2.0 * np.mean(omega**2) / 0.5 - 1) < 5 * math.sqrt(2 / omega.size)
    assert "300 marbles" in str(some) and "inertia 2" in str(some)


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


# ------------------------------------------------------------ errors


@pytest.mark.parametrize(
    "wrong, words",
    [
        (dict(box=7.0), r"below 2 \(reach \+ skin\)"),
        (dict(box=10.0, count=0), "count is 0"),
        (dict(box=10.0, count=9), "do not fit"),
        (dict(box=10.0, count=2), r"below 2 \(reach \+ skin\).*use a side of at least 1[2-9]"),
        (dict(box=10.0, coupling="sticky"), "coupling is 'sticky'"),
        (dict(box=10.0, gamma_cs=-1.0), "gamma_cs is -1.0"),
        (dict(box=10.0, inertia=0.0), "inertia is 0.0"),
        (dict(box=10.0, friction=dpd.term(rub, gamma_cc=1.0, r_c=1.0)), "give is_several=True"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, dict) else None,
)
def test_marbles_that_cannot_be(wrong, words, key):
    with pytest.raises(ValueError, match=words):
        dpd.marbles(key, report=None, **wrong)


def test_what_cannot_rotate(marbled, settled, key, water, fresh):
    drag = [dpd.term(dpd.central_drag, gamma=1.0, r_c=1.0)]
    with pytest.raises(ValueError, match="species 0 has an inertia and no radius"):
        dpd.fluid(drag=drag, kT=1.0, inertia=1.0)
    with pytest.raises(
        ValueError,
        match=r"the species \[0, 2\] rotate; give inertia to species that follow one another",
    ):
        dpd.fluid(drag=drag, kT=1.0, radius=(1.0, 1.0, 1.0), inertia=(1.0, None, 1.0))
    with pytest.raises(TypeError, match="no term of this fluid has 'inertia'"):
        water.set(inertia=2.0)
    with pytest.raises(ValueError, match="beads of the fluid rotate and those of the state do not"):
        dpd.simulate(
            marbled.fluid, dataclasses.replace(settled, rotation=None), key, DT, dpd.Plan(1)
        )
    with pytest.raises(ValueError, match="no bead of this state rotates"):
        dpd.observe.rotations(water, fresh)
    shifted = dataclasses.replace(settled, rotation=dataclasses.replace(settled.rotation, begin=0))
    with pytest.raises(ValueError, match="of other species"):
        dpd.simulate(marbled.fluid, shifted, key, DT, dpd.Plan(1))


def test_projectors_have_names():
    assert declare.PROJECTORS == COUPLINGS


# ------------------------------------------------------------ advice


def test_the_step_suits_the_spin(key):
    """A light spin is damped faster than the velocity, and asks for a shorter step; central drag
    leaves it alone."""
    step = lambda **numbers: dpd.suggest_dt(dpd.marble_fluid(radius=1.5, **numbers), (3.0, 0.005))
    assert step(inertia=0.05) < 0.05 * step(inertia=1000.0)
    assert step(inertia=0.05, coupling="central") == step(inertia=1000.0, coupling="central")
    light = dpd.marble_fluid(radius=1.5, inertia=0.05)
    made = dpd.marbles(key, box=6.0, radius=1.5, skin=0.3, report=None)
    with pytest.raises(ValueError, match="too large for the drag: dt times the damping rate"):
        dpd.simulate(light, made.state, key, 0.005, dpd.Plan(1))


def test_the_rate_of_rubbing_spheres_has_their_arms():
    """``zeta (1/M + R^2/I)`` across the line of centres, six neighbours, each giving way."""
    friction = lambda projector: dpd.term(rub, gamma_cc=3.0, r_c=1.0, projector=projector)
    fluid = lambda p: dpd.marble_fluid(
        is_several=True, radius=2.0, mass=10.0, inertia=4.0, friction=friction(p)
    )
    limits = [advice.dt_limits(fluid(p), (3.0, 0.01))[2][1] for p in COUPLINGS]
    np.testing.assert_allclose(
        limits, [10 / 18, 1 / (18 * (0.1 + 1.0)), 1 / (18 * (0.1 + 1.0))], rtol=1e-3
    )


def test_the_solvent_starts_outside_the_wall(key):
    """Wherever the wall is: no bead has more than its share of energy."""
    for r_0 in (0.5, 1.0, 1.4):
        made = dpd.marbles(key, box=6.0, radius=1.5, density=1.0, r_0=r_0, skin=0.3, report=None)
        r = jnp.linalg.norm(
            boxes.displacement(made.state.box, made.state.position[:-1], made.state.position[-1:]),
            axis=1,
        )
        assert jnp.min(r) >= max(1.5, r_0 + 1.0)
