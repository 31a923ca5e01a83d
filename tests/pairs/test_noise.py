"""Noise: unit variance, no memory, no favourites, and a function of the pair alone."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpdjax.pairs import noise
from dpdjax.pairs.noise import step_words

BEADS = 1500
SIGMAS = 4.0


def pair_noise(words, i, j, dtype):
    """The noise of pairs of ids."""
    a, b = (noise.bead_words(words, jnp.asarray(k)) for k in (i, j))
    return noise.pair_noise(words, a, b, dtype)


@functools.cache
def table(seed=0, step=5, channel=0):
    """The noise of all pairs of 1500 beads as a symmetric table with an empty diagonal."""
    i, j = np.triu_indices(BEADS, 1)
    words = step_words(jax.random.key(seed), step, channel)
    xi = np.zeros((BEADS, BEADS))
    xi[i, j] = xi[j, i] = np.asarray(pair_noise(words, jnp.asarray(i), jnp.asarray(j), np.float64))
    return xi


def upper(xi):
    return xi[np.triu_indices(BEADS, 1)]


def correlation(a, b):
    """Mean of the product in its standard errors."""
    return np.mean(a * b) * np.sqrt(a.size)


def test_noise_has_mean_zero_and_variance_one():
    xi = upper(table())
    assert xi.size > 1e6
    assert abs(xi.mean()) < SIGMAS / np.sqrt(xi.size)
    assert abs(np.mean(xi**2) - 1) < SIGMAS * np.sqrt(0.8 / xi.size)


def test_noise_is_uniform():
    counts, _ = np.histogram(upper(table()), bins=256, range=(-np.sqrt(3), np.sqrt(3)))
    expected = BEADS * (BEADS - 1) / 2 / 256
    chi_square = np.sum((counts - expected) ** 2 / expected)
    assert abs(chi_square - 255) < SIGMAS * np.sqrt(2 * 255)


@pytest.mark.parametrize(
    "other", [{"step": 6}, {"step": 4}, {"step": 5 + 2**16}, {"seed": 1}, {"channel": 1}], ids=str
)
def test_noise_of_other_steps_keys_and_channels_is_independent(other):
    a, b = upper(table()), upper(table(**other))
    assert abs(correlation(a, b)) < SIGMAS
    assert abs(correlation((a**2 - 1) / 0.8**0.5, (b**2 - 1) / 0.8**0.5)) < SIGMAS


@pytest.mark.parametrize("shift", [1, 2, 3, 64, 256, 1024])
def test_noise_of_pairs_that_share_a_bead_is_independent(shift):
    xi = table()
    i, j = np.triu_indices(BEADS - shift, 1)
    assert abs(correlation(xi[i, j], xi[i, j + shift])) < SIGMAS
    assert abs(correlation(xi[i, j], xi[i + shift, j + shift])) < SIGMAS


def test_noise_summed_over_the_partners_of_a_bead_has_the_variance_of_independent_numbers():
    sums = table().sum(axis=1) / np.sqrt(BEADS - 1)
    assert abs(np.mean(sums**2) - 1) < SIGMAS * np.sqrt(2 / BEADS)


def test_noise_around_triangles_is_independent():
    xi = table()
    assert abs(np.trace(xi @ xi @ xi)) < SIGMAS * np.sqrt(6 * BEADS**3)


def bits(words, i, j):
    """The 23 bits each number is made of, (pairs, 23)."""
    k = np.round(
        np.asarray(pair_noise(words, i, j, np.float64)) / 12**0.5 * 2**23 + (2**22 - 0.5)
    ).astype(np.int64)
    return k[:, None] >> np.arange(23) & 1


def test_each_bit_of_an_id_and_of_the_step_turns_each_bit_of_the_noise_half_the_time():
    rng, count = np.random.default_rng(4), 20_000
    i, j = rng.integers(0, 2**20, (2, count))
    words = step_words(jax.random.key(0), 3)
    here = bits(words, i, j)
    there = [bits(words, i ^ 1 << b, j) for b in range(20)]
    there += [
        bits(words.at[w].set(words[w] ^ np.uint32(1 << b)), i, j) for w in (0, 1) for b in range(32)
    ]
    turned = np.mean([here != other for other in there], axis=1)
    assert turned.shape == (84, 23)
    assert np.max(np.abs(turned - 0.5)) < 5 * 0.5 / np.sqrt(count)


@pytest.mark.parametrize("step", range(6))
def test_two_beads_share_no_stretch_of_noise(step):
    """Numbers that are equal in all 23 bits are as many as chance makes them, and not in runs."""
    xi, (i, _) = upper(table(step=step)), np.triu_indices(BEADS, 1)
    order = np.argsort(xi)
    equal = np.flatnonzero(np.diff(xi[order]) == 0)
    expected = xi.size + 2**23 * np.expm1(-xi.size / 2**23)
    assert abs(equal.size - expected) < 6 * np.sqrt(expected)
    first, second = np.sort([i[order[equal]], i[order[equal + 1]]], axis=0)
    assert np.max(np.unique(first * BEADS + second, return_counts=True)[1]) < 10


def test_noise_is_symmetric():
    words = step_words(jax.random.key(0), 3)
    i, j = jnp.array([0, 4, 70000]), jnp.array([9, 2, 3])
    assert jnp.array_equal(pair_noise(words, i, j, np.float64), pair_noise(words, j, i, np.float64))


def test_noise_is_the_same_in_both_precisions():
    i, j = jnp.triu_indices(300, 1)
    words = step_words(jax.random.key(0), 3)
    single, double = (pair_noise(words, i, j, dtype) for dtype in (np.float32, np.float64))
    assert (single.dtype, double.dtype) == (jnp.float32, jnp.float64)
    np.testing.assert_allclose(single, double, rtol=2e-7)
