"""The small states of this room have lists from cells."""

import pytest
from small import SIDE, SKIN, equilibrator, lists_from_cells

import dpdjax as dpd


@pytest.fixture(scope="session")
def fresh(water, key):
    with lists_from_cells():
        return dpd.initial_state(water, key, box=SIDE, density=3.0, skin=SKIN)


@pytest.fixture(scope="session")
def equilibrated(simulate, fresh, key, long):
    return equilibrator(simulate, fresh, key, long)


@pytest.fixture(scope="session")
def quiet_water(equilibrated, water):
    return equilibrated(water)


@pytest.fixture(scope="session")
def sheared_water(equilibrated, water):
    return equilibrated(water, dpd.shear(1.0))


@pytest.fixture(autouse=True)
def cells():
    """Lists planned by a test of this room come from cells too."""
    with lists_from_cells():
        yield
