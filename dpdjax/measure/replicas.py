"""A batch as replicas of one system: what measures pool may differ in its noise alone."""

import numpy as np

from dpdjax.engine.system import System


def refuse_scan(trajectory):
    """Raise ValueError, naming them, where members of a batch differ in numbers of the fluid or the
    flow, or in the time step."""
    names = System.of(trajectory.fluid, trajectory.dt, trajectory.flow).differing()
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


def species_of(trajectory) -> np.ndarray:
    """The species of each bead (n,), the same in every member of a batch."""
    species = np.asarray(trajectory.final.species)
    return species.reshape(-1, species.shape[-1])[0]


def volume_of(trajectory) -> float:
    """Volume of the box at the end, the same in every member of a batch [length^3]."""
    return float(np.prod(np.asarray(trajectory.final.box.lengths, float).reshape(-1, 3)[0]))


def bead_masses(trajectory):
    """Mass of each bead in each member, (batch, n), or of all, (1, n)."""
    mass = np.asarray(trajectory.fluid.mass, float)
    mass = mass.reshape(-1, mass.shape[-1])[:, species_of(trajectory)]
    size = np.asarray(trajectory.final.size, float).reshape(-1, mass.shape[1])
    return mass * size**3
