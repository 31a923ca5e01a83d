"""Pages of measured figures, as the site shows them: those that the scripts of ``tests/physics``
and ``tests/benchmarks`` wrote, each with the command that writes it again, and a table of the most
telling figures out of their results."""

import json
import re
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
PHYSICS, BENCHMARKS = "tests/physics", "tests/benchmarks"
sys.path.insert(0, str(ROOT / PHYSICS))

from rooms import shown

PAGES = {
    f"{PHYSICS}/RESULTS.md": ("measure.py",),
    f"{PHYSICS}/INTEGRATORS.md": ("integrators.py",),
    f"{PHYSICS}/SUSPENSIONS.md": ("suspensions.py",),
    f"{PHYSICS}/LONGSTEPS.md": ("longsteps.py",),
    f"{PHYSICS}/MARBLES.md": ("marbles.py",),
    f"{PHYSICS}/MOLECULES.md": ("molecules.py", "phantom.py", "lammps_melt.py"),
    f"{PHYSICS}/BAROSTAT.md": ("barostat.py",),
    f"{PHYSICS}/INVERSE.md": ("inverse.py",),
    f"{BENCHMARKS}/README.md": (),
    f"{BENCHMARKS}/PEERS.md": ("peers.py",),
    f"{BENCHMARKS}/SCALING.md": ("scaling.py",),
    f"{BENCHMARKS}/STEPS.md": ("steps.py",),
    f"{BENCHMARKS}/SUSPENSION.md": ("suspension.py",),
    f"{BENCHMARKS}/CAMPAIGNS.md": ("campaigns.py",),
    f"{BENCHMARKS}/NOISE.md": ("noise.py",),
    f"{BENCHMARKS}/TREES.md": ("trees.py",),
}
"""And the scripts that write each."""
TELLING = (
    ("results", "measure.py", "pressure", ("pressure", "excess energy", "g(r) at 0.88")),
    ("results", "measure.py", "ideal_shear", ("viscosity, shear",)),
    ("results", "measure.py", "water_shear", ("viscosity, shear",)),
    ("results", "measure.py", "identities", ("dp/da", "d<v^2>/dkT")),
    ("results", "measure.py", "main_job", ("viscosity, fresh run",)),
    ("suspensions", "suspensions.py", "pair_temperature", ("T/kT at h = 0.01, exact",)),
    ("suspensions", "suspensions.py", "well", ("P(h) over r^2 exp(-U/kT), h from 0.02",)),
    ("suspensions", "suspensions.py", "diffusion", ("D over stick",)),
    ("molecules", "molecules.py", "melt", ("pressure", "viscosity", "squared end")),
    ("molecules", "molecules.py", "scaling", ("nu",)),
    ("barostat", "barostat.py", "water_at_a_pressure", ("density", "compressibility")),
    ("inverse", "inverse.py", "published_states", ("pressure",)),
    ("inverse", "inverse.py", "designed", ("gamma",)),
)
"""File, script, room, and how the quantities begin that are shown; those with a reference."""


def copy_notebooks(folder: Path):
    """The executed notebooks, with their links to measured pages."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(ROOT / "notebooks", folder)
    for notebook in folder.glob("*.ipynb"):
        notebook.write_text(_linked(notebook.read_text(), ROOT / "notebooks", "../measured/"))


def page_name(path: str) -> str:
    folder, name = path.split("/")[1:]
    stem = "benchmarks" if name == "README.md" else Path(name).stem.lower()
    return f"{stem}.md" if folder == "physics" or stem == "benchmarks" else f"bench_{stem}.md"


def write(folder: Path):
    """All pages, into a folder that is made anew."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for path, scripts in PAGES.items():
        text = _linked((ROOT / path).read_text(), (ROOT / path).parent)
        (folder / page_name(path)).write_text(_with_commands(text, path, scripts))
    for picture in (ROOT / PHYSICS).glob("*.png"):
        shutil.copy(picture, folder)
    (folder / "telling.txt").write_text(telling())


def _linked(text: str, folder: Path, to: str = "") -> str:
    """Links to the pages out of a file of a folder, where they now are."""

    def moved(match):
        known = str((folder / match[1]).resolve().relative_to(ROOT))
        return f"]({to}{page_name(known)})" if known in PAGES else match[0]

    return re.sub(r"\]\(([^)#:]+\.md)\)", moved, text)


def _with_commands(text: str, path: str, scripts) -> str:
    title, _, rest = text.partition("\n")
    folder = path.rpartition("/")[0]
    commands = ", ".join(f"`python {folder}/{script}`" for script in scripts)
    note = f"\n```{{note}}\n`{path}`, written by {commands}.\n```\n" if scripts else ""
    return f"{title}\n{note}{rest}"


# ------------------------------------------------------------ the most telling


def telling() -> str:
    """A table of them, in Markdown."""
    head = "| quantity and state | here | reference | source | apart by | measured by |"
    lines = [head, "|" + "---|" * head.count(" | ") + "---|"]
    for file, script, room, begins in TELLING:
        found = json.loads((ROOT / PHYSICS / f"{file}.json").read_text())[room]
        rows = [row for row in found["rows"] if row["quantity"].startswith(begins)]
        lines += [_line(row, found["date"], script) for row in rows if row["reference"] != ""]
    return "\n".join(lines) + "\n"


def _line(row: dict, date: str, script: str) -> str:
    value, reference = _number(row["value"]), _number(row["reference"])
    error = (value[1] ** 2 + reference[1] ** 2) ** 0.5
    apart = f"{abs(value[0] - reference[0]) / error:.1f} errors"
    what = f"**{row['quantity']}**, {row['state']}"
    told = shown(row["value"]), shown(row["reference"])
    cells = what, *told, row["source"], apart, f"`{script}`, {date}"
    return "| " + " | ".join(cells) + " |"


def _number(value) -> tuple[float, float]:
    return tuple(value) if isinstance(value, list) else (float(value), 0.0)
