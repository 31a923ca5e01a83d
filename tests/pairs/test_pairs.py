"""Pairs: nothing counted twice, nothing missed, nothing pushed without pushing back."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine.record import recorders
from dpdjax.engine.simulate import advance
from dpdjax.engine.system import System
from dpdjax.pairs import box as boxes
from dpdjax.pairs import cells, kernels
from dpdjax.pairs import neighbours as lists
from dpdjax.pairs.forces import pair_force
from dpdjax.xla import on_cpu

BOXES = [
    ((4.2, 4.2, 4.2), 222),
    ((9.0, 3.7, 4.0), 300),
    ((4.1, 8.0, 3.7), 200),
    ((3.9, 4.0, 9.0), 260),
    ((2.7, 2.7, 2.7), 60),
    ((3.1, 2.6, 5.0), 210),
]
TILTS = [-0.5, -0.31, -1e-3, 0.0, 0.2, 0.5]


def distances(lengths, strain, position):
    """Nearest-image distances of wrapped positions by trying 45 images of each pair, in plain
    numpy."""
    lx, ly, lz = lengths
    x, y, z = np.meshgrid(np.arange(-2, 3), np.arange(-1, 2), np.arange(-1, 2))
    images = np.stack([x * lx + y * strain * ly, y * ly, z * lz], -1).reshape(-1, 3)
    d = position[:, None] - position[None]
    nearest = np.full(d.shape[:2], np.inf)
    for image in images:
        np.minimum(nearest, np.einsum("ija,ija->ij", d + image, d + image), out=nearest)
    return np.sqrt(nearest)


def pairs_within(cut, distance):
    i, j = np.nonzero(np.triu(distance < cut, 1))
    return set(zip(i.tolist(), j.tolist()))


def listed(idx, n):
    """The pairs of a list as a set; fails where one is listed twice or the wrong way round."""
    idx = np.asarray(idx)
    i, j = idx[:, idx[0] < n]
    assert np.all(i < j)
    pairs = set(zip(i.tolist(), j.tolist()))
    assert len(pairs) == len(i)
    return pairs


def uniform(rng, lengths, n):
    return rng.random((n, 3)) * lengths


def clustered(rng, lengths, n):
    """A third of the beads in each of two blobs, one of them on a corner."""
    blob = rng.normal(size=(n, 3)) * 0.3 + np.where(
        np.arange(n)[:, None] % 3 == 0, 0.0, 0.4 * np.asarray(lengths)
    )
    return np.where(np.arange(n)[:, None] % 3 == 2, uniform(rng, lengths, n), blob)


def on_boundaries(rng, lengths, n):
    """Coordinates exactly on faces and cell edges, and one rounding error beside them."""
    edge = rng.integers(0, 13, (n, 3)) / 12 * lengths
    nudge = rng.choice([-1e-16, 0.0, 1e-16], (n, 3))
    return np.where(rng.random((n, 3)) < 0.6, edge + nudge, uniform(rng, lengths, n))


@pytest.fixture(scope="module")
def build():
    return jax.jit(lists.build_pairs, static_argnums=0)


@pytest.mark.parametrize("lengths, n", BOXES, ids=str)
def test_list_equals_all_pairs(lengths, n, build):
    planned = lists.plan_grid(n, lengths, 1.0, 0.15)
    roomy = dataclasses.replace(planned, window=-(-n // 8) * 8, capacity=n * (n - 1) // 2)
    rng = np.random.default_rng(n)
    for tilt in TILTS:
        strain = tilt * lengths[0] / lengths[1]
        box = boxes.Box(jnp.asarray(lengths), jnp.asarray(strain))
        for place in (uniform, clustered, on_boundaries):
            position = np.asarray(boxes.wrap(box, jnp.asarray(place(rng, lengths, n)))[0])
            idx, overflow = build(roomy, box, position)
            found = listed(idx, n)
            assert not any(overflow)
            true = distances(lengths, strain, position)
            assert pairs_within(1.15 - 1e-12, true) <= found <= pairs_within(1.15 + 1e-12, true)


GROUPS = [
    ((0, 80), (80, 420)),
    ((0, 340), (340, 420)),
    ((10, 210), (215, 415)),
    ((0, 70), (90, 420)),
    ((0, 3), (3, 420)),
]
"""Few and many, many and few, as many of either, with beads left out, and so few that all pairs are
tried."""


@pytest.mark.parametrize(
    "lengths, groups",
    [((5.2, 5.2, 5.2), groups) for groups in GROUPS]
    + [(box, GROUPS[0]) for box in ((5.4, 9.0, 4.9), (3.9, 4.0, 9.0))],
    ids=str,
)
def test_list_between_two_groups_equals_all_pairs(lengths, groups, build):
    n, cut = 420, 1.55
    planned = lists.plan_grid(groups, lengths, 1.4, 0.15)
    few, many = planned.few[1] - planned.few[0], planned.many[1] - planned.many[0]
    roomy = dataclasses.replace(planned, window=-(-n // 8) * 8, capacity=few * many)
    assert (planned.cells is None) == (few == 3 or min(lengths) < 4)
    rng = np.random.default_rng(n)
    first, second = (np.isin(np.arange(n), np.arange(*group)) for group in groups)
    for tilt in (-0.5, -1e-3, 0.31):
        box = boxes.Box(jnp.asarray(lengths), jnp.asarray(tilt * lengths[0] / lengths[1]))
        for place in (uniform, clustered, on_boundaries):
            position = np.asarray(boxes.wrap(box, jnp.asarray(place(rng, lengths, n)))[0])
            idx, overflow = build(roomy, box, position)
            assert not any(overflow)
            true = distances(lengths, float(box.strain), position)
            true[~(first[:, None] & second[None, :])] = np.inf
            assert (
                pairs_within(cut - 1e-12, true) <= listed(idx, n) <= pairs_within(cut + 1e-12, true)
            )


@pytest.mark.parametrize("groups", GROUPS[:2], ids=str)
def test_the_order_of_beads_in_memory_does_not_change_a_list_between_groups(groups, build):
    lengths, n = (5.2, 5.2, 5.2), 420
    grid, box = lists.plan_grid(groups, lengths, 1.4, 0.15), boxes.box(lengths)
    rng = np.random.default_rng(1)
    position = uniform(rng, lengths, n)
    ids = np.concatenate([rng.permutation(np.arange(*group)) for group in groups]).astype(np.int32)
    for chosen in (grid, dataclasses.replace(grid, cells=None)):
        by_id, _ = build(chosen, box, position, np.arange(n, dtype=np.int32))
        stored, _ = build(chosen, box, position[ids], ids)
        real = np.asarray(by_id[0] < n)
        assert real.sum() > 500
        assert np.array_equal(ids[np.asarray(stored)[:, real]], np.asarray(by_id)[:, real])


def test_a_list_between_groups_lasts_while_neither_moves_too_far():
    lengths, n = (5.2, 5.2, 5.2), 300
    grid, box = lists.plan_grid(((0, 80), (80, 250)), lengths, 1.4, 0.2), boxes.box(lengths)
    position = jnp.asarray(uniform(np.random.default_rng(2), lengths, n))
    old = lists.allocate(grid, box, position)
    moved = lambda bead, by: position.at[bead, 1].add(by)
    for by, stale in (
        (moved(3, 0.19), False),
        (moved(3, 0.21), True),
        (moved(90, 0.21), True),
        (moved(299, 3.0), False),
        (moved(3, 0.11).at[90, 0].add(0.11), True),
        (moved(3, 0.11).at[4, 0].add(0.11), False),
    ):
        assert jax.jit(lists.is_stale)(old, box, by) == stale


def test_lists_between_groups_in_a_batch_and_in_a_gradient():
    lengths, n = (5.2, 5.2, 5.2), 300
    grid, box = lists.plan_grid(((0, 80), (80, n)), lengths, 1.4, 0.2), boxes.box(lengths)
    position = jnp.asarray(uniform(np.random.default_rng(2), lengths, n))
    batch = jnp.stack([position, position.at[3, 0].add(0.5), position.at[3, 0].add(0.01)])
    old = lists.allocate(grid, box, position)
    new = jax.jit(jax.vmap(lists.update, (None, None, 0)))(old, box, batch)
    for k in range(3):
        assert jnp.array_equal(new.list.idx[k], lists.update(old, box, batch[k]).list.idx)
    assert jnp.array_equal(new.list.idx[2], old.list.idx)
    assert not jnp.array_equal(new.list.idx[1], old.list.idx)

    def spread(position):
        i, j = lists.update(old, box, position).list.idx
        d = boxes.displacement(
            box, position[jnp.minimum(i, n - 1)], position[jnp.minimum(j, n - 1)]
        )
        return jnp.sum(jnp.where(i < n, 1.4**2 - jnp.sum(d * d, axis=1), 0.0))

    push = jnp.asarray(np.random.default_rng(3).normal(size=(n, 3)))
    slope = jnp.vdot(jax.jit(jax.grad(spread))(batch[1]), push)
    step = 1e-6
    central = (spread(batch[1] + step * push) - spread(batch[1] - step * push)) / (2 * step)
    np.testing.assert_allclose(slope, central, rtol=1e-6)


def test_boxes_of_the_list_test_use_cells_and_all_pairs():
    shapes = [lists.plan_grid(n, lengths, 1.0, 0.15).cells for lengths, n in BOXES]
    assert [shape is None for shape in shapes] == [False, False, False, False, True, True]


@pytest.mark.parametrize("lengths, n", BOXES[:1] + BOXES[4:5], ids=["cells", "all pairs"])
def test_list_too_short_raises_the_overflow_flags(lengths, n, build):
    grid, box = lists.plan_grid(n, lengths, 1.0, 0.15), boxes.box(lengths)
    even = jnp.asarray(uniform(np.random.default_rng(0), lengths, n))
    overflow = lambda grid, position: [bool(flag) for flag in build(grid, box, position)[1]]
    assert overflow(grid, even) == [False, False]
    assert overflow(dataclasses.replace(grid, capacity=64), even) == [True, False]
    assert any(overflow(grid, 0.2 * even))


@pytest.mark.parametrize("block", [300, 700, 1000])
def test_a_list_built_in_blocks_is_the_same(block, monkeypatch, build):
    lengths, n = (9.0, 9.0, 9.0), 2187
    grid, box = lists.plan_grid(n, lengths, 1.0, 0.15), boxes.box(lengths)
    position = jnp.asarray(uniform(np.random.default_rng(5), lengths, n))
    ids = jnp.asarray(np.random.default_rng(6).permutation(n), jnp.int32)
    whole, _ = build(grid, box, position, ids)
    monkeypatch.setattr(cells, "BLOCK", block)
    assert 0 < cells.block_size(n) - n // (n // block) < 32
    planned = lists.plan_grid(n, lengths, 1.0, 0.15)
    in_blocks, overflow = jax.jit(cells.cell_pairs, static_argnums=0)(planned, box, position, ids)
    pairs = int(jnp.sum(whole[0] < n))
    assert not any(overflow)
    assert jnp.array_equal(in_blocks[:, :pairs], whole[:, :pairs])
    assert jnp.all(in_blocks[:, pairs:] == n)
    tight = dataclasses.replace(planned, capacity=pairs)
    assert cells.cell_pairs(tight, box, position, ids)[1][0], "the last block has no room"


def test_pair_forces_sum_to_zero(water, quiet_water, sheared_water, key):
    for state, rate in ((quiet_water, 0.0), (sheared_water, 1.0)):
        force, _, _ = jax.jit(pair_force)(water, state, state.velocity, rate, key, 0.01)
        assert jnp.max(jnp.abs(force)) > 10
        assert jnp.max(jnp.abs(jnp.sum(force, axis=0))) < 1e-11


@pytest.mark.parametrize("block", [256, 300, 3071])
def test_blocks_of_pairs_add_up_to_the_whole_list(block, monkeypatch, water, sheared_water, key):
    whole = lambda state: pair_force(water, state, state.velocity, 1.0, key, 0.01, tally=True)
    blocked = lambda state: pair_force(water, state, state.velocity, 1.0, key, 0.01, tally=True)
    force, _, tally = jax.jit(whole)(sheared_water)
    monkeypatch.setattr(kernels, "BLOCK", block)
    monkeypatch.setattr(kernels, "BLOCKED_FROM", 0)
    assert block < sheared_water.neighbours[0].grid.capacity
    in_blocks, _, tally_in_blocks = jax.jit(blocked)(sheared_water)
    np.testing.assert_allclose(in_blocks, force, atol=1e-11)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), tally_in_blocks, tally)


@pytest.mark.parametrize("flow", [None, dpd.shear(1.0)], ids=["quiet", "sheared"])
def test_momentum_is_conserved_over_a_run(flow, water, fresh, simulate, key, long):
    push = dataclasses.replace(fresh, velocity=fresh.velocity + jnp.array([[1.0, 0.0, -2.0]]))
    momentum = simulate(water, push, key, 0.01, long, flow).frames["momentum"]
    assert jnp.max(jnp.abs(momentum - push.n * jnp.array([[1.0, 0.0, -2.0]]))) < 1e-10


def test_free_beads_fly_straight_through_a_sheared_box(water, sheared_water, simulate, key, long):
    free, start, time = water.set(a=0.0, gamma=0.0), sheared_water.restarted(), 2.0
    final = simulate(free, start, key, 0.01, long, dpd.shear(1.0)).final
    lab = start.velocity.at[:, 0].add(1.0 * start.position[:, 1])
    peculiar = start.velocity.at[:, 0].add(-1.0 * start.velocity[:, 1] * time)
    off = boxes.displacement(final.box, final.position, start.position + lab * time)
    np.testing.assert_allclose(final.velocity, peculiar, atol=1e-11)
    np.testing.assert_allclose(off, 0, atol=1e-10)


def watch(fluid, state):
    """What it takes to check a list afterwards."""
    chosen = state.neighbours[0].list
    return {
        "position": state.position,
        "strain": state.box.strain,
        "idx": chosen.idx,
        "built_at": chosen.reference_position,
    }


@pytest.mark.parametrize("kT", [1.0, 25.0])
def test_no_pair_is_missed_in_fast_shear(kT, water, sheared_water, simulate, key):
    run = simulate(
        water.set(kT=kT), sheared_water, key, 0.01, dpd.Plan(150), dpd.shear(2.5), observe=watch
    )
    seen = jax.tree.map(np.asarray, run.frames)
    assert run.final.status == 0
    assert np.sum(np.abs(np.diff(seen["strain"])) > 0.5) >= 3, "the strain wraps several times"
    assert np.any(np.all(seen["built_at"][1:] == seen["built_at"][:-1], axis=(1, 2))), (
        "lists are reused"
    )
    lengths = np.asarray(run.final.box.lengths)
    for f in range(0, 150, 5):
        close = pairs_within(1.0, distances(lengths, seen["strain"][f], seen["position"][f]))
        assert close <= listed(seen["idx"][f], run.final.n)


def test_a_list_lasts_until_the_strain_could_bring_a_pair_within_reach(quiet_water):
    state, cut = quiet_water, 1.2
    old = lists.allocate(state.neighbours[0].grid, state.box, state.position)
    for strain, stale in ((0.9 * 0.2 / cut, False), (1.1 * 0.2 / cut, True)):
        box = state.box.strained(strain)
        carried = state.position.at[:, 0].add(strain * state.position[:, 1])
        assert lists.is_stale(old, box, boxes.wrap(box, carried)[0]) == stale


@pytest.mark.parametrize("lengths", [(4.2, 4.2, 4.2), (9.0, 4.0, 5.0), (4.0, 9.0, 5.0)], ids=str)
def test_displacement_equals_that_of_jax_md(lengths):
    from jax_md import space

    rng = np.random.default_rng(3)
    direction = rng.normal(size=(500, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    separation = direction * rng.uniform(0, 0.5 * boxes.narrowest(lengths, True).min(), (500, 1))
    origin = uniform(rng, lengths, 500)
    for tilt in TILTS:
        box = boxes.Box(jnp.asarray(lengths), jnp.asarray(tilt * lengths[0] / lengths[1]))
        ra, rb = (boxes.wrap(box, jnp.asarray(r))[0] for r in (origin + separation, origin))
        ours = boxes.displacement(box, ra, rb)
        displacement, _ = space.periodic_general(boxes.matrix(box), fractional_coordinates=True)
        with jax.numpy_rank_promotion("allow"):
            theirs = jax.vmap(displacement)(boxes.fractional(box, ra), boxes.fractional(box, rb))
        np.testing.assert_allclose(ours, separation, atol=1e-13)
        np.testing.assert_allclose(ours, theirs, atol=1e-13)


def test_a_batch_keeps_the_lists_that_are_not_stale(quiet_water):
    state = quiet_water
    shift = jnp.zeros_like(state.position).at[3, 0].set(1.0)
    position = jnp.stack([state.position + 0.01 * shift, state.position + 0.5 * shift])
    old = lists.allocate(state.neighbours[0].grid, state.box, state.position)
    new = jax.vmap(lists.update, (None, None, 0))(old, state.box, position)
    assert jnp.array_equal(new.list.idx[0], old.list.idx)
    assert jnp.array_equal(new.list.reference_position[0], state.position)
    assert jnp.array_equal(new.list.reference_position[1], position[1])
    assert not jnp.array_equal(new.list.idx[1], old.list.idx)


def inner(value):
    """The jaxprs inside the parameters of an equation."""
    if hasattr(value, "jaxpr"):
        yield value.jaxpr
    elif hasattr(value, "eqns"):
        yield value
    elif isinstance(value, (tuple, list)):
        for one in value:
            yield from inner(one)


def equations(jaxpr):
    """Every equation of a program, however deep."""
    for eqn in jaxpr.eqns:
        yield eqn
        for value in eqn.params.values():
            for one in inner(value):
                yield from equations(one)


BUILDS = "population_count"
"""An operation that nothing but the builder of lists does."""


def guards_a_build(eqn):
    """Whether an equation decides, with one flag, if a list is built; a batched flag would be
    none."""
    # On a CPU the builder's own stages are branches too, but only what decides is a loop.
    if eqn.primitive.name not in (("while",) if on_cpu() else ("cond", "while")):
        return False
    bodies = [one for value in eqn.params.values() for one in inner(value)]
    return any(e.primitive.name == BUILDS for body in bodies for e in equations(body))


@pytest.mark.parametrize("batches", [0, 1, 2])
def test_list_updates_stay_a_branch_under_vmap(batches, water, quiet_water, key):
    run = lambda gamma, key: advance(
        System.of(water.set(gamma=gamma), 0.01, dpd.shear(1.0)),
        quiet_water,
        key,
        dpd.Plan(2, 5),
        recorders(None),
    )
    gamma, keys = 4.5, key
    if batches > 0:
        run, keys = jax.vmap(run, (None, 0)), jax.random.split(key, 3)
    if batches > 1:
        run, gamma = jax.vmap(run, (0, None)), jnp.array([2.0, 4.5])
    scans = [
        e for e in equations(jax.make_jaxpr(run)(gamma, keys).jaxpr) if e.primitive.name == "scan"
    ]
    frames = next(scan for scan in scans if scan.params["length"] == 2)
    work = list(equations(frames.params["jaxpr"].jaxpr))
    guarded = [g for g in work if guards_a_build(g)]
    assert guarded
    inside = {
        id(e)
        for g in guarded
        for value in g.params.values()
        for one in inner(value)
        for e in equations(one)
    }
    assert all(id(e) in inside for e in work if e.primitive.name == BUILDS)
