"""The order of beads in memory: by cell while a run goes on, the caller's own outside it.

Beads that are neighbours in space are then neighbours in memory, which is what large boxes live
on. Nothing depends on the order, to the last bit: noise and lists are keyed by ``id``.
"""

import dataclasses

import jax
import jax.numpy as jnp

from dpdjax.engine import cells
from dpdjax.engine.state import State

SMALLEST = 10_000
"""Beads from which sorting pays: fewer stay in the cache in any order."""
LASTS = 100
"""Steps for which an order is as good as new: beads move a fraction of a cell."""


def is_kept(state: State) -> bool:
    """Whether a run of this state sorts its beads (static)."""
    return state.n >= SMALLEST and all(n.grid.cells is not None for n in state.neighbours)


def list_ids(state: State):
    """What keys the pairs of the lists: the ids (n,), or None where the slots do because nothing is sorted."""
    return state.id if is_kept(state) else None


def in_cell_order(state: State) -> State:
    """The same beads, sorted by the cells of the first list; small boxes are left alone."""
    if not is_kept(state):
        return state
    grid = state.neighbours[0].grid
    position = jax.lax.stop_gradient(state.position)
    return permuted(state, cells.cell_order(grid, state.box, position, state.id))


def in_order_of(state: State, ids) -> State:
    """The same beads, in the order in which their ids come in ``ids`` (n,)."""
    return permuted(state, cells.inverse(state.id)[ids]) if is_kept(state) else state


def permuted(state: State, order) -> State:
    """The beads ``order`` (n,), a permutation of the slots; lists keep their pairs and their order."""
    names = ("position", "velocity", "force", "image", "id", "species")
    slot = jnp.append(cells.inverse(order), state.n)
    neighbours = tuple(_renumbered(n, order, slot) for n in jax.lax.stop_gradient(state.neighbours))
    beads = {name: getattr(state, name)[order] for name in names}
    return dataclasses.replace(state, **beads, neighbours=neighbours)


def _renumbered(neighbours, order, slot):
    old = neighbours.list
    new = dataclasses.replace(old, idx=slot[old.idx], reference_position=old.reference_position[order])
    return dataclasses.replace(neighbours, list=new)
