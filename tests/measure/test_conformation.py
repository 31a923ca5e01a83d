"""Molecules read off their bonds, and what is measured of phantom chains, whose answers are
exact."""

import dataclasses
import warnings

import chains
import gaussian
import jax
import matplotlib
import numpy as np
import pytest
from gaussian import FRICTION, INTERVAL, SIDES, SPRING

import dpdjax as dpd
from dpdjax.bonded.forces import measured
from dpdjax.engine.flow import Flow
from dpdjax.engine.system import System
from dpdjax.measure import molecules as reading
from dpdjax.measure.molecules import by_molecule

matplotlib.use("Agg")

FRAMES, CHAINS, N = 600, 20, 12
DUE = 1.0 / (4 * SPRING * np.sin(0.5 * np.pi * np.arange(1, N) / N) ** 2)
"""Mean square of a component of each mode."""
ERRORS = 4.0


@pytest.fixture(scope="module")
def path():
    return gaussian.paths(3, FRAMES, CHAINS, N)


@pytest.fixture(scope="module")
def run(path):
    return gaussian.run(path)


@pytest.fixture(scope="module")
def shuffled(path):
    """The same chains in a tilted box, the beads in any order of rows, and of ids."""
    rng = np.random.default_rng(0)
    ids, order = rng.permutation(CHAINS * N).reshape(CHAINS, N), rng.permutation(CHAINS * N)
    relabelled = np.empty_like(path.reshape(FRAMES, -1, 3))
    relabelled[:, ids.ravel()] = path.reshape(FRAMES, -1, 3)
    bonds = np.stack([ids[:, :-1], ids[:, 1:]], axis=-1).reshape(-1, 2)
    groups = {"spring": rng.permuted(bonds, axis=1)}
    x = relabelled.reshape(path.shape)
    return gaussian.run(x, strain=0.31, order=order, groups=groups)


def agrees(found, due):
    assert 0 < found.error < 0.2 * abs(due)
    assert found.deviation(due) < ERRORS, (found, due)


def state_of(bonds, species=None, n=12):
    """A state with these bonds."""
    return gaussian.run(np.zeros((1, 1, n, 3)), groups=bonds, species=species).final


class Swelling(dpd.integrators.VelocityVerlet):
    """Stands for one that changes the sides of the box."""

    changes_box = True


jax.tree_util.register_static(Swelling)

# ------------------------------------------------------------ reading


def test_molecules_by_architecture():
    """Two chains, one of them the other way round, a star and a ring; single beads are none."""
    species = np.array([0] * 8 + [1] * 6)
    bonds = {
        "a": np.array([[0, 1], [1, 8], [9, 3], [3, 2]]),
        "b": np.array([[5, 4], [5, 6], [5, 10]]),
        "c": np.array([[11, 12], [12, 13], [13, 11]]),
    }
    pair, *others = dpd.measure.molecules_of(state_of(bonds, species, 14))
    assert pair.ids.tolist() == [[0, 1, 8], [2, 3, 9]]
    assert pair.species == (0, 0, 1) and pair.is_linear
    star, ring = others
    assert star.count == ring.count == 1 and not star.is_linear and not ring.is_linear
    assert sorted(star.ids[0]) == [4, 5, 6, 10] and sorted(star.species) == [0, 0, 0, 1]
    assert ring.ids.tolist() == [[11, 12, 13]] and len(ring.bonds) == 3
    assert sorted(bead for bead, _ in star.tree) == [1, 2, 3]
    assert repr(pair) == "Molecules(2 linear of length 3, species 0 x 2, 1)"


def test_branched_molecules_are_known_again_in_any_order():
    """Lipids of two tails whose ids are shuffled: of one architecture, beads that are alike in one
    column."""
    rng = np.random.default_rng(1)
    tree = np.array([[0, 1], [1, 2], [2, 3], [3, 4], [2, 5], [5, 6], [0, 7]])
    ids = rng.permutation(80).reshape(10, 8)
    species = np.zeros(80, int)
    species[ids[:, [0, 7]]] = 1
    order = np.argsort(species, kind="stable")
    ids = np.argsort(order)[ids]
    (found,) = dpd.measure.molecules_of(
        state_of({"spring": ids[:, tree].reshape(-1, 2)}, species[order], 80)
    )
    assert found.ids.shape == (10, 8) and found.species.count(1) == 2
    place = {bead: k for row in found.ids for k, bead in enumerate(row)}
    for bead in (0, 1, 2, 7):
        assert len({place[k] for k in ids[:, bead]}) == 1


