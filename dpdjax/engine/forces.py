"""All that acts on the beads of a state: between pairs of them, along bonds, and from outside."""

import dataclasses

import jax

from dpdjax.bonded.forces import bonded_force
from dpdjax.engine import order
from dpdjax.engine.state import State
from dpdjax.model.beads import masses
from dpdjax.model.fluid import ORIGINS
from dpdjax.pairs import neighbours as lists
from dpdjax.pairs.forces import pair_force
from dpdjax.pairs.laws import CONSERVATIVE
from dpdjax.pairs.sums import Forces

DRIVEN = "driven"
EVERYTHING = (*ORIGINS, DRIVEN)
"""Kinds of force: those of pairs, of which drag alone depends on velocities, and what drives beads
from outside."""
UNDAMPED = (CONSERVATIVE, DRIVEN)
"""Those that are the same whatever the velocities are, and without noise."""


def update_lists(state: State) -> State:
    """The state with those of its lists built anew that are stale.

    Example:
        >>> import dataclasses
        >>> swapped = dataclasses.replace(state, position=state.position[::-1])
        >>> fresh = dpd.integrators.update_lists(swapped)
        >>> bool((fresh.neighbours[0].list.idx == state.neighbours[0].list.idx).all())
        False
    """
    how = order.list_ids(state), state.excluded
    with jax.named_scope("neighbours"):
        neighbours = tuple(
            lists.update(n, state.box, state.position, *how) for n in state.neighbours
        )
    return dataclasses.replace(state, neighbours=neighbours)


def forces_on(
    system,
    state: State,
    velocity: jax.Array,
    key: jax.Array,
    tally: bool,
    kinds: tuple[str, ...] = EVERYTHING,
    only: tuple[int, ...] | None = None,
) -> Forces:
    """All forces at the state's positions, with drag from ``velocity`` (n, 3) and from the angular
    velocities of the state.

    Args:
        system, state, key: what moves, where, and what keys the noise of ``state.step``.
        velocity: peculiar velocities (n, 3).
        tally: whether with the sums over pairs (static); without, they are None.
        kinds: which of ``"conservative"``, ``"drag"``, ``"random"`` and ``"driven"`` (static); all
            but drag do not depend on the velocity.
        only: places in ``fluid.interactions`` of those that act (static); all by default. Bonds
            act whichever do.

    Returns :class:`dpdjax.integrators.Forces`; those of two kinds are added by ``+``, and
    multiplied by a number. Raises ValueError for an unknown kind or velocities of another shape.

    Example:
        >>> now, kinds = rest.final, ("conservative", "driven")
        >>> acts = dpd.integrators.forces_on(rest.system, now, now.velocity, key, False, kinds)
        >>> acts.force.shape, acts.tally is None
        ((192, 3), True)
        >>> bool(jnp.abs(acts.force.sum(axis=0)).max() < 1e-2)
        True
    """
    check_kinds_of_force(kinds)
    if velocity.shape != state.velocity.shape:
        raise ValueError(
            f"forces_on: velocities have shape {velocity.shape}, and the state's "
            f"{state.velocity.shape}"
        )
    rate = system.flow.rate_at(state.time)
    with jax.named_scope("forces"):
        how = tally, kinds, only
        total = pair_force(system.fluid, state, velocity, rate, key, system.dt, *how)
        if CONSERVATIVE in kinds and system.fluid.bonded:
            total = total + bonded_force(system.fluid, state, tally)
        # Whatever else acts is another part, and adds up here.
        if DRIVEN in kinds:
            total = total + _driven(system, state)
    return total


def check_kinds_of_force(kinds: tuple[str, ...]) -> None:
    """Raise ValueError for what is no tuple of kinds of force."""
    unknown = [kinds] if isinstance(kinds, str) else [k for k in kinds if k not in EVERYTHING]
    if unknown:
        raise ValueError(f"kinds has {unknown[0]!r}; they are {', '.join(EVERYTHING)}, in a tuple")


def _driven(system, state: State) -> Forces:
    """What drives the beads from outside; it has no part in the sums over pairs."""
    mass = masses(system.fluid, state)[:, None]
    return Forces(system.flow.force(state, mass), system.flow.torque(state), None)
