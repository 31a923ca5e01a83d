"""Spheres read off runs, and what all measures of them have in common: lattices, wrong runs and
arguments, pictures."""

import numpy as np
import pytest
from clouds import SIDES, STRAINS, lattice_of, one_frame, recorded, thrown, two_species

import dpdjax as dpd
from dpdjax.engine.flow import Flow
from dpdjax.measure.clusters import cluster_of_each, clusters
from dpdjax.measure.contact_bonds import bonded_pairs, contact_bonds
from dpdjax.measure.contacts import contact_number, contacts_of_each
from dpdjax.measure.distribution import pair_distribution, partial_distribution
from dpdjax.measure.scattering import structure_factor
from dpdjax.measure.spheres import Spheres, spheres


@pytest.mark.parametrize("strain", STRAINS)
def test_unwrapped_positions_measure_the_same(strain):
    position = thrown(3, 40)
    shifts = np.random.default_rng(2).integers(-2, 3, position.shape) @ lattice_of(strain)
    inside, outside = (Spheres(x, 0.5, SIDES, strain) for x in (position, position + shifts))
    assert np.array_equal(
        contact_number(inside, gap=0.4).series, contact_number(outside, gap=0.4).series
    )
    assert np.allclose(pair_distribution(inside, bins=5).g, pair_distribution(outside, bins=5).g)
    assert np.array_equal(
        clusters(inside, gap=0.4).percolates, clusters(outside, gap=0.4).percolates
    )


def test_strain_counts_modulo_the_box():
    position, period = thrown(3, 40), SIDES[0] / SIDES[1]
    a, b = (
        clusters(Spheres(position, 0.5, SIDES, strain), gap=0.6)
        for strain in (0.3, 0.3 - 4 * period)
    )
    assert np.array_equal(a.largest, b.largest) and np.array_equal(a.percolates, b.percolates)


def test_reading_a_run():
    size = np.linspace(0.5, 1.5, 50)
    run = two_species()
    run.final.size = size
    read, chosen = spheres(run), run.final.species == 1
    assert np.array_equal(read.position, run.frames["position"][None][:, :, chosen])
    assert np.allclose(read.radius, 0.5 * size[chosen])
    assert np.allclose(read.lengths, SIDES) and np.allclose(read.time, [0, 0.5, 1])
    assert read.strain.shape == (1, 3) and not read.strain.any()
    run.frames["position"] = run.frames["position"][:, chosen]
    assert np.array_equal(spheres(run).position, read.position)


def test_reading_a_sheared_batch():
    strain, size = 0.1 * np.arange(8.0).reshape(2, 4), np.stack([np.ones(9), np.full(9, 1.2)])
    run = recorded(thrown(2, 4, 9), strain=strain, flow=dpd.shear(0.1), size=size)
    run.final.box.lengths = np.stack([SIDES, SIDES])
    read = spheres(run)
    assert np.array_equal(read.strain, strain) and read.time.shape == (4,)
    assert np.allclose(read.radius, 0.5 * size)
    assert contact_number(run, gap=0.2).series.shape == (2, 4)


def test_a_run_is_measured_like_its_spheres():
    run = two_species(frames=4)
    for measure in (contact_number, contact_bonds, clusters):
        a, b = measure(run, gap=0.5), measure(spheres(run), gap=0.5)
        assert all(
            np.array_equal(x, y, equal_nan=True)
            for x, y in zip(vars(a).values(), vars(b).values())
            if np.ndim(x)
        )
    assert np.array_equal(pair_distribution(run).g, pair_distribution(spheres(run)).g)
    assert np.array_equal(
        structure_factor(run, q_max=3).s, structure_factor(spheres(run), q_max=3).s
    )


def whole(fluid, state):
    return {f"whole_{name}": x for name, x in dpd.observe.positions(fluid, state).items()}


@pytest.mark.parametrize("rate", [0.0, 1.0])
def test_recording_one_species(simulate, key, rate):
    numbers = (
        [dpd.term(dpd.soft_repulsion, a=5.0, r_c=0.8)],
        [dpd.term(dpd.central_drag, gamma=4.5, r_c=0.8)],
    )
    among = [dpd.interaction(groups, *numbers) for groups in ((0, 0), (0, 1), (1, 1))]
    mixture = dpd.fluid(interactions=among, kT=1.0, radius=(None, 0.3))
    state = dpd.initial_state(mixture, key, box=3.6, n=(60, 12), dt=0.01, skin=0.15)
    run = simulate(
        mixture,
        state,
        key,
        0.01,
        dpd.Plan(6, 5),
        dpd.shear(rate),
        observe=(dpd.observe.positions_of(1), whole),
    )
    assert run.final.status == 0
    for name in ("position", "unwrapped", "velocity"):
        assert np.array_equal(run.frames[name], run.frames[f"whole_{name}"][:, 60:])
    strain = (0.05 * rate * np.arange(1, 7) + 0.5) % 1 - 0.5
    by_hand = Spheres(run.frames["position"], 0.3, 3.6, strain)
    assert np.allclose(spheres(run).strain, strain)
    assert np.array_equal(
        contact_number(run, gap=0.4).series, contact_number(by_hand, gap=0.4).series
    )
    if rate == 0:
        assert np.all(
            dpd.measure.mean_squared_displacement(run, species=1, t_max=0.1).value[1:] > 0
        )


