"""The force pass: every pair of a list once, every law once, both beads at the end."""

import jax.numpy as jnp

from dpdjax.model.fluid import ORIGINS, Fluid
from dpdjax.pairs.geometry import Columns, Moment
from dpdjax.pairs.laws import Wanted, Words
from dpdjax.pairs.sums import Forces, Tally


def interactions_of(fluid: Fluid, state):
    """Each interaction of a fluid with its list in a state."""
    return zip(fluid.interactions, state.neighbours)


def pair_force(
    fluid: Fluid, state, velocity, rate, key, dt, tally: bool = False, kinds=ORIGINS, only=None
) -> Forces:
    """What pairs do at ``state.position`` and ``velocity`` (n, 3): force on each bead (n, 3), and
    torque on those that rotate (m, 3); of these ``kinds``, and of ``only``
    these places among the interactions (static).

    Noise is that of ``state.step``, angular velocities those of ``state.rotation``. Sums over pairs
    are None unless asked for by ``tally`` (static).
    """
    dtype, wanted = state.position.dtype, Wanted(tuple(kinds), tally)
    torque = None if state.rotation is None else jnp.zeros_like(state.rotation.torque)
    total = Forces(
        jnp.zeros_like(state.position), torque, Tally.zero(dtype, fluid.origins) if tally else None
    )
    beads = Columns.of(fluid, state, velocity)
    for channel, (interaction, neighbours) in enumerate(interactions_of(fluid, state)):
        if only is not None and channel not in only:
            continue
        words = Words.of(key, state.step, channel, beads.id, not interaction.is_central)
        moment = Moment(state.box, rate, dt, words)
        kernel, idx = neighbours.grid.kernel, neighbours.list.idx
        total = total + kernel(fluid, interaction, beads, idx, moment, wanted)
    return total
