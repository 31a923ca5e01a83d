"""The force pass: every pair of a list once, every law once, both beads at the end."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from dpdjax.engine import box as boxes
from dpdjax.engine import noise
from dpdjax.engine.batching import on_cpu
from dpdjax.engine.state import Tally, radii
from dpdjax.model.fluid import ORIGINS, Fluid, Interaction
from dpdjax.model.term import ACROSS, ALONG

BLOCK, BLOCKED_FROM = 65_536, 1_000_000
"""Pairs of a block, and of the smallest list worked on in blocks (measured: tests/benchmarks)."""
CONSERVATIVE, DRAG, RANDOM = ORIGINS
DRIVEN = "driven"
EVERYTHING = (*ORIGINS, DRIVEN)
"""Kinds of force: those of pairs, of which drag alone depends on velocities, and what drives beads
from outside."""
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


class Pairs(NamedTuple):
    """The geometry of a list of pairs, by component; every entry has shape (pairs,).

    ``v`` is the approach along ``e``, ``across`` the velocity of the two surfaces past each other,
    perpendicular to ``e``; None where nothing asks for it.
    """

    i: jax.Array
    j: jax.Array
    real: jax.Array
    r: jax.Array
    h: jax.Array
    e: tuple
    v: jax.Array
    across: tuple | None
    si: jax.Array
    sj: jax.Array
    R_i: jax.Array
    R_j: jax.Array


class Beads(NamedTuple):
    """What the pairs read of the beads, in columns of shape (n,); no radii where all are points.

    ``spin``: angular velocities of the beads that rotate, from the slot ``turning_from`` on, in
    columns; or None.
    """

    position: tuple
    velocity: tuple
    species: jax.Array
    id: jax.Array
    radius: jax.Array | None
    spin: tuple | None = None
    turning_from: int = 0

    @classmethod
    def of(cls, fluid, state, velocity) -> "Beads":
        # Whole columns first: XLA would fold what makes them into every single read.
        columns = lambda rows: tuple(rows[:, k] for k in range(3))
        x, v = jax.lax.optimization_barrier((columns(state.position), columns(velocity)))
        radius = radii(fluid, state) if fluid.has_radii else None
        turning = state.rotation
        spin, begin = (None, 0) if turning is None else (columns(turning.velocity), turning.begin)
        return cls(x, v, state.species, state.id, radius, spin, begin)


def pair_geometry(
    box, beads: Beads, idx, rate, spheres=(False, False), across: bool = False, words=None
) -> Pairs:
    """Distance, gap, direction and relative velocity of each pair of ``idx`` (2, pairs).

    ``spheres``: whether the first and the second beads have radii at all; ``across``: whether the
    velocity perpendicular to the line of centres is wanted (static). ``words``: of the step, which
    key the direction of beads at one place.

    The lab velocities of two beads differ by their peculiar velocities and by
    ``rate y_ij`` of the nearest image, which is the jump across the y-boundary too.
    """
    n = beads.id.shape[0]
    # Padded slots are pairs of a bead with itself.
    real = idx[0] < n
    i, j = jnp.minimum(idx[0], n - 1), jnp.minimum(idx[1], n - 1)
    dx, dy, dz = boxes.minimum_image(box, *(take(c, i) - take(c, j) for c in beads.position))
    square = dx * dx + dy * dy + dz * dz
    # Beads at one place are a pair too. Zero is kept out of the root and its derivative.
    apart = square > 0
    inverse = jax.lax.rsqrt(jnp.where(apart, square, 1.0))
    somewhere = diagonal_of(words, square.dtype)
    e = tuple(jnp.where(apart, d * inverse, s) for d, s in zip((dx, dy, dz), somewhere))
    vx, vy, vz = (take(c, i) - take(c, j) for c in beads.velocity)
    vx = vx + rate * dy
    approach = e[0] * vx + e[1] * vy + e[2] * vz
    r = jnp.where(real, square * inverse, jnp.inf)
    R_i, R_j = (
        take(beads.radius, k) if has else jnp.zeros((), r.dtype) for k, has in zip((i, j), spheres)
    )
    h = r - (R_i + R_j) if any(spheres) else r
    past = None
    if across:
        past = tuple(u - approach * c for u, c in zip((vx, vy, vz), e))
        if beads.spin is not None:
            # Surface points lie at -R_i e and R_j e from the centres, and move as omega x arm.
            both = tuple(R_i * a + R_j * b for a, b in zip(spin_of(beads, i), spin_of(beads, j)))
            past = tuple(p - c for p, c in zip(past, cross(both, e)))
    return Pairs(
        idx[0],
        idx[1],
        real,
        r,
        h,
        e,
        approach,
        past,
        take(beads.species, i),
        take(beads.species, j),
        R_i,
        R_j,
    )


def diagonal_of(words, dtype) -> tuple:
    """A diagonal of a cube by the words (2,) of a step, or a fixed one: from the second to the
    first of two beads at one place.

    The same for all pairs. One for each would make every pair read the words of its beads here too:
    a tenth of the pass.
    """
    side = jnp.asarray(3.0**-0.5, dtype)
    if words is None:
        return side, side, side
    return tuple(jnp.where(words[0] & jnp.uint32(1 << k) == 0, side, -side) for k in (31, 30, 29))


def spin_of(beads: Beads, slots) -> tuple:
    """Angular velocity, by component, of the beads in ``slots`` (pairs,); 0 for those that do not
    rotate."""
    row, rows = slots - beads.turning_from, beads.spin[0].shape[0]
    turns = (row >= 0) & (row < rows)
    return tuple(jnp.where(turns, take(c, jnp.clip(row, 0, rows - 1)), 0.0) for c in beads.spin)


def cross(a: tuple, b: tuple) -> tuple:
    """Vector product of two vectors by component."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def take(x, i):
    """``x[i]`` for indices known to be within bounds."""
    return x.at[i].get(mode="promise_in_bounds", wrap_negative_indices=False)


