"""Compilation: once per shape. Numbers, keys and states never compile anything again."""

import dataclasses
import importlib
import os
import subprocess
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.calibration import experiment
from dpdjax.calibration.goal import viscosity_goal
from dpdjax.engine import compiling
from dpdjax.host import progress
from dpdjax.host.stream import Piece

host_run = importlib.import_module("dpdjax.host.stream")

PLAN = dpd.Plan(3, 7)  # no other test has it


@pytest.fixture(scope="module")
def mixture():
    """``mixture(a, gamma)``: a fluid of two species."""

    def make(a, gamma):
        repulsion = dpd.term(dpd.soft_repulsion, a=a, r_c=1.0)
        drag = dpd.term(dpd.central_drag, gamma=gamma, r_c=1.0)
        return dpd.fluid([repulsion], [drag], kT=1.0, species=2)

    return make


@pytest.fixture(scope="module")
def two_species(sheared_water):
    species = jnp.arange(sheared_water.n, dtype=jnp.int32) % 2
    return dataclasses.replace(sheared_water.restarted(), species=species)


def test_other_numbers_keys_and_states_do_not_recompile(simulate, water, fresh, sheared_water, key):
    simulate(water, sheared_water, key, 0.01, PLAN, dpd.shear(1.0))
    compiled = simulate._cache_size()
    run = simulate(
        water.set(gamma=9.0, a=15.0, kT=0.5, mass=2.0),
        fresh,
        jax.random.key(1),
        0.005,
        PLAN,
        dpd.shear(0.3),
    )
    simulate(water, run.final, key, 0.01, PLAN, dpd.shear(1.0))
    simulate(water, run.final.restarted(), key, 0.01, dpd.Plan(frames=3, every=7), dpd.shear(1.0))
    assert simulate._cache_size() == compiled
    simulate(water, dpd.grow(fresh), key, 0.01, PLAN, dpd.shear(1.0))
    assert simulate._cache_size() == compiled + 1, "another shape is another program"


def test_mixture_of_equal_species_is_one_fluid(
    simulate, mixture, water, sheared_water, two_species, key
):
    same = mixture(np.full((2, 2), 25.0), np.full((2, 2), 4.5))
    two = simulate(same, two_species, key, 0.01, PLAN, dpd.shear(1.0))
    one = simulate(water, sheared_water.restarted(), key, 0.01, PLAN, dpd.shear(1.0))
    np.testing.assert_allclose(two.final.velocity, one.final.velocity, atol=1e-11)
    np.testing.assert_allclose(
        two.frames["pressure_tensor"], one.frames["pressure_tensor"], atol=1e-9
    )


def test_mixtures_share_one_program(simulate, mixture, two_species, key):
    first = mixture([[25.0, 25.0], [25.0, 25.0]], [[4.5, 4.5], [4.5, 4.5]])
    other = mixture([[25.0, 40.0], [40.0, 25.0]], [[4.5, 9.0], [9.0, 2.0]])
    a = simulate(first, two_species, key, 0.01, PLAN, dpd.shear(1.0))
    compiled = simulate._cache_size()
    b = simulate(other, two_species, key, 0.01, PLAN, dpd.shear(1.0))
    assert simulate._cache_size() == compiled
    assert b.final.status == 0
    assert b.frames["potential_energy"][-1] > 1.1 * a.frames["potential_energy"][-1]


def observed(fluid, state):
    return {"energy": state.tally.energy}


def test_a_run_in_many_pieces_is_one_program(water, fresh, key, monkeypatch):
    """The last piece, a shorter one, was compiled on its own: 7 s twice for 30,000 steps of a small
    box."""
    monkeypatch.setattr(host_run, "CHUNK", 150 * 20 * fresh.n)
    monkeypatch.setattr(host_run, "LEAST", 150 * 20)
    run = lambda plan, key=key: dpd.run(
        water, fresh, key, 0.001, plan, observe=observed, progress=False
    )
    run(dpd.Plan(2, 20))
    before = compiling.programs()
    assert run(dpd.Plan(170, 20)).frames["energy"].shape == (170,)
    assert compiling.programs() == before + 1, "one with more room for frames"
    # So are all members of a batch, and it is that of a run.
    if jax.default_backend() == "cpu":
        run(dpd.Plan(170, 20), jax.random.split(key, 3))
        assert compiling.programs() == before + 1


