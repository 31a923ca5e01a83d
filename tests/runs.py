"""Runs of every kind whose answers are known: random walks carried by a flow, and noise about the
right means.

A fluid of points and spheres that do not see each other, in a box of unequal sides. A point and a
sphere make a molecule, of which each goes its own way: the vector between them, that of nearest
images, is anywhere in the box.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import lfilter

import dpdjax as dpd
from dpdjax.engine.drivers import Drive
from dpdjax.engine.flow import Flow
from dpdjax.engine.system import System
from dpdjax.pairs.box import Box, wrap

VISCOSITY, STORAGE, LOSS = 0.85, 0.4, 2.55
DIFFUSION, ROTATION = 0.3, 0.05
FORCE, TORQUE = 2.0, 3.0
POINTS, SPHERES, RADIUS = 40, 40, 0.5
SIDES = np.array([6.0, 7.0, 5.0])
VOLUME = float(SIDES.prod())
DT, EVERY, FRAMES = 0.01, 5, 900
INTERVAL = DT * EVERY
RATE, AMPLITUDE, FREQUENCY = 0.4, 0.1, 3.0
WAVE_AMPLITUDE = 0.3
LIGHT = 1e-3
"""Mass and moment of inertia of beads that forget their velocities at once, as random walks do."""
MEMORY, MOTION = 0.1, 0.2
"""Times that the stress of a fluid at rest, and the velocities of its beads, are remembered [time].
"""

FLOWS = {
    "at rest": lambda number: Flow(),
    "sheared": lambda number: Flow.of(dpd.shear(RATE * number)),
    "oscillated": lambda number: Flow.of(dpd.oscillatory_shear(AMPLITUDE * number, FREQUENCY)),
    "pushed": lambda number: Flow.of(dpd.flows.sinusoidal_force(WAVE_AMPLITUDE * number, SIDES[1])),
    "driven": lambda number: Flow.of(dpd.drive(FORCE * number, TORQUE * number, species=1)),
}
"""Each kind of flow, of a strength relative to that of a single run."""
FORMS = ("one run", "started up", "batch", "scan", "short")
REPLICAS, SCAN = 3, (0.8, 1.0, 1.2)


@functools.cache
def made(flow: str, form: str):
    """A run under one of :data:`FLOWS` in one of :data:`FORMS`; a scan at rest is one over kT."""
    fluid, state = system()
    seed = 10 * list(FLOWS).index(flow) + 100 * FORMS.index(form)
    if form == "batch":
        members = [
            one(fluid, state, FLOWS[flow](1.0), seed=seed + k, count=FRAMES // REPLICAS)
            for k in range(REPLICAS)
        ]
        return joined(members, fluid, FLOWS[flow](1.0))
    if form == "scan":
        flows = [FLOWS[flow](number) for number in SCAN]
        members = [
            one(fluid, state, flow, seed=seed + k, count=FRAMES // REPLICAS)
            for k, flow in enumerate(flows)
        ]
        fluid = fluid.set(kT=jnp.array(SCAN)) if flow == "at rest" else fluid
        return joined(members, fluid, jax.tree.map(lambda *numbers: jnp.stack(numbers), *flows))
    return one(
        fluid,
        state,
        FLOWS[flow](1.0),
        seed=seed,
        count=6 if form == "short" else FRAMES,
        starts=form == "started up",
    )


@functools.cache
def system():
    fluid = dpd.fluid(
        [dpd.term(dpd.soft_repulsion, a=jnp.zeros((2, 2)), r_c=1.0)],
        [dpd.term(dpd.central_drag, gamma=jnp.ones((2, 2)), r_c=1.0, projector="full")],
        kT=1.0,
        mass=[LIGHT, LIGHT],
        radius=[None, RADIUS],
        inertia=[None, LIGHT],
    )
    state = dpd.initial_state(fluid, jax.random.key(0), box=SIDES, n=[POINTS, SPHERES], dt=DT)
    pairs = np.arange(POINTS)[:, None] + [0, POINTS]
    return fluid, state.bonded({"pair": pairs})


def joined(members, fluid, flow):
    """A batch of runs."""
    stack = lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves])
    final, frames = (
        jax.tree.map(stack, *[getattr(m, name) for m in members]) for name in ("final", "frames")
    )
    frames = {name: np.asarray(values) for name, values in frames.items()}
    how = System.of(fluid, DT, flow)
    return dataclasses.replace(members[0], final=final, frames=frames, system=how)


def one(fluid, state, flow, *, seed: int, count: int, starts: bool = False):
    """A single run; ``starts``: it begins far from where it settles."""
    rng = np.random.default_rng(seed)
    time = INTERVAL * np.arange(1, count + 1)
    late = 1.0 + (2.0 * np.exp(-5.0 * np.arange(count) / count) if starts else np.zeros(count))
    frames = {"time": time, "step": EVERY * np.arange(1, count + 1)}
    frames["temperature"] = late * (1.0 + 0.01 * rng.normal(size=count))
    frames["potential_energy"] = 30.0 * late + rng.normal(size=count)
    frames |= (
        stresses(rng, flow, time, late) | places(rng, state, flow, time) | turns(rng, flow, count)
    )
    return dpd.Trajectory(state, frames, System.of(fluid, DT, flow), EVERY)


def stresses(rng, flow, time, late):
    """What viscosities and moduli are read from."""
    count = len(time)
    stress = tensors(0.3 * rng.normal(size=(count, 3, 3)))
    if flow.deformation.frequency is not None:
        due = (
            AMPLITUDE
            * (STORAGE * np.sin(FREQUENCY * time) + LOSS * np.cos(FREQUENCY * time))
            * late
        )
    else:
        due = VISCOSITY * float(flow.rate) * late
    stress[:, 0, 1] -= due
    # A stress that fades as exp(-t / MEMORY) about its mean, and the rest of the viscosity without
    # delay.
    kept = np.exp(-INTERVAL / MEMORY)
    variance = 0.5 * VISCOSITY / VOLUME / (0.5 * INTERVAL * (1 + kept) / (1 - kept))
    noise = tensors(np.sqrt(variance * (1 - kept**2)) * rng.normal(size=(count + 200, 3, 3)))
    flux = lfilter([1.0], [1.0, -kept], noise, axis=0)[200:]
    jumps = tensors(np.sqrt(2 * VISCOSITY * INTERVAL / VOLUME) * rng.normal(size=(count, 3, 3)))
    # Members of a scan keep the mean wave: they are to be refused before it is looked at.
    wave = (POINTS + SPHERES) / VOLUME * WAVE_AMPLITUDE / (VISCOSITY * (2 * np.pi / SIDES[1]) ** 2)
    return {
        "pressure_tensor": stress,
        "pressure_random": tensors(0.1 * rng.normal(size=(count, 3, 3))),
        "flux": flux,
        "reversed_flux": flux,
        "instantaneous_viscosity": np.full(count, 0.5 * VISCOSITY),
        "flux_integral": jumps,
        "wave_velocity": wave * late + 0.02 * rng.normal(size=count),
    }


def tensors(numbers):
    """Symmetric traceless tensors of which each off-diagonal has the spread of the numbers, as in
    an isotropic fluid."""
    symmetric = (numbers + np.swapaxes(numbers, -1, -2)) / np.sqrt(2)
    trace = np.trace(symmetric, axis1=-2, axis2=-1)[..., None, None]
    return symmetric - trace * np.eye(3) / 3


def places(rng, state, flow, time):
    """Random walks of points thrown at random, carried along by the flow, and velocities that add
    up to their diffusion."""
    count, n = len(time), POINTS + SPHERES
    fine = 4
    steps = np.sqrt(2 * DIFFUSION * INTERVAL / fine) * rng.normal(size=(count * fine, n, 3))
    if flow.driver(Drive) is not None:
        share = SPHERES / n
        driven = np.asarray(state.species) == 1
        steps[..., 0] += DIFFUSION * FORCE * INTERVAL / fine * (driven - share) / (1 - share)
    path = SIDES * rng.random((n, 3)) + np.cumsum(steps, axis=0)
    moments = INTERVAL / fine * np.arange(1, count * fine + 1)
    strain = np.broadcast_to(tilt(flow, moments), moments.shape)
    carried = np.diff(strain, prepend=0.0)[:, None] * (path[..., 1] - 0.5 * steps[..., 1])
    path[..., 0] += np.cumsum(carried, axis=0)
    path, strain = path[fine - 1 :: fine], strain[fine - 1 :: fine]
    period = SIDES[0] / SIDES[1]
    strain = strain - period * np.round(strain / period)
    position, image = jax.vmap(lambda s, x: wrap(Box(jnp.asarray(SIDES), s), x))(
        jnp.asarray(strain), jnp.asarray(path)
    )
    velocity = remembering(rng, DIFFUSION, (count, n, 3))
    return {
        "position": np.asarray(position),
        "unwrapped": path,
        "image": np.asarray(image),
        "velocity": velocity,
        "strain": strain,
    }


def remembering(rng, diffusion, shape):
    """Velocities (frames, ...) that fade as exp(-t / MOTION) and whose memory adds up, frame by
    frame, to a diffusion."""
    kept = np.exp(-INTERVAL / MOTION)
    spread = np.sqrt(2 * diffusion / INTERVAL * (1 - kept) / (1 + kept) * (1 - kept**2))
    return lfilter(
        [1.0], [1.0, -kept], spread * rng.normal(size=(shape[0] + 200, *shape[1:])), axis=0
    )[200:]


def tilt(flow, time):
    """The strain at a time."""
    return (
        AMPLITUDE * np.sin(FREQUENCY * time)
        if flow.deformation.frequency is not None
        else float(flow.rate) * time
    )


def turns(rng, flow, count):
    """Random turns of the spheres."""
    omega = remembering(rng, ROTATION, (count, SPHERES, 3))
    if flow.driver(Drive) is not None:
        omega[..., 0] += ROTATION * TORQUE
    half = 0.5 * INTERVAL * omega
    angle = np.linalg.norm(half, axis=-1, keepdims=True)
    turn = np.concatenate([np.cos(angle), half * np.sinc(angle / np.pi)], axis=-1)
    orientation, now = np.empty((count, SPHERES, 4)), rng.normal(size=(SPHERES, 4))
    for k in range(count):
        now = product(turn[k], now)
        now = now / np.linalg.norm(now, axis=-1, keepdims=True)
        orientation[k] = now
    return {"angular_velocity": omega, "orientation": orientation, "torque": np.zeros_like(omega)}


def product(p, q):
    """Of quaternions (..., 4)."""
    w = p[..., :1] * q[..., :1] - np.sum(p[..., 1:] * q[..., 1:], axis=-1, keepdims=True)
    return np.concatenate(
        [w, p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:] + np.cross(p[..., 1:], q[..., 1:])],
        axis=-1,
    )
