"""What a run refuses before the work starts, each with the value and the cure."""

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.bonded.forces import measured
from dpdjax.checks import is_concrete, positive, prng_key
from dpdjax.engine import soundness
from dpdjax.engine import status as bits
from dpdjax.engine.answers import check_part
from dpdjax.engine.choice import cheapest
from dpdjax.engine.deformation import check_tilt
from dpdjax.engine.integrator import Integrator
from dpdjax.engine.state import State
from dpdjax.engine.system import System
from dpdjax.engine.trajectory import LAST_STEP, Plan
from dpdjax.model import advice
from dpdjax.model.beads import radii
from dpdjax.model.bonded import BEADS
from dpdjax.model.fluid import Fluid
from dpdjax.pairs import neighbours as lists
from dpdjax.pairs.forces import interactions_of


def fitted(fluid, state):
    """A state that no run has begun with, with room for what this fluid keeps; others, and what is
    neither, as they are."""
    is_fit = isinstance(fluid, Fluid) and isinstance(state, State)
    return state.keeping(fluid.origins) if is_fit else state


def check_run(system: System, state, key):
    """Errors that can be told before the work starts, each with the value and the cure."""
    fluid = system.fluid
    check_kinds(system, state)
    prng_key(key)
    dt = positive(system.dt, "dt")
    if dt.ndim > 1 or not dt.size:
        raise ValueError(f"dt has shape {dt.shape}; give one number, or one for each member")
    shape = jnp.shape(state.position)
    if len(shape) != 2 or shape[1] != 3 or jnp.shape(state.velocity) != shape:
        raise ValueError(
            f"positions {shape} and velocities {jnp.shape(state.velocity)} must both be (beads, "
            "3); for a batch use jax.vmap, or dpd.run with a vector of keys"
        )
    held, wanted = len(state.neighbours), len(fluid.interactions)
    if held != wanted:
        raise ValueError(f"{held} lists for {wanted} interactions: make the state with this fluid")
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
    check_bonds(fluid, state)
    check_finite(state)
    soundness.check_laws(fluid, state)
    system.integrator.check(fluid)
    system.integrator.check_flow(system.flow)
    check_dt(system, state)
    if is_concrete(state.box.strain) and np.any(np.asarray(state.box.strain)):
        check_tilt(state)
    # What is known is judged now, inside a program that is being traced too.
    with jax.ensure_compile_time_eval():
        system.flow.check(fluid, state)


def check_kinds(system: System, state):
    """Raise TypeError, with what to give, for a system or a state of anything else."""
    fluid = system.fluid
    if isinstance(fluid, State) and isinstance(state, Fluid):
        raise TypeError(
            "fluid is a State and state a Fluid, the wrong way round: the one of dpd.fluid(...) "
            "comes first"
        )
    check_fluid(fluid)
    if not isinstance(state, State):
        part = next((name for name in ("final", "state") if hasattr(state, name)), None)
        cure = f"give its .{part}" if part else "build one with dpd.initial_state(...)"
        raise TypeError(f"state is a {type(state).__name__}; {cure}")
    wanted = (
        "dpd.integrators.VelocityVerlet(), another of dpd.integrators, an object of a class "
        "derived from dpd.integrators.Integrator"
    )
    check_part(system.integrator, (Integrator,), "integrator", wanted)


def check_fluid(fluid):
    """Raise TypeError, with what to give, for what is no fluid."""
    if not isinstance(fluid, Fluid):
        cure = "give its .fluid" if hasattr(fluid, "fluid") else "build one with dpd.fluid(...)"
        raise TypeError(f"fluid is a {type(fluid).__name__}; {cure}")


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
        does = lambda yes: "rotate" if yes else "do not"
        what = f"beads of the fluid {does(fluid.rotating)} and those of the state {does(has)}"
        raise ValueError(f"{what}: make the state with this fluid")
    if has and is_concrete(state.species):
        rotating = np.isin(np.asarray(state.species), fluid.rotating)
        if not np.all(rotating[state.rotation.slots]) or rotating.sum() != state.rotation.m:
            raise ValueError(
                "the beads of the state that rotate are of other species: make the state with this "
                "fluid"
            )


