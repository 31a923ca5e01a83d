"""Measures of spheres beside freud, an independent package in single precision."""

import numpy as np
import pytest
from clouds import SIDES, thrown

from dpdjax.measure.clusters import clusters
from dpdjax.measure.contacts import contact_number
from dpdjax.measure.distribution import pair_distribution
from dpdjax.measure.scattering import structure_factor
from dpdjax.measure.spheres import Spheres


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
