"""What a notebook shows of fluids, states and runs: short, and never an error in place of one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine import status as bits


@pytest.fixture(scope="module")
def two(water, fresh):
    """A scan of two, under shear."""
    keys = jax.random.split(jax.random.key(1), 2)
    both = water.set(gamma=jnp.array([4.0, 5.0]))
    return dpd.run(both, fresh, keys, 0.01, dpd.Plan(3, 2), dpd.shear(0.5), progress=False)


def test_a_state_says_what_it_is(fresh, two):
    assert repr(fresh) == f"State({fresh.n} beads, box 4.2 x 4.2 x 4.2, step 0, time 0)"
    assert (
        repr(two.final)
        == f"State(2 members of {fresh.n} beads, box 4.2 x 4.2 x 4.2 at strain 0.03, step 6, time "
        "0.06)"
    )
    broken = dataclasses.replace(fresh, status=jnp.uint32(bits.RUN_AWAY))
    assert "the beads ran away" in repr(broken)


def test_a_run_says_what_it_recorded(two):
    told = repr(two)
    assert (
        told.startswith("Trajectory(3 frames, one in 2 steps of 0.01: ")
        and "pressure_tensor (2, 3, 3, 3)" in told
    )
    partial = dataclasses.replace(two, complete=False, failed=((1, "why"),))
    assert "interrupted, members [1] failed" in repr(partial) and len(told) < 400


def test_a_term_says_its_numbers(water):
    repulsion, drag = water.interactions[0].terms
    assert (repr(repulsion), repr(drag)) == (
        "soft_repulsion(a=25, r_c=1)",
        "central_drag(gamma=4.5, r_c=1)",
    )
    mine = dpd.term(dpd.central_drag, gamma=2.0, r_c=1.0, projector="full", origin="surface")
    assert repr(mine) == "central_drag(gamma=2, r_c=1, projector='full', origin='surface')"


LEAVES = {
    "axes": lambda x: 0,
    "none": lambda x: None,
    "shapes": lambda x: jax.ShapeDtypeStruct(np.shape(x), float),
}


@pytest.mark.parametrize("of", LEAVES.values(), ids=LEAVES)
def test_whatever_the_leaves_are_something_is_said(two, of):
    """Error messages of JAX print trees of axes and of shapes."""
    for whole in (two, two.final, two.fluid, two.fluid.interactions[0].terms[0]):
        other = jax.tree.map(of, whole)
        assert repr(other) and str(other)


def test_traced_numbers_are_told_as_such(water, fresh):
    said = []

    @jax.jit
    def look(fluid, state):
        said.extend([repr(fluid), repr(state), repr(fluid.interactions[0].terms)])

    look(water, fresh)
    assert "traced" in said[0] and "not known" in said[1] and "traced" in said[2]


def test_notebooks_see_tables(water, two):
    """Short, escaped, and of all that is said of itself."""
    drag = water.interactions[0].terms[1]
    for shown, words in (
        (water, ("kT 1", "soft_repulsion", "energies")),
        (drag, ("central_drag", "gamma", "4.5")),
        (two, ("temperature", "2 steps")),
        (two.final, ("2 members", "box")),
    ):
        table = shown._repr_html_()
        assert table.startswith("<table>") and len(table) < 2000
        assert all(word in table for word in words), table
