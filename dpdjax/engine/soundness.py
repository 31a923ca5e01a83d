"""Whether the laws of a fluid make sense where beads can be: judged by their values, before a run
and inside it.

A friction below zero heats, and no noise belongs to it. A potential that is not a number, or falls
without end, moves beads nowhere. Laws are sampled over their reach between every two species, at
all sizes, by the code that runs them.
"""

import functools
import itertools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dpdjax.checks import is_concrete
from dpdjax.engine import status as bits
from dpdjax.engine.batching import chosen
from dpdjax.model.declare import name_of
from dpdjax.model.fluid import Fluid, Interaction
from dpdjax.model.term import ACROSS, ALONG, Term
from dpdjax.pairs.laws import evaluate

EVENLY, FINELY = (
    (np.arange(128) + 0.5) / 128,
    np.concatenate([[1e-20], np.geomspace(1e-6, 0.9, 96)]),
)
"""Shares of a length: in equal steps, and closer and closer to zero, where a law without limit
shows."""
OF_REACH = np.concatenate([EVENLY, FINELY, 0 * FINELY, EVENLY])[None]
OF_CONTACT = np.concatenate([0 * EVENLY, 0 * FINELY, -FINELY, EVENLY - 1])[None]
"""Gaps: from contact to the reach, into the spheres down to their centres, and from there to the
reach, which may be inside.

In shares of the reach and of the distance of the centres at contact. As one sum it costs XLA little
to compile.
"""
CLIMB_OF_SPHERES, CLIMB_OF_POINTS = 1e2, 1e6
"""Energies [kT] that keep beads out. Points may start anywhere, so only what diverges counts;
spheres start apart."""
ENDLESS = 1e9
"""An attraction deeper than this [kT] has no bottom."""


class Samples(NamedTuple):
    """Pairs of beads to try laws on; every entry has shape (samples,), or (kinds, samples) by kind
    of pair.

    Named as those of the forces: gap ``h``, approach ``v``, species and radii.
    """

    h: jax.Array
    v: jax.Array
    si: jax.Array
    sj: jax.Array
    R_i: jax.Array
    R_j: jax.Array


class Survey(NamedTuple):
    """What :func:`survey` found of one interaction: species of each kind of pair (kinds,), gaps and
    energies (kinds, samples)."""

    si: jax.Array
    sj: jax.Array
    h: jax.Array
    energy: jax.Array


def check_laws(fluid: Fluid, state=None):
    """Raise ValueError for a friction below zero, or a law that is not finite where beads can be.

    ``state``: whose sizes count; without one all beads have the size of their species. A batch of
    fluids is judged member by member; numbers that are being traced are judged inside the run, by
    :func:`law_trouble`.
    """
    if not is_concrete(fluid):
        return
    with jax.ensure_compile_time_eval():
        sizes = (
            one_size(fluid)
            if state is None or not is_concrete(state.species, state.size)
            else sizes_of(fluid, state)
        )
        lengths = {len(leaf) for leaf in jax.tree.leaves(_batched(fluid))}
        # Members that do not agree on their number are told of elsewhere.
        if len(lengths) > 1 or not np.any(
            _faults(fluid, sizes) if lengths else survey(fluid, sizes)[1]
        ):
            return
        members = (
            [chosen(fluid, fluid.batch_axes(), k) for k in range(lengths.pop())]
            if lengths
            else [fluid]
        )
        for k, member in enumerate(members):
            for n in range(len(member.interactions)):
                _refuse(member, n, sizes, f" of member {k}" if len(members) > 1 else "")


@jax.jit
def survey(fluid: Fluid, sizes):
    """A :class:`Survey` of each interaction at relative ``sizes`` (species, 2), and whether any law
    is at fault."""
    judged = [_wrong(fluid, i, sizes) for i in fluid.interactions]
    found = [
        Survey(samples.si[:, 0], samples.sj[:, 0], samples.h, energy)
        for samples, energy, _ in judged
    ]
    faults = [jnp.any(wrong) for _, _, all_wrong in judged for terms, wrong in all_wrong if terms]
    return found, functools.reduce(jnp.logical_or, faults)


def one_size(fluid: Fluid):
    """Relative sizes (species, 2) where all beads are alike."""
    return jnp.ones((fluid.species, 2), fluid.kT.dtype)


