"""How beads move on in time: what every integrator answers, and velocity-Verlet with a predicted
velocity."""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from dpdjax.checks import Numbers
from dpdjax.engine.answers import Part
from dpdjax.engine.compensated import plus
from dpdjax.engine.forces import EVERYTHING, check_kinds_of_force, forces_on, update_lists
from dpdjax.engine.rotation import rotation_step
from dpdjax.engine.state import State
from dpdjax.model import advice
from dpdjax.model.beads import inertias, masses
from dpdjax.model.fluid import Fluid
from dpdjax.pairs import box as boxes
from dpdjax.pairs.sums import Forces
from dpdjax.xla import any_in_batch


class Integrator(Part):
    """What every integrator answers.

    One of your own is a frozen dataclass, registered with ``jax.tree_util.register_dataclass``. It
    writes ``step``, of which :func:`dpdjax.integrators.drifted`,
    :func:`dpdjax.integrators.forces_on` and :func:`dpdjax.integrators.settled` are the parts, and
    has numbers (leaves, for gradients) and counts (``dataclasses.field(default=4,
    metadata={"static": True})``). ``ranks = {"name": 0}`` names the numbers that may differ from
    member to member of a batch, each with its axes in one member. ``system`` has a ``fluid``, a
    ``dt``, a ``flow`` (``rate_at``, ``strain_in``) and the integrator.

    ``dt_limits`` and ``dt_errors`` are those measured for velocity-Verlet unless you write others:
    a run is refused by the first, and ``suggest_dt`` answers by both, so measure the temperature at
    a few ``dt`` times :func:`dpdjax.theory.damping_rate`. ``forces`` and ``mark_of`` are for a
    force that lacks some interactions between two steps, ``kinds`` for one that lacks some kinds: a
    state with your mark is gone on with as it is.

    Attributes:
        kinds: the kinds of force that the force of a state consists of between two steps.
        cost: a step in units of one of velocity-Verlet (measured: tests/benchmarks/STEPS.md), by
            which lists are planned and :func:`dpdjax.integrators.cheapest` chooses among those of
            the package.
        changes_box: whether the sides of the box may change in a step.

    Example:
        >>> import dataclasses
        >>> from dpdjax import integrators
        >>> @jax.tree_util.register_dataclass
        ... @dataclasses.dataclass(frozen=True)
        ... class Own(integrators.Integrator):
        ...     lam: float = 0.65
        ...     def step(self, system, state, key, tally):
        ...         moved, drift = integrators.drifted(system, state, self.lam)
        ...         velocity = drift.predicted(self.lam)
        ...         forces = integrators.forces_on(system, moved, velocity, key, tally)
        ...         return integrators.settled(system, state, moved, drift, forces)
        >>> dpd.step(water, state, key, 0.01, integrator=Own())
        State(192 beads, box 4 x 4 x 4, step 201, time 2.01)
    """

    kinds: ClassVar[tuple[str, ...]] = EVERYTHING
    cost: ClassVar[float] = 1.0
    changes_box: ClassVar[bool] = False

    def step(self, system, state: State, key: jax.Array, tally: bool) -> State:
        """The state a step of ``system.dt`` later, its force known.

        ``tally`` (static): with the sums over pairs, which energies and stresses are read off. Hand
        it to the last evaluation of each kind of force; :class:`dpdjax.integrators.Forces` with
        sums and without add up.
        """
        raise NotImplementedError(f"{type(self).__name__} has no step(system, state, key, tally)")

    def stepped(self, system, state: State, key: jax.Array, tally: bool) -> State:
        """``step``, and TypeError or ValueError for what is no state a step later."""
        after, name = self.step(system, state, key, tally), type(self).__name__
        if not isinstance(after, State):
            raise TypeError(f"step of {name} gives {after!r}; return the state a step later")
        if after.step is state.step or after.force is state.force:
            raise ValueError(
                f"step of {name} gives a state whose step or force is that before it: move the "
                "beads by drifted(...) and end with settled(...) or with_forces(...)"
            )
        old = jax.tree.leaves(state.tally)
        if tally and any(a is b for a, b in zip(jax.tree.leaves(after.tally), old)):
            raise ValueError(
                f"step of {name} leaves the sums over pairs as they were: hand its tally to the "
                "last forces_on(...) of each kind"
            )
        return after

    def start(self, system, state: State, key: jax.Array) -> State:
        """The state with its force known, computed now if it was not."""

        mark = self.mark_of(system.fluid)
        is_known = state.started == mark

        def compute(state):
            updated = update_lists(state)
            forces = self.forces(system, updated, key, True)
            known = dataclasses.replace(
                with_forces(updated, forces), started=jnp.full_like(state.started, mark)
            )
            return jax.tree.map(lambda old, new: jnp.where(is_known, old, new), state, known)

        # In a batch all compute as soon as one must: a branch of its own for each would be no
        # branch.
        return jax.lax.cond(any_in_batch(~is_known), compute, lambda state: state, state)

    def forces(self, system, state: State, key: jax.Array, tally: bool) -> Forces:
        """The force of a state between two steps, as ``start`` computes it."""
        return forces_on(system, state, state.velocity, key, tally, self.kinds)

    def mark_of(self, fluid: Fluid) -> int:
        """What a state that this integrator can go on with has in ``started``: its kinds of force,
        as bits."""
        check_kinds_of_force(self.kinds)
        return sum(1 << EVERYTHING.index(kind) for kind in self.kinds)

    def check(self, fluid: Fluid) -> None:
        """Raise TypeError or ValueError, before a run, for a fluid it cannot move or numbers of its
        own that it cannot have, which may be a batch or traced. By default all are taken."""

    def check_flow(self, flow) -> None:
        """Raise ValueError, before a run, for a flow that it does not go with. By default all
        are taken."""

    def dt_limits(
        self, fluid: Fluid, density: Numbers, sizes: tuple[float, float]
    ) -> list[tuple[str, float]]:
        """What is unstable at too long a time step, and the longest it allows [time]."""
        return advice.dt_limits(fluid, density, sizes)

    def dt_errors(
        self, fluid: Fluid, density: Numbers, error: float = advice.ERROR
    ) -> list[tuple[str, float]]:
        """What errs with the time step, and the dt at which it errs by ``error`` [time]."""
        return advice.dt_errors(fluid, density, error)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class VelocityVerlet(Integrator):
    """Velocity-Verlet whose drag is that of a predicted velocity (Groot & Warren 1997, eq. 15).

    ==================================  ===================================================
    in the method                       here
    ==================================  ===================================================
    r += dt v + dt^2 f / 2m             :func:`dpdjax.integrators.drifted`, v = c + rate y e_x
    strain += rate dt                   ``flow.strain_in``
    v~ = v + lambda dt f / m            ``predicted``
    f' = F(r, v~), noise of step + 1    :func:`dpdjax.integrators.forces_on`
    v += dt (f + f') / 2m               :func:`dpdjax.integrators.settled`
    the same for angles, with I for m   in ``drifted`` and ``settled``
    ==================================  ===================================================

    Attributes:
        lam: weight of the old force in the predicted velocity, ``lambda``.

    Example:
        >>> dpd.integrators.VelocityVerlet(lam=0.65)
        VelocityVerlet(lam=0.65)
        >>> dpd.step(water, state, key, 0.01, integrator=dpd.integrators.VelocityVerlet(lam=0.65))
        State(192 beads, box 4 x 4 x 4, step 201, time 2.01)
    """

    ranks = {"lam": 0}

    lam: Any = 0.5

    def step(self, system, state: State, key: jax.Array, tally: bool) -> State:
        """One step, by the three parts."""
        moved, drift = drifted(system, state, self.lam)
        forces = forces_on(system, moved, drift.predicted(self.lam), key, tally)
        return settled(system, state, moved, drift, forces)


