"""Some beads of a state as a state of their own, to be moved on by themselves and put back."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dpdjax.bonded.topology import NOBODY, Topology
from dpdjax.engine.state import State
from dpdjax.pairs import neighbours as lists


class Part(NamedTuple):
    """Which beads and interactions are taken out of a state (static).

    Attributes:
        interactions: places among those of the fluid; all of their beads are in the part.
        begin, end: slots of the beads.
    """

    interactions: tuple[int, ...]
    begin: int
    end: int

    @classmethod
    def of(cls, state: State, interactions: tuple[int, ...]) -> "Part":
        """The beads that interactions act between, and those that lie among them; with all that
        rotate, where some do."""
        groups = [g for k in interactions for g in state.neighbours[k].grid.groups]
        if state.rotation is not None:
            groups.append((state.rotation.slots.start, state.rotation.slots.stop))
        return cls(interactions, min(a for a, _ in groups), max(b for _, b in groups))

    def state(self, state: State) -> State:
        """The beads of the part, numbered from 0, with the lists of its interactions."""
        beads = jax.tree.map(lambda rows: rows[self.begin : self.end], state.beads)
        neighbours = tuple(self._listed(state.neighbours[k], state.n) for k in self.interactions)
        rotation = state.rotation
        if rotation is not None:
            rotation = dataclasses.replace(rotation, begin=rotation.begin - self.begin)
        own = {"rotation": rotation, "topology": self._apart(state)}
        beads |= {"id": beads["id"] - self.begin} | own
        return dataclasses.replace(state, **beads, neighbours=neighbours)

    def _apart(self, state: State) -> Topology | None:
        """Which pairs of the part no list holds; bonds act on the whole."""
        if state.excluded is None:
            return None
        partners = state.topology.partners[self.begin : self.end]
        within = (partners >= self.begin) & (partners < self.end)
        return Topology({}, {}, jnp.where(within, partners - self.begin, NOBODY))

    def put(self, rows, own):
        """``own`` rows of the part in place of those of all beads (n, ...)."""
        return rows.at[self.begin : self.end].set(own)

    def placed(self, state: State, own: State) -> State:
        """The state with the beads of the part where they are in their own state, at the same time,
        and as many overflows."""
        image = own.image
        # Their boxes may differ by a period of strain, for it is summed in other steps.
        period = state.box.lengths[0] / state.box.lengths[1]
        periods = jnp.round((own.box.strain - state.box.strain) / period).astype(image.dtype)
        image = image.at[:, 0].add(periods * image[:, 1])
        new = {name: getattr(own, name) for name in ("position", "position_rest")}
        rows = {name: self.put(getattr(state, name), x) for name, x in new.items()}
        rows |= {"image": self.put(state.image, image)}
        neighbours = list(state.neighbours)
        for k, mine in zip(self.interactions, own.neighbours):
            neighbours[k] = lists.with_overflow(neighbours[k], mine.list.error.code)
        return dataclasses.replace(state, **rows, neighbours=tuple(neighbours))

    def _listed(self, neighbours: lists.Neighbours, n: int) -> lists.Neighbours:
        grid, held = neighbours.grid, neighbours.list
        groups = tuple((a - self.begin, b - self.begin) for a, b in grid.groups)
        idx = jnp.where(held.idx < n, held.idx - self.begin, self.end - self.begin)
        reference = held.reference_position[self.begin : self.end]
        grid = dataclasses.replace(grid, groups=groups)
        built_in = neighbours.strain, neighbours.lengths
        return lists.restore(grid, idx, reference, held.error.code, *built_in)
