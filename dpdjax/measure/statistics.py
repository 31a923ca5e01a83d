"""Numbers with error bars: estimates, block averages, independent replicas."""

import dataclasses
import math

import numpy as np
from jax.typing import ArrayLike

from dpdjax.checks import is_concrete, whole


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A measured value and its standard error; prints as ``0.851 +- 0.021``.

    Attributes:
        value: the estimate.
        error: its standard error (one sigma).
        blocks: independent pieces the error was read off.

    Example:
        >>> suspension, solvent = dpd.Estimate(1.702, 0.021), dpd.Estimate(0.851, 0.004)
        >>> suspension
        1.702 +- 0.021
        >>> suspension.over(solvent)
        2.000 +- 0.026
        >>> round(solvent.deviation(0.859), 3)  # in standard errors
        2.0
        >>> solvent.scaled(1e-9)
        (8.510 +- 0.040)e-10
    """

    value: float
    error: float
    blocks: int = 0

    def __str__(self):
        plainly = f"{self.value:.6g} +- {self.error:.2g}"
        if not (math.isfinite(self.value) and math.isfinite(self.error) and self.error > 0):
            return plainly
        power = math.floor(math.log10(max(abs(self.value), self.error)))
        if abs(power) > 300:
            return plainly
        unit = 1.0 if -6 < power < 7 else 10.0**power
        value, error = self.value / unit, self.error / unit
        digits = max(0, 1 - math.floor(math.log10(error)))
        if digits > 15:
            return plainly
        written = f"{value:.{digits}f} +- {error:.{digits}f}"
        return written if unit == 1.0 else f"({written})e{power}"

    __repr__ = __str__

    def scaled(self, factor: float) -> "Estimate":
        """The estimate of ``factor`` times the quantity."""
        return Estimate(self.value * factor, self.error * abs(factor), self.blocks)

    def over(self, other: "Estimate") -> "Estimate":
        """The quotient of two independent estimates, as of a viscosity and that of the solvent."""
        value = self.value / other.value
        return Estimate(
            value, math.hypot(self.error, value * other.error) / abs(other.value), self.blocks
        )

    def deviation(self, other: "Estimate | float") -> float:
        """Distance from a number or another estimate in combined standard errors; infinite where
        both are 0."""
        value, error = (
            (other.value, other.error) if isinstance(other, Estimate) else (float(other), 0.0)
        )
        distance, combined = abs(self.value - value), math.hypot(self.error, error)
        return distance / combined if combined > 0 else math.inf if distance > 0 else 0.0


def from_replicas(values) -> Estimate:
    """Mean and standard error of independent values; needs at least two."""
    values = np.asarray(values, float).ravel()
    if values.size < 2:
        raise ValueError(
            f"{values.size} independent value gives no error bar; at least 2 are needed"
        )
    return Estimate(
        float(values.mean()), float(values.std(ddof=1) / math.sqrt(values.size)), values.size
    )


def block_average(series: ArrayLike, blocks: int = 20) -> Estimate:
    """Mean of a correlated series, with the standard error over ``blocks`` pieces of it.

    Args:
        series: values over frames (frames,), or (replicas, frames).
        blocks: pieces in all, each longer than the correlation time. Fewer where the
            error still grows when neighbouring pieces are merged (Flyvbjerg & Petersen 1989).

    Raises ValueError for fewer than 4 values, values that are not finite, and more than two axes;
    TypeError for values that are being traced.

    Example:
        >>> series = np.sin(np.arange(1000)) + 5.0
        >>> dpd.measure.block_average(series, blocks=10)
        5.00... +- 0.00...
        >>> abs(dpd.measure.block_average(rest.frames["temperature"]).value - 1.0) < 0.2
        True
    """
    if not is_concrete(series):
        raise TypeError(
            "block_average works on numbers of the host: inside jit, vmap or grad take jnp.mean, "
            "and average outside"
        )
    blocks = whole(blocks, "blocks")
    try:
        series = np.atleast_2d(np.asarray(series, float))
    except (TypeError, ValueError) as error:
        raise TypeError(f"the series is {series!r}; give numbers, one for each frame") from error
    if series.ndim > 2:
        raise ValueError(
            f"the series has shape {series.shape}; give (frames,) or (replicas, frames), of a "
            "tensor one component"
        )
    if not np.all(np.isfinite(series)):
        raise ValueError(
            "the series holds NaN or infinity: the run failed, or a frame has no such number"
        )
    replicas, frames = series.shape
    per_replica = max(1, min(frames, blocks // replicas))
    if replicas * per_replica < 4:
        per_replica = min(frames, -(-4 // replicas))
    if replicas * per_replica < 4:
        raise ValueError(f"{series.size} values give no error bar; record at least 4 frames")
    length = frames // per_replica
    means = series[:, : per_replica * length].reshape(replicas, per_replica, length).mean(2)
    mean, error, count = float(series.mean()), 0.0, 0
    while True:
        size = means.size
        now = float(means.std(ddof=1) / math.sqrt(size))
        # A merged error is kept where it is larger by more than its own uncertainty.
        if count == 0 or now > error * (1 + 1 / math.sqrt(2 * (size - 1))):
            error, count = now, size
        if means.shape[1] < 2 or size < 16:
            return Estimate(mean, error, count)
        even = means.shape[1] // 2 * 2
        means = means[:, :even].reshape(replicas, -1, 2).mean(2)
