"""The command line: quick help, one JSON object, readable text, pictures, errors on standard
error."""

import importlib.util
import json
import math
import subprocess
import sys
from types import SimpleNamespace

import pytest
from synthetic import FLUID, replace_runs

import dpdjax as dpd
from dpdjax.calibration import experiment
from dpdjax.cli import main

PNG = b"\x89PNG\r\n"
VISCOSITY_KEYS = {
    "gamma",
    "gamma_error",
    "viscosity",
    "viscosity_error",
    "temperature",
    "dt",
    "rate",
    "seconds",
    "particle_steps",
    "compile_seconds",
}


@pytest.fixture
def known(monkeypatch):
    """Commands measure a fluid known in closed form."""
    replace_runs(monkeypatch)


def said(capsys, *arguments):
    """Exit status, standard output and standard error of a command."""
    kept = [] if arguments[0] in ("bench", "design") else ["--no-cache"]
    status = main([str(a) for a in arguments] + kept)
    return status, *capsys.readouterr()


@pytest.mark.parametrize(
    "command",
    [[], ["design"], ["viscosity"], ["calibrate"], ["suspension"], ["bench"]],
    ids=" ".join,
)
def test_help_imports_no_jax(command):
    code = f"""
import sys
from dpdjax.cli import main
try:
    main({[*command, "--help"]})
except SystemExit as end:
    assert end.code == 0
assert not {{"jax", "jax_md", "numpy", "gsd", "matplotlib"}} & set(sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage: dpdjax")
    assert ("--tolerance" in done.stdout) == (command in (["viscosity"], ["calibrate"]))
    assert ("--phi" in done.stdout) == (command == ["suspension"])


@pytest.mark.parametrize("place", ["there", "full"])
def test_programs_are_kept_unless_told_otherwise(known, capsys, monkeypatch, place):
    asked = []

    def keep():
        asked.append(place)
        if place == "full":
            raise OSError("no space left")

    monkeypatch.setattr("dpdjax.host.compilation.compilation_cache", keep)
    assert said(capsys, "viscosity", "--json")[0] == 0 and not asked
    assert main(["viscosity", "--json"]) == 0 and asked == [place]
    err = capsys.readouterr().err
    assert ("compiled programs are not kept: no space left" in err) == (place == "full")


def test_module_runs_as_a_command():
    done = subprocess.run(
        [sys.executable, "-m", "dpdjax.cli", "--help"], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0 and "viscosity" in done.stdout and "calibrate" in done.stdout


def test_viscosity_as_json(known, capsys):
    status, out, err = said(capsys, "viscosity", "--gamma", 20, "--json")
    assert status == 0 and out.count("\n") == 1
    result = json.loads(out)
    assert set(result) == VISCOSITY_KEYS
    assert result["gamma"] == 20 and result["gamma_error"] == 0
    assert abs(result["viscosity"] - FLUID.value(math.log(20))) < 4 * result["viscosity_error"]


def test_calibration_as_json(known, capsys):
    status, out, err = said(capsys, "calibrate", "--viscosity", 1.5, "--json")
    assert status == 0 and out.count("\n") == 1
    result = json.loads(out)
    assert set(result) == VISCOSITY_KEYS | {"target", "history"}
    assert result["target"] == 1.5
    assert abs(result["gamma"] - math.exp(FLUID.root(1.5, 1))) < 4 * result["gamma_error"]
    assert abs(result["viscosity"] - 1.5) < 4 * result["viscosity_error"]
    assert len(result["history"]) >= 2
    assert set(result["history"][0]) == {
        "gamma",
        "viscosity",
        "viscosity_error",
        "slope",
        "slope_error",
    }
    assert "slope" in err, "progress goes to standard error"


def test_numbers_reach_the_calibration(known, capsys, monkeypatch):
    asked = {}

    def spy(fluid, parameter, **how):
        asked.update(how, a=float(fluid.value("a")), kT=float(fluid.kT))
        return dpd.calibration_of_tests(fluid, parameter, **how)

    monkeypatch.setattr(dpd, "calibration_of_tests", dpd.calibrate, raising=False)
    monkeypatch.setattr(dpd, "calibrate", spy)
    numbers = {
        "viscosity": 1.5,
        "density": 4.0,
        "tolerance": 0.1,
        "branch": "lower",
        "dt": 0.003,
        "rate": 0.1,
        "box": 6.0,
    }
    options = [x for name, value in numbers.items() for x in (f"--{name}", value)]
    assert said(capsys, "calibrate", *options, "--gamma", 0.5, "--repulsion", 10, "--kT", 2)[0] == 0
    assert {name: asked[name] for name in numbers} == numbers
    assert (asked["guess"], asked["a"], asked["kT"]) == (0.5, 10.0, 2.0)


def test_same_seed_same_words(known, capsys, monkeypatch):
    first = said(capsys, "viscosity", "--json")[1]
    replace_runs(monkeypatch)
    assert json.loads(first) | {"seconds": 0} == json.loads(
        said(capsys, "viscosity", "--json")[1]
    ) | {"seconds": 0}


def test_design_as_json(capsys):
    status, out, _ = said(
        capsys, "design", "--viscosity", 1.1, "--kT", 0.1, "--repulsion", 2.5, "--json"
    )
    (branch,) = json.loads(out)["branches"]
    same = dpd.design(viscosity=1.1, kT=0.1, repulsion=2.5)[0]
    assert status == 0 and branch["gamma"] == [same.gamma.value, same.gamma.error]


def test_design_of_a_liquid_in_si(capsys):
    wanted = ["--viscosity", 0.89e-3, "--diffusion", 2.3e-9]
    status, out, _ = said(capsys, "design", *wanted, "--celsius", 25, "--molecules", 1)
    assert status == 0 and "Pa s" in out and "unit of time" in out
    alone = said(capsys, "design", "--viscosity", 0.89e-3, "--celsius", 25)
    assert alone[0] == 2 and "give --viscosity and --diffusion together" in alone[2]
    loose = said(capsys, "design", "--viscosity", 1.0, "--molecules", 3)
    assert loose[0] == 2 and "give --celsius too" in loose[2]
    status, _, said_ = said(capsys, "design", "--viscosity", 1e3)
    assert status == 2 and "viscosity goes from" in said_


def test_readable_answers(known, capsys):
    lines = said(capsys, "calibrate", "--viscosity", 1.5, "--branch", "lower", "--gamma", 2)[
        1
    ].splitlines()
    assert lines[0] == "wanted viscosity 1.5"
    assert lines[1].startswith("gamma     = 1.") and lines[2].startswith("viscosity = 1.")
    assert all(float(line.split("+-")[1].split()[0]) > 0 for line in lines[1:3]), (
        "enough digits to show the error"
    )
    lines = said(capsys, "viscosity", "--gamma", 2)[1].splitlines()
    assert lines[0] == "gamma     = 2" and "particle-steps" in lines[-1]


@pytest.mark.skipif(not importlib.util.find_spec("matplotlib"), reason="plots are an extra")
@pytest.mark.parametrize(
    "command", [["viscosity"], ["calibrate", "--viscosity", 1.5]], ids=["viscosity", "calibrate"]
)
def test_plot_writes_a_picture(known, capsys, command, tmp_path):
    status, out, err = said(capsys, *command, "--json", "--plot", tmp_path / "result.png")
    assert status == 0 and "gamma" in json.loads(out)
    assert f"wrote {tmp_path / 'result.png'}" in err
    assert (tmp_path / "result.png").read_bytes().startswith(PNG)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["viscosity", "--gamma", -1], "gamma is -1.0; it must not be negative"),
        (["viscosity", "--gamma", 0], "no drag"),
        (["viscosity", "--density", 0], "density is 0.0; it must be above zero"),
        (["viscosity", "--tolerance", 0], "tolerance is 0.0; it must be above zero"),
        (["calibrate", "--viscosity", -1], "viscosity is -1.0; it must be above zero"),
        (
            ["calibrate", "--viscosity", 0.8],
            "viscosity 0.8 cannot be reached with gamma: the smallest measured is 0.9",
        ),
        (["viscosity", "--plot", "nowhere/at/all.png"], "there is no folder nowhere/at"),
        (
            ["suspension", "--phi", 0.1, "--out", "nowhere/at/all.gsd"],
            "there is no folder nowhere/at",
        ),
        (["suspension", "--phi", 0.1, "--out", __file__], "is there already; give another name"),
        (["suspension", "--phi", -0.1], "phi is -0.1; it must be above zero"),
        (["suspension", "--phi", 0.1, "--times", 0], "times is 0.0; it must be above zero"),
        (["suspension", "--phi", 0.1, "--kappa", 0], "kappa is 0.0; it must be above zero"),
        (["suspension", "--phi", 0.1, "--settle", -1], "settle is -1.0; it must not be negative"),
        (["suspension", "--phi", 0.1, "--frames", 1], "frames is 1; it must be at least 2"),
        (["suspension", "--phi", 0.7, "--box", 12], "volume fraction 0.7"),
    ],
    ids=lambda value: " ".join(map(str, value)) if isinstance(value, list) else "",
)
def test_errors_are_one_line_on_standard_error(known, capsys, arguments, message):
    status, out, err = said(capsys, *arguments, "--json")
    assert status == 2 and out == ""
    last = err.splitlines()[-1]
    assert last.startswith(f"dpdjax {arguments[0]}: ") and message in last
    assert "Traceback" not in err


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["viscosity", "--gama", "3"],
        ["calibrate"],
        ["calibrate", "--viscosity", "x"],
        ["suspension"],
    ],
    ids=str,
)
def test_misspelt_commands(capsys, arguments):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    out, err = capsys.readouterr()
    assert end.value.code == 2 and out == "" and err.startswith("usage: dpdjax")


def test_interrupt_ends_quietly(known, capsys, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(experiment, "measure", interrupt)
    status, out, err = said(capsys, "viscosity", "--json")
    assert (status, out, err.splitlines()[-1]) == (130, "", "dpdjax viscosity: interrupted")


def test_calibration_of_real_boxes(capsys, monkeypatch):
    """The whole way, on boxes of 81 beads: at a = 0 the viscosity 1.26 belongs to gamma 5."""
    monkeypatch.setattr(experiment, "PIECE", dpd.Plan(20, 20))
    small = [
        "--box",
        3,
        "--dt",
        0.01,
        "--tolerance",
        0.1,
        "--repulsion",
        0,
        "--branch",
        "lower",
        "--gamma",
        4,
        "--seed",
        1,
    ]
    status, out, err = said(capsys, "calibrate", "--viscosity", 1.26, *small, "--json")
    assert status == 0, err
    result = json.loads(out)
    assert abs(result["gamma"] - 5.0) < 4 * result["gamma_error"] < 6
    assert abs(result["viscosity"] - 1.26) < 4 * result["viscosity_error"] < 0.3
    assert result["particle_steps"] > 1e5 and result["dt"] == 0.01


def test_bench_as_json(capsys):
    small = ("--beads", 200, "--steps", 4, "--batch", 2, "--tangent")
    status, out, err = said(capsys, "bench", *small, "--json")
    assert (status, err, out.count("\n")) == (0, "", 1)
    result = json.loads(out)
    wanted = {
        "particle_steps_per_second",
        "rebuild_seconds",
        "steps_per_rebuild",
        "compile_seconds",
        "peak_memory_bytes",
    }
    assert wanted | {
        "device",
        "tangent_over_primal",
        "beads",
        "batch",
        "dt",
        "skin",
        "list_pairs",
    } == set(result)
    assert all(result[name] > 0 for name in wanted)
    assert result["beads"] == 200 and result["batch"] == 2
    assert 1 <= result["steps_per_rebuild"] <= 200


SMALL = (
    "--phi",
    0.1,
    "--box",
    6,
    "--radius",
    0.5,
    "--density",
    1,
    "--times",
    0.05,
    "--frames",
    10,
)
SUSPENSION_KEYS = {
    "colloids",
    "solvents",
    "phi",
    "tau",
    "dt",
    "integrator",
    "frames",
    "times",
    "temperature",
    "contact_number",
    "file",
    "particle_steps",
    "seconds",
}


def test_suspension_as_json(capsys, tmp_path, monkeypatch):
    """Settled for as long as the run lasts, so that both are one program."""
    monkeypatch.chdir(tmp_path)
    tau = 6 * math.pi * 0.3 * 0.5**3 / 0.1
    status, out, err = said(capsys, "suspension", *SMALL, "--settle", 0.05 * tau, "--json")
    assert status == 0 and out.count("\n") == 1, err
    result = json.loads(out)
    assert set(result) == SUSPENSION_KEYS
    assert result["colloids"] == round(0.1 * 6**3 / (math.pi / 6)) and result[
        "solvents"
    ] == math.floor(0.9 * 6**3)
    assert result["tau"] == pytest.approx(tau) and result["phi"] == pytest.approx(0.1, rel=0.02)
    assert result["frames"] == 10 and result["times"] == pytest.approx(0.05, rel=0.1)
    assert 0.05 < result["temperature"] < 0.2 and result["contact_number"] >= 0
    assert result["file"] is None and list(tmp_path.iterdir()) == []
    assert (
        "41 colloids and 194 solvent beads" in err
        and "dpdjax suspension: note: box side 6 is small" in err
    )


def test_suspension_writes_a_file(capsys, tmp_path):
    gsd = pytest.importorskip("gsd.hoomd")
    path = tmp_path / "sheared.gsd"
    status, out, err = said(
        capsys,
        "suspension",
        *SMALL,
        "--settle",
        0,
        "--rate",
        0.5,
        "--spread",
        0.1,
        "--D0",
        0.5,
        "--out",
        path,
    )
    assert status == 0, err
    lines = out.splitlines()
    assert (
        lines[0].startswith("10 frames over 0.0")
        and "contact number" in lines[1]
        and lines[2] == f"wrote {path}"
    )
    with gsd.open(str(path), "r") as file:
        assert len(file) == 10 and file[-1].particles.types == ["A", "B"]
        assert (
            file[-1].particles.N == 194 + sum(file[-1].particles.typeid)
            and len(set(file[-1].particles.diameter)) > 10
        )
        assert file[-1].configuration.box[3] == pytest.approx(
            0.5 * 0.05 * 6 * math.pi * 0.3 * 0.5**3 / 0.1, rel=0.15
        )


def test_numbers_reach_the_suspension(capsys, monkeypatch):
    asked = {}

    def spy(key, **how):
        asked.update(how)
        raise ValueError("seen")

    monkeypatch.setattr(dpd, "suspension", spy)
    numbers = {
        "phi": 0.2,
        "box": 9.0,
        "radius": 0.7,
        "spread": 0.1,
        "density": 2.0,
        "kT": 0.2,
        "gamma": 9.0,
        "D0": 1.0,
    }
    named = "--integrator", "multiple-time-step"
    numbers |= {"kappa": 20.0, "dt": 1e-4}
    options = [x for name, value in numbers.items() for x in (f"--{name}", value)]
    assert (
        said(capsys, "suspension", *options, *named, "--eta_0", 0.9, "--rate", 0.1)[2].splitlines()[
            -1
        ]
        == "dpdjax suspension: seen"
    )
    assert {name: asked[name] for name in numbers} == numbers
    assert asked["eta_0"] == 0.9 and asked["sheared"] is True
    assert asked["integrator"] == dpd.integrators.MultipleTimeStep()
    said(capsys, "suspension", "--phi", 0.2)
    assert asked["sheared"] is False and asked["dt"] is None and asked["box"] == 30.0
    assert asked["integrator"] is None


@pytest.mark.parametrize("settle", [1, 0], ids=["settling", "running"])
def test_interrupt_of_a_suspension_ends_it(settle, capsys, monkeypatch):
    """A run that Ctrl-C ended before its first frame comes back without any."""
    runs = []

    def run(*_, **how):
        runs.append(how)
        return SimpleNamespace(complete=False, frames={}, final=None)

    fluid = SimpleNamespace(set=lambda **_: None)
    monkeypatch.setattr(
        dpd,
        "suspension",
        lambda *_, **how: SimpleNamespace(
            fluid=fluid, state=None, dt=0.1, tau=10.0, integrator=None
        ),
    )
    monkeypatch.setattr(dpd, "run", run)
    status, out, err = said(capsys, "suspension", "--phi", 0.2, "--settle", settle)
    assert (status, out, err.splitlines()[-1]) == (130, "", "dpdjax suspension: interrupted")
    assert len(runs) == 1, "nothing is run after it"
