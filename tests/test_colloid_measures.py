"""Suspensions of spheres: configurations known by hand, all images tried by force, ideal gas,
lattice, freud."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine.flow import Flow
from dpdjax.measure import distribution
from dpdjax.measure.clusters import clusters
from dpdjax.measure.contact_bonds import bonded_pairs, contact_bonds
from dpdjax.measure.contacts import contact_number
from dpdjax.measure.distribution import pair_distribution, partial_distribution
from dpdjax.measure.scattering import structure_factor
from dpdjax.measure.spheres import Spheres, spheres
from dpdjax.measure.structure import radial_distribution
from dpdjax.pairs import box as boxes

SIDES = np.array([6.0, 7.0, 8.0])
STRAINS = [0.0, 0.25, -0.4]


def thrown(*shape, seed=0, sides=SIDES):
    return np.random.default_rng(seed).random((*shape, 3)) * sides


def mixed_radii(n, seed=0):
    return np.random.default_rng(seed + 100).uniform(0.2, 0.6, n)


def lattice_of(strain):
    lattice = np.diag(SIDES)
    lattice[1, 0] = strain * SIDES[1]
    return lattice


def gaps_by_force(position, radius, strain):
    """Surface gaps of all images up to two cells away, (n, n, images), and the images, (images,
    3)."""
    images = np.array(list(itertools.product((-2, -1, 0, 1, 2), repeat=3)))
    lattice = lattice_of(strain - SIDES[0] / SIDES[1] * np.round(strain * SIDES[1] / SIDES[0]))
    position = position @ np.linalg.inv(lattice) % 1 @ lattice
    d = position[None, :, None] + images @ lattice - position[:, None, None]
    return np.linalg.norm(d, axis=-1) - (radius[:, None] + radius[None, :])[..., None], images


def nearest_by_force(position, radius, strain):
    """Smallest gap of each pair i < j, (pairs,)."""
    h = gaps_by_force(position, radius, strain)[0].min(axis=-1)
    return h[np.triu_indices(len(radius), 1)]


def apart(*gaps):
    """Pairs of spheres of diameter 1 along x with these gaps, one frame to each, (frames, 2, 3)."""
    position = np.ones((len(gaps), 2, 3))
    position[:, 1, 0] += 1.0 + np.array(gaps)
    return position


def row(count, step, start=(0.3, 0.4, 0.5)):
    """Spheres at equal steps."""
    return np.array(start) + np.arange(count)[:, None] * np.array(step)


def one_frame(position, radius=0.5, strain=0.0):
    return Spheres(position, radius, SIDES, strain)


# Pairs by surface gap.


@pytest.mark.parametrize("strain", STRAINS)
def test_gaps_are_those_of_all_images(strain):
    position, radius = thrown(60), mixed_radii(60)
    h_max = 3.0 - 2 * radius.max()
    pairs = pair_distribution(one_frame(position, radius, strain), bins=8, h_min=-0.3)
    edges = np.linspace(-0.3, h_max, 9)
    s = (radius[:, None] + radius[None, :])[np.triu_indices(60, 1)]
    ideal = [np.sum((s + b) ** 3 - (s + a) ** 3) for a, b in zip(edges, edges[1:])]
    expected = 4 / 3 * np.pi * np.array(ideal) / SIDES.prod()
    assert np.allclose(
        pairs.g * expected, np.histogram(nearest_by_force(position, radius, strain), edges)[0]
    )
    assert np.allclose(pairs.h, 0.5 * (edges[1:] + edges[:-1]))


def test_equal_spheres_have_the_radial_distribution():
    position = thrown(4, 50)
    by_gap = pair_distribution(Spheres(position, 0.5, SIDES), bins=30, h_min=-1.0)
    by_distance = radial_distribution(position, box=SIDES, bins=30)
    assert np.allclose(by_gap.h + 1.0, by_distance.r)
    assert np.allclose(by_gap.g, by_distance.g)
    assert np.allclose(by_gap.error, by_distance.error)


def test_counts_in_small_blocks(monkeypatch):
    gas = Spheres(thrown(2, 37), mixed_radii(37), SIDES, 0.3)
    whole = pair_distribution(gas, bins=9)
    monkeypatch.setattr(distribution, "PAIRS_AT_ONCE", 100)
    assert np.array_equal(pair_distribution(gas, bins=9).g, whole.g)


def test_ideal_gas_of_mixed_radii_has_no_structure():
    gas = Spheres(thrown(240, 60), mixed_radii(60), SIDES, np.linspace(0, 2, 240))
    pairs = pair_distribution(gas, bins=20)
    assert np.all(np.abs(pairs.g - 1) < 5 * pairs.error)
    assert np.mean(((pairs.g - 1) / pairs.error) ** 2) < 2.5
    assert np.all(pairs.error[5:] < 0.05)


def test_members_with_their_own_radii():
    position, radius = thrown(2, 5, 40), np.stack([mixed_radii(40), mixed_radii(40, seed=1)])
    whole = pair_distribution(Spheres(position, radius, SIDES), bins=5, h_max=1.5)
    members = [
        pair_distribution(Spheres(x, r, SIDES), bins=5, h_max=1.5).g
        for x, r in zip(position, radius)
    ]
    assert np.allclose(whole.g, np.mean(members, axis=0))


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


# Contacts.


def test_contacts_of_a_dimer_and_a_monomer():
    position = np.concatenate([apart(0.1)[0], [[1.0, 4.0, 4.0]]])
    contacts = contact_number(one_frame(position), gap=0.2)
    assert contacts.z.tolist() == [0, 1] and np.allclose(contacts.share, [1 / 3, 2 / 3])
    assert contacts.mean.value == pytest.approx(2 / 3) and np.isnan(contacts.mean.error)
    assert contact_number(one_frame(position), gap=0.05).mean.value == 0


@pytest.mark.parametrize("shift, contacts", [(1.5, 1), (0.0, 0), (-1.5, 0)])
def test_contacts_across_a_tilted_face(shift, contacts):
    """The image above the lower sphere stands ``shift`` off along x: over the upper sphere, or
    not."""
    position = np.array([[1.0, 0.4, 1.0], [2.5, 6.4, 1.0]])
    assert contact_number(one_frame(position, strain=shift / 7), gap=0.01).mean.value == contacts


@pytest.mark.parametrize("strain", STRAINS)
def test_contacts_are_those_of_all_images(strain):
    position, radius = thrown(6, 50), mixed_radii(50)
    contacts = contact_number(Spheres(position, radius, SIDES, strain), gap=0.5)
    by_force = np.array(
        [2 * np.sum(nearest_by_force(x, radius, strain) < 0.5) / 50 for x in position]
    )
    assert np.allclose(contacts.series, by_force[None])
    assert contacts.share.sum() == pytest.approx(1)
    assert np.sum(contacts.z * contacts.share) == pytest.approx(contacts.mean.value)
    assert contacts.mean.error > 0 and np.all(contacts.error >= 0)


def test_the_gap_of_a_fluid_with_a_range():
    """That of the attraction between the spheres, up to its reach; a Yukawa ``kappa`` is none."""
    run = lambda **numbers: recorded(
        apart(0.1, 0.3), fluid=dpd.colloid_fluid(radius=0.5, **numbers)
    )
    assert contact_number(run(kappa=15.0)).gap == pytest.approx(0.2)
    assert contact_number(run(kappa=15.0, r0=0.05)).gap == pytest.approx(0.25)
    assert contact_number(run(kappa=2.0)).gap == pytest.approx(1.0), "cut off at r_c"
    assert contact_number(run(kappa=15.0)).series.tolist() == [[1, 0]]
    assert contact_number(run(kappa=15.0), gap=0.5).series.tolist() == [[1, 1]]
    depletion = dpd.term(dpd.laws.asakura_oosawa, phi_p=0.2, r_g=0.1)
    assert contact_number(run(attraction=depletion)).gap == pytest.approx(0.2 * (1 - 0.1**0.5))
    charged = dpd.term(dpd.laws.yukawa, epsilon=1.0, kappa=15.0)
    scan = dpd.colloid_fluid(radius=0.5).set(kappa=np.array([15.0, 20.0]))
    for what in (run(attraction=charged), one_frame(apart(0.1))):
        with pytest.raises(ValueError, match="no gap is given.*give gap"):
            contact_number(what)
    with pytest.raises(ValueError, match="differ in kappa"):
        contact_number(recorded(apart(0.1), fluid=scan))


# Structure factor.


def test_structure_factor_by_force():
    position, radius = thrown(3, 30), mixed_radii(30)
    s = structure_factor(Spheres(position, radius, SIDES), q_max=4.0, bins=6)
    m = np.array([v for v in itertools.product(range(-6, 7), repeat=3) if any(v)])
    waves = 2 * np.pi * m / SIDES
    q = np.linalg.norm(waves, axis=1)
    waves, q = waves[q <= 4.0], q[q <= 4.0]
    power = np.abs(np.exp(-1j * position @ waves.T).sum(axis=1)) ** 2 / 30
    shell = np.minimum((q / 4.0 * 6).astype(int), 5)
    vectors = np.bincount(shell, minlength=6)
    full = vectors > 0
    mean = lambda values: np.bincount(shell, values, 6)[full] / vectors[full]
    assert np.array_equal(s.vectors, vectors[full])
    assert np.allclose(s.q, mean(q))
    assert np.allclose(s.s, np.mean([mean(p) for p in power], axis=0))


def test_ideal_gas_scatters_alike_everywhere():
    s = structure_factor(Spheres(thrown(2, 100, 40), 0.5, SIDES), q_max=5.0, bins=15)
    assert np.all(np.abs(s.s - 1) < 5 * s.error)
    assert np.all(s.error < 0.3) and np.all(s.error[-3:] < 0.05)


def test_bragg_peak_of_a_simple_cubic_lattice():
    sites = np.stack(np.meshgrid(*3 * [np.arange(4) * 1.5], indexing="ij"), -1).reshape(-1, 3) + 0.2
    s = structure_factor(Spheres(sites, 0.5, 6.0), q_max=2 * np.pi / 1.5, bins=400)
    assert s.q[-1] == pytest.approx(2 * np.pi / 1.5)
    assert s.s[-1] * s.vectors[-1] == pytest.approx(64 * 6)
    assert np.allclose(s.s[:-1], 0)


def test_whole_turns_of_the_box_are_no_tilt():
    position = thrown(20)
    turned, straight = (
        structure_factor(one_frame(position, strain=strain), q_max=3.0) for strain in (12 / 7, 0.0)
    )
    assert np.allclose(turned.s, straight.s)


# Bonds.


def test_a_bond_in_and_out_of_the_band():
    """Gap 1: forms below 0.8, lives on in the band up to 1, breaks above, does not form in the
    band."""
    tracked = contact_bonds(one_frame(apart(0.9, 0.7, 0.9, 1.0, 0.95, 1.1, 0.9, 0.5)), gap=1.0)
    assert tracked.number.tolist() == [[0, 1, 1, 1, 1, 0, 0, 1]]
    assert tracked.formed.tolist() == [[0, 1, 0, 0, 0, 0, 0, 1]]
    assert tracked.broken.tolist() == [[0, 0, 0, 0, 0, 1, 0, 0]]
    assert tracked.per_colloid.value == pytest.approx(5 / 8)


def test_bonds_without_a_band_are_contacts():
    gas = Spheres(thrown(2, 10, 40), mixed_radii(40), SIDES, 0.2)
    tracked, contacts = contact_bonds(gas, gap=0.5, forms=1.0), contact_number(gas, gap=0.5)
    assert np.allclose(2 * tracked.number / 40, contacts.series)
    assert tracked.per_colloid.value == pytest.approx(contacts.mean.value)
    assert tracked.per_colloid.error == pytest.approx(contacts.mean.error)


def wandering(frames=24, batch=2, n=40, seed=3):
    """Spheres that wander so that bonds come and go."""
    steps = 0.15 * np.random.default_rng(seed).normal(size=(batch, frames, n, 3))
    steps[:, 0] = thrown(batch, n, seed=seed)
    return Spheres(
        np.cumsum(steps, axis=1),
        mixed_radii(n),
        SIDES,
        0.1 * np.arange(frames),
        0.5 * np.arange(frames),
    )


def test_bonds_by_force():
    """Every pair of every frame followed on its own."""
    gas = wandering()
    tracked, pairs = contact_bonds(gas, gap=0.4, t_max=2.0), bonded_pairs(gas, gap=0.4)
    there = np.zeros((2, 24, 40, 40), bool)
    for b, t in np.ndindex(2, 24):
        h = gaps_by_force(gas.position[b, t], gas.radius[b], gas.strain[b, t])[0].min(axis=-1)
        before = there[b, t - 1] if t else np.zeros((40, 40), bool)
        there[b, t] = np.triu((h < 0.32) | (before & (h <= 0.4)), 1)
        assert np.array_equal(pairs[b][t], np.argwhere(there[b, t]))
    assert np.array_equal(tracked.number, there.sum((2, 3)))
    assert np.array_equal(tracked.formed[:, 1:], (there[:, 1:] & ~there[:, :-1]).sum((2, 3)))
    assert np.array_equal(tracked.broken[:, 1:], (there[:, :-1] & ~there[:, 1:]).sum((2, 3)))
    # Longest lag 4 frames: three stretches of 8 frames to a member, 4 origins each.
    origins = [8 * k + o for k in range(3) for o in range(4)]
    survive = np.array(
        [[np.all(there[:, o : o + lag + 1], axis=1).sum() for lag in range(5)] for o in origins]
    )
    assert np.allclose(tracked.lag, 0.5 * np.arange(5))
    assert np.allclose(tracked.survival, survive.sum(0) / survive.sum(0)[0])
    assert np.all(tracked.error[1:] > 0) and tracked.error[0] == 0


def test_survival_of_bonds_that_all_break():
    """Ten dimers, those of gap below the frame's number over ten broken: one more each frame."""
    frames, pairs = 11, 10
    position = np.ones((frames, 2 * pairs, 3))
    position[:, :, 2] = np.repeat(1.2 * np.arange(pairs), 2)
    held = np.arange(pairs)[None, :] >= np.arange(frames)[:, None]
    position[:, 1::2, 0] += np.where(held, 1.01, 1.5)
    tracked = contact_bonds(Spheres(position, 0.5, [6.0, 6.0, 12.0]), gap=0.1, t_max=10.0)
    assert np.allclose(tracked.survival, 1 - np.arange(frames) / 10)
    assert tracked.broken.tolist() == [[0] + 10 * [1]]
    assert np.all(np.isnan(tracked.error))


