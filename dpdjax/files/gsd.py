"""GSD files: frames of beads that HOOMD-blue, freud, MDAnalysis and OVITO open, with what was
recorded of each."""

import contextlib
import dataclasses
import json
import os
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from dpdjax.checks import file_name
from dpdjax.engine.flow import Flow
from dpdjax.engine.observables import positions, rotations
from dpdjax.engine.record import Recorder
from dpdjax.engine.state import State
from dpdjax.engine.trajectory import Trajectory
from dpdjax.errors import FileError
from dpdjax.files import molecules
from dpdjax.files.states import refuse_existing
from dpdjax.model.beads import inertias, masses, radii
from dpdjax.model.colloids import solvent_reach
from dpdjax.model.fluid import Fluid

DRAWN_RADIUS = 0.5
"""Radius of beads that are points, for drawing alone, over the reach of those of the first species.
"""
OF_BEADS = ("position", "velocity", "image")
DERIVED = {positions: (*OF_BEADS, "strain", "lengths", "unwrapped")}
"""What observables record that is told by the beads of a file, and not logged beside them."""
RECORDED = (*OF_BEADS, "strain", "lengths")
TURNING = ("orientation", "angular_velocity")
"""Recorded too where beads rotate."""
BEADS = "beads/"
"""What the names begin with under which a run that writes a file records its beads, beside what it
was told to observe."""
OWN, FILES, ABOUT = "dpdjax/", "dpdjax/file/", "dpdjax/about"
"""What the names begin with under which a file logs what a run recorded, and what it tells of its
own; and under which the first frame of a run says what made it."""
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

    Example:
        >>> file = dpd.GSD("water.gsd", mode="w", about={"sample": "water"})
        >>> ran = dpd.run(water, state, key, 0.01, dpd.Plan(40, 5), observe=seen, out=file, **quiet)
        >>> ran.frames["position"].shape  # read from the file when asked for
        (40, 192, 3)
        >>> dpd.load_gsd("water.gsd", frame=0, fluid=water).n
        192
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
        file_name(out, "out", "give a file name, or dpd.GSD(...)")
        if not os.fspath(out).endswith(".gsd"):
            raise ValueError(
                f"out is {os.fspath(out)!r}; give the name of a GSD file, such as run.gsd"
            )
        return cls(out)


def gsd_record(fluid: Fluid, state: State) -> dict:
    """What a frame of a GSD file holds; give it to ``observe=``.

    ``position``, ``velocity`` and ``image`` (n, 3), the sides of the box ``lengths`` (3,) and its
    ``strain``; of beads that rotate ``orientation`` (m, 4) and ``angular_velocity`` (m, 3) too.

    Example:
        >>> recorded = dpd.observe.gsd_record(water, state)
        >>> sorted(recorded)
        ['image', 'lengths', 'position', 'strain', 'velocity']
    """
    beads = {
        "position": state.position,
        "velocity": state.velocity,
        "image": state.image,
        "strain": state.box.strain,
        "lengths": state.box.lengths,
    }
    if state.rotation is None:
        return beads
    rotation = rotations(fluid, state)
    return beads | {name: rotation[name] for name in TURNING}


def beads_record(fluid: Fluid, state: State) -> dict:
    """:func:`gsd_record` under names of its own."""
    return {BEADS + name: values for name, values in gsd_record(fluid, state).items()}


DERIVED[gsd_record] = (*RECORDED, *TURNING)


def derived(how: Iterable[Recorder]) -> set[str]:
    """Names of what recorders record that the beads of a file tell."""
    return {name for r in how if r.how == "last" for name in DERIVED.get(r.observe, ())}


@contextlib.contextmanager
def gsd_writer(
    path: str | os.PathLike,
    fluid: Fluid,
    state: State,
    mode: str = "x",
    *,
    species: int | None = None,
    about: dict | None = None,
    untold: Iterable[str] = (),
) -> Iterator[Callable]:
    """Opens a GSD file; gives ``write(frames, flow)``, which appends the frames of a run that
    recorded :func:`dpdjax.observe.gsd_record`.

    What was written is in the file when ``write`` returns: a process killed later loses nothing of
    it.

    Species are the types A, B, ... in turn: of a suspension A the solvent and B the colloids.
    Diameters, masses and the box with its tilt are written too; positions are centred, and
    velocities those of the lab where the flow is given. Images unwrap positions where the strain
    stays as it is. Beads that rotate have their orientation, moment of inertia and angular
    momentum, as HOOMD-blue means them; the others are not turned. Positions are in single
    precision. Bonds, angles and dihedrals among the beads that are written are of the types of the
    fluid by name, and in the file once.

    All else that was recorded is logged as ``dpdjax/...``, and temperature, pressure and potential
    energy also where HOOMD-blue logs them: ``gsd.hoomd.read_log(path)`` reads them all.

    Args:
        path: file name.
        fluid, state: what runs, and the state it starts from.
        mode: ``"x"`` for a new file, ``"w"`` to replace one, ``"r+"`` to go on with one.
        species: the only one whose beads are written; all by default.
        about: what the first frame that is written is to say of the run.
        untold: names of what is recorded and not to be logged.

    Raises ImportError where the package ``gsd`` is missing, FileExistsError by ``"x"`` for a file
    that is there, ValueError by ``"r+"`` for one of other beads or another box; FileError where the
    file cannot be written.

    Example:
        >>> with dpd.gsd_writer("rest.gsd", water, state) as write:
        ...     write(rest.frames)
        >>> dpd.load_gsd("rest.gsd", fluid=water).n
        192
    """
    hoomd = hoomd_files()
    if mode == "x":
        refuse_existing(path, 'mode="w" to replace it, mode="r+" to go on with it')
    if mode == "r+":
        check_fits(path, fluid, state, species)
    beads = Beads.of(fluid, state, species)
    # What a run that goes on with its own file has told at its first frame.
    is_told = mode == "r+" and about is None
    with writing(path), hoomd.open(str(path), mode) as file:

        def write(frames, flow=None):
            nonlocal is_told
            flow = None if flow is None else Flow.of(flow)
            log = _to_log(frames, set(untold))
            with writing(path):
                if not is_told:
                    _tell(file, about, log)
                    is_told = True
                made = lambda k: beads.frame(hoomd.Frame(), frames, log, k, flow)
                file.extend(made(k) for k in range(len(frames["step"])))
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


