"""Trajectories as tables, joined, and in diffusion times."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd

PLAN = dpd.Plan(4, 5)
pytestmark = pytest.mark.filterwarnings("ignore:the later half", "ignore:the run ends")


@pytest.fixture(scope="module")
def run(water, fresh, key):
    """``run(state, **how)``: four frames."""

    def of(state=fresh, key=key, plan=PLAN, fluid=water, flow=None, observe=None, out=None):
        observe = observe or [dpd.observe.standard, dpd.observe.positions]
        how = {"observe": observe, "out": out, "progress": False}
        return dpd.run(fluid, state, key, 0.01, plan, flow, **how)

    return of


@pytest.fixture(scope="module")
def first(run):
    return run()


@pytest.fixture(scope="module")
def batch(run, key):
    return run(key=jax.random.split(key, 3))


def test_a_dataset_has_all_that_was_recorded(first, batch):
    pytest.importorskip("xarray")
    data = first.to_xarray()
    assert set(data.data_vars) | set(data.coords) == set(first.frames)
    assert data.pressure_tensor.dims == ("frame", "pressure_tensor_0", "pressure_tensor_1")
    assert data.temperature.dims == ("frame",) and data.temperature.units == "energy"
    np.testing.assert_array_equal(data.position, first.frames["position"])
    many = batch.to_xarray()
    assert many.momentum.dims == ("member", "frame", "momentum_0")
    assert many.time.dims == many.step.dims == ("frame",)
    np.testing.assert_array_equal(many.momentum[2], batch[2].frames["momentum"])
    other = dataclasses.replace(
        batch, frames=batch.frames | {"time": batch.frames["time"] * np.array([[1.0], [2], [3]])}
    )
    assert other.to_xarray().time.dims == ("member", "frame")


def test_a_frame_of_pandas_has_the_numbers(first, batch):
    pytest.importorskip("pandas")
    table = first.to_pandas()
    assert table.index.name == "time" and len(table) == 4
    stress = np.asarray(first.frames["pressure_tensor"])
    np.testing.assert_array_equal(table.pressure_tensor_xy, stress[:, 0, 1])
    np.testing.assert_array_equal(table.pressure_tensor_zx, stress[:, 2, 0])
    np.testing.assert_array_equal(table.index, first.frames["time"])
    scalars = {"step", "strain", "temperature", "potential_energy"}
    assert len(table.columns) == len(scalars) + 9 + 3 + 3 and scalars < set(table.columns)
    many = batch.to_pandas()
    assert many.index.names == ["member", "time"] and len(many) == 12
    np.testing.assert_array_equal(many.loc[1].temperature, batch.frames["temperature"][1])


def test_tables_of_a_file(run, first, tmp_path):
    pytest.importorskip("xarray")
    stored = run(observe=dpd.observe.standard, out=tmp_path / "run.gsd")
    np.testing.assert_allclose(stored.to_xarray().position, first.frames["position"], atol=1e-5)
    pairs = stored.to_pandas().temperature, first.to_pandas().temperature
    np.testing.assert_array_equal(*pairs)


def test_missing_xarray_has_a_cure(first, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    for table in (first.to_xarray, first.to_pandas):
        with pytest.raises(ImportError, match=r'pip install "dpdjax\[scan\]"'):
            table()


def test_runs_in_a_row_are_one(run, first, batch, tmp_path):
    second = run(first.final, out=tmp_path / "later.gsd", observe=dpd.observe.standard)
    whole, both = run(plan=dpd.Plan(8, 5)), first + run(first.final)
    assert (
        both.every == 5 and both.final is not first.final and set(both.frames) == set(whole.frames)
    )
    for name in ("step", "time", "position", "pressure_tensor"):
        np.testing.assert_allclose(both.frames[name], whole.frames[name], rtol=1e-6, atol=1e-6)
    assert (first + second).frames["position"].shape == (8, first.final.n, 3)
    other = run(first.final, observe=dpd.observe.standard)
    with pytest.raises(ValueError, match="the runs recorded .*unwrapped.* only the same"):
        first + other
    later = run(batch.final, key=jax.random.split(jax.random.key(1), 3))
    assert (batch + later).frames["position"].shape == (3, 8, first.final.n, 3)
    stored = run(out=tmp_path / "first.gsd", observe=dpd.observe.standard)
    assert (stored + second).frames["position"].shape == (8, first.final.n, 3)


def test_runs_that_do_not_fit(run, first, batch, water):
    later = run(first.final)
    with pytest.raises(ValueError, match="ends at step 40 and .* first frame is at step 5, not"):
        later + first
    with pytest.raises(ValueError, match="frames every 5 and 2"):
        first + run(first.final, plan=dpd.Plan(4, 2))
    with pytest.raises(ValueError, match="shape"):
        first + batch
    with pytest.raises(ValueError, match="differ in kT"):
        first + run(first.final, fluid=water.set(kT=2.0, energies="keep"))
    with pytest.raises(ValueError, match="differ in flow"):
        first + run(first.final, flow=dpd.shear(0.1))
    with pytest.raises(TypeError, match="unsupported operand"):
        first + 1


def test_tau_is_that_of_the_colloids(first):
    of = lambda fluid: dataclasses.replace(
        first, system=dataclasses.replace(first.system, fluid=fluid)
    )
    colloids = dpd.colloid_fluid(kT=0.1, eta_0=0.3, radius=1.5)
    assert of(colloids).tau == pytest.approx(6 * np.pi * 0.3 * 1.5**3 / 0.1)
    scan = of(colloids.set(eta_0=jnp.array([0.3, 0.6]))).tau
    assert scan[1] == pytest.approx(2 * scan[0])
    with pytest.raises(ValueError, match="no radius.*a time of your own"):
        _ = first.tau
    with pytest.raises(ValueError, match="declares the viscosity.*a time of your own"):
        _ = of(dpd.marble_fluid()).tau
    with pytest.raises(ValueError, match="eta_0 of the fluid must be above zero"):
        _ = of(colloids.set(eta_0=0.0)).tau


def test_the_last_frames_alone(run, first, batch, tmp_path):
    for ran in (first, batch, run(out=tmp_path / "run.gsd")):
        later = ran.last(2)
        assert later.final is ran.final and np.shape(later.frames["time"])[-1] == 2
        axis = 1 if ran.is_batch else 0
        for name in ("time", "position", "temperature"):
            whole = np.moveaxis(np.asarray(ran.frames[name]), axis, 0)
            end = np.moveaxis(np.asarray(later.frames[name]), axis, 0)
            np.testing.assert_array_equal(end, whole[-2:])
    with pytest.raises(ValueError, match="count is 5, and the run has 4 frames"):
        first.last(5)
