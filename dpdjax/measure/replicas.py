"""A batch as replicas of one system: what measures pool may differ in its noise alone."""

import jax
import numpy as np


def refuse_scan(trajectory):
    """Raise ValueError, naming them, where members of a batch differ in numbers of the fluid or the flow, or in the time step."""
    names = []

    def look(path, axis, leaf):
        if axis is not None and np.ptp(np.asarray(leaf), axis=0).any():
            names.append(_name(path))

    interval = {"dt": trajectory.interval}
    spaced = {"dt": 0} if np.ndim(trajectory.interval) else None
    for axes, tree in (
        (trajectory.fluid.batch_axes(), trajectory.fluid), (trajectory.flow.batch_axes(), trajectory.flow), (spaced, interval)
    ):  # fmt: skip
        if axes is not None:
            jax.tree_util.tree_map_with_path(look, axes, tree, is_leaf=lambda axis: axis is None)
    if names:
        raise ValueError(
            f"the members of this batch differ in {', '.join(dict.fromkeys(names))}; "
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
