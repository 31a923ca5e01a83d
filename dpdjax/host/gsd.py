"""GSD files: frames of beads that HOOMD-blue, freud and OVITO open."""

import contextlib
import os
from collections.abc import Callable, Iterator

import jax
import numpy as np
from jax.typing import ArrayLike

from dpdjax.checks import prng_key
from dpdjax.engine.flow import Driving, Flow
from dpdjax.engine.integrator import Integrator
from dpdjax.engine.observables import rotations, standard
from dpdjax.engine.refusals import check_kinds, check_plan, check_run
from dpdjax.engine.state import State
from dpdjax.engine.system import System
from dpdjax.engine.trajectory import Plan, Trajectory
from dpdjax.host.io import refuse_existing
from dpdjax.host.progress import Progress
from dpdjax.host.run import collected
from dpdjax.host.stream import Job, Piece, chunk_frames
from dpdjax.model.beads import inertias, masses, radii
from dpdjax.model.colloids import solvent_reach
from dpdjax.model.fluid import Fluid

DRAWN_RADIUS = 0.5
"""Radius of beads that are points, for drawing alone, over the reach of those of the first species.
"""
RECORDED = ("position", "velocity", "image", "strain")
TURNING = ("orientation", "angular_velocity")
"""Recorded too where beads rotate."""


def gsd_record(fluid: Fluid, state: State) -> dict:
    """What a frame of a GSD file holds; give it to ``observe=``."""
    beads = {
        "position": state.position,
        "velocity": state.velocity,
        "image": state.image,
        "strain": state.box.strain,
    }
    if state.rotation is None:
        return beads
    rotation = rotations(fluid, state)
    return beads | {name: rotation[name] for name in TURNING}


@contextlib.contextmanager
def gsd_writer(
    path: str | os.PathLike, fluid: Fluid, state: State, mode: str = "x"
) -> Iterator[Callable]:
    """Opens a GSD file; gives ``write(frames, flow)``, which appends the frames of a run that
    recorded :func:`gsd_record`.

    What was written is in the file when ``write`` returns: a process killed later loses nothing of
    it.

    Species are the types A, B, ... in turn: of a suspension A the solvent and B the colloids.
    Diameters, masses and the box with its tilt are written too; positions are centred, and
    velocities those of the lab where the flow is given. Images unwrap positions where the strain
    stays as it is. Beads that rotate have their orientation, moment of inertia and angular
    momentum, as HOOMD-blue means them; the others are not turned.

    Args:
        path: file name.
        fluid, state: what runs, and the state it starts from.
        mode: ``"x"`` for a new file, ``"w"`` to replace one, ``"r+"`` to go on with one.

    Raises ImportError where the package ``gsd`` is missing, FileExistsError by ``"x"`` for a file
    that is there, ValueError by ``"r+"`` for one of other beads or another box.
    """
    hoomd = _hoomd()
    if mode == "x":
        refuse_existing(path, 'mode="w" to replace it, mode="r+" to go on with it')
    if mode == "r+":
        _check_fits(path, fluid, state)
    template = _beads(fluid, state)
    with hoomd.open(str(path), mode) as file:

        def write(frames, flow=None):
            flow = None if flow is None else Flow.of(flow)
            file.extend(
                _frame(hoomd.Frame(), template, state, frames, k, flow)
                for k in range(len(frames["step"]))
            )
            file.flush()

        yield write


def _hoomd():
    try:
        import gsd.hoomd
    except ImportError as error:
        raise ImportError("GSD files need the package gsd: pip install gsd") from error
    return gsd.hoomd


def _mode(path, overwrite: bool, append: bool) -> str:
    """How to open a file, by what the caller wants done with one that is there."""
    if overwrite and append:
        raise ValueError("overwrite=True and append=True: give one of them")
    if not overwrite and not append:
        refuse_existing(path, "overwrite=True to replace it, append=True to go on with it")
    return "r+" if append and os.path.exists(path) else "w"


def _check_fits(path, fluid, state) -> int:
    """The last step in a file; raises ValueError unless that is of these beads in this box."""
    with _hoomd().open(str(path), "r") as file:
        last = file[-1] if len(file) else None
    if last is None:
        return 0
    beads, sides = _beads(fluid, state), np.asarray(state.box.lengths)
    same = all(
        np.array_equal(getattr(last.particles, name), beads[name])
        for name in ("N", "types", "typeid", "mass", "diameter")
    )
    if not same or not np.allclose(last.configuration.box[:3], sides, rtol=1e-6, atol=0):
        raise ValueError(
            f"{path} holds {last.particles.N} beads in a box of "
            f"{last.configuration.box[:3].tolist()}, other than the {state.n} in {sides.tolist()} "
            "of this state; give another file"
        )
    return last.configuration.step


def _check_follows(path, fluid, state) -> None:
    """Raise ValueError for a file that a run from this state does not go on with."""
    last = _check_fits(path, fluid, state)
    if last > int(state.step):
        raise ValueError(
            f"{path} ends at step {last} and the state is at step {int(state.step)}: "
            "go on from the final state of that run, or give another file"
        )


