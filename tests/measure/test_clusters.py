"""Clusters of spheres: chains, rods and rings known by hand, and percolation found by walking over
all images."""

import numpy as np
import pytest
from clouds import SIDES, STRAINS, gaps_by_force, mixed_radii, one_frame, thrown

from dpdjax.measure.clusters import clusters
from dpdjax.measure.spheres import Spheres


def row(count, step, start=(0.3, 0.4, 0.5)):
    """Spheres at equal steps."""
    return np.array(start) + np.arange(count)[:, None] * np.array(step)


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


def test_one_sphere_is_a_cluster():
    found = clusters(one_frame(thrown(1)), gap=0.5)
    assert found.largest[0, 0] == found.number[0, 0] == found.mean_size[0, 0] == 1
