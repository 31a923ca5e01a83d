"""The pure door: a whole run as one function that jit, vmap and grad go through."""

import dataclasses

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from dpdjax.checks import is_concrete, prng_key
from dpdjax.engine import motion, order, soundness
from dpdjax.engine import status as bits
from dpdjax.engine.flow import Driving
from dpdjax.engine.forces import EVERYTHING, check_kinds_of_force, forces_on, update_lists
from dpdjax.engine.integrator import Integrator
from dpdjax.engine.record import Observing, Recorder, averaged, check_names, recorders
from dpdjax.engine.refusals import check_plan, check_run, fitted, list_trouble
from dpdjax.engine.state import State
from dpdjax.engine.system import System
from dpdjax.engine.trajectory import Plan, Trajectory
from dpdjax.model.fluid import Fluid
from dpdjax.pairs.sums import Forces


def simulate(
    fluid: Fluid,
    state: State,
    key: jax.Array,
    dt: ArrayLike,
    plan: Plan,
    flow: Driving = None,
    *,
    observe: Observing = None,
    integrator: Integrator | None = None,
    remat: bool = False,
) -> Trajectory:
    """Run ``plan.steps`` steps: pure, so ``jax.jit``, ``vmap``, ``jvp`` and ``grad`` all work.

    Args:
        fluid, state: what, and from where. The lists in the state keep their capacity.
        key: PRNG key; the noise of step s is a function of (key, s), s counted absolutely.
        dt: time step [time].
        plan: frames, and steps between two.
        flow: ``dpd.shear(rate)``, ``dpd.oscillatory_shear(...)``, ``dpd.flows.body_force(...)``,
            ``dpd.drive(...)`` or None.
        observe: what to record: a function ``observe(fluid, state) -> dict``, or a list of
            such, each possibly wrapped in ``dpd.mean`` or ``dpd.integral``.
        integrator: how beads move on in time; by default ``dpd.integrators.VelocityVerlet()``.
        remat: in reverse mode keep only the state of each frame and recompute the steps
            between. That is fastest for ``every`` below 10, whose steps stay in a CPU's cache;
            memory is least for ``every`` near ``sqrt(steps)``.

    A run that fails (overflow, NaN) has ``final.status`` set and NaN in every number and
    every gradient; ``dpd.run`` repairs overflows instead.

    Example:
        >>> def temperature(gamma):
        ...     thicker = water.set(gamma=gamma)
        ...     return dpd.simulate(thicker, state, key, 0.01, dpd.Plan(2, 5)).frames["temperature"]
        >>> temperature(4.5).shape
        (2,)
        >>> gammas = jnp.array([2.0, 4.5, 9.0])
        >>> jax.eval_shape(jax.vmap(temperature), gammas).shape  # jax.grad goes through too
        (3, 2)
    """
    system = System.of(fluid, dt, flow, integrator)
    state = fitted(fluid, state)
    check_run(system, state, key)
    check_plan(plan, state)
    if system.is_batch:
        raise ValueError(
            "a number of the fluid, the flow, dt or the integrator has one axis too many: a batch; "
            "use jax.vmap, or dpd.run with a vector of keys"
        )
    trajectory = advance(system, state, prng_key(key), plan, recorders(observe), remat)
    if not is_concrete(fluid, state.species, state.size):
        final = _judged(trajectory.final, soundness.law_trouble(fluid, state))
        trajectory = dataclasses.replace(trajectory, final=final)
    return bits.poison(trajectory, trajectory.final.status, (system, state))


def _judged(state: State, trouble) -> State:
    """The state with more trouble in its status."""
    return dataclasses.replace(state, status=state.status | trouble)


def advance(system: System, state: State, key, plan: Plan, how, remat: bool = False) -> Trajectory:
    """:func:`simulate` with recorders ``how``, without checks and without the poison."""
    return proceed(system, begin(system, state, key), key, plan, how, remat)


def begin(system: System, state: State, key) -> State:
    """The state with its force known, as :func:`proceed` takes it."""
    system = system.as_type(state.position.dtype)
    return system.integrator.start(system, state, key)


def proceed(
    system: System, state: State, key, plan: Plan, how, remat: bool = False, trips=None
) -> Trajectory:
    """:func:`advance` from a state whose force is known.

    ``trips``, the number of frames and the steps before each of them, stand in place of those of
    the plan, and are no part of the program; the plan then gives the room for frames, and whether
    the beads are sorted before each (``every >= LASTS``). Forward mode goes through these, and
    through frames that are not evenly spaced; reverse mode does not.
    """
    system = system.as_type(state.position.dtype)
    fluid, dt = system.fluid, system.dt
    check_names(how, fluid, state)
    # Interval records need the pair sums of every step; instantaneous ones of the last step only.
    each = any(r.accumulates for r in how)
    one = lambda state, tally: system.integrator.stepped(system, state, key, tally)
    is_sorted_anew = plan.longest >= order.LASTS
    ids = state.id
    seen = lambda state: order.in_order_of(state, ids)

    def frame(state, every):
        if is_sorted_anew:
            state = order.in_cell_order(state)
        state, sums = run_interval(state, one, every, how, fluid, each, seen)
        values = {"step": state.step, "time": state.time}
        view = seen(state)
        for r, s in zip(how, sums):
            values |= r.value(fluid, view, s, dt, every)
        return _judged(state, motion.trouble(fluid, state, dt)), values

    state = _judged(state, list_trouble(fluid, state))
    if not is_sorted_anew:
        state = order.in_cell_order(state)
    if trips is None:
        final, frames = _all_frames(frame, state, plan, remat)
    else:
        final, frames = scanned(frame, state, plan.frames, *trips)
    final = _judged(final, list_trouble(fluid, final))
    return Trajectory(seen(final), frames, system, plan.every, means=averaged(how, fluid, state))


