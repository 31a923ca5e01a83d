"""TOML files: what they say is what is run; what they say wrong is told, with the nearest right."""

import json
import re
import sys
import tomllib
from importlib.resources import files

import gsd.hoomd
import jax
import numpy as np
import pytest
from small import water_toml

import dpdjax as dpd
from dpdjax.cli import main
from dpdjax.configs import reading
from dpdjax.configs.running import run_file, scan_file
from dpdjax.files.frames import StoredFrames

pytestmark = pytest.mark.filterwarnings("ignore:the ", "ignore:box side", "ignore:.*frames are")

RUN = (
    "seed = 7\ndt = 0.01\n"
    + water_toml("box = 3.5\ndensity = 3.0\nskin = 0.3")
    + """
[flow]
shear = 0.5

[plan]
steps = 40
every = 5

[output]
gsd = "{folder}/water.gsd"
checkpoint = "{folder}/saved"
mean = ["stresses"]
"""
)
SCAN = (
    water_toml()
    + """
[scan]
experiment = "Viscosity"
replicas = 2
store = "{folder}/scan.nc"

[scan.grid]
gamma = [4.5, 9.0]

[scan.settings]
box = 3.5
time = 1.0
settle = 1.0
rate = 0.5
"""
)


@pytest.fixture
def write(tmp_path):
    """``write(text)``: a file, whose output goes beside it."""

    def go(text, name="run.toml"):
        path = tmp_path / name
        path.write_text(text.replace("{folder}", str(tmp_path)))
        return str(path)

    return go


def test_a_run_is_what_python_would_run(write, water, tmp_path):
    result, complete = run_file(write(RUN), progress=False)
    assert complete and result["frames"] == 8 and result["dt"] == 0.01
    key = jax.random.key(7)
    state = dpd.initial_state(water, key, box=3.5, density=3.0, skin=0.3)
    ran = dpd.run(water, state, key, 0.01, dpd.Plan(8, 5), dpd.shear(0.5), progress=False)
    stored = StoredFrames(tmp_path / "water.gsd")
    for name, values in ran.frames.items():
        np.testing.assert_array_equal(stored[name], values)
    assert stored["pressure_drag"].shape == (8, 3, 3)
    assert tomllib.loads(stored.about["toml"])["flow"] == {"shear": 0.5}


def test_resumed_and_refused(write, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys.modules[dpd.stream.__module__], "chunk_frames", lambda *_: 2)
    path = write(RUN)
    assert main(["run", path, "--hours", "1e-9", "--json", "--no-cache"]) == 75
    part = json.loads(capsys.readouterr().out)
    assert part["stopped"] and part["frames"] <= part["of"] == 8
    assert main(["run", path, "--no-cache"]) == 2
    assert "--resume goes on with it, --out takes another name" in capsys.readouterr().err
    assert main(["run", path, "--resume", "--json", "--no-cache"]) == 0
    assert json.loads(capsys.readouterr().out)["frames"] == 8
    with gsd.hoomd.open(str(tmp_path / "water.gsd"), "r") as file:
        assert [frame.configuration.step for frame in file] == list(range(5, 41, 5))


def test_a_scan(write, water, tmp_path, capsys):
    path = write(SCAN, "scan.toml")
    assert main(["scan", path, "--json", "--no-cache"]) == 0
    told = json.loads(capsys.readouterr().out)
    points = told.pop("points")
    assert told == {"runs": 4, "done": 4, "failed": 0, "store": str(tmp_path / "scan.nc")}
    assert [p["gamma"] for p in points] == [4.5, 9.0] and points[0]["replicas"] == 2
    experiment = dpd.experiments.Viscosity(fluid=water, box=3.5, time=1.0, settle=1.0, rate=0.5)
    how = {"key": jax.random.key(0), "replicas": 2, "progress": False}
    table = dpd.scan(experiment, {"gamma": [4.5, 9.0]}, **how)
    stored = dpd.load_scan(tmp_path / "scan.nc")
    assert np.array_equal(stored.viscosity_each, table.viscosity_each)
    assert points[1]["viscosity"] == float(table.viscosity[1])
    assert "[scan.grid]" in stored.attrs["toml"]
    parts = []
    for shard in ("1/2", "2/2"):
        assert main(["scan", path, "--shard", shard, "--json", "--no-cache"]) == 0
        parts.append(json.loads(capsys.readouterr().out)["store"])
    assert [part[-8:] for part in parts] == ["-1of2.nc", "-2of2.nc"]
    again = ["scan", path, "--shard", "1/2", "--out", parts[0], "--json", "--no-cache"]
    assert main(again) == 0, "the store of a part goes by its own name, too"
    assert json.loads(capsys.readouterr().out)["store"] == parts[0]
    assert main(["merge", *parts, "--out", str(tmp_path / "all.nc")]) == 0
    merged = dpd.load_scan(tmp_path / "all.nc")
    assert np.array_equal(merged.viscosity_each, table.viscosity_each)


