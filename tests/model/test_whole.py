"""Coefficients of any shape: a potential through knots, a friction from a small network."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd

KNOTS = jnp.linspace(0.0, 1.0, 9)


def knotted(h, *, knots, r_c):
    """A potential through energies at equal steps up to the reach, cubic between them."""
    k = len(knots) - 1
    s = jnp.clip(h / r_c, 0.0, 1.0) * k
    n = jnp.clip(jnp.floor(s).astype(int), 0, k - 1)
    t = s - n
    inner = 0.5 * (knots[2:] - knots[:-2])
    first, last = 2 * (knots[1] - knots[0]) - inner[0], 2 * (knots[-1] - knots[-2]) - inner[-1]
    slopes = jnp.concatenate([first[None], inner, last[None]])
    rise = knots[n + 1] - knots[n]
    bend = (1 - t) * (slopes[n] - rise) + t * (rise - slopes[n + 1])
    return knots[n] + t * rise + t * (1 - t) * bend


def network(h, *, weights, r_c):
    """A friction from a layer of eight neurons, positive whatever the weights."""
    hidden = jnp.tanh(jnp.stack([h, jnp.ones_like(h)], axis=-1) @ weights["in"])
    return jax.nn.softplus(hidden @ weights["out"]) * (1.0 - h / r_c) ** 2


def weights(key):
    a, b = jax.random.split(key)
    return {"in": jax.random.normal(a, (2, 8)), "out": jax.random.normal(b, (8,))}


def fluid(energies, of, **batch):
    return dpd.fluid(
        [dpd.term(knotted, knots=dpd.whole(energies, **batch), r_c=1.0)],
        [dpd.term(network, weights=dpd.whole(of), r_c=1.0)],
        kT=1.0,
    )


SOFT = 12.5 * (1.0 - KNOTS) ** 2


@pytest.fixture(scope="module")
def made(key):
    return fluid(SOFT, weights(key))


@pytest.fixture(scope="module")
def state(made, key):
    return dpd.initial_state(made, key, box=4.2, density=3.0)


def test_knots_of_a_parabola_are_the_soft_repulsion(made, state, key):
    """Forces through knots are those of the law they were taken from."""
    soft = dpd.fluid(
        [dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)], made.interactions[0].drag, kT=1
    )
    of = lambda fluid: dpd.forces(fluid, state, key, 0.001, kinds=("conservative",)).force
    np.testing.assert_allclose(of(made), of(soft), atol=1e-9)


def test_gradients_reach_every_knot_and_weight(made, state, key):
    def pressure(energies, of):
        run = dpd.simulate(fluid(energies, of), state, key, 0.001, dpd.Plan(2, 3))
        return jnp.trace(run.frames["pressure_tensor"][-1])

    along_energies, along_weights = jax.grad(pressure, (0, 1))(SOFT, weights(key))
    assert along_energies.shape == KNOTS.shape and np.all(np.isfinite(along_energies))
    assert all(np.any(leaf != 0) for leaf in jax.tree.leaves(along_weights))
    step, k = 1e-4, 4
    at = lambda x: float(pressure(SOFT.at[k].add(x), weights(key)))
    assert float(along_energies[k]) == pytest.approx((at(step) - at(-step)) / (2 * step), rel=1e-4)


def test_beside_tables_of_species(key):
    """A number of each pair of species, and an array for all, in one law."""

    def scaled(h, *, knots, strength, r_c):
        return strength * knotted(h, knots=knots, r_c=r_c)

    table = jnp.array([[1.0, 2.0], [2.0, 1.0]])
    drag = dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)
    two = dpd.fluid(
        [dpd.term(scaled, knots=dpd.whole(SOFT), strength=table, r_c=1.0)], drag, kT=1.0
    )
    state = dpd.initial_state(two, key, box=4.2, density=3.0, fractions=[0.5, 0.5])
    alike = two.set(strength=jnp.ones((2, 2)))
    energy = lambda fluid: dpd.forces(fluid, state, key, 0.01).tally.energy
    double = energy(two.set(strength=2 * jnp.ones((2, 2))))
    assert energy(alike) < energy(two) < double
    assert float(double) == pytest.approx(2 * float(energy(alike)))


def test_runs_sets_and_scans(made, state, key):
    """By every door; ``set`` takes the bare array, and a batch says that it is one."""
    keys = jax.random.split(key, 2)
    stiff = made.set(knots=2 * SOFT)
    np.testing.assert_array_equal(stiff.value("knots"), 2 * SOFT)
    plan = dpd.Plan(2, 5)
    alone = dpd.run(stiff, state, keys[1], 0.001, plan, progress=False)
    both = jnp.stack([SOFT, 2 * SOFT])
    scan = dpd.run(fluid(both, weights(key), batch=True), state, keys, 0.001, plan, progress=False)
    assert scan.fluid.is_batch and list(scan.system.differing()) == ["value"]
    np.testing.assert_allclose(scan.final.velocity[1], alone.final.velocity, atol=1e-8)
    chosen = scan[1].fluid
    np.testing.assert_array_equal(chosen.value("knots"), 2 * SOFT)
    assert not chosen.is_batch and made.set(knots=both).is_batch
    again = dpd.run(chosen, state, keys[1], 0.001, plan, progress=False)
    np.testing.assert_array_equal(again.final.velocity, alone.final.velocity)
    assert "whole((9,))" in repr(made.interactions[0].conservative[0])


def test_arrays_that_are_refused(made):
    with pytest.raises(ValueError, match=r"knots has shape \(9,\).*dpd.whole\(...\) where"):
        dpd.term(knotted, knots=SOFT, r_c=1.0)
    with pytest.raises(ValueError, match="must be finite"):
        dpd.whole(SOFT.at[3].set(jnp.nan))
    with pytest.raises(TypeError, match="r_c of knotted is .*whole.* is none like it"):
        made.set(r_c=dpd.whole(SOFT))
    with pytest.raises(TypeError, match="weights of network is whole.* is none like it"):
        made.set(weights=SOFT)
    with pytest.raises(
        ValueError, match="the friction <lambda>.w=whole.*must be finite and not negative"
    ):
        negative = dpd.term(lambda h, *, w, r_c: jnp.sum(w) - h, w=dpd.whole(-SOFT), r_c=1.0)
        liquid = dpd.fluid([], [negative], kT=1.0)
        dpd.initial_state(liquid, jax.random.key(0), box=4.2, density=3.0)


@pytest.mark.parametrize("taken", ["mass", "energies"])
def test_names_that_set_takes_for_something_else(taken):
    """``fluid.set(mass=...)`` would have set both, without a word."""
    laws = {"mass": lambda h, *, mass, r_c: mass * h, "energies": lambda h, *, energies, r_c: h}
    with pytest.raises(TypeError, match=f"coefficient '{taken}', which fluid.set"):
        dpd.term(laws[taken], **{taken: 1.0}, r_c=1.0)
