"""The README tells the truth: its snippets run, its commands exist, its rooms are there."""

import pathlib
import re
import subprocess
import sys

import jax
import pytest

import dpdjax

ROOT = pathlib.Path(dpdjax.__file__).parent.parent
README = (ROOT / "README.md").read_text()
SNIPPETS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
SMALLER = {
    "[10.0, 10.0, 10.0]": "[4.0, 4.0, 4.0]",
    "frames=100,": "frames=4,",
    "frames=2000,": "frames=40,",
    "frames=40, every=1": "frames=4, every=1",
    "key=key))": "key=key, tolerance=0.5, box=4.0, boxes=2))",
    "Plan(200, 10)": "Plan(10, 2)",
    "Plan(100, 40)": "Plan(20, 2)",
    "Plan(100, 20)": "Plan(20, 2)",
    "side=10.0": "side=4.0",
    "box=6.0": "box=4.0",
    "box=12.0": "box=7.0",
    "Plan(10, 60)": "Plan(4, 10)",
    "Plan(100, 30)": "Plan(24, 2)",
    "Plan(100, 5)": "Plan(20, 4)",
    "Plan(80, 3)": "Plan(80, 2)",
    "frequency=6.3": "frequency=20.0",
    "Plan(250, 40)": "Plan(40, 40)",
    "fit=(8.0, 12.0)": "fit=(1.0, 2.0)",
    "Plan(20000, 1)": "Plan(200, 1)",
    "window=1.0": "window=0.1",
    "Plan(100, 2), shear": "Plan(20, 2), shear",
    "logarithmic(2000, per_decade=20)": "logarithmic(8, per_decade=5)",
    "box=5.0, density=3.0": "box=3.5, density=3.0",
    "dpd.Plan(20, 20)": "dpd.Plan(2, 5)",
    '"gamma": [4.5, 20.0], "rate": [0.2, 0.5, 1.0]': '"gamma": [4.5], "rate": [0.2, 0.5]',
    "dpd.Plan(50, 20), ": "dpd.Plan(4, 2), ",
    "aged.last(6)": "aged.last(2)",
    "n=[4800, 60]": "n=[600, 9]",
    "Plan(10, 30)": "Plan(12, 2)",
    "box=10.0, gamma_cs=5.0": "box=6.0, radius=1.0, gamma_cs=5.0",
    "Plan(20, 200)": "Plan(2, 10)",
    "Plan(2000, 20)": "Plan(60, 20)",
    "fit=(15.0, 20.0)": "fit=(0.2, 0.3)",
    "Plan(200, 20)": "Plan(20, 2)",
    '"H3(T4)2": 60, "W": 700}, box=[6.0, 6.0, 12.0]': '"H3(T4)2": 16, "W": 250}, box=5.2',
    "hydrodynamic_radius([10.0], [D]": "hydrodynamic_radius([10.0], [dpd.Estimate(0.005, D.error)]",
}
"""The same lines at a size that suits a test."""


def test_snippets_run(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    # Users have single precision and no strict ranks; the suite has neither by default.
    with jax.enable_x64(False), jax.numpy_rank_promotion("allow"):
        code = "\n".join(SNIPPETS)
        for large, small in SMALLER.items():
            assert large in code, f"README no longer says {large}: adapt the test"
            code = code.replace(large, small)
        names = {}
        exec(compile(code, "README.md", "exec"), names)
    printed = capsys.readouterr().out
    assert printed.count("+-") >= 9 and "gamma = " in printed and "Pa s" in printed
    assert len(SNIPPETS[0].strip().splitlines()) <= 22


def test_commands_are_one_line_each():
    commands = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
    assert ["pytest" in commands[1], "dpdjax calibrate" in commands[0]] == [True, True]
    assert all(len(command.strip().splitlines()) == 1 for command in commands[:2])


def test_main_job_parses():
    """The options of the README's main job are those of the command line."""
    words = re.search(r"dpdjax (calibrate [^\n]*)", README).group(1).split()
    from dpdjax.cli import _parser

    arguments = _parser().parse_args(words)
    assert (arguments.viscosity, arguments.kT, arguments.repulsion) == (1.1, 0.1, 2.5)


def test_version_of_the_package():
    assert f'version = "{dpdjax.__version__}"' in (ROOT / "pyproject.toml").read_text()


@pytest.mark.parametrize("room", re.findall(r"^  (\w+)[/.]", README, re.MULTILINE))
def test_rooms_exist(room):
    assert (ROOT / "dpdjax" / room).is_dir() or (ROOT / "dpdjax" / f"{room}.py").is_file()


def test_help_is_quick_to_import():
    code = (
        "import sys\nfrom dpdjax.cli import _parser\n_parser().format_help()\nprint(*sys.modules)"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert not {"jax", "jax_md", "matplotlib", "tqdm"} & set(loaded)
