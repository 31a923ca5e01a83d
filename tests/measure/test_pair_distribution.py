"""Pairs by surface gap and between two species: all images tried by force, and an ideal gas."""

import numpy as np
import pytest
from clouds import (
    SIDES,
    STRAINS,
    gaps_by_force,
    mixed_radii,
    nearest_by_force,
    one_frame,
    recorded,
    thrown,
    two_species,
)

from dpdjax.measure import distribution
from dpdjax.measure.distribution import pair_distribution, partial_distribution
from dpdjax.measure.spheres import Spheres
from dpdjax.measure.structure import radial_distribution

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


# Two species.


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
