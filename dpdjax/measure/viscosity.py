"""Shear viscosity, by four methods that share nothing but the fluid.

| method                   | record                        | notes                           |
|--------------------------|-------------------------------|---------------------------------|
| ``shear_viscosity``      | under ``dpd.shear(rate)``     | the workhorse; at finite rate   |
| ``green_kubo``           | ``green_kubo_record``         | equilibrium; frames close by    |
| ``einstein_helfand``     | ``einstein_helfand_record``   | equilibrium; every step summed  |
| ``sinusoidal_viscosity`` | ``wave_of(waves)``            | needs no stress; k -> 0 by hand |

A batched trajectory is taken as replicas of one system: its members are pooled, and a scan over
numbers is refused.
"""

import functools
import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from dpdjax.checks import Numbers, not_negative, plain
from dpdjax.engine.drivers import Wave
from dpdjax.engine.observables import (
    SMOOTH,
    STATIC,
    instantaneous_viscosity,
    momentum,
    pressure_tensor,
    standard,
    stresses,
    temperature,
)
from dpdjax.engine.record import Recorder, integral, mean
from dpdjax.engine.state import State
from dpdjax.engine.trajectory import Trajectory
from dpdjax.errors import warn
from dpdjax.measure import needs
from dpdjax.measure.replicas import refuse_scan, shared
from dpdjax.measure.statistics import Estimate, block_average, from_replicas
from dpdjax.model.fluid import Fluid
from dpdjax.pairs.laws import DRAG, RANDOM

CLEARLY, LIKELY = 3.0, 0.5
"""Standard errors at which something is there, and the share of an error above which it is told of.
"""


def shear_viscosity(
    trajectory: Trajectory, *, skip: float = 0.1, blocks: int = 20, control: bool = True
) -> Estimate:
    """Viscosity ``-<P_xy> / rate`` of a sheared run [energy time / volume].

    The pressure holds the kinetic, conservative and drag parts. The random part has mean
    zero; where it was recorded too (``observe=dpd.observe.shear_record``), as much of it as lowers
    the variance is subtracted, a control variate.

    Args:
        trajectory: a run with ``flow=dpd.shear(rate)``, one or replicas.
        skip: share of the frames left out at the start.
        blocks: pieces for the error bar.
        control: use the random part where recorded.

    Warns where stress, temperature or energy still drift over the frames used.

    Raises ValueError for a run without shear, or a batch that scans over numbers.

    Example:
        >>> viscosity = dpd.shear_viscosity(sheared, skip=0.2)
        >>> stress = -sheared.frames["pressure_tensor"][8:, 0, 1]
        >>> plain = dpd.shear_viscosity(sheared, skip=0.2, control=False)
        >>> abs(plain.value - float(stress.mean()) / 0.2) < 1e-4
        True
    """
    needs.finished(trajectory)
    rate = _one_rate(trajectory)
    frames = _later(trajectory, skip, need="pressure_tensor")
    series = -frames["pressure_tensor"][..., 0, 1] / rate
    needs.warn_of_drift({"viscosity": series})
    if control and "pressure_random" in frames:
        series = controlled(series, -frames["pressure_random"][..., 0, 1] / rate, blocks)
    return block_average(series, blocks)


def controlled(series, noise, blocks: int = 20):
    """``series`` less the multiple of the zero-mean ``noise`` that explains most of its variance.

    The multiple is fitted to block means, with long blocks the relation of the integrals.
    """
    x, y = (_block_means(a, max(blocks, 32)) for a in (noise, series))
    spread = np.mean((x - x.mean()) ** 2)
    factor = np.mean((x - x.mean()) * (y - y.mean())) / spread if spread > 0 else 0.0
    return series - factor * noise


