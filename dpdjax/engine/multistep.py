"""A long step for the solvent, short ones for what is stiff between a few beads."""

import dataclasses
import math
from typing import Any

import jax

from dpdjax.checks import Numbers
from dpdjax.engine.deformation import Shear
from dpdjax.engine.flow import Flow
from dpdjax.engine.forces import EVERYTHING, forces_on, update_lists
from dpdjax.engine.implicit import damped
from dpdjax.engine.integrator import (
    Integrator,
    carried_along,
    drifted,
    rotation_turned,
    settled,
    with_forces,
)
from dpdjax.engine.part import Part
from dpdjax.engine.state import State
from dpdjax.engine.system import System
from dpdjax.model import advice
from dpdjax.model.beads import inertias, masses
from dpdjax.model.fluid import Fluid
from dpdjax.pairs.laws import CONSERVATIVE
from dpdjax.pairs.sums import Forces

MOST = 64
"""Short steps in a long one."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class MultipleTimeStep(Integrator):
    """Velocity-Verlet for most interactions; those that are stiff, between a few beads, in short
    steps and by the midpoint rule.

    ==========================================================  ====================================
    in a step of dt                                             here
    ==========================================================  ====================================
    v += dt/2 f, of all that is not stiff                       ``half``
    r += dt v; beads between which something is stiff by        ``carried_along``,
    ``inner`` steps of velocity-Verlet in their potentials      ``_in_short_steps``
    f' of all that is not stiff, its drag of the velocity now   :func:`dpdjax.integrators.forces_on`
    v += dt/2 f'                                                ``_kicked``
    drag and noise between the beads of before, midpoint rule   :func:`dpdjax.integrators.damped`
    ==========================================================  ====================================

    The solvent, which costs most, has its forces once in a step that suits it. The few pairs of
    colloids, whose contacts and lubrication would ask for a step a tenth as long, are looked at as
    often as they need (Tuckerman, Berne & Martyna 1992). Pairs that lubrication holds have the
    temperature of the midpoint rule (:class:`dpdjax.integrators.ImplicitDrag`), right at any dt.

    Attributes:
        inner: short steps in a long one (static).
        stiff: the stiff interactions by their places in ``fluid.interactions`` (static); by default
            all between two groups of beads with radii.
        tolerance: of the midpoint rule's solution, relative.

    Example:
        >>> how = dpd.integrators.MultipleTimeStep(inner=8)
        >>> how.stiff_of(made.fluid), how.slow_of(made.fluid)  # colloids with each other, all else
        ((2,), (0, 1))
        >>> plain = dpd.suggest_dt(made.fluid, [2.4, 0.05])
        >>> dpd.suggest_dt(made.fluid, [2.4, 0.05], integrator=how) > 4 * plain
        True
    """

    ranks = {"tolerance": 0}
    cost = 2.4

    inner: int = dataclasses.field(default=8, metadata={"static": True})
    stiff: tuple[int, ...] | None = dataclasses.field(default=None, metadata={"static": True})
    tolerance: Any = 0.003

    @classmethod
    def suited_to(
        cls,
        fluid: Fluid,
        density: Numbers,
        sizes: tuple[float, float] = (1.0, 1.0),
        *,
        error: float = advice.ERROR,
        **numbers,
    ) -> "MultipleTimeStep":
        """With as many short steps as the potentials of what is stiff need in the longest step that
        suits the rest, 64 at most.

        ``fluid, density, sizes, error`` as for :func:`dpdjax.suggest_dt`; ``numbers`` are the
        other attributes.
        """
        step = lambda inner: advice.suggest_dt(
            fluid, density, sizes, integrator=cls(inner, **numbers), error=error
        )
        return cls(math.ceil(step(MOST) / step(1) * (1 - 1e-6)), **numbers)

    def step(self, system, state: State, key: jax.Array, tally: bool) -> State:
        """One long step."""
        fluid, dt, part = system.fluid, system.dt, Part.of(state, self.stiff_of(system.fluid))
        # Without the forces of the stiff: they come in as the beads move.
        half = _kicked(fluid, state, Forces(state.force, _torque(state), None), 0.5 * dt)
        own = self._in_short_steps(system, part, half)
        moved, carried = carried_along(system, half, half.velocity.T, dt * half.velocity.T)
        velocity = part.put(carried.T, own.velocity)
        moved = part.placed(dataclasses.replace(moved, velocity=velocity), own)
        moved = update_lists(_turned(moved, dt))
        forces = forces_on(
            system, moved, moved.velocity, key, tally, self.kinds, self.slow_of(fluid)
        )
        moved = _kicked(fluid, moved, forces, 0.5 * dt)
        return self._rubbed(system, part, moved, key, tally)

    def _in_short_steps(self, system, part: Part, state: State) -> State:
        """The beads of the part a step later, moved by the flow and the potentials between them."""
        deformation, dt = system.flow.deformation, system.dt / self.inner
        # At one rate: short strains are to add up to that of the long step.
        rate = system.flow.strain_in(state.time, system.dt) / system.dt
        flow = Flow(Shear(rate)) if deformation.deforms else Flow()
        among = System(system.fluid.only(part.interactions), dt, flow, self)
        among_forces = lambda own: forces_on(
            among, own, own.velocity, jax.random.key(0), False, (CONSERVATIVE,)
        )
        start = dataclasses.replace(part.state(state), rotation=None)

        def short(own, _):
            moved, drift = drifted(among, own, 0.5)
            return settled(among, own, moved, drift, among_forces(moved)), None

        start = with_forces(start, among_forces(start))
        return jax.lax.scan(short, start, length=self.inner)[0]

    def _rubbed(self, system, part: Part, state: State, key, tally: bool) -> State:
        """The state with the velocities of the part changed by the drag and the noise of a step,
        and with the sums over its pairs."""
        among = dataclasses.replace(system, fluid=system.fluid.only(part.interactions))
        own = part.state(state)
        if tally:
            sums = forces_on(among, own, own.velocity, key, True, (CONSERVATIVE,)).tally
            own = dataclasses.replace(own, tally=sums)
        own = damped(among, own, key, tally, self.tolerance, part.interactions)
        new = {"velocity": part.put(state.velocity, own.velocity), "status": own.status}
        if own.rotation is not None:
            new["rotation"] = dataclasses.replace(own.rotation, begin=state.rotation.begin)
        if tally:
            new["tally"] = state.tally + own.tally
        return dataclasses.replace(state, **new)

    def stiff_of(self, fluid: Fluid) -> tuple[int, ...]:
        """Places of the stiff interactions."""
        if self.stiff is not None:
            return self.stiff
        is_round = lambda group: all(fluid.radius[k] is not None for k in group)
        return tuple(k for k, i in enumerate(fluid.interactions) if all(map(is_round, i.groups)))

    def slow_of(self, fluid: Fluid) -> tuple[int, ...]:
        """Places of the others."""
        stiff = self.stiff_of(fluid)
        return tuple(k for k in range(len(fluid.interactions)) if k not in stiff)

    def forces(self, system, state, key, tally):
        only = self.slow_of(system.fluid)
        return forces_on(system, state, state.velocity, key, tally, self.kinds, only)

    def mark_of(self, fluid: Fluid) -> int:
        """The kinds of force as bits, and which interactions are not in them."""
        stiff = sum(1 << (len(EVERYTHING) + k) for k in self.stiff_of(fluid))
        return super().mark_of(fluid) + stiff

    def check(self, fluid: Fluid) -> None:
        """Raise ValueError where nothing is stiff, or the noise of what is does not follow from its
        drag."""
        stiff, count = self.stiff_of(fluid), len(fluid.interactions)
        if len(set(stiff)) < len(stiff) or not all(k in range(count) for k in stiff):
            raise ValueError(
                f"MultipleTimeStep: stiff is {stiff}; give each place once, of 0 to {count - 1}"
            )
        if not stiff:
            raise ValueError(
                "MultipleTimeStep: no interaction is between beads with radii; name the stiff "
                "ones, stiff=(...), or run with dpd.integrators.VelocityVerlet()"
            )
        if any(fluid.interactions[k].random is not None for k in stiff):
            raise ValueError(
                "MultipleTimeStep needs noise of the stiff interactions that follows from their "
                "drag, and one has random=: leave it out"
            )

    def dt_limits(self, fluid, density, sizes):
        """Those of what is slow; of what is stiff the potentials have their short steps, and drag
        is held."""
        slow, stiff = self._apart(fluid)
        limits = super().dt_limits(slow, density, sizes) if slow.interactions else []
        if not slow.interactions and fluid.bonded:
            every = super().dt_limits(fluid, density, sizes)
            limits = [one for one in every if one[0] == advice.BOND]
        kept = advice.REPULSION, advice.CONTACT
        return limits + [
            (f"{name}, in short steps", self.inner * limit)
            for name, limit in super().dt_limits(stiff, density, sizes)
            if name in kept
        ]

    def dt_errors(self, fluid, density, error=advice.ERROR):
        """Those of velocity-Verlet for what is slow."""
        slow, _ = self._apart(fluid)
        return super().dt_errors(slow, density, error) if slow.interactions else []

    def _apart(self, fluid: Fluid) -> tuple[Fluid, Fluid]:
        """The fluid with the slow interactions and the bonds, and with the stiff interactions."""
        slow = dataclasses.replace(fluid.only(self.slow_of(fluid)), bonded=fluid.bonded)
        return slow, fluid.only(self.stiff_of(fluid))


def _torque(state: State):
    return None if state.rotation is None else state.rotation.torque


def _turned(state: State, dt) -> State:
    """The state with its spheres turned by their angular velocities."""
    return state if state.rotation is None else rotation_turned(state, dt * state.rotation.velocity)


def _kicked(fluid, state: State, forces: Forces, time) -> State:
    """The state with these forces as its last, and its velocities changed by them for a time."""
    state = with_forces(state, forces)
    velocity = state.velocity + time * forces.force / masses(fluid, state)[:, None]
    rotation = state.rotation
    if rotation is not None:
        spin = rotation.velocity + time * forces.torque / inertias(fluid, state)[:, None]
        rotation = dataclasses.replace(rotation, velocity=spin)
    return dataclasses.replace(state, velocity=velocity, rotation=rotation)
