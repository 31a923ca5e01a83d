"""What a run recorded, read from its GSD file when it is asked for."""

import json
import os
from collections.abc import Iterator, Mapping

import jax
import numpy as np

from dpdjax.errors import FileError
from dpdjax.files.gsd import ABOUT, OF_BEADS, OWN, angular_velocity, middle, reading


@jax.tree_util.register_pytree_node_class
class StoredFrames(Mapping):
    """Recorded values by name, as ``frames`` of a trajectory, read from a GSD file one name at a
    time; as a pytree the arrays themselves.

    Beads are there as in a run: wrapped positions, peculiar velocities and images, in the single
    precision of the file; all else to the last bit.
    """

    def __init__(self, path: str | os.PathLike, begin: int = 0):
        self.path, self.begin = path, begin
        with reading(path) as file:
            self.about = about(file)
            self.count = max(0, int(len(file)) - begin)
            beads = file[0].particles if self.count else None
        self.shapes = self._shapes(beads)

    def _shapes(self, beads) -> dict[str, tuple]:
        """Of every name the shape of its values, the frames in front."""
        if beads is None:
            return {}
        own = {name: (beads.N, 3) for name in OF_BEADS} | {"strain": ()}
        own |= {name: tuple(shape) for name, shape in self.about.get("recorded", {}).items()}
        if beads.moment_inertia is not None and np.any(beads.moment_inertia):
            rotating = int(np.any(beads.moment_inertia, axis=1).sum())
            own |= {"orientation": (rotating, 4), "angular_velocity": (rotating, 3)}
        return {name: (self.count, *map(int, shape)) for name, shape in own.items()}

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.shapes:
            raise KeyError(name)
        numbers = range(self.begin, self.begin + self.count)
        with reading(self.path) as file:
            if name in self.about.get("recorded", {}) or name == "strain":
                rows = [file.file.read_chunk(k, f"log/{OWN}{name}") for k in numbers]
            elif name in OF_BEADS:
                rows = [self._bead(name, file, k) for k in numbers]
            else:
                rows = [_turning(name, file[k].particles) for k in numbers]
        return np.stack(rows).reshape(self.shapes[name])

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

    @staticmethod
    def _bead(name: str, file, k: int) -> np.ndarray:
        frame = file[k]
        position, velocity, image, _ = as_run(frame)
        if name == "velocity":
            rate = file.file.read_chunk(k, f"log/{OWN}rate")[0]
            velocity[:, 0] -= rate * frame.particles.position[:, 1]
        return {"position": position, "velocity": velocity, "image": image}[name]


def about(file) -> dict:
    """What the first frame of an open GSD file says of the run that wrote it; empty where another
    program did."""
    if not len(file) or not file.file.chunk_exists(0, ABOUT):
        return {}
    try:
        return json.loads(bytes(file.file.read_chunk(0, ABOUT)))
    except ValueError as error:
        raise FileError(f"{file.file.name} does not tell what made it: {error}") from error


def as_run(frame):
    """Wrapped positions (n, 3), velocities as in the file, images and strain of a frame."""
    lengths, strain = np.asarray(frame.configuration.box[:3], float), _strain(frame)
    beads = frame.particles
    position = beads.position.astype(float) + middle(lengths, strain)
    columns = np.floor(position[:, 0] / lengths[0]).astype(np.int32)
    position[:, 0] -= columns * lengths[0]
    image = np.zeros((beads.N, 3), np.int32) if beads.image is None else np.array(beads.image)
    image[:, 0] += columns
    # Single precision may round a place up onto the face.
    position = np.minimum(position.astype(np.float32), np.nextafter(np.float32(lengths), 0))
    return np.maximum(position, 0), np.array(beads.velocity, np.float32), image, strain


def _strain(frame) -> float:
    xy, xz, yz = (float(x) for x in frame.configuration.box[3:])
    if xz or yz:
        raise ValueError(
            f"the box is tilted by xz = {xz:g} and yz = {yz:g}; one tilted along xy alone can run"
        )
    return xy


def _turning(name: str, beads) -> np.ndarray:
    rotating = np.any(beads.moment_inertia, axis=1)
    orientation = beads.orientation[rotating]
    if name == "orientation":
        return orientation
    return angular_velocity(orientation, beads.angmom[rotating], beads.moment_inertia[rotating, :1])
