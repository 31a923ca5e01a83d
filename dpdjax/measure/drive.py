"""Driven spheres: diffusion from the velocity under a force, or the angular velocity under a
torque."""

import dataclasses
import math

import numpy as np

from dpdjax.engine.drivers import Drive
from dpdjax.engine.trajectory import Trajectory
from dpdjax.errors import warn
from dpdjax.measure import needs
from dpdjax.measure.reading import chosen_beads, displaced, of_beads, recorded
from dpdjax.measure.replicas import bead_masses, refuse_scan, shared, species_of
from dpdjax.measure.results import Result
from dpdjax.measure.rotation import check_turned
from dpdjax.measure.statistics import Estimate, block_average

SUSPECT = 0.5
"""Share of the least error that an error bar, itself uncertain, stays above."""


@dataclasses.dataclass(frozen=True, repr=False)
class Driven(Result):
    """What spheres do under a force or a torque.

    Attributes:
        diffusion: ``D = kT v / F`` [length^2/time], or ``D_r = kT omega / T`` [1/time].
        velocity: along the force, where the whole has no momentum [length/time]; or the angular
            velocity about the torque [1/time].
        friction: ``kT / D``, force over velocity [mass/time] or torque over angular velocity
            [energy time].
        is_torque: whether it is a torque.

    Example:
        >>> found = dpd.measure.Driven(
        ...     diffusion=dpd.Estimate(0.02, 0.001),
        ...     velocity=dpd.Estimate(0.1, 0.005),
        ...     friction=dpd.Estimate(50.0, 2.5),
        ... )
        >>> round(found.reynolds(density=3.0, viscosity=1.0, radius=1.0), 3)
        0.3
    """

    diffusion: Estimate
    velocity: Estimate
    friction: Estimate
    is_torque: bool = False

    def reynolds(self, *, density: float, viscosity: float, radius: float) -> float:
        """``density v radius / viscosity``, for an angular velocity with ``v = omega radius``: to
        stay below 0.1 or so."""
        speed = abs(self.velocity.value) * (radius if self.is_torque else 1.0)
        return float(density * speed * radius / viscosity)


def driven_diffusion(trajectory: Trajectory, *, skip: float = 0.1, blocks: int = 20) -> Driven:
    """Diffusion coefficient of spheres from their drift under ``flow=dpd.drive(force=...)``.

    Of one sphere; several, pushed together, drift with their collective mobility.

    ``D = kT v / F`` where the whole has no momentum. With the reaction on all beads (Einstein 1905;
    the D of equilibrium and of the theory of periodic boxes), F is the force given; where the
    others alone bear it, a part ``x`` of the mass being that of the driven beads, the drive acts
    like a force ``F/(1 - x)`` with the reaction on all. Zhou & Schmid (2015) divide by F and take
    the velocity relative to the solvent, ``v/(1 - x)``: theirs is ``D/(1 - x)^2``.

    The drift is that from frame to frame, so it is the mean over all steps. Over a time t the drift
    of n spheres in all is uncertain by ``sqrt(2 D/(n t))`` at least: to halve an error run four
    times as long, or push twice as hard while the Reynolds number stays small.

    Args:
        trajectory: a run recorded with ``observe=dpd.observe.positions_of(species)``, or
            ``dpd.observe.positions``; one or replicas.
        skip: share of the frames left out at the start.
        blocks: pieces for the error bar, each longer than the velocity lives.

    Warns of an error bar well below that bound: the run is too short for its blocks to be
    independent.

    Raises ValueError for a run without such a force, or a batch with several.

    Example:
        >>> push, plan = dpd.drive(force=20.0, torque=20.0), dpd.Plan(40, 10)
        >>> record = [dpd.observe.positions_of(1), dpd.observe.rotations]
        >>> fluid, start = marble.fluid, turning.final
        >>> ran = dpd.run(fluid, start, key, marble.dt, plan, push, observe=record, **quiet)
        >>> found = dpd.measure.driven_diffusion(ran)
        >>> abs(found.velocity.value / 20.0 - found.diffusion.value) < 1e-6  # kT is 1
        True
    """
    drive, force, along = _driven(trajectory, "applied_force", "force")
    beads = chosen_beads(trajectory, drive.species)
    record = f"dpd.observe.positions_of({drive.species})"
    position = of_beads(displaced(trajectory, record), trajectory, beads)
    first = int(skip * (position.shape[1] - 1))
    steps = np.diff(position[:, first:], axis=1) @ along / shared(trajectory.interval)
    needs.warn_of_drift({"velocity": steps.mean(axis=2)})
    velocity = block_average(steps.mean(axis=2), blocks)
    if drive.reaction == "others":
        force = force / (1.0 - driven_share(trajectory))
    return _result(trajectory, velocity, force, steps.size, is_torque=False)