class Drift(NamedTuple):
    """What a step knows once beads have moved and before new forces act, by component (3, n).

    ``predicted(lam)`` is ``(carried + lam kick).T``, (n, 3) as :func:`dpdjax.integrators.forces_on`
    takes it.

    Attributes:
        carried: peculiar velocities, less what the flow gains where beads have moved to.
        kick: ``dt f / m`` of the old force.
        spin_kick: ``dt T / I`` of the old torque (m, 3), or None.

    Example:
        >>> moved, drift = dpd.integrators.drifted(rest.system, rest.final, 0.5)
        >>> drift.carried.shape, drift.kick.shape, drift.spin_kick is None
        ((3, 192), (3, 192), True)
        >>> drift.predicted(0.5).shape
        (192, 3)
    """

    carried: Any
    kick: Any
    spin_kick: Any

    def predicted(self, lam: ArrayLike) -> jax.Array:
        """Velocities (n, 3) after the share ``lam`` of a whole old kick."""
        return (self.carried + lam * self.kick).T


def drifted(system, state: State, lam: ArrayLike) -> tuple[State, Drift]:
    """The beads moved by their velocities and old forces, lists and noise those of the next step.

    The state's ``step`` is one more, and :func:`dpdjax.integrators.forces_on` draws the noise of
    that step; the old force had that of the one before. ``lam`` matters to angular velocities
    alone, which are those of the state that drag is of; ``Drift.predicted`` has the others.

    The streaming velocity at a bead changes as the bead moves in y, so the peculiar velocity loses
    ``rate dy`` along x: in steady shear the exact rewriting of the lab-frame step, with no jump
    when a bead crosses the boundary. Where the rate changes, the whole box follows at once (SLLOD).
    Spheres are turned, and have their angular velocity predicted by ``lam``. Where the sides of the
    box change in this step they do so here, before the new forces.

    Returns the state moved on and a :class:`dpdjax.integrators.Drift`.

    Example:
        >>> moved, drift = dpd.integrators.drifted(rest.system, rest.final, 0.5)
        >>> int(moved.step - rest.final.step), round(float(moved.time - rest.final.time), 4)
        (1, 0.01)
    """
    # By component, (3, n): XLA vectorises along the beads, and along three numbers it cannot.
    dt, mass, velocity = system.dt, masses(system.fluid, state)[None], state.velocity.T
    kick = dt * state.force.T / mass
    with jax.named_scope("integration"):
        moved, carried = carried_along(system, state, velocity, dt * velocity + 0.5 * dt * kick)
        if system.stretch is not None:
            moved = stretched(moved, system.stretch)
            carried, kick = (v / system.stretch[:, None] for v in (carried, kick))
        moved = update_lists(moved)
    if state.rotation is None:
        return moved, Drift(carried, kick, None)
    moved, spin_kick = rotation_drifted(system.fluid, moved, dt, lam)
    return moved, Drift(carried, kick, spin_kick)