def evaluate(terms, pairs: Pairs, kT, derivative: bool):
    """Sum over terms of the law, or of (law, -d law/dh), zero beyond each reach; a potential is
    zero there."""
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
            value, force = (
                value + jnp.where(inside, u - at_end, 0.0),
                force - jnp.where(inside, slope, 0.0),
            )
        else:
            value = value + jnp.where(inside, law(h), 0.0)
    return (value, force) if derivative else value


def by_origin(terms, kind: str) -> dict:
    """The terms of each origin: those without a name of their own under ``kind``."""
    origins = dict.fromkeys([kind, *(t.origin for t in terms if t.origin is not None)])
    return {origin: [t for t in terms if (t.origin or kind) == origin] for origin in origins}


def safe_sqrt(x):
    """Square root with derivative 0 at 0, where the plain one has none; NaN below, so that no run
    goes on without its noise."""
    at_zero = x == 0
    return jnp.where(at_zero, 0.0, jnp.sqrt(jnp.where(at_zero, 1.0, x)))


class Words(NamedTuple):
    """What keys the noise of one step and interaction: its own words, those of a vector, and one of
    each bead (n,)."""

    step: jax.Array
    vector: jax.Array | None
    bead: jax.Array

    @classmethod
    def of(cls, key, step, channel: int, ids, vector: bool) -> "Words":
        step_words = noise.step_words(key, step, channel)
        of_bead = jax.lax.optimization_barrier(noise.bead_words(step_words, ids))
        return cls(step_words, noise.vector_words(key, step, channel) if vector else None, of_bead)

    def of_pairs(self, pairs: Pairs):
        """The words of both beads of each pair."""
        n = self.bead.shape[0]
        return tuple(take(self.bead, jnp.minimum(k, n - 1)) for k in (pairs.i, pairs.j))


