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
import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import dpdjax as dpd
from dpdjax.scans import drive
from dpdjax.scans.grid import Grid
from dpdjax.scans.table import _over_replicas

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
    """Whether two tables hold the same numbers, bit by bit, whatever it took; filters of warnings
    are those of each process."""
    drop = ["seconds", "note"]
    return a.drop_vars(drop).identical(b.drop_vars(drop))


def test_the_table(table):
    assert dict(table.sizes) == {"gamma": 2, "a": 2, "replica": 2}
    each = table.viscosity_each
    assert np.all(np.isfinite(each)) and len(np.unique(each)) == each.size
    np.testing.assert_allclose(table.viscosity, each.mean("replica"))
    # Of two, 68 % by Student's t; or what their own errors come to.
    scatter = each.std("replica", ddof=1) / np.sqrt(2) * 1.8373
    own = np.sqrt((table.viscosity_each_error**2).sum("replica")) / 2
    np.testing.assert_allclose(table.viscosity_error, np.fmax(scatter, own), rtol=1e-4)
    assert table.attrs["complete"] == 1
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


@pytest.mark.parametrize("count", [2, 3, 8])
def test_errors_of_few_replicas_cover(count):
    """Two that happened to agree stated an error 16 times too small."""
    rng = np.random.default_rng(count)
    values = rng.normal(size=(4000, count))
    for own, least in ((np.nan, 0.66), (1.0, 0.68), (0.2, 0.66)):
        _, errors = _over_replicas(values, np.full(values.shape, own))
        share = np.mean(np.abs(values.mean(axis=1)) < errors)
        assert least < share < 0.85


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


def sometimes(key, x):
    if "UNLUCKY" in os.environ:
        raise RuntimeError("no luck")
    return {"y": dpd.Estimate(2.0 * x, 0.1)}


@pytest.mark.filterwarnings("ignore:1 of 1 runs failed")
@pytest.mark.parametrize("which", [(0, 1), (1, 0)])
def test_what_failed_in_one_part_and_was_done_in_another_is_done(tmp_path, monkeypatch, which):
    paths = [tmp_path / "lucky.nc", tmp_path / "unlucky.nc"]
    for path in paths:
        key = jax.random.key(0)
        dpd.scan(sometimes, {"x": [1.0]}, key=key, store=path, progress=False)
        monkeypatch.setenv("UNLUCKY", "1")
    merged = dpd.merge_scans([paths[k] for k in which])
    assert merged.status.values.tolist() == [[1]] and merged.y.values.tolist() == [2.0]


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


def test_a_batch_keeps_what_was_warned_of_with_its_point(water, fresh, key):
    def warm(key, *, rate):
        ran = yield dpd.Run(water, fresh, key, 0.01, dpd.Plan(60, 5), dpd.shear(rate))
        if rate < 1:
            warnings.warn("slow", stacklevel=2)
        return {"temperature": ran.frames["temperature"][-1]}

    points = [{"rate": 0.1}, {"rate": 4.0}]
    found = drive.driven_together(warm, list(jax.random.split(key)), points)
    assert found[0].note == "slow"
    assert "the shear heats it" in found[1].note and "member" not in found[1].note


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
    assert ax.get_ylabel() == "shear viscosity [energy time/length$^3$]"
    assert ax.get_xlabel() in ("friction [mass/time]", "repulsion [energy/length]")
    assert len(ax.get_legend().get_texts()) == 2
    with pytest.raises(ValueError, match="name is 'speed'; the table has viscosity, temperature"):
        dpd.plot_scan(table, "speed")
    with pytest.raises(ValueError, match="'rate' is no axis of viscosity"):
        dpd.plot_scan(table, x="rate")


FACTOR = 1.0


