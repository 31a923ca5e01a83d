"""Transport of beads: mean squared displacement, velocity autocorrelation, diffusion.

Averages run over beads and time origins. Error bars come from pieces that are independent:
replicas, and stretches of time at least twice the longest lag. Blocks of beads would not do,
since beads of one fluid are carried by the same eddies.
"""

import dataclasses
import math

import numpy as np

from dpdjax.checks import plain, positive
from dpdjax.drawing import curve, labelled
from dpdjax.engine.trajectory import Trajectory
from dpdjax.errors import warn
from dpdjax.measure import needs
from dpdjax.measure.blocks import PIECES, pieces_of_member, standard_error
from dpdjax.measure.forgetting import Memory, is_forgotten, memory_of_beads
from dpdjax.measure.reading import chosen_beads, displaced, of_beads, recorded
from dpdjax.measure.replicas import bead_masses, shared, species_of
from dpdjax.measure.results import Result
from dpdjax.measure.statistics import Estimate, from_replicas

BEADS_AT_ONCE = 256
"""Beads Fourier-transformed at a time."""
LEAST_PIECES = 4
"""Independent pieces that tell an error."""


@dataclasses.dataclass(frozen=True, repr=False)
class MeanSquaredDisplacement(Result):
    """``<|r(t) - r(0)|^2>`` relative to the centre of mass.

    Attributes:
        time: lags from 0, (lags,) [time].
        value: (lags,) [length^2].
        error: its standard error, (lags,); NaN where there is a single piece.
        dimensions: axes of the displacement that count.
    """

    time: np.ndarray
    value: np.ndarray
    error: np.ndarray
    dimensions: int = 3

    def scaled(self, *, time=1.0, length=1.0) -> "MeanSquaredDisplacement":
        """The same in other units: ``time=tau, length=R`` for diffusion times and radii."""
        return MeanSquaredDisplacement(
            self.time / time, self.value / length**2, self.error / length**2, self.dimensions
        )

    def plot(self, ax=None, *, fit: tuple[float, float] | None = None):
        """Draw it in double logarithmic scale with its error band; returns the matplotlib axes.

        Args:
            ax: matplotlib axes, or None for new ones.
            fit: first and last lag [time] of a straight line ``2 dimensions D t`` and a constant
                that is drawn too, its D in the legend; :func:`diffusion` tells the error of D.

        Raises ValueError where fewer than two lags are within ``fit``.
        """
        label = labelled("mean squared displacement", "length^2")
        ax = curve(ax, self.time[1:], self.value[1:], self.error[1:], "t [time]", label)
        ax.set(xscale="log", yscale="log")
        if fit is not None:
            t = self.time[_window(self.time, fit)]
            slope, constant = np.polyfit(t, self.value[_window(self.time, fit)], 1)
            told = f"{2 * self.dimensions} D t + const, D = {slope / (2 * self.dimensions):.4g}"
            ax.plot(t, slope * t + constant, "k--", lw=1.5, label=told)
            ax.legend()
        return ax


@dataclasses.dataclass(frozen=True, repr=False)
class VelocityAutocorrelation(Result):
    """How long velocities are remembered, relative to the centre of mass; ``3 kT / m`` at t = 0.

    Attributes:
        time: lags from 0, (lags,) [time].
        value: ``<v(t) . v(0)>``, (lags,) [length^2 / time^2].
        error: its standard error, (lags,); NaN where there is a single piece.
    """

    time: np.ndarray
    value: np.ndarray
    error: np.ndarray

    def plot(self, ax=None):
        """Draw it with its error band; returns the matplotlib axes."""
        label = labelled("velocity autocorrelation", "length^2/time^2")
        return curve(ax, self.time, self.value, self.error, "t [time]", label)


def mean_squared_displacement(
    trajectory: Trajectory,
    *,
    species: int | None = None,
    t_max: float | None = None,
    axes: str = "xyz",
) -> MeanSquaredDisplacement:
    """The mean squared displacement of a run recorded with ``observe=dpd.observe.positions``.

    The drift of the centre of mass of all beads is taken off. Where only one species was recorded
    (``dpd.observe.positions_of``) nothing is: without body forces the momentum of the whole stays
    zero.

    Under shear it is the displacement relative to the flow: what the flow has carried each bead
    along, the integral of ``rate y`` at the places it went through, is taken off. For that frames
    must not be further apart than a strain of 0.3, which leaves the displacement along x off by
    0.75 %, 0.1 by 0.1 %. A flow driven by body forces is not taken off, which is warned of: measure
    across it, ``axes="yz"``.

    Args:
        trajectory: a run, batched or not, sheared or not.
        species: index of the species looked at, or None for every bead; to be given where it alone
            was recorded.
        t_max: longest lag [time]; by default as long as leaves 12 independent pieces.
        axes: of the displacement that count, such as ``"yz"`` for those across a shear flow.

    Returns a ``MeanSquaredDisplacement``. Raises ValueError for a failed run, one without
    positions or with means of them, frames of a sheared one too far apart, a species that is not
    there, a ``t_max`` outside the run, other axes.

    Example:
        >>> found = dpd.measure.mean_squared_displacement(rest, t_max=1.0)
        >>> found.time.round(3)[:3].tolist(), found.dimensions
        ([0.0, 0.05, 0.1], 3)
        >>> across = dpd.measure.mean_squared_displacement(sheared, t_max=1.0, axes="yz")
        >>> across.dimensions
        2
    """
    members, shape = _of_species(trajectory, "position", species, axes)
    time, curves = correlated(trajectory, members, shape, squared_displacement, t_max)
    return MeanSquaredDisplacement(time, curves.mean(axis=0), standard_error(curves), len(axes))


