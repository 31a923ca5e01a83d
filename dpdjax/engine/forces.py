"""The force pass: every pair of a list once, every law once, both beads at the end."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dpdjax.engine import box as boxes
from dpdjax.engine import noise
from dpdjax.engine.state import Tally
from dpdjax.model.fluid import Fluid, Interaction

UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


class Pairs(NamedTuple):
    """The geometry of a list of pairs, by component; every entry has shape (pairs,)."""

    i: jax.Array
    j: jax.Array
    real: jax.Array
    r: jax.Array
    e: tuple
    v: jax.Array
    si: jax.Array
    sj: jax.Array


def pair_geometry(box, position, velocity, species, idx, rate) -> Pairs:
    """Distance, direction and approach velocity of each pair.

    The lab velocities of two beads differ by their peculiar velocities and by
    ``rate y_ij`` of the nearest image, which is the jump across the y-boundary too.
    """
    n = position.shape[0]
    real = idx[0] < n
    i, j = jnp.minimum(idx[0], n - 1), jnp.minimum(idx[1], n - 1)
    # Whole columns first: XLA would fold what makes them into every single read.
    x, v = jax.lax.optimization_barrier((_columns(position), _columns(velocity)))
    dx, dy, dz = boxes.minimum_image(box, *(take(c, i) - take(c, j) for c in x))
    square = dx * dx + dy * dy + dz * dz
    real &= square > 0
    # Padded slots are pairs of a bead with itself: keep zero out of the root and its derivative.
    inverse = jax.lax.rsqrt(jnp.where(real, square, 1.0))
    e = (dx * inverse, dy * inverse, dz * inverse)
    vx, vy, vz = (take(c, i) - take(c, j) for c in v)
    approach = e[0] * (vx + rate * dy) + e[1] * vy + e[2] * vz
    r = jnp.where(real, square * inverse, jnp.inf)
    return Pairs(idx[0], idx[1], real, r, e, approach, take(species, i), take(species, j))


def take(x, i):
    """``x[i]`` for indices known to be within bounds."""
    return x.at[i].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _columns(rows):
    return tuple(rows[:, k] for k in range(3))


def evaluate(terms, pairs: Pairs, derivative: bool):
    """Sum over terms of the law, or of (law, -d law/dr), zero beyond each reach."""
    zero = jnp.zeros_like(pairs.v)
    value, force = zero, zero
    for t in terms:
        coefficients, reach = t.between(lambda c: c if jnp.ndim(c) == 0 else c[pairs.si, pairs.sj])
        inside = pairs.r < reach
        # Laws see only gaps at which they are meant to be evaluated: NaN times zero is NaN.
        h = jnp.where(inside, pairs.r, 0.5 * reach)
        law = lambda h: t.law(h, **coefficients)
        if derivative:
            u, slope = jax.jvp(law, (h,), (jnp.ones_like(h),))
            value, force = value + jnp.where(inside, u, 0.0), force - jnp.where(inside, slope, 0.0)
        else:
            value = value + jnp.where(inside, law(h), 0.0)
    return (value, force) if derivative else value


def safe_sqrt(x):
    """Square root with derivative 0 at 0, where the plain one has none."""
    above = x > 0
    return jnp.where(above, jnp.sqrt(jnp.where(above, x, 1.0)), 0.0)


def pair_forces(interaction: Interaction, kT, pairs: Pairs, ids, words, dt):
    """Energy and the conservative, drag and random force of each pair along ``e``.

    The random force follows from the *sum* of the frictions, so fluctuation and
    dissipation balance for any drag law (Espanol & Warren 1995, eq. 8).
    """
    energy, conservative = evaluate(interaction.conservative, pairs, derivative=True)
    zeta = evaluate(interaction.drag, pairs, derivative=False)
    n = ids.shape[0]
    i, j = jnp.minimum(pairs.i, n - 1), jnp.minimum(pairs.j, n - 1)
    xi = noise.pair_noise(words, take(ids, i), take(ids, j), pairs.v.dtype.type)
    return energy, conservative, -zeta * pairs.v, safe_sqrt(2.0 * kT * zeta / dt) * xi


def interaction_force(interaction, kT, pairs: Pairs, ids, words, dt, tally: bool):
    """Force on each bead (n, 3), and the sums over pairs where asked for."""
    energy, conservative, drag, random = pair_forces(interaction, kT, pairs, ids, words, dt)
    total = conservative + drag + random
    force = sum_onto_beads(pairs, total, ids.shape[0])
    return force, sum_pairs(pairs, energy, conservative, drag, random) if tally else None


def sum_onto_beads(pairs: Pairs, along, n: int):
    """``along`` e on bead i and its opposite on bead j of every pair; (n, 3)."""
    # The laws before the sums: XLA would evaluate them again for every scatter.
    f = jax.lax.optimization_barrier(tuple(along * e for e in pairs.e))
    ways = {"cpu": _sum_in_twos, "default": _sum_by_component}
    return jax.lax.platform_dependent(pairs.i, pairs.j, f, **{k: functools.partial(w, n) for k, w in ways.items()})


def _sum_by_component(n, i, j, f):
    return jnp.stack([_net(x, i, j, n) for x in f], axis=1)


def _sum_in_twos(n, i, j, f):
    """A CPU adds a complex number as fast as a real one: x and y in one go."""
    xy, z = _net(jax.lax.complex(f[0], f[1]), i, j, n), _net(f[2], i, j, n)
    return jnp.stack([xy.real, xy.imag, z], axis=1)


def _net(x, i, j, n):
    return jax.ops.segment_sum(x, i, n) - jax.ops.segment_sum(x, j, n)


def sum_pairs(pairs: Pairs, energy, conservative, drag, random) -> Tally:
    """Energy and the virials ``sum r_ij F_ij`` of a list, all in one matrix product."""
    r = jnp.where(pairs.real, pairs.r, 0.0)
    energy, forces, r, e = jax.lax.optimization_barrier((energy, (conservative, drag, random), r, pairs.e))
    upper = jnp.stack([r * e[a] * e[b] for a, b in UPPER])
    sums = jnp.einsum("fp,vp->fv", jnp.stack(forces), upper, precision=jax.lax.Precision.HIGHEST)
    return Tally(jnp.sum(energy), *(symmetric(sums[k]) for k in range(3)))


def symmetric(upper):
    """The six numbers of ``UPPER`` as a (3, 3) matrix."""
    xx, xy, xz, yy, yz, zz = upper
    return jnp.stack([jnp.stack([xx, xy, xz]), jnp.stack([xy, yy, yz]), jnp.stack([xz, yz, zz])])


def pair_force(fluid: Fluid, state, velocity, rate, key, dt, tally: bool = False):
    """Total pair force on each bead (n, 3) at ``state.position`` and ``velocity``.

    Noise is that of ``state.step``. Returns (force, Tally or None).
    """
    force, sums = jnp.zeros_like(state.position), Tally.zero(state.position.dtype)
    for channel, (interaction, neighbours) in enumerate(zip(fluid.interactions, state.neighbours)):
        idx = neighbours.list.idx
        pairs = pair_geometry(state.box, state.position, velocity, state.species, idx, rate)
        words = noise.step_words(key, state.step, channel)
        f, t = interaction_force(interaction, fluid.kT, pairs, state.id, words, dt, tally)
        force = force + f
        sums = sums + t if tally else None
    return force, sums
