"""The viscosity of a suspension over that of its solvent."""

import jax
import numpy as np

from dpdjax.calibration.calibrate import measure_viscosity
from dpdjax.engine.trajectory import Trajectory
from dpdjax.measure.solvent import solvent_density
from dpdjax.measure.statistics import Estimate
from dpdjax.measure.viscosity import shear_viscosity
from dpdjax.model.colloids import pure_solvent


def relative_viscosity(
    trajectory: Trajectory,
    *,
    solvent: Estimate | None = None,
    key: jax.Array | None = None,
    tolerance: float = 0.02,
    skip: float = 0.1,
    blocks: int = 20,
) -> Estimate:
    """The viscosity of a sheared suspension over that of its solvent at the density between the
    colloids.

    Colloids displace less solvent than their volume, so the solvent between them is thinner than
    planned, and its viscosity another. Its density is read off the last state of each replica, a
    snapshot, whose scatter is not in the error: where that matters, average
    :func:`dpdjax.measure.solvent_density` over many states, measure there and give ``solvent``.

    Args:
        trajectory: a run with ``flow=dpd.shear(rate)`` recorded with
            ``observe=dpd.observe.shear_record``, one or replicas.
        solvent: viscosity of the solvent, where it is known; measured by default.
        key: a PRNG key for that measurement.
        tolerance: of that measurement, relative; its standard error is a third.
        skip, blocks: as for :func:`dpdjax.shear_viscosity`.

    Raises ValueError as :func:`dpdjax.shear_viscosity` and :func:`dpdjax.measure.solvent_density`
    do, TypeError without a key.

    Example:
        >>> solvent = dpd.Estimate(0.85, 0.02)  # measured at the density between the colloids
        >>> found = dpd.relative_viscosity(sheared, solvent=solvent)  # water for a suspension
        >>> found == dpd.shear_viscosity(sheared).over(solvent)
        True
    """
    suspended = shear_viscosity(trajectory, skip=skip, blocks=blocks)
    if solvent is None:
        member = lambda k: jax.tree.map(lambda leaf: leaf[k], trajectory.final)
        states = (
            map(member, range(len(trajectory.final.position)))
            if trajectory.is_batch
            else [trajectory.final]
        )
        density = float(np.mean([solvent_density(trajectory.fluid, state) for state in states]))
        solvent = measure_viscosity(
            pure_solvent(trajectory.fluid), key=key, density=density, tolerance=tolerance
        ).estimate
    return suspended.over(solvent)
