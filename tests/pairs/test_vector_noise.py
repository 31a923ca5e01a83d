"""Vector noise: three white numbers to a pair, which change sign with its order."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpdjax.pairs import laws, noise


@pytest.fixture(scope="module")
def vectors():
    """Vector noise of all pairs of 600 beads at two steps, and of the pairs the other way round:
    (3, pairs) each."""
    i, j = map(jnp.asarray, np.triu_indices(600, 1))

    def at(step, i, j):
        words = laws.Words.of(jax.random.key(3), step, 1, jnp.arange(600), True)
        return np.stack(noise.pair_vector(words.vector, words.bead[i], words.bead[j], np.float64))

    words = laws.Words.of(jax.random.key(3), 5, 1, jnp.arange(600), True)
    scalar = np.asarray(noise.pair_noise(words.step, words.bead[i], words.bead[j], np.float64))
    return at(5, i, j), at(6, i, j), at(5, j, i), scalar


def test_vector_noise_is_white(vectors):
    now, later, _, scalar = vectors
    count = now.shape[1]
    all_of_them = np.stack([*now, *later, scalar, scalar**2 - 1.0])
    covariance = all_of_them @ all_of_them.T / count
    expected = np.diag([1.0] * 7 + [0.8])
    np.testing.assert_allclose(covariance, expected, atol=4.5 / math.sqrt(count))
    assert np.abs(now.mean(axis=1)).max() < 4.5 / math.sqrt(count)


def test_vector_noise_changes_sign_with_the_order(vectors):
    np.testing.assert_array_equal(vectors[2], -vectors[0])
