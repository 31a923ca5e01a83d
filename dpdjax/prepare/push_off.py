"""Beads that were placed on top of each other, pushed apart before they run."""

import dataclasses
import functools

import jax
import jax.numpy as jnp

from dpdjax.engine.forces import forces_on, update_lists
from dpdjax.engine.integrator import moved_on
from dpdjax.engine.state import State, assemble
from dpdjax.engine.system import System
from dpdjax.model.fluid import Fluid
from dpdjax.model.rates import (
    bond_frequency,
    extreme,
    pair_frequency,
    repulsion_energy,
    shortest_reach,
)
from dpdjax.pairs import neighbours as lists
from dpdjax.pairs.laws import CONSERVATIVE

STEPS = 200
FARTHEST = 0.05
"""Share of the shortest reach that a bead moves by at most in a step."""
ROOM, MOST_GROWTHS = 1.3, 10
"""Pairs of beads that lie on top of each other, over those of beads without structure; and how
often there is made more room."""


def pushed_off(fluid: Fluid, state: State, key: jax.Array, steps: int = STEPS) -> State:
    """The same beads after some steps down the slope of their energy, each at most a twentieth of
    the shortest reach, with lists that hold them; velocities, step and time stay.

    Raises ValueError where no list holds them.
    """
    # At rest in a flow of none: what drives and what rubs has no part in it.
    system = System.of(fluid, 1.0).as_type(state.position.dtype)
    pace = _pace(fluid, state), FARTHEST * shortest_reach(extreme(fluid))
    grids = [_roomy(n.grid) for n in state.neighbours]
    for _ in range(MOST_GROWTHS):
        roomy = tuple(_stale(grid, state) for grid in grids)
        given = dataclasses.replace(state, neighbours=roomy)
        after = _descended(system, given, key, pace, steps)
        codes = [lists.overflow(n) for n in after.neighbours]
        if not any(codes):
            return _relisted(fluid, state, after)
        grids = [grid.grown(code) for grid, code in zip(grids, codes)]
    raise ValueError("the beads start so crowded that no list holds them; give a lower density")


@functools.partial(jax.jit, static_argnames="steps")
def _descended(system, state: State, key, pace, steps: int) -> State:
    """The state some steps down the slope."""
    rate, most = pace

    def lower(state, _):
        state = update_lists(state)
        force = forces_on(system, state, state.velocity, key, False, (CONSERVATIVE,)).force
        size = jnp.sqrt(jnp.sum(force * force, axis=1, keepdims=True))
        share = jnp.minimum(rate, most / jnp.where(size > 0, size, 1.0))
        still = jnp.zeros_like(state.time)
        return moved_on(state, (share * force).T, still, still), None

    return jax.lax.scan(lower, state, length=steps)[0]


def _relisted(fluid: Fluid, state: State, after: State) -> State:
    """The beads of ``after`` with lists as long as those of ``state``."""
    grids = tuple(n.grid for n in state.neighbours)
    given = after.position, after.velocity, after.species, _all_pairs(grids), after.size
    lists_of = assemble(after.box, *given, fluid.origins, after.rotation).neighbours
    if after.excluded is not None:
        lists_of = tuple(lists.excluding(n, after.excluded) for n in lists_of)
    names = ("step", "time", "time_rest", "status")
    same = {name: getattr(state, name) for name in names}
    return dataclasses.replace(after, neighbours=lists_of, **same)


def _all_pairs(grids) -> tuple[lists.Grid, ...]:
    """Grids that leave nothing out."""
    return tuple(dataclasses.replace(grid, excludes=False) for grid in grids)


def _roomy(grid: lists.Grid) -> lists.Grid:
    return dataclasses.replace(grid, capacity=lists.room_for(grid, ROOM))


def _stale(grid: lists.Grid, state: State) -> lists.Neighbours:
    """An empty list, which the first look at it finds to be stale."""
    half = 0.5 * state.box.lengths[None] * jnp.array([[1, 0, 0]], state.position.dtype)
    idx = jnp.full((2, grid.capacity), state.n, jnp.int32)
    code = jnp.zeros((), jnp.uint8)
    return lists.restore(
        grid, idx, state.position + half, code, state.box.strain, state.box.lengths
    )


def _pace(fluid: Fluid, state: State) -> float:
    """Distance over force: a third of what the stiffest motion is stable with."""
    numbers = extreme(fluid)
    mass = float(min(numbers.mass))
    pairs = max((pair_frequency(numbers, i) for i in numbers.interactions), default=0.0)
    crowd = repulsion_energy(numbers, state.n / float(state.box.volume))
    stiffness = 2.0 * mass * max(bond_frequency(numbers), pairs) ** 2
    stiffness += 10.0 * crowd / shortest_reach(numbers) ** 2
    return 0.3 / stiffness if stiffness > 0 else 1.0
