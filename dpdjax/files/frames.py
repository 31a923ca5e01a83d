"""What a run recorded, read from its GSD file when it is asked for."""

import copy
import json
import os
from collections.abc import Iterator, Mapping

import jax
import numpy as np

from dpdjax.errors import FileError
from dpdjax.files.gsd import ABOUT, FILES, OF_BEADS, OWN, angular_velocity, middle, reading


@jax.tree_util.register_pytree_node_class
class StoredFrames(Mapping):
    """Recorded values by name, as ``frames`` of a trajectory, read from a GSD file one name at a
    time; as a pytree the arrays themselves.

    Beads are there as in a run: wrapped positions, peculiar velocities and images, in the single
    precision of the file; all else to the last bit.
    """

    def __init__(self, path: str | os.PathLike, begin: int = 0):
        self.path, self.begin, self.skip = os.path.abspath(path), begin, 0
        with reading(path) as file:
            self.about = about(file, begin)
            self.count = max(0, int(len(file)) - begin)
            beads = file[begin].particles if self.count else None
        self._logged = {name: kind for name, kind in self.about.get("recorded", {}).items()}
        self.shapes = self._shapes(beads)

    def _shapes(self, beads) -> dict[str, tuple]:
        """Of every name the shape of its values, the frames in front."""
        if beads is None:
            return {}
        own = {name: (beads.N, 3) for name in (*OF_BEADS, "unwrapped")}
        own |= {"strain": (), "lengths": (3,)}
        if beads.moment_inertia is not None and np.any(beads.moment_inertia):
            rotating = int(np.any(beads.moment_inertia, axis=1).sum())
            own |= {"orientation": (rotating, 4), "angular_velocity": (rotating, 3)}
        own |= {name: tuple(shape) for name, (shape, _) in self._logged.items()}
        return {name: (self.count, *map(int, shape)) for name, shape in own.items()}

    def last(self, count: int) -> "StoredFrames":
        """The last so many frames alone."""
        later = copy.copy(self)
        later.skip = self.count - count
        later.shapes = {name: (count, *shape[1:]) for name, shape in self.shapes.items()}
        return later

    def __contains__(self, name) -> bool:
        return name in self.shapes

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.shapes:
            raise KeyError(name)
        numbers = range(self.begin + self.skip, self.begin + self.count)
        with reading(self.path) as file:
            self._check_same(file)
            if name in self._logged:
                rows = [file.file.read_chunk(k, f"log/{OWN}{name}") for k in numbers]
                return np.stack(rows).astype(self._logged[name][1]).reshape(self.shapes[name])
            of = _OF_FRAME.get(name, _turning)
            return np.stack([of(name, file, k) for k in numbers])

    def _check_same(self, file):
        """Raise FileError where the file is another one by now."""
        if len(file) < self.begin + self.count or about(file, self.begin) != self.about:
            raise FileError(
                f"{self.path} is no longer the file that these frames were written to; give each "
                "run a file of its own"
            )

    def __iter__(self) -> Iterator[str]:
        return iter(self.shapes)

    def __len__(self) -> int:
        return len(self.shapes)

    def __repr__(self):
        return f"StoredFrames({os.fspath(self.path)!r}, {', '.join(self.shapes)})"

    def tree_flatten(self):
        """As a pytree: the arrays, by name."""
        return [self[name] for name in self], tuple(self)

    @staticmethod
    def tree_unflatten(names, arrays):
        """The arrays by name, no longer in a file."""
        return dict(zip(names, arrays))


def about(file, frame: int = 0) -> dict:
    """What a frame of an open GSD file, the first of a run, says of it; empty where another program
    wrote it."""
    if frame >= len(file) or not file.file.chunk_exists(frame, ABOUT):
        return {}
    try:
        return json.loads(bytes(file.file.read_chunk(frame, ABOUT)))
    except ValueError as error:
        raise FileError(f"{file.file.name} does not tell what made it: {error}") from error


def told(file, frame: int, name: str, other):
    """A number that a frame of an open file tells of its own, or ``other`` where it does not."""
    chunk = f"log/{FILES}{name}"
    there = file.file.chunk_exists(frame, chunk)
    return float(file.file.read_chunk(frame, chunk)[0]) if there else other


def as_run(frame):
    """Wrapped positions (n, 3), velocities as in the file, images and strain of a frame."""
    lengths, strain = np.asarray(frame.configuration.box[:3], float), _strain(frame)
    beads = frame.particles
    whole = beads.position.astype(float) + middle(lengths, strain)
    position, crossed = wrapped(whole, lengths, strain, np.float32)
    image = np.zeros((beads.N, 3), np.int32) if beads.image is None else np.array(beads.image)
    return position, np.array(beads.velocity, np.float32), image + crossed, strain


def wrapped(whole, lengths, strain: float, dtype):
    """Places (n, 3) wrapped along the axes, in a precision, and the vectors of the lattice (n, 3)
    that each was carried over.

    Rounding puts places next to a face onto it: those stay where they are.
    """
    onto = ONTO * np.finfo(dtype).eps
    x, y, z = whole.T
    crossings = lambda s: np.where((s > -onto) & (s < 1 + onto), 0.0, np.floor(s))
    rows, layers = crossings(y / lengths[1]), crossings(z / lengths[2])
    x = x - rows * strain * lengths[1]
    columns = np.floor(x / lengths[0])
    crossed = np.stack([columns, rows, layers], axis=1)
    position = np.stack([x, y, z], axis=1) - crossed * lengths
    below = np.nextafter(lengths.astype(dtype), np.zeros((), dtype))
    return np.clip(position, 0.0, below).astype(dtype), crossed.astype(np.int32)


ONTO = 8
"""Roundings of a side within which a place is on a face."""


def _strain(frame) -> float:
    xy, xz, yz = (float(x) for x in frame.configuration.box[3:])
    if xz or yz:
        raise ValueError(
            f"the box is tilted by xz = {xz:g} and yz = {yz:g}; one tilted along xy alone can run"
        )
    return xy


def _position(_, file, k: int) -> np.ndarray:
    return as_run(file[k])[0]


def _velocity(_, file, k: int) -> np.ndarray:
    frame = file[k]
    velocity = as_run(frame)[1]
    velocity[:, 0] -= told(file, k, "rate", 0.0) * frame.particles.position[:, 1]
    return velocity


def _image(_, file, k: int) -> np.ndarray:
    return as_run(file[k])[2]


def _unwrapped(_, file, k: int) -> np.ndarray:
    frame = file[k]
    position, _, image, strain = as_run(frame)
    lengths = np.asarray(frame.configuration.box[:3], float)
    whole = position + image * lengths
    whole[:, 0] += strain * lengths[1] * image[:, 1]
    return whole.astype(np.float32)


def _strain_told(_, file, k: int):
    return np.asarray(file.file.read_chunk(k, f"log/{FILES}strain")[0])


def _lengths(_, file, k: int) -> np.ndarray:
    return np.asarray(file[k].configuration.box[:3], np.float32)


_OF_FRAME = {
    "position": _position,
    "velocity": _velocity,
    "image": _image,
    "unwrapped": _unwrapped,
    "strain": _strain_told,
    "lengths": _lengths,
}


def _turning(name: str, file, k: int) -> np.ndarray:
    beads = file[k].particles
    rotating = np.any(beads.moment_inertia, axis=1)
    orientation = beads.orientation[rotating]
    if name == "orientation":
        return orientation
    return angular_velocity(orientation, beads.angmom[rotating], beads.moment_inertia[rotating, :1])
