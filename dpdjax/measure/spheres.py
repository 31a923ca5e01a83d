"""Spheres of a suspension, as its measures take them: read from a run, frame by frame, and pair by
pair.

The surface gap of two spheres is ``h = r - R_i - R_j``. Every box may be tilted, each frame by its
own strain.
"""

import dataclasses
import itertools
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from dpdjax.checks import number, positive
from dpdjax.engine.state import State
from dpdjax.engine.trajectory import Trajectory
from dpdjax.measure import needs
from dpdjax.measure.reading import as_frames, chosen_beads, of_beads, recorded, strains
from dpdjax.measure.results import Result
from dpdjax.model.beads import radii
from dpdjax.model.fluid import Fluid

IMAGES = np.array(list(itertools.product((0, 1, -1), repeat=3)))
"""The box and the 26 around it, in lattice vectors."""


@dataclasses.dataclass(frozen=True, repr=False)
class Spheres(Result):
    """Frames of a suspension, from a run by :func:`spheres` or from arrays that broadcast to these
    shapes.

    Attributes:
        position: (batch, frames, n, 3), wrapped or not [length].
        radius: of each bead, (batch, n) [length].
        lengths: sides of the box, (3,) [length].
        strain: tilt of the box in each frame, (batch, frames), by default none.
        time: of each frame, (frames,), by default their number [time].

    Raises ValueError for shapes that do not fit, numbers that are not finite, radii or sides not
    above zero.

    Example:
        >>> where = [[0.0, 0.0, 0.0], [2.1, 0.0, 0.0], [5.0, 5.0, 5.0]]
        >>> given = dpd.measure.Spheres(position=where, radius=1.0, lengths=10.0)
        >>> dpd.measure.clusters(given, gap=0.2).largest.tolist()
        [[2]]
    """

    position: Any
    radius: Any
    lengths: Any
    strain: Any = 0.0
    time: Any = None

    def __post_init__(self):
        position = as_frames(self.position, "position")
        batch, frames, n = position.shape[:3]
        positive(self.radius, "radius")
        positive(self.lengths, "lengths")
        fields = {
            "position": position,
            "time": np.arange(frames) if self.time is None else self.time,
        }
        shapes = {
            "radius": (batch, n),
            "lengths": (3,),
            "strain": (batch, frames),
            "time": (frames,),
        }
        for name, shape in shapes.items():
            fields[name] = _fitted(fields.get(name, getattr(self, name)), shape, name)
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    @property
    def n(self) -> int:
        """Spheres in a frame."""
        return self.position.shape[2]


def _fitted(values, shape, name: str) -> np.ndarray:
    number(values, name)
    values = np.asarray(values, float)
    try:
        return np.broadcast_to(values, shape)
    except ValueError:
        raise ValueError(
            f"{name} has shape {values.shape}; {shape} is wanted, as the positions have it"
        ) from None


def spheres(trajectory: Trajectory, *, species: int | None = None) -> Spheres:
    """The spheres of one species of a run, with the radius ``fluid.radius[species]`` times each
    bead's size.

    Args:
        trajectory: a run recorded with ``observe=dpd.observe.positions_of(species)`` or
            ``dpd.observe.positions``, sheared or not.
        species: index of the species, by default the one that has a radius.

    Raises:
        TypeError: what is no run.
        ValueError: no recorded positions, or means of them, or of other beads; a sheared run
            without ``strain``; no species with a radius, or several and none named, or a named one
            that is not there or has none; a scan over numbers; members of a batch in different
            boxes or at different times.

    Example:
        >>> found = dpd.measure.spheres(gel)
        >>> found.position.shape, found.radius.shape
        ((1, 24, 16, 3), (1, 16))
    """
    needs.finished(trajectory)
    species = _of_radius(trajectory.fluid, species)
    beads = chosen_beads(trajectory, species)
    sizes = np.asarray(trajectory.final.size, float)
    sizes = sizes.reshape(-1, sizes.shape[-1])[:, beads]
    return of_run(trajectory, beads, np.reshape(trajectory.fluid.radius[species], (-1, 1)) * sizes)


def _of_radius(fluid, species: int | None) -> int:
    """The species of spheres that is meant; ValueError where it has no radius or none is named
    among several."""
    round_ones = [k for k, radius in enumerate(fluid.radius) if radius is not None]
    if not round_ones:
        raise ValueError(
            "this fluid has no spheres, for no species has a radius; give one, dpd.fluid(..., "
            "radius=[None, R])"
        )
    if species is None and len(round_ones) > 1:
        raise ValueError(
            f"species {', '.join(map(str, round_ones))} are spheres; name one: "
            "dpd.measure.spheres(trajectory, species=...)"
        )
    if species is not None and species not in round_ones:
        told = ", ".join(map(str, round_ones))
        raise ValueError(
            f"species {species} has no radius, its beads are points; spheres are of species {told}"
        )
    return round_ones[0] if species is None else species