def test_duplicate_bonds_count_once():
    (found,) = dpd.measure.molecules_of(
        state_of({"a": np.array([[0, 1]]), "b": np.array([[1, 0]])})
    )
    assert found.is_linear and found.bonds == ((0, 1),)


def test_chains_are_chosen():
    species = np.array([0] * 9 + [1] * 3)
    bonds = {"s": np.array([[0, 1], [2, 3], [3, 9], [4, 5], [5, 6], [10, 11]])}
    state = state_of(bonds, species)
    with pytest.raises(ValueError, match="4 kinds of molecules fit length = None.*there are 1 lin"):
        dpd.measure.chains(state)
    with pytest.raises(ValueError, match="2 kinds of molecules fit length = 3"):
        dpd.measure.chains(state, length=3)
    assert dpd.measure.chains(state, species=[1, 0, 0]).ids.tolist() == [[2, 3, 9]]
    assert dpd.measure.chains(state, species=1).ids.tolist() == [[10, 11]]
    assert dpd.measure.chains(state, species=0, length=2).ids.tolist() == [[0, 1]]
    with pytest.raises(ValueError, match="0 kinds of molecules fit length = 7"):
        dpd.measure.chains(state, length=7)


def test_beads_without_bonds_are_no_molecules(fresh):
    with pytest.raises(ValueError, match="no bonds.*state.bonded"):
        dpd.measure.molecules_of(fresh)
    with pytest.raises(TypeError, match="measures a run"):
        dpd.measure.molecules_of("state")


def test_members_have_the_same_bonds(run):
    other = dataclasses.replace(run, final=run.final.bonded({"spring": _others(220)}))
    with pytest.raises(ValueError, match="differ in their bonds; measure them one by one"):
        dpd.measure.molecules_of(gaussian.joined([run, other]))


def _others(count: int):
    """As many bonds, between other beads."""
    return np.stack([np.arange(count), np.arange(count) + 2], axis=1)


def test_molecules_are_in_one_piece(path, shuffled, monkeypatch):
    """Bond by bond as they were before they were wrapped, whatever is done at a time."""
    which = dpd.measure.chains(shuffled)
    lengths = lambda x: np.linalg.norm(np.diff(x, axis=2), axis=-1)
    bonds = lambda x: np.sort(lengths(x).reshape(len(x), -1), axis=1)
    for many in (2**20, 1000):
        monkeypatch.setattr(reading, "BEADS_AT_ONCE", many)
        found = by_molecule(shuffled, which.ids, which.tree, lambda x: x)[0]
        np.testing.assert_allclose(bonds(found), bonds(path), atol=1e-9)


def test_lengths_of_each_frame(path):
    """A box that swells, as frames record it."""
    run = gaussian.run(path[:5])
    factor = np.linspace(1.0, 1.2, 5)[:, None]
    swollen = run.frames | {
        "position": run.frames["position"] * factor[..., None],
        "lengths": SIDES * factor,
    }
    system = dataclasses.replace(run.system, integrator=Swelling())
    run = dataclasses.replace(run, frames=swollen, system=system, every=None)
    found = dpd.measure.end_to_end(run)
    square = np.sum((path[:5, :, -1] - path[:5, :, 0]) ** 2, axis=-1)
    assert np.isclose(found.mean_square.value, np.mean(square * factor**2))
    assert found.correlation is None
    with pytest.raises(ValueError, match="no autocorrelation was measured"):
        found.plot()
    area = dpd.measure.area_per_lipid(run)
    assert np.isclose(area.value, np.mean(factor**2) * 56 * 2 / CHAINS) and area.error > 0


# ------------------------------------------------------------ phantom chains


def test_size_of_phantom_chains(run):
    found = dpd.measure.end_to_end(run)
    agrees(found.mean_square, 3 * (N - 1) / SPRING)
    agrees(found.mean, np.sqrt(8 * (N - 1) / SPRING / np.pi))
    agrees(found.correlation.relaxation_time, FRICTION * DUE[0])
    gyration = dpd.measure.radius_of_gyration(run)
    agrees(gyration.mean_square, (N**2 - 1) / (2 * N * SPRING))
    assert np.isclose(sum(e.value for e in gyration.eigenvalues), gyration.mean_square.value)
    assert gyration.eigenvalues[0].value > 3 * gyration.eigenvalues[1].value


