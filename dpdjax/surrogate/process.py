"""Gaussian processes: smooth functions through measured values and slopes, with their errors.

In plain numpy, double precision: a few hundred numbers. What is asked of them may be traced by JAX,
in double precision too.
"""

import dataclasses
import functools
import math
from typing import Any

import numpy as np

VALUE = -1
"""In place of an axis: a value was measured, no slope."""
VAGUE = 10.0
"""Standard deviation that constant and slopes of the trend have before any data."""


@dataclasses.dataclass(frozen=True)
class Kernel:
    """Squared exponential: values a length apart, along any axis, are alike by exp(-1/2).

    Attributes:
        amplitude: standard deviation of the function around its trend.
        lengths: over which it changes, one for each axis (d,).
    """

    amplitude: float
    lengths: np.ndarray

    def __call__(self, a: "Rows", b: "Rows") -> np.ndarray:
        """Covariances of what rows tell (rows of a, rows of b)."""
        xp, lengths = namespace(a.x), np.asarray(self.lengths, float)[None, None, :]
        apart = (a.x[:, None, :] - b.x[None, :, :]) / lengths
        alike = self.amplitude**2 * xp.exp(-0.5 * xp.sum(apart**2, axis=-1))
        first, second = a.axis[:, None], b.axis[None, :]
        if np.all(first == VALUE) and np.all(second == VALUE):
            return alike
        along = lambda axis: _chosen(xp, apart / lengths, axis)
        # The derivative with respect to the second point has the other sign.
        left = xp.where(first == VALUE, 1.0, -along(first))
        right = xp.where(second == VALUE, 1.0, along(second))
        same = (first == second) & (first != VALUE)
        return alike * (
            left * right + np.where(same, 1.0 / lengths[0, 0, np.maximum(first, 0)] ** 2, 0)
        )

    def variance(self, rows: "Rows") -> np.ndarray:
        """Variances of what rows tell (rows,)."""
        lengths = np.asarray(self.lengths, float)[np.maximum(rows.axis, 0)]
        return self.amplitude**2 * np.where(rows.axis == VALUE, 1.0, 1.0 / lengths**2)


def namespace(x) -> Any:
    """The module whose functions take an array: numpy, or that of JAX."""
    if isinstance(x, np.ndarray):
        return np
    import jax.numpy

    return jax.numpy


def _chosen(xp, values, axis):
    """Of values (n, m, d) the one along an axis that is broadcast to (n, m)."""
    axis = np.broadcast_to(np.maximum(axis, 0), values.shape[:2])
    return xp.take_along_axis(values, axis[..., None], axis=-1)[..., 0]


@dataclasses.dataclass(frozen=True)
class Rows:
    """What is told of a function, a number in each row.

    Attributes:
        x: places (n, d).
        axis: of each row the axis along which its number is the slope, ``VALUE`` for a value (n,).
        bias: of each row how many times a bias is in it, which is a function of its own (n,).
    """

    x: np.ndarray
    axis: np.ndarray
    bias: np.ndarray

    @classmethod
    def of(cls, x, axis: int | np.ndarray = VALUE, bias: float | np.ndarray = 0.0) -> "Rows":
        xp = namespace(np.asarray(x, float) if isinstance(x, list | tuple) else x)
        x = xp.atleast_2d(xp.asarray(x, float))
        spread = lambda value, kind: np.broadcast_to(np.asarray(value, kind), (len(x),))
        return cls(x, spread(axis, int), spread(bias, float))

    @property
    def trend(self) -> np.ndarray:
        """What a constant and slopes along all axes are in each row (n, 1 + d)."""
        xp, is_value = namespace(self.x), (self.axis == VALUE)[:, None]
        slopes = np.eye(self.x.shape[1])[np.maximum(self.axis, 0)]
        return xp.concatenate([is_value.astype(float), xp.where(is_value, self.x, slopes)], axis=1)