def test_recording_a_species_that_is_no_group(key):
    fluid = dpd.fluid(drag=[dpd.term(dpd.central_drag, gamma=1.0, r_c=1.0)], kT=1.0, species=2)
    state = dpd.initial_state(fluid, key, box=3.0, density=1.0)
    with pytest.raises(
        ValueError, match=r"species 1 is no group.* are \(0, 1\); .*dpd.interaction\(\(1, 1\)"
    ):
        dpd.observe.positions_of(1)(fluid, state)
    assert dpd.observe.positions_of(1) is dpd.observe.positions_of(1)


def spoiled(**changes):
    run = two_species()
    for path, value in changes.items():
        *way, last = path.split("__")
        target = run
        for name in way:
            target = getattr(target, name)
        setattr(target, last, value)
    return run


@pytest.mark.parametrize(
    "run, message",
    [
        (
            spoiled(frames={"temperature": np.ones(3)}),
            "no 'position' but temperature; use observe=dpd.observe.positions",
        ),
        (spoiled(flow=Flow.of(dpd.shear(0.1))), "sheared, and the tilt of the box.*record it too"),
        (spoiled(final__species=np.zeros(50, int)), "no bead is of species 1"),
        (spoiled(fluid__radius=(None, None)), "this fluid has no spheres.*give one"),
        (spoiled(fluid__radius=(0.5, 0.5)), "species 0, 1 are spheres; name one"),
        (
            spoiled(frames={"position": thrown(3, 7), "time": np.arange(3)}),
            "7 of its 50 beads, not the 20 to be measured",
        ),
        (
            spoiled(final__box__lengths=np.stack([SIDES, 2 * SIDES])),
            r"different boxes; .*members\(\)",
        ),
    ],
)
def test_wrong_runs(run, message):
    for measure in (spheres, lambda run: contact_number(run, gap=0.1)):
        with pytest.raises(ValueError, match=message):
            measure(run)


def test_a_species_that_is_no_sphere():
    with pytest.raises(ValueError, match="species 0 has no radius.*spheres are of species 1"):
        spheres(two_species(), species=0)


def test_wrong_partial_runs():
    with pytest.raises(ValueError, match="20 of its 50 beads"):
        partial_distribution(
            spoiled(frames={"position": thrown(3, 20), "time": np.arange(3)}), 0, 1
        )
    with pytest.raises(ValueError, match="no bead is of species 3"):
        partial_distribution(two_species(), 0, 3)
    with pytest.raises(ValueError, match="one bead of species 1 has no pairs"):
        partial_distribution(spoiled(final__species=np.arange(50) // 49), 1, 1)
    with pytest.raises(ValueError, match="r_max is 3.5.*half the shortest side, 3"):
        partial_distribution(two_species(), 0, 1, r_max=3.5)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"radius": -0.5}, "radius is -0.5; it must be above zero"),
        (
            {"radius": np.ones(3)},
            r"radius has shape \(3,\); \(1, 2, 4\)|radius has shape \(3,\); \(1, 4\)",
        ),
        ({"lengths": 0.0}, "lengths is 0"),
        ({"strain": np.zeros(3)}, r"strain has shape \(3,\); \(1, 2\)"),
        ({"strain": np.nan}, "strain is nan; it must be finite"),
        ({"time": np.zeros(3)}, r"time has shape \(3,\); \(2,\)"),
        ({"position": np.full((4, 3), np.nan)}, "position holds NaN"),
        ({"position": np.zeros((4, 2))}, r"position has shape \(4, 2\)"),
    ],
)
def test_wrong_spheres(changes, message):
    right = {"position": thrown(2, 4), "radius": 0.5, "lengths": SIDES}
    with pytest.raises(ValueError, match=message):
        Spheres(**right | changes)


