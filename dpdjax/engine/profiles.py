"""Profiles across the box that a run records: the pressure, slab by slab."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.bonded.forces import along
from dpdjax.bonded.topology import each_type
from dpdjax.checks import choice, whole
from dpdjax.engine.state import State
from dpdjax.model.beads import masses
from dpdjax.model.fluid import Fluid
from dpdjax.pairs.forces import interactions_of
from dpdjax.pairs.geometry import Columns, Moment, geometry, take
from dpdjax.pairs.laws import evaluate
from dpdjax.pairs.sums import over_blocks

HIGHEST = jax.lax.Precision.HIGHEST
AXES = {"x": (0, 1, 2), "y": (1, 2, 0), "z": (2, 0, 1)}
"""The components of each profile: along its axis, and across it."""
BLOCK = 4096
"""Segments spread over the slabs at a time."""


@functools.cache
def pressure_in_slabs(bins: int = 50, axis: str = "z") -> Callable:
    """An observable: the pressure in slabs of equal width across an axis, as
    :func:`dpdjax.measure.pressure_profile` reads it; best recorded as ``dpd.mean(...)`` of it.

    Args:
        bins: slabs, 2 or more.
        axis: ``"x"``, ``"y"`` or ``"z"``, normal to the slabs.

    It gives ``pressure_profile`` (bins, 3) [energy / volume], along the axis and along the two
    others, x, y, z in turn, and ``pressure_profile_side``, that of the box along the axis [length].

    The pressure is the kinetic part, of each bead where it is, and that of all potentials along the
    straight line between two beads (Irving & Kirkwood 1950): a slab has the share of ``F_a r_a``
    that the share of the line in it is, exactly. An angle or a dihedral pulls along its bonds. The
    volume of a slab times the sum over slabs is what the pressure tensor of these parts is; the
    contour is a choice, and the profile of the tangential part depends on it, the tension does not.

    Raises ValueError for fewer slabs or another axis. Slabs across x of a box that is tilted do not
    repeat with it, and are NaN.

    Example:
        >>> slabs = dpd.observe.pressure_in_slabs(8)(water, rest.final)["pressure_profile"]
        >>> slabs.shape
        (8, 3)
        >>> p = dpd.observe.pressure_tensor(water, rest.final, ("kinetic", "conservative"))
        >>> bool(jnp.allclose(slabs.mean(axis=0), jnp.diagonal(p)[jnp.array([2, 0, 1])], rtol=1e-3))
        True
    """
    bins, components = whole(bins, "bins", least=2), AXES[choice(axis, AXES, "axis")]
    slabs = functools.partial(_Slabs, bins, components)

    def observe(fluid: Fluid, state: State) -> dict:
        box = state.box
        total = slabs(box).kinetic(fluid, state)
        for part in (_of_pairs, _of_bonds):
            total = total + part(fluid, state, slabs(box))
        repeats = True if axis != "x" else box.strain == 0
        profile = jnp.where(repeats, total.T * (bins / box.volume), jnp.nan)
        side = box.lengths[components[0]]
        return {"pressure_profile": profile, "pressure_profile_side": side}

    return observe


class _Slabs:
    """Slabs of equal width across one side of a box, and what lies in them, (3, bins) each."""

    def __init__(self, bins: int, components: tuple[int, int, int], box):
        self.bins, self.components = bins, components
        self.side = box.lengths[components[0]]
        self.width = self.side / bins

    @property
    def middle(self):
        """Of each slab (bins,)."""
        return (jnp.arange(self.bins, dtype=self.side.dtype) + 0.5) * self.width

    def kinetic(self, fluid, state):
        """``sum m c c`` of the beads in each slab, with an even share for each bead of what the end
        of a step changed at once."""
        place = state.position[:, self.components[0]]
        slab = jnp.clip((place / self.width).astype(jnp.int32), 0, self.bins - 1)
        every = state.velocity**2 * masses(fluid, state)[:, None]
        every += (jnp.diagonal(state.tally.carried) / state.n)[None]
        total = jnp.zeros((self.bins, 3), every.dtype).at[slab].add(every)
        return total[:, np.array(self.components)].T

    def spread(self, end, vector, product):
        """What segments have in each slab, in proportion to their lengths there.

        Args:
            end: where each begins along the axis (segments,).
            vector: how far it goes from there along the axis (segments,), less than half a side.
            product: what it has in all (3, segments), x, y, z.
        """
        product = jnp.stack([product[k] for k in self.components])
        # Of a segment within a plane of the slabs: as if it were this long across it.
        least = jnp.finfo(vector.dtype).eps ** 0.5 * self.width
        length = jnp.maximum(jnp.abs(vector), least)
        away = self.middle[:, None] - (end + 0.5 * vector)[None]
        away = jnp.abs(away - self.side * jnp.round(away / self.side))
        inside = 0.5 * (length[None] + self.width) - away
        inside = jnp.clip(inside, 0.0, jnp.minimum(length, self.width)[None])
        # Divided by their sum and not by the length, the shares add up to 1 whatever rounding does.
        share = inside / jnp.sum(inside, axis=0, keepdims=True)
        return jnp.einsum("kp,bp->kb", product, share, precision=HIGHEST)


def _of_pairs(fluid, state, slabs: _Slabs):
    """That of the potentials between pairs."""
    beads, moment = Columns.of(fluid, state, state.velocity), Moment(state.box)
    total = jnp.zeros((3, slabs.bins), state.position.dtype)
    for interaction, neighbours in interactions_of(fluid, state):
        if interaction.conservative:
            add = functools.partial(_add_pairs, fluid, interaction, beads, moment, slabs)
            idx = neighbours.list.idx
            total = over_blocks(add, total, idx, min(BLOCK, idx.shape[1]), state.n)
    return total


def _add_pairs(fluid, interaction, beads: Columns, moment: Moment, slabs: _Slabs, total, idx):
    pairs = geometry(fluid, interaction, beads, idx, moment)
    force = evaluate(interaction.conservative, pairs, fluid.kT, derivative=True)[1]
    r = jnp.where(pairs.real, pairs.r, 0.0)
    normal = slabs.components[0]
    end = take(beads.position[normal], jnp.minimum(pairs.j, beads.id.shape[0] - 1))
    product = jnp.stack([force * r * e * e for e in pairs.e])
    return total + slabs.spread(end, r * pairs.e[normal], product)


def _of_bonds(fluid, state, slabs: _Slabs):
    """That of bonds, angles and dihedrals."""
    total, normal = jnp.zeros((3, slabs.bins), state.position.dtype), slabs.components[0]
    for b, slots, v in each_type(fluid.bonded, state):
        pull = sum(along(b, v, fluid.kT)[1].values())
        end = take(state.position[:, normal], slots[1:])
        rows = lambda x: x.reshape(*x.shape[:-2], -1)
        total = total + slabs.spread(rows(end), rows(v[normal]), rows(pull * v))
    return total