def _tell(file, about, log):
    """What made the frames that follow, and the shapes and kinds of what they log, into the first
    of them."""
    kind_of = lambda values: [list(np.shape(values)[1:]), str(values.dtype)]
    recorded = {name: kind_of(np.asarray(values)) for name, values in log.items()}
    text = json.dumps((about or {}) | {"recorded": recorded, "id": uuid.uuid4().hex})
    file.file.write_chunk(ABOUT, np.frombuffer(text.encode(), np.uint8))


def _to_log(frames, untold: set[str]) -> dict:
    """What of recorded frames is logged: all but the beads themselves."""
    if BEADS + "position" not in frames:
        untold = {*RECORDED, *TURNING}
    is_logged = lambda name: name not in untold and not name.startswith(BEADS)
    return {name: values for name, values in frames.items() if is_logged(name)}


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
    with _opened(path) as file:
        yield file


LOOKS = 3
"""At a file that cannot be read before it counts as damaged. One that is being written cannot at
some moments: gsd takes the size of it, and a frame that comes before it reads where frames are lies
beyond that (3 of 225,000 looks at a file that grew by 20 frames 100 times in half a minute)."""


def _opened(path):
    file_name(path, "path")
    hoomd = hoomd_files()
    for look in range(LOOKS):
        try:
            return hoomd.open(str(path), "r")
        except FileNotFoundError:
            raise
        except (RuntimeError, OSError) as error:
            if look == LOOKS - 1:
                raise FileError(f"{path} is no GSD file, or a damaged one: {error}") from error
        time.sleep(0.01)


def check_fits(path, fluid, state, species: int | None = None) -> int:
    """The last step in a file; raises ValueError unless that is of these beads in this box, bonded
    alike."""
    with reading(path) as file:
        last = file[-1] if len(file) else None
    if last is None:
        return 0
    own, sides = Beads.of(fluid, state, species), np.asarray(state.box.lengths)
    beads = own.same
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
    if not molecules.are_same(last, own.bonds):
        raise ValueError(
            f"{path} holds beads with other bonds than those of this state; give another file"
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

    Example:
        >>> dpd.write_gsd("rest.gsd", rest)
        >>> import gsd.hoomd
        >>> with gsd.hoomd.open("rest.gsd") as file:
        ...     len(file), int(file[-1].particles.N)
        (40, 192)
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
        lengths: sides of the box at the start, for frames that do not record them.
        same: values by their names in a GSD file.
        bonds: the bonds, angles and dihedrals among those that are written, by kind.
        spins: of the beads that rotate which are written, their places among those, and their
            moments of inertia; None where none rotates.
    """

    slots: np.ndarray
    lengths: np.ndarray
    same: dict[str, Any]
    bonds: dict[str, molecules.Rows]
    spins: tuple[np.ndarray, np.ndarray, np.ndarray] | None

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
        if state.rotation is not None:
            rotating = np.r_[state.rotation.slots]
            own = np.isin(rotating, slots)
            inertia = np.asarray(inertias(fluid, state))[own, None]
            spins = own, np.searchsorted(slots, rotating[own]), inertia
            same["moment_inertia"] = np.zeros((len(slots), 3), np.float32)
            same["moment_inertia"][spins[1]] = inertia
        bonds = molecules.rows_of(fluid, state, slots)
        return cls(slots, np.asarray(state.box.lengths, float), same, bonds, spins)

    def frame(self, frame, frames, log, k: int, flow):
        """A frame of a file, filled with the recorded one of number ``k`` and what is logged of it,
        in a box centred on the origin."""
        before = BEADS if BEADS + "position" in frames else ""
        of = lambda name: np.array(frames[before + name][k])
        lengths = of("lengths").astype(float) if before + "lengths" in frames else self.lengths
        strain, rate = float(of("strain")), 0.0
        if flow is not None:
            rate = float(flow.rate_at(frames["time"][k]))
        whole, velocity = of("position"), of("velocity").astype(float)[self.slots]
        position, columns = centred(whole.astype(float)[self.slots], lengths, strain)
        velocity[:, 0] += rate * position[:, 1]
        image = of("image").astype(np.int32)[self.slots]
        image[:, 0] += columns
        frame.configuration.step = int(frames["step"][k])
        frame.configuration.box = [*lengths, strain, 0.0, 0.0]
        moving = {"position": position, "velocity": velocity, "image": image}
        for name, value in (self.same | moving).items():
            setattr(frame.particles, name, value)
        molecules.put(frame, self.bonds)
        if self.spins is not None:
            own, places, inertia = self.spins
            turned = (of(name).astype(float)[own] for name in TURNING)
            both = _orientation_and_momentum(*turned, places, inertia, len(self.slots))
            frame.particles.orientation, frame.particles.angmom = both
        always = {"strain": strain, "rate": rate, "time": frames["time"][k]}
        frame.log = _logged(log, k) | {FILES + name: _as_log(x) for name, x in always.items()}
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
    if value.dtype.itemsize == 2 and value.dtype.kind not in "iu":  # half floats of either kind
        value = value.astype(np.float32)
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
