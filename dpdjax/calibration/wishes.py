"""What is wanted, checked, and the gauges that measure it."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from dpdjax.calibration import experiment, gauges
from dpdjax.calibration.goal import (
    ONE_NUMBER,
    Goal,
    custom_goal,
    damped,
    pressure_goal,
    rough_viscosity,
    viscosity_goal,
    viscosity_goal_at,
)
from dpdjax.checks import number, positive
from dpdjax.engine.flow import Driving
from dpdjax.engine.integrator import Integrator
from dpdjax.engine.state import State
from dpdjax.model.fluid import Fluid

ABOVE_ZERO = ("viscosity", "diffusion", "schmidt", "compressibility")
FALLING = ("diffusion", "compressibility")
"""What falls where friction or repulsion rises."""
SLOW_ENOUGH = 0.3
"""Shear rate times the longest memory of chains, up to which they are not stretched much."""
OF_STATES = ("viscosity", "pressure", "target")
"""What is measured in boxes that begin as a given state."""
SIDES, LOOSE = (6.0, 10.0), 0.05
"""Least and largest side of a box in interaction ranges, and the tolerance from which on the
shortest runs in the largest one are better than was asked for."""


@dataclasses.dataclass(frozen=True)
class Setup:
    """How boxes are made and moved; arguments as for :func:`dpdjax.calibrate`."""

    density: float
    tolerance: float
    box: float | None = None
    boxes: int = 2
    dt: float | None = None
    integrator: Integrator | None = None
    rate: float | None = None
    observe: Callable | None = None
    flow: Driving = None
    say: Callable[[str], None] = lambda text: None
    state: State | None = None
    memory: float | None = None

    def ensemble(self, fluid: Fluid, goal: Goal, key, density: float | None = None):
        """Boxes in equilibrium, at another density where one is given."""
        how = {"boxes": self.boxes, "dt": self.dt, "integrator": self.integrator}
        if self.state is not None:
            given = {"state": self.state, "memory": self.memory, "report": self.say}
            return experiment.adopt(fluid, goal, key, **given, **how)
        return experiment.prepare(
            fluid,
            goal,
            key,
            density=self.density if density is None else density,
            side=suggest_box(fluid, self.tolerance) if self.box is None else self.box,
            report=self.say,
            **how,
        )

    def viscosity_goal(self, fluid: Fluid, target: float) -> Goal:
        damped(fluid, self.density)
        if self.rate is not None:
            return viscosity_goal(target, float(positive(self.rate, "rate")))
        suggested = viscosity_goal_at(fluid, self.density, target, self.tolerance)
        memory = 0.0 if self.state is None else experiment.memory_in(self.state, self.memory)(fluid)
        if not memory:
            return suggested
        return viscosity_goal(target, min(SLOW_ENOUGH / memory, float(suggested.flow.rate)))

    def mean(self, fluid: Fluid, key, goal_of: Callable) -> gauges.Mean:
        """A gauge of a mean; of a state, whose memory outlasts a tangent, with slopes by chords."""
        kind = gauges.Mean if self.state is None else gauges.SlowMean
        return kind(self.ensemble(fluid, goal_of(fluid), key), goal_of)


def suggest_box(fluid: Fluid, tolerance: float) -> float:
    """Side of the boxes for a tolerance: half the beads for twice the tolerance."""
    least, largest = SIDES
    side = max(least, largest * min(1.0, LOOSE / tolerance) ** (1 / 3))
    return side * max(fluid.reaches())


def gauges_of(wanted: dict[str, float], fluid: Fluid, key, setup: Setup) -> list[gauges.Gauge]:
    """A gauge for each wanted number; several may rest on the same boxes."""
    keys = [key] if len(wanted) == 1 else [jax.random.fold_in(key, k) for k in range(len(wanted))]
    of = _Gauges(fluid, setup, jax.random.fold_in(key, len(wanted)), wanted.get("viscosity"))
    return [of.of(name, target, own) for (name, target), own in zip(wanted.items(), keys)]


@dataclasses.dataclass
class _Gauges:
    """Gauges of one fluid.

    Attributes:
        fluid, setup: what is measured, and how.
        key: of boxes that several gauges rest on.
        viscosity: that is wanted, None where none is.
    """

    fluid: Fluid
    setup: Setup
    key: jax.Array
    viscosity: float | None = None

    def of(self, name: str, target: float, key) -> gauges.Gauge:
        made = {
            "viscosity": lambda: self.sheared,
            "diffusion": lambda: self._diffusion(target, key),
            "schmidt": lambda: gauges.Schmidt(target, self.sheared, self._diffusion(target, key)),
            "compressibility": lambda: self._compressibility(target, key),
        }
        if name == "viscosity":
            self.key = key
        return made.get(name, lambda: self._mean(name, target, key))()

    @functools.cached_property
    def sheared(self) -> gauges.Mean:
        """The viscosity, wanted or needed."""
        target = self.viscosity or rough_viscosity(self.fluid, self.setup.density)
        goal_of = lambda fluid: self.setup.viscosity_goal(fluid, target)
        return self.setup.mean(self.fluid, self.key, goal_of)

    def _mean(self, name: str, target: float, key) -> gauges.Mean:
        observe, flow = self.setup.observe, self.setup.flow
        pressure = name == "pressure"
        goal = pressure_goal(target) if pressure else custom_goal(target, observe, flow)
        return self.setup.mean(self.fluid, key, lambda fluid: goal)

    def _diffusion(self, target: float, key) -> gauges.Diffusion:
        goal = custom_goal(target, _nothing, name="diffusion")
        # Where the atlas knows the viscosity no boxes need be sheared.
        viscosity = lambda: self.sheared
        return gauges.Diffusion(self.setup.ensemble(self.fluid, goal, key), target, viscosity)

    def _compressibility(self, target: float, key) -> gauges.Compressibility:
        goal = pressure_goal(1.0)
        ends = [
            gauges.Mean(self.setup.ensemble(self.fluid, goal, own, density), lambda fluid: goal)
            for own, density in zip(
                jax.random.split(key),
                (self.setup.density * (1 - gauges.PART), self.setup.density * (1 + gauges.PART)),
            )
        ]
        return gauges.Compressibility(target, *ends)


def _nothing(fluid, state):
    return state.box.volume


def wanted_of(asked: dict[str, float | None], observe: Any, count: int) -> dict[str, float]:
    """What is wanted, as many numbers as parameters; ValueError, TypeError for what cannot be."""
    given = {name: value for name, value in asked.items() if value is not None}
    names = ", ".join(f"{name}=" for name in asked if name != "target")
    if count == 1 and len(given) != 1:
        told = " and ".join(given) or "none"
        raise ValueError(f"give one of {names} or target= with observe=; got {told}")
    if len(given) != count:
        raise ValueError(
            f"{count} parameters for {len(given)} wanted numbers {tuple(given)}; give as many of "
            f"{names} or target="
        )
    for name, value in given.items():
        _check(name, value, observe)
    return {name: float(value) for name, value in given.items()}


def scalar(fluid: Fluid, name: str):
    """The present value of a parameter; ValueError for one that is a table."""
    value = fluid.value(name)
    if np.ndim(value) != 0:
        raise ValueError(
            f"{name} is a table of shape {np.shape(value)}; only a scalar can be calibrated"
        )
    return value


def _check(name: str, value, observe):
    if name in ABOVE_ZERO:
        positive(value, name)
    if number(value, name) == 0:
        raise ValueError(
            f"{name} is 0, and no error bar is small relative to it; shift the number that is "
            "observed"
        )
    if name == "target" and observe is None:
        raise ValueError(
            "target= needs observe=, a function observe(fluid, state) of which it is the mean"
        )
    if name == "target" and not callable(observe):
        raise TypeError(f"observe is a {type(observe).__name__}; {ONE_NUMBER}")


def refuse_of_state(asked: dict[str, float | None], state, memory, density, box):
    """Raise for what does not go with a state to begin from, or needs one."""
    if state is None:
        if memory is not None:
            raise ValueError("memory= is of the molecules of a state: give state=, or leave it out")
        return
    if not isinstance(state, State) or np.ndim(state.position) != 2:
        raise TypeError("state is no single state; give one of dpd.molecules(...), made.state")
    for name, value in (("density", density), ("box", box)):
        if value is not None:
            raise ValueError(f"{name}= is that of the state: leave it out")
    others = [k for k, v in asked.items() if v is not None and k not in OF_STATES]
    if others:
        raise ValueError(
            f"{others[0]}= is measured of one kind of bead, and a state is given: ask for "
            f"{', '.join(OF_STATES)}"
        )


def refuse_unused(asked: dict[str, float | None], observe, flow, rate):
    """Raise where an argument would be ignored without a word."""
    sheared = [asked[name] for name in ("viscosity", "schmidt")]
    for name, value, goes_with, used in (
        ("observe", observe, "target", asked["target"] is not None),
        ("flow", flow, "target", asked["target"] is not None),
        ("rate", rate, "viscosity", any(value is not None for value in sheared)),
    ):
        if value is not None and not used:
            raise ValueError(
                f"{name}= is used with {goes_with}= only; give {goes_with}= or leave {name}= out"
            )
