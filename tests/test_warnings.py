"""Warnings are told at the line that led to them, whatever lies between."""

import warnings

import jax
import pytest

import dpdjax as dpd
from dpdjax.errors import warn


def deep(n: int):
    warn("careful") if n == 0 else deep(n - 1)


@pytest.mark.parametrize("depth", [0, 3])
def test_outside_of_the_package(depth):
    """This file is outside; of the package only ``warn`` itself is on the way."""
    with pytest.warns(UserWarning, match="careful") as caught:
        deep(depth)
    assert caught[0].filename == __file__


def test_runs_and_measures_name_the_line_of_the_user():
    water, key = dpd.water(), jax.random.key(0)
    state = dpd.initial_state(water, key, box=4.0, density=3.0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        hot = dpd.run(water, state, key, 0.01, dpd.Plan(100, 5), dpd.shear(3.0), progress=False)
        dpd.shear_viscosity(hot)
    assert len(caught) == 2
    assert {one.filename for one in caught} == {__file__}
