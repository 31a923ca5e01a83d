"""Pair noise: a function of (key, step, {i, j}) and of nothing else.

A word is made of each bead's id and the step, and one number of the sum of two words, each by a
short integer hash; what statistical batteries say of it is in tests/benchmarks/NOISE.md.

Two lists that hold the same pair give it the same number, whatever its slot; so an
overflow can be replayed, a restart is exact, and the order of the beads is free.
"""

import enum

import jax
import jax.numpy as jnp


class Domain(enum.IntEnum):
    """What chance is for: folded into a key before anything else, so that no two uses of one key
    share numbers.

    ``split(key)[i]`` equals ``fold_in(key, i)``, and a step may be any number.
    """

    PAIR = 1
    POSITION = 2
    VELOCITY = 3
    PACK = 4
    FILL = 5
    SIZE = 6
    VECTOR = 7
    SPIN = 8
    FRESH_RUN = 9
    GOAL = 10
    FIT = 11
    CHAINS = 12
    BOX = 13


def step_words(key, step, channel: int = 0):
    """Two uint32 words for one step and one interaction, from JAX's own generator."""
    return _words(key, Domain.PAIR, channel, step, 2)


def box_noise(key, step, count: int, dtype):
    """Normal numbers (count,) of one step, for a box whose sides fluctuate."""
    for word in (Domain.BOX, step):
        key = jax.random.fold_in(key, word)
    return jax.random.normal(key, (count,), dtype)


def vector_words(key, step, channel: int = 0):
    """Three more, for noise with three components."""
    return _words(key, Domain.VECTOR, channel, step, 3)


def _words(key, domain, channel, step, count):
    for word in (domain, channel, step):
        key = jax.random.fold_in(key, word)
    return jax.random.bits(key, (count,), jnp.uint32)


def mix(x):
    """A bijection of uint32 with good avalanche (constants of Ettinger's ``triple32``)."""
    x = (x ^ (x >> 17)) * jnp.uint32(0xED5AD4BB)
    x = (x ^ (x >> 11)) * jnp.uint32(0xAC4C1B51)
    x = (x ^ (x >> 15)) * jnp.uint32(0x31848BAB)
    return x ^ (x >> 14)


def bead_words(words, ids):
    """One uint32 word for each bead, of which the noise of its pairs is made; (n,)."""
    return mix(ids.astype(jnp.uint32) ^ words[0])


def pair_noise(words, a, b, dtype, normal: bool = False):
    """One number of mean 0 and variance 1 per pair of beads with the words ``a`` and ``b``,
    :func:`uniform` or :func:`normal`.

    The sum of two words knows no order; and, unlike a sum that is linear in an id, two beads never
    share a stretch of it.
    """
    return _shape(normal)(mix((a + b) ^ words[1]), dtype)


def pair_vector(words, a, b, dtype, normal: bool = False):
    """Three such numbers per pair, keyed by ``vector_words``: a vector that changes sign with the
    order of the beads."""
    sign, shape = jnp.where(a < b, dtype(1.0), dtype(-1.0)), _shape(normal)
    return tuple(sign * shape(mix((a + b) ^ words[k]), dtype) for k in range(3))


def _shape(is_normal: bool):
    return normal if is_normal else uniform


def normal(x, dtype):
    """Of words of random bits, how many are set: binomial, whose fourth cumulant is -1/16 where a
    Gaussian has 0 and :func:`uniform` -6/5.

    For steps so long that noise of one decides how velocities are distributed.
    """
    return (jax.lax.population_count(x).astype(dtype) - dtype(16.0)) * dtype(8.0**-0.5)


def uniform(x, dtype):
    """Of words of random bits, a number from an interval: of the same weak order in dt as Gaussian
    noise (Dunweg & Paul 1991). The 23 top bits are centred, so that the mean is zero to the last
    bit."""
    centred = (x >> 9).astype(dtype) + dtype(0.5 - 2.0**22)
    return centred * dtype(12.0**0.5 * 2.0**-23)
