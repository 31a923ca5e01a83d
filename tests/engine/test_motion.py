"""Beads at one place, and beads that run away."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine import motion
from dpdjax.engine import status as bits
from dpdjax.pairs import neighbours as lists
from dpdjax.pairs.forces import pair_force


def relisted(state):
    fresh = tuple(
        lists.allocate(n.grid, state.box, state.position, state.id) for n in state.neighbours
    )
    return dataclasses.replace(state.restarted(), neighbours=fresh)


def only_pair(state):
    """The lists of the state with nothing but the pair of beads 5 and 9."""
    idx = jnp.full_like(state.neighbours[0].list.idx, state.n).at[:, 0].set(jnp.array([5, 9]))
    return tuple(
        dataclasses.replace(n, list=dataclasses.replace(n.list, idx=idx)) for n in state.neighbours
    )


@pytest.fixture(scope="module")
def stacked(water):
    """64 beads at rest, bead 5 where bead 9 is."""
    state = dpd.initial_state(water, jax.random.key(3), box=4.0, n=64)
    position = state.position.at[5].set(state.position[9])
    return relisted(
        dataclasses.replace(state, position=position, velocity=jnp.zeros_like(state.velocity))
    )


@pytest.fixture(scope="module")
def one_step(water, simulate):
    cold = water.set(kT=0.0)
    return lambda state, key: simulate(cold, state, key, 1e-3, dpd.Plan(1, 1))


def parted(run):
    return np.asarray(run.final.position[5] - run.final.position[9])


def test_beads_at_one_place_have_their_energy(stacked, one_step, water):
    """At distance 0 the energy is a r_c/2 = 12.5, not 0."""
    nearly = relisted(dataclasses.replace(stacked, position=stacked.position.at[5, 0].add(1e-9)))
    energies = [
        float(one_step(state, jax.random.key(0)).frames["potential_energy"][0])
        for state in (stacked, nearly)
    ]
    assert energies[0] == pytest.approx(energies[1], rel=1e-6)
    apart = relisted(dataclasses.replace(stacked, position=stacked.position.at[5, 0].add(1.0)))
    of_pair = lambda state: (
        pair_force(water, state, state.velocity, 0.0, jax.random.key(0), 0.01, True)[2].energy
    )
    close = lambda state: float(of_pair(dataclasses.replace(state, neighbours=only_pair(state))))
    assert close(stacked) == pytest.approx(12.5) and close(apart) == 0.0


def test_beads_at_one_place_part(stacked, one_step):
    """By the full force, equal and opposite, in directions that keys decide; the momentum stays."""
    runs = [one_step(stacked, jax.random.key(k)) for k in range(12)]
    directions = {tuple(np.sign(parted(run)).astype(int)) for run in runs}
    assert len(directions) > 3
    for run in runs:
        assert np.linalg.norm(parted(run)) == pytest.approx(25.0 * 1e-6, rel=0.5)
        np.testing.assert_allclose(run.frames["momentum"], 0.0, atol=1e-12)


def test_beads_at_one_place_part_alike_in_any_order(stacked, one_step):
    """The direction goes with the ids where the list does, not with the slots."""
    order = jnp.arange(64).at[jnp.array([5, 9])].set(jnp.array([9, 5]))
    names = ("position", "velocity", "force", "image", "id", "species", "size")
    other = relisted(
        dataclasses.replace(stacked, **{name: getattr(stacked, name)[order] for name in names})
    )
    a, b = (one_step(state, jax.random.key(2)) for state in (stacked, other))
    np.testing.assert_allclose(a.final.position[5], b.final.position[9], atol=1e-12)
    np.testing.assert_allclose(a.final.position[9], b.final.position[5], atol=1e-12)


def test_gradients_of_beads_at_one_place_are_finite(stacked, water):
    def work(x):
        state = dataclasses.replace(stacked, position=x)
        force, _, sums = pair_force(
            water, state, state.velocity, 0.0, jax.random.key(0), 0.01, True
        )
        return jnp.sum(force**2) + sums.energy

    assert np.all(np.isfinite(jax.grad(work)(stacked.position)))
    assert np.isfinite(dpd.observe.configurational_temperature(water, stacked))


def test_padded_slots_are_no_pairs(stacked, one_step):
    grown = dpd.grow(stacked)
    a, b = (one_step(state, jax.random.key(2)).final for state in (stacked, grown))
    assert np.array_equal(a.position, b.position) and np.array_equal(a.velocity, b.velocity)


def test_beads_that_run_away_are_told(fresh, water, key):
    """Sheared at a rate of 50 they were at 270 kT, without a word."""
    with pytest.raises(dpd.RunError, match="ran away.*smaller shear rate"):
        dpd.run(water, fresh, key, 0.01, dpd.Plan(10, 10), dpd.shear(50.0), progress=False)


def test_a_hot_end_is_told(fresh, water, key):
    with pytest.warns(UserWarning, match="ends at a kinetic temperature.*the shear heats it"):
        dpd.run(water, fresh, key, 0.01, dpd.Plan(10, 10), dpd.shear(5.0), progress=False)
    with pytest.warns(UserWarning, match="still cools from its start"):
        dpd.run(water.set(kT=1e-3), fresh, key, 0.005, dpd.Plan(10, 10), progress=False)


def test_the_pure_door_answers_nan_for_them(fresh, water, simulate, key, ten):
    run = simulate(water, fresh, key, 0.05, ten, dpd.shear(200.0))
    assert run.final.status & bits.RUN_AWAY
    assert np.all(np.isnan(run.frames["temperature"]))


@pytest.mark.parametrize("kT", [0.0, 1e-4])
def test_a_quench_does_not_run_away(fresh, water, simulate, key, ten, kT):
    """Potential energy turned into heat is hot beside kT, and in order."""
    run = simulate(water.set(kT=kT), fresh, key, 0.005, ten, dpd.shear(0.0))
    assert run.final.status == 0


def test_few_beads_may_be_hot_for_a_while(water):
    """Two beads at twenty times kT are a fluctuation; a thousand are none."""
    for n, told in ((2, 0), (1000, bits.RUN_AWAY)):
        state = dpd.initial_state(water, jax.random.key(0), box=8.0, n=n)
        hot = dataclasses.replace(
            state, velocity=state.velocity * jnp.sqrt(20.0 / dpd.observe.temperature(water, state))
        )
        assert motion.trouble(water, hot, 1e-4) == told


def test_a_steady_excess_is_told(fresh, water, key):
    """Of too long a step, 3 % at dt 0.05; of which member; and by measures that recorded velocities
    alone."""
    settled = dpd.run(water, fresh, key, 0.01, dpd.Plan(5, 100), progress=False).final
    with pytest.warns(
        UserWarning,
        match=r"steadily at a kinetic temperature of 1.0\d+ where kT is 1: dt is too large",
    ):
        dpd.run(water, settled, key, 0.05, dpd.Plan(200, 10), progress=False)
    both = jax.random.split(key, 2)
    with pytest.warns(UserWarning, match="member 1: the later half"):
        dpd.run(water, settled, both, jnp.array([0.005, 0.05]), dpd.Plan(200, 10), progress=False)
    moved = dpd.run(
        water, settled, key, 0.05, dpd.Plan(200, 10), observe=dpd.observe.positions, progress=False
    )
    with pytest.warns(UserWarning, match="the beads were at 1.0"):
        dpd.measure.mean_squared_displacement(moved)
