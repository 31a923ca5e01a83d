"""The notebooks: every cell runs, at reduced size; the committed ones were executed."""

import os
import sys
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")
pytest.importorskip("matplotlib")

from jupyter_client import AsyncKernelManager  # noqa: E402
from jupyter_client.kernelspec import KernelSpec  # noqa: E402

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))
each = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


class ThisPython(AsyncKernelManager):
    """A kernel of the Python that runs the tests: none needs to be registered."""

    @property
    def kernel_spec(self):
        command = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
        return KernelSpec(argv=command, display_name="Python 3", language="python")


def execute(path, folder):
    """Run all cells at reduced size in an empty folder; raises CellExecutionError."""
    client = nbclient.NotebookClient(
        nbformat.read(path, as_version=4),
        timeout=600,
        kernel_manager_class=ThisPython,
        resources={"metadata": {"path": str(folder)}},
    )
    as_users = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    return client.execute(env=as_users | {"DPDJAX_QUICK": "1"})


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def pictures(notebook):
    return sum(
        "image/png" in output.get("data", {})
        for cell in code_cells(notebook)
        for output in cell.outputs
    )


def test_there_are_notebooks():
    assert len(NOTEBOOKS) >= 3


@each
def test_every_cell_runs(path, tmp_path):
    assert pictures(execute(path, tmp_path)) == pictures(nbformat.read(path, as_version=4))


@each
def test_the_committed_one_was_executed_from_top_to_bottom(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    cells = code_cells(notebook)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert not any(
        output.output_type == "error" or output.get("name") == "stderr" for output in outputs
    )
    assert pictures(notebook) > 0
    assert path.stat().st_size < 600_000


@each
def test_it_says_first_what_one_learns(path):
    first, *rest = nbformat.read(path, as_version=4).cells
    title, *lines = [line for line in first.source.splitlines() if line.strip()]
    assert first.cell_type == "markdown" and title.startswith("# ") and len(lines) == 3
    assert any("DPDJAX_QUICK" in cell.source for cell in rest[:2])
