"""Kernels: all that the pairs of a list do to their beads, one way for each kind of machine.

A kernel is a function ``kernel(fluid, interaction, beads, idx, moment, wanted) -> Forces``; the
list whose layout it takes names it (``Grid.kernel``). One of your own, compiled or in Pallas, has
:func:`scattered` as its reference and, by ``jax.custom_jvp``, as its derivative.
"""

from collections.abc import Callable

import jax.numpy as jnp

from dpdjax.model.fluid import Fluid, Interaction
from dpdjax.pairs import laws, sums
from dpdjax.pairs.geometry import Columns, Moment, geometry
from dpdjax.pairs.laws import Wanted
from dpdjax.pairs.sums import Forces, Tally
from dpdjax.xla import on_cpu

BLOCK, BLOCKED_FROM = 65_536, 1_000_000
"""Pairs of a block, and of the smallest list worked on in blocks (measured: tests/benchmarks)."""


def suited() -> Callable:
    """The kernel for the machine that programs are made for."""
    return blocked if on_cpu() else scattered


def scattered(
    fluid: Fluid, interaction: Interaction, beads: Columns, idx, moment: Moment, wanted: Wanted
) -> Forces:
    """The pairs ``idx`` (2, pairs) all at once, each component of a force added by itself."""
    add = _adding(fluid, interaction, beads, moment, wanted)
    return _total(add(_empty(fluid, beads, False), idx), interaction, beads, wanted)


def blocked(
    fluid: Fluid, interaction: Interaction, beads: Columns, idx, moment: Moment, wanted: Wanted
) -> Forces:
    """As many pairs at a time as a CPU's cache holds, two components added as one complex
    number."""
    add, start = _adding(fluid, interaction, beads, moment, wanted), _empty(fluid, beads, True)
    if idx.shape[1] < BLOCKED_FROM:
        return _total(add(start, idx), interaction, beads, wanted)
    found = sums.over_blocks(add, start, idx, BLOCK, beads.id.shape[0])
    return _total(found, interaction, beads, wanted)


def _empty(fluid, beads: Columns, paired: bool):
    """Sums of no pairs: onto beads, of torques, over all."""
    n, dtype = beads.id.shape[0], beads.position[0].dtype
    m = 0 if beads.spin is None else len(beads.spin[0])
    return (
        sums.net_zero(n, dtype, paired),
        jnp.zeros((m, 3), dtype),
        Tally.zero(dtype, fluid.origins),
    )


def _adding(fluid, interaction, beads: Columns, moment: Moment, wanted: Wanted):
    """``add(sums, part)``: the sums with those of the pairs ``part`` (2, pairs)."""

    def add(so_far, part):
        net, torque, totals = so_far
        pairs = geometry(fluid, interaction, beads, part, moment)
        energy, along = laws.central_forces(interaction, fluid.kT, pairs, moment, wanted)
        across = push = None
        if _rubs(interaction, wanted):
            across = laws.transverse_forces(interaction, fluid.kT, pairs, moment, wanted)
            push = tuple(map(sum, zip(*across.values()))) if across else None
        net = sums.net_add(net, pairs, sum(along.values()), push)
        if push is not None and beads.spin is not None:
            torque = sums.torque_add(torque, beads, pairs, push)
        if wanted.tally:
            totals = totals.plus(*sums.sum_pairs(pairs, energy, along))
            totals = totals.plus(0.0, sums.sum_across(pairs, across)) if across else totals
        return net, torque, totals

    return add


def _rubs(interaction, wanted: Wanted) -> bool:
    """Whether anything acts across the line of centres: drag, and the noise that goes with it."""
    return not interaction.is_central and bool({laws.DRAG, laws.RANDOM} & set(wanted.kinds))


def _total(found, interaction, beads: Columns, wanted: Wanted) -> Forces:
    net, torque, totals = found
    has_torque = beads.spin is not None and _rubs(interaction, wanted)
    return Forces(
        sums.net_force(net), torque if has_torque else None, totals if wanted.tally else None
    )
