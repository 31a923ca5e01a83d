"""The state of a run: where the beads are, and all that a bitwise restart needs."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dpdjax.bonded import topology as bonds
from dpdjax.bonded.topology import Topology
from dpdjax.checks import is_concrete, whole
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
        velocity: peculiar velocities, the streaming velocity taken off, (n, 3) [length / time].
        force: force of the last step, on which the next half kick depends, (n, 3) [force].
        image: vectors of the lattice, as it is now, that each bead was carried over since the
            start, (n, 3) int32.
        id: what the noise of a bead is keyed by, a permutation of 0 to n - 1, (n,) int32; travels
            with the bead.
        species: index into the tables of the fluid, (n,) int32; beads of a species lie together.
        size: relative size of each bead, (n,): its radius in those of its species, the mass goes as
            the cube.
        box: lengths and strain, a :class:`dpdjax.Box`.
        step: absolute number of the step, which keys the noise.
        time: elapsed time, which body forces and oscillations depend on [time].
        position_rest: what rounding has left out of the positions, which grow by many small
            steps, (n, 3).
        strain_rest: the same of the strain of the box.
        time_rest: the same of the time.
        neighbours: one list for each interaction.
        tally: sums over pairs, for the observables.
        rotation: of the beads that rotate, or None.
        topology: which beads are bonded, or None; see ``State.bonded``.
        started: which kinds of force ``force`` consists of, as bits (``Integrator.mark_of``); a run
            with an integrator of other kinds computes it first, as where it is 0.
        status: sticky bits, 0 while all is well.

    Example:
        >>> state
        State(192 beads, box 4 x 4 x 4, step 200, time 2)
        >>> state.n, state.position.shape, int(state.step)
        (192, (192, 3), 200)
        >>> state.restarted()
        State(192 beads, box 4 x 4 x 4, step 200, time 0)
        >>> melt.state.topology
        Topology(1228 bond)
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
    topology: Topology | None = None

    def __repr__(self):
        shape = getattr(self.position, "shape", ())
        if len(shape) not in (2, 3):
            return f"State(position={self.position!r}, ...)"
        members = f"{shape[0]} members of " if len(shape) == 3 else ""
        rotating = "" if self.rotation is None else f", {self.rotation.m} of which rotate"
        bonds = () if self.topology is None else self.topology.counts.items()
        bonded = "".join(f", {count} {name}" for name, count in bonds)
        return f"State({members}{shape[-2]} beads{rotating}{bonded}, {self._whereabouts()})"

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
        """What has a row for each bead, by name, and goes where a bead goes in memory."""
        own = [f.name for f in dataclasses.fields(self) if f.metadata.get("of_bead")]
        return {name: getattr(self, name) for name in own}

    def bonded(self, groups: Mapping[str, ArrayLike], *, exclude: int = 0) -> "State":
        """The same beads with bonds, angles and dihedrals in place of any they had.

        Args:
            groups: by the names of the types in the fluid the ids of the beads, (bonds, 2),
                (angles, 3) with the middle one second, (dihedrals, 4) along the chain.
            exclude: pairs up to so many bonds apart do not act on each other as pairs, by
                potentials, drag or noise; 0, as is usual in DPD, for none.

        Bonded beads are the nearest images of each other. Raises ValueError for ids of no bead, or
        a bead twice in one bond; for a batch of states, or one that is traced.
        """
        if not is_concrete(self.position) or self.position.ndim != 2:
            raise ValueError("bonds are made of one state whose numbers are known")
        apart = whole(exclude, "exclude", least=0)
        where = self.box, self.position, self.image, self.id
        new = dataclasses.replace(self, topology=bonds.topology(*where, groups, apart))
        new = dataclasses.replace(new, started=jnp.zeros_like(self.started))
        if not apart:
            return new._with_all_pairs()
        held = tuple(lists.excluding(n, new.excluded) for n in self.neighbours)
        return dataclasses.replace(new, neighbours=held)

    def _with_all_pairs(self) -> "State":
        """Lists that leave nothing out, built anew where they did."""
        if not any(n.grid.excludes for n in self.neighbours):
            return self
        grids = (dataclasses.replace(n.grid, excludes=False) for n in self.neighbours)
        anew = tuple(lists.allocate(grid, self.box, self.position) for grid in grids)
        return dataclasses.replace(self, neighbours=anew)

    def keeping(self, origins: tuple[str, ...]) -> "State":
        """The same state, one or a batch, where its force is not known yet, with room for the
        stresses of these names."""
        held = self.tally.virial
        if set(held) == set(origins) or not is_concrete(self.started) or np.any(self.started):
            return self
        nothing = jnp.zeros_like(next(iter(held.values())))
        virial = {origin: held.get(origin, nothing) for origin in origins}
        return dataclasses.replace(self, tally=dataclasses.replace(self.tally, virial=virial))

    @property
    def excluded(self) -> lists.Excluded | None:
        """The pairs that no list holds, or None."""
        if self.topology is None or self.topology.partners is None:
            return None
        return lists.Excluded(self.topology.partners, self.id)

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

    Example:
        >>> roomy = dpd.grow(state)
        >>> before, after = (s.neighbours[0].list.idx.shape[1] for s in (state, roomy))
        >>> after > before  # room for pairs
        True
        >>> bool((roomy.position == state.position).all())
        True
    """
    grown = []
    for neighbours, code in zip(state.neighbours, codes or [3] * len(state.neighbours)):
        grid = neighbours.grid.grown(code)
        if lists.overflow(neighbours):
            build = lambda box, position, out: lists.allocate(grid, box, position, excluded=out)
            build = each_member(build) if state.position.ndim == 3 else build
            grown.append(build(state.box, state.position, state.excluded))
        else:
            grown.append(lists.pad(neighbours, grid))
    return dataclasses.replace(state, neighbours=tuple(grown), status=jnp.zeros_like(state.status))
