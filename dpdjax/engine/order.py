"""The order of beads in memory: by cell while a run goes on, the caller's own outside it.

Beads that are neighbours in space are then neighbours in memory, which is what large boxes live
on. Nothing depends on the order, to the last bit: noise and lists are keyed by ``id``.
"""

import dataclasses

import jax
import jax.numpy as jnp

from dpdjax.engine.state import State
from dpdjax.pairs import cells

SMALLEST = 10_000
"""Beads from which sorting pays: fewer stay in the cache in any order."""
LASTS = 100
"""Steps for which an order is as good as new: beads move a fraction of a cell."""


def is_kept(state: State) -> bool:
    """Whether a run of this state sorts its beads (static)."""
    return bool(_sorted_parts(state))


def _sorted_parts(state: State) -> dict:
    """The ranges of slots that are sorted, each with the grid that says how (static).

    A group of any list stays together, so beads are sorted within the parts that the groups have in
    common.
    """
    edges = {edge for n in state.neighbours for group in n.grid.groups for edge in group}
    if state.rotation is not None:
        edges |= {state.rotation.slots.start, state.rotation.slots.stop}
    edges = sorted(edges)
    grids = [n.grid for n in state.neighbours if n.grid.cells is not None]
    covers = lambda grid, begin, end: any(a <= begin and end <= b for a, b in grid.groups)
    parts = {}
    for begin, end in zip(edges, edges[1:]):
        grid = next((grid for grid in grids if covers(grid, begin, end)), None)
        if grid is not None and end - begin >= SMALLEST:
            parts[begin, end] = grid
    return parts


def list_ids(state: State):
    """What keys the pairs of the lists: the ids (n,), or None where the slots do because nothing is
    sorted."""
    return state.id if is_kept(state) else None


def in_cell_order(state: State) -> State:
    """The same beads, those of large groups sorted by the cells of their first list; small boxes
    are left alone."""
    parts = _sorted_parts(state)
    if not parts:
        return state
    position = jax.lax.stop_gradient(state.position)
    order = jnp.arange(state.n, dtype=jnp.int32)
    for (begin, end), grid in parts.items():
        part = cells.cell_order(grid, state.box, position[begin:end], state.id[begin:end])
        order = order.at[begin:end].set(begin + part)
    return permuted(state, order)


def in_order_of(state: State, ids) -> State:
    """The same beads, in the order in which their ids come in ``ids`` (n,)."""
    return permuted(state, cells.inverse(state.id)[ids]) if is_kept(state) else state


def by_id(state: State):
    """A function that puts what each bead has, or each that rotates, in the order of the ids."""
    places = {state.n: jnp.argsort(state.id)}
    if state.rotation is not None:
        places.setdefault(state.rotation.m, jnp.argsort(state.id[state.rotation.slots]))
    return lambda rows: rows[places[rows.shape[0]]]


def permuted(state: State, order) -> State:
    """The beads ``order`` (n,), a permutation of the slots; lists keep their pairs and their
    order."""
    slot = jnp.append(cells.inverse(order), state.n)
    neighbours = tuple(_renumbered(n, order, slot) for n in jax.lax.stop_gradient(state.neighbours))
    beads = jax.tree.map(lambda rows: rows[order], state.beads)
    rotation = state.rotation
    if rotation is not None:
        rotation = jax.tree.map(lambda rows: rows[order[rotation.slots] - rotation.begin], rotation)
    return dataclasses.replace(state, **beads, neighbours=neighbours, rotation=rotation)


def _renumbered(neighbours, order, slot):
    old = neighbours.list
    new = dataclasses.replace(
        old, idx=slot[old.idx], reference_position=old.reference_position[order]
    )
    return dataclasses.replace(neighbours, list=new)
