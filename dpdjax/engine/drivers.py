"""Drivers: forces and torques on beads from outside. Their numbers are leaves."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dpdjax.checks import choice, is_concrete, number, positive, whole
from dpdjax.engine.answers import Part, check_answers
from dpdjax.engine.batching import chosen
from dpdjax.engine.state import State
from dpdjax.model.fluid import Fluid


class Driver(Part):
    """What every driver answers; by default it drives nothing.

    One of your own is a frozen dataclass, registered with ``jax.tree_util.register_dataclass``, its
    numbers leaves. ``ranks = {"name": 0}`` names the numbers that may differ from member to member
    of a batch, each with its axes in one member.

    Example:
        >>> import dataclasses
        >>> @jax.tree_util.register_dataclass
        ... @dataclasses.dataclass(frozen=True)
        ... class Trap(dpd.flows.Driver):  # a spring to the middle of the box
        ...     stiffness: float
        ...     def force(self, state, mass):
        ...         return self.stiffness * (0.5 * state.box.lengths - state.position)
        >>> held = dpd.forces(water, state, key, 0.01, Trap(0.1), kinds=("driven",))
        >>> bool(jnp.allclose(held.force, 0.1 * (2.0 - state.position), atol=1e-5))
        True
    """

    def check(self, fluid: Fluid, state: State) -> None:
        """Raise TypeError or ValueError, before a run of one state, for one that cannot work there.

        A driver with demands of its own adds them, and calls this one by ``super()``.
        """
        rotating = 0 if state.rotation is None else state.rotation.m
        mass = jnp.ones((state.n, 1), state.position.dtype)
        answers = {
            "force": (lambda one: one.force(state, mass), (state.n, 3)),
            "torque": (lambda one: one.torque(state), (rotating, 3)),
        }
        check_answers(self, state, answers)

    def force(self, state: State, mass: jax.Array) -> jax.Array | None:
        """Force on each bead (n, 3), or None; ``mass`` is (n, 1).

        A net force is not taken off, as those of ``dpd.flows.body_force`` and ``dpd.drive`` are: it
        sets the whole in motion.
        """
        return None

    def torque(self, state: State) -> jax.Array | None:
        """Torque on each bead that rotates (m, 3), or None."""
        return None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BodyForce(Driver):
    """A force on every bead, ``field(position, time, **numbers)``; see
    :func:`dpdjax.flows.body_force`.
    """

    field: Callable = dataclasses.field(metadata={"static": True})
    numbers: dict[str, Any]
    balance: bool = dataclasses.field(default=True, metadata={"static": True})
    jumps: bool = dataclasses.field(default=False, metadata={"static": True})

    def check(self, fluid, state):
        super().check(fluid, state)
        if not self.jumps:
            check_faces(self, state)

    def force(self, state, mass):
        """Force on each bead (n, 3), less its mean acceleration where balanced."""
        f = self.field(state.position, state.time, **self.numbers)
        f = jnp.broadcast_to(f, state.position.shape).astype(state.position.dtype)
        if self.balance:
            f = f - mass * (jnp.sum(f, axis=0, keepdims=True) / jnp.sum(mass))
        return f


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Wave(BodyForce):
    """A sinusoidal body force along x; see :func:`dpdjax.flows.sinusoidal_force`."""

    ranks = {"numbers": 0}

    def check(self, fluid, state):
        side = state.box.lengths[1]
        if is_concrete(self, side):
            waves = np.asarray(self.numbers["wavenumber"]) * float(side) / (2 * np.pi)
            if np.any(np.abs(waves - np.round(waves)) > 1e-3):
                raise ValueError(
                    "the body force is not periodic along y: "
                    f"{np.array2string(waves, precision=4)} waves in a side of {float(side):.4g}; "
                    f"use dpd.flows.sinusoidal_force(amplitude, side={float(side):.6g}, waves=...)"
                )
        super().check(fluid, state)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Drive(Driver):
    """A force and a torque on every bead of one species, the rest held back; see
    :func:`dpdjax.flows.drive`.
    """

    ranks = {"applied_force": 1, "applied_torque": 1}

    applied_force: Any
    applied_torque: Any
    species: int = dataclasses.field(metadata={"static": True})
    reaction: str = dataclasses.field(metadata={"static": True})

    def check(self, fluid, state):
        """Refuse a drive of beads that are not there, or a torque on what does not rotate."""
        if is_concrete(self, state.species):
            check_driven(self, state)
        super().check(fluid, state)

    def force(self, state, mass):
        """Force on each bead (n, 3), without a net one."""
        driven = (state.species == self.species)[:, None].astype(state.position.dtype)
        bearing = mass if self.reaction == "all" else mass * (1.0 - driven)
        applied_force = self.applied_force[None, :]
        return driven * applied_force - bearing * (
            jnp.sum(driven) * applied_force / jnp.sum(bearing)
        )

    def torque(self, state):
        """Torque on each bead that rotates (m, 3), or None where none does."""
        if state.rotation is None:
            return None
        rotating = state.species[state.rotation.slots] == self.species
        return jnp.where(rotating[:, None], self.applied_torque[None, :], 0.0)


def body_force(
    field: Callable, *, balance: bool = True, jumps: bool = False, **numbers
) -> BodyForce:
    """A one-body force field, any small pure function.

    Args:
        field: ``field(position, time, **numbers) -> force``, with positions (n, 3)
            [length] and a result that broadcasts to (n, 3) [force].
        balance: take the net force away each step, as one acceleration common to all
            beads. Without it a periodic box accelerates for ever.
        jumps: the field is meant to jump at the faces of the box, as that of reverse Poiseuille
            flow does (one way in one half, the other way in the other). Elsewhere a jump is a
            mistake and refused before a run, with ValueError.
        **numbers: the field's numbers (leaves).

    Example:
        >>> def towards_z(position, time, *, g):
        ...     return jnp.array([0.0, 0.0, g])
        >>> falling = dpd.flows.body_force(towards_z, g=-0.1, balance=False)
        >>> mass = dpd.integrators.masses(water, state)[:, None]
        >>> [round(float(f), 2) for f in falling.force(state, mass).sum(axis=0)]  # of 192 beads
        [0.0, 0.0, -19.2]
    """
    return BodyForce(field, {k: number(v, k) for k, v in numbers.items()}, balance, jumps=jumps)


def drive(
    force: ArrayLike = 0.0, torque: ArrayLike = 0.0, *, species: int = 1, reaction: str = "all"
) -> Drive:
    """The same force and torque on each bead of one species, as large spheres are driven to measure
    their drag.

    Momentum stays as it is: every bead, or every other one, feels a force in proportion to its mass
    that makes up for the sum. Nothing makes up for the torque. Measure with
    :func:`dpdjax.measure.driven_diffusion` and :func:`dpdjax.measure.driven_rotation`.

    Args:
        force: on each driven bead, along x or a vector (3,) [force].
        torque: on each driven bead that rotates, about x or a vector (3,) [energy].
        species: the driven one.
        reaction: ``"all"`` takes the sum from all beads, the driven ones included, as one
            acceleration; ``"others"`` from the others alone.

    For a batch, give ``force`` or ``torque`` as (members, 3), such as ``strengths[:, None] *
    jnp.array([1.0, 0.0, 0.0])``.

    Raises ValueError for an unknown reaction, or nothing to drive.

    Example:
        >>> pulled = dpd.drive(force=2.0, species=1)
        >>> mass = dpd.integrators.masses(marble.fluid, marble.state)[:, None]
        >>> f = pulled.force(marble.state, mass)
        >>> f.shape, round(float(f[-1, 0]), 2)  # of the marble, less what its own mass bears
        ((636, 3), 1.96)
        >>> bool(abs(f.sum()) < 1e-3)
        True
    """
    choice(reaction, ("all", "others"), "reaction")
    species = whole(species, "species", least=0)
    applied_force, applied_torque = (
        _along_x(number(x, name), name) for x, name in ((force, "force"), (torque, "torque"))
    )
    if (
        is_concrete(applied_force, applied_torque)
        and not jnp.any(applied_force)
        and not jnp.any(applied_torque)
    ):
        raise ValueError("nothing is driven: give force=... or torque=...")
    return Drive(applied_force, applied_torque, species, reaction)


def _along_x(value, name: str):
    vector = value * jnp.array([1.0, 0.0, 0.0], value.dtype) if value.ndim == 0 else value
    if vector.ndim > 2 or vector.shape[-1] != 3:
        raise ValueError(
            f"{name} has shape {value.shape}; give a number along x, a vector (3,), or (members, "
            "3) for a batch"
        )
    return vector


def sine_field(position, time, *, amplitude, wavenumber):
    """``amplitude sin(wavenumber y)`` along x, for :func:`sinusoidal_force`."""
    fx = amplitude * jnp.sin(wavenumber * position[:, 1])
    return jnp.stack([fx, jnp.zeros_like(fx), jnp.zeros_like(fx)], axis=1)


def sinusoidal_force(amplitude: ArrayLike, side: ArrayLike, waves: int = 1) -> BodyForce:
    """``amplitude sin(k y)`` along x on each bead [force], with ``waves`` periods in ``side``
    [length].

    Drives ``U sin(k y)`` with ``U = density amplitude / (viscosity k**2)``. For a batch, give a
    number for each member. A run raises ValueError where the periods do not fit its box along y.
    Measure with :func:`dpdjax.measure.sinusoidal_viscosity`.

    Example:
        >>> wave = dpd.flows.sinusoidal_force(amplitude=0.1, side=4.0)
        >>> mass = dpd.integrators.masses(water, state)[:, None]
        >>> f = wave.force(state, mass)
        >>> expected = 0.1 * jnp.sin(2 * jnp.pi * state.position[:, 1] / 4.0)
        >>> bool(jnp.allclose(f[:, 0], expected - expected.mean(), atol=1e-5))
        True
    """
    wavenumber = 2 * jnp.pi * number(waves, "waves") / positive(side, "side")
    return Wave(sine_field, {"amplitude": number(amplitude, "amplitude"), "wavenumber": wavenumber})


def constant_field(position: jax.Array, time: ArrayLike, *, acceleration: ArrayLike) -> jax.Array:
    """The same force on every bead (n, 3), for :func:`dpdjax.flows.body_force`.

    ``acceleration`` is that force, a vector (3,) [force]: the acceleration of beads of mass 1.

    Example:
        >>> field, along_x = dpd.flows.constant_field, jnp.array([0.1, 0.0, 0.0])
        >>> field(state.position, 0.0, acceleration=along_x).shape
        (192, 3)
        >>> flow = dpd.flows.body_force(field, acceleration=along_x, balance=False)
    """
    return jnp.broadcast_to(acceleration, position.shape)


def check_driven(flow, state) -> None:
    """Raise ValueError for a drive of beads that are not there, or a torque on what does not
    rotate."""
    there = np.asarray(state.species)
    if flow.species not in there:
        raise ValueError(
            f"no bead is of the driven species {flow.species}; name another: dpd.drive(..., "
            "species=...)"
        )
    if flow.reaction == "others" and np.all(there == flow.species):
        raise ValueError(
            'all beads are driven, and reaction="others" has none to act on; use reaction="all"'
        )
    rotating = () if state.rotation is None else there[state.rotation.slots]
    if np.any(np.asarray(flow.applied_torque)) and flow.species not in rotating:
        raise ValueError(
            f"beads of species {flow.species} do not rotate, and a torque is given: give them an "
            "inertia"
        )


def check_faces(flow, state) -> None:
    """Refuse a body force whose limits at two opposite faces, both from within the box, differ."""
    if not is_concrete(flow, state.position, state.box, state.time):
        return
    flow = chosen(flow, flow.batch_axes(), 0)
    sides, strain = np.asarray(state.box.lengths, float), float(state.box.strain)
    here = np.random.default_rng(0).uniform(size=(64, 3)) * sides
    # A field may be zero at this moment, or overflow at later ones.
    for time in float(state.time) + np.array([0.0, 0.3, 1.7]):
        of = lambda position: np.asarray(
            jnp.broadcast_to(
                flow.field(
                    jnp.asarray(position, state.position.dtype),
                    jnp.asarray(time, state.time.dtype),
                    **flow.numbers,
                ),
                position.shape,
            )
        )
        scale = np.max(np.abs(of(here)))
        for axis in range(3) if np.isfinite(scale) else ():
            low, high = _facing(here, axis, sides, strain)
            if not np.allclose(of(low), of(high), rtol=0, atol=2e-3 * scale):
                raise ValueError(
                    f"the body force is not periodic along {'xyz'[axis]}: it jumps at the face of "
                    f"a box of sides {sides.tolist()}; give it a whole number of periods in that "
                    "side, or dpd.flows.body_force(..., jumps=True) where it is meant to jump"
                )


def _facing(here, axis: int, sides, strain: float):
    """Points just inside a face, and their images just inside the opposite one."""
    low, high, edge = here.copy(), here.copy(), 1e-6 * sides[axis]
    low[:, axis], high[:, axis] = edge, sides[axis] - edge
    if axis == 1:
        high[:, 0] = np.mod(high[:, 0] + strain * sides[1], sides[0])
    return low, high
