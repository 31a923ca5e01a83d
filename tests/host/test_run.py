"""The host door: chunks, growth, failures, interrupts, batches and files change no bit of a run."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine import compiling
from dpdjax.pairs import neighbours as lists

host = sys.modules[dpd.stream.__module__]
chunk_frames = host.chunk_frames

DT, FLOW, PIECE = 0.01, dpd.shear(1.0), dpd.Plan(2, 5)
"""Every run here is made of one compiled piece."""


@pytest.fixture(scope="module", autouse=True)
def pieces():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(host, "chunk_frames", lambda *_: PIECE.frames)
        yield


@pytest.fixture(scope="module")
def run(water, key):
    """``run(state, frames)``: water under shear, in pieces."""
    return lambda state, frames, fluid=water, key=key, **how: dpd.run(
        fluid, state, key, DT, dpd.Plan(frames, PIECE.every), FLOW, progress=False, **how
    )


@pytest.fixture(scope="module")
def state(run, fresh):
    return run(fresh, 10).final


@pytest.fixture(scope="module")
def sixty(run, state):
    return run(state, 12)


def same_bits(a, b):
    return all(
        jnp.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


def moved(state):
    """Where a run ends, without the lists, whose size is free."""
    return dataclasses.replace(state, neighbours=())


def with_capacity(state, capacity):
    grid = dataclasses.replace(state.neighbours[0].grid, capacity=capacity)
    return dataclasses.replace(state, neighbours=(lists.allocate(grid, state.box, state.position),))


def member(tree, k):
    return jax.tree.map(lambda leaf: leaf[k], tree)


def test_chunks_are_one_simulation(simulate, water, state, key, sixty):
    whole = simulate(water, state, key, DT, dpd.Plan(12, PIECE.every), FLOW)
    assert sixty.complete and sixty.every == PIECE.every
    assert same_bits(moved(whole.final), moved(sixty.final))
    assert same_bits(whole.frames, sixty.frames)


def test_chunks_hold_a_million_particle_steps_or_fifty_steps(monkeypatch):
    monkeypatch.setattr(host, "CHUNK", 10_000)
    assert chunk_frames(dpd.Plan(61, 10), 100) == 10
    assert chunk_frames(dpd.Plan(5, 10), 100) == 5
    assert chunk_frames(dpd.Plan(5, 50), 100_000) == 1


def test_other_plans_are_the_same_program_and_the_same_run(
    monkeypatch, run, water, state, key, sixty
):
    compiled = compiling.programs()
    monkeypatch.setattr(host, "chunk_frames", lambda *_: 25)
    seldom, often = (
        dpd.run(water, state, key, DT, dpd.Plan(*n), FLOW, progress=False)
        for n in ((3, 20), (60, 1))
    )
    assert same_bits(seldom.frames, {name: values[3::4] for name, values in sixty.frames.items()})
    assert same_bits({name: values[4::5] for name, values in often.frames.items()}, sixty.frames)
    assert same_bits(moved(seldom.final), moved(often.final)) and same_bits(
        moved(often.final), moved(sixty.final)
    )
    assert compiling.programs() == compiled


def test_list_too_small_from_the_start_is_grown(run, state):
    small = with_capacity(state, 2048)
    assert small.neighbours[0].list.error.code == 1
    repaired = run(small, 2)
    large = with_capacity(state, repaired.final.neighbours[0].grid.capacity)
    assert same_bits(run(large, 2), repaired)


def test_list_that_overflows_on_the_way_is_grown_and_replayed(run, state):
    """A list that just holds the pairs of now, and one with room to spare, give the same run."""
    pairs = int(jnp.sum(with_capacity(state, 3072).neighbours[0].list.idx[0] < state.n))
    tight = with_capacity(state, pairs)
    assert tight.neighbours[0].list.error.code == 0
    roomy = run(with_capacity(state, 3072), 40)
    repaired = run(tight, 40)
    assert repaired.final.neighbours[0].grid.capacity > pairs
    for name in ("position", "velocity", "force", "image", "step", "time"):
        assert jnp.array_equal(getattr(roomy.final, name), getattr(repaired.final, name))
    # Sums over pairs are added in an order that depends on the length of the list.
    for name, values in roomy.frames.items():
        assert np.allclose(values, repaired.frames[name], rtol=1e-12, atol=1e-12)


def test_overflow_in_simulate_is_told_and_poisoned(simulate, water, state, key):
    ended = simulate(water, with_capacity(state, 2048), key, DT, PIECE, FLOW)
    assert ended.final.status == 1
    numbers = [ended.final.position, ended.final.velocity, *ended.frames.values()]
    assert all(jnp.all(jnp.isnan(x)) for x in numbers if jnp.issubdtype(x.dtype, jnp.floating))


def disturbed(monkeypatch, third):
    """Let ``third(state)`` happen to the state before the third piece."""
    genuine, count = host.replayed, []

    def chunk(fluid, state, *rest):
        count.append(None)
        return genuine(fluid, third(state) if len(count) == 3 else state, *rest)

    monkeypatch.setattr(host, "replayed", chunk)


def test_nan_is_an_error_that_keeps_the_frames_before(run, state, sixty, monkeypatch):
    disturbed(
        monkeypatch,
        lambda state: dataclasses.replace(state, velocity=state.velocity.at[3, 0].set(jnp.nan)),
    )
    first = int(state.step) + 4 * PIECE.every
    with pytest.raises(
        dpd.RunError, match=f"between steps {first} and {first + 10}: .* NaN .* smaller dt"
    ) as raised:
        run(state, 12)
    kept = raised.value.trajectory
    assert not kept.complete and kept.final.step == first
    assert same_bits(kept.frames, jax.tree.map(lambda frames: frames[:4], sixty.frames))


def test_interrupt_returns_the_run_so_far(run, state, sixty, monkeypatch, capsys):
    def interrupt(state):
        raise KeyboardInterrupt

    disturbed(monkeypatch, interrupt)
    cut = run(state, 12)
    assert not cut.complete
    assert "interrupted after 4 of 12 frames" in capsys.readouterr().err
    assert same_bits(cut.frames, jax.tree.map(lambda frames: frames[:4], sixty.frames))
    assert cut.final.step == cut.frames["step"][-1]
    monkeypatch.undo()
    assert same_bits(moved(run(cut.final, 8).final), moved(sixty.final))


def test_interrupt_at_once_returns_no_frames(run, state, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(host, "replayed", interrupt)
    cut = run(state, 12)
    assert (cut.complete, cut.frames) == (False, {})
    assert same_bits(moved(cut.final), moved(state))


def test_progress_goes_to_standard_error(water, state, key, capsys):
    dpd.run(water, state, key, DT, PIECE, FLOW)
    out, err = capsys.readouterr()
    assert out == "" and "10/10" in err


def test_scan_over_gamma(run, water, state, sixty, key):
    """Three keys and three numbers: three members, each the run it would be alone."""
    gammas, keys = [2.0, 4.5, 9.0], jax.random.split(key, 3)
    scan = run(state, 4, fluid=water.set(gamma=jnp.array(gammas)), key=keys)
    assert scan.is_batch and scan.frames["pressure_tensor"].shape == (3, 4, 3, 3)
    on = run(scan.final, 2, fluid=scan.fluid, key=keys)
    members = scan.members()
    for k in range(3):
        alone = run(state, 4, fluid=water.set(gamma=gammas[k]), key=keys[k])
        assert members[k].fluid.value("gamma") == gammas[k] and not members[k].fluid.is_batch
        assert np.allclose(members[k].frames["temperature"], alone.frames["temperature"], rtol=1e-9)
        assert np.allclose(members[k].final.velocity, alone.final.velocity, atol=1e-8)
        alone_on = run(alone.final, 2, fluid=alone.fluid, key=keys[k])
        assert np.allclose(on.members()[k].final.velocity, alone_on.final.velocity, atol=1e-6)


def test_keys_must_match_the_members(run, water, state, key):
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
    with pytest.raises(
        ValueError, match=r"the state is a batch of 2; give 2 keys: jax.random.split\(key, 2\)"
    ):
        run(batch, 2)
    with pytest.raises(ValueError, match="3 keys for a batch of 2 states"):
        run(batch, 2, key=jax.random.split(key, 3))
    three = water.set(gamma=jnp.array([2.0, 4.5, 9.0]))
    with pytest.raises(
        ValueError, match=r"numbers for 3 members and keys of shape \(\): give 3 keys"
    ):
        run(state, 2, fluid=three)
    with pytest.raises(
        ValueError, match=r"numbers for 3 members and keys of shape \(2,\): give 3 keys"
    ):
        run(batch, 2, fluid=three, key=jax.random.split(key))
