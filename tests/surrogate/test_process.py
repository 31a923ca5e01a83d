"""Gaussian processes: values, slopes, bias, errors that cover, and the same traced by JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpdjax.surrogate.process import VALUE, Kernel, Process, Rows, fitted


def curved(x):
    return np.sin(x[:, 0]) + 0.5 * np.cos(1.3 * x[:, 1]) * x[:, 0]


def slope(x):
    return np.cos(x[:, 0]) + 0.5 * np.cos(1.3 * x[:, 1])


@pytest.fixture(scope="module")
def process():
    """Values with twice a bias, values with the bias, slopes: 60 places, errors of 0.01."""
    random = np.random.default_rng(0)
    x = random.uniform(0, 3, (60, 2))
    bias = 0.05 * np.cos(x[:, 0])
    rows = Rows.of(
        np.concatenate([x, x, x[:20]]),
        np.repeat([VALUE, VALUE, 0], [60, 60, 20]),
        np.repeat([1.0, 4.0, 0.0], [60, 60, 20]),
    )
    y = np.concatenate([curved(x) + bias, curved(x) + 4 * bias, slope(x[:20])])
    noise = np.full(len(y), 0.01)
    return fitted(rows, y + 0.01 * random.normal(size=len(y)), noise, biased=True, starts=1)


@pytest.mark.parametrize("axis, exact", [(VALUE, curved), (0, slope)])
def test_errors_cover_what_is_foretold(process, axis, exact):
    x = np.random.default_rng(1).uniform(0.1, 2.9, (400, 2))
    mean, error = process.at(x, axis)
    off = np.abs(mean - exact(x)) / error
    assert np.mean(error) < 0.05
    assert np.mean(off < 1) > 0.55 and np.mean(off < 2) > 0.9


def test_slopes_are_those_of_the_mean(process):
    x, step = np.array([[0.7, 2.1], [2.2, 0.4]]), 1e-4
    for axis in (0, 1):
        move = step * np.eye(2)[axis]
        difference = (process.mean(x + move) - process.mean(x - move)) / (2 * step)
        assert process.mean(x, axis) == pytest.approx(difference, rel=1e-3, abs=1e-4)


def test_the_same_traced(process):
    x = np.random.default_rng(2).uniform(0, 3, (5, 2))
    with jax.enable_x64(True):
        mean, error = jax.jit(process.at)(jnp.asarray(x))
        assert np.allclose(mean, process.at(x)[0], rtol=1e-7)
        assert np.allclose(error, process.at(x)[1], rtol=1e-4)
        gradient = jax.grad(lambda x: process.mean(x[None])[0])(jnp.asarray(x[0]))
    assert gradient == pytest.approx([float(process.mean(x[:1], k)[0]) for k in (0, 1)], rel=1e-6)


def test_what_others_foretell(process):
    off, deviation = process.left_out()
    assert 0.7 < np.std(off / deviation) < 1.3


def test_left_out_is_what_leaving_out_gives():
    x, y = np.linspace(0, 2, 6)[:, None], np.array([0.1, 0.5, 0.4, 0.9, 1.3, 1.2])
    kernel, noise = Kernel(0.5, np.array([0.7])), np.full(6, 0.05)
    whole, keep = Process(Rows.of(x), y, noise, kernel), np.arange(6) != 2
    less = Process(Rows.of(x[keep]), y[keep], noise[keep], kernel)
    off, deviation = (each[2] for each in whole.left_out())
    mean, error = (float(each[0]) for each in less.at(x[2:3]))
    assert off == pytest.approx(y[2] - mean)
    assert deviation == pytest.approx(np.hypot(error, 0.05), rel=1e-6)


def test_more_data_is_as_all_of_it():
    x, y = np.linspace(0, 2, 6)[:, None], np.sin(np.arange(6.0))
    kernel, noise = Kernel(0.5, np.array([0.7])), np.full(6, 0.05)
    whole = Process(Rows.of(x), y, noise, kernel)
    grown = Process(Rows.of(x[:4]), y[:4], noise[:4], kernel).with_more(
        Rows.of(x[4:]), y[4:], noise[4:]
    )
    at = np.array([[0.33], [1.9]])
    assert np.allclose(whole.at(at), grown.at(at))