def carried_along(system, state: State, velocity, move) -> tuple[State, Any]:
    """The beads moved by ``move`` (3, n) in a step, with the flow, their lists as they were; and
    ``velocity`` (3, n) less what the flow gains where they have moved to."""
    strain = system.flow.strain_in(state.time, system.dt)
    carried = velocity - _along_x(strain / system.dt * move[1])
    return moved_on(state, move, strain, system.dt), carried


def settled(system, before: State, moved: State, drift: Drift, forces: Forces) -> State:
    """The end of a step: velocities by the mean of the old and the new kick, and the new forces.

    To keep another force for the next step, give the result to
    :func:`dpdjax.integrators.with_forces`.

    Example:
        >>> system, before = rest.system, rest.final
        >>> moved, drift = dpd.integrators.drifted(system, before, 0.5)
        >>> acts = dpd.integrators.forces_on(system, moved, drift.predicted(0.5), key, True)
        >>> dpd.integrators.settled(system, before, moved, drift, acts)
        State(192 beads, box 4 x 4 x 4, step 401, time 4.01)
    """
    dt, fluid = system.dt, system.fluid
    mass = masses(fluid, before)[None]
    velocity = drift.carried + 0.5 * (drift.kick + dt * forces.force.T / mass)
    moved = dataclasses.replace(moved, velocity=velocity.T)
    if drift.spin_kick is not None:
        spin = rotation_settled(fluid, before, moved, drift.spin_kick, forces.torque, dt)
        moved = dataclasses.replace(moved, rotation=spin)
    return with_forces(moved, forces)