@pytest.mark.parametrize(
    "measure, arguments, message",
    [
        (pair_distribution, {"h_max": 2.5}, "h_max is 2.5.*at most 2, "),
        (pair_distribution, {"h_max": -0.5}, "h_max is -0.5.*above h_min, -0.05"),
        (pair_distribution, {"h_min": -1.5}, "h_min is -1.5; it must be at least -1"),
        (pair_distribution, {"bins": 0}, "bins is 0"),
        (contact_number, {"gap": -0.1}, "gap is -0.1; it must be above zero"),
        (
            contact_number,
            {"gap": 2.1},
            "gap is 2.1.*touch 3.1 apart.*half the shortest side, 3; take a smaller gap",
        ),
        (clusters, {"gap": 2.1}, "gap is 2.1"),
        (structure_factor, {"q_max": 0.5}, "q_max is 0.5.*smallest wave vector of the box, 0.785"),
        (structure_factor, {"bins": 2.5}, "bins is 2.5"),
        (contact_bonds, {"gap": 0.5, "forms": 1.2}, "forms is 1.2 and breaks 1.0"),
        (contact_bonds, {"gap": 0.5, "forms": 0.0}, "0 < forms <= breaks"),
        (contact_bonds, {"gap": 1.5, "breaks": 1.5}, "gap is 2.25"),
        (contact_bonds, {"gap": 0.5, "t_max": 5.0}, "t_max is 5; .*within the run, 3"),
        (bonded_pairs, {"gap": 0.5, "forms": 1.2}, "forms is 1.2"),
    ],
)
def test_wrong_arguments(measure, arguments, message):
    with pytest.raises(ValueError, match=message):
        measure(one_frame(thrown(4, 8)), **arguments)


def test_more_wrong_arguments():
    with pytest.raises(ValueError, match="one sphere has no pairs"):
        pair_distribution(one_frame(thrown(1)))
    with pytest.raises(ValueError, match="evenly spaced"):
        contact_bonds(Spheres(thrown(3, 8), 0.5, SIDES, time=[0.0, 1.0, 3.0]), gap=0.5)
    with pytest.raises(ValueError, match="name is 'size'; it is largest"):
        clusters(one_frame(thrown(4)), gap=0.5).average("size")


def test_results_draw_themselves():
    pytest.importorskip("matplotlib").use("Agg")
    gas = Spheres(thrown(2, 6, 20), 0.5, SIDES)
    results = [
        pair_distribution(gas, bins=5),
        contact_number(gas, gap=0.5),
        structure_factor(gas, q_max=3.0, bins=5),
        contact_bonds(gas, gap=0.5),
        clusters(gas, gap=0.5),
    ]
    labels = ["g(h)", "P(z)", "S(q)", "share of bonds that survive", "largest cluster"]
    for result, label in zip(results, labels):
        ax = result.plot()
        assert ax.get_ylabel() == label
        assert result.plot(ax) is ax
        drawn = ax.containers if label == "P(z)" else ax.lines
        assert len(drawn) in (2, 4)


def test_contact_numbers_are_bars_and_a_series():
    pytest.importorskip("matplotlib").use("Agg")
    found = contact_number(Spheres(thrown(3, 6, 20), 0.5, SIDES), gap=0.5)
    bars, stems = found.plot().containers[::-1]
    np.testing.assert_allclose([bar.get_height() for bar in bars], found.share)
    assert len(stems[2][0].get_segments()) == len(found.z)
    ax = found.plot_series(tau=2.0)
    np.testing.assert_allclose(ax.lines[0].get_xdata(), found.time / 2.0)
    np.testing.assert_allclose(ax.lines[0].get_ydata(), found.series.mean(axis=0))
    low, high = (f(ax.collections[0].get_paths()[0].vertices[:, 1]) for f in (np.min, np.max))
    assert low < found.series.mean(axis=0).min() and high > found.series.mean(axis=0).max()
    assert ax.get_xlabel() == "t/tau" and found.plot_series().get_xlabel() == "t [time]"
    with pytest.raises(ValueError, match="tau"):
        found.plot_series(tau=0.0)


def test_contacts_and_cluster_of_each_sphere():
    """Three in a row, across a face, two together, one alone."""
    x = np.array([0.4, 5.5, 1.4, 3.0, 3.0, 3.0])
    y = np.array([1.0, 1.0, 1.0, 4.0, 4.95, 6.0]) + np.array([0, 0, 0, 0, 0, 0.5])
    frame = one_frame(np.stack([x, y, np.full(6, 2.0)], axis=1), strain=0.0)
    assert contacts_of_each(frame, gap=0.15)[0, 0].tolist() == [2, 1, 1, 1, 1, 0]
    assert cluster_of_each(frame, gap=0.15)[0, 0].tolist() == [0, 0, 0, 1, 1, 2]
