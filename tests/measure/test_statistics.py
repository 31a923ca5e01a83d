"""Error bars are as large as the errors: block averages, estimates and straight lines."""

import math

import numpy as np
import pytest

from dpdjax.measure.statistics import Estimate, block_average, from_replicas
from dpdjax.measure.viscosity import extrapolate

MANY = 500


def ar1(rng, phi, *shape):
    """Gaussian series of variance 1 in which a value remembers a share ``phi`` of the one
    before."""
    x = rng.normal(size=shape)
    x[..., 1:] *= math.sqrt(1 - phi**2)
    for k in range(1, shape[-1]):
        x[..., k] += phi * x[..., k - 1]
    return x


def error_of_mean(phi, count):
    return math.sqrt((1 + phi) / (1 - phi) / count)


@pytest.mark.parametrize(
    "phi, shape",
    [(0.0, (400,)), (0.5, (1000,)), (0.9, (4000,)), (0.9, (4, 1000))],
    ids=["white", "short memory", "long memory", "replicas"],
)
def test_block_errors_are_the_errors(phi, shape):
    series = ar1(np.random.default_rng(1), phi, MANY, *shape)
    estimates = [block_average(s) for s in series]
    assert np.allclose([e.value for e in estimates], series.reshape(MANY, -1).mean(1))
    assert np.mean([e.error for e in estimates]) == pytest.approx(
        error_of_mean(phi, np.prod(shape)), rel=0.08
    )
    covered = np.mean([abs(e.value) < e.error for e in estimates])
    assert 0.61 < covered < 0.75


def test_blocks_are_merged_where_they_are_correlated():
    """Twenty pieces, each no longer than the memory: the merged error is nearer to the truth."""
    series = ar1(np.random.default_rng(2), 0.98, MANY, 1000)
    pieces = series.reshape(MANY, 20, 50).mean(2)
    unmerged = np.mean(pieces.std(1, ddof=1)) / math.sqrt(20)
    merged = np.mean([block_average(s).error for s in series])
    assert 1.1 * unmerged < merged < error_of_mean(0.98, 1000)


def test_few_values():
    assert block_average([1.0, 2.0, 3.0, 4.0]).blocks == 4
    for series in ([1.0, 2.0, 3.0], [[1.0], [2.0], [3.0]]):
        with pytest.raises(ValueError, match="3 values give no error bar; record at least 4"):
            block_average(series)
    with pytest.raises(ValueError, match="1 independent value gives no error bar; at least 2"):
        from_replicas([1.0])


def test_replicas():
    e = from_replicas([1.0, 2.0, 3.0, 6.0])
    assert (e.value, e.blocks) == (3.0, 4)
    assert e.error == pytest.approx(math.sqrt(14 / 3 / 4))


@pytest.mark.parametrize(
    "estimate, text",
    [
        (Estimate(0.85123, 0.0213), "0.851 +- 0.021"),
        (Estimate(0.85123, 0.0996), "0.851 +- 0.100"),
        (Estimate(1234.6, 56.0), "1235 +- 56"),
        (Estimate(-3.0, 1.5), "-3.0 +- 1.5"),
        (Estimate(0.85123, 0.0), "0.85123 +- 0"),
        (Estimate(0.85123, math.nan), "0.85123 +- nan"),
    ],
)
def test_an_estimate_prints(estimate, text):
    assert str(estimate) == repr(estimate) == text


def test_deviation_counts_combined_errors():
    assert Estimate(1.0, 0.1).deviation(1.2) == pytest.approx(2.0)
    assert Estimate(1.0, 0.3).deviation(Estimate(2.0, 0.4)) == pytest.approx(2.0)
    assert (
        Estimate(1.0, 0.0).deviation(1.0) == 0.0 and Estimate(1.0, 0.0).deviation(2.0) == math.inf
    )


def test_scaled_estimates_keep_their_relative_error():
    assert Estimate(2.0, 0.1, 5).scaled(-3.0) == Estimate(-6.0, pytest.approx(0.3), 5)


def test_extrapolation_recovers_a_line():
    x = [0.1, 0.3, 0.4]
    exact = extrapolate(x, [Estimate(2.0 - 5.0 * t, s) for t, s in zip(x, (0.1, 0.2, 0.4))])
    assert exact.value == pytest.approx(2.0)
    two = extrapolate([1.0, 2.0], [Estimate(5.0, 0.1), Estimate(8.0, 0.3)])
    assert (two.value, two.error) == (pytest.approx(2.0), pytest.approx(math.hypot(2 * 0.1, 0.3)))


def test_extrapolation_error_is_the_error():
    rng = np.random.default_rng(3)
    x, sigma = np.array([0.1, 0.3, 0.4]), np.array([0.1, 0.2, 0.4])
    lines = [
        [Estimate(v, s) for v, s in zip(2.0 - 5.0 * x + sigma * noise, sigma)]
        for noise in rng.normal(size=(2000, 3))
    ]
    intercepts = [extrapolate(x, line) for line in lines]
    assert np.std([e.value for e in intercepts]) == pytest.approx(intercepts[0].error, rel=0.06)


def test_one_point_is_no_line():
    with pytest.raises(ValueError, match="1 abscissae for 1 estimates; a line needs two"):
        extrapolate([0.1], [Estimate(1.0, 0.1)])
    with pytest.raises(ValueError, match="2 abscissae for 1"):
        extrapolate([0.1, 0.2], [Estimate(1.0, 0.1)])


def test_quotient_of_estimates():
    a, b = Estimate(2.0, 0.1, 8), Estimate(4.0, 0.4)
    rng = np.random.default_rng(0)
    draws = rng.normal(2.0, 0.1, 200_000) / rng.normal(4.0, 0.04, 200_000)
    assert a.over(b).value == 0.5
    np.testing.assert_allclose(a.over(Estimate(4.0, 0.04)).error, draws.std(), rtol=0.02)
    np.testing.assert_allclose(a.over(b).error, 0.5 * math.hypot(0.05, 0.1))
