"""Small states that many tests start from, whichever ``fresh`` one a room begins with, and lists of
them that are made through cells."""

import contextlib
import dataclasses

import pytest

import dpdjax as dpd
from dpdjax.pairs import neighbours

SIDE, SKIN = 4.2, 0.2
"""The smallest box whose lists can come from cells at every tilt: 222 beads."""


@pytest.fixture(scope="session")
def equilibrated(simulate, fresh, key, long):
    """A maker of small states: ``equilibrated(fluid, flow=None)``."""

    def equilibrate(fluid, flow=None):
        run = simulate(fluid, fresh, key, 0.01, long, flow)
        assert run.final.status == 0
        return run.final

    return equilibrate


@pytest.fixture(scope="session")
def quiet_water(equilibrated, water):
    return equilibrated(water)


@pytest.fixture(scope="session")
def sheared_water(equilibrated, water):
    """Water sheared at rate 1, the box at strain 2 (wrapped twice)."""
    return equilibrated(water, dpd.shear(1.0))


@contextlib.contextmanager
def lists_from_cells(count=200):
    """Within it lists of so many beads are planned through cells, as they are outside the tests."""
    before, neighbours.IN_CELLS = neighbours.IN_CELLS, count
    try:
        yield
    finally:
        neighbours.IN_CELLS = before


def with_cells(state):
    """The same beads with lists from cells wherever these are planned."""

    def planned(held):
        old = held.grid
        with lists_from_cells():
            new = neighbours.plan_grid(
                old.groups, state.box.lengths, old.reach, old.skin, old.sheared
            )
        new = dataclasses.replace(new, capacity=max(old.capacity, new.capacity))
        return neighbours.allocate(new, state.box, state.position)

    return dataclasses.replace(state, neighbours=tuple(map(planned, state.neighbours)))


WATER = """
[fluid]
kT = 1.0
{place}

[[fluid.conservative]]
law = "soft_repulsion"
a = 25.0
r_c = 1.0

[[fluid.drag]]
law = "central_drag"
gamma = 4.5
r_c = 1.0
"""


def water_toml(place: str = "") -> str:
    """The standard fluid as the table [fluid] of a TOML file, with where its beads are."""
    return WATER.format(place=place)