def driven_rotation(trajectory: Trajectory, *, skip: float = 0.1, blocks: int = 20) -> Driven:
    """Rotational diffusion coefficient of spheres from their angular velocity under
    ``flow=dpd.drive(torque=...)``.

    ``D_r = kT omega / T``. Record with ``observe=dpd.observe.rotations``, or its mean over all
    steps. Arguments, errors and the warning as in :func:`driven_diffusion`; ValueError also where
    no friction turns the spheres, as with ``coupling="central"``.

    Example:
        >>> push, plan = dpd.drive(force=20.0, torque=20.0), dpd.Plan(40, 10)
        >>> record = [dpd.observe.positions_of(1), dpd.observe.rotations]
        >>> fluid, start = marble.fluid, turning.final
        >>> ran = dpd.run(fluid, start, key, marble.dt, plan, push, observe=record, **quiet)
        >>> dpd.measure.driven_rotation(ran).is_torque
        True
    """
    drive, torque, along = _driven(trajectory, "applied_torque", "torque")
    omega = (
        recorded(
            trajectory, "angular_velocity", observe="dpd.observe.rotations", averaged=True
        ).astype(float)
        @ along
    )
    check_turned(trajectory.fluid, (drive.species,))
    rotating = species_of(trajectory)[trajectory.final.rotation.slots] == drive.species
    omega = omega[:, int(skip * omega.shape[1]) :, rotating]
    needs.warn_of_drift({"angular velocity": omega.mean(axis=2)})
    return _result(
        trajectory, block_average(omega.mean(axis=2), blocks), torque, omega.size, is_torque=True
    )


def driven_share(trajectory) -> float:
    """The part of the whole mass that is driven."""
    mass, species = bead_masses(trajectory)[0], species_of(trajectory)
    return float(mass[species == trajectory.flow.driver(Drive).species].sum() / mass.sum())


def _driven(trajectory, name: str, what: str):
    """The drive, the size of its force or torque, and its direction (3,)."""
    needs.finished(trajectory)
    drive = trajectory.flow.driver(Drive)
    if drive is None or not np.any(np.asarray(getattr(drive, name))):
        raise ValueError(f"this run had no driving {what}; run it with flow=dpd.drive({what}=...)")
    needs.unsheared(trajectory, "the drift without the flow", "drive spheres in a run without it")
    needs.warn_of_others(trajectory, (Drive,))
    refuse_scan(trajectory)
    vector = np.asarray(getattr(drive, name), float).reshape(-1, 3)[0]
    size = float(np.linalg.norm(vector))
    return drive, size, vector / size


def _result(
    trajectory, velocity: Estimate, strength: float, readings: int, is_torque: bool
) -> Driven:
    """``readings``: of the velocity, one for each sphere and frame."""
    kT = float(np.ravel(trajectory.fluid.kT)[0])
    diffusion = velocity.scaled(kT / strength)
    _check_error(diffusion, kT / strength, readings * shared(trajectory.interval))
    friction = (
        Estimate(strength, 0.0, velocity.blocks).over(velocity)
        if velocity.value
        else Estimate(math.inf, math.inf)
    )
    return Driven(diffusion, velocity, friction, is_torque)


def _check_error(diffusion: Estimate, mobility_unit: float, time: float):
    """Warn of an error bar that fluctuation and dissipation rule out: displacement over a time t
    scatters by ``sqrt(2 D t)``."""
    least = mobility_unit * math.sqrt(2 * abs(diffusion.value) / time) if time else 0.0
    if diffusion.error < SUSPECT * least:
        warn(
            f"the error bar of {diffusion} cannot be below {least:.2g} in a run of {time:.3g} "
            "time units in all: its blocks are shorter than the velocity lives; run longer",
        )
