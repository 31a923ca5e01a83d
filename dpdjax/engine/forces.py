"""The force pass: every pair of a list once, every law once, both beads at the end."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from dpdjax.engine import box as boxes
from dpdjax.engine import noise
from dpdjax.engine.batching import on_cpu
from dpdjax.engine.state import Tally, radii
from dpdjax.model.fluid import ORIGINS, Fluid, Interaction

BLOCK, BLOCKED_FROM = 65_536, 1_000_000
"""Pairs of a block, and of the smallest list worked on in blocks (measured: tests/benchmarks)."""
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


class Pairs(NamedTuple):
    """The geometry of a list of pairs, by component; every entry has shape (pairs,)."""

    i: jax.Array
    j: jax.Array
    real: jax.Array
    r: jax.Array
    h: jax.Array
    e: tuple
    v: jax.Array
    si: jax.Array
    sj: jax.Array
    R_i: jax.Array
    R_j: jax.Array


class Beads(NamedTuple):
    """What the pairs read of the beads, in columns of shape (n,); no radii where all are points."""

    position: tuple
    velocity: tuple
    species: jax.Array
    id: jax.Array
    radius: jax.Array | None

    @classmethod
    def of(cls, fluid, state, velocity) -> "Beads":
        # Whole columns first: XLA would fold what makes them into every single read.
        columns = lambda rows: tuple(rows[:, k] for k in range(3))
        x, v = jax.lax.optimization_barrier((columns(state.position), columns(velocity)))
        return cls(x, v, state.species, state.id, radii(fluid, state) if fluid.has_radii else None)


def pair_geometry(box, beads: Beads, idx, rate, spheres=(False, False)) -> Pairs:
    """Distance, gap, direction and approach velocity of each pair of ``idx`` (2, pairs).

    ``spheres``: whether the first and the second beads have radii at all (static).

    The lab velocities of two beads differ by their peculiar velocities and by
    ``rate y_ij`` of the nearest image, which is the jump across the y-boundary too.
    """
    n = beads.id.shape[0]
    real = idx[0] < n
    i, j = jnp.minimum(idx[0], n - 1), jnp.minimum(idx[1], n - 1)
    dx, dy, dz = boxes.minimum_image(box, *(take(c, i) - take(c, j) for c in beads.position))
    square = dx * dx + dy * dy + dz * dz
    real &= square > 0
    # Padded slots are pairs of a bead with itself: keep zero out of the root and its derivative.
    inverse = jax.lax.rsqrt(jnp.where(real, square, 1.0))
    e = (dx * inverse, dy * inverse, dz * inverse)
    vx, vy, vz = (take(c, i) - take(c, j) for c in beads.velocity)
    approach = e[0] * (vx + rate * dy) + e[1] * vy + e[2] * vz
    r = jnp.where(real, square * inverse, jnp.inf)
    R_i, R_j = (take(beads.radius, k) if has else jnp.zeros((), r.dtype) for k, has in zip((i, j), spheres))
    h = r - (R_i + R_j) if any(spheres) else r
    return Pairs(idx[0], idx[1], real, r, h, e, approach, take(beads.species, i), take(beads.species, j), R_i, R_j)


def take(x, i):
    """``x[i]`` for indices known to be within bounds."""
    return x.at[i].get(mode="promise_in_bounds", wrap_negative_indices=False)


def evaluate(terms, pairs: Pairs, kT, derivative: bool):
    """Sum over terms of the law, or of (law, -d law/dh), zero beyond each reach; a potential is zero there."""
    zero = jnp.zeros_like(pairs.v)
    value, force = zero, zero
    for t in terms:
        table_of = lambda c: c if jnp.ndim(c) == 0 else c[pairs.si, pairs.sj]
        law, reach = t.between(table_of, R_i=pairs.R_i, R_j=pairs.R_j, kT=kT)
        inside = pairs.h < reach
        # Laws see only gaps at which they are meant to be evaluated: NaN times zero is NaN.
        h = jnp.where(inside, pairs.h, 0.5 * reach)
        if derivative:
            u, slope = jax.jvp(law, (h,), (jnp.ones_like(h),))
            at_end = law(jnp.asarray(reach, h.dtype))
            value, force = value + jnp.where(inside, u - at_end, 0.0), force - jnp.where(inside, slope, 0.0)
        else:
            value = value + jnp.where(inside, law(h), 0.0)
    return (value, force) if derivative else value


def by_origin(terms, kind: str) -> dict:
    """The terms of each origin: those without a name of their own under ``kind``."""
    origins = dict.fromkeys([kind, *(t.origin for t in terms if t.origin is not None)])
    return {origin: [t for t in terms if (t.origin or kind) == origin] for origin in origins}


def safe_sqrt(x):
    """Square root with derivative 0 at 0, where the plain one has none."""
    above = x > 0
    return jnp.where(above, jnp.sqrt(jnp.where(above, x, 1.0)), 0.0)


def pair_forces(interaction: Interaction, kT, pairs: Pairs, words, of_bead, dt):
    """Energy of each pair, and its forces along ``e`` by origin.

    ``words`` key the noise of the step, ``of_bead`` (n,) that of each bead (``dpdjax.engine.noise``).

    The random force follows from the *sum* of the frictions, so fluctuation and
    dissipation balance for any drag law (Espanol & Warren 1995, eq. 8).
    """
    energy, forces, zeta = 0.0, {}, 0.0
    for origin, terms in by_origin(interaction.conservative, ORIGINS[0]).items():
        potential, forces[origin] = evaluate(terms, pairs, kT, derivative=True)
        energy = energy + potential
    for origin, terms in by_origin(interaction.drag, ORIGINS[1]).items():
        friction = evaluate(terms, pairs, kT, derivative=False)
        forces[origin] = forces.get(origin, 0.0) - friction * pairs.v
        zeta = zeta + friction
    if interaction.random is not None:
        zeta = evaluate(interaction.random, pairs, kT, derivative=False)
    n = of_bead.shape[0]
    a, b = (take(of_bead, jnp.minimum(k, n - 1)) for k in (pairs.i, pairs.j))
    xi = noise.pair_noise(words, a, b, pairs.v.dtype.type)
    return energy, forces | {ORIGINS[2]: safe_sqrt(2.0 * kT * zeta / dt) * xi}


def geometry(fluid, box, beads: Beads, interaction: Interaction, idx, rate) -> Pairs:
    """:func:`pair_geometry` of pairs of one interaction."""
    spheres = tuple(any(fluid.radius[k] is not None for k in group) for group in interaction.groups)
    return pair_geometry(box, beads, idx, rate, spheres)


def interaction_force(fluid, interaction, box, beads: Beads, idx, rate, words, dt, tally: bool):
    """Force on each bead (n, 3) from one list, and the sums over its pairs where asked for."""
    n, dtype = beads.id.shape[0], beads.position[0].dtype
    of_bead = jax.lax.optimization_barrier(noise.bead_words(words, beads.id))

    def add(sums, part):
        net, totals = sums
        pairs = geometry(fluid, box, beads, interaction, part, rate)
        energy, forces = pair_forces(interaction, fluid.kT, pairs, words, of_bead, dt)
        net = net_add(net, pairs, sum(forces.values()))
        return net, totals.plus(*sum_pairs(pairs, energy, forces)) if tally else totals

    sums = over_blocks(add, (net_zero(n, dtype), Tally.zero(dtype, fluid.origins)), idx, n)
    return net_force(sums[0]), sums[1] if tally else None


def sum_onto_beads(pairs: Pairs, along, n: int):
    """``along`` e on the first and its opposite on the second bead of every pair; (n, 3)."""
    return net_force(net_add(net_zero(n, along.dtype), pairs, along))


def over_blocks(add, sums, idx, pad: int):
    """``sums = add(sums, part)`` over ``idx`` (2, pairs): all of it at once, or what a CPU's cache holds at a time.

    The last block is filled with ``pad``.
    """
    capacity, size = idx.shape[1], BLOCK
    if capacity < BLOCKED_FROM or not on_cpu():
        return add(sums, idx)

    def turn(sums, begin):
        # The last block reaches back into the one before it.
        start = jnp.minimum(begin, capacity - size)
        fresh = start + jnp.arange(size, dtype=idx.dtype) >= begin
        part = jax.lax.dynamic_slice_in_dim(idx, start, size, 1)
        return add(sums, jnp.where(fresh[None], part, pad)), None

    return jax.lax.scan(turn, sums, jnp.arange(0, capacity, size, dtype=idx.dtype))[0]


def net_zero(n: int, dtype):
    """Empty sums over first and over second beads, each as its parts (n,).

    The parts are x, y, z; on a CPU x + i y and z: it adds a complex number as fast as a real one.
    """
    z = jnp.zeros(n, dtype)
    parts = (jax.lax.complex(z, z), z) if on_cpu() else (z, z, z)
    return parts, parts


def net_add(net, pairs: Pairs, along):
    """Add ``along`` e of every pair to the sums of its first and of its second bead."""
    # The laws before the sums: XLA would evaluate them again for every scatter.
    f = jax.lax.optimization_barrier(tuple(along * e for e in pairs.e))
    parts = (jax.lax.complex(f[0], f[1]), f[2]) if len(net[0]) == 2 else f
    add = lambda total, i, part: total.at[i].add(part, mode="drop", wrap_negative_indices=False)
    return tuple(tuple(add(t, i, p) for t, p in zip(totals, parts)) for totals, i in zip(net, (pairs.i, pairs.j)))


def net_force(net):
    """What the pairs push each bead by (n, 3): first beads one way, second beads the other."""
    parts = [first - second for first, second in zip(*net)]
    x, y, z = (parts[0].real, parts[0].imag, parts[1]) if len(parts) == 2 else parts
    return jnp.stack([x, y, z], axis=1)


def sum_pairs(pairs: Pairs, energy, forces: dict):
    """Energy and the virials ``sum r_ij F_ij`` by origin of a list, all in one matrix product."""
    r = jnp.where(pairs.real, pairs.r, 0.0)
    energy, along, r, e = jax.lax.optimization_barrier((energy, tuple(forces.values()), r, pairs.e))
    upper = jnp.stack([r * e[a] * e[b] for a, b in UPPER])
    sums = jnp.einsum("fp,vp->fv", jnp.stack(along), upper, precision=jax.lax.Precision.HIGHEST)
    return jnp.sum(energy), {origin: symmetric(sums[k]) for k, origin in enumerate(forces)}


def symmetric(upper):
    """The six numbers of ``UPPER`` as a (3, 3) matrix."""
    xx, xy, xz, yy, yz, zz = upper
    return jnp.stack([jnp.stack([xx, xy, xz]), jnp.stack([xy, yy, yz]), jnp.stack([xz, yz, zz])])


def pair_force(fluid: Fluid, state, velocity, rate, key, dt, tally: bool = False):
    """Total pair force on each bead (n, 3) at ``state.position`` and ``velocity``.

    Noise is that of ``state.step``. Returns (force, Tally or None).
    """
    force, sums = jnp.zeros_like(state.position), Tally.zero(state.position.dtype, fluid.origins)
    beads = Beads.of(fluid, state, velocity)
    for channel, (interaction, neighbours) in enumerate(zip(fluid.interactions, state.neighbours)):
        words = noise.step_words(key, state.step, channel)
        f, t = interaction_force(fluid, interaction, state.box, beads, neighbours.list.idx, rate, words, dt, tally)
        force = force + f
        sums = sums.plus(t.energy, t.virial) if tally else None
    return force, sums
