"""A scan's numbers depend on its points alone, whoever computes them and in whatever company; what
fails is named, what is interrupted goes on."""

import concurrent.futures as futures
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import dpdjax as dpd
from dpdjax.scans import drive
from dpdjax.scans.grid import Grid

GRID = {"gamma": [4.5, 9.0], "a": [10.0, 25.0]}
pytestmark = pytest.mark.filterwarnings("ignore:the ", "ignore:3 frames", "ignore:.*drifts")


@pytest.fixture(scope="module")
def experiment(water):
    """Viscosity in a small box."""
    return dpd.experiments.Viscosity(fluid=water, box=3.5, time=1.0, settle=1.0, rate=0.5)


@pytest.fixture(scope="module")
def scan(experiment, key):
    """``scan(grid, **how)``: two replicas."""
    return lambda grid=GRID, **how: dpd.scan(
        experiment, grid, **{"key": key, "replicas": 2, "progress": False} | how
    )


@pytest.fixture(scope="module")
def table(scan):
    return scan()


def same(a, b):
    """Whether two tables hold the same numbers, bit by bit, whatever it took."""
    drop = ["seconds"]
    return a.drop_vars(drop).identical(b.drop_vars(drop))


def test_the_table(table):
    assert dict(table.sizes) == {"gamma": 2, "a": 2, "replica": 2}
    each = table.viscosity_each
    assert np.all(np.isfinite(each)) and len(np.unique(each)) == each.size
    np.testing.assert_allclose(table.viscosity, each.mean("replica"))
    np.testing.assert_allclose(table.viscosity_error, each.std("replica", ddof=1) / np.sqrt(2))
    assert table.viscosity.attrs == {
        "long_name": "shear viscosity",
        "units": "energy time/length^3",
    }
    assert table.gamma.attrs["units"] == "mass/time" and np.all(table.status == 1)
    made = json.loads(table.attrs["made_by"])
    assert made["experiment"]["rate"] == 0.5 and made["version"] == dpd.__version__
    frame = table.to_dataframe()
    assert len(frame) == 8 and "viscosity_error" in frame
    steps = 128 * (round(1.0 / 0.011) + 300)
    assert np.all(table.particle_steps > 128 * 100) and np.all(table.particle_steps < 3 * steps)


def test_a_number_is_that_of_the_point_alone(scan, table):
    """In another order, in part, with more points and replicas around it; as a run by itself."""
    turned = scan({"a": [25.0, 10.0], "gamma": [9.0, 4.5]})
    assert np.array_equal(
        turned.viscosity_each.transpose("gamma", "a", "replica").sel(
            gamma=[4.5, 9.0], a=[10.0, 25.0]
        ),
        table.viscosity_each,
    )
    more = scan({"gamma": [4.5, 20.0], "a": [10.0]}, replicas=3)
    assert np.array_equal(more.viscosity_each[0, 0, :2], table.viscosity_each[0, 0])


def test_members_of_a_batch_have_the_same_numbers(experiment, key, table):
    """The way of an accelerator: all runs of one shape in one batch."""
    grid = Grid.of(GRID, 2)
    units = grid.units()
    keys, points = [grid.key_of(key, u) for u in units], [grid.point(place) for place, _ in units]
    found = drive.driven_together(experiment, keys, points)
    got = [outcome.values["viscosity"].value for outcome in found]
    np.testing.assert_allclose(got, table.viscosity_each.values.ravel(), rtol=1e-9)
    assert [o.particle_steps for o in found] == table.particle_steps.values.ravel().tolist()


def test_shards_make_one_table(scan, table, tmp_path):
    paths = [tmp_path / f"{i}.nc" for i in (1, 2, 3)]
    for i, path in enumerate(paths):
        part = scan(store=path, shard=(i + 1, 3))
        assert (part.status == 0).sum() in (5, 6)
    merged = dpd.merge_scans(paths, tmp_path / "all.nc")
    assert same(merged, table) and same(dpd.load_scan(tmp_path / "all.nc"), table)
    with pytest.raises(ValueError, match=r"shard is \(0, 3\); give \(i, n\) with i from 1 to n"):
        scan(shard=(0, 3))
    with pytest.raises(ValueError, match="paths is empty"):
        dpd.merge_scans([])