def central_forces(interaction: Interaction, kT, pairs: Pairs, words: Words, dt, kinds=ORIGINS):
    """Energy of each pair, and its forces along ``e`` by origin, of these ``kinds`` (static).

    The random force follows from the *sum* of the frictions, so fluctuation and
    dissipation balance for any drag law (Espanol & Warren 1995, eq. 8).
    """
    energy, forces = 0.0, {}
    potentials = interaction.conservative if CONSERVATIVE in kinds else ()
    for origin, terms in by_origin(potentials, CONSERVATIVE).items():
        potential, forces[origin] = evaluate(terms, pairs, kT, derivative=True)
        energy = energy + potential
    frictions, zeta = friction_by_origin(interaction, pairs, kT, ALONG)
    for origin, friction in frictions.items() if DRAG in kinds else ():
        forces[origin] = forces.get(origin, 0.0) - friction * pairs.v
    if RANDOM not in kinds:
        return energy, forces
    xi = noise.pair_noise(words.step, *words.of_pairs(pairs), pairs.v.dtype.type)
    return energy, forces | {RANDOM: safe_sqrt(2.0 * kT * zeta / dt) * xi}


def transverse_forces(interaction: Interaction, kT, pairs: Pairs, words: Words, dt, kinds=ORIGINS):
    """Forces perpendicular to ``e`` by origin, each by component: drag on ``across``, and its noise
    by the same projector."""
    frictions, zeta = friction_by_origin(interaction, pairs, kT, ACROSS)
    opposed = lambda friction: tuple(-friction * u for u in pairs.across)
    forces = {origin: opposed(f) for origin, f in frictions.items() if DRAG in kinds}
    if RANDOM not in kinds:
        return forces
    xi = noise.pair_vector(words.vector, *words.of_pairs(pairs), pairs.v.dtype.type)
    along = sum(x * e for x, e in zip(xi, pairs.e))
    strength = safe_sqrt(2.0 * kT * zeta / dt)
    return forces | {RANDOM: tuple(strength * (x - along * e) for x, e in zip(xi, pairs.e))}


def friction_by_origin(interaction: Interaction, pairs: Pairs, kT, projectors: tuple):
    """Frictions by origin of the terms with one of the projectors, and the sum that the noise
    follows from."""
    among = lambda terms: [t for t in terms if t.projector in projectors]
    frictions = {
        origin: evaluate(among(terms), pairs, kT, derivative=False)
        for origin, terms in by_origin(interaction.drag, ORIGINS[1]).items()
        if among(terms)
    }
    if interaction.random is not None:
        return frictions, evaluate(among(interaction.random), pairs, kT, derivative=False)
    return frictions, sum(frictions.values())


def geometry(fluid, box, beads: Beads, interaction: Interaction, idx, rate, words=None) -> Pairs:
    """:func:`pair_geometry` of pairs of one interaction."""
    spheres = tuple(any(fluid.radius[k] is not None for k in group) for group in interaction.groups)
    return pair_geometry(box, beads, idx, rate, spheres, not interaction.is_central, words)


def interaction_force(
    fluid, interaction, box, beads: Beads, idx, rate, words: Words, dt, tally: bool, kinds=ORIGINS
):
    """Force on each bead (n, 3) from one list, torque (m, 3) or None, and the sums over its pairs
    where asked for."""
    n, dtype = beads.id.shape[0], beads.position[0].dtype
    # Across the line of centres there is drag, and the noise that goes with it.
    rubs = not interaction.is_central and bool({DRAG, RANDOM} & set(kinds))
    turning = rubs and beads.spin is not None

    def add(sums, part):
        net, torque, totals = sums
        pairs = geometry(fluid, box, beads, interaction, part, rate, words.step)
        energy, along = central_forces(interaction, fluid.kT, pairs, words, dt, kinds)
        across = transverse_forces(interaction, fluid.kT, pairs, words, dt, kinds) if rubs else None
        push = tuple(map(sum, zip(*across.values()))) if across else None
        net = net_add(net, pairs, sum(along.values()), push)
        torque = torque_add(torque, beads, pairs, push) if turning else None
        if tally:
            totals = totals.plus(*sum_pairs(pairs, energy, along))
            totals = totals.plus(0.0, sum_across(pairs, across)) if across else totals
        return net, torque, totals

    start = (
        net_zero(n, dtype),
        jnp.zeros((len(beads.spin[0]), 3), dtype) if turning else None,
        Tally.zero(dtype, fluid.origins),
    )
    net, torque, totals = over_blocks(add, start, idx, n)
    return net_force(net), torque, totals if tally else None


