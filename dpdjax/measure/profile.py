"""Profiles across a flow: the velocity along x and the temperature, by the height y."""

import dataclasses
import functools
from typing import Any

import numpy as np

from dpdjax.drawing import COLOURS, axes
from dpdjax.engine.batching import chosen
from dpdjax.engine.trajectory import Trajectory
from dpdjax.measure import needs
from dpdjax.measure.blocks import error_of
from dpdjax.measure.reading import (
    as_frames,
    check_not_averaged,
    check_there,
    chosen_beads,
    of_beads,
    side_lengths,
)
from dpdjax.measure.replicas import bead_masses, shared
from dpdjax.measure.results import Result
from dpdjax.measure.structure import whole_bins

RECORD = "dpd.observe.positions"
NUMBERS = {"temperature", "potential_energy", "wave_velocity"}
"""What tells that a run still drifts."""


@dataclasses.dataclass(frozen=True, repr=False)
class VelocityProfile(Result):
    """Velocity and temperature of the beads at each height, in bins of equal width.

    Attributes:
        y: middle of each bin, (bins,) [length].
        velocity: mean velocity along x in the lab, (bins,) [length/time].
        velocity_error: its standard error, (bins,); NaN where there is a single frame.
        temperature: kinetic temperature about the mean velocity of the bin, (bins,) [energy].
        temperature_error: its standard error, (bins,); NaN where there is a single frame.
        imposed: velocity of a homogeneous shear, ``rate (y - L_y/2)``, (bins,) [length/time]; 0
            where the box was not sheared.

    Example:
        >>> profile = dpd.measure.velocity_profile(sheared, bins=4)
        >>> profile.y.round(3).tolist(), profile.imposed.round(3).tolist()
        ([0.5, 1.5, 2.5, 3.5], [-0.3, -0.1, 0.1, 0.3])
    """

    y: np.ndarray
    velocity: np.ndarray
    velocity_error: np.ndarray
    temperature: np.ndarray
    temperature_error: np.ndarray
    imposed: np.ndarray

    def plot(self, ax: Any = None) -> Any:
        """Draw the velocity with its errors and the line of a homogeneous shear, and the
        temperature on an axis of its own to the right; returns the axes of the velocity."""
        ax = axes(ax)
        hot = ax.twinx()
        parts = [
            (ax, self.velocity, self.velocity_error, COLOURS[0], "velocity $v_x$ [length/time]"),
            (hot, self.temperature, self.temperature_error, COLOURS[3], "temperature [energy]"),
        ]
        for own, values, error, colour, label in parts:
            style = {"fmt": "o", "ms": 4, "lw": 1, "capsize": 2, "color": colour}
            own.errorbar(self.y, values, np.nan_to_num(error), **style)
            own.set_ylabel(label, color=colour)
            own.tick_params(axis="y", colors=colour)
        if np.any(self.imposed):
            ax.plot(self.y, self.imposed, "k--", lw=1, label="rate (y - L$_y$/2)")
            ax.legend(loc="lower right")
        # From 0, or the noise of a flat temperature would look like a profile.
        hot.set_ylim(0.0, 1.15 * np.max(self.temperature))
        ax.set_xlabel("y [length]")
        return ax