def test_bonds_of_nothing():
    tracked = contact_bonds(one_frame(apart(2.0, 2.0, 2.0)), gap=0.5)
    assert tracked.number.tolist() == [[0, 0, 0]] and np.all(np.isnan(tracked.survival))
    assert bonded_pairs(one_frame(apart(2.0)), gap=0.5)[0][0].shape == (0, 2)
    assert contact_bonds(one_frame(apart(0.1)), gap=0.5).survival.tolist() == [1.0]


# Clusters.


def test_sizes_of_chains():
    position = np.concatenate(
        [row(3, (1.05, 0, 0)), row(2, (0, 1.05, 0), (3, 3, 3)), row(1, (0, 0, 0), (5, 5, 6))]
    )
    found = clusters(one_frame(position), gap=0.1)
    assert found.largest.tolist() == [[3]] and found.number.tolist() == [[3]]
    assert found.mean_size[0, 0] == pytest.approx((9 + 4 + 1) / 6)
    assert not found.percolates.any()
    assert found.average("number").value == 3


@pytest.mark.parametrize("strain", STRAINS)
def test_a_rod_along_x_percolates_in_any_tilt(strain):
    found = clusters(one_frame(row(6, (1, 0, 0)), strain=strain), gap=0.1)
    assert found.percolates.tolist() == [[[True, False, False]]] and found.largest[0, 0] == 6
    assert found.percolation.tolist() == [1, 0, 0]
    broken = clusters(one_frame(row(5, (1, 0, 0)), strain=strain), gap=0.1)
    assert not broken.percolates.any() and broken.largest[0, 0] == 5


