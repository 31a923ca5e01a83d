"""Flows: what drives the fluid from outside. Their numbers are leaves."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from dpdjax.checks import is_concrete, number, positive


class Flow:
    """What every flow answers; by default there is none.

    Attributes:
        rate: the shear rate; the largest where it changes [1/time].
    """

    rate: Any

    def rate_at(self, time):
        """Shear rate at a time [1/time]."""
        return self.rate

    def strain_in(self, time, dt):
        """Shear strain of the step that begins at ``time``."""
        return self.rate * dt

    def force(self, state, mass):
        """Force on each bead (n, 3), or None."""
        return None

    def torque(self, state):
        """Torque on each bead that rotates (m, 3), or None."""
        return None

    def batch_axes(self):
        """The ``in_axes`` for ``jax.vmap``: numbers with an axis of their own are a batch."""
        return None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Quiet(Flow):
    """No flow."""

    rate: float = dataclasses.field(default=0.0, metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Shear(Flow):
    """Steady homogeneous shear ``u_x = rate y`` by Lees-Edwards boundaries."""

    rate: Any

    def batch_axes(self):
        return Shear(0) if jnp.ndim(self.rate) == 1 else None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Oscillation(Flow):
    """Homogeneous shear of strain ``amplitude sin(frequency time)``; see :func:`oscillatory_shear`."""

    amplitude: Any
    frequency: Any

    @property
    def rate(self):
        return self.amplitude * self.frequency

    def rate_at(self, time):
        return self.rate * jnp.cos(self.frequency * time)

    def strain_in(self, time, dt):
        # The difference of two sines as a product, which rounds less.
        half = 0.5 * self.frequency * dt
        return 2.0 * self.amplitude * jnp.sin(half) * jnp.cos(self.frequency * time + half)

    def batch_axes(self):
        axes = [0 if jnp.ndim(x) == 1 else None for x in (self.amplitude, self.frequency)]
        return None if axes == [None, None] else Oscillation(*axes)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BodyForce(Flow):
    """A force on every bead, ``field(position, time, **numbers)``; see :func:`body_force`."""

    field: Callable = dataclasses.field(metadata={"static": True})
    numbers: dict[str, Any]
    balance: bool = dataclasses.field(default=True, metadata={"static": True})
    rate: float = dataclasses.field(default=0.0, metadata={"static": True})

    def force(self, state, mass):
        """Force on each bead (n, 3), less its mean acceleration where balanced."""
        f = self.field(state.position, state.time, **self.numbers)
        f = jnp.broadcast_to(f, state.position.shape).astype(state.position.dtype)
        if self.balance:
            f = f - mass * (jnp.sum(f, axis=0, keepdims=True) / jnp.sum(mass))
        return f


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Drive(Flow):
    """A force and a torque on every bead of one species, the rest held back; see :func:`drive`."""

    push: Any
    twist: Any
    species: int = dataclasses.field(metadata={"static": True})
    reaction: str = dataclasses.field(metadata={"static": True})
    rate: float = dataclasses.field(default=0.0, metadata={"static": True})

    def force(self, state, mass):
        """Force on each bead (n, 3), without a net one."""
        driven = (state.species == self.species)[:, None].astype(state.position.dtype)
        bearing = mass if self.reaction == "all" else mass * (1.0 - driven)
        push = self.push[None, :]
        return driven * push - bearing * (jnp.sum(driven) * push / jnp.sum(bearing))

    def torque(self, state):
        """Torque on each bead that rotates (m, 3), or None where none does."""
        if state.rotation is None:
            return None
        turning = state.species[state.rotation.slots] == self.species
        return jnp.where(turning[:, None], self.twist[None, :], 0.0)

    def batch_axes(self):
        axes = [0 if jnp.ndim(x) == 2 else None for x in (self.push, self.twist)]
        return None if axes == [None, None] else dataclasses.replace(self, push=axes[0], twist=axes[1])


def quiet() -> Quiet:
    """No flow: a fluid in equilibrium."""
    return Quiet()


def shear(rate) -> Shear:
    """Steady shear ``u_x = rate y`` [1/time] under Lees-Edwards boundaries.

    Velocities in the state are peculiar: relative to the streaming velocity.
    """
    return Shear(number(rate, "rate"))


def oscillatory_shear(amplitude, frequency) -> Oscillation:
    """Shear of strain ``amplitude sin(frequency t)``, t the time of the state, under Lees-Edwards boundaries.

    The strain is imposed on the whole box at once (the SLLOD equations), so there is no wave to wait for.
    ``frequency`` is the angular one [1/time]. Measure with :func:`dpdjax.moduli`.
    """
    return Oscillation(number(amplitude, "amplitude"), positive(frequency, "frequency"))


def body_force(field: Callable, *, balance: bool = True, **numbers) -> BodyForce:
    """A one-body force field, any small pure function.

    Args:
        field: ``field(position, time, **numbers) -> force``, with positions (n, 3)
            [length] and a result that broadcasts to (n, 3) [force].
        balance: take the net force away each step, as one acceleration common to all
            beads. Without it a periodic box accelerates for ever.
        **numbers: the field's numbers (leaves).
    """
    return BodyForce(field, {k: number(v, k) for k, v in numbers.items()}, balance)


def drive(force=0.0, torque=0.0, *, species: int = 1, reaction: str = "all") -> Drive:
    """The same force and torque on each bead of one species, as large spheres are driven to measure their drag.

    Momentum stays as it is: every bead, or every other one, feels a force in proportion to its mass that makes up for the
    sum. Nothing makes up for the torque. Measure with :func:`dpdjax.driven_diffusion` and
    :func:`dpdjax.driven_rotation`.

    Args:
        force: on each driven bead, along x or a vector (3,) [force].
        torque: on each driven bead that rotates, about x or a vector (3,) [energy].
        species: the driven one.
        reaction: ``"all"`` takes the sum from all beads, the driven ones included, as one acceleration; ``"others"``
            from the others alone.

    For a batch, give ``force`` or ``torque`` as (members, 3), such as ``strengths[:, None] * jnp.array([1.0, 0.0, 0.0])``.

    Raises ValueError for an unknown reaction, or nothing to drive.
    """
    if reaction not in ("all", "others"):
        raise ValueError(f'reaction is {reaction!r}; it is "all" or "others"')
    push, twist = (_along_x(number(x, name), name) for x, name in ((force, "force"), (torque, "torque")))
    if is_concrete(push, twist) and not jnp.any(push) and not jnp.any(twist):
        raise ValueError("nothing is driven: give force=... or torque=...")
    return Drive(push, twist, species, reaction)


def _along_x(value, name: str):
    vector = value * jnp.array([1.0, 0.0, 0.0], value.dtype) if value.ndim == 0 else value
    if vector.ndim > 2 or vector.shape[-1] != 3:
        raise ValueError(f"{name} has shape {value.shape}; give a number along x, a vector (3,), or (members, 3) for a batch")
    return vector


def sine_field(position, time, *, amplitude, wavenumber):
    """``amplitude sin(wavenumber y)`` along x, for :func:`sinusoidal_force`."""
    fx = amplitude * jnp.sin(wavenumber * position[:, 1])
    return jnp.stack([fx, jnp.zeros_like(fx), jnp.zeros_like(fx)], axis=1)


def sinusoidal_force(amplitude, side, waves: int = 1) -> BodyForce:
    """``amplitude sin(k y)`` along x on each bead, with ``waves`` periods in ``side``.

    Drives ``U sin(k y)`` with ``U = density amplitude / (viscosity k**2)``.
    """
    return body_force(sine_field, amplitude=amplitude, wavenumber=2 * jnp.pi * waves / side)


def constant_field(position, time, *, acceleration):
    """The same force on every bead."""
    return jnp.broadcast_to(acceleration, position.shape)
