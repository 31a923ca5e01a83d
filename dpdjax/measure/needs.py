"""What measures need of a run, and the checks that it is so."""

import math

import numpy as np

from dpdjax import drawing
from dpdjax.checks import is_concrete
from dpdjax.errors import warn
from dpdjax.measure.replicas import bead_masses, species_of, volume_of
from dpdjax.measure.statistics import block_average
from dpdjax.model import rates

RARELY = 1e-3
"""How often a stationary series is told to drift."""
PIECES = 10
"""Stretches of a series whose means are looked at for a trend: longer than the series remembers."""
HOT, WARM, OFF = 0.25, 0.05, 0.02
"""Shares of kT by which the kinetic temperature may be off: at the end of a run, on average, and on
average beyond doubt."""
SURELY, FEWEST = 4.0, 8
"""Standard errors, of so many blocks, by which a temperature is off beyond doubt."""
FLUCTUATIONS = 5.0
"""Standard deviations of the temperature of few beads at one time that are no excess."""
LIKELY = 3.0
"""Standard deviations by which a mean is off by chance at most."""


def warn_of_ages(what, name: str):
    """Warn where an average over the frames of a run is one over ages: frames that are further and
    further apart are of something that ages."""
    frames = getattr(what, "frames", {})
    if "time" in frames and drawing.grows(np.atleast_2d(frames["time"])[0]):
        warn(
            f"the frames are further and further apart, and {name} is the mean over all of them, "
            "most of them young: trajectory.last(6) has the last six",
        )


def finished(trajectory):
    """Raise unless this is a run, of known numbers, that recorded a frame.

    Raises TypeError for what is no trajectory and for numbers that are being traced, ValueError for
    a run without frames, or one that failed, of a batch with its members that did.
    """
    if not hasattr(trajectory, "frames"):
        raise TypeError(
            f"this measures a run, and was given a {type(trajectory).__name__}; give what "
            "dpd.run(...) returns"
        )
    if not is_concrete(trajectory.frames):
        raise TypeError(
            "measures work on numbers of the host and have no derivative: inside jit, vmap or grad "
            "take a mean of trajectory.frames by jax.numpy, and measure outside"
        )
    if not trajectory.frames:
        raise ValueError(
            "the run recorded no frame: it was interrupted before the first; run it again"
        )
    failed = getattr(trajectory, "failed", ())
    if failed:
        cure = (
            "measure the others, trajectory.survivors"
            if trajectory.is_batch
            else "measure the survivors of the batch it was in"
        )
        raise ValueError(f"the run failed: {'; '.join(why for _, why in failed)}; {cure}")


def finite(frames: dict):
    """Raise ValueError, naming it, where something recorded is not finite."""
    for name, values in frames.items():
        if not np.all(np.isfinite(values)):
            raise ValueError(
                f"{name!r} holds NaN or infinity: the run failed, see trajectory.failed and "
                "trajectory.survivors"
            )


def warn_of_heat(trajectory, frames: dict):
    """Warns where the kinetic temperature that was recorded, or that of recorded velocities, is not
    that of the fluid."""
    if "temperature" in frames:
        series = frames["temperature"]
    elif "velocity" in frames and "velocity" not in getattr(trajectory, "means", ()):
        series = _temperature_of(trajectory, np.asarray(frames["velocity"]))
    else:
        return
    kT, series = float(np.mean(np.asarray(trajectory.fluid.kT, float))), np.atleast_1d(series)
    chance = float(np.max(doubt(trajectory, series.shape[-1])))
    measured = is_off(series, kT, chance)
    if measured is not None:
        warn(
            f"the beads were at {measured:.4g} where kT is {kT:.4g}, and what is measured is of "
            "that temperature: use a smaller shear rate or dt, or leave out more of the start, "
            "skip=...",
        )


def is_off(temperatures, kT: float, chance: float = 0.0):
    """The mean of temperatures (frames,) or (replicas, frames) where it is far from kT, or not kT
    beyond doubt; else None. By ``chance``, a share, the mean of each may be off."""
    series = np.atleast_2d(np.asarray(temperatures, float))
    if kT <= 0 or series.size < 4 or not np.all(np.isfinite(series)):
        return None
    found = block_average(series)
    share = abs(found.value / kT - 1.0)
    if share < LIKELY * chance / math.sqrt(len(series)):
        return None
    surely = found.deviation(kT) > SURELY and found.blocks >= FEWEST
    return found.value if share > WARM or (share > OFF and surely) else None


def fluctuation(motions: int) -> float:
    """Standard deviation, over kT, of the kinetic temperature of so many motions at one time."""
    return math.sqrt(2.0 / motions)


