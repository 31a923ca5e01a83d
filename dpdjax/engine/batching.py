"""What of the numbers of a run is a batch."""

import jax
import numpy as np


def each_fluid(function, fluid, many: bool):
    """``function(fluid, state)`` of one state; for ``many`` of each member of a batch."""
    return jax.vmap(function, (fluid.batch_axes(), 0)) if many else function


def lengths_of(tree, axes) -> set[int]:
    """The lengths of the batches in a tree of numbers; ``axes``, a prefix of it, are 0 or None."""
    length = lambda axis, leaf: None if axis is None else len(leaf)
    return set(jax.tree.leaves(jax.tree.map(length, axes, tree, is_leaf=lambda axis: axis is None)))


def differing(tree, axes) -> dict:
    """The numbers of a tree that differ from member to member, by their innermost name: (members,
    ...) each, known values; ``axes`` as for :func:`lengths_of`."""
    found = {}

    def note(path, axis, values):
        if axis is not None and np.ptp(np.asarray(values), axis=0).any():
            names = [getattr(key, "name", getattr(key, "key", None)) for key in path]
            found[[name for name in names if name is not None][-1]] = np.asarray(values)

    jax.tree_util.tree_map_with_path(note, axes, tree, is_leaf=lambda axis: axis is None)
    return found


def named(member: int, differing: dict) -> str:
    """A member of a batch with those of its numbers that differ from member to member."""
    shown = lambda values: np.array2string(values[member], precision=6)
    own = ", ".join(f"{name} = {shown(values)}" for name, values in differing.items())
    return f"member {member}" + (f" ({own})" if own else "")


def chosen(tree, axes, which):
    """The members ``which`` of a batch of numbers; ``axes``, a prefix of the tree, are 0 for what
    is a batch, else None."""
    own = lambda axis, part: part if axis is None else jax.tree.map(lambda leaf: leaf[which], part)
    return jax.tree.map(own, axes, tree, is_leaf=lambda axis: axis is None)