def velocity_autocorrelation(
    trajectory: Trajectory,
    *,
    species: int | None = None,
    t_max: float | None = None,
    axes: str = "xyz",
) -> VelocityAutocorrelation:
    """The velocity autocorrelation of a run recorded with ``observe=dpd.observe.positions``.

    Under shear that of the velocities relative to the flow. Arguments, warnings and errors as in
    :func:`mean_squared_displacement`; returns a ``VelocityAutocorrelation``.

    Example:
        >>> memory = dpd.measure.velocity_autocorrelation(rest, t_max=0.5)
        >>> bool(abs(memory.value[0] - 3.0) < 0.5)  # 3 kT / m
        True
    """
    members, shape = _of_species(trajectory, "velocity", species, axes)
    time, curves = correlated(trajectory, members, shape, autocorrelation, t_max)
    return VelocityAutocorrelation(time, curves.mean(axis=0), standard_error(curves))


def diffusion(
    trajectory: Trajectory,
    *,
    method: str = "msd",
    fit: tuple[float, float] | None = None,
    species: int | None = None,
    axes: str = "xyz",
) -> Estimate:
    """The self-diffusion coefficient ``D`` [length^2 / time] of a run recorded with
    ``observe=dpd.observe.positions``.

    Two readings of one number over the lags of ``fit``: a sixth of the slope of the mean squared
    displacement (Einstein), or a third of the integral of the velocity autocorrelation up to t,
    averaged over t (Green-Kubo). The integral needs frames much closer than the velocity lives; the
    slope does not.

    D is that of the periodic box, short of a large system's by about
    ``2.837 kT / (6 pi viscosity side)`` (Duenweg & Kremer 1993). Under shear it is that relative to
    the flow, the mean over ``axes``: along and across the flow it differs.

    Args:
        trajectory: a run, batched or not, sheared or not.
        method: ``"msd"`` or ``"vacf"``.
        fit: first and last lag [time]: after the velocity is forgotten, and below half the run. By
            default the later half of the lags that leave 12 independent pieces.
        species: index of the species looked at, or None for every bead.
        axes: of the displacement that count, as in
            :func:`dpdjax.measure.mean_squared_displacement`.

    Warns, with lags that would do, where what velocities remember beyond those of ``fit`` is more
    than the error: of the drag, and of the flow that beads have stirred up, by kinetic theory;
    where the slope of the displacements still grows; and where frames are too far apart to
    integrate.

    Raises ValueError for an unknown method, a ``fit`` that holds fewer than two lags or leaves
    fewer than 4 independent pieces, lags at which beads still fly as they started, and as
    :func:`dpdjax.measure.mean_squared_displacement` does.

    Example:
        >>> plan = dpd.Plan(40, 120)
        >>> ran = dpd.run(water, rest.final, key, 0.01, plan, observe=seen, **quiet)
        >>> D = dpd.diffusion(ran, fit=(2.4, 3.6))
        >>> 0.2 < D.value < 0.4
        True
    """
    readings = {
        "msd": ("position", squared_displacement, einstein),
        "vacf": ("velocity", autocorrelation, green_kubo_integral),
    }
    if method not in readings:
        raise ValueError(f'method is {method!r}; it is "msd" or "vacf"')
    name, correlate, read = readings[method]
    members, shape = _of_species(trajectory, name, species, axes)
    memory = memory_of_beads(
        trajectory,
        chosen_beads(trajectory, species),
        bead_masses(trajectory)[0],
        species_of(trajectory),
    )
    return read_diffusion(trajectory, members, shape, correlate, read, fit, memory, 3.0 / len(axes))


BOX = 2.837297 / (6 * math.pi)
"""Sum over the images of a periodic cube, over ``6 pi`` (Duenweg & Kremer 1993)."""


