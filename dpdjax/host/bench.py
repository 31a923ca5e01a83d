"""How fast this machine runs a fluid: the first thing to ask of a new one."""

import resource
import statistics
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.checks import positive, whole
from dpdjax.engine import order
from dpdjax.engine.integrator import Integrator
from dpdjax.engine.simulate import simulate
from dpdjax.engine.state import State
from dpdjax.engine.trajectory import Plan
from dpdjax.host.run import run
from dpdjax.model.advice import suggest_dt
from dpdjax.model.fluid import Fluid
from dpdjax.pairs import neighbours as lists
from dpdjax.prepare.start import initial_state
from dpdjax.xla import each_member

SETTLE = 400
"""Steps from a random start to a fluid whose lists last as long as they will."""
LARGEST_SETTLE, LONGEST = 100_000_000, 50_000_000
"""Particle-steps at which the settling and a timed run of a large box are cut short."""


def bench(
    fluid: Fluid | None,
    key: jax.Array | None,
    *,
    beads: int,
    dt: float | None,
    density: float = 3.0,
    batch: int = 1,
    skin: float | None = None,
    steps: int | None = None,
    repeats: int = 5,
    tangent: str | bool | None = False,
    integrator: Integrator | None = None,
) -> dict:
    """Measure the speed of plain runs of a cubic box, or of a batch as ``dpd.run`` would run it.

    Args:
        fluid: what runs; its ``gamma`` is what a tangent is taken of.
        key: a PRNG key.
        beads: beads of one box.
        dt: time step [time].
        density: beads per volume.
        batch: boxes side by side.
        skin: margin of the lists [length]; by default :func:`dpdjax.theory.suggest_skin`.
        steps: steps of one timed run, even; by default 200, fewer in large boxes.
        repeats: timed runs; medians are returned.
        tangent: time the forward derivative with respect to gamma too.
        integrator: what moves it; by default velocity-Verlet.

    Returns a dict of ``particle_steps_per_second``, ``rebuild_seconds``, ``steps_per_rebuild``,
    ``compile_seconds``, ``peak_memory_bytes`` (of the device; of the process on a CPU),
    ``device`` and what was run; with ``tangent``, ``tangent_over_primal`` too. Raises ValueError
    for numbers that cannot be.

    Example:
        >>> speed = dpd.bench(water, key, beads=192, dt=0.01, steps=10, repeats=1)
        >>> speed["particle_steps_per_second"] > 1e3, speed["beads"]
        (True, 192)
    """
    counts = {"beads": beads, "batch": batch, "repeats": repeats}
    beads, batch, repeats = (whole(value, name) for name, value in counts.items())
    positive(density, "density")
    if steps is not None:
        whole(steps, "steps")
    steps = _even(max(10, min(200, LONGEST / (beads * batch))) if steps is None else steps)
    state, keys = _settled(fluid, key, beads, density, batch, skin, dt, integrator)
    plain = _Program(_plain(dt, steps, integrator), fluid, state, keys)
    seconds = plain.seconds(repeats)
    result = {
        "particle_steps_per_second": beads * batch * steps / seconds,
        "rebuild_seconds": _rebuild_seconds(state, keys, repeats),
        "steps_per_rebuild": _steps_per_rebuild(fluid, state, keys, dt, max(20, steps), integrator),
        "compile_seconds": plain.compile_seconds,
        "peak_memory_bytes": peak_memory(),
        "device": jax.devices()[0].device_kind,
        "beads": beads,
        "batch": batch,
        "dt": float(dt),
        "skin": state.neighbours[0].grid.skin,
        "list_pairs": int(
            np.max(np.sum(np.asarray(state.neighbours[0].list.idx[..., 0, :]) < beads, axis=-1))
        ),
    }
    if tangent:
        result["tangent_over_primal"] = (
            _Program(_tangent(dt, steps, integrator), fluid, state, keys).seconds(repeats) / seconds
        )
    return result


def peak_memory() -> int:
    """Most bytes held so far on the device, or by the process where the device does not count."""
    counted = jax.devices()[0].memory_stats()
    if counted and "peak_bytes_in_use" in counted:
        return int(counted["peak_bytes_in_use"])
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


class _Program:
    """A compiled function of (fluid, state, keys), and how long that took."""

    def __init__(self, function, *arguments):
        began = time.perf_counter()
        self.compiled = jax.jit(function).lower(*arguments).compile()
        self.compile_seconds = time.perf_counter() - began
        self.arguments = arguments

    def seconds(self, repeats) -> float:
        """Median duration of a call, one call to warm up left out."""
        return statistics.median(
            [_duration(self.compiled, *self.arguments) for _ in range(repeats + 1)][1:]
        )


def _duration(function, *arguments) -> float:
    began = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    return time.perf_counter() - began


def _settled(fluid, key, beads, density, batch, skin, dt, integrator) -> tuple[State, jax.Array]:
    """Boxes whose beads move as they will; one box, unbatched, for a batch of 1."""
    side = (beads / density) ** (1 / 3)
    start = lambda k: initial_state(fluid, k, box=side, n=beads, skin=skin, dt=dt, sheared=False)
    keys = key if batch == 1 else jax.random.split(key, batch)
    state = start(keys) if batch == 1 else jax.vmap(start)(keys)
    coarse = max(float(dt), suggest_dt(fluid, density, integrator=integrator))
    steps = min(SETTLE, LARGEST_SETTLE / (beads * batch))
    go = lambda state, dt, plan: (
        run(fluid, state, keys, dt, plan, integrator=integrator, progress=False).final
    )
    state = go(state, coarse, Plan(max(2, int(steps / 5)), 5)).restarted()
    # So that the force at the start is no part of what is timed.
    return go(state, dt, Plan(2, 1)), keys


def _even(steps) -> int:
    """The nearest even number of at least 2."""
    return max(2, 2 * round(steps / 2))


def _boxes(function, keys):
    """``function(state, key)`` for one box or for each of a batch."""
    return function if not keys.ndim else each_member(function)


def _plain(dt, steps, integrator):
    plan = Plan(2, steps // 2)

    def program(fluid, state, keys):
        once = lambda s, k: simulate(fluid, s, k, dt, plan, integrator=integrator).final
        return _boxes(once, keys)(state, keys)

    return program


def _tangent(dt, steps, integrator):
    primal = _plain(dt, steps, integrator)

    def program(fluid, state, keys):
        velocity = lambda gamma: primal(fluid.set(gamma=gamma), state, keys).velocity
        gamma = fluid.value("gamma")
        return jax.jvp(velocity, (gamma,), (jnp.ones_like(gamma),))

    return program


def _rebuild_seconds(state, keys, repeats) -> float:
    grid = state.neighbours[0].grid
    build = lambda state, _: (
        lists.allocate(grid, state.box, state.position, order.list_ids(state)).list.idx
    )
    sort = jax.jit(_boxes(lambda state, _: order.in_cell_order(state), keys))
    return _Program(_boxes(build, keys), sort(state, keys), keys).seconds(repeats)


def _steps_per_rebuild(fluid, state, keys, dt, steps, integrator) -> float:
    """Steps over the number of them in which a list was built, as its reference positions tell."""
    anchor = lambda fluid, state: {"anchor": state.neighbours[0].list.reference_position[0]}
    how = dict(observe=anchor, integrator=integrator, progress=False)
    frames = run(fluid, state, keys, dt, Plan(steps, 1), **how).frames["anchor"]
    frames = np.reshape(frames, (-1, steps, 3))
    built = np.any(frames[:, 1:] != frames[:, :-1], axis=-1).sum(axis=-1)
    return float(steps / max(1.0, built.mean()))
