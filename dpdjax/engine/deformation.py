"""Deformations of the box: none, steady shear, oscillating shear. Their numbers are leaves."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from dpdjax.checks import number, positive
from dpdjax.engine.answers import Part, check_answers
from dpdjax.engine.state import State
from dpdjax.model.fluid import Fluid


class Deformation(Part):
    """What every deformation answers; by default a steady shear of its ``rate``.

    One of your own is a frozen dataclass, registered with ``jax.tree_util.register_dataclass``, its
    numbers leaves. ``rate_at`` and ``strain_in`` have to agree. ``ranks = {"name": 0}`` names the
    numbers that may differ from member to member of a batch, each with its axes in one member.

    Attributes:
        rate: the shear rate; the largest where it changes [1 / time]. One that never deforms the
            box has the plain number 0.0, as a static field or an attribute of its class.
        frequency: angular frequency of an oscillation [1 / time], None of what does not
            oscillate.

    Example:
        >>> import dataclasses
        >>> @jax.tree_util.register_dataclass
        ... @dataclasses.dataclass(frozen=True)
        ... class Pulse(dpd.flows.Deformation):  # sheared until a moment, and no more
        ...     rate: float
        ...     until: float
        ...     def rate_at(self, time):
        ...         return jnp.where(time < self.until, self.rate, 0.0)
        ...     def strain_in(self, time, dt):
        ...         return dt * self.rate_at(time)
        >>> pulse = Pulse(rate=0.2, until=1.0)
        >>> [round(float(pulse.strain_in(time, 0.01)), 4) for time in (0.5, 1.5)]
        [0.002, 0.0]
        >>> pulse.deforms, pulse.is_steady
        (True, False)
    """

    rate: Any
    frequency: Any = None

    @property
    def is_steady(self) -> bool:
        """Whether the shear rate never changes."""
        kind = type(self)
        unchanged = kind.rate_at is Deformation.rate_at
        return unchanged and kind.strain_in is Deformation.strain_in

    @property
    def deforms(self) -> bool:
        """Whether it can tilt the box, by its kind and whatever its numbers; False only for a plain
        rate of 0.
        """
        return not (self.is_steady and isinstance(self.rate, (int, float)) and self.rate == 0)

    def check(self, fluid: Fluid, state: State) -> None:
        """Raise TypeError or ValueError, before a run of one state, for one that cannot work there.

        A deformation with demands of its own adds them, and calls this one by ``super()``.
        """
        if not hasattr(self, "rate"):
            kind = type(self).__name__
            raise TypeError(f"{kind} has no rate; give it one, rate = 0.0 where it does not shear")
        step = jnp.ones((), state.position.dtype)
        answers = {
            "rate": (lambda one: one.rate_at(state.time), ()),
            "strain": (lambda one: one.strain_in(state.time, step), ()),
        }
        check_answers(self, state, answers)
        if self.deforms:
            check_tilt(state)

    def rate_at(self, time: ArrayLike) -> jax.Array:
        """Shear rate at a time [1/time]."""
        return self.rate

    def strain_in(self, time: ArrayLike, dt: ArrayLike) -> jax.Array:
        """Shear strain of the step that begins at ``time``."""
        return self.rate * dt


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Still(Deformation):
    """None: the box stays as it is."""

    rate: float = dataclasses.field(default=0.0, metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Shear(Deformation):
    """Steady homogeneous shear ``u_x = rate y`` by Lees-Edwards boundaries."""

    ranks = {"rate": 0}

    rate: Any


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Oscillation(Deformation):
    """Homogeneous shear of strain ``amplitude sin(frequency time)``; see
    :func:`dpdjax.flows.oscillatory_shear`.
    """

    ranks = {"amplitude": 0, "frequency": 0}

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


def shear(rate: ArrayLike) -> Shear:
    """Steady shear ``u_x = rate y`` [1 / time] under Lees-Edwards boundaries, a ``flow=`` of a run.

    Velocities in the state are peculiar: relative to the streaming velocity. For a batch, give a
    rate for each member. Raises TypeError for what is no number.

    Example:
        >>> flow = dpd.shear(0.2)
        >>> round(float(flow.strain_in(time=0.0, dt=0.01)), 4), flow.is_steady
        (0.002, True)
        >>> round(float(sheared.final.box.strain), 3)  # 200 steps of 0.01
        0.4
    """
    return Shear(number(rate, "rate"))


def oscillatory_shear(amplitude: ArrayLike, frequency: ArrayLike) -> Oscillation:
    """Shear of strain ``amplitude sin(frequency t)``, t the time of the state, under Lees-Edwards
    boundaries.

    The strain is imposed on the whole box at once (the SLLOD equations), so there is no wave to
    wait for. ``frequency`` is the angular one [1 / time]; raises ValueError where it is not above
    zero. Measure with :func:`dpdjax.measure.moduli`.

    Example:
        >>> swing = dpd.oscillatory_shear(amplitude=0.05, frequency=2 * np.pi)
        >>> [round(float(swing.rate_at(time)), 3) for time in (0.0, 0.5, 1.0)]
        [0.314, -0.314, 0.314]
        >>> swing.deforms, swing.is_steady
        (True, False)
    """
    return Oscillation(number(amplitude, "amplitude"), positive(frequency, "frequency"))


def check_tilt(state) -> None:
    """Raise ValueError for lists that miss pairs of a tilted box."""
    if not all(n.grid.sheared for n in state.neighbours):
        raise ValueError(
            "this state was made with sheared=False and its lists miss pairs of a tilted box: make "
            "it without"
        )
