"""The laws of an interaction at its pairs: what acts on each of them."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from dpdjax.model.fluid import ORIGINS, Interaction
from dpdjax.model.term import ACROSS, ALONG
from dpdjax.pairs import noise
from dpdjax.pairs.geometry import Moment, Pairs, take

CONSERVATIVE, DRAG, RANDOM = ORIGINS
"""Kinds of force between pairs, of which drag alone depends on velocities."""


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


def friction_by_origin(interaction: Interaction, pairs: Pairs, kT, projectors: tuple):
    """Frictions by origin of the terms with one of the projectors, and the sum that the noise
    follows from."""
    among = lambda terms: [t for t in terms if t.projector in projectors]
    frictions = {
        origin: evaluate(among(terms), pairs, kT, derivative=False)
        for origin, terms in by_origin(interaction.drag, DRAG).items()
        if among(terms)
    }
    if interaction.random is not None:
        return frictions, evaluate(among(interaction.random), pairs, kT, derivative=False)
    return frictions, sum(frictions.values())


def safe_sqrt(x):
    """Square root with derivative 0 at 0, where the plain one has none; NaN below, so that no run
    goes on without its noise."""
    at_zero = x == 0
    return jnp.where(at_zero, 0.0, jnp.sqrt(jnp.where(at_zero, 1.0, x)))


class Wanted(NamedTuple):
    """What of the forces is asked for (static): the kinds, whether the sums over pairs, and whether
    noise is normal in place of uniform."""

    kinds: tuple[str, ...] = ORIGINS
    tally: bool = False
    normal: bool = False


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


def central_forces(interaction: Interaction, kT, pairs: Pairs, moment: Moment, wanted: Wanted):
    """Energy of each pair, and its forces along ``e`` by origin.

    The random force follows from the *sum* of the frictions, so fluctuation and
    dissipation balance for any drag law (Espanol & Warren 1995, eq. 8).
    """
    energy, forces = 0.0, {}
    potentials = interaction.conservative if CONSERVATIVE in wanted.kinds else ()
    for origin, terms in by_origin(potentials, CONSERVATIVE).items():
        potential, forces[origin] = evaluate(terms, pairs, kT, derivative=True)
        energy = energy + potential
    frictions, zeta = friction_by_origin(interaction, pairs, kT, ALONG)
    for origin, friction in frictions.items() if DRAG in wanted.kinds else ():
        forces[origin] = forces.get(origin, 0.0) - friction * pairs.v
    if RANDOM not in wanted.kinds:
        return energy, forces
    given = *moment.words.of_pairs(pairs), pairs.v.dtype.type, wanted.normal
    xi = noise.pair_noise(moment.words.step, *given)
    return energy, forces | {RANDOM: safe_sqrt(2.0 * kT * zeta / moment.dt) * xi}


def transverse_forces(interaction: Interaction, kT, pairs: Pairs, moment: Moment, wanted: Wanted):
    """Forces perpendicular to ``e`` by origin, each by component: drag on ``across``, and its noise
    by the same projector."""
    frictions, zeta = friction_by_origin(interaction, pairs, kT, ACROSS)
    opposed = lambda friction: tuple(-friction * u for u in pairs.across)
    forces = {origin: opposed(f) for origin, f in frictions.items() if DRAG in wanted.kinds}
    if RANDOM not in wanted.kinds:
        return forces
    given = *moment.words.of_pairs(pairs), pairs.v.dtype.type, wanted.normal
    xi = noise.pair_vector(moment.words.vector, *given)
    along = sum(x * e for x, e in zip(xi, pairs.e))
    strength = safe_sqrt(2.0 * kT * zeta / moment.dt)
    return forces | {RANDOM: tuple(strength * (x - along * e) for x, e in zip(xi, pairs.e))}