def test_rouse_modes_of_phantom_chains(run):
    found = dpd.measure.rouse_modes(run)
    assert np.all(np.abs(found.mean_square - DUE) < ERRORS * found.error)
    assert np.all(found.error < 0.15 * DUE)
    seen = FRICTION * DUE > 1.05 * INTERVAL
    off = np.abs(found.relaxation_time - FRICTION * DUE)[seen] / found.relaxation_error[seen]
    assert np.all(off < ERRORS) and np.all(
        np.isnan(found.relaxation_time[FRICTION * DUE < 0.9 * INTERVAL])
    )
    # The squares of all modes are those of the radius of gyration.
    gyration = dpd.measure.radius_of_gyration(run).mean_square.value
    assert np.isclose(3 * found.mean_square.sum() / N, gyration)


def test_centres_diffuse(run):
    due = 1.0 / (FRICTION * N) * (1 - 1 / CHAINS)
    agrees(dpd.measure.molecular_diffusion(run, fit=(5.0, 10.0)), due)
    agrees(dpd.measure.molecular_diffusion(run, fit=(5.0, 10.0), axes="yz"), due)
    found = dpd.measure.molecular_displacement(run, t_max=10.0)
    assert abs(found.value[-1] - 60 * due) < ERRORS * found.error[-1]


def test_any_order_of_beads_in_a_tilted_box(run, shuffled):
    """The same chains, whole: every number is the same, apart from which chains make a group."""
    one, other = (dpd.measure.end_to_end(r).mean_square for r in (run, shuffled))
    assert np.isclose(one.value, other.value) and other.error < 2 * one.error
    one, other = (dpd.measure.rouse_modes(r) for r in (run, shuffled))
    np.testing.assert_allclose(one.mean_square, other.mean_square)
    one, other = (dpd.measure.radius_of_gyration(r).mean_square for r in (run, shuffled))
    assert np.isclose(one.value, other.value)
    one, other = (dpd.measure.molecular_displacement(r).value for r in (run, shuffled))
    np.testing.assert_allclose(one, other, atol=1e-9)
    one, other = (dpd.measure.bond_lengths(r).density for r in (run, shuffled))
    np.testing.assert_allclose(one, other, atol=1e-9)


