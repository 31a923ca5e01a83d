"""What measures read from a run: vectors of beads, frame by frame, followed through the images and
relative to the flow."""

import numpy as np

from dpdjax.checks import whole
from dpdjax.engine.batching import chosen
from dpdjax.measure import needs
from dpdjax.measure.replicas import refuse_scan, shared, species_of

COARSE = 0.3
"""Strain between two frames up to which what the flow carried a bead along is told from its places
in them.

A bead that diffuses in between leaves the mean squared displacement along the flow off by a twelfth
of its square.
"""

RECORD_STRAIN = (
    "record it too, as dpd.observe.positions does: observe=[..., lambda fluid, state: "
    "{'strain': state.box.strain}]"
)


def recorded(
    trajectory,
    name: str,
    *,
    observe: str = "dpd.observe.positions",
    components: int = 3,
    averaged: bool = False,
) -> np.ndarray:
    """A vector of every bead that was recorded, (batch, frames, beads, 3); the batch is 1 where
    there is none.

    Args:
        trajectory: a run, one or replicas.
        name: of what was recorded.
        observe: what records it, for the message.
        components: of the vector.
        averaged: whether means over the interval of a frame will do.

    Raises ValueError where the run did not record ``name``, or recorded means of it that will not
    do, failed, or scans over numbers; TypeError for what is no run.
    """
    check_recorded(trajectory, name, observe)
    if not averaged:
        check_not_averaged(trajectory, name, observe)
    return as_frames(trajectory.frames[name], name, components)


def check_recorded(trajectory, name: str, observe: str):
    """Raise unless this is a run, or replicas of one, that recorded ``name``; warns of beads that
    are hot."""
    check_there(trajectory, name, observe)
    needs.warn_of_heat(trajectory, trajectory.frames)


def check_there(trajectory, name: str, observe: str):
    """Raise unless this is a run, or replicas of one, that recorded ``name``."""
    needs.finished(trajectory)
    if name not in trajectory.frames:
        raise ValueError(
            f"the run recorded no {name!r} but {', '.join(trajectory.frames)}; use "
            f"observe={observe}"
        )
    refuse_scan(trajectory)


def check_not_averaged(trajectory, name: str, observe: str):
    """Raise ValueError where a run recorded means of what is wanted at a moment: beads change sides
    in between, or turn."""
    if name in getattr(trajectory, "means", ()):
        raise ValueError(
            f"the run recorded means of {name!r}, not its value at a time; use observe={observe} "
            "without dpd.mean"
        )


def displaced(trajectory, observe: str = "dpd.observe.positions") -> np.ndarray:
    """Positions followed through the images, less what the flow has carried the beads along since
    the first frame.

    (batch, frames, beads, 3) in double precision: far from where it began a bead's single one moves
    in jumps. Their differences are what the peculiar velocities add up to; without shear, the
    displacements.

    Raises as :func:`recorded` does, and ValueError for a sheared run whose frames are a strain of
    more than :data:`COARSE` apart.
    """
    needs.fixed_box(trajectory)
    there = getattr(trajectory, "frames", {})
    if "unwrapped" in there and "image" not in there:
        needs.unsheared(
            trajectory,
            "the displacement of beads recorded without their images",
            f"use observe={observe}",
        )
        return recorded(trajectory, "unwrapped", observe=observe).astype(float)
    position = recorded(trajectory, "position", observe=observe).astype(float)
    image = as_frames(trajectory.frames["image"], "image").astype(float)
    lengths, strain = side_lengths(trajectory)[:, None, None, :], strains(trajectory)
    place = position + image * lengths
    place[..., 0] += strain[..., None] * lengths[..., 1] * image[..., 1]
    if needs.is_sheared(trajectory):
        place[..., 0] -= carried(place[..., 1], _unfolded(trajectory, strain))
    return place


def carried(y, strain):
    """How far along x the flow has carried beads at heights ``y`` (batch, frames, beads) since the
    first frame."""
    steps = 0.5 * (y[:, 1:] + y[:, :-1]) * np.diff(strain, axis=1)[..., None]
    return np.concatenate([np.zeros_like(y[:, :1]), np.cumsum(steps, axis=1)], axis=1)