def law_trouble(fluid: Fluid, state):
    """The bit for laws that fail the same test inside a compiled run."""
    fluid, sizes = jax.lax.stop_gradient((fluid, sizes_of(fluid, state)))
    return bits.flag(survey(fluid, sizes)[1], bits.BAD_LAW)


def sizes_of(fluid: Fluid, state):
    """Relative sizes (species, 2) of the smallest and the largest bead of each species; 1 where
    there is none."""
    mine = jnp.arange(fluid.species)[:, None] == state.species[None]
    extreme = lambda find, other: find(jnp.where(mine, state.size[None], other), axis=1)
    both = jnp.stack([extreme(jnp.min, jnp.inf), extreme(jnp.max, -jnp.inf)], 1)
    return jnp.where(jnp.any(mine, axis=1)[:, None], both, 1.0)


def sampled(fluid: Fluid, interaction: Interaction, sizes) -> Samples:
    """Gaps between every two species of an interaction, at all their ``sizes`` (species, sizes);
    (kinds, samples) each."""
    kinds = [
        (a, b, m, n)
        for a, b in itertools.product(*interaction.groups)
        for m, n in itertools.product(
            *(range(sizes.shape[1] if fluid.radius[k] is not None else 1) for k in (a, b))
        )
    ]
    dtype = fluid.mass.dtype
    radius = lambda k, which: (
        jnp.zeros((), dtype) if fluid.radius[k] is None else fluid.radius[k] * sizes[k, which]
    )
    R_i = jnp.stack([radius(a, m) for a, _, m, _ in kinds])
    R_j = jnp.stack([radius(b, n) for _, b, _, n in kinds])
    si, sj = (np.array([kind[k] for kind in kinds]) for k in (0, 1))
    h = _gaps(interaction, si, sj, R_i, R_j, fluid.kT)
    wide = lambda x: jnp.broadcast_to(jnp.asarray(x)[:, None], h.shape)
    return Samples(h, jnp.zeros_like(h), wide(si), wide(sj), wide(R_i), wide(R_j))


def energy_and_slope(terms, samples: Samples, kT):
    """What the engine makes of potentials: energy, zero at the reach, and minus its slope; the
    shape of ``samples.h``."""
    energy, force = evaluate(terms, _flat(samples), kT, derivative=True)
    return energy.reshape(samples.h.shape), force.reshape(samples.h.shape)


def friction(terms, samples: Samples, kT: ArrayLike):
    """The sum of frictions, the shape of ``samples.h``."""
    return evaluate(terms, _flat(samples), kT, derivative=False).reshape(samples.h.shape)


def _flat(samples: Samples) -> Samples:
    return Samples(*(x.reshape(-1) for x in samples))


def _gaps(interaction, si, sj, R_i, R_j, kT):
    """Gaps (kinds, samples): up to the farthest reach of the terms, and into spheres down to their
    centres."""
    contact = (R_i + R_j)[:, None]

    def reach_of(t):
        table_of = lambda c: c if jnp.ndim(c) == 0 else c[si, sj]
        return jnp.broadcast_to(t.between(table_of, R_i=R_i, R_j=R_j, kT=kT)[1], R_i.shape)[:, None]

    farthest = functools.reduce(jnp.maximum, [reach_of(t) for t in interaction.terms])
    return farthest * jnp.asarray(OF_REACH, contact.dtype) + contact * jnp.asarray(
        OF_CONTACT, contact.dtype
    )


def _is_open(energy, samples: Samples, kT):
    """Where beads can be: from the widest gap inwards, until the energy is too far above its lowest
    out of contact."""
    climb = jnp.where(samples.R_i + samples.R_j > 0, CLIMB_OF_SPHERES, CLIMB_OF_POINTS).astype(
        energy.dtype
    )
    lowest = jnp.min(
        jnp.where(jnp.isfinite(energy) & (samples.h > 0), energy, jnp.inf), axis=1, keepdims=True
    )
    out = (energy == jnp.inf) | ((energy - lowest > climb * kT) & (kT > 0))
    return samples.h > jnp.max(jnp.where(out, samples.h, -jnp.inf), axis=1, keepdims=True)


