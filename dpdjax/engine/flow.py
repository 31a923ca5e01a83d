"""Flows: what drives the fluid from outside. Their numbers are leaves."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from dpdjax.checks import number, positive


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
