"""GSD files: frames of beads that HOOMD-blue, freud, MDAnalysis and OVITO open, with what was
recorded of each."""

import contextlib
import dataclasses
import json
import os
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from dpdjax.engine.flow import Flow
from dpdjax.engine.observables import rotations
from dpdjax.engine.state import State
from dpdjax.engine.trajectory import Trajectory
from dpdjax.errors import FileError
from dpdjax.files.states import refuse_existing
from dpdjax.model.beads import inertias, masses, radii
from dpdjax.model.colloids import solvent_reach
from dpdjax.model.fluid import Fluid

DRAWN_RADIUS = 0.5
"""Radius of beads that are points, for drawing alone, over the reach of those of the first species.
"""
OF_BEADS = ("position", "velocity", "image")
RECORDED = (*OF_BEADS, "strain")
TURNING = ("orientation", "angular_velocity")
"""Recorded too where beads rotate."""
BEADS = "beads/"
"""What the names begin with under which a run that writes a file records its beads, beside what it
was told to observe."""
OWN, ABOUT = "dpdjax/", "dpdjax/about"
"""What the names begin with under which a file logs what a run recorded; and under which its first
frame says what made it."""
THERMO = "md/compute/ThermodynamicQuantities/"
UPPER = np.triu_indices(3)


