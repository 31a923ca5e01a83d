"""A batch as replicas of one system: what measures pool may differ in its noise alone."""

import numpy as np

from dpdjax.engine.system import System


def refuse_scan(trajectory):
    """Raise ValueError, naming them, where members of a batch differ in numbers of the fluid or the
    flow, or in the time step."""
    names = System.of(trajectory.fluid, trajectory.interval, trajectory.flow).differing()
    if names:
        raise ValueError(
            f"the members of this batch differ in {', '.join(names)}; "
            "measure them one by one: [measure(member) for member in run.members()]"
        )


def shared(numbers) -> float:
    """A number that all members of a batch have in common; ValueError where they differ."""
    values = np.unique(np.asarray(numbers, float))
    if values.size > 1:
        raise ValueError(
            f"the members of this batch differ, {values}; measure them one by one: run.members()"
        )
    return float(values[0])
