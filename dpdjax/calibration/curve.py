"""The curve behind a calibration: one polynomial through noisy values and slopes.

All runs so far are fitted together, weighted by their errors. Plain numpy: nothing here
knows what was measured.
"""

import dataclasses
import math

import numpy as np

from dpdjax.measure.statistics import Estimate

CURVATURE = 0.3
"""Allowance for what the polynomial leaves out, relative to the value, per unit of x."""
REACH = 1.0
"""How far beyond the measured points the curve is believed, in units of x."""


@dataclasses.dataclass(frozen=True)
class Point:
    """A value and a slope measured at ``x``, with their standard errors."""

    x: float
    value: Estimate
    slope: Estimate


@dataclasses.dataclass(frozen=True)
class Curve:
    """A fitted polynomial in ``x - centre`` with the covariance of its coefficients."""

    centre: float
    coefficients: np.ndarray
    covariance: np.ndarray
    low: float
    high: float

    def __call__(self, x):
        return np.polynomial.polynomial.polyval(np.asarray(x) - self.centre, self.coefficients)

    def slope(self, x):
        derivative = np.polynomial.polynomial.polyder(self.coefficients)
        return np.polynomial.polynomial.polyval(np.asarray(x) - self.centre, derivative)

    def at(self, x) -> Estimate:
        """Value with its standard error at one ``x``."""
        powers = (x - self.centre) ** np.arange(len(self.coefficients))
        return Estimate(float(self(x)), float(np.sqrt(powers @ self.covariance @ powers)))

    def roots(self, target: float, sign: int) -> list[float]:
        """Where the curve crosses ``target`` with a slope of the given sign, within its reach."""
        x = np.linspace(self.low, self.high, 4001)
        excess = self(x) - target
        k = np.nonzero((excess[1:] > 0) != (excess[:-1] > 0))[0]
        # Between points so close the curve is straight to a ten-millionth of x.
        crossings = x[k] + (x[k + 1] - x[k]) * excess[k] / (excess[k] - excess[k + 1])
        return [float(root) for root in crossings if np.sign(self.slope(root)) == sign]

    def minimum(self) -> float | None:
        """Where the curve is lowest, if that is inside its reach and not at the rim."""
        x = np.linspace(self.low, self.high, 4001)
        k = int(np.argmin(self(x)))
        return float(x[k]) if 0 < k < len(x) - 1 else None


def fit(points: list[Point], centre: float) -> Curve:
    """Weighted least squares of a polynomial to all values and slopes.

    Of degree 1 for one point, 2 for two, 3 for more. A point far from ``centre`` counts
    less: the polynomial is local, and its neglected curvature is part of the error.
    """
    degree = min(3, len(points))
    rows, wanted = [], []
    powers = np.arange(degree + 1)
    for p in points:
        d = p.x - centre
        missing = CURVATURE * abs(p.value.value) * abs(d) ** (degree + 1) / math.factorial(degree)
        missing_slope = CURVATURE * abs(p.value.value) * abs(d) ** degree
        lower = powers * d ** np.maximum(powers - 1, 0)
        for row, estimate, extra in (
            (d**powers, p.value, missing),
            (lower, p.slope, missing_slope),
        ):
            sigma = math.hypot(estimate.error, extra)
            if math.isfinite(sigma) and sigma > 0:
                rows.append(row / sigma)
                wanted.append(estimate.value / sigma)
    design, wanted = np.array(rows, float), np.array(wanted)
    # A weak ridge keeps a curvature that no point speaks of near zero.
    scale = max(abs(p.value.value) for p in points)
    ridge = np.diag(np.where(powers >= 2, 1.0 / (CURVATURE * scale) ** 2, 0.0))
    covariance = np.linalg.pinv(design.T @ design + ridge)
    coefficients = covariance @ design.T @ wanted
    xs = [p.x for p in points]
    return Curve(centre, coefficients, covariance, min(xs) - REACH, max(xs) + REACH)


@dataclasses.dataclass(frozen=True)
class Proposal:
    """Where to measure next, and why: ``"root"``, ``"search"`` or ``"minimum"``."""

    x: float
    why: str
    curve: Curve


def propose(points: list[Point], target: float, sign: int) -> Proposal:
    """The next place to measure: the root on the branch of slope ``sign``, or a step towards it.

    Safeguards: a root must lie within reach of the points, on the asked branch, and inside
    the bracket where one is known; otherwise step along the branch, or to the minimum when
    the target lies below everything on it.
    """
    # A point across the minimum may come as near in value: look on the branch first.
    on_branch = [p for p in points if np.sign(p.slope.value) == sign]
    nearest = min(on_branch or points, key=lambda p: abs(p.value.value - target))
    centre = nearest.x
    for _ in range(3):
        curve = fit(points, centre)
        roots = [r for r in curve.roots(target, sign) if _inside_bracket(points, target, sign, r)]
        if not roots:
            break
        centre = min(roots, key=lambda r: abs(r - nearest.x))
    else:
        # One point knows no curvature: do not follow its slope far.
        step = np.clip(centre - nearest.x, -0.5, 0.5) if len(points) == 1 else centre - nearest.x
        return Proposal(nearest.x + float(step), "root", curve)
    curve = fit(points, min(points, key=lambda p: p.value.value).x)
    lowest = curve.minimum()
    if lowest is not None and curve(lowest) > target:
        return Proposal(lowest, "minimum", curve)
    # On the branch the sign of the step follows the residual; off it, cross to the branch.
    uphill = nearest.value.value < target
    foot = _foot(points, sign)
    if foot is not None and not uphill:
        return Proposal(foot, "minimum", fit(points, min(points, key=lambda p: abs(p.x - foot)).x))
    direction = sign if uphill or not on_branch else -sign
    rim = max(p.x for p in points) if direction > 0 else min(p.x for p in points)
    return Proposal(rim + 0.7 * direction, "search", curve)


def _foot(points, sign):
    """Where the slope changes sign below the branch, from the two points around it; None where it
    was not seen."""
    branch = [p for p in points if np.sign(p.slope.value) == sign]
    beyond = [
        p
        for p in points
        if np.sign(p.slope.value) == -sign and all(sign * (q.x - p.x) > 0 for q in branch)
    ]
    if not branch or not beyond:
        return None
    a, b = min(branch, key=lambda p: sign * p.x), max(beyond, key=lambda p: sign * p.x)
    share = abs(a.slope.value) / (abs(a.slope.value) + abs(b.slope.value))
    return float(a.x + share * (b.x - a.x))


def _inside_bracket(points, target, sign, x):
    """Whether no measured point contradicts a root at ``x`` by three standard errors."""
    for p in points:
        excess = p.value.value - target
        if abs(excess) < 3 * p.value.error or np.sign(p.slope.value) != sign:
            continue
        if (excess > 0) == (sign * (x - p.x) > 0):
            return False
    return True