@dataclasses.dataclass(frozen=True)
class GSD:
    """The file that a run writes, ``dpd.run(..., out=dpd.GSD("run.gsd", mode="w"))``.

    Attributes:
        path: file name.
        mode: ``"x"`` for a new file, ``"w"`` to replace one, ``"a"`` to go on with one of the same
            beads, or begin it.
        species: the only one whose beads are written, such as 1 for colloids alone; all by default.
        about: what else the first frame is to tell, that JSON holds.
    """

    path: str | os.PathLike
    mode: str = "x"
    species: int | None = None
    about: dict[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        if self.mode not in ("x", "w", "a"):
            raise ValueError(
                f'mode is {self.mode!r}; it is "x" for a new file, "w" to replace one, "a" to go '
                "on with one"
            )

    @classmethod
    def of(cls, out) -> "GSD | None":
        """What ``out=`` of a run means: a file name, or one of these."""
        if out is None or isinstance(out, GSD):
            return out
        if not isinstance(out, str | os.PathLike):
            raise TypeError(f"out is {out!r}; give a file name, or dpd.GSD(...)")
        if not os.fspath(out).endswith(".gsd"):
            raise ValueError(
                f"out is {os.fspath(out)!r}; give the name of a GSD file, such as run.gsd"
            )
        return cls(out)


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


def beads_record(fluid: Fluid, state: State) -> dict:
    """:func:`gsd_record` under names of its own."""
    return {BEADS + name: values for name, values in gsd_record(fluid, state).items()}


@contextlib.contextmanager
def gsd_writer(
    path: str | os.PathLike,
    fluid: Fluid,
    state: State,
    mode: str = "x",
    *,
    species: int | None = None,
    about: dict | None = None,
) -> Iterator[Callable]:
    """Opens a GSD file; gives ``write(frames, flow)``, which appends the frames of a run that
    recorded :func:`gsd_record`.

    What was written is in the file when ``write`` returns: a process killed later loses nothing of
    it.

    Species are the types A, B, ... in turn: of a suspension A the solvent and B the colloids.
    Diameters, masses and the box with its tilt are written too; positions are centred, and
    velocities those of the lab where the flow is given. Images unwrap positions where the strain
    stays as it is. Beads that rotate have their orientation, moment of inertia and angular
    momentum, as HOOMD-blue means them; the others are not turned. Positions are in single
    precision.

    All else that was recorded is logged as ``dpdjax/...``, and temperature, pressure and potential
    energy also where HOOMD-blue logs them: ``gsd.hoomd.read_log(path)`` reads them all.

    Args:
        path: file name.
        fluid, state: what runs, and the state it starts from.
        mode: ``"x"`` for a new file, ``"w"`` to replace one, ``"r+"`` to go on with one.
        species: the only one whose beads are written; all by default.
        about: what the first frame of a new file is to say of the run.

    Raises ImportError where the package ``gsd`` is missing, FileExistsError by ``"x"`` for a file
    that is there, ValueError by ``"r+"`` for one of other beads or another box; FileError where the
    file cannot be written.
    """
    hoomd = hoomd_files()
    if mode == "x":
        refuse_existing(path, 'mode="w" to replace it, mode="r+" to go on with it')
    if mode == "r+":
        check_fits(path, fluid, state, species)
    beads = Beads.of(fluid, state, species)
    with writing(path), hoomd.open(str(path), mode) as file:

        def write(frames, flow=None):
            flow = None if flow is None else Flow.of(flow)
            with writing(path):
                if not len(file):
                    _tell(file, about, frames, state.n)
                file.extend(
                    beads.frame(hoomd.Frame(), frames, k, flow) for k in range(len(frames["step"]))
                )
                file.flush()

        yield write


@contextlib.contextmanager
def writing(path):
    """Errors of the system while a file is written, as FileError with the cure."""
    try:
        yield
    except FileExistsError:
        raise
    except OSError as error:
        if isinstance(error, FileError):
            raise
        raise FileError(
            f"{path} cannot be written: {error.strerror or error}; what it held before is kept. "
            "Make room or give another name"
        ) from error


def _tell(file, about, frames, n: int):
    """What made the file, and the shapes of what it logs, into its first frame."""
    shape_of = lambda values: list(np.shape(values)[1:])
    recorded = {name: shape_of(values) for name, values in _to_log(frames, n).items()}
    text = json.dumps({"recorded": recorded} | (about or {}))
    file.file.write_chunk(ABOUT, np.frombuffer(text.encode(), np.uint8))


def _to_log(frames, n: int) -> dict:
    """What of recorded frames is logged: all but the beads themselves."""
    is_whole = lambda name: name in OF_BEADS and np.shape(frames[name])[1] == n
    are_beads = lambda name: name.startswith(BEADS) or name in TURNING or is_whole(name)
    return {name: values for name, values in frames.items() if not are_beads(name)}


def hoomd_files():
    """The module ``gsd.hoomd``; ImportError with the cure where it is missing."""
    try:
        import gsd.hoomd
    except ImportError as error:
        raise ImportError("GSD files need the package gsd: pip install gsd") from error
    return gsd.hoomd


@contextlib.contextmanager
def reading(path):
    """A GSD file to read frames from; FileError for what is none."""
    if not isinstance(path, str | os.PathLike):
        raise TypeError(f"path is {path!r}; give a file name")
    hoomd = hoomd_files()
    try:
        file = hoomd.open(str(path), "r")
    except FileNotFoundError:
        raise
    except (RuntimeError, OSError) as error:
        raise FileError(f"{path} is no GSD file, or a damaged one: {error}") from error
    with file:
        yield file


def check_fits(path, fluid, state, species: int | None = None) -> int:
    """The last step in a file; raises ValueError unless that is of these beads in this box."""
    with reading(path) as file:
        last = file[-1] if len(file) else None
    if last is None:
        return 0
    beads, sides = Beads.of(fluid, state, species).same, np.asarray(state.box.lengths)
    same = all(
        np.array_equal(getattr(last.particles, name), beads[name])
        for name in ("N", "types", "typeid", "mass", "diameter")
    )
    if not same or not np.allclose(last.configuration.box[:3], sides, rtol=1e-6, atol=0):
        raise ValueError(
            f"{path} holds {last.particles.N} beads in a box of "
            f"{last.configuration.box[:3].tolist()}, other than the {beads['N']} in "
            f"{sides.tolist()} of this state; give another file"
        )
    return last.configuration.step


def check_follows(path, fluid, state, species: int | None = None) -> None:
    """Raise ValueError for a file that a run from this state does not go on with."""
    last = check_fits(path, fluid, state, species)
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


@dataclasses.dataclass(frozen=True)
class Beads:
    """What of the beads in a file does not change from frame to frame.

    Attributes:
        slots: of those that are written, among all.
        lengths: sides of the box.
        same: values by their names in a GSD file.
        spins: places of those that rotate among the written ones, and their moments of inertia.
    """

    slots: np.ndarray
    lengths: np.ndarray
    same: dict[str, Any]
    spins: tuple[np.ndarray, np.ndarray] | None

    @classmethod
    def of(cls, fluid, state, species: int | None = None) -> "Beads":
        """Those of a state, or of one species of it."""
        kinds = np.asarray(state.species)
        slots = np.arange(state.n) if species is None else np.flatnonzero(kinds == species)
        if not len(slots):
            there = np.unique(kinds).tolist()
            raise ValueError(f"no bead is of species {species}; there are {there}")
        radius = np.asarray(radii(fluid, state))
        drawn = np.where(radius > 0, radius, DRAWN_RADIUS * solvent_reach(fluid))
        same = {
            "N": len(slots),
            "types": [chr(ord("A") + k) for k in range(fluid.species)],
            "typeid": np.asarray(kinds[slots], np.uint32),
            "mass": np.asarray(masses(fluid, state), np.float32)[slots],
            "diameter": 2 * drawn.astype(np.float32)[slots],
        }
        spins = None
        if state.rotation is not None and np.isin(slots, np.r_[state.rotation.slots]).any():
            rotating = np.r_[state.rotation.slots]
            spins = np.searchsorted(slots, rotating), np.asarray(inertias(fluid, state))[:, None]
            same["moment_inertia"] = np.zeros((len(slots), 3), np.float32)
            same["moment_inertia"][spins[0]] = spins[1]
        return cls(slots, np.asarray(state.box.lengths, float), same, spins)

    def frame(self, frame, frames, k: int, flow):
        """A frame of a file, filled with the recorded one of number ``k``, in a box centred on the
        origin."""
        of = lambda name: np.array(frames.get(BEADS + name, frames.get(name))[k])
        strain, rate = float(of("strain")), 0.0
        if flow is not None:
            rate = float(flow.rate_at(frames["time"][k]))
        whole, velocity = of("position"), of("velocity").astype(float)[self.slots]
        position, columns = centred(whole.astype(float)[self.slots], self.lengths, strain)
        velocity[:, 0] += rate * position[:, 1]
        image = of("image").astype(np.int32)[self.slots]
        image[:, 0] += columns
        frame.configuration.step = int(frames["step"][k])
        frame.configuration.box = [*self.lengths, strain, 0.0, 0.0]
        moving = {"position": position, "velocity": velocity, "image": image}
        for name, value in (self.same | moving).items():
            setattr(frame.particles, name, value)
        if self.spins is not None:
            turned = (of(name).astype(float) for name in TURNING)
            both = _orientation_and_momentum(*turned, *self.spins, len(self.slots))
            frame.particles.orientation, frame.particles.angmom = both
        always = {f"{OWN}strain": np.array([strain]), f"{OWN}rate": np.array([rate])}
        frame.log = always | _logged(_to_log(frames, len(whole)), k)
        return frame


def centred(position, lengths, strain: float):
    """Positions (n, 3) that are wrapped along the axes, between the tilted faces of a box centred
    on the origin; and the images (n,) that takes along x."""
    columns = np.floor((position[:, 0] - strain * position[:, 1]) / lengths[0]).astype(np.int32)
    shift = np.stack([columns * lengths[0], *np.zeros((2, len(columns)))], axis=1)
    return position - shift - middle(lengths, strain), columns


def middle(lengths, strain: float) -> np.ndarray:
    """The middle of a tilted box whose corner is the origin."""
    return 0.5 * (lengths + np.array([strain * lengths[1], 0.0, 0.0]))


def _logged(frames, k: int) -> dict:
    """The values of a frame by the names in its log; of some also where HOOMD-blue logs them."""
    own = {name: np.asarray(values[k]) for name, values in frames.items()}
    found = {OWN + name: _as_log(value) for name, value in own.items()}
    for name, log in (("temperature", "kinetic_temperature"), ("potential_energy",) * 2):
        if name in own and own[name].ndim == 0:
            found[THERMO + log] = _as_log(own[name])
    pressure = own.get("pressure_tensor")
    if np.shape(pressure) == (3, 3):
        symmetric = 0.5 * (pressure + pressure.T)
        found[f"{THERMO}pressure_tensor"] = symmetric[UPPER]
        found[f"{THERMO}pressure"] = _as_log(np.trace(pressure) / 3)
    return found


def _as_log(value) -> np.ndarray:
    """A value as a log takes it: numbers, of one or two axes."""
    value = np.asarray(value)
    value = value.astype(np.uint8) if value.dtype == bool else value
    return value.reshape(len(value), -1) if value.ndim > 2 else np.atleast_1d(value)


def _orientation_and_momentum(orientation, velocity, slots, inertia, n: int):
    """Quaternions (n, 4) of orientation and of angular momentum: HOOMD's is ``2 q (0, L')``, L' in
    the axes of the body.

    In those of the lab, as here, it is ``2 (0, L) q``.
    """
    every, momentum = np.zeros((2, n, 4), np.float32)
    every[:, 0] = 1.0
    every[slots] = orientation
    L, w, v = inertia * velocity, orientation[:, :1], orientation[:, 1:]
    momentum[slots] = 2 * np.concatenate(
        [-np.sum(L * v, axis=1, keepdims=True), w * L + np.cross(L, v)], axis=1
    )
    return every, momentum


def angular_velocity(orientation, momentum, inertia):
    """The angular velocity (m, 3) that a quaternion of angular momentum means: ``p q* / 2 I``."""
    w, v = orientation[:, :1], -orientation[:, 1:]
    a, b = momentum[:, :1], momentum[:, 1:]
    return 0.5 * (a * v + w * b + np.cross(b, v)) / inertia