def test_a_rod_along_y_percolates_where_it_meets_its_image():
    upright = row(7, (0, 1, 0))
    assert clusters(one_frame(upright), gap=0.1).percolates.tolist() == [[[False, True, False]]]
    assert not clusters(one_frame(upright, strain=0.3), gap=0.1).percolates.any()
    slanted = row(7, (0.3, 1, 0))
    assert clusters(one_frame(slanted, strain=0.3), gap=0.1).percolates.tolist() == [
        [[False, True, False]]
    ]
    assert not clusters(one_frame(slanted), gap=0.1).percolates.any()


def test_a_diagonal_winds_both_ways():
    """Ten spheres from corner to corner of the x-y face."""
    diagonal = row(10, (0.6, 0.7, 0))
    assert clusters(one_frame(diagonal), gap=0.1).percolates.tolist() == [[[True, True, False]]]


def test_a_ring_does_not_percolate():
    """Nine spheres around a corner of the box: over every face, and back."""
    angle = 2 * np.pi * np.arange(9) / 9
    ring = 1.45 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    for strain in STRAINS:
        found = clusters(one_frame(ring, strain=strain), gap=0.1)
        assert found.largest[0, 0] == 9 and not found.percolates.any()


def percolates_by_force(touch, images):
    """Walk over beads and cells up to three away: (3,) whether a bead is met again in a cell off
    along each axis."""
    winds = np.zeros(3, bool)
    steps = [[(j, images[k]) for j, k in np.argwhere(bead)] for bead in touch]
    for start in range(len(touch)):
        seen, waiting = {(start, (0, 0, 0))}, [(start, (0, 0, 0))]
        while waiting:
            bead, cell = waiting.pop()
            if bead == start:
                winds |= np.array(cell) != 0
            for other, image in steps[bead]:
                there = (int(other), tuple(int(c) for c in np.array(cell) + image))
                if there not in seen and max(map(abs, there[1])) <= 3:
                    seen.add(there)
                    waiting.append(there)
        if winds.all():
            break
    return winds