def velocity_profile(
    trajectory: Trajectory, *, species: int | None = None, bins: int = 20, skip: float = 0.1
) -> VelocityProfile:
    """The mean velocity along x and the kinetic temperature across the gap y, of a run recorded
    with ``observe=dpd.observe.positions`` or read from a GSD file.

    Velocities of the lab are the recorded ones, which are peculiar, and ``rate (y - L_y/2)``. The
    temperature is that of velocities relative to the mean of their bin over all frames; in a flow
    that a force drives it holds what the velocity changes by within a bin, so take narrow ones.
    Errors come from blocks of frames (and of replicas).

    Args:
        trajectory: a run in a steady flow, one or replicas.
        species: index of the species looked at, or None for every bead.
        bins: of equal width across the box; those that no bead ever was in are left out.
        skip: share of the frames left out at the start.

    Warns where temperature or energy, if recorded, still drift. Raises ValueError for a failed run,
    one without positions and velocities or with means of them, a scan over numbers, a species that
    is not there, a number of bins below 1, ``skip`` outside 0 to 1.

    Example:
        >>> profile = dpd.measure.velocity_profile(sheared, bins=4, skip=0.5)
        >>> profile.velocity.shape, profile.velocity_error.shape
        ((4,), (4,))
        >>> bool(np.all(abs(profile.temperature - 1.0) < 0.5))
        True
    """
    if not 0 <= skip < 1:
        raise ValueError(f"skip is {skip}; it is a share of the frames, from 0 to below 1")
    bins = whole_bins(bins)
    y, velocity, mass, freedom = _beads(trajectory, species, skip)
    side = shared(side_lengths(trajectory)[:, 1])
    place = np.minimum((np.mod(y, side) / side * bins).astype(int), bins - 1)
    there, place = np.unique(place, return_inverse=True)
    total = functools.partial(_by_bin, place.reshape(y.shape), len(there))
    middle, rate = (there + 0.5) * side / bins, _rates(trajectory, skip)
    inertia = total(mass)
    streaming = rate[..., None] * (y - 0.5 * side)
    lab, lab_error = _quotient(total(mass * (velocity[..., 0] + streaming)), inertia)
    peculiar = [_quotient(total(mass * velocity[..., k]), inertia)[0] for k in range(3)]
    thermal = velocity - np.stack(peculiar, axis=-1)[place.reshape(y.shape)]
    hot = _quotient(total(mass * np.sum(thermal**2, axis=-1)), total(freedom))
    return VelocityProfile(middle, lab, lab_error, *hot, rate.mean() * (middle - 0.5 * side))


def _beads(trajectory, species, skip):
    """Heights (batch, frames, n), peculiar velocities (batch, frames, n, 3), masses, and how many
    degrees of freedom each bead has, in double precision."""
    for name in ("position", "velocity"):
        check_there(trajectory, name, RECORD)
        check_not_averaged(trajectory, name, RECORD)
    beads = chosen_beads(trajectory, species)
    place, velocity = (_later(trajectory, name, beads, skip) for name in ("position", "velocity"))
    recent = {name: np.asarray(trajectory.frames[name]) for name in NUMBERS & {*trajectory.frames}}
    needs.warn_unsettled({name: x[..., int(skip * x.shape[-1]) :] for name, x in recent.items()})
    every = bead_masses(trajectory)
    mass = np.broadcast_to(every[:, None, beads], velocity.shape[:-1])
    # The momentum of the whole is fixed: of that each bead lacks its share.
    return place[..., 1], velocity, mass, 3.0 * (1.0 - mass / every.sum(axis=1)[:, None, None])


def _later(trajectory, name, beads, skip):
    """What was recorded of some beads after the start, (batch, frames, n, 3)."""
    values = of_beads(as_frames(trajectory.frames[name], name), trajectory, beads)
    return values[:, int(skip * values.shape[1]) :].astype(float)


def _rates(trajectory, skip):
    """The shear rate in each frame after the start, (batch, frames)."""
    time = np.atleast_2d(np.asarray(trajectory.frames["time"], float))
    time = time[:, int(skip * time.shape[1]) :]
    flow = chosen(trajectory.flow, trajectory.flow.batch_axes(), 0)
    return np.broadcast_to(np.asarray(flow.rate_at(time), float), time.shape)


def _by_bin(place, bins: int, values):
    """Sums of values (batch, frames, n) over the beads of each bin, (batch, frames, bins)."""
    batch, frames = place.shape[:2]
    row = np.arange(batch * frames).reshape(batch, frames, 1) * bins
    counted = np.bincount((row + place).ravel(), values.ravel(), batch * frames * bins)
    return counted.reshape(batch, frames, bins)


def _quotient(above, below):
    """Quotient of the means of sums (batch, frames, bins), and its standard error, (bins,) each."""
    level = below.mean(axis=(0, 1))
    found = above.mean(axis=(0, 1)) / level
    return found, error_of((above - found * below) / level)