def large_system_diffusion(
    found: Estimate, *, viscosity: float, density: float, kT: float, side: float, mass: float = 1.0
) -> Estimate:
    """The self-diffusion of beads in a large system, from that in a periodic cube.

    Momentum that a bead gives away comes back to it, less of it in a box: ``2.837 kT / (6 pi (eta +
    rho m D) side)`` (Duenweg & Kremer 1993). Momentum spreads by the viscosity, and the bead that
    it comes back to by its own diffusion, which counts where the Schmidt number is small, as in
    most DPD fluids.

    Args:
        found: D in the box, as from :func:`dpdjax.diffusion`.
        viscosity: of the fluid [energy time/length^3].
        density: beads per volume [1/length^3].
        kT, mass: thermal energy, mass of a bead.
        side: of the box [length].

    Example:
        >>> box = dpd.Estimate(0.28, 0.01)
        >>> fluid = {"viscosity": 0.9, "density": 3.0, "kT": 1.0}
        >>> dpd.measure.large_system_diffusion(box, side=10.0, **fluid)
        0.289 +- 0.010
    """
    spreads = viscosity + density * mass * found.value
    added = BOX * kT / (spreads * side)
    return Estimate(found.value + added, found.error, found.blocks)


def read_diffusion(
    trajectory,
    members,
    shape,
    correlate,
    read,
    fit: tuple[float, float] | None,
    memory: Memory,
    factor: float = 1.0,
) -> Estimate:
    """A diffusion coefficient, ``factor`` times that of what ``correlate`` makes of each member by
    ``read`` over ``fit``.

    See :func:`correlated`, and :func:`is_forgotten` for ``memory``.
    """
    time, curves = correlated(
        trajectory, members, shape, correlate, None if fit is None else fit[1]
    )
    window = _window(time, (0.5 * time[-1], time[-1]) if fit is None else fit)
    if len(curves) < LEAST_PIECES:
        raise ValueError(
            f"{len(curves)} independent pieces give no error bar; run 8 times as long as the last "
            f"lag of the fit, {time[-1]:.4g}, or several replicas"
        )
    found = from_replicas(read(time, curves, window)).scaled(factor)
    forgotten = is_forgotten(memory, found, time[window], LEAST_PIECES if fit else PIECES)
    if read is green_kubo_integral:
        _check_close(time, factor * curves, window, found)
    elif forgotten:
        _check_straight(time, factor * curves, window, found)
    return found


def _check_straight(time, curves, window, found: Estimate):
    """Warn where displacements still speed up over the lags of a fit: the slope there is not that
    of diffusion."""
    lags = np.flatnonzero(window)
    if len(lags) < 4:
        return
    early, late = (einstein(time, curves, half) for half in np.array_split(lags, 2))
    change = late - early
    if change.mean() > max(0.1 * early.mean(), 3 * change.std(ddof=1) / np.sqrt(len(change))):
        warn(
            f"the mean squared displacement is not yet straight between {time[lags[0]]:.4g} and "
            f"{time[lags[-1]]:.4g}: its slope grows by {change.mean() / early.mean():.0%} within, "
            f"so {found} is too small; run longer, or fit later lags, fit=(...)",
        )