@pytest.mark.parametrize("strain", STRAINS)
def test_percolation_by_force(strain):
    """Random spheres near the threshold, so that some configurations percolate along some axes."""
    position, radius = thrown(8, 24, seed=5), mixed_radii(24) + 0.3
    found = clusters(Spheres(position, radius, SIDES, strain), gap=0.6)
    for k, x in enumerate(position):
        h, images = gaps_by_force(x, radius, strain)
        h[np.arange(24), np.arange(24)] = np.inf
        assert np.array_equal(found.percolates[0, k], percolates_by_force(h < 0.6, images))
    assert 0 < found.percolates.mean() < 1
    assert np.allclose(found.percolation, found.percolates.mean((0, 1)))


# Two species.


def two_species(frames=3, a=20, b=30, strain=None):
    found = recorded(thrown(frames, a + b), strain=strain)
    found.final.species = np.arange(a + b) % 5 // 3
    return found


@pytest.mark.parametrize("strain", STRAINS)
def test_partial_distributions_by_force(strain):
    run = two_species(strain=np.full(3, strain))
    species, edges = run.final.species, np.linspace(0.0, 3.0, 7)
    for a, b in ((0, 1), (1, 0), (1, 1)):
        rdf = partial_distribution(run, a, b, bins=6)
        counts = 0
        for x in run.frames["position"]:
            r = gaps_by_force(x, np.zeros(50), strain)[0].min(axis=-1)
            r[np.diag_indices(50)] = np.inf
            counts = counts + np.histogram(r[np.ix_(species == a, species == b)], edges)[0]
        pairs = 3 * np.sum(species == a) * (np.sum(species == b) - (a == b))
        assert np.allclose(rdf.g * pairs * 4 / 3 * np.pi * np.diff(edges**3) / SIDES.prod(), counts)


