"""A run piece by piece, for sinks of one's own."""

import csv

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd


def test_pieces_are_the_run(water, fresh, key):
    """Of any size: the same bits, and the state each ends at."""
    flow = dpd.shear(0.5)
    whole = dpd.run(water, fresh, key, 0.01, dpd.Plan(7, 4), flow, progress=False)
    pieces = list(dpd.stream(water, fresh, key, 0.01, dpd.Plan(7, 4), flow, piece=3))
    assert [len(piece.frames["step"]) for piece in pieces] == [3, 3, 1]
    for name, values in whole.frames.items():
        np.testing.assert_array_equal(np.concatenate([p.frames[name] for p in pieces]), values)
    np.testing.assert_array_equal(pieces[-1].state.velocity, whole.final.velocity)
    assert [int(piece.state.step) for piece in pieces] == [12, 24, 28]


def test_a_table_written_on_the_way(water, fresh, key, tmp_path):
    """A sink of comma-separated values, that stops the run when it has seen enough."""
    with open(tmp_path / "run.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["time", "temperature"])
        for piece in dpd.stream(water, fresh, key, 0.01, dpd.Plan(1000, 5), piece=4):
            table.writerows(zip(piece.frames["time"], piece.frames["temperature"]))
            file.flush()
            if piece.state.time > 0.5:
                break
    with open(tmp_path / "run.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 12 and float(rows[-1]["time"]) == pytest.approx(0.6)


def test_what_cannot_run_is_refused_at_the_call(water, fresh, key):
    with pytest.raises(ValueError, match="dt 5 is too large"):
        dpd.stream(water, fresh, key, 5.0, dpd.Plan(1))
    with pytest.raises(ValueError, match="give 2 keys"):
        dpd.stream(water.set(gamma=jnp.ones(2)), fresh, key, 0.01, dpd.Plan(1))


def test_failures_of_a_batch_are_told_piece_by_piece(water, fresh, key):
    rates = dpd.shear(jnp.array([0.2, 90.0]))
    keys = jax.random.split(key, 2)
    pieces = list(dpd.stream(water, fresh, keys, 0.01, dpd.Plan(4, 10), rates, piece=2))
    assert list(pieces[-1].failed) == [1] and "ran away" in pieces[-1].failed[1]
    with pytest.raises(dpd.RunError, match="ran away"):
        list(dpd.stream(water, fresh, key, 0.01, dpd.Plan(4, 10), dpd.shear(90.0), piece=2))
