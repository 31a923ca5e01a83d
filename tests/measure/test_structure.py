"""The radial distribution function: exact counts, ideal gas, batches, errors, a real run."""

import dataclasses
import itertools
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine.flow import Flow
from dpdjax.measure import structure
from dpdjax.measure.structure import expected_pairs, radial_distribution
from dpdjax.pairs.box import Box

SIDES = np.array([4.0, 5.0, 6.0])


def ideal_gas(*shape, seed=0):
    return np.random.default_rng(seed).random((*shape, 3)) * SIDES


def ordered_pairs(g, n, volume, r_max):
    """The counts behind a g(r)."""
    edges = np.linspace(0.0, r_max, len(g) + 1)
    return g * expected_pairs(edges, n, [volume])[0]


def counted_by_hand(position, lattice, r_max, bins):
    """Ordered pairs over all images (images beyond the nearest lie outside ``r_max``)."""
    shifts = np.array(list(itertools.product((-1, 0, 1), repeat=3))) @ lattice
    d = position[:, None, None] - position[None, :, None] + shifts
    r = np.linalg.norm(d, axis=-1)[~np.eye(len(position), dtype=bool)]
    return np.histogram(r, bins, (0.0, r_max))[0]


def test_ideal_gas_has_no_structure():
    rdf = radial_distribution(ideal_gas(240, 60), box=SIDES, bins=20)
    assert rdf.r[-1] == pytest.approx(2.0 * 39 / 40)
    assert np.all(np.abs(rdf.g - 1) < 5 * rdf.error)
    assert np.mean(((rdf.g - 1) / rdf.error) ** 2) < 2.5
    assert np.all(rdf.error[5:] < 0.03)


def test_lattice_shells_are_exact():
    sites = np.stack(np.meshgrid(*3 * [np.arange(4) + 0.5], indexing="ij"), -1).reshape(-1, 3)
    rdf = radial_distribution(sites, box=4.0, bins=7, r_max=1.9)
    assert np.allclose(ordered_pairs(rdf.g, 64, 64.0, 1.9), [0, 0, 0, 6 * 64, 0, 12 * 64, 8 * 64])
    assert np.all(np.isnan(rdf.error))


@pytest.mark.parametrize("strain", [0.0, 0.3, -0.4])
def test_counts_in_small_blocks_and_a_tilted_box(strain, monkeypatch):
    monkeypatch.setattr(structure, "PAIRS_AT_ONCE", 200)
    position = ideal_gas(37, seed=1)
    lattice = np.diag(SIDES)
    lattice[1, 0] = strain * SIDES[1]
    rdf = radial_distribution(position, box=Box(SIDES, np.asarray(strain)), bins=9)
    by_hand = counted_by_hand(position, lattice, 2.0, 9)
    assert np.allclose(ordered_pairs(rdf.g, 37, SIDES.prod(), 2.0), by_hand)


def test_a_batch_is_the_mean_of_its_members():
    position = ideal_gas(2, 15, 30)
    whole = radial_distribution(position, box=SIDES, bins=5)
    members = [radial_distribution(p, box=SIDES, bins=5).g for p in position]
    assert np.allclose(whole.g, np.mean(members, axis=0))
    assert np.all(whole.error > 0)


def test_unwrapped_positions_count_the_same():
    position = ideal_gas(10, 30)
    shifts = np.random.default_rng(2).integers(-2, 3, position.shape) * SIDES
    a, b = (radial_distribution(p, box=SIDES, bins=5) for p in (position, position + shifts))
    assert np.allclose(a.g, b.g)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({}, "give box"),
        ({"box": SIDES, "r_max": 2.1}, "r_max is 2.1.*half the shortest side, 2"),
        ({"box": SIDES, "r_max": -1.0}, "r_max is -1"),
        ({"box": SIDES, "bins": 0}, "bins is 0"),
        ({"box": -1.0}, "box"),
    ],
)
def test_wrong_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        radial_distribution(ideal_gas(8), **arguments)


