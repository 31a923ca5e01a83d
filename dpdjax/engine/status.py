"""Sticky bits: what went wrong inside a compiled run, to be read when it is over."""

import jax
import jax.numpy as jnp
import numpy as np

PAIRS_OVERFLOW = 1
WINDOW_OVERFLOW = 2
NOT_FINITE = 4
REACH_EXCEEDED = 8
BOX_TOO_SMALL = 16
RUN_AWAY = 32
BAD_LAW = 64
UNSOLVED = 128
TORN = 256
NARROW_CELLS = 512

MEANINGS = {
    PAIRS_OVERFLOW: "a neighbour list overflowed; use dpd.run, which grows it, or dpd.grow(state)",
    WINDOW_OVERFLOW: "a cell of the neighbour list overflowed; use dpd.run, which grows it, or "
    "dpd.grow(state)",
    NARROW_CELLS: "the box became too small for the cells of a neighbour list; use dpd.run, which "
    "makes them wider, or dpd.grow(state)",
    NOT_FINITE: "positions or velocities became NaN or infinite; use a smaller dt, or a start "
    "whose beads are further apart",
    REACH_EXCEEDED: "a term reaches further than the list was made for; make the state with this "
    "fluid",
    RUN_AWAY: "the beads ran away, hotter than their energies explain; use a smaller shear rate or "
    "dt, or a start whose beads are "
    'further apart, start="lattice"',
    BOX_TOO_SMALL: "a side of the box fell below 2 (reach + skin); use a larger box or a smaller "
    "skin",
    BAD_LAW: "a friction is negative, or a law is not finite where beads can be; give other "
    "coefficients",
    UNSOLVED: "the drag of a step was not solved for; use a smaller dt, or a larger tolerance of "
    "the integrator",
    TORN: "a bond became longer than half a box; use stiffer bonds, a smaller dt or shear rate, or "
    "a larger box",
}
OVERFLOWS = PAIRS_OVERFLOW | WINDOW_OVERFLOW | NARROW_CELLS
CROWDED = (
    "the beads crowd together until no neighbour list holds them; give repulsions that keep "
    "them apart"
)
"""What an overflow means where lists were grown again and again."""


def flag(condition, bit: int):
    """``bit`` where the condition holds, else no bit; uint32."""
    return jnp.where(condition, jnp.uint32(bit), jnp.uint32(0))


def describe(status, grown: bool = False) -> str:
    """The bits in words; empty where all is well. A batch is merged; ``grown``: lists that overflow
    were grown before."""
    bits = int(np.bitwise_or.reduce(np.asarray(status).ravel(), initial=0))
    text_of = lambda bit: CROWDED if grown and bit & OVERFLOWS else MEANINGS[bit]
    return "; ".join(dict.fromkeys(text_of(bit) for bit in MEANINGS if bits & bit))


def poison(tree, status, inputs):
    """NaN in every float of ``tree``, and in every derivative with respect to ``inputs``, unless
    the status is clear."""
    harm = jnp.where(status == 0, 0.0, jnp.nan)
    # Zero, with a derivative of one for each input: the harm reaches even those that the tree does
    # not depend on.
    zero = lambda x: jnp.sum(jnp.where(jnp.isfinite(x), x - jax.lax.stop_gradient(x), 0.0))
    link = sum(zero(x) for x in jax.tree.leaves(inputs) if _is_floating(x))
    return jax.tree.map(
        lambda leaf: leaf + (harm * link).astype(leaf.dtype) if _is_floating(leaf) else leaf, tree
    )


def _is_floating(leaf) -> bool:
    return jnp.issubdtype(jnp.result_type(leaf), jnp.floating)
