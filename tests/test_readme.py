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
    assert printed.count("+-") >= 3 and "gamma = " in printed
    assert len(SNIPPETS[0].strip().splitlines()) <= 22


def test_commands_are_one_line_each():
    commands = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
    assert ["pytest" in commands[1], "dpdjax calibrate" in commands[0]] == [True, True]
    assert all(len(command.strip().splitlines()) == 1 for command in commands[:2])


def test_main_job_parses():
    """The options of the README's main job are those of the command line."""
    words = re.search(r"dpdjax (calibrate [^\n]*)", README).group(1).split()
    from dpdjax.cli import parser

    arguments = parser().parse_args(words)
    assert (arguments.viscosity, arguments.kT, arguments.repulsion) == (1.1, 0.1, 2.5)


def test_version_of_the_package():
    assert f'version = "{dpdjax.__version__}"' in (ROOT / "pyproject.toml").read_text()


def test_rooms_are_told():
    """The folders that the page for contributors lists are those of the package."""
    told = re.findall(r"^  (\w+)/", (ROOT / "docs" / "contributing.md").read_text(), re.MULTILINE)
    assert set(told) == {path.parent.name for path in (ROOT / "dpdjax").glob("*/__init__.py")}


@pytest.mark.parametrize("link", sorted(set(re.findall(r"\]\(([^)#:]+)\)", README))))
def test_links_lead_somewhere(link):
    assert (ROOT / link).exists()


def test_help_is_quick_to_import():
    code = "import sys\nfrom dpdjax.cli import parser\nparser().format_help()\nprint(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert not {"jax", "jax_md", "matplotlib", "tqdm"} & set(loaded)