def _block_means(series, blocks):
    series = np.atleast_2d(np.asarray(series, float))
    each = max(1, min(series.shape[1], blocks // series.shape[0]))
    length = series.shape[1] // each
    return series[:, : each * length].reshape(-1, length).mean(1)


def _sheared(fluid, state) -> dict:
    return standard(fluid, state) | {"pressure_random": stresses(fluid, state)["pressure_random"]}


shear_record = mean(_sheared)
"""What tells a viscosity under shear with least noise: means of the standard record and of the
random stress."""


def green_kubo_record(fluid: Fluid, state: State) -> dict:
    """What :func:`dpdjax.measure.green_kubo` needs of each frame.

    Give it to ``observe=``. ``flux`` and ``reversed_flux``, the smooth stress with the drag and
    less it, (3, 3) [energy / volume]; ``instantaneous_viscosity`` [energy time / volume];
    ``temperature`` [energy].

    Example:
        >>> recorded = dpd.observe.green_kubo_record(water, state)
        >>> recorded["flux"].shape
        (3, 3)
        >>> bool(recorded["instantaneous_viscosity"] > 0)
        True
    """
    smooth = pressure_tensor(fluid, state, STATIC)
    drag = pressure_tensor(fluid, state, (DRAG,))
    return {
        "flux": smooth + drag,
        "reversed_flux": smooth - drag,
        "instantaneous_viscosity": instantaneous_viscosity(fluid, state),
        "temperature": temperature(fluid, state),
    }


def green_kubo(
    trajectory: Trajectory, *, window: float, skip: float = 0.0, blocks: int = 16
) -> Estimate:
    """Viscosity from the stress autocorrelation of a fluid in equilibrium [energy time / volume].

    ``eta_inf + V/kT integral_0^window <[K + C - D](0) [K + C + D](t)> dt`` with the flipped
    sign of the drag at the earlier time (it is odd under time reversal) and the part
    ``eta_inf`` that acts without delay (Jung & Schmid 2016). Averaged over all
    orientations of the stress (Daivis & Evans 1994).

    Args:
        trajectory: a run with ``observe=dpd.observe.green_kubo_record`` and frames close together
            (at most 0.05 time units), one or replicas.
        window: upper limit of the integral [time]; a few correlation times.
        skip: share of the frames left out at the start.
        blocks: independent pieces for the error bar.

    Warns where the stress is still remembered at the end of the window.

    Raises ValueError for a run that was driven.

    Example:
        >>> record = dpd.observe.green_kubo_record
        >>> ran = dpd.run(water, state, key, 0.01, dpd.Plan(400, 4), observe=record, **quiet)
        >>> viscosity = dpd.measure.green_kubo(ran, window=0.5)
        >>> 0.3 < viscosity.value < 2.0
        True
    """
    needs.finished(trajectory)
    needs.equilibrium(trajectory, "the Green-Kubo viscosity")
    frames = _later(trajectory, skip, need="flux")
    dt, volume, kT = _constants(trajectory)
    lags = max(1, round(window / (dt * trajectory.every)))
    early, late = _irreducible(frames["reversed_flux"]), _irreducible(frames["flux"])
    pieces = [_correlate(early[k], late[k], lags) for k in _pieces(early.shape, blocks, lags)]
    correlation = np.array(pieces) * volume / kT
    interval = dt * trajectory.every
    instant = block_average(frames["instantaneous_viscosity"], blocks)
    later = from_replicas(np.trapezoid(correlation, dx=interval, axis=1))
    found = Estimate(
        instant.value + later.value, math.hypot(instant.error, later.error), later.blocks
    )
    _warn_unfaded(correlation, interval, later, found)
    return found


def _warn_unfaded(correlation, interval: float, later: Estimate, found: Estimate):
    """Warn where correlations (pieces, lags) are cut off before they have faded, by what they would
    leave if they faded evenly."""
    lags = correlation.shape[1]
    last = from_replicas(correlation[:, -max(1, lags // 4) :].mean(axis=1))
    first = float(correlation[:, 0].mean())
    if last.deviation(0.0) < CLEARLY:
        return
    # Of an even decay; what has not decayed at all leaves out no number that could be told.
    missing = last.value * later.value / (first - last.value) if first > last.value else math.inf
    if abs(missing) > LIKELY * found.error:
        rest = f"about {missing:.2g}" if math.isfinite(missing) else "most of it"
        warn(
            "the stress is still remembered at the end of the window, to "
            f"{last.value / first:.0%} of what it was, and the viscosity {found} leaves out "
            f"{rest}; give a longer window, a few times {interval * lags:.3g}",
        )


def _flux_integral(fluid, state) -> dict:
    return {"flux_integral": pressure_tensor(fluid, state, (*SMOOTH, RANDOM))}


einstein_helfand_record = [
    integral(_flux_integral),
    Recorder(lambda fluid, state: {"temperature": temperature(fluid, state)}),
]
"""What :func:`dpdjax.measure.einstein_helfand` needs: the whole stress, summed over every step."""


def einstein_helfand(
    trajectory: Trajectory,
    *,
    window: float,
    start: float | None = None,
    skip: float = 0.0,
    blocks: int = 16,
) -> Estimate:
    """Viscosity from the growth of the integrated stress of a fluid in equilibrium
    [energy time / volume].

    The slope of ``V <(integral_0^t P_xy)^2> / 2 kT`` between ``start`` and ``window``
    (Helfand 1960), all orientations, random part included: no decomposition, and the cost
    does not depend on the size of the box.

    Args:
        trajectory: a run with ``observe=dpd.observe.einstein_helfand_record``, one or replicas.
        window, start: times between which the slope is taken [time], after the stress is forgotten;
            from half the window on unless told otherwise.
        skip, blocks: as in :func:`green_kubo`.

    Warns where the integral still grows faster and faster, or slower, between these times.

    Raises ValueError for a run that was driven.

    Example:
        >>> record = dpd.observe.einstein_helfand_record
        >>> ran = dpd.run(water, state, key, 0.01, dpd.Plan(400, 4), observe=record, **quiet)
        >>> viscosity = dpd.measure.einstein_helfand(ran, window=0.5)
        >>> 0.3 < viscosity.value < 2.0
        True
    """
    needs.finished(trajectory)
    needs.equilibrium(trajectory, "the Einstein-Helfand viscosity")
    frames = _later(trajectory, skip, need="flux_integral")
    dt, volume, kT = _constants(trajectory)
    interval = dt * trajectory.every
    first = round((0.5 * window if start is None else start) / interval)
    last = max(round(window / interval), first + 1)
    middle = (first + last) // 2
    jumps = _irreducible(frames["flux_integral"])
    growth = np.array(
        [_growth(jumps[k], (first, middle, last)) for k in _pieces(jumps.shape, blocks, last)]
    )
    slope = lambda a, b, m, n: (
        volume / (2 * kT) * (growth[:, b] - growth[:, a]) / ((n - m) * interval)
    )
    found = from_replicas(slope(0, 2, first, last))
    if middle > first:
        _warn_bent(slope(0, 1, first, middle), slope(1, 2, middle, last), found)
    return found


def _growth(jumps, lags):
    """Mean square of what jumps (frames, ...) add up to over each of some lags."""
    walk = np.concatenate([np.zeros_like(jumps[:1]), np.cumsum(jumps, axis=0)])
    return [np.mean(np.sum((walk[m:] - walk[:-m]) ** 2, axis=-1)) if m else 0.0 for m in lags]


def _warn_bent(early, late, found: Estimate):
    """Warn where slopes (pieces,) of the later half differ from those of the earlier one by more
    than errors explain."""
    change = from_replicas(late - early)
    if change.deviation(0.0) > CLEARLY and abs(change.value) > LIKELY * found.error:
        warn(
            "the integral of the stress is not yet straight: its slope changes by "
            f"{change.value:.2g} between the two halves of the window, and the viscosity {found} "
            "is off; start later, start=..., or give a longer window",
        )


@functools.cache
def wave_of(waves: int = 1) -> Recorder:
    """What :func:`dpdjax.measure.sinusoidal_viscosity` needs: the mean amplitude of the velocity
    wave ``U sin(2 pi waves y / L_y)`` [length / time], as ``wave_velocity``.

    Args:
        waves: periods in the side, those of the force.

    Example:
        >>> wave = dpd.observe.wave_of(2)
        >>> wave is dpd.observe.wave_of(2)  # so runs that record it share their program
        True
    """

    def observe(fluid, state):
        phase = 2 * jnp.pi * waves * state.position[:, 1] / state.box.lengths[1]
        return {
            "wave_velocity": 2 * jnp.mean(state.velocity[:, 0] * jnp.sin(phase)),
            "temperature": temperature(fluid, state),
            "momentum": momentum(fluid, state),
        }

    return mean(observe)


def sinusoidal_viscosity(
    trajectory: Trajectory, *, skip: float = 0.2, blocks: int = 20
) -> Estimate:
    """Viscosity at wavenumber k from the flow under ``dpd.flows.sinusoidal_force``
    [energy time / volume].

    ``density amplitude / (U k^2)`` (Gosling, McDonald & Singer 1973). Take the result at two
    wavelengths to k = 0 with :func:`dpdjax.measure.extrapolate`: kinetic corrections are of order
    k^2 (9 % at L = 10).

    The error bar is right where each of the ``blocks`` is longer than the relaxation time
    ``density / (viscosity k^2)``, about 6 time units at L = 10 and 24 at L = 20.

    Args:
        trajectory: a run with ``observe=dpd.observe.wave_of(waves)``, one or replicas.
        skip: share of the frames left out at the start.
        blocks: pieces for the error bar.

    Raises ValueError for a run without that force, or a sheared one.

    Example:
        >>> flow, wave = dpd.flows.sinusoidal_force(1.0, side=4.0), dpd.observe.wave_of()
        >>> ran = dpd.run(water, state, key, 0.01, dpd.Plan(40, 20), flow, observe=wave, **quiet)
        >>> viscosity = dpd.measure.sinusoidal_viscosity(ran)
        >>> 0.3 < viscosity.value < 2.0
        True
    """
    needs.finished(trajectory)
    wave = trajectory.flow.driver(Wave)
    if wave is None:
        raise ValueError(
            "this run had no dpd.flows.sinusoidal_force; run it with "
            "flow=dpd.flows.sinusoidal_force(...)"
        )
    needs.unsheared(trajectory, "the wave without the shear", "drive the wave in a run without it")
    needs.warn_of_others(trajectory, (Wave,))
    numbers = wave.numbers
    velocity = block_average(
        _later(trajectory, skip, need="wave_velocity")["wave_velocity"], blocks
    )
    density = trajectory.final.n / _constants(trajectory)[1]
    eta = (
        density
        * shared(numbers["amplitude"])
        / (velocity.value * shared(numbers["wavenumber"]) ** 2)
    )
    return Estimate(eta, abs(eta) * velocity.error / abs(velocity.value), velocity.blocks)


def extrapolate(x: Numbers, estimates: Sequence[Estimate]) -> Estimate:
    """Intercept at ``x = 0`` of the straight line through estimates, weighted by their errors.

    For k^2 -> 0, dt -> 0 or rate^2 -> 0.

    Args:
        x: where they are (points,).
        estimates: one for each.

    Raises ValueError for fewer than two points, or other numbers of the two.

    Example:
        >>> steps = [0.01, 0.02]
        >>> pressures = [dpd.Estimate(23.8, 0.1), dpd.Estimate(24.2, 0.1)]
        >>> dpd.measure.extrapolate(np.square(steps), pressures)
        23.67 +- 0.14
    """
    if len(x) < 2 or len(x) != len(estimates):
        raise ValueError(
            f"{len(x)} abscissae for {len(estimates)} estimates; a line needs two of each"
        )
    design = np.stack([np.ones(len(x)), np.asarray(x, float)], 1) / np.array(
        [[e.error] for e in estimates]
    )
    covariance = np.linalg.inv(design.T @ design)
    solution = covariance @ design.T @ np.array([e.value / e.error for e in estimates])
    return Estimate(float(solution[0]), float(np.sqrt(covariance[0, 0])), len(x))


RECORD_OF = {
    "pressure_tensor": "dpd.observe.shear_record",
    "flux": "dpd.observe.green_kubo_record",
    "flux_integral": "dpd.observe.einstein_helfand_record",
    "wave_velocity": "dpd.observe.wave_of()",
}


def _one_rate(trajectory) -> float:
    if trajectory.flow.deforms and not trajectory.flow.is_steady:
        raise ValueError(
            "the shear of this run oscillates; use dpd.measure.moduli(trajectory).viscosity"
        )
    refuse_scan(trajectory)
    needs.warn_of_others(trajectory)
    rate = shared(trajectory.flow.rate)
    if rate == 0:
        raise ValueError("this run had no shear; run it with flow=dpd.shear(rate)")
    return rate


def _later(trajectory, skip, need=None) -> dict:
    """Frames after the first ``skip`` share of them."""
    needs.finished(trajectory)
    if need is not None and need not in trajectory.frames:
        raise ValueError(f"the run recorded no {need!r}; use observe={RECORD_OF[need]}")
    if trajectory.every is None:
        raise ValueError(
            "the frames of this run are not evenly spaced, and a mean over them is none over time: "
            "run it with dpd.Plan(frames, every)"
        )
    skip = plain(skip, "skip", not_negative)
    axis = 1 if trajectory.is_batch else 0
    count = np.shape(trajectory.frames["time"])[axis]
    first = int(skip * count)
    if first >= count:
        raise ValueError(f"skip is {skip:g}, and leaves no frame of {count}; give a share below 1")
    later = lambda v: np.asarray(v)[:, first:] if axis else np.asarray(v)[first:]
    # Beads tell nothing here but how hot they are, and may be too many to be read from a file.
    beads = {"position", "velocity", "image", "unwrapped"}
    beads -= set() if "temperature" in trajectory.frames else {"velocity"}
    frames = {k: later(trajectory.frames[k]) for k in trajectory.frames if k not in beads}
    needs.finite(frames)
    needs.warn_of_heat(trajectory, frames)
    needs.warn_unsettled(frames)
    return frames


def _constants(trajectory):
    """Time step, volume and kT of replicas of one system."""
    refuse_scan(trajectory)
    needs.fixed_box(trajectory)
    lengths = np.asarray(trajectory.final.box.lengths, float).reshape(-1, 3)[0]
    return shared(trajectory.dt), float(lengths.prod()), shared(trajectory.fluid.kT)


def _irreducible(tensors):
    """Symmetric traceless and antisymmetric parts as 18 numbers, scaled so that their products sum
    to one P_xy P_xy.

    By isotropy P_xy P_xy is a tenth of the sum over all nine products of the former, and a sixth of
    that of the latter, which is there where drag acts across the line of centres.
    """
    tensors = np.asarray(tensors, float)
    swapped = np.swapaxes(tensors, -1, -2)
    symmetric, odd = 0.5 * (tensors + swapped), 0.5 * (tensors - swapped)
    trace = np.trace(symmetric, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) / 3
    parts = [(symmetric - trace) / math.sqrt(10.0)] + (
        [odd / math.sqrt(6.0)] if np.any(odd) else []
    )
    flat = np.concatenate([p.reshape(*tensors.shape[:-2], 9) for p in parts], axis=-1)
    return flat if flat.ndim == 3 else flat[None]


def _pieces(shape, blocks, lags):
    """Index of each independent piece of (replicas, frames, ...), none shorter than 4 lags."""
    replicas, frames = shape[:2]
    each = max(1, min(-(-blocks // replicas), frames // (4 * lags)))
    length = frames // each
    if replicas * each < 2 or length <= lags:
        raise ValueError(
            f"{frames} frames of {replicas} replicas are too few for a window of {lags}: run longer"
        )
    return [(r, slice(b * length, (b + 1) * length)) for r in range(replicas) for b in range(each)]


def _correlate(early, late, lags):
    """Sum over components of ``<early(0) late(t)>`` for t = 0 .. lags frames, by FFT."""
    count = early.shape[0]
    size = 1 << (2 * count - 1).bit_length()
    product = np.conj(np.fft.rfft(early, size, axis=0)) * np.fft.rfft(late, size, axis=0)
    sums = np.fft.irfft(product.sum(-1), size)[: lags + 1]
    return sums / (count - np.arange(lags + 1))
