"""The structure factor: all wave vectors by force, an ideal gas, and the peak of a lattice."""

import itertools

import numpy as np
import pytest
from clouds import SIDES, mixed_radii, one_frame, thrown

from dpdjax.measure.scattering import structure_factor
from dpdjax.measure.spheres import Spheres


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