@pytest.mark.parametrize(
    "position, message",
    [
        (np.zeros((4, 2)), r"shape \(4, 2\)"),
        (np.zeros((0, 4, 3)), r"shape \(0, 4, 3\)"),
        (np.zeros((1, 3)), "one bead"),
        (np.full((4, 3), np.nan), "NaN"),
    ],
)
def test_wrong_positions(position, message):
    with pytest.raises(ValueError, match=message):
        radial_distribution(position, box=SIDES)


def test_wrong_trajectories(water):
    final = SimpleNamespace(box=Box(SIDES, np.zeros(())))
    run = {"final": final, "fluid": water, "interval": 0.1, "dt": 0.1}
    frames = {"time": np.arange(5), "position": ideal_gas(5, 8)}
    with pytest.raises(
        ValueError, match="sheared, and the tilt of the box in each frame is unknown; record it too"
    ):
        radial_distribution(SimpleNamespace(frames=frames, flow=Flow.of(dpd.shear(0.1)), **run))
    frames = frames | {"strain": np.zeros(5)}
    with pytest.raises(
        ValueError,
        match="recorded means of 'position', not its value at a time; use observe=dpd.observe.pos",
    ):
        radial_distribution(
            SimpleNamespace(frames=frames, flow=Flow.of(dpd.shear(0.1)), means=("position",), **run)
        )
    standard = SimpleNamespace(frames={"temperature": np.ones(5)}, flow=Flow(), final=final)
    with pytest.raises(
        ValueError, match="no 'position' but temperature; use observe=dpd.observe.positions"
    ):
        radial_distribution(standard)
    with pytest.raises(ValueError, match="knows its box"):
        radial_distribution(standard, box=SIDES)


def test_results_draw_themselves(monkeypatch):
    pytest.importorskip("matplotlib").use("Agg")
    rdf = radial_distribution(ideal_gas(6, 20), box=SIDES, bins=5)
    ax = rdf.plot()
    assert ax.get_xlabel() == "r [length]"
    assert rdf.plot(ax) is ax and len(ax.lines) == len(ax.collections) == 2
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ImportError, match="matplotlib"):
        rdf.plot()


def test_structure_of_water():
    """Soft beads at density 3: first peak near 0.88 (Warren's HNC), half empty at 0.5."""
    water, key = dpd.water(), jax.random.key(3)
    state = dpd.initial_state(water, key, box=5.0, density=3.0)
    plan = dpd.Plan(frames=60, every=10)
    run = dpd.simulate(water, state, key, 0.02, plan, observe=dpd.observe.positions)
    late = dataclasses.replace(
        run, frames={name: values[20:] for name, values in run.frames.items()}
    )
    rdf = radial_distribution(late, bins=50)
    assert abs(rdf.r[np.argmax(rdf.g)] - 0.88) < 0.1
    assert abs(np.interp(0.5, rdf.r, rdf.g) - 0.59) < 0.06
    assert abs(rdf.g[-10:].mean() - 1) < 0.01


def test_a_scan_is_not_pooled(water, fresh, key):
    """What differs is named; members, and replicas of one fluid, are measured."""
    keys = jax.random.split(key, 2)
    go = lambda fluid: dpd.run(
        fluid, fresh, keys, 0.005, dpd.Plan(2, 2), observe=dpd.observe.positions, progress=False
    )
    scan = go(water.set(gamma=np.array([4.5, 9.0]), kT=np.array([1.0, 0.5])))
    for measure in (
        radial_distribution,
        dpd.diffusion,
        dpd.measure.mean_squared_displacement,
        dpd.measure.velocity_autocorrelation,
    ):
        with pytest.raises(
            ValueError,
            match="the members of this batch differ in gamma, kT; measure them one by one",
        ):
            measure(scan)
    assert len([radial_distribution(member) for member in scan.members()]) == 2
    assert radial_distribution(go(water.set(gamma=np.array([4.5, 4.5])))).g.shape == (100,)