def test_a_larger_grid_is_wanted_where_the_store_has_more(key, tmp_path, monkeypatch):
    """A smaller call erased what it did not ask for; a changed global was not told."""
    one = lambda key, x: {"y": FACTOR * x}
    how = {"key": key, "store": tmp_path / "scan.nc", "progress": False}
    dpd.scan(one, {"x": [1.0, 2.0]}, replicas=2, **how)
    with pytest.raises(dpd.FileError, match="holds what this grid lacks, x = 1.0: give a grid"):
        dpd.scan(one, {"x": [2.0]}, replicas=2, **how)
    with pytest.raises(dpd.FileError, match="lacks, 2 replicas"):
        dpd.scan(one, {"x": [1.0, 2.0]}, **how)
    with pytest.raises(dpd.FileError, match="the table has the axes x, the scan x, z"):
        dpd.scan(one, {"x": [1.0, 2.0], "z": [1]}, **how)
    monkeypatch.setattr(sys.modules[__name__], "FACTOR", 2.0)
    with pytest.raises(dpd.FileError, match="another scan: experiment.uses.FACTOR: 1.0 then, 2.0"):
        dpd.scan(one, {"x": [1.0, 2.0]}, replicas=2, **how)


def test_keys_are_those_of_the_values(key):
    of = lambda **axes: [Grid.of(axes, 1).key_of(key, unit) for unit in Grid.of(axes, 1).units()]
    assert of(x=[4, 9])[0] == of(x=[4, 4.5, 9])[0] == of(x=[4.0])[0]
    a, b = of(x=[1981.2857142857142, 8244.857142857143])
    assert a != b, "32 bits of a hash are too few"
    assert of(a=[1.0], b=[2.0])[0] == of(b=[2.0], a=[1.0])[0] != of(a=[2.0], b=[1.0])[0]


def test_names_of_the_table_are_kept_free(key):
    one = lambda key, **point: {"y_error": 1.0}
    with pytest.raises(ValueError, match="returns 'y_error'"):
        dpd.scan(one, {"x": [1]}, key=key, progress=False)
    for name in ("replica", "status", "y_error"):
        with pytest.raises(ValueError, match=f"is called '{name}', a name of the table"):
            dpd.scan(one, {name: [1]}, key=key, progress=False)
    wide = dpd.scan(lambda key, x: {"y": float(x)}, {"x": [2**40]}, key=key, progress=False)
    assert wide.x.values == wide.y.values == 2**40


def test_failures_are_tried_again_when_told(key, tmp_path):
    mark = str(tmp_path / "tried")

    def shaky(key, *, x):
        with open(mark, "a") as file:
            file.write("x")
        raise RuntimeError("out of memory")

    how = {"key": key, "store": tmp_path / "scan.nc", "progress": False}
    with pytest.warns(UserWarning, match="out of memory"):
        for _ in range(2):
            dpd.scan(shaky, {"x": [1]}, **how)
        assert open(mark).read() == "x"
        dpd.scan(shaky, {"x": [1]}, retry=True, **how)
    assert open(mark).read() == "xx"


def test_an_experiment_may_go_on_after_a_failed_run(water, fresh, key):
    def careful(key, *, rate):
        try:
            yield dpd.Run(water, fresh, key, 0.01, dpd.Plan(4, 10), dpd.shear(rate))
            return {"ran_away": 0.0}
        except dpd.RunError:
            return {"ran_away": 1.0}

    table = dpd.scan(careful, {"rate": [0.2, 90.0]}, key=key, progress=False)
    assert table.ran_away.values.tolist() == [0.0, 1.0]


def test_a_run_that_is_broken_off_is_not_measured(water, fresh, key, monkeypatch):
    """A Ctrl-C inside it gives a trajectory that is short."""

    def broken(*given, **how):
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules[dpd.stream.__module__], "replayed", broken)
    with pytest.raises(drive.Cancelled):
        drive.Run(water, fresh, key, 0.01, dpd.Plan(4, 10)).alone()


def test_threads_compute_as_their_caller(key):
    kind = lambda key, x: {"bytes": float(jnp.ones(1).dtype.itemsize)}
    with jax.enable_x64(False):
        table = dpd.scan(kind, {"x": [1, 2]}, key=key, progress=False)
    assert table.bytes.values.tolist() == [4.0, 4.0]


def test_all_that_ended_is_taken_in(key, monkeypatch):
    """With the hours over, replicas that had ended beside the first were dropped."""
    monkeypatch.setattr(sys.modules[dpd.scan.__module__], "cores", lambda: 4)
    wait = lambda key, x: (time.sleep(0.5), {"y": 1.0})[1]
    table = dpd.scan(wait, {"x": [1, 2, 3, 4, 5, 6]}, key=key, hours=1e-4, progress=False)
    assert (table.status == 1).sum() == 4