def test_replicas_are_pooled(path):
    halves = [gaussian.run(path[: FRAMES // 2]), gaussian.run(path[FRAMES // 2 :])]
    both = dpd.measure.end_to_end(gaussian.joined(halves))
    each = [dpd.measure.end_to_end(half).mean_square.value for half in halves]
    assert np.isclose(both.mean_square.value, np.mean(each))
    agrees(both.mean_square, 3 * (N - 1) / SPRING)
    found = dpd.measure.bond_lengths(gaussian.joined(halves))
    agrees(found.mean_square, 3 / SPRING)


def test_errors_cover_short_runs():
    """Ten frames in which no chain moves much: the error is that of so many chains."""
    off = []
    for seed in range(8):
        path = gaussian.paths(seed, 10, 24, N, interval=0.01)
        with pytest.warns(UserWarning, match="remembered at the longest lag.*run longer"):
            found = dpd.measure.end_to_end(gaussian.run(path, interval=0.01)).mean_square
        off.append((found.value - 3 * (N - 1) / SPRING) / found.error)
    assert 0.3 < np.std(off) < 2.0 and np.max(np.abs(off)) < 5.0


def test_chains_alone_may_be_recorded(path):
    """The rows of one species, as ``positions_of`` has them."""
    n = N * CHAINS
    solvent = np.random.default_rng(0).random((8, CHAINS, N, 3)) * SIDES
    both = np.concatenate([solvent, path[:8]], axis=1)
    species = np.repeat([0, 1], n)
    ids = np.arange(n, 2 * n).reshape(CHAINS, N)
    groups = {"spring": np.stack([ids[:, :-1], ids[:, 1:]], axis=-1).reshape(-1, 2)}
    whole = gaussian.run(both, groups=groups, species=species)
    names = ("position", "image")
    part = dataclasses.replace(
        whole, frames=whole.frames | {k: whole.frames[k][:, n:] for k in names}
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        one, other = (dpd.measure.end_to_end(r, t_max=1.0).mean_square for r in (whole, part))
    assert one == other
    fewer = dataclasses.replace(
        whole, frames=whole.frames | {k: whole.frames[k][:, :5] for k in names}
    )
    with pytest.raises(ValueError, match="recorded 5 of its 480 beads, not the 240"):
        dpd.measure.end_to_end(fewer)


def test_what_is_not_linear_is_told():
    star = {"spring": np.array([[0, 1], [0, 2], [0, 3]])}
    run = gaussian.run(gaussian.paths(0, 6, 1, 4), groups=star)
    for measure in (dpd.measure.end_to_end, dpd.measure.rouse_modes):
        with pytest.raises(ValueError, match="measures linear chains.*1 branched or ringed of len"):
            measure(run)
    assert dpd.measure.radius_of_gyration(run).mean_square.value > 0


# ------------------------------------------------------------ bonds, angles, lipids


def test_bond_lengths_of_springs(run):
    found = dpd.measure.bond_lengths(run, "spring", bins=40)
    agrees(found.mean, np.sqrt(8 / SPRING / np.pi))
    agrees(found.mean_square, 3 / SPRING)
    width = found.x[1] - found.x[0]
    due = 4 * np.pi * found.x**2 * (SPRING / 2 / np.pi) ** 1.5 * np.exp(-SPRING / 2 * found.x**2)
    some = due > 0.05
    assert np.isclose(found.density.sum() * width, 1.0)
    assert np.all(np.abs(found.density - due)[some] < (5 * found.error + width**2)[some])
    assert found.mean_cosine is None


def test_angles_and_dihedrals_of_free_chains(path):
    """Those of directions that know nothing of each other."""
    run = gaussian.run(path[:200])
    ids = np.arange(CHAINS * N).reshape(CHAINS, N)
    rows = lambda k: np.concatenate([ids[:, s : s + k] for s in range(N - k + 1)])
    groups = {"spring": rows(2), "bend": rows(3), "twist": rows(4)}
    run = dataclasses.replace(run, final=run.final.bonded(groups))
    bend, twist = dpd.measure.angles(run, "bend", bins=12), dpd.measure.dihedrals(run, bins=12)
    agrees(bend.mean, np.pi / 2)
    agrees(bend.mean_square, np.pi**2 / 2 - 2)
    agrees(twist.mean, np.pi / 2)
    agrees(twist.mean_square, np.pi**2 / 3)
    assert bend.mean_cosine.deviation(0.0) < ERRORS and twist.mean_cosine.deviation(0.0) < ERRORS
    assert np.all(np.abs(twist.density - 1 / np.pi) < 5 * twist.error)
    due = -np.diff(np.cos(np.linspace(0, np.pi, 13))) / 2 / (np.pi / 12)
    assert np.all(np.abs(bend.density - due) < 5 * bend.error)
    with pytest.raises(ValueError, match="name is 'twist'; the types of angle .* are: 'bend'"):
        dpd.measure.angles(run, "twist")


def test_angles_are_those_of_the_laws():
    """In line pi, at a corner pi/2; trans is pi."""
    x = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [2, 1, 0]])
    groups = {"s": np.array([[0, 1]]), "bend": np.array([[0, 1, 2]]), "t": np.array([[0, 1, 2, 3]])}
    run = gaussian.run(np.broadcast_to(x - 0.5, (3, 1, 4, 3)), groups=groups)
    assert np.isclose(dpd.measure.angles(run).mean.value, np.pi / 2)
    assert np.isclose(dpd.measure.dihedrals(run).mean.value, np.pi, atol=1e-6)
    assert np.isclose(dpd.measure.bond_lengths(run).mean.value, 1.0)


def test_order_of_bonds_and_lipids():
    """All along one axis, across it, and in all directions."""
    x = np.zeros((2, 6, 4, 3))
    x[..., 2] = 0.9 * np.arange(4)
    x[..., :2] = np.random.default_rng(0).random((6, 1, 2))
    species = np.tile([0, 1, 1, 1], 6)
    order = np.argsort(species, kind="stable")
    flat = x.reshape(2, 24, 3)[:, order].reshape(x.shape)
    ids = np.argsort(order).reshape(6, 4)
    groups = {"spring": np.stack([ids[:, :-1], ids[:, 1:]], axis=-1).reshape(-1, 2)}
    run = gaussian.run(flat, groups=groups, species=species[order])
    for how in ({}, {"head": 0}):
        assert np.isclose(dpd.measure.order_parameter(run, **how).value, 1.0)
        assert np.isclose(dpd.measure.order_parameter(run, normal="x", **how).value, -0.5)
    assert np.isclose(dpd.measure.area_per_lipid(run).value, 56 / 3)
    assert np.isclose(dpd.measure.area_per_lipid(run, normal="x", leaflets=1).value, 72 / 6)
    with pytest.raises(ValueError, match="head is species 3.*0 such beads of 4"):
        dpd.measure.order_parameter(run, head=3)
    with pytest.raises(ValueError, match="choose lipids, and bonds are chosen by name"):
        dpd.measure.order_parameter(run, length=4)
    with pytest.raises(ValueError, match="normal is 'w'"):
        dpd.measure.order_parameter(run, normal="w")
    with pytest.raises(ValueError, match="no molecule fits length = 9"):
        dpd.measure.area_per_lipid(run, length=9)


def test_bonds_in_all_directions(run):
    found = dpd.measure.order_parameter(run, "spring")
    assert found.deviation(0.0) < ERRORS and found.error < 0.01


def test_pairs_within_and_between_molecules(shuffled):
    """Within them as a Gaussian chain has them, between them none that is not there; both are
    all."""
    run = dataclasses.replace(
        shuffled, frames={k: v[::60] for k, v in shuffled.frames.items()}, every=None
    )
    some = {"bins": 20, "r_max": 3.0}
    of = lambda pairs: dpd.measure.partial_distribution(run, 0, 0, pairs=pairs, **some)
    within, between, both = of("within"), of("between"), of("all")
    np.testing.assert_allclose(within.g + between.g, both.g)
    apart = np.arange(1, N)[:, None]
    number, spread = N - apart, apart / SPRING
    shells = 4 * np.pi * within.r**2
    density = shells * np.exp(-0.5 * within.r**2 / spread) / (2 * np.pi * spread) ** 1.5
    beads, volume = CHAINS * N, SIDES.prod()
    ideal = beads * (beads - 1) / 2 * shells / volume
    due = CHAINS * np.sum(number * density, axis=0) / ideal
    later = within.r > 0.4
    assert np.all(np.abs(within.g - due)[later] < (5 * within.error + 0.02 * due)[later])
    assert np.all(np.abs(between.g - 1 + (N - 1) / (beads - 1)) < 6 * between.error)
    with pytest.raises(ValueError, match='pairs is "?.?others'):
        of("others")


def test_results_draw_themselves(run):
    modes = dpd.measure.rouse_modes(run)
    for ax in (
        dpd.measure.end_to_end(run).plot(),
        dpd.measure.radius_of_gyration(run).plot(),
        modes.plot(spring=1 / SPRING),
        modes.plot_correlations(),
        dpd.measure.bond_lengths(run).plot(),
    ):
        assert ax.get_xlabel() and ax.get_ylabel()
        matplotlib.pyplot.close(ax.figure)


# ------------------------------------------------------------ through the engine


def test_bonds_are_as_long_as_those_of_the_engine():
    """In a tilted box, beads in the order of memory."""
    fluid = chains.fluid()
    state = chains.state(fluid, strain=0.3)
    frames = {"time": np.ones(1), "position": np.asarray(state.position)[None]}
    frames["strain"] = np.reshape(state.box.strain, 1)
    run = dpd.Trajectory(state, frames, System.of(fluid, 0.01, Flow()), 1)
    found = by_molecule(run, np.asarray(state.topology.beads["strong"]), [(1, 0)], lambda x: x)
    lengths = np.linalg.norm(found[0, 0, :, 1] - found[0, 0, :, 0], axis=-1)
    np.testing.assert_allclose(lengths, chains.stretched(fluid, state), rtol=1e-9)
    bend = next(b for b in fluid.bonded if b.name == "bend")
    due = np.arccos(np.asarray(measured(fluid, state, bend)[0])).mean()
    assert np.isclose(dpd.measure.angles(run, "bend").mean.value, due)