def _unfolded(trajectory, strain):
    """The strain of each frame with the periods that were taken off it since the first, (batch,
    frames)."""
    flow = chosen(trajectory.flow, trajectory.flow.batch_axes(), 0)
    interval, time = (
        shared(trajectory.interval),
        np.atleast_2d(trajectory.frames["time"]).astype(float),
    )
    most = float(np.max(np.abs(np.asarray(flow.rate)))) * interval
    if most > COARSE:
        every = max(1, int(trajectory.every * COARSE / most))
        raise ValueError(
            f"the box is strained by up to {most:.3g} between frames, too far to tell what the "
            "flow carried a bead along from where it was in them; record frames closer together, "
            f"every={every}"
        )
    due = np.broadcast_to(
        np.asarray(flow.rate_at(time[:, 1:] - 0.5 * interval), float) * interval, time[:, 1:].shape
    )
    lengths = side_lengths(trajectory)
    period = (lengths[:, 0] / lengths[:, 1])[:, None]
    periods = np.round((due - np.diff(strain, axis=1)) / period)
    return strain + period * np.pad(np.cumsum(periods, axis=1), ((0, 0), (1, 0)))


def strains(trajectory) -> np.ndarray:
    """The tilt of the box in each frame, (batch, frames); ValueError for a sheared run that did not
    record it."""
    frames = np.atleast_2d(trajectory.frames["time"]).shape
    if "strain" in trajectory.frames:
        check_not_averaged(trajectory, "strain", "dpd.observe.positions")
        return np.atleast_2d(np.asarray(trajectory.frames["strain"], float))
    needs.unsheared(trajectory, "the tilt of the box in each frame", RECORD_STRAIN)
    return np.broadcast_to(
        np.reshape(np.asarray(trajectory.final.box.strain, float), (-1, 1)), frames
    )


def frame_lengths(trajectory) -> np.ndarray:
    """The sides of the box in each frame, (batch, frames, 3); ValueError for a run in which they
    changed and that did not record them."""
    frames = np.atleast_2d(trajectory.frames["time"]).shape
    if not needs.is_box_changed(trajectory):
        return np.broadcast_to(side_lengths(trajectory)[:, None], (*frames, 3))
    if "lengths" not in trajectory.frames:
        raise ValueError(
            "the box of this run changed, and its sides in each frame are unknown: record them "
            "too, as dpd.observe.positions does: observe=[..., dpd.observe.box]"
        )
    check_not_averaged(trajectory, "lengths", "dpd.observe.box")
    return np.reshape(np.asarray(trajectory.frames["lengths"], float), (*frames, 3))


def side_lengths(trajectory) -> np.ndarray:
    """The sides of the box of each member, (batch, 3); ValueError for a run in which they
    changed."""
    needs.fixed_box(trajectory)
    members = np.atleast_2d(trajectory.frames["time"]).shape[0]
    return np.broadcast_to(
        np.reshape(np.asarray(trajectory.final.box.lengths, float), (-1, 3)), (members, 3)
    )


def as_frames(values, name: str, components: int = 3) -> np.ndarray:
    """(n, 3), (frames, n, 3) or (..., frames, n, 3) as (batch, frames, n, 3), 3 the components;
    ValueError unless finite."""
    values = np.asarray(values)
    if values.ndim < 2 or values.shape[-1] != components or values.size == 0:
        wanted = f"(n, {components}), (frames, n, {components}) or (batch, frames, n, {components})"
        raise ValueError(f"{name} has shape {values.shape}; {wanted} is wanted")
    if not np.all(np.isfinite(values)):
        raise ValueError(
            f"{name} holds NaN or infinity: the run failed, see trajectory.failed and "
            "trajectory.survivors"
        )
    values = values[None] if values.ndim == 2 else values
    return values.reshape(-1, *values.shape[-3:])


def chosen_beads(trajectory, species: int | None) -> np.ndarray:
    """Indices of the beads of one species, or of all; ValueError where there is none."""
    of_bead = species_of(trajectory)
    species = None if species is None else whole(species, "species", least=0)
    if species is not None and species not in of_bead:
        raise ValueError(
            f"no bead is of species {species}; there are {', '.join(map(str, np.unique(of_bead)))}"
        )
    return np.flatnonzero(of_bead == species) if species is not None else np.arange(len(of_bead))


def of_beads(values, trajectory, beads) -> np.ndarray:
    """Recorded values (batch, frames, n, 3) of some beads, which may be the only ones recorded;
    else ValueError."""
    there, everything = values.shape[2], len(species_of(trajectory))
    if there not in (everything, len(beads)):
        raise ValueError(
            f"the run recorded {there} of its {everything} beads, not the {len(beads)} to be "
            "measured; name their species, or use observe=dpd.observe.positions"
        )
    return values[:, :, beads] if there == everything else values