def _all_frames(frame, state, plan: Plan, remat: bool):
    """``frame(state, every)`` for each frame of a plan; the final state, and the frames."""
    if plan.schedule:
        body = jax.checkpoint(frame) if remat else frame
        return jax.lax.scan(body, state, jnp.asarray(plan.intervals, jnp.int32))
    one = lambda state, _: frame(state, plan.every)
    return jax.lax.scan(jax.checkpoint(one) if remat else one, state, length=plan.frames)


def scanned(frame, state, room: int, count, intervals):
    """``lax.scan`` of ``frame`` over a ``count`` that is no part of the program, each after one of
    the ``intervals`` (room,); the frames beyond it, up to ``room``, are 0."""
    shapes = jax.eval_shape(frame, state, intervals[0])[1]
    empty = jax.tree.map(lambda s: jnp.zeros((room, *s.shape), s.dtype), shapes)

    def body(k, carry):
        state, frames = carry
        state, values = frame(state, intervals[k])
        put = lambda kept, value: jax.lax.dynamic_update_index_in_dim(kept, value, k, 0)
        return state, jax.tree.map(put, frames, values)

    return jax.lax.fori_loop(0, count, body, (state, empty))


def repeated(body, carry, times):
    """``body`` applied ``times`` times, a number of the program or one given to it."""
    if isinstance(times, int):
        return jax.lax.scan(lambda carry, _: (body(carry), None), carry, length=times)[0]
    return jax.lax.fori_loop(0, times, lambda _, carry: body(carry), carry)


def run_interval(state, one, every, how: list[Recorder], fluid, each: bool, seen):
    """``every`` steps, the last with its pair sums, and the sums of what accumulates.

    Recorders get ``seen(state)``: the beads in the caller's order.
    """

    def add(sums, state):
        view = seen(state)
        return [r.add(s, fluid, view) for r, s in zip(how, sums)]

    def body(carry):
        state, sums = carry
        state = one(state, each)
        return state, add(sums, state)

    start = state, [r.zero(fluid, state) for r in how]
    if each:
        return repeated(body, start, every)
    # Two copies of a step: one without the sums over pairs, one with them for the frame.
    state, sums = repeated(body, start, every - 1)
    return one(state, True), sums


def step(
    fluid: Fluid,
    state: State,
    key: jax.Array,
    dt: ArrayLike,
    flow: Driving = None,
    *,
    integrator: Integrator | None = None,
) -> State:
    """One step, for a loop of one's own: pure, so ``jit``, ``vmap`` and ``grad`` go through.

    Lists are kept up to date and the sums over pairs are in ``state.tally``, so that observables
    may be called. ``n`` of these are the ``n`` steps of :func:`dpdjax.simulate`, up to rounding.
    Check ``state.status`` now and then: it is 0 while all is well, ``dpd.grow(state)`` makes room
    in a list that overflowed.

    Arguments as for :func:`dpdjax.simulate`. What cannot run is refused at the first step of a
    state, whose force is not yet known, or known to another integrator.

    Example:
        >>> now = state
        >>> for _ in range(3):
        ...     now = dpd.step(water, now, key, 0.01)
        >>> now
        State(192 beads, box 4 x 4 x 4, step 203, time 2.03)
        >>> int(now.status)  # all is well
        0
    """
    system = System.of(fluid, dt, flow, integrator)
    state = fitted(fluid, state)
    if not is_concrete(state.started) or state.started != system.integrator.mark_of(fluid):
        check_run(system, state, key)
    system, key = system.as_type(state.position.dtype), prng_key(key)
    state = system.integrator.start(system, state, key)
    state = system.integrator.stepped(system, state, key, True)
    trouble = list_trouble(system.fluid, state) | motion.trouble(system.fluid, state, system.dt)
    return _judged(state, trouble)


def forces(
    fluid: Fluid,
    state: State,
    key: jax.Array,
    dt: ArrayLike,
    flow: Driving = None,
    *,
    kinds: tuple[str, ...] = EVERYTHING,
) -> Forces:
    """What acts on the beads of a state at its positions and velocities, wherever those are from.

    Args:
        fluid, state: what, and where; lists that are stale are built anew first.
        key, dt: of the noise of ``state.step``, whose size is ``sqrt(2 kT zeta / dt)``.
        flow: what drives the fluid.
        kinds: which of ``"conservative"``, ``"drag"``, ``"random"`` and ``"driven"``.

    Returns :class:`dpdjax.integrators.Forces`: force (n, 3), torque (m, 3) or None, and the tally
    of energy and virials. Pure; NaN where a list overflowed, for which ``dpd.grow(state)`` makes
    room. Raises ValueError for an unknown kind, and as :func:`dpdjax.simulate` does.

    Example:
        >>> acts = dpd.forces(water, state, key, 0.01)
        >>> acts.force.shape, acts.torque is None
        ((192, 3), True)
        >>> bool(jnp.abs(acts.force.sum(axis=0)).max() < 1e-2)  # pairs keep momentum
        True
        >>> bool(acts.tally.energy > 0)
        True
    """
    check_kinds_of_force(kinds)
    kinds = tuple(kinds)
    system = System.of(fluid, dt, flow)
    state = fitted(fluid, state)
    check_run(system, state, key)
    system = system.as_type(state.position.dtype)
    state = update_lists(state)
    found = forces_on(system, state, state.velocity, prng_key(key), True, kinds)
    return bits.poison(found, list_trouble(system.fluid, state), (system, state))
