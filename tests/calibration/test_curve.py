"""The fit behind a calibration finds the roots of a noisy curve, and knows how well."""

import math

import numpy as np
import pytest
from synthetic import FLUID, sample

from dpdjax.calibration.curve import Curve, Point, fit, propose
from dpdjax.measure.statistics import Estimate

UPPER, LOWER = 1, -1
TOLERANCE = 0.02


def search(seed, target, sign, x, bias=1.0, points=10):
    """Measure and propose as a calibration does: the answer, its error, and the points."""
    rng, wanted = np.random.default_rng(seed), 0.5 * TOLERANCE * target
    measured, proposal = [], None
    while len(measured) < points:
        coarse = proposal is None or proposal.why == "search"
        measured.append(sample(rng, x, (3.0 if coarse else 0.9) * wanted, bias))
        proposal = propose(measured, target, sign)
        x = proposal.x
        answer = proposal.curve.at(x)
        if (
            proposal.why == "root"
            and min(abs(p.x - x) for p in measured) < 0.1
            and answer.error <= wanted
        ):
            return x, answer.error / abs(proposal.curve.slope(x)), measured
    raise AssertionError(f"no root after {points} points, last proposal {proposal}")


# Far on the right branch, near its foot, on the other side of the minimum.
STARTS = [
    (1.5, UPPER, 3.0), (1.2, UPPER, 1.0), (3.0, UPPER, 2.0), (1.5, UPPER, 0.0),
    (1.5, LOWER, 0.5), (3.0, LOWER, 1.5), (1.5, LOWER, 3.0), (1.2, LOWER, 4.0),
]  # fmt: skip


@pytest.mark.parametrize("target, sign, start", STARTS)
def test_search_ends_at_the_root(target, sign, start):
    for seed in range(20):
        x, _, measured = search(seed, target, sign, start, points=8)
        assert abs(FLUID.value(x) - target) < 4 * 0.5 * TOLERANCE * target
        assert FLUID.slope(x) * sign > 0


@pytest.mark.parametrize(
    "target, sign, start",
    [(1.5, UPPER, 3.0), (1.2, UPPER, 2.5), (1.5, LOWER, 0.5), (1.5, LOWER, 3.0)],
)
def test_error_bars_cover_the_root(target, sign, start):
    answers = [search(seed, target, sign, start) for seed in range(200)]
    deviations = np.array([(x - FLUID.root(target, sign)) / error for x, error, _ in answers])
    assert 0.58 < np.mean(np.abs(deviations) < 1) < 0.82
    assert abs(np.mean(deviations)) < 0.35


@pytest.mark.parametrize("bias", [0.7, 1.3])
@pytest.mark.parametrize(
    "target, sign, start", [(1.5, UPPER, 3.0), (1.2, UPPER, 2.5), (1.5, LOWER, 0.5)]
)
def test_biased_slopes_lead_to_the_same_root(target, sign, start, bias):
    found = np.array([search(seed, target, sign, start, bias)[0] for seed in range(100)])
    excess = FLUID.value(found) - target
    assert abs(excess.mean()) < 0.5 * TOLERANCE * target
    assert np.all(np.abs(excess) < 5 * 0.5 * TOLERANCE * target)


@pytest.mark.parametrize("sign, start", [(UPPER, 3.0), (UPPER, 0.0), (LOWER, 0.0), (LOWER, 3.0)])
def test_target_below_everything_leads_to_the_minimum(sign, start):
    target = FLUID.value(FLUID.lowest) - 0.2
    for seed in range(10):
        rng, measured, x, found = np.random.default_rng(seed), [], start, []
        for _ in range(8):
            measured.append(sample(rng, x, 0.01))
            proposal = propose(measured, target, sign)
            x, found = (
                proposal.x,
                [*found, proposal.why == "minimum" and abs(proposal.x - FLUID.lowest) < 0.35],
            )
        assert all(found[-3:])
        assert proposal.curve.at(x).deviation(FLUID.value(FLUID.lowest)) < 4


def exact(x, value=None):
    return Point(
        x,
        Estimate(FLUID.value(x) if value is None else value, 1e-6),
        Estimate(FLUID.slope(x), 1e-6),
    )


def test_one_point_is_followed_half_a_unit_at_most():
    assert propose(
        [exact(3.0)], FLUID.value(3.0) + 0.8 * FLUID.slope(3.0), UPPER
    ).x == pytest.approx(3.5)
    near = propose([exact(3.0)], FLUID.value(3.0) + 0.05, UPPER)
    assert near.x == pytest.approx(3.0 + 0.05 / FLUID.slope(3.0), abs=1e-3)


def test_root_beyond_reach_is_approached_in_steps():
    proposal = propose([exact(3.0)], 20.0, UPPER)
    assert (proposal.why, proposal.x) == ("search", pytest.approx(3.7))
    assert propose([exact(0.0)], 20.0, LOWER).x == pytest.approx(-0.7)


def test_fit_passes_through_exact_points():
    curve = fit([exact(2.5), exact(3.0), exact(3.3)], 3.0)
    x = np.linspace(2.7, 3.3, 7)
    assert np.allclose(curve(x), FLUID.value(x), atol=2e-3)
    assert np.allclose(curve.slope(x), FLUID.slope(x), atol=2e-2)
    assert curve.at(3.0).error == pytest.approx(1e-6, rel=0.1)


def test_error_grows_away_from_the_points():
    rng = np.random.default_rng(0)
    curve = fit([sample(rng, x, 0.01) for x in (2.8, 3.0, 3.2)], 3.0)
    errors = [curve.at(x).error for x in (3.0, 3.5, 4.0)]
    assert errors[0] < 0.01 < errors[1] < errors[2]


def test_roots_and_minimum_of_a_parabola():
    curve = Curve(1.0, np.array([2.0, 0.0, 1.0]), np.eye(3), -2.0, 4.0)
    assert curve.roots(3.0, UPPER) == [pytest.approx(2.0, abs=1e-6)]
    assert curve.roots(3.0, LOWER) == [pytest.approx(0.0, abs=1e-6)]
    assert curve.roots(1.0, UPPER) == []
    assert curve.minimum() == pytest.approx(1.0, abs=1e-3)
    assert Curve(1.0, np.array([2.0, 1.0]), np.eye(2), -2.0, 4.0).minimum() is None
    assert curve.at(2.0).error == pytest.approx(math.sqrt(3))


def test_search_stays_inside_a_bracket_of_the_minimum():
    """Noisy values with a steep far point, whose polynomial has no minimum between the slopes'
    change of sign."""
    at = lambda gamma, value, slope: Point(
        math.log(gamma), Estimate(value, 0.06), Estimate(slope, 0.1)
    )
    points = [
        at(8.4, 0.95, 0.2),
        at(4.1, 0.84, 0.1),
        at(2.1, 0.83, 0.05),
        at(1.0, 0.5, -0.2),
        at(3.0, 0.82, 0.1),
    ]
    for count in (4, 5):
        proposal = propose(points[:count], 0.3, UPPER)
        assert math.log(1.0) <= proposal.x <= math.log(2.1)
        assert proposal.why == "minimum"
