"""A batch as replicas of one system: what measures pool may differ in its noise alone."""

import jax
import numpy as np

from dpdjax.engine.batching import batch_axes


def refuse_scan(trajectory):
    """Raise ValueError, naming them, where members of a batch differ in numbers of the fluid or the flow, or in the time step."""
    numbers = trajectory.fluid, trajectory.interval, trajectory.flow
    named = [dict(zip(("fluid", "dt", "flow"), trees)) for trees in (batch_axes(*numbers), numbers)]

    def differing(path, axis, leaf):
        return _name(path) if axis is not None and np.ptp(np.asarray(leaf), axis=0).any() else None

    found = jax.tree_util.tree_map_with_path(differing, *named, is_leaf=lambda axis: axis is None)
    names = dict.fromkeys(jax.tree.leaves(found))
    if names:
        raise ValueError(
            f"the members of this batch differ in {', '.join(names)}; "
            "measure them one by one: [measure(member) for member in run.members()]"
        )


def shared(numbers) -> float:
    """A number that all members of a batch have in common; ValueError where they differ."""
    values = np.unique(np.asarray(numbers, float))
    if values.size > 1:
        raise ValueError(f"the members of this batch differ, {values}; measure them one by one: run.members()")
    return float(values[0])


def _name(path) -> str:
    """Of a number in a tree, the innermost name on the way to it."""
    names = [getattr(key, "name", getattr(key, "key", None)) for key in path]
    return [name for name in names if name is not None][-1]
