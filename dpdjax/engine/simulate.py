"""The pure door: a whole run as one function that jit, vmap and grad go through."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.checks import is_concrete, positive, prng_key
from dpdjax.engine import advice, motion, order, soundness
from dpdjax.engine import flow as flows
from dpdjax.engine import status as bits
from dpdjax.engine.batching import batch_axes, chosen, differing, named
from dpdjax.engine.record import Recorder, averaged, check_names, recorders
from dpdjax.engine.state import State, radii
from dpdjax.engine.step import started, step
from dpdjax.model import summary
from dpdjax.model.fluid import Fluid


@dataclasses.dataclass(frozen=True)
class Plan:
    """How much to run and how much to keep (static).

    Attributes:
        frames: recorded frames.
        every: steps between two frames.
    """

    frames: int
    every: int = 1

    def __post_init__(self):
        for name in ("frames", "every"):
            value = getattr(self, name)
            whole = isinstance(value, (int, float, np.number)) and value % 1 == 0
            if isinstance(value, bool) or not whole or value < 1:
                raise ValueError(
                    f"Plan {name} is {value!r}; it must be a whole number of at least 1"
                )
            object.__setattr__(self, name, int(value))

    @property
    def steps(self) -> int:
        return self.frames * self.every


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, repr=False)
class Trajectory:
    """What a run leaves behind.

    Attributes:
        final: the state after the last step.
        frames: recorded values by name, each with a leading axis of frames; always with
            ``time`` and ``step``. A batched run has the batch in front of the frames.
        fluid, flow, dt: what was run, for the measurements that need it.
        every: steps between two frames (static).
        complete: whether all planned frames are there (static).
        means: names of those frames that are means over their interval (static).
        failed: of a batch, the members that failed and why (static); their frames are NaN from then
            on, and their final state is the last that was sound.
    """

    final: State
    frames: dict[str, Any]
    fluid: Fluid
    flow: Any
    dt: Any
    every: int = dataclasses.field(default=1, metadata={"static": True})
    complete: bool = dataclasses.field(default=True, metadata={"static": True})
    means: tuple[str, ...] = dataclasses.field(default=(), metadata={"static": True})
    failed: tuple[tuple[int, str], ...] = dataclasses.field(default=(), metadata={"static": True})

    def __repr__(self):
        recorded = {name: jnp.shape(x) for name, x in self.frames.items() if hasattr(x, "shape")}
        count = recorded.get("step", (0,))[-1:]
        head = (
            f"Trajectory({count[0] if count else 0} frames, one in {self.every} steps of "
            f"{summary.span(self.dt)}"
        )
        told = [
            "" if self.complete else "interrupted",
            f"members {[k for k, _ in self.failed]} failed" if self.failed else "",
        ]
        head = ", ".join([head, *filter(None, told)])
        values = ", ".join(f"{name} {shape}" for name, shape in recorded.items())
        return f"{head}: {values}; final {self.final!r})"

    @property
    def interval(self):
        """Time between two frames."""
        return self.dt * self.every

    @property
    def is_batch(self) -> bool:
        return jnp.ndim(self.final.position) == 3

    def __getitem__(self, which) -> "Trajectory":
        """Members of a batch with their own numbers: one by its number, or a batch by a slice or a
        list of numbers."""
        if not self.is_batch:
            raise TypeError(
                "this trajectory is no batch and has no members to choose from; its frames are in "
                ".frames"
            )
        members = self.final.position.shape[0]
        slots = np.arange(members)[which]
        if np.ndim(slots) > 1 or not np.size(slots):
            raise IndexError(
                f"{which!r} chooses no members of the {members} of this batch; give a number, a "
                "slice or a list"
            )
        numbers = self.fluid, self.dt, self.flow
        fluid, dt, flow = chosen(numbers, batch_axes(*numbers), slots)
        final, frames = chosen((self.final, self.frames), 0, slots)
        failed = tuple(
            (k, why)
            for k, member in enumerate(np.ravel(slots))
            for n, why in self.failed
            if n == member
        )
        new = {"final": final, "frames": frames, "fluid": fluid, "flow": flow, "dt": dt}
        complete = self.complete and not (failed and np.ndim(slots) == 0)
        return dataclasses.replace(self, **new, complete=complete, failed=failed)

    @property
    def survivors(self) -> "Trajectory":
        """The members of a batch that did not fail, as a batch; ValueError where all did."""
        if not self.failed:
            return self
        lost = dict(self.failed)
        left = [k for k in range(self.final.position.shape[0]) if k not in lost]
        if not left:
            raise ValueError(f"all {len(lost)} members failed: {next(iter(lost.values()))}")
        return self[left]

    def members(self) -> list["Trajectory"]:
        """The trajectories of a batch one by one, each with its own numbers; of one run, that
        alone."""
        return [self[k] for k in range(self.final.position.shape[0])] if self.is_batch else [self]


def simulate(
    fluid: Fluid,
    state: State,
    key,
    dt,
    plan: Plan,
    flow=None,
    *,
    observe=None,
    lam=0.5,
    remat: bool = False,
) -> Trajectory:
    """Run ``plan.steps`` steps: pure, so ``jax.jit``, ``vmap``, ``jvp`` and ``grad`` all work.

    Args:
        fluid, state: what, and from where. The lists in the state keep their capacity.
        key: PRNG key; the noise of step s is a function of (key, s), s counted absolutely.
        dt: time step [time].
        plan: frames, and steps between two.
        flow: ``dpd.shear(rate)``, ``dpd.oscillatory_shear(...)``, ``dpd.body_force(...)``,
            ``dpd.drive(...)`` or None.
        observe: what to record: a function ``observe(fluid, state) -> dict``, or a list of
            such, each possibly wrapped in ``dpd.mean`` or ``dpd.integral``.
        lam: weight of the predicted velocity.
        remat: in reverse mode keep only the state of each frame and recompute the steps
            between. That is fastest for ``every`` below 10, whose steps stay in a CPU's cache;
            memory is least for ``every`` near ``sqrt(steps)``.

    A run that fails (overflow, NaN) has ``final.status`` set and NaN in every number and
    every gradient; ``dpd.run`` repairs overflows instead.
    """
    check_run(fluid, state, key, dt, flow)
    check_plan(plan, state)
    if fluid.is_batch or jnp.ndim(dt) or (flow is not None and flow.batch_axes() is not None):
        raise ValueError(
            "a number of the fluid, the flow or dt has one axis too many: a batch; "
            "use jax.vmap, or dpd.run with a vector of keys"
        )
    trajectory = advance(fluid, state, prng_key(key), dt, plan, flow, observe, lam, remat)
    if not is_concrete(fluid, state.species, state.size):
        trajectory = _judged(trajectory, soundness.law_trouble(fluid, state))
    return bits.poison(trajectory, trajectory.final.status, (fluid, state, dt, flow))


def _judged(trajectory: Trajectory, trouble) -> Trajectory:
    """The trajectory with more trouble in its status."""
    final = dataclasses.replace(trajectory.final, status=trajectory.final.status | trouble)
    return dataclasses.replace(trajectory, final=final)


def advance(
    fluid, state, key, dt, plan, flow, observe, lam=0.5, remat=False, trips=None
) -> Trajectory:
    """:func:`simulate` without checks and without the poison.

    ``trips``, a pair of whole numbers, are the frames and the steps between two in place of those
    of the plan, and no part of the program; the plan then gives the room for frames, and whether
    the beads are sorted before each (``every >= LASTS``). Forward mode goes through, reverse mode
    does not.
    """
    flow = flows.quiet() if flow is None else flow
    dtype = state.position.dtype
    fluid, flow, dt, lam = jax.tree.map(lambda x: jnp.asarray(x, dtype), (fluid, flow, dt, lam))
    how = recorders(observe)
    check_names(how, fluid, state)
    # Interval records need the pair sums of every step; instantaneous ones of the last step only.
    each = any(r.accumulates for r in how)

    def one(state, tally):
        return step(fluid, state, key, dt, flow, lam, tally)

    every = plan.every if trips is None else trips[1]
    ids = state.id
    seen = lambda state: order.in_order_of(state, ids)

    def frame(state, _):
        if plan.every >= order.LASTS:
            state = order.in_cell_order(state)
        state, sums = run_interval(state, one, every, how, fluid, each, seen)
        values = {"step": state.step, "time": state.time}
        view = seen(state)
        for r, s in zip(how, sums):
            values |= r.value(fluid, view, s, dt, every)
        return dataclasses.replace(
            state, status=state.status | motion.trouble(fluid, state, dt)
        ), values

    state = started(fluid, state, key, dt, flow)
    state = dataclasses.replace(state, status=state.status | list_trouble(fluid, state))
    if plan.every < order.LASTS:
        state = order.in_cell_order(state)
    if trips is None:
        final, frames = jax.lax.scan(
            jax.checkpoint(frame) if remat else frame, state, length=plan.frames
        )
    else:
        final, frames = collected(frame, state, plan.frames, trips[0])
    final = dataclasses.replace(final, status=final.status | list_trouble(fluid, final))
    return Trajectory(
        seen(final), frames, fluid, flow, dt, plan.every, means=averaged(how, fluid, state)
    )


def collected(frame, state, room: int, count):
    """``lax.scan`` of ``frame`` over a ``count`` that is no part of the program; the frames beyond
    it, up to ``room``, are 0."""
    shapes = jax.eval_shape(frame, state, None)[1]
    empty = jax.tree.map(lambda s: jnp.zeros((room, *s.shape), s.dtype), shapes)

    def body(k, carry):
        state, frames = carry
        state, values = frame(state, None)
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

    zeros = [r.zero(fluid, state) for r in how]
    state, sums = repeated(body, (state, zeros), every - 1)
    state = one(state, True)
    return state, add(sums, state)


def list_trouble(fluid, state):
    """Bits for lists that overflowed, that are too short for the laws, or too wide for the box."""
    trouble = jnp.zeros((), jnp.uint32)
    radius = radii(fluid, state)
    for interaction, neighbours in zip(fluid.interactions, state.neighbours):
        code = neighbours.list.error.code
        grid = neighbours.grid
        trouble |= bits.flag((code & 1) > 0, bits.PAIRS_OVERFLOW) | bits.flag(
            (code & 2) > 0, bits.WINDOW_OVERFLOW
        )
        largest = [jnp.max(radius[begin:end]) for begin, end in grid.groups]
        reach = jnp.stack([jnp.max(r) for r in interaction.reaches(*largest, fluid.kT)])
        trouble |= bits.flag(jnp.any(reach > grid.reach * (1 + 1e-5)), bits.REACH_EXCEEDED)
        sides = state.box.lengths
        trouble |= bits.flag(jnp.any(sides < 2 * grid.cut * (1 - 1e-5)), bits.BOX_TOO_SMALL)
        if grid.cells is not None:
            across = jnp.asarray(grid.cells, sides.dtype) / jnp.asarray(
                (grid.span, 1, 1), sides.dtype
            )
            least = across * grid.cut * (1 - 1e-5)
            trouble |= bits.flag(jnp.any(sides < least), bits.BOX_TOO_SMALL)
    return trouble


def check_run(fluid, state, key, dt, flow):
    """Errors that can be told before the work starts, each with the value and the cure."""
    check_kinds(fluid, state)
    if flow is not None and not isinstance(flow, flows.Flow):
        flows_there_are = (
            "dpd.shear(rate), dpd.oscillatory_shear(...), dpd.body_force(...), dpd.drive(...)"
        )
        raise TypeError(
            f"flow is {flow!r}; give {flows_there_are}, a class derived from dpd.Flow, or None"
        )
    prng_key(key)
    positive(dt, "dt")
    shape = jnp.shape(state.position)
    if len(shape) != 2 or shape[1] != 3 or jnp.shape(state.velocity) != shape:
        raise ValueError(
            f"positions {shape} and velocities {jnp.shape(state.velocity)} must both be (beads, "
            "3); for a batch use jax.vmap, or dpd.run with a vector of keys"
        )
    lists, wanted = len(state.neighbours), len(fluid.interactions)
    if lists != wanted:
        raise ValueError(f"{lists} lists for {wanted} interactions: make the state with this fluid")
    highest = int(np.max(np.asarray(state.species), initial=0)) if is_concrete(state.species) else 0
    if highest >= fluid.species:
        raise ValueError(
            f"the state has species {highest}, the fluid knows 0 to {fluid.species - 1}"
        )
    if set(state.tally.virial) != set(fluid.origins):
        raise ValueError(
            f"the state keeps stresses as {', '.join(state.tally.virial)}, the fluid as "
            f"{', '.join(fluid.origins)}: make the state with this fluid"
        )
    check_rotation(fluid, state)
    check_finite(state)
    soundness.check_laws(fluid, state)
    check_dt(fluid, state, dt)
    if is_concrete(state.box.strain) and np.any(np.asarray(state.box.strain)):
        flows.check_tilt(state)
    if flow is not None:
        # What is known is judged now, inside a program that is being traced too.
        with jax.ensure_compile_time_eval():
            flow.check(fluid, state)


def check_kinds(fluid, state):
    """Raise TypeError, with what to give, for anything but a fluid and a state."""
    if isinstance(fluid, State) and isinstance(state, Fluid):
        raise TypeError(
            "fluid is a State and state a Fluid, the wrong way round: the one of dpd.fluid(...) "
            "comes first"
        )
    if not isinstance(fluid, Fluid):
        cure = "give its .fluid" if hasattr(fluid, "fluid") else "build one with dpd.fluid(...)"
        raise TypeError(f"fluid is a {type(fluid).__name__}; {cure}")
    if not isinstance(state, State):
        part = next((name for name in ("final", "state") if hasattr(state, name)), None)
        cure = f"give its .{part}" if part else "build one with dpd.initial_state(...)"
        raise TypeError(f"state is a {type(state).__name__}; {cure}")


def check_finite(state):
    """Refuse positions or velocities that are not finite, of one state or a batch, and name the
    first such bead."""
    for name in ("position", "velocity"):
        values = getattr(state, name)
        if not is_concrete(values) or np.all(np.isfinite(np.asarray(values))):
            continue
        where = np.argwhere(~np.all(np.isfinite(np.asarray(values)), axis=-1))[0]
        member = f" of member {where[0]}" if len(where) == 2 else ""
        value = np.asarray(values)[tuple(where)].tolist()
        raise ValueError(
            f"the {name} of bead {where[-1]}{member} is {value} at the start; give a state of "
            "finite numbers"
        )


def check_rotation(fluid, state):
    """Refuse a state whose beads rotate otherwise than those of the fluid."""
    has = state.rotation is not None
    if has != bool(fluid.rotating):
        turns = lambda yes: "rotate" if yes else "do not"
        what = f"beads of the fluid {turns(fluid.rotating)} and those of the state {turns(has)}"
        raise ValueError(f"{what}: make the state with this fluid")
    if has and is_concrete(state.species):
        turning = np.isin(np.asarray(state.species), fluid.rotating)
        if not np.all(turning[state.rotation.slots]) or turning.sum() != state.rotation.m:
            raise ValueError(
                "the beads of the state that rotate are of other species: make the state with this "
                "fluid"
            )


LAST_STEP = 2**31 - 1
"""Steps are counted in 32 bits."""


def check_plan(plan, state=None):
    """Raise TypeError for anything but a :class:`Plan`, ValueError for one that outruns the count
    of the steps of a state."""
    if not isinstance(plan, Plan):
        raise TypeError(f"plan is {plan!r}; give dpd.Plan(frames=..., every=...)")
    if state is None or not is_concrete(state.step):
        return
    end = int(np.max(np.asarray(state.step))) + plan.steps
    if end > LAST_STEP:
        raise ValueError(
            f"the run would end at step {end}, and steps, by which the noise is keyed, are counted "
            f"up to {LAST_STEP}: start the count anew, dataclasses.replace(state, "
            "step=jnp.zeros_like(state.step)), and give another key"
        )


def check_dt(fluid, state, dt):
    """Refuse a time step at which drag, repulsion, lubrication or contacts would overshoot, and
    name the member it is of."""
    if not is_concrete(fluid, dt, state.box.lengths, state.species, state.size):
        return
    counts = np.bincount(np.asarray(state.species), minlength=fluid.species)
    density = counts / float(np.prod(np.asarray(state.box.lengths)))
    sizes = float(np.min(np.asarray(state.size))), float(np.max(np.asarray(state.size)))
    told = _too_large(fluid, dt, density, sizes)
    if told is None:
        return
    numbers = fluid, dt, flows.quiet()
    for member in range(max((len(values) for values in differing(*numbers).values()), default=0)):
        of_member = _too_large(*chosen(numbers, batch_axes(*numbers), member)[:2], density, sizes)
        if of_member is not None:
            raise ValueError(f"{named(member, numbers)}: {of_member}")
    raise ValueError(told)


def _too_large(fluid, dt, density, sizes):
    """What a time step is too large for, and the cure; None where it is not."""
    largest = float(np.max(np.asarray(dt)))
    for what, limit in advice.dt_limits(fluid, density, sizes):
        if largest > limit:
            return (
                f"dt {largest:.4g} is too large for the {what}, which allows {limit:.2g}; "
                f"use dt = {advice.suggest_dt(fluid, density, sizes):.2g} (temperature error 0.5 %)"
            )
    return None