def test_interrupted_and_gone_on_with(experiment, scan, table, tmp_path, monkeypatch, capsys):
    """Ctrl-C after two runs: what is done is in the store, and is not done again."""
    genuine, ran, at = drive.Run.alone, [], [7]

    def counted(self, *rest):
        ran.append(self)
        if len(ran) in at:
            at.clear()
            os.kill(os.getpid(), signal.SIGINT)
        return genuine(self, *rest)

    monkeypatch.setattr(drive.Run, "alone", counted)
    part = scan(store=tmp_path / "scan.nc", progress=True)
    assert "ended by SIGINT: the same call does what is missing" in capsys.readouterr().err
    done = int((part.status == 1).sum())
    assert 0 < done < 8 and same(dpd.load_scan(tmp_path / "scan.nc"), part)
    ran.clear()
    whole = scan(store=tmp_path / "scan.nc")
    assert same(whole, table) and len(ran) == 3 * (8 - done)
    ran.clear()
    larger = scan(GRID | {"gamma": [4.5, 9.0, 20.0]}, store=tmp_path / "scan.nc")
    assert len(ran) == 3 * 4 and same(larger.sel(gamma=[4.5, 9.0]), table)
    with pytest.raises(dpd.FileError, match="another scan: key.key.*Give what that began with"):
        dpd.scan(experiment, GRID, key=jax.random.key(8), store=tmp_path / "scan.nc")


def placed(key, *, phi):
    """Refused where nothing can be packed so densely."""
    made = dpd.suspension(key, phi=phi, box=7.2, kT=0.1, skin=0.2, report=None)
    return {"beads": made.state.n, "there": made.phi}


def test_a_point_that_fails_is_named(key):
    with pytest.warns(UserWarning, match="1 of 3 runs failed.*phi = 0.7: volume fraction"):
        table = dpd.scan(placed, {"phi": [0.05, 0.7, 0.1]}, key=key, progress=False)
    assert table.status.values.ravel().tolist() == [1, 2, 1]
    assert "spheres jam" in str(table.reason.values[1, 0]) and np.isnan(table.there[1])
    assert np.all(np.abs(table.there[[0, 2]] - [0.05, 0.1]) < 0.01)
    assert np.all(np.isnan(table.there_error)), "one replica, and no error of its own"


def test_a_run_that_fails_is_named(water, fresh, key):
    def violent(key, *, rate):
        ran = yield dpd.Run(water, fresh, key, 0.01, dpd.Plan(4, 10), dpd.shear(rate))
        return {"hot": ran.frames["temperature"][-1]}

    with pytest.warns(UserWarning, match="rate = 90: stopped between steps .*ran away"):
        table = dpd.scan(violent, {"rate": [0.2, 90.0]}, key=key, progress=False)
    assert np.isfinite(table.hot[0]) and np.isnan(table.hot[1])
    grid = Grid.of({"rate": [0.2, 90.0]}, 1)
    keys = [grid.key_of(key, unit) for unit in grid.units()]
    together = drive.driven_together(violent, keys, [{"rate": 0.2}, {"rate": 90.0}])
    assert not together[0].reason and "ran away" in together[1].reason


def test_a_mistake_in_the_experiment_ends_the_scan(key):
    for wrong, told in (
        (lambda key, x: undefined, "undefined"),  # noqa: F821
        (lambda key, x: 3.0, "the experiment returns 3.0; return estimates or numbers by name"),
        (lambda key, x: {"y": [1.0]}, "returns .* as 'y'"),
        (lambda key, x: (n for n in [3]), "yields 3; yield dpd.Run"),
    ):
        with pytest.raises((NameError, TypeError), match=told):
            dpd.scan(wrong, {"x": [1, 2]}, key=key, progress=False)
    with pytest.raises(ValueError, match="'x', the name of an axis"):
        dpd.scan(lambda key, x: {"x": 1.0}, {"x": [1, 2]}, key=key, progress=False)