@pytest.mark.parametrize("kind", ["fluid", "suspension", "marbles", "molecules", "scan"])
def test_examples_are_right(kind, tmp_path, monkeypatch, capsys):
    """They are read to the end, and nothing in them is unknown; what they run is cut short."""
    monkeypatch.chdir(tmp_path)
    command = "scan" if kind == "scan" else "run"
    assert main(["init", kind]) == 0 and f"dpdjax {command}" in capsys.readouterr().out
    assert main(["init", kind]) == 2 and "is there already" in capsys.readouterr().err
    seen = {}

    def instead(*given, **how):
        seen.update(how, given=given)
        raise dpd.RunError("enough")

    monkeypatch.setattr(dpd, "scan" if kind == "scan" else "run", instead)
    text = re.sub(r"^box = .*$", "box = 10.0", (tmp_path / f"{kind}.toml").read_text(), flags=re.M)
    (tmp_path / f"{kind}.toml").write_text(text)
    with pytest.raises(dpd.RunError, match="enough"):
        (scan_file if kind == "scan" else run_file)(f"{kind}.toml", progress=False)
    assert seen["given"] and (files("dpdjax.configs") / "examples" / f"{kind}.toml").is_file()


LAWS = """
def yukawa(h, *, strength, kappa):
    import jax.numpy as jnp
    return strength * jnp.exp(-kappa * h) / h
"""


def test_laws_of_your_own(write, tmp_path, monkeypatch):
    (tmp_path / "mylaws.py").write_text(LAWS)
    monkeypatch.chdir(tmp_path)
    term = 'law = "mylaws:yukawa"\nstrength = 2.0\nkappa = 3.0\nreach = 1.0'
    path = write(RUN.replace('law = "soft_repulsion"\na = 25.0\nr_c = 1.0', term))
    file, _ = reading.load(path)
    from dpdjax.configs.building import fluid_of

    fluid = fluid_of(file.table("fluid"))
    assert fluid.value("strength") == 2.0


WRONG = {
    "spelling": (("kT = 1.0", "kt = 1.0"), r"\[fluid\] has 'kt', which is not known; near is 'kT'"),
    "top": (("seed = 7", "sed = 7"), "the file has 'sed', which is not known; near is 'seed'"),
    "law": (("soft_repulsion", "soft_repulsive"), "near is 'soft_repulsion'"),
    "coefficient": (("gamma = 4.5", "gama = 4.5"), r"\[\[fluid.drag\]\] 1 has 'gama'.*'gamma'"),
    "plan": (("steps = 40", "steps = 40\ntime = 1.0"), r"\[plan\] gives both steps and time"),
    "no plan": (("steps = 40\n", ""), r"\[plan\] gives none of them; give one of steps, time"),
    "times": (("steps = 40", "times = 4"), "diffusion times of colloids; give time"),
    "kind": (("seed = 7", "seed = 'a'"), "the file has seed = 'a'; a whole number is wanted"),
    "flow": (("shear = 0.5", "sheer = 0.5"), r"\[flow\] has 'sheer'.*near is 'shear'"),
    "observable": (('mean = ["stresses"]', 'mean = ["stress"]'), "near is 'stresses'"),
    "value": (("gamma = 4.5", "gamma = -4.5"), r"gamma is -4.5; it must not be negative"),
    "step": (("dt = 0.01", "dt = 5.0"), "dt 5 is too large for the drag"),
    "box": (("box = 3.5", "box = 1.5"), r"\[fluid\]: box side 1.5 is below"),
    "two": (("[flow]", "[marbles]\nbox = 10.0\n[flow]"), "gives both fluid and marbles"),
    "integrator": (("[flow]", '[integrator]\nname = "frog"\n[flow]'), "there are velocity-verlet"),
    "toml": (("[flow]", "[flow"), "is no TOML: .*line"),
    "spacing": (("every = 5", 'spacing = "log"'), 'spacing is "linear" or "logarithmic"'),
    "rate": (("shear = 0.5", "shear = 'fast'"), r"\[flow\]: rate is 'fast'; a number"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_told(name, write, tmp_path):
    (old, new), told = WRONG[name]
    assert old in RUN
    with pytest.raises((ValueError, TypeError), match=told):
        run_file(write(RUN.replace(old, new)), progress=False)
    assert not (tmp_path / "water.gsd").exists()


def test_what_is_wrong_in_a_scan(write, tmp_path):
    for (old, new), told in (
        (('"Viscosity"', '"Viscocity"'), "near is 'Viscosity'"),
        (("box = 3.5", "bax = 3.5"), r"\[scan.settings\] has 'bax'.*near is 'box'"),
        (("gamma = [4.5, 9.0]", "gamma = 4.5"), "the axis gamma of the grid is 4.5"),
        (("replicas = 2", "replicas = 0"), "replicas is 0"),
        (('"Viscosity"', '"nowhere:it"'), "nowhere:it cannot be imported"),
        (("[fluid]", "[flued]"), "near is 'fluid'"),
    ):
        with pytest.raises(ValueError, match=told):
            scan_file(write(SCAN.replace(old, new)), progress=False)
    with pytest.raises(ValueError, match="cannot be read: No such file"):
        scan_file(tmp_path / "none.toml")