def test_a_store_is_written_by_one(key, tmp_path):
    one = lambda key, x: {"y": 1.0}
    how = {"key": key, "store": tmp_path / "scan.nc", "progress": False}

    def inner(key, x):
        dpd.scan(one, {"x": [1]}, **how)

    with pytest.raises(dpd.FileError, match="is being written by another process"):
        _within(inner, how)
    assert not (tmp_path / "scan.nc.lock").exists()


def _within(inner, how):
    """Raise what an experiment saw."""
    seen = []

    def outer(key, x):
        try:
            inner(key, x)
        except dpd.FileError as error:
            seen.append(error)
        return {"y": 1.0}

    dpd.scan(outer, {"x": [1]}, **how)
    raise seen[0]


def test_two_devices_change_nothing(table, tmp_path):
    """Forced ones of the host, in a process of its own."""
    script = tmp_path / "devices.py"
    script.write_text(textwrap.dedent(DEVICES).replace("{grid}", repr(GRID)))
    flags = os.environ | {
        "XLA_FLAGS": f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2"
    }
    command = [sys.executable, script, tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=flags)
    assert done.returncode == 0 and done.stdout.strip() == "2", done.stderr[-2000:]
    assert same(dpd.load_scan(tmp_path / "two.nc"), table)


DEVICES = """
    import sys, warnings
    warnings.simplefilter("ignore")
    import jax, dpdjax as dpd
    jax.config.update("jax_enable_x64", True)
    soft = dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)
    water = dpd.fluid([soft], [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)], kT=1.0)
    experiment = dpd.experiments.Viscosity(fluid=water, box=3.5, time=1.0, settle=1.0, rate=0.5)
    dpd.scan(experiment, {grid}, key=jax.random.key(7), replicas=2, progress=False,
             store=sys.argv[1] + "/two.nc")
    print(len(jax.devices()))
"""


def test_a_fluid_that_the_flow_heats_fails_by_name(water, key):
    """It was a point like the others, at five times its kT."""
    hot = dpd.experiments.Viscosity(fluid=water, box=3.5, strain=4.0, settle=1.0)
    with pytest.warns(UserWarning, match="2 of 2 runs failed.*give a smaller rate"):
        table = dpd.scan(hot, {"rate": [6.0, 8.0]}, key=key, progress=False)
    assert np.all(table.status == 2) and "where kT is 1: give a smaller rate" in str(
        table.reason[0, 0].item()
    )
    assert dpd.scan_points(table)["replicas"].tolist() == [0, 0]
    with pytest.raises(ValueError, match="no run of the table is done"):
        dpd.plot_flow_curve(table)


def test_points_of_one_strain_are_as_long_in_it(water, key):
    made = dpd.experiments.Viscosity(fluid=water, box=3.5, strain=1.0, settle=1.0)
    table = dpd.scan(made, {"rate": [0.5, 1.0]}, key=key, progress=False)
    steps = table.particle_steps.values[:, 0]
    # Three and one time units before, and two or one that are measured.
    assert 1.15 < steps[0] / steps[1] < 1.25
    with pytest.raises(TypeError, match="has 'rates'.* the experiment has .*rate, strain"):
        dpd.scan(made, {"rates": [0.5]}, key=key, progress=False)


def test_a_warning_is_kept_with_its_point(key, tmp_path):
    """One text of two points, and none of a third; told once, by name, and again by the store."""

    def warning(key, *, x):
        if x:
            warnings.warn("too warm", stacklevel=1)
        return {"y": 1.0}

    for _ in range(2):
        with pytest.warns(UserWarning) as told:
            table = dpd.scan(
                warning, {"x": [0, 1, 2]}, key=key, store=tmp_path / "x.nc", progress=False
            )
        assert len(told) == 1
        assert str(told[0].message) == (
            "2 of 3 runs warned of something, see the table's note: x = 1: too warm; "
            "x = 2: too warm"
        )
    assert table.note.values[:, 0].tolist() == ["", "too warm", "too warm"]