def test_what_is_no_grid(experiment, key, tmp_path):
    for grid, error, told in (
        ([1, 2], TypeError, "give values by name"),
        ({"gamma": 4.5}, TypeError, "the axis gamma of the grid is 4.5; give a list"),
        ({"gamma": []}, ValueError, "gamma of the grid has no values"),
        ({"gamma": [1.0, jnp.inf]}, ValueError, "give finite numbers"),
        ({"gamma": [1.0, 1.0]}, ValueError, "give each value once"),
        ({"gamma": [None]}, TypeError, "has None; give numbers or words"),
    ):
        with pytest.raises(error, match=told):
            dpd.scan(experiment, grid, key=key, progress=False)
    with pytest.raises(ValueError, match="replicas is 0"):
        dpd.scan(experiment, GRID, key=key, replicas=0)
    with pytest.raises(dpd.FileError, match="there is no folder"):
        dpd.scan(experiment, GRID, key=key, store=tmp_path / "nowhere" / "scan.nc")
    (tmp_path / "hello.nc").write_text("hello")
    with pytest.raises(dpd.FileError, match="hello.nc is no table of a scan"):
        dpd.scan(experiment, GRID, key=key, store=tmp_path / "hello.nc")
    xarray.Dataset({"x": 1}).to_netcdf(tmp_path / "other.nc", engine="scipy")
    with pytest.raises(dpd.FileError, match="does not tell what made it"):
        dpd.load_scan(tmp_path / "other.nc")


def test_workers_elsewhere(scan, table):
    """Two processes of their own."""
    spawn = multiprocessing.get_context("spawn")
    with futures.ProcessPoolExecutor(2, mp_context=spawn) as pool:
        assert same(scan(executor=pool), table)


KILLER = """
    import os, signal, sys, time, warnings
    import jax, distributed
    warnings.simplefilter("ignore")
    import dpdjax as dpd
    jax.config.update("jax_enable_x64", True)

    def main(folder):
        soft = dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)
        rub = dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)
        water = dpd.fluid([soft], [rub], kT=1.0)
        experiment = dpd.experiments.Viscosity(fluid=water, box=3.5, time=1.0, settle=1.0, rate=0.5)
        how = dict(n_workers=2, threads_per_worker=1, dashboard_address=None)
        with distributed.LocalCluster(**how) as cluster, distributed.Client(cluster) as client:
            first = client.submit(os.getpid)
            pid = first.result()
            jax_ready = client.run(lambda: __import__("jax").devices()[0].platform)
            import threading
            threading.Timer(6.0, os.kill, (pid, signal.SIGKILL)).start()
            dpd.scan(experiment, {grid}, key=jax.random.key(7), replicas=2, progress=False,
                     executor=client.get_executor(), store=folder + "/dask.nc")

    if __name__ == "__main__":
        main(sys.argv[1])
"""


def test_dask_with_a_worker_killed_in_the_middle(table, tmp_path):
    script = tmp_path / "dask_scan.py"
    script.write_text(textwrap.dedent(KILLER).replace("{grid}", repr(GRID)))
    done = subprocess.run(
        [sys.executable, script, tmp_path], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert same(dpd.load_scan(tmp_path / "dask.nc"), table)


def test_a_picture(table):
    ax = dpd.plot_scan(table)
    assert ax.get_ylabel() == "shear viscosity [energy time/length^3]"
    assert ax.get_xlabel() in ("friction [mass/time]", "repulsion [energy/length]")
    assert len(ax.get_legend().get_texts()) == 2
    with pytest.raises(ValueError, match="name is 'speed'; the table has viscosity, temperature"):
        dpd.plot_scan(table, "speed")
    with pytest.raises(ValueError, match="'rate' is no axis of viscosity"):
        dpd.plot_scan(table, x="rate")