@dataclasses.dataclass(frozen=True)
class Process:
    """A Gaussian process given data.

    Attributes:
        rows: what was measured.
        y: the numbers (n,).
        noise: their standard errors (n,).
        kernel: of the function.
        bias: kernel of the bias; None where no row has any.
        nugget: scatter that errors do not explain; values that are predicted have it too.
    """

    rows: Rows
    y: np.ndarray
    noise: np.ndarray
    kernel: Kernel
    bias: Kernel | None = None
    nugget: float = 0.0

    @property
    def axes(self) -> int:
        """How many coordinates places have."""
        return self.rows.x.shape[1]

    def _prior(self, a: Rows, b: Rows) -> np.ndarray:
        found = self.kernel(a, b) + VAGUE**2 * a.trend @ b.trend.T
        if self.bias is not None:
            found = found + a.bias[:, None] * b.bias[None, :] * self.bias(a, b)
        return found

    @functools.cached_property
    def _root(self) -> np.ndarray:
        """Inverse of the Cholesky factor of the covariance of the data (n, n)."""
        scatter = np.where(self.rows.axis == VALUE, self.nugget, 0.0)
        covariance = self._prior(self.rows, self.rows) + np.diag(self.noise**2 + scatter**2)
        return np.linalg.inv(np.linalg.cholesky(covariance))

    @functools.cached_property
    def _weights(self) -> np.ndarray:
        return self._root.T @ (self._root @ self.y)

    def mean(self, x, axis: int | np.ndarray = VALUE) -> np.ndarray:
        """The function, or its slope along an axis, at places (n, d); without bias (n,)."""
        return self._prior(Rows.of(x, axis), self.rows) @ self._weights

    def at(self, x, axis: int | np.ndarray = VALUE) -> tuple[np.ndarray, np.ndarray]:
        """As :meth:`mean`, with standard errors (n,)."""
        asked = Rows.of(x, axis)
        xp, cross = namespace(asked.x), self._prior(asked, self.rows)
        known = xp.sum((cross @ self._root.T) ** 2, axis=1)
        trend = VAGUE**2 * xp.sum(asked.trend**2, axis=1)
        scatter = np.where(asked.axis == VALUE, self.nugget, 0.0)
        # Rounding may leave less than nothing of a variance.
        left = xp.maximum(self.kernel.variance(asked) + trend - known, 1e-14)
        return cross @ self._weights, xp.sqrt(left + scatter**2)

    def with_more(self, rows: Rows, y, noise) -> "Process":
        """The process given more data."""
        join = lambda name: np.concatenate([getattr(self.rows, name), getattr(rows, name)])
        return dataclasses.replace(
            self,
            rows=Rows(join("x"), join("axis"), join("bias")),
            y=np.concatenate([self.y, y]),
            noise=np.concatenate([self.noise, noise]),
        )

    @property
    def evidence(self) -> float:
        """Logarithm of how likely the data are, up to a constant."""
        whitened = self._root @ self.y
        return float(-0.5 * whitened @ whitened + np.sum(np.log(np.diag(self._root))))

    def left_out(self) -> tuple[np.ndarray, np.ndarray]:
        """What each row says less what the others foretell of it, and the standard deviation of
        that (n,)."""
        precision = np.sum(self._root**2, axis=0)
        return self._weights / precision, 1.0 / np.sqrt(precision)


def fitted(rows: Rows, y, noise, *, biased: bool = False, starts: int = 3) -> Process:
    """The process under which the data are most likely; ``biased`` where their bias is to be told
    apart from the function.

    Amplitudes, lengths and nugget are found from a few starts. Lengths are kept above a twentieth
    and below twenty times the spread of the places.
    """
    from scipy.optimize import minimize

    y, noise = np.asarray(y, float), np.asarray(noise, float)
    spread, size = np.ptp(rows.x, axis=0), max(float(np.std(y)), 1e-12)
    # Along an axis on which all places are one any length will do.
    spread = np.where(spread > 0, spread, 1.0)
    bound = lambda low, high: (math.log(low), math.log(high))
    bounds = [bound(0.01 * size, 100 * size), *(bound(0.05 * s, 20 * s) for s in spread)]
    bounds += [bound(1e-5 * size, size)] + ([bound(1e-4 * size, size)] if biased else [])

    def process(z):
        amplitude, *lengths = np.exp(z[: 1 + len(spread)])
        kernel = Kernel(float(amplitude), np.array(lengths))
        # A bias is smoother than what it is of, and its few numbers tell no lengths.
        bias = Kernel(float(np.exp(z[-1])), 2 * kernel.lengths) if biased else None
        return Process(rows, y, noise, kernel, bias, float(np.exp(z[1 + len(spread)])))

    def cost(z):
        try:
            made = process(z)
            return -made.evidence, -_slopes_of_evidence(made)
        except np.linalg.LinAlgError:
            return 1e12, np.zeros(len(z))

    best = None
    for share in np.linspace(0.5, 1.5, starts):
        start = [math.log(size), *np.log(share * spread), math.log(0.01 * size)]
        start += [math.log(0.05 * size)] if biased else []
        start = np.clip(start, *np.array(bounds).T)
        found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds)
        best = found if best is None or found.fun < best.fun else best
    return process(best.x)


def _slopes_of_evidence(process: Process, step: float = 1e-6) -> np.ndarray:
    """Slopes of the evidence in the logarithms of amplitude, lengths, nugget, and amplitude of the
    bias where there is one: half the trace of ``(w w^T - K^-1) dK``."""
    outer = np.outer(process._weights, process._weights) - process._root.T @ process._root
    smooth = lambda p: (p.kernel(p.rows, p.rows), _of_bias(p))
    alone, biased = smooth(process)
    half = lambda change: 0.5 * float(np.sum(outer * change))
    found = [half(2 * alone)]
    for k in range(process.axes):
        longer = _longer(process, k, math.exp(step))
        found.append(half((sum(smooth(longer)) - alone - biased) / step))
    is_value = process.rows.axis == VALUE
    found.append(float(np.sum(np.diag(outer)[is_value]) * process.nugget**2))
    return np.array(found + ([half(2 * biased)] if process.bias is not None else []))


def _of_bias(process: Process):
    if process.bias is None:
        return 0.0
    times = process.rows.bias
    return times[:, None] * times[None, :] * process.bias(process.rows, process.rows)


def _longer(process: Process, k: int, factor: float) -> Process:
    """The process with both lengths along an axis longer."""
    stretched = lambda kernel: dataclasses.replace(
        kernel, lengths=np.where(np.arange(process.axes) == k, factor, 1.0) * kernel.lengths
    )
    bias = None if process.bias is None else stretched(process.bias)
    return dataclasses.replace(process, kernel=stretched(process.kernel), bias=bias)
