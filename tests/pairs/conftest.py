"""The small states of this room have lists from cells."""

import pytest
from small import (  # noqa: F401
    SIDE,
    SKIN,
    equilibrated,
    lists_from_cells,
    quiet_water,
    sheared_water,
)

import dpdjax as dpd


@pytest.fixture(scope="session")
def fresh(water, key):
    with lists_from_cells():
        return dpd.initial_state(water, key, box=SIDE, density=3.0, skin=SKIN)


@pytest.fixture(autouse=True)
def cells():
    """Lists planned by a test of this room come from cells too."""
    with lists_from_cells():
        yield
