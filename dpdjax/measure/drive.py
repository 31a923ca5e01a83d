"""Driven spheres: diffusion from the velocity under a force, or the angular velocity under a torque."""

import dataclasses
import math

import numpy as np

from dpdjax.engine.flow import Drive
from dpdjax.measure.statistics import Estimate, block_average
from dpdjax.measure.structure import chosen_beads, of_beads, recorded, species_of
from dpdjax.measure.transport import bead_masses, frame_interval


@dataclasses.dataclass(frozen=True)
class Driven:
    """What spheres do under a force or a torque.

    Attributes:
        diffusion: ``D = kT v / F`` [length^2/time], or ``D_r = kT omega / T`` [1/time].
        velocity: along the force, where the whole has no momentum [length/time]; or the angular velocity about the torque.
        friction: ``kT / D``, force over velocity or torque over angular velocity.
        turns: whether it is a torque.
    """

    diffusion: Estimate
    velocity: Estimate
    friction: Estimate
    turns: bool = False

    def reynolds(self, *, density, viscosity, radius) -> float:
        """``density v radius / viscosity``, for an angular velocity with ``v = omega radius``: to stay below 0.1 or so."""
        speed = abs(self.velocity.value) * (radius if self.turns else 1.0)
        return float(density * speed * radius / viscosity)


def driven_diffusion(trajectory, *, skip: float = 0.1, blocks: int = 20) -> Driven:
    """Diffusion coefficient of spheres from their drift under ``flow=dpd.drive(force=...)``.

    Of one sphere; several, pushed together, drift with their collective mobility.

    ``D = kT v / F`` where the whole has no momentum. With the reaction on all beads (Einstein 1905; the D of equilibrium
    and of the theory of periodic boxes), F is the force given; where the others alone bear it, a part ``x`` of the mass being
    that of the driven beads, the drive acts like a force ``F/(1 - x)`` with the reaction on all. Zhou & Schmid (2015) divide
    by F and take the velocity relative to the solvent, ``v/(1 - x)``: theirs is ``D/(1 - x)^2``.

    The drift is that from frame to frame, so it is the mean over all steps.

    Args:
        trajectory: a run recorded with ``observe=dpd.positions_of(species)``, or ``dpd.positions``; one or replicas.
        skip: share of the frames left out at the start.
        blocks: pieces for the error bar, each longer than the velocity lives.

    Raises ValueError for a run without such a force, or a batch with several.
    """
    flow, force, along = _driven(trajectory, "push", "force")
    beads = chosen_beads(trajectory, flow.species)
    position = of_beads(recorded(trajectory, "unwrapped"), trajectory, beads).astype(float)
    first = int(skip * (position.shape[1] - 1))
    steps = np.diff(position[:, first:], axis=1) @ along / frame_interval(trajectory)
    velocity = block_average(steps.mean(axis=2), blocks)
    if flow.reaction == "others":
        force = force / (1.0 - driven_share(trajectory))
    return _result(trajectory, velocity, force, turns=False)


def driven_rotation(trajectory, *, skip: float = 0.1, blocks: int = 20) -> Driven:
    """Rotational diffusion coefficient of spheres from their angular velocity under ``flow=dpd.drive(torque=...)``.

    ``D_r = kT omega / T``. Record with ``observe=dpd.rotations``, or its mean over all steps. Arguments and errors as
    in :func:`driven_diffusion`.
    """
    flow, torque, along = _driven(trajectory, "twist", "torque")
    omega = recorded(trajectory, "angular_velocity", observe="dpd.rotations").astype(float) @ along
    turning = species_of(trajectory)[trajectory.final.rotation.slots] == flow.species
    velocity = block_average(omega[:, int(skip * omega.shape[1]) :, turning].mean(axis=2), blocks)
    return _result(trajectory, velocity, torque, turns=True)


def driven_share(trajectory) -> float:
    """The part of the whole mass that is driven."""
    mass, species = bead_masses(trajectory)[0], species_of(trajectory)
    return float(mass[species == trajectory.flow.species].sum() / mass.sum())


def _driven(trajectory, name: str, what: str):
    """The flow, the size of its force or torque, and its direction (3,)."""
    flow = trajectory.flow
    if not isinstance(flow, Drive) or not np.any(np.asarray(getattr(flow, name))):
        raise ValueError(f"this run had no driving {what}; run it with flow=dpd.drive({what}=...)")
    vectors = np.asarray(getattr(flow, name), float).reshape(-1, 3)
    if np.ptp(vectors, axis=0).any() or trajectory.fluid.is_batch:
        raise ValueError("the members of this batch differ; measure them one by one: trajectory.members()")
    size = float(np.linalg.norm(vectors[0]))
    return flow, size, vectors[0] / size


def _result(trajectory, velocity: Estimate, strength: float, turns: bool) -> Driven:
    kT = float(np.ravel(trajectory.fluid.kT)[0])
    diffusion = velocity.scaled(kT / strength)
    friction = Estimate(strength, 0.0, velocity.blocks).over(velocity) if velocity.value else Estimate(math.inf, math.inf)
    return Driven(diffusion, velocity, friction, turns)