def sum_onto_beads(pairs: Pairs, along, n: int):
    """``along`` e on the first and its opposite on the second bead of every pair; (n, 3)."""
    return net_force(net_add(net_zero(n, along.dtype), pairs, along))


def over_blocks(add, sums, idx, pad: int):
    """``sums = add(sums, part)`` over ``idx`` (2, pairs): all of it at once, or what a CPU's cache
    holds at a time.

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


def net_add(net, pairs: Pairs, along, across=None):
    """Add ``along`` e, and ``across``, of every pair to the sums of its first and of its second
    bead."""
    f = tuple(along * e for e in pairs.e)
    f = f if across is None else tuple(a + b for a, b in zip(f, across))
    # The laws before the sums: XLA would evaluate them again for every scatter.
    f = jax.lax.optimization_barrier(f)
    parts = (jax.lax.complex(f[0], f[1]), f[2]) if len(net[0]) == 2 else f
    add = lambda total, i, part: total.at[i].add(part, mode="drop", wrap_negative_indices=False)
    return tuple(
        tuple(add(t, i, p) for t, p in zip(totals, parts))
        for totals, i in zip(net, (pairs.i, pairs.j))
    )


def net_force(net):
    """What the pairs push each bead by (n, 3): first beads one way, second beads the other."""
    parts = [first - second for first, second in zip(*net)]
    x, y, z = (parts[0].real, parts[0].imag, parts[1]) if len(parts) == 2 else parts
    return jnp.stack([x, y, z], axis=1)


def torque_add(torque, beads: Beads, pairs: Pairs, across):
    """Add ``arm x force`` of every pair to what turns its beads (m, 3).

    The arms ``-R_i e`` and ``R_j e`` are those of the surface velocities, and the second bead feels
    the opposite force: both get ``-R e x across``.
    """
    twist = jnp.stack(cross(pairs.e, across), axis=1)
    m = torque.shape[0]
    for slots, R in ((pairs.i, pairs.R_i), (pairs.j, pairs.R_j)):
        row = slots - beads.turning_from
        row = jnp.where((row >= 0) & (row < m), row, m)
        torque = torque.at[row].add(
            -jnp.reshape(R, (-1, 1)) * twist, mode="drop", wrap_negative_indices=False
        )
    return torque


def sum_across(pairs: Pairs, across: dict) -> dict:
    """The virials ``sum F_ij r_ij`` of forces perpendicular to ``e``, by origin."""
    r = jnp.where(pairs.real, pairs.r, 0.0)
    separation = jnp.stack([r * e for e in pairs.e])
    product = lambda f: jnp.einsum(
        "ap,bp->ab", jnp.stack(f), separation, precision=jax.lax.Precision.HIGHEST
    )
    return {origin: product(f) for origin, f in across.items()}


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


def pair_force(fluid: Fluid, state, velocity, rate, key, dt, tally: bool = False, kinds=ORIGINS):
    """Total pair force on each bead (n, 3) at ``state.position`` and ``velocity``, and what turns
    those that rotate (m, 3); of these ``kinds`` (static).

    Noise is that of ``state.step``, angular velocities those of ``state.rotation``. Returns (force,
    torque or None, Tally or None).
    """
    force, sums = jnp.zeros_like(state.position), Tally.zero(state.position.dtype, fluid.origins)
    torque = None if state.rotation is None else jnp.zeros_like(state.rotation.torque)
    beads = Beads.of(fluid, state, velocity)
    for channel, (interaction, neighbours) in enumerate(zip(fluid.interactions, state.neighbours)):
        words = Words.of(key, state.step, channel, beads.id, not interaction.is_central)
        idx = neighbours.list.idx
        f, twist, t = interaction_force(
            fluid, interaction, state.box, beads, idx, rate, words, dt, tally, kinds
        )
        force = force + f
        torque = torque if twist is None else torque + twist
        sums = sums.plus(t.energy, t.virial) if tally else None
    return force, torque, sums
