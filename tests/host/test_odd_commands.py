"""Whatever is typed at a command, it works, or one line on standard error says what cannot be."""

import contextlib
import io
import pathlib

import hypothesis
import hypothesis.strategies as st
import pytest
from odd import ALIKE, LONGEST
from small import water_toml
from synthetic import replace_runs

from dpdjax.calibration import experiment
from dpdjax.cli import main

ODD = ["nan", "inf", "-1", "0", "-0.0", "1e300", "1e-300", "much", "", "1,5", "None"]
SMALL = {"--phi": "0.1", "--box": "6", "--times": "0.0001", "--settle": "0", "--frames": "2"}
COMMON = {
    "--repulsion": "25",
    "--density": "3",
    "--kT": "1",
    "--dt": "0.01",
    "--seed": "0",
    "--integrator": "velocity-verlet",
    "--gamma": "4.5",
}
FITTED = COMMON | {"--rate": "0.2", "--box": "4", "--tolerance": "0.1"}
COMMANDS = {
    "viscosity": FITTED,
    "calibrate": FITTED | {"--viscosity": "1.3", "--branch": "upper"},
    "suspension": SMALL
    | {name: value for name, value in COMMON.items() if name != "--repulsion"}
    | {"--kT": "0.1", "--dt": "0.002", "--D0": "0", "--kappa": "30", "--radius": "1"}
    | {"--spread": "0", "--eta_0": "0.3", "--rate": "0", "--out": "run.gsd"},
    "bench": COMMON | {"--beads": "200", "--batch": "1", "--skin": "0.3", "--steps": "2"},
    "init": {"": "fluid"},
    "run": {"": "fluid.toml", "--out": "odd.gsd", "--hours": "1e-9"},
    "scan": {"": "scan.toml", "--out": "odd.nc", "--hours": "1e-9", "--shard": "1/200"},
    "merge": {"": "part.nc", "--out": "whole.nc"},
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("command", COMMANDS)
def test_one_odd_word(command, tmp_path):
    """Every odd word in place of every right one, in turn."""
    good = COMMANDS[command]
    # What bench accepts it compiles anew each time.
    words = [word for word in ODD if command != "bench" or word in ("nan", "-1", "0", "much")]
    told = [judged(command, good | {name: word}, tmp_path) for name in good for word in words]
    assert not any(told), "\n".join(filter(None, told))


@pytest.mark.filterwarnings("ignore")
@hypothesis.given(data=st.data())
@hypothesis.settings(ALIKE, max_examples=100)
def test_two_odd_words(data, tmp_path_factory):
    command = data.draw(st.sampled_from([c for c in COMMANDS if len(COMMANDS[c]) > 1]))
    good = COMMANDS[command]
    names = data.draw(st.lists(st.sampled_from(sorted(good)), min_size=2, max_size=2, unique=True))
    given = good | {name: data.draw(st.sampled_from(ODD)) for name in names}
    told = judged(command, given, tmp_path_factory.mktemp("odd"))
    assert not told, told


def judged(command: str, given: dict, folder) -> str:
    """What is wrong with what a command did; empty where nothing is."""
    words = [word for option, value in given.items() for word in (option, value) if option or word]
    folder = folder / str(len(list(folder.iterdir())))
    folder.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_files()
        prepare = experiment.prepare
        replace_runs(patch)
        patch.setattr(experiment, "prepare", prepare)
        patch.setattr(experiment, "_equilibrate", lambda ensemble: None)
        try:
            status, out, told = said(command, words)
        except Exception as error:
            status, out, told = 1, "", f"{type(error).__name__}: {error}"
    shown = f"dpdjax {command} {' '.join(words)}: {status} {told[-300:]!r}"
    if status in (0, 75):
        is_right = "nan" not in out.lower().split() or given.get("--out") == "nan"
        return "" if is_right else shown + out
    is_line = status == 2 and told.strip() and len(told) < 2 * LONGEST
    return "" if is_line and "Traceback" not in told and "Tracer" not in told else shown


def write_files():
    """What ``run``, ``scan`` and ``merge`` read."""
    fluid = water_toml("box = 3.5\ndensity = 3.0\nskin = 0.3")
    pathlib.Path("fluid.toml").write_text(f"{fluid}\n[plan]\nsteps = 4\nframes = 2\n")
    grid = '[scan]\nexperiment = "Viscosity"\ngrid = { gamma = [1, 2] }\n'
    settings = "[scan.settings]\nbox = 3.5\ntime = 0.1\nsettle = 0.1\n"
    pathlib.Path("scan.toml").write_text(water_toml() + grid + settings)


def said(command: str, words) -> tuple[int, str, str]:
    """Exit status, standard output and standard error."""
    kept = ["--no-cache"] if command in ("viscosity", "calibrate", "suspension") else []
    with (
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.redirect_stderr(io.StringIO()) as told,
    ):
        try:
            status = main([command, *words, *kept])
        except SystemExit as end:
            status = end.code
    return status, out.getvalue(), told.getvalue()