def with_forces(state: State, forces: Forces) -> State:
    """The state with these forces as its last; sums over pairs that they lack stay as they were.

    Example:
        >>> now, kinds = rest.final, ("conservative",)
        >>> acts = dpd.integrators.forces_on(rest.system, now, now.velocity, key, True, kinds)
        >>> after = dpd.integrators.with_forces(now, acts)
        >>> bool((after.force == acts.force).all()), bool((after.velocity == now.velocity).all())
        (True, True)
    """
    rotation, tally = state.rotation, state.tally if forces.tally is None else forces.tally
    if rotation is not None:
        rotation = dataclasses.replace(rotation, torque=forces.torque)
    return dataclasses.replace(state, force=forces.force, tally=tally, rotation=rotation)


def rotation_drifted(fluid, state: State, dt, lam):
    """The state with its spheres turned and their predicted angular velocity, and the kick
    ``dt T / I`` of the old torque."""
    old = state.rotation
    spin_kick = dt * old.torque / inertias(fluid, state)[:, None]
    turned = rotation_turned(state, dt * (old.velocity + 0.5 * spin_kick))
    new = dataclasses.replace(turned.rotation, velocity=old.velocity + lam * spin_kick)
    return dataclasses.replace(turned, rotation=new), spin_kick


def rotation_turned(state: State, angle) -> State:
    """The state with its spheres turned by small vectors (m, 3) [radian]."""
    old = state.rotation
    step = rotation_step(old.orientation, angle)
    orientation, rest = plus(old.orientation, old.orientation_rest, step)
    new = dataclasses.replace(old, orientation=orientation, orientation_rest=rest)
    return dataclasses.replace(state, rotation=new)


def rotation_settled(fluid, before: State, moved: State, spin_kick, torque, dt):
    """The rotation at the end of a step, from that before it."""
    velocity = before.rotation.velocity + 0.5 * (
        spin_kick + dt * torque / inertias(fluid, moved)[:, None]
    )
    return dataclasses.replace(moved.rotation, velocity=velocity)


def moved_on(state: State, move, strain, dt) -> State:
    """The state a step later: beads moved by ``move`` (3, n), and they and the box by a shear
    strain."""
    move = move + _along_x(strain * state.position[:, 1])
    position, position_rest = plus(state.position.T, state.position_rest.T, move)
    total, strain_rest = plus(state.box.strain, state.strain_rest, strain)
    time, time_rest = plus(state.time, state.time_rest, dt)
    box, periods = boxes.Box(state.box.lengths, total).folded()
    position, crossed = boxes.wrapped_columns(box, position)
    # A period less of strain leaves an upper image a side further back along x.
    image = state.image + (crossed + _along_x(periods.astype(jnp.int32) * state.image[:, 1])).T
    rests = {"position_rest": position_rest.T, "strain_rest": strain_rest, "time_rest": time_rest}
    new = {"position": position.T, "image": image, "box": box, "step": state.step + 1, "time": time}
    if state.topology is not None:
        new["topology"] = state.topology.folded(periods)
    return dataclasses.replace(state, **new, **rests)


def stretched(state: State, by) -> State:
    """The state in a box whose sides are longer by factors (3,), its beads with them."""
    more = by - 1.0
    move = more[:, None] * state.position.T
    position, rest = plus(state.position.T, state.position_rest.T, move)
    lengths, strain = state.box.lengths, state.box.strain * (by[0] / by[1])
    new = {"position": position.T, "position_rest": rest.T}
    return dataclasses.replace(state, **new, box=boxes.Box(lengths + more * lengths, strain))


def _along_x(values):
    """A vector along x for each bead, (3, n)."""
    return jnp.stack([values, jnp.zeros_like(values), jnp.zeros_like(values)])
