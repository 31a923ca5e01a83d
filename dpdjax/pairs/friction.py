"""Frictions of pairs held where they are: a linear operator on velocities, and what pushes besides.

The drag on beads that do not move on is ``-G v``: ``G``, the sum over pairs of ``zeta P`` with
``P`` the projector of each friction, is symmetric and never negative. An implicit step solves with
it.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

from dpdjax.model.fluid import Fluid, Interaction
from dpdjax.model.term import ACROSS, ALONG
from dpdjax.pairs import sums
from dpdjax.pairs.forces import interactions_of
from dpdjax.pairs.geometry import Columns, Moment, Pairs, geometry, past_each_other, take
from dpdjax.pairs.laws import (
    DRAG,
    RANDOM,
    Wanted,
    Words,
    central_forces,
    friction_by_origin,
    transverse_forces,
)
from dpdjax.pairs.sums import Tally
from dpdjax.xla import on_cpu

RUBBING = Wanted((DRAG, RANDOM), normal=True)
"""What belongs to a friction: in a long step its noise alone makes the velocities, so it is
normal."""


class Motion(NamedTuple):
    """Velocities (n, 3), and angular velocities (m, 3) of the beads that rotate or None; or forces
    and torques."""

    velocity: Any
    spin: Any


class Held(NamedTuple):
    """The pairs of one list with their frictions.

    Attributes:
        interaction, moment: what acts, and when.
        pairs: their geometry, with the velocities that the flow alone gives them.
        along, across: friction along and across the line of centres (pairs,); 0, or None where all
            frictions are central.
    """

    interaction: Interaction
    moment: Moment
    pairs: Pairs
    along: Any
    across: Any


class Frictions(NamedTuple):
    """Those of several lists of the same beads, whose velocities in ``beads`` are zero."""

    fluid: Fluid
    beads: Columns
    held: tuple[Held, ...]

    def drag(self, motion: Motion) -> Motion:
        """``G v``: forces (n, 3) and torques (m, 3), against which a motion goes on."""

        def of_pairs(held):
            approach, past = self._past(held, motion)
            push = None if past is None else tuple(held.across * u for u in past)
            return held.along * approach, push

        return self._onto_beads(of_pairs)

    def force(self, motion: Motion) -> Motion:
        """Forces and torques of drag and noise in a motion."""

        def of_pairs(held):
            along, across = self._forces(self._moving(held, motion))
            return sum(along.values()), tuple(map(sum, zip(*across.values()))) if across else None

        return self._onto_beads(of_pairs)

    def tally(self, motion: Motion) -> Tally:
        """The virials of drag and noise in a motion."""
        total = Tally.zero(self.beads.position[0].dtype, self.fluid.origins)
        for held in self.held:
            moving = self._moving(held, motion)
            along, across = self._forces(moving)
            nothing = jnp.zeros_like(moving.pairs.v)
            total = total.plus(*sums.sum_pairs(moving.pairs, nothing, along))
            total = total.plus(0.0, sums.sum_across(moving.pairs, across)) if across else total
        return total

    def _moving(self, held: Held, motion: Motion) -> Held:
        """The pairs with the velocities of a motion besides those of the flow."""
        approach, past = self._past(held, motion)
        pairs = held.pairs._replace(v=held.pairs.v + approach)
        if past is not None:
            pairs = pairs._replace(across=tuple(map(jnp.add, pairs.across, past)))
        return held._replace(pairs=pairs)

    def _forces(self, held: Held) -> tuple[dict, dict]:
        """Drag and noise of pairs by origin, along and across the line of centres."""
        given = held.interaction, self.fluid.kT, held.pairs, held.moment, RUBBING
        _, along = central_forces(*given)
        return along, {} if held.across is None else transverse_forces(*given)

    def _past(self, held: Held, motion: Motion):
        """How fast the beads of pairs approach, and their surfaces move past each other."""
        pairs, n = held.pairs, self.beads.id.shape[0]
        i, j = jnp.minimum(pairs.i, n - 1), jnp.minimum(pairs.j, n - 1)
        columns = tuple(motion.velocity[:, k] for k in range(3))
        v = tuple(take(c, i) - take(c, j) for c in columns)
        approach = sum(e * u for e, u in zip(pairs.e, v))
        if held.across is None:
            return approach, None
        spin = None if motion.spin is None else tuple(motion.spin[:, k] for k in range(3))
        beads, radii = self.beads._replace(spin=spin), (pairs.R_i, pairs.R_j)
        return approach, past_each_other(beads, i, j, pairs.e, v, approach, *radii)

    def _onto_beads(self, of_pairs) -> Motion:
        """The sums over all pairs of what acts along and across, by bead."""
        n, dtype, spin = self.beads.id.shape[0], self.beads.position[0].dtype, self.beads.spin
        net = sums.net_zero(n, dtype, on_cpu())
        torque = None if spin is None else jnp.zeros((len(spin[0]), 3), dtype)
        for held in self.held:
            along, across = of_pairs(held)
            net = sums.net_add(net, held.pairs, along, across)
            if torque is not None and across is not None:
                torque = sums.torque_add(torque, self.beads, held.pairs, across)
        return Motion(sums.net_force(net), torque)


def frictions_of(fluid: Fluid, state, rate, key, dt, channels=None) -> Frictions:
    """The frictions of all lists at the positions of a state, with the noise of its step.

    ``channels``: of each interaction what keys its noise, by default its place in the fluid.
    """
    channels = range(len(fluid.interactions)) if channels is None else channels
    beads = Columns.of(fluid, state, jnp.zeros_like(state.velocity))
    if beads.spin is not None:
        beads = beads._replace(spin=tuple(map(jnp.zeros_like, beads.spin)))
    held = []
    for channel, (interaction, neighbours) in zip(channels, interactions_of(fluid, state)):
        if interaction.drag:
            words = Words.of(key, state.step, channel, beads.id, not interaction.is_central)
            moment = Moment(state.box, rate, dt, words)
            held.append(_held(fluid, interaction, beads, neighbours.list.idx, moment))
    return Frictions(fluid, beads, tuple(held))


def _held(fluid, interaction, beads, idx, moment) -> Held:
    pairs = geometry(fluid, interaction, beads, idx, moment)
    total = lambda projectors: friction_by_origin(interaction, pairs, fluid.kT, projectors)[1]
    across = None if interaction.is_central else total(ACROSS) + jnp.zeros_like(pairs.v)
    return Held(interaction, moment, pairs, total(ALONG) + jnp.zeros_like(pairs.v), across)