def check_bonds(fluid, state):
    """Refuse a state whose bonds are of other types than those of the fluid, or where the energy of
    one is not finite."""
    has = {} if state.topology is None else state.topology.beads
    wanted = {b.name: b for b in fluid.bonded}
    if set(has) != set(wanted):
        told = lambda names: ", ".join(map(repr, names)) or "none"
        raise ValueError(
            f"the fluid has bonds of the types {told(wanted)}, the state of {told(has)}: give the "
            "state those of the fluid, state.bonded({name: ids, ...})"
        )
    for name, b in wanted.items():
        if has[name].shape[-1] != BEADS[b.kind]:
            raise ValueError(
                f"{name!r} is a type of {b.kind}, of {BEADS[b.kind]} beads, and the state has "
                f"{has[name].shape[-1]} in each"
            )
    if is_concrete(fluid, state.position, state.box) and not fluid.is_batch:
        with jax.ensure_compile_time_eval():
            for b in fluid.bonded:
                _check_energies(fluid, state, b)


def _check_energies(fluid, state, b):
    """Refuse a start at which a bond has no finite energy or force."""
    q, energy, slope = map(np.asarray, measured(fluid, state, b))
    wrong = np.flatnonzero(~(np.isfinite(energy) & np.isfinite(slope)))
    if wrong.size:
        k = int(wrong[0])
        what = "is {:.4g} long" if b.kind == "bond" else "has a cosine of {:.4g}"
        ids = np.asarray(state.topology.beads[b.name])[k].tolist()
        raise ValueError(
            f"{b.name!r} {k}, of the beads {ids}, {what.format(q[k])}, where its energy is "
            f"{energy[k]:.4g}: start with beads closer together, or another law"
        )


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


def check_dt(system: System, state):
    """Refuse a time step at which drag, repulsion, lubrication or contacts would overshoot, and
    name the member it is of."""
    if not is_concrete(system, state.box.lengths, state.species, state.size):
        return
    counts = np.bincount(np.asarray(state.species), minlength=system.fluid.species)
    density = counts / float(np.prod(np.asarray(state.box.lengths)))
    sizes = float(np.min(np.asarray(state.size))), float(np.max(np.asarray(state.size)))
    told = _too_large(system, density, sizes)
    if told is None:
        return
    for member in range(max(system.lengths(), default=0)):
        of_member = _too_large(system.member(member), density, sizes)
        if of_member is not None:
            raise ValueError(f"{system.named(member)}: {of_member}")
    raise ValueError(told)


def _too_large(system: System, density, sizes):
    """What a time step is too large for, and the cure; None where it is not."""
    largest = float(np.max(np.asarray(system.dt)))
    for what, limit in system.integrator.dt_limits(system.fluid, density, sizes):
        if largest > limit:
            suits = advice.suggest_dt(system.fluid, density, sizes, integrator=system.integrator)
            return (
                f"dt {largest:.4g} is too large for the {what}, which allows {limit:.2g}; "
                f"use dt = {suits:.2g} (right to 0.5 %)"
                f"{_another(system, largest, density, sizes)}"
            )
    return None


def _another(system: System, dt, density, sizes) -> str:
    """The integrator that a time step suits, in place of one that it does not."""
    other = cheapest(system.fluid, density, sizes)
    suits = advice.suggest_dt(system.fluid, density, sizes, integrator=other)
    return f", or integrator=dpd.integrators.{other}" if dt <= suits * (1 + 1e-6) else ""


def list_trouble(fluid, state):
    """Bits for lists that overflowed, that are too short for the laws, or too wide for the box."""
    trouble = jnp.zeros((), jnp.uint32)
    radius = radii(fluid, state)
    for interaction, neighbours in interactions_of(fluid, state):
        code = neighbours.list.error.code
        grid = neighbours.grid
        told = {
            lists.PAIRS: bits.PAIRS_OVERFLOW,
            lists.WINDOWS: bits.WINDOW_OVERFLOW,
            sum(lists.NARROW): bits.NARROW_CELLS,
            lists.SHORT: bits.BOX_TOO_SMALL,
        }
        for wrong, bit in told.items():
            trouble |= bits.flag((code & wrong) > 0, bit)
        largest = [jnp.max(radius[begin:end]) for begin, end in grid.groups]
        reach = jnp.stack([jnp.max(r) for r in interaction.reaches(*largest, fluid.kT)])
        trouble |= bits.flag(jnp.any(reach > grid.reach * (1 + 1e-5)), bits.REACH_EXCEEDED)
        is_short = (grid.misfit(state.box) & lists.SHORT) > 0
        trouble |= bits.flag(is_short, bits.BOX_TOO_SMALL)
    return trouble