def doubt(trajectory, frames: int):
    """Share of kT by which a mean of the kinetic temperature over so many frames is off by chance:
    few beads have energies that vary, and remember theirs as long as drag does. Of each member
    where their steps differ.

    A short run seems to be steadily hot else: all its frames are of one moment.
    """
    of_bead = species_of(trajectory)
    one = fluctuation(3 * max(len(of_bead), 2) - 3)
    if getattr(trajectory, "every", None) is None:
        return one
    fluid = rates.extreme(trajectory.fluid)
    densities = np.bincount(of_bead, minlength=fluid.species) / volume_of(trajectory)
    span = frames * np.asarray(trajectory.interval, float)
    # Drag takes from the kinetic energy alone, which the potential one fills up again.
    forgotten = 0.5 * rates.damping_rate(fluid, densities) * span
    return one / np.sqrt(np.maximum(forgotten, 1.0))


def _temperature_of(trajectory, velocity):
    """Of each frame, (..., frames), from velocities (..., frames, n, 3) of all beads; NaN of some
    of them alone.

    Three momenta are fixed.
    """
    n = len(species_of(trajectory))
    if n != velocity.shape[-2] or n < 2:
        return np.nan
    # In double precision piece by piece: a copy of all velocities might not fit.
    mass, product = bead_masses(trajectory)[0], "n,...nc,...nc->..."
    return np.einsum(product, mass, velocity, velocity, dtype=float) / (3 * n - 3)


def is_sheared(trajectory) -> bool:
    """Whether the box of the run was deformed."""
    return trajectory.flow.deforms and bool(np.any(np.asarray(trajectory.flow.rate) != 0))


def is_box_changed(trajectory) -> bool:
    """Whether the sides of the box could change in the run."""
    system = getattr(trajectory, "system", None)
    return getattr(getattr(system, "integrator", None), "changes_box", False)


def fixed_box(trajectory):
    """Raise ValueError for a run whose box changed its sides, by which this measure divides."""
    if is_box_changed(trajectory):
        raise ValueError(
            "the box of this run changed its sides, and this measure is of one that keeps them: "
            "go on from the final state without the barostat, and measure that run"
        )


def is_pushed(trajectory) -> bool:
    """Whether a force or a torque drove the run."""
    return bool(trajectory.flow.drivers)


def warn_of_others(trajectory, meant: tuple[type, ...] = ()):
    """Warns of drivers other than those that are meant: what they do is in what is measured."""
    others = [d for d in trajectory.flow.drivers if not isinstance(d, meant)]
    if others:
        kinds = ", ".join(type(driver).__name__ for driver in others)
        warn(
            f"{kinds} drove this run too, and what it did is in what is measured here; measure in "
            "a run without it",
        )


def unsheared(trajectory, what: str, cure: str):
    """Raise ValueError for a sheared run, in which ``what`` is unknown."""
    if is_sheared(trajectory):
        raise ValueError(f"the run was sheared, and {what} is unknown; {cure}")


def equilibrium(trajectory, measure: str):
    """Raise ValueError unless nothing drove the run."""
    if is_sheared(trajectory):
        raise ValueError(
            f"{measure} is of a fluid in equilibrium, and this run was sheared; run it without a "
            "flow"
        )
    if is_pushed(trajectory):
        raise ValueError(
            f"{measure} is of a fluid in equilibrium, and a force drove this run; run it without a "
            "flow"
        )


def warn_unsettled(frames: dict):
    """Warns where a temperature, an energy or the wave of a flow, where recorded, still drifts."""
    warn_of_drift(
        {
            name: frames[name]
            for name in ("temperature", "potential_energy", "wave_velocity")
            if name in frames
        }
    )


def warn_of_drift(series: dict):
    """Warns where any of these series, (frames,) or (replicas, frames) each, rises or falls
    throughout (Kendall's test)."""
    for name, values in series.items():
        pieces = pieces_in_time(values)
        if trend(values):
            warn(
                f"the run is not stationary: its {name} goes from {pieces[0]:.4g} to "
                f"{pieces[-1]:.4g} over the frames used; leave out more at the start, skip=..., "
                "or run longer",
            )


def pieces_in_time(values):
    """Means over stretches of a series (frames,) or (replicas, frames), (pieces,)."""
    mean = np.atleast_2d(np.asarray(values, float)).mean(axis=0)
    return np.array([part.mean() for part in np.array_split(mean, min(PIECES, len(mean)))])


def trend(values) -> int:
    """-1 for a series (frames,) or (replicas, frames) that falls throughout, 1 for one that rises
    (Kendall's test), 0 for one that does neither or does not tell."""
    pieces = pieces_in_time(values)
    if len(pieces) < 2 or not np.all(np.isfinite(pieces)) or np.ptp(pieces) == 0:
        return 0
    # The package it is in takes half a second to load.
    from scipy.stats import kendalltau

    found = kendalltau(np.arange(len(pieces)), pieces)
    return int(np.sign(found.statistic)) if found.pvalue < RARELY else 0
