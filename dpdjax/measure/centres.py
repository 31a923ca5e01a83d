"""How the centres of mass of molecules move."""

from collections.abc import Sequence

import numpy as np

from dpdjax.engine.trajectory import Trajectory
from dpdjax.measure import needs
from dpdjax.measure.blocks import standard_error
from dpdjax.measure.conformation import shares
from dpdjax.measure.forgetting import memory_of_beads
from dpdjax.measure.molecules import chains, rows_of
from dpdjax.measure.reading import displaced
from dpdjax.measure.replicas import bead_masses, species_of
from dpdjax.measure.statistics import Estimate
from dpdjax.measure.transport import (
    MeanSquaredDisplacement,
    columns_of,
    correlated,
    einstein,
    read_diffusion,
    squared_displacement,
    without_drift,
)


def molecular_displacement(
    trajectory: Trajectory,
    *,
    length: int | None = None,
    species: int | Sequence[int] | None = None,
    t_max: float | None = None,
    axes: str = "xyz",
) -> MeanSquaredDisplacement:
    """The mean squared displacement of the centres of mass of molecules.

    Relative to the centre of mass of all beads where all were recorded, and under shear relative to
    the flow, as :func:`mean_squared_displacement` has it of beads.

    Args:
        trajectory: a run recorded with ``observe=dpd.observe.positions``, batched or not, sheared
            or not; of molecules alone ``dpd.observe.positions_of`` their species.
        length, species: which molecules, where there are several kinds; see :func:`chains`.
        t_max: longest lag [time]; by default as long as leaves 12 independent pieces.
        axes: of the displacement that count, such as ``"yz"`` for those across a shear flow.

    Returns a ``MeanSquaredDisplacement``. Raises ValueError for a run without bonds, molecules
    of several kinds, and as :func:`mean_squared_displacement` does.

    Example:
        >>> centres = dpd.measure.molecular_displacement(chains, t_max=0.2)
        >>> beads = dpd.measure.mean_squared_displacement(chains, t_max=0.2)
        >>> bool(centres.value[-1] < beads.value[-1])
        True
    """
    which, members, shape = _centres(trajectory, length, species, axes)
    time, curves = correlated(trajectory, members, shape, squared_displacement, t_max)
    return MeanSquaredDisplacement(time, curves.mean(axis=0), standard_error(curves), len(axes))


def molecular_diffusion(
    trajectory: Trajectory,
    *,
    fit: tuple[float, float] | None = None,
    length: int | None = None,
    species: int | Sequence[int] | None = None,
    axes: str = "xyz",
) -> Estimate:
    """The diffusion coefficient of the centres of mass of molecules [length^2 / time].

    A sixth of the slope of their mean squared displacement over the lags of ``fit``. Of a phantom
    chain of N beads with the friction zeta on each it is ``kT / (N zeta)`` at all lags (Doi &
    Edwards 1986, section 4.1); chains that see each other or a solvent take until they have
    relaxed, see :func:`end_to_end`, whose warning is not given here.

    Args:
        trajectory, length, species, axes: as in :func:`molecular_displacement`.
        fit: first and last lag [time]; by default the later half of the lags that leave 12
            independent pieces.

    Warns and raises ValueError as :func:`dpdjax.diffusion` does, and as
    :func:`molecular_displacement`.

    Example:
        >>> plan = dpd.Plan(24, 50)  # too short a run, as a warning says
        >>> ran = dpd.run(melt.fluid, chains.final, key, melt.dt, plan, observe=seen, **quiet)
        >>> D = dpd.measure.molecular_diffusion(ran, fit=(0.9, 1.5))
        >>> 0 < D.value < 0.2
        True
    """
    which, members, shape = _centres(trajectory, length, species, axes)
    mass, of_bead = bead_masses(trajectory)[0], species_of(trajectory)
    own = rows_of(trajectory, which.ids, len(mass))[0]
    memory = memory_of_beads(trajectory, own.ravel(), mass, of_bead)
    memory = memory._replace(inertia=float(mass[own].sum(axis=1).mean()))
    return read_diffusion(
        trajectory,
        members,
        shape,
        squared_displacement,
        einstein,
        fit,
        memory,
        3.0 / len(axes),
    )


def _centres(trajectory, length, species, axes: str):
    """Which molecules, and of each member where their centres of mass went (frames, molecules,
    axes), and the shape of all."""
    which, place = chains(trajectory, length=length, species=species), displaced(trajectory)
    needs.warn_unsettled(trajectory.frames)
    share, columns = shares(trajectory, which), columns_of(trajectory, axes)
    rows = rows_of(trajectory, which.ids, place.shape[2])
    return which, _paths(trajectory, place, rows, share, columns), place.shape


def _paths(trajectory, place, rows, share, columns):
    of_members = np.broadcast_to(bead_masses(trajectory), (len(place), len(species_of(trajectory))))
    for member, mine, mass in zip(place, rows, of_members):
        member = without_drift(member, mass) if member.shape[1] == len(mass) else member
        yield np.einsum("mn,fmnc->fmc", share, member[:, mine])[..., columns]