def test_one_species_has_the_whole_distribution():
    run = recorded(thrown(4, 40))
    assert np.allclose(
        partial_distribution(run, 1, 1, bins=10).g, radial_distribution(run, bins=10).g
    )


# Runs.


def recorded(position, fluid=None, strain=None, flow=None, size=None):
    """What a run would leave behind of beads of species 1, radius 0.5."""
    n, frames = position.shape[-2], position.shape[-3]
    records = {
        "position": position,
        "time": np.broadcast_to(0.5 * np.arange(frames), position.shape[:-2]),
    }
    return SimpleNamespace(
        frames=records if strain is None else records | {"strain": strain},
        flow=Flow.of(flow),
        final=SimpleNamespace(
            box=SimpleNamespace(lengths=SIDES, strain=np.zeros(())),
            species=np.ones(n, int),
            size=np.ones(n) if size is None else size,
        ),
        fluid=fluid
        or SimpleNamespace(radius=(None, 0.5), interactions=(), batch_axes=lambda: None),
        interval=0.5,
    )


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


def test_one_sphere_is_a_cluster():
    found = clusters(one_frame(thrown(1)), gap=0.5)
    assert found.largest[0, 0] == found.number[0, 0] == found.mean_size[0, 0] == 1


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
        assert result.plot(ax) is ax and len(ax.lines) == len(ax.collections) == 2


# An independent package, in single precision.


@pytest.fixture(scope="module")
def gas():
    return Spheres(thrown(4, 300, seed=8), 0.3, SIDES, np.array([0.0, 0.2, -0.35, 0.4]))