def _check_close(time, curves, window, found: Estimate):
    """Warn where frames are too far apart for the integral of a velocity autocorrelation, by the
    one of every other frame."""
    even = slice(0, len(time) // 2 * 2 + 1, 2)
    coarse = (
        green_kubo_integral(time[even], curves[:, even], window[even])
        if np.any(window[even])
        else np.nan
    )
    # The trapezoidal rule is off by the square of the step: by a third of what doubling it changes.
    off = float(np.mean(coarse - green_kubo_integral(time, curves, window))) / 3
    if off > found.error:
        warn(
            f"frames {time[1]:.3g} apart are too far for the integral of the velocity "
            "autocorrelation, which is too large by about "
            f'{off:.2g}, more than the error of {found}; record closer frames, or use method="msd"',
        )


def einstein(time, curves, window):
    """A sixth of the least-squares slope of each curve."""
    return np.polyfit(time[window], curves[:, window].T, 1)[0] / 6.0


def green_kubo_integral(time, curves, window):
    """A third of the running integral of each curve, averaged over the window."""
    steps = 0.5 * (curves[:, 1:] + curves[:, :-1]) * np.diff(time)[None, :]
    running = np.concatenate([np.zeros_like(curves[:, :1]), np.cumsum(steps, axis=1)], axis=1)
    return running[:, window].mean(axis=1) / 3.0


def _window(time, fit):
    slack = 1e-4 * time[1]
    window = (time >= fit[0] - slack) & (time <= fit[1] + slack)
    if window.sum() < 2:
        raise ValueError(
            f"fit = ({fit[0]:.4g}, {fit[1]:.4g}) holds {window.sum()} lags, at least 2 are needed; "
            f"frames are {time[1]:.4g} apart: run longer, or record closer frames"
        )
    return window


def correlated(trajectory, members, shape, correlate, t_max):
    """Lags (lags,) and one curve for each independent piece (pieces, lags).

    ``members``: an iterable of values (frames, beads, 3), ``shape`` that of all of them.
    """
    batch, frames = shape[:2]
    interval = shared(trajectory.interval)
    longest = _longest_lag(frames, batch, interval, t_max)
    each = pieces_of_member(batch, frames, longest)
    curves = [
        correlate(piece, longest)
        for member in members
        for piece in np.split(member[: frames // each * each], each)
    ]
    return interval * np.arange(longest + 1), np.array(curves)


def _longest_lag(frames, batch, interval, t_max):
    """The longest lag in frames; by default half of each piece."""
    t_max = None if t_max is None else plain(t_max, "t_max", positive)
    if t_max is None:
        longest = frames // (2 * -(-PIECES // batch))
        if longest < 1:
            raise ValueError(
                f"{frames} frames are too few for {PIECES} pieces; record more, or give the "
                "longest lag"
            )
        return longest
    longest = math.floor(t_max / interval + 1e-4)
    if not 1 <= longest < frames:
        run = interval * (frames - 1)
        raise ValueError(
            f"longest lag {t_max:.4g} is outside the run; frames are {interval:.4g} apart over "
            f"{run:.4g}"
        )
    return longest


def _of_species(trajectory, name: str, species, axes: str):
    """Of each member positions or velocities (frames, beads, axes) of a species, and the shape of
    all; see :func:`_relative`."""
    values = displaced(trajectory) if name == "position" else recorded(trajectory, name)
    needs.warn_unsettled(trajectory.frames)
    return _relative(trajectory, values, species, columns_of(trajectory, axes)), values.shape


def columns_of(trajectory, axes: str) -> list[int]:
    """The axes by number; ValueError for others than some of x, y and z. Warns where all are meant
    and a force drove the run."""
    is_odd = not isinstance(axes, str) or not axes
    if is_odd or len(set(axes)) < len(axes) or not set(axes) <= set("xyz"):
        raise ValueError(f'axes is {axes!r}; give some of "xyz", such as "yz" across a shear flow')
    if len(axes) == 3 and needs.is_pushed(trajectory):
        warn(
            "a force drove this run, and the flow that it made is not taken off the motion of the "
            "beads; "
            'measure across it, axes="yz" for a force along x',
        )
    return ["xyz".index(axis) for axis in axes]


def _relative(trajectory, values, species, columns):
    """Member by member, relative to the centre of mass if all beads are there."""
    beads = chosen_beads(trajectory, species)
    if values.shape[2] < len(species_of(trajectory)):
        yield from of_beads(values, trajectory, beads)[..., columns].astype(float)
        return
    of_members = np.broadcast_to(bead_masses(trajectory), (len(values), values.shape[2]))
    for member, mass in zip(values, of_members):
        yield without_drift(member, mass)[:, beads][..., columns]


def without_drift(values, mass):
    """Values (frames, n, 3) relative to their mean over the mass, in double precision."""
    values = np.asarray(values, float)
    drift = np.einsum("n,fnc->fc", mass / mass.sum(), values)
    return values - drift[:, None, :]


def _products(values, longest: int):
    """Mean over beads and origins of ``x(t0) . x(t0 + t)``, (longest + 1,), for x (frames, n, 3).

    Every lag has the same origins, those that the longest still finds an end for. By Fourier
    transform: the circular product of origins and frames does not wrap at these lags.
    """
    frames, n = values.shape[:2]
    spectrum = 0.0
    for x in np.array_split(values, -(-n // BEADS_AT_ONCE), axis=1):
        ends, origins = np.fft.rfft(x, axis=0), np.fft.rfft(x[: frames - longest], frames, axis=0)
        spectrum = spectrum + np.sum(np.conj(origins) * ends, axis=(1, 2))
    return np.fft.irfft(spectrum, frames)[: longest + 1] / (n * (frames - longest))


def autocorrelation(velocity, longest: int):
    return _products(velocity, longest)


def squared_displacement(position, longest: int):
    """``<x(t)^2> + <x(0)^2> - 2 <x(t) . x(0)>`` over the origins common to all lags, (longest +
    1,)."""
    # Only displacements count: start at the origin, where the difference of squares loses least.
    position = position - position[:1]
    origins = len(position) - longest
    squares = np.mean(np.sum(position**2, axis=2), axis=1)
    means = np.lib.stride_tricks.sliding_window_view(squares, origins).mean(axis=1)
    return np.maximum(means + means[0] - 2.0 * _products(position, longest), 0.0)
