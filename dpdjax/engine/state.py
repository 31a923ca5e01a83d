"""The state of a run: where the beads are, and all that a bitwise restart needs."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.engine import status as bits
from dpdjax.engine.rotation import Rotation
from dpdjax.model import summary
from dpdjax.model.fluid import ORIGINS
from dpdjax.pairs import box as boxes
from dpdjax.pairs import neighbours as lists
from dpdjax.pairs.sums import Tally
from dpdjax.xla import each_member


def _of_bead():
    """A field with a row for each bead."""
    return dataclasses.field(metadata={"of_bead": True})


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, repr=False)
class State:
    """One configuration of n beads.

    Attributes:
        position: wrapped Cartesian positions (n, 3), 0 to the side along each axis [length].
        velocity: peculiar velocities, the streaming velocity taken off, (n, 3).
        force: force of the last step, on which the next half kick depends, (n, 3).
        image: vectors of the lattice, as it is now, that each bead was carried over since the
            start, (n, 3) int32.
        id: what the noise of a bead is keyed by, a permutation of 0 to n - 1, (n,) int32; travels
            with the bead.
        species: index into the tables of the fluid, (n,) int32; beads of a species lie together.
        size: relative size of each bead, (n,): its radius in those of its species, the mass goes as
            the cube.
        box: lengths and strain.
        step: absolute number of the step, which keys the noise.
        time: elapsed time, which body forces and oscillations depend on.
        position_rest, strain_rest, time_rest: what rounding has left out of the positions (n, 3),
            the strain of the box and the time, which grow by many small steps.
        neighbours: one list for each interaction.
        tally: sums over pairs, for the observables.
        rotation: of the beads that rotate, or None.
        started: which kinds of force ``force`` consists of, as bits
            (``Integrator.mark_of``); a run
            with an integrator of other kinds computes it first, as where it is 0.
        status: sticky bits (``dpdjax.engine.status``).
    """

    position: Any = _of_bead()
    velocity: Any = _of_bead()
    force: Any = _of_bead()
    image: Any = _of_bead()
    id: Any = _of_bead()
    species: Any = _of_bead()
    size: Any = _of_bead()
    box: boxes.Box
    step: Any
    time: Any
    position_rest: Any = _of_bead()
    strain_rest: Any
    time_rest: Any
    neighbours: tuple[lists.Neighbours, ...]
    tally: Tally
    started: Any
    status: Any
    rotation: Rotation | None = None

    def __repr__(self):
        shape = getattr(self.position, "shape", ())
        if len(shape) not in (2, 3):
            return f"State(position={self.position!r}, ...)"
        members = f"{shape[0]} members of " if len(shape) == 3 else ""
        rotating = "" if self.rotation is None else f", {self.rotation.m} of which rotate"
        return f"State({members}{shape[-2]} beads{rotating}, {self._whereabouts()})"

    def _whereabouts(self) -> str:
        if not summary.is_known(self.box, self.step, self.time, self.status):
            return "numbers not known"
        sides = " x ".join(summary.span(self.box.lengths[..., k]) for k in range(3))
        tilt = f" at strain {summary.span(self.box.strain)}" if np.any(self.box.strain) else ""
        trouble = bits.describe(self.status)
        return (
            f"box {sides}{tilt}, step {summary.span(self.step)}, time {summary.span(self.time)}"
            + (trouble and f": {trouble}")
        )

    def _repr_html_(self):
        inside = repr(self).removeprefix("State(").removesuffix(")")
        return summary.as_table("State", [(part,) for part in inside.split(", ")])

    @property
    def n(self) -> int:
        """Number of beads."""
        return self.position.shape[-2]

    @property
    def beads(self) -> dict:
        """All that has a row for each bead, by name: what goes where a bead goes in memory."""
        own = [f.name for f in dataclasses.fields(self) if f.metadata.get("of_bead")]
        return {name: getattr(self, name) for name in own}

    @property
    def unwrapped(self) -> jax.Array:
        """Positions followed through the periodic images (n, 3) [length].

        Their differences are displacements; under shear they hold what the flow carries a bead
        along, ``rate y``.
        """
        lengths = self.box.lengths
        shift = (self.box.strain * lengths[..., 1])[..., None] * self.image[..., 1]
        tilted = jnp.stack([shift, jnp.zeros_like(shift), jnp.zeros_like(shift)], axis=-1)
        return self.position + self.image * lengths[..., None, :] + tilted

    def restarted(self) -> "State":
        """The same beads for a run of its own: the force is forgotten, which the next run computes
        from its own fluid, and its clock starts at 0, so that times are ages. Steps count on, so
        that noise of the same key does not repeat."""
        names = ("started", "time", "time_rest")
        zero = {name: jnp.zeros_like(getattr(self, name)) for name in names}
        return dataclasses.replace(self, **zero)


# One program: operation by operation, a first list takes seconds to compile.
@functools.partial(jax.jit, static_argnames=("grids", "origins"))
def assemble(
    box: boxes.Box,
    position,
    velocity,
    species,
    grids: tuple[lists.Grid, ...],
    size=None,
    origins: tuple[str, ...] = ORIGINS,
    rotation: Rotation | None = None,
) -> State:
    """A state from arrays: positions (n, 3) anywhere, peculiar velocities (n, 3), species (n,),
    relative sizes (n,).

    ``origins``: names under which the fluid keeps stresses; ``rotation``: that of the beads that
    rotate.
    """
    n = position.shape[0]
    position, _ = boxes.wrap(box, position)
    integers = jnp.zeros((), jnp.int32)
    return State(
        position=position,
        velocity=velocity,
        force=jnp.zeros_like(position),
        image=jnp.zeros((n, 3), jnp.int32),
        id=jnp.arange(n, dtype=jnp.int32),
        species=species,
        size=jnp.ones(n, position.dtype) if size is None else size.astype(position.dtype),
        box=box,
        step=integers,
        time=jnp.zeros((), position.dtype),
        position_rest=jnp.zeros_like(position),
        strain_rest=jnp.zeros((), position.dtype),
        time_rest=jnp.zeros((), position.dtype),
        neighbours=tuple(lists.allocate(grid, box, position) for grid in grids),
        tally=Tally.zero(position.dtype, origins),
        started=integers,
        status=jnp.zeros((), jnp.uint32),
        rotation=rotation,
    )


def grow(state: State, codes: Sequence[int] | None = None) -> State:
    """The same state with larger lists, one or a batch; ``codes``: of each list what is to grow, by
    default all.

    A complete list keeps its pairs in order, so a replay is bitwise the same; one that
    overflowed is built anew.
    """
    grown = []
    for neighbours, code in zip(state.neighbours, codes or [3] * len(state.neighbours)):
        grid = neighbours.grid.grown(code)
        if lists.overflow(neighbours):
            build = lambda box, position: lists.allocate(grid, box, position)
            build = each_member(build) if state.position.ndim == 3 else build
            grown.append(build(state.box, state.position))
        else:
            grown.append(lists.pad(neighbours, grid))
    return dataclasses.replace(state, neighbours=tuple(grown), status=jnp.zeros_like(state.status))