def write_gsd(path: str | os.PathLike, trajectory: Trajectory, *, overwrite: bool = False) -> None:
    """Writes the frames of one run, recorded with ``observe=dpd.observe.gsd_record``, to a new GSD
    file.

    Raises ValueError for a batch or a run that recorded something else, FileExistsError for a file
    that is there, which ``overwrite=True`` replaces.
    """
    if trajectory.is_batch:
        raise ValueError(
            "a GSD file holds one run; write the members of a batch one by one, "
            "trajectory.members()"
        )
    wanted = RECORDED if trajectory.final.rotation is None else RECORDED + TURNING
    missing = set(wanted) - set(trajectory.frames)
    if missing:
        raise ValueError(
            f"the run recorded no {', '.join(sorted(missing))}; use observe=dpd.observe.gsd_record"
        )
    if not overwrite:
        refuse_existing(path, "overwrite=True to replace it")
    with gsd_writer(path, trajectory.fluid, trajectory.final, "w") as write:
        write(trajectory.frames, trajectory.flow)


def run_to_gsd(
    path: str | os.PathLike,
    fluid: Fluid,
    state: State,
    key: jax.Array,
    dt: ArrayLike,
    plan: Plan,
    flow: Driving = None,
    *,
    piece: int = 10,
    overwrite: bool = False,
    append: bool = False,
    integrator: Integrator | None = None,
    progress: bool = True,
) -> Trajectory:
    """:func:`dpdjax.run` with its frames written to a GSD file as they come, ``piece`` at a time or
    fewer.

    Returns the trajectory with the standard record, and how beads that rotate are turned; positions
    are in the file alone, so that long runs fit in memory. Ctrl-C ends it early, with all whole
    pieces in the file; a process that is killed leaves them too. A file that is there is refused,
    or replaced by ``overwrite=True``, or gone on with by ``append=True``.

    Raises FileExistsError for a file that is there, ValueError for a batch or a file to append to
    that does not fit, and as :func:`dpdjax.run` does; a file of that name is then left as it was.
    """
    system = System.of(fluid, dt, flow, integrator)
    check_kinds(system, state)
    if prng_key(key).ndim or state.position.ndim == 3 or system.is_batch:
        raise ValueError(
            "a GSD file holds one run; run the batch with observe=dpd.observe.gsd_record and write "
            "its members by write_gsd"
        )
    with contextlib.ExitStack() as stack:
        line = stack.enter_context(Progress(plan, progress))
        check_plan(plan)
        check_run(system, state, key)
        mode, write = _mode(path, overwrite, append), None
        if mode == "r+":
            _check_follows(path, fluid, state)
        job = Job.of(system, state, key, plan, [standard, gsd_record], stacklevel=2)

        def written(part: Piece) -> dict:
            nonlocal write
            # Opened when there is something to write: a run that ends at once leaves an old file as
            # it was.
            if write is None:
                write = stack.enter_context(gsd_writer(path, fluid, state, mode))
            write(part.frames, system.flow)
            return {name: v for name, v in part.frames.items() if name not in RECORDED}

        return collected(job, line, min(max(1, piece), chunk_frames(plan, state.n)), written)


def _beads(fluid, state) -> dict:
    """What does not change from frame to frame."""
    radius = np.asarray(radii(fluid, state))
    beads = {
        "N": state.n,
        "types": [chr(ord("A") + k) for k in range(fluid.species)],
        "typeid": np.asarray(state.species, np.uint32),
        "mass": np.asarray(masses(fluid, state), np.float32),
        "diameter": 2
        * np.where(radius > 0, radius, DRAWN_RADIUS * solvent_reach(fluid)).astype(np.float32),
    }
    if state.rotation is not None:
        beads["moment_inertia"] = np.zeros((state.n, 3), np.float32)
        beads["moment_inertia"][state.rotation.slots] = np.asarray(inertias(fluid, state))[:, None]
    return beads


def _frame(frame, beads, state, frames, k, flow):
    """One frame, in a box centred on the origin."""
    lengths, strain = np.asarray(state.box.lengths, float), float(frames["strain"][k])
    position = np.array(frames["position"][k], float)
    # Positions are wrapped along x, a file wants them between the tilted faces.
    columns = np.floor((position[:, 0] - strain * position[:, 1]) / lengths[0])
    position[:, 0] -= columns * lengths[0]
    position -= 0.5 * (lengths + np.array([strain * lengths[1], 0.0, 0.0]))
    velocity = np.array(frames["velocity"][k], float)
    if flow is not None:
        velocity[:, 0] += float(flow.rate_at(frames["time"][k])) * position[:, 1]
    frame.configuration.step = int(frames["step"][k])
    frame.configuration.box = [*lengths, strain, 0.0, 0.0]
    for name, value in beads.items():
        setattr(frame.particles, name, value)
    frame.particles.position = position.astype(np.float32)
    frame.particles.velocity = velocity.astype(np.float32)
    frame.particles.image = np.asarray(frames["image"][k], np.int32) + np.array(
        [[1, 0, 0]]
    ) * columns[:, None].astype(np.int32)
    if state.rotation is not None:
        orientation, velocity = (np.asarray(frames[name][k], float) for name in TURNING)
        both = _orientation_and_momentum(
            orientation, velocity, state.rotation.slots, beads["moment_inertia"]
        )
        frame.particles.orientation, frame.particles.angmom = both
    return frame


def _orientation_and_momentum(orientation, velocity, slots, inertia):
    """Quaternions (n, 4) of orientation and of angular momentum: HOOMD's is ``2 q (0, L')``, L' in
    the axes of the body.

    In those of the lab, as here, it is ``2 (0, L) q``.
    """
    every, momentum = np.zeros((2, len(inertia), 4), np.float32)
    every[:, 0] = 1.0
    every[slots] = orientation
    L, w, v = inertia[slots] * velocity, orientation[:, :1], orientation[:, 1:]
    momentum[slots] = 2 * np.concatenate(
        [-np.sum(L * v, axis=1, keepdims=True), w * L + np.cross(L, v)], axis=1
    )
    return every, momentum