def spheres_of(fluid: Fluid, state: State, *, species: int | None = None) -> Spheres:
    """The spheres of one species of a single state; ``species`` and ValueError as in
    :func:`spheres`, or for a batch.

    Example:
        >>> found = dpd.measure.spheres_of(made.fluid, gel.final)
        >>> found.position.shape
        (1, 1, 16, 3)
        >>> dpd.measure.contact_number(found, gap=0.2).series.shape
        (1, 1)
    """
    if np.ndim(state.position) != 2:
        raise ValueError(
            "the state is a batch; give one member: jax.tree.map(lambda leaf: leaf[0], state)"
        )
    species = _of_radius(fluid, species)
    beads = np.asarray(state.species) == species
    if not np.any(beads):
        raise ValueError(
            f"no bead is of species {species}; the state has species "
            f"{np.unique(state.species).tolist()}"
        )
    radius = np.asarray(radii(fluid, state))[beads]
    return Spheres(
        np.asarray(state.position)[beads],
        radius,
        state.box.lengths,
        state.box.strain,
        np.reshape(state.time, 1),
    )


def of_run(trajectory, beads, radius) -> Spheres:
    """Some beads of a run, with radii (batch, n)."""
    needs.fixed_box(trajectory)
    position = of_beads(recorded(trajectory, "position"), trajectory, beads)
    lengths = _common(trajectory.final.box.lengths, "in different boxes")
    time = _common(trajectory.frames["time"], "recorded at different times")
    return Spheres(position, radius, lengths, strains(trajectory), time)


def as_spheres(what) -> Spheres:
    if not isinstance(what, Spheres) and not hasattr(what, "frames"):
        raise TypeError(
            f"this measures a run or spheres, not a {type(what).__name__}; of one state, "
            "dpd.measure.spheres_of(fluid, state)"
        )
    return what if isinstance(what, Spheres) else spheres(what)


def _common(values, what: str):
    """The values of the first member; ValueError unless all members have the same."""
    members = np.atleast_2d(np.asarray(values, float))
    if not np.allclose(members, members[:1], rtol=1e-6, atol=0):
        raise ValueError(
            f"members of the batch are {what}; measure them one by one: trajectory.members()"
        )
    return members[0]


class Frame(NamedTuple):
    """One configuration: positions (n, 3) in the box, radii (n,), sides (3,), shift of the upper
    y-image along x."""

    position: np.ndarray
    radius: np.ndarray
    lengths: np.ndarray
    shift: float


class ClosePairs(NamedTuple):
    """Close pairs: beads ``first < second`` and their surface gap, (pairs,) each."""

    first: np.ndarray
    second: np.ndarray
    gap: np.ndarray


def shift_of(strain, lengths):
    """How far the upper y-image is shifted along x, within half a side of zero."""
    shift = strain * lengths[1]
    return shift - lengths[0] * np.round(shift / lengths[0])


def frames_of(what: Spheres, member: int):
    """The frames of one member."""
    lengths = what.lengths
    for position, shift in zip(what.position[member], shift_of(what.strain[member], lengths)):
        yield frame_of(position, what.radius[member], lengths, shift)


def frame_of(position, radius, lengths, shift) -> Frame:
    """The configuration with its beads brought into the box."""
    x = np.array(position, float)
    x[:, 0] -= shift * np.floor(x[:, 1] / lengths[1])
    return Frame(x - lengths * np.floor(x / lengths), radius, lengths, shift)


def by_frame(what: Spheres, measure) -> np.ndarray:
    """``measure(frame)`` of every frame, (batch, frames, ...)."""
    return np.array(
        [[measure(frame) for frame in frames_of(what, k)] for k in range(len(what.position))]
    )


def nearest(frame: Frame, d):
    """Separations (3, ...) to the nearest images, and by how many lattice vectors they were longer,
    (3, ...).

    Changes ``d``; right for separations below half the shortest side.
    """
    sides = frame.lengths.reshape(3, *[1] * (d.ndim - 1))
    if frame.shift != 0:
        d[0] -= frame.shift * np.rint(d[1] / sides[1])
    images = np.rint(d / sides)
    d -= sides * images
    return d, images


def with_images(frame: Frame, reach) -> tuple[np.ndarray, np.ndarray]:
    """The beads, and their images within ``reach`` of the box: positions (m, 3), and whose they are
    (m,)."""
    lattice = np.diag(frame.lengths)
    lattice[1, 0] = frame.shift
    points = frame.position[None] + (IMAGES @ lattice)[:, None]
    around = np.all((points >= -reach) & (points <= frame.lengths + reach), axis=2)
    return points[around], np.nonzero(around)[1]


def close_pairs(frame: Frame, gap) -> ClosePairs:
    """Pairs with a surface gap below ``gap``; the largest spheres must then be within half the
    shortest side."""
    n, reach = len(frame.position), 2 * np.max(frame.radius) + gap
    points, owner = with_images(frame, reach)
    first, copy = cKDTree(points).query_pairs(reach, output_type="ndarray").T
    # The beads themselves come first. A pair across a face is found from either side: keep one.
    once = (first < n) & (first < owner[copy])
    first, copy = first[once], copy[once]
    second = owner[copy]
    h = (
        np.linalg.norm(points[copy] - points[first], axis=1)
        - frame.radius[first]
        - frame.radius[second]
    )
    return ClosePairs(*(values[h < gap] for values in (first, second, h)))