def freud_systems(freud, gas):
    """Box and centred positions of each frame, as freud takes them."""
    for x, strain in zip(gas.position[0], gas.strain[0]):
        box = freud.box.Box(*SIDES, xy=strain)
        yield box, box.wrap(x)


def test_freud_counts_the_same_pairs(gas):
    freud = pytest.importorskip("freud")
    rdf = freud.density.RDF(24, 2.7, normalization_mode="finite_size")
    for k, system in enumerate(freud_systems(freud, gas)):
        rdf.compute(system, reset=k == 0)
    pairs = pair_distribution(gas, bins=24, h_min=-0.6, h_max=2.1)
    # A pair or two may change shell by rounding.
    assert np.allclose(pairs.g, rdf.rdf, rtol=2e-3)


def test_freud_finds_the_same_contacts_and_clusters(gas):
    freud = pytest.importorskip("freud")
    contacts, found = contact_number(gas, gap=0.2), clusters(gas, gap=0.2)
    for k, (box, points) in enumerate(freud_systems(freud, gas)):
        pairs = (
            freud.locality.AABBQuery(box, points)
            .query(points, {"r_max": 0.8, "exclude_ii": True})
            .toNeighborList()
        )
        assert contacts.series[0, k] == pytest.approx(len(pairs) / 300)
        cluster = freud.cluster.Cluster().compute((box, points), neighbors=pairs)
        sizes = np.bincount(cluster.cluster_idx)
        assert (found.largest[0, k], found.number[0, k]) == (sizes.max(), cluster.num_clusters)
        assert found.mean_size[0, k] == pytest.approx(np.sum(sizes**2) / 300)


def test_freud_has_the_same_structure_factor():
    """Freud takes only wave vectors without a negative component: mirrored positions, and one octet
    to a shell."""
    freud = pytest.importorskip("freud")
    mirrors = np.array([(1, y, z) for y in (1, -1) for z in (1, -1)])
    position = (thrown(2, 15, seed=9)[:, :, None, :] * mirrors).reshape(2, 60, 3)
    other = freud.diffraction.StaticStructureFactorDirect(
        bins=1000, k_max=3.1, num_sampled_k_points=0
    )
    box = freud.box.Box(*SIDES)
    for k, x in enumerate(position):
        other.compute((box, box.wrap(x)), reset=k == 0)
    s = structure_factor(Spheres(position, 0.5, SIDES), q_max=3.1, bins=1000)
    filled = np.isfinite(other.S_k[1:])
    assert np.all(s.vectors <= 8) and filled.sum() == len(s.s) > 30
    assert np.allclose(s.s, other.S_k[1:][filled], rtol=1e-4, atol=1e-4)
    assert np.allclose(s.q, other.bin_centers[1:][filled], atol=3.1 / 1000)


@pytest.mark.parametrize("strain, unit", [(0.0, 1.0), (0.4, 1.0), (0.4, 6.46)])
def test_density_of_the_solvent_between_colloids(strain, unit):
    """Uniform solvent of density 2 outside two spheres that displace twice their radius' worth."""
    rng, side = np.random.default_rng(7), 12.0
    colloids = np.array([[3.0, 3.0, 3.0], [8.0, 11.5, 8.0]])
    box = boxes.Box(np.full(3, side), strain)
    points = rng.random((int(2 * side**3), 3)) * side
    clear = np.ones(len(points), bool)
    for centre in colloids:
        d = np.asarray(boxes.displacement(box, points, centre[None]))
        clear &= np.sum(d * d, axis=1) > 1.5**2
    position = unit * np.concatenate([points[clear], colloids])
    box = boxes.Box(unit * box.lengths, strain)
    species = np.repeat([0, 1], [clear.sum(), 2])
    state = SimpleNamespace(position=position, species=species, size=np.ones(len(species)), box=box)
    among = [
        dpd.interaction(pair, dpd.term(dpd.soft_repulsion, a=0.0, r_c=unit))
        for pair in ((0, 0), (0, 1))
    ]
    fluid = dpd.fluid(kT=1.0, radius=(None, unit), interactions=among)
    measured = dpd.measure.solvent_density(fluid, state, points=4000) * unit**3
    assert abs(measured - 2.0) < 4 * 2.0 / np.sqrt(2 * side**3)
    with pytest.raises(ValueError, match="smaller clearance"):
        dpd.measure.solvent_density(fluid, state, clearance=20.0 * unit)