def test_compiling_is_told_and_left_out_of_the_rate(water, fresh, key, capsys):
    other = lambda fluid, state: {"time_again": state.time}
    lines = []
    for _ in range(2):
        dpd.run(water, fresh, key, 0.01, dpd.Plan(2, 5), observe=other)
        lines.append(capsys.readouterr().err)
    assert "compiling" in lines[0] and "compiling" not in lines[1]
    assert "10/10" in lines[0] and "10/10" in lines[1]


def test_seconds_of_compiling_stop_the_clock(monkeypatch, fresh):
    spent = iter([5.0, 95.0, 95.0])
    monkeypatch.setattr(progress.compiling, "seconds", lambda: next(spent))
    with progress.Progress(dpd.Plan(10, 10), shown=True) as line:
        line.compiling()
        line._bar.start_t -= 91.0
        line._bar.last_print_t = line._bar.start_t
        line.advance(Piece(fresh, {"step": np.arange(5), "temperature": np.full(5, 1.25)}, {}))
        assert line._bar.postfix == "T 1.25"
        assert 1.0 <= line._bar.format_dict["elapsed"] < 10.0
        assert line._bar.n == 50


def test_a_function_made_anew_is_told(water, fresh, key):
    """It is another function each time, and each time another program."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(3):
            dpd.run(
                water,
                fresh,
                key,
                0.01,
                dpd.Plan(2, 5),
                observe=lambda fluid, state: {"n": state.time},
                progress=False,
            )
    told = [str(w.message) for w in caught if "anew" in str(w.message)]
    assert (
        len(told) == 1
        and "<lambda> is made anew each time" in told[0]
        and "define it once" in told[0]
    )


def test_programs_inside_programs_count_once():
    clock = compiling.Clock()
    inner = jax.jit(lambda x: jnp.sin(x) * 1.2345)
    jax.jit(lambda x: inner(x) + inner(x + 1.0))(0.5)
    assert 0 < clock.compile_seconds < clock.seconds


def test_slopes_in_several_parameters_are_one_program(water, fresh, key):
    """``a`` and ``gamma`` took one each."""
    state = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), fresh)
    goal = viscosity_goal(0.85, 0.3)
    told = []
    ensemble = experiment.Ensemble(
        water, goal, 3.0, state, jax.random.split(key, 2), 0.01, report=told.append
    )
    before = compiling.programs()
    for k in (0, 1):
        both = experiment.window_tangents(ensemble, water, ("gamma", "a"), k, 0.01, dpd.Plan(2, 3))
        assert np.all(np.isfinite(both)) and both.shape == (2, 2)
    assert compiling.programs() - before <= 2, "one for the first force at most, and one"
    assert told == ["compiling"]


KEPT = """
import dpdjax as dpd
folder = dpd.compilation_cache({folder!r})
import jax
from dpdjax.engine import compiling
repulsion = dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)
fluid = dpd.fluid([repulsion], [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)], kT=1.0)
state = dpd.initial_state(fluid, jax.random.key(0), box=4.2, density=3.0)
events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
run = dpd.run(fluid, state, jax.random.key(1), 0.01, dpd.Plan(2, 5), progress=False)
print(repr(run.frames["potential_energy"].tolist()), sum("cache_hits" in event for event in events))
"""


def test_programs_kept_on_disk_are_found_and_give_the_same_numbers(tmp_path):
    """In silence: on a CPU jax logs a page of its processor's features for every program that it
    reads back."""
    code = KEPT.format(folder=str(tmp_path))
    clean = {
        name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "TF_"))
    }
    first, second = (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=clean
        )
        for _ in range(2)
    )
    numbers, hits = zip(*(run.stdout.rsplit(" ", 1) for run in (first, second)))
    assert numbers[0] == numbers[1]
    assert int(hits[0]) == 0 < int(hits[1])
    assert "Target machine feature" not in second.stderr and "SIGILL" not in second.stderr