def _wrong(fluid: Fluid, interaction: Interaction, sizes):
    """The samples, their energies, and where potentials, frictions along and across, and those
    behind the noise make no sense."""
    samples = sampled(fluid, interaction, sizes)
    energy, force = energy_and_slope(interaction.conservative, samples, fluid.kT)
    is_open = _is_open(energy, samples, fluid.kT)
    endless = (samples.h > 0) & (
        (energy == -jnp.inf) | (energy < -ENDLESS * fluid.kT) & (fluid.kT > 0)
    )
    potentials, *frictions = _judged_together(interaction)
    found = [(potentials, endless | is_open & ~(jnp.isfinite(energy) & jnp.isfinite(force)))]
    for terms in frictions:
        zeta = friction(terms, samples, fluid.kT)
        found.append((terms, is_open & ~((zeta >= 0) & (zeta < jnp.inf))))
    return samples, energy, found


@jax.jit
def _faults(fluid, sizes):
    """Whether any law of each member of a batch of fluids is at fault."""
    return jax.vmap(lambda fluid: survey(fluid, sizes)[1], (fluid.batch_axes(),))(fluid)


def _refuse(fluid, k: int, sizes, whose: str):
    """Raise ValueError for the worst fault of the interaction ``k``."""
    samples, values, wrong = jax.tree.map(np.asarray, _detailed(fluid, sizes, k))
    for kind, (terms, where) in enumerate(zip(_judged_together(fluid.interactions[k]), wrong)):
        if where.any():
            total = sum(v[0] for v in values[kind])
            at = np.unravel_index(
                np.argmin(np.where(where, np.nan_to_num(total, nan=-np.inf), np.inf)), where.shape
            )
            here = [[float(x[at]) for x in v] for v in values[kind]]
            pair = (
                f"between species {samples.si[at]} and {samples.sj[at]}{whose} at a gap of "
                f"{samples.h[at]:.4g}"
            )
            raise ValueError(_told(terms, here, pair))


@functools.partial(jax.jit, static_argnums=2)
def _detailed(fluid, sizes, k: int):
    """The samples of one interaction, the values of every term, and where those judged together are
    at fault."""
    interaction = fluid.interactions[k]
    samples, _, found = _wrong(fluid, interaction, sizes)
    potentials, *frictions = _judged_together(interaction)
    values = [[energy_and_slope([t], samples, fluid.kT) for t in potentials]]
    values += [[(friction([t], samples, fluid.kT),) for t in terms] for terms in frictions]
    return samples, values, [wrong for _, wrong in found]


def _judged_together(interaction):
    """The potentials; the frictions along and across; those behind the noise, along and across."""
    among = lambda terms, projectors: [t for t in terms if t.projector in projectors]
    frictions = [
        among(terms, p)
        for terms in (interaction.drag, interaction.random or ())
        for p in (ALONG, ACROSS)
    ]
    return [list(interaction.conservative), *frictions]


def _told(terms, values, pair: str) -> str:
    """What is wrong: the law that is, its numbers, the gap, the value, and the cure."""
    worst = min(
        range(len(terms)),
        key=lambda k: min(v if math.isfinite(v) else -math.inf for v in values[k]),
    )
    what, value = f"{_written(terms[worst])} {pair}", values[worst][0]
    if len(values[worst]) == 1:
        return (
            f"the friction {what} is {value:.4g}: it must be finite and not negative, for a "
            "negative one heats and has no noise; give coefficients that keep it so, or "
            "jnp.maximum(..., 0.0) in the law"
        )
    cure = "beads can be there: give coefficients or a reach that keep it finite"
    if math.isfinite(value) and math.isnan(values[worst][1]):
        return (
            f"the slope of the potential {what} is nan, and {cure}; guard the argument inside "
            "jnp.where too"
        )
    return f"the potential {what} is {value:.4g}, and {cure}"


def _written(term: Term) -> str:
    numbers = ", ".join(f"{k}={np.asarray(c).tolist()!r}" for k, c in term.coefficients.items())
    return f"{name_of(term.law)}({numbers})"


def _batched(fluid):
    return jax.tree.map(
        lambda axis, leaf: leaf if axis == 0 else None,
        fluid.batch_axes(),
        fluid,
        is_leaf=lambda x: x is None,
    )
