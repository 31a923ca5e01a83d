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
    add, nothing = _adding(fluid, interaction, beads, moment, wanted, paired=False)
    return _total(*add(nothing, idx))


def blocked(
    fluid: Fluid, interaction: Interaction, beads: Columns, idx, moment: Moment, wanted: Wanted
) -> Forces:
    """As many pairs at a time as a CPU's cache holds, two components added as one complex
    number."""
    add, nothing = _adding(fluid, interaction, beads, moment, wanted, paired=True)
    if idx.shape[1] < BLOCKED_FROM:
        return _total(*add(nothing, idx))
    return _total(*sums.over_blocks(add, nothing, idx, BLOCK, beads.id.shape[0]))


def _adding(fluid, interaction, beads: Columns, moment: Moment, wanted: Wanted, paired: bool):
    """``add(so_far, part)``, which adds the pairs ``part`` (2, pairs) to sums onto beads, of
    torques and over all pairs, and these sums of no pairs; None for those that are not wanted."""
    # Across the line of centres there is drag, and the noise that goes with it.
    rubs = not interaction.is_central and bool({laws.DRAG, laws.RANDOM} & set(wanted.kinds))
    n, dtype = beads.id.shape[0], beads.position[0].dtype
    turns = rubs and beads.spin is not None
    nothing = (
        sums.net_zero(n, dtype, paired),
        jnp.zeros((len(beads.spin[0]), 3), dtype) if turns else None,
        Tally.zero(dtype, fluid.origins) if wanted.tally else None,
    )

    def add(so_far, part):
        net, torque, totals = so_far
        pairs = geometry(fluid, interaction, beads, part, moment)
        energy, along = laws.central_forces(interaction, fluid.kT, pairs, moment, wanted)
        across = push = None
        if rubs:
            across = laws.transverse_forces(interaction, fluid.kT, pairs, moment, wanted)
            push = tuple(map(sum, zip(*across.values()))) if across else None
        net = sums.net_add(net, pairs, sum(along.values()), push)
        if turns and push is not None:
            torque = sums.torque_add(torque, beads, pairs, push)
        if wanted.tally:
            totals = totals.plus(*sums.sum_pairs(pairs, energy, along))
            totals = totals.plus(0.0, sums.sum_across(pairs, across)) if across else totals
        return net, torque, totals

    return add, nothing


def _total(net, torque, totals) -> Forces:
    return Forces(sums.net_force(net), torque, totals)
