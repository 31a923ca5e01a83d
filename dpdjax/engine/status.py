"""Sticky bits: what went wrong inside a compiled run, to be read when it is over."""

import jax
import jax.numpy as jnp
import numpy as np

PAIRS_OVERFLOW = 1
WINDOW_OVERFLOW = 2
NOT_FINITE = 4
REACH_EXCEEDED = 8
BOX_TOO_SMALL = 16

MEANINGS = {
    PAIRS_OVERFLOW: "a neighbour list overflowed; use dpd.run, which grows it, or dpd.grow(state)",
    WINDOW_OVERFLOW: "a cell of the neighbour list overflowed; use dpd.run, which grows it, or dpd.grow(state)",
    NOT_FINITE: "positions or velocities became NaN or infinite; use a smaller dt",
    REACH_EXCEEDED: "a term reaches further than the list was made for; make the state with this fluid",
    BOX_TOO_SMALL: "a side of the box fell below 2 (reach + skin); use a larger box or a smaller skin",
}
OVERFLOWS = PAIRS_OVERFLOW | WINDOW_OVERFLOW


def flag(condition, bit: int):
    """``bit`` where the condition holds, else no bit; uint32."""
    return jnp.where(condition, jnp.uint32(bit), jnp.uint32(0))


def describe(status) -> str:
    """The bits in words; empty where all is well. A batch is merged."""
    bits = int(np.bitwise_or.reduce(np.asarray(status).ravel(), initial=0))
    return "; ".join(text for bit, text in MEANINGS.items() if bits & bit)


def poison(tree, status):
    """NaN in every float, value and gradient alike, unless the status is clear.

    A product, not a ``where``: the branch not taken would pass a gradient of zero.
    """
    factor = jnp.where(status == 0, 1.0, jnp.nan)

    def spoil(leaf):
        floating = jnp.issubdtype(jnp.result_type(leaf), jnp.floating)
        return leaf * factor.astype(leaf.dtype) if floating else leaf

    return jax.tree.map(spoil, tree)
