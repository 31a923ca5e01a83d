"""What a campaign of runs stands and costs: kills, output to disk, scans, large boxes.

    python tests/benchmarks/campaigns.py                   # everything
    python tests/benchmarks/campaigns.py kills output      # rooms by name
    python tests/benchmarks/campaigns.py page              # the page alone

Each room writes what it measured into ``campaigns.json``, and ``CAMPAIGNS.md`` is made of that.
"""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import dpdjax as dpd
from dpdjax.files.checkpoint import Checkpoint as Saved
from dpdjax.files.frames import StoredFrames

HERE = Path(__file__).parent
DATA, PAGE = HERE / "campaigns.json", HERE / "CAMPAIGNS.md"
KEY, KILLS = jax.random.key(2026), 20
OPENERS = {
    "gsd": "import gsd.hoomd; print(len(gsd.hoomd.open(path)))",
    "freud": "import freud, gsd.hoomd; f = gsd.hoomd.open(path); "
    "r = freud.density.RDF(20, 2.0); [r.compute(x, reset=False) for x in f]; "
    "assert r.rdf[-1] > 0.5; print(len(f))",
    "MDAnalysis": "import MDAnalysis as m; u = m.Universe(path); "
    "x = [t.positions.sum() for t in u.trajectory]; print(len(x))",
    "ovito": "import ovito.io as o; p = o.import_file(path); d = [p.compute(k) for k in "
    "range(p.source.num_frames)]; assert d[-1].particles.count > 9; print(len(d))",
}
"""How each program reads all frames of a file and says how many there are."""


def suspension():
    """Sheared colloids, 2,500 beads."""
    return dpd.suspension(KEY, phi=0.2, box=10.0, kT=0.1, D0=0.3, report=None)


def sheared(folder: Path):
    """The run that is killed."""
    made = suspension()
    return dpd.run(
        made.fluid.set(D0=0.0), made.state, KEY, made.dt, dpd.Plan(6000, 5), dpd.shear(0.1),
        integrator=made.integrator, out=folder / "run.gsd",
        checkpoint=dpd.Checkpoint(folder / "saved", 0.2), progress=False,
    )  # fmt: skip


def kills():
    """Killed at random moments and begun again, until it ends; against the unbroken run."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "whole").mkdir()
        began = time.monotonic()
        assert _child(folder / "whole").wait() == 0
        unbroken, began = time.monotonic() - began, time.monotonic()
        moments, frames = random.Random(1), []
        while len(frames) < KILLS:
            process = _child(folder)
            before = _frames(folder / "run.gsd")
            while _frames(folder / "run.gsd") == before and process.poll() is None:
                time.sleep(0.02)
            time.sleep(moments.uniform(0.0, 1.0))
            assert process.poll() is None, "it ended before it was killed often enough"
            process.send_signal(signal.SIGKILL)
            process.wait()
            frames.append(_frames(folder / "run.gsd"))
        assert _child(folder).wait() == 0
        ends = [Saved(f / "saved").load().state for f in (folder, folder / "whole")]
        files = [StoredFrames(f / "run.gsd") for f in (folder, folder / "whole")]
        return {
            "kills": KILLS,
            "frames at each": frames,
            "frames at the end": int(files[0].count),
            "same final state, bits": all(
                jnp.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, ends), strict=True)
            ),
            "same frames, bits": all(
                np.array_equal(files[0][name], files[1][name]) for name in files[1]
            ),
            "opened by": _opened(folder / "run.gsd"),
            "seconds, unbroken": unbroken,
            "seconds, killed": time.monotonic() - began,
        }


def _child(folder: Path):
    cache = os.path.join(tempfile.gettempdir(), "dpdjax-campaigns")
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": cache, "TF_CPP_MIN_LOG_LEVEL": "3"}
    command = [sys.executable, __file__, "child", str(folder)]
    return subprocess.Popen(command, env=environment)


def _frames(path) -> int:
    if not path.exists() or not path.stat().st_size:
        return 0
    import gsd.hoomd

    with gsd.hoomd.open(str(path), "r") as file:
        return len(file)


def _opened(path) -> dict:
    """Frames that other programs find in a file, by the interpreter named in OPENERS, which has
    them; this one by default."""
    python = os.environ.get("OPENERS", sys.executable)
    found = {}
    for name, code in OPENERS.items():
        line = f"import warnings; warnings.simplefilter('ignore'); path = {str(path)!r}; {code}"
        done = subprocess.run([python, "-c", line], capture_output=True, text=True)
        found[name] = done.stdout.strip() if not done.returncode else done.stderr[-200:]
    return found


def output():
    """A million steps of 3,000 beads to disk, a frame in a hundred; and what that adds to the time,
    by turns."""
    water = dpd.fluid(
        [dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)],
        [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)],
        kT=1.0,
    )
    state = dpd.initial_state(water, KEY, box=10.0, density=3.0)
    go = lambda state, plan, **how: dpd.run(water, state, KEY, 0.01, plan, progress=False, **how)
    state = go(state, dpd.Plan(20, 100)).final
    with tempfile.TemporaryDirectory() as name:
        ratios = [_with_over_without(go, state, Path(name)) for _ in range(7)]
        memory, out = [], Path(name) / "run.gsd"
        began = time.monotonic()

        def watch(piece):
            if time.monotonic() - began > 30 * len(memory):
                memory.append(_resident())

        saved = Path(name) / "saved"
        ran = go(state, dpd.Plan(10_000, 100), out=out, checkpoint=saved, callback=watch)
        heat = np.asarray(ran.frames["temperature"])
        drift = np.asarray(ran.frames["momentum"])
        return {
            "steps": 1_000_000,
            "beads": state.n,
            "seconds": time.monotonic() - began,
            "temperature by tenths": [float(x.mean()) for x in np.array_split(heat, 10)],
            "momentum a bead, largest": float(np.abs(drift).max() / state.n),
            "resident MB, every 30 s": memory,
            "file MB": out.stat().st_size / 1e6,
            "frames": len(heat),
            "time with output over without": sorted(ratios),
        }


def _with_over_without(go, state, folder) -> float:
    spent = []
    for how in ({}, {"out": folder / "try.gsd", "checkpoint": folder / "try"}):
        shutil.rmtree(folder / "try", ignore_errors=True)
        (folder / "try.gsd").unlink(missing_ok=True)
        began = time.monotonic()
        go(state, dpd.Plan(200, 100), **how)
        spent.append(time.monotonic() - began)
    return spent[1] / spent[0]


def _resident() -> float:
    """Resident memory of this process [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


ROOMS = {"kills": kills, "output": output}


def page(data: dict):
    """Write the page from what was measured."""
    lines = [
        "# Campaigns",
        "",
        f"Measured by `{Path(__file__).name}`, see there for what each is.",
        "",
    ]
    for room, found in data.items():
        lines += [f"## {room}", "", (ROOMS[room].__doc__ or "").replace("\n    ", " "), ""]
        lines += ["| what | measured |", "|---|---|"]
        lines += [f"| {name} | {_shown(value)} |" for name, value in found.items()] + [""]
    PAGE.write_text("\n".join(lines))


def _shown(value) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{k}: {_shown(v)}" for k, v in value.items())
    if isinstance(value, list):
        return ", ".join(map(_shown, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def main(names):
    warnings.simplefilter("ignore")
    if names[:1] == ["child"]:
        sheared(Path(names[1]))
        return
    data = json.loads(DATA.read_text()) if DATA.exists() else {}
    for room in [] if names == ["page"] else names or ROOMS:
        data[room] = {"date": time.strftime("%Y-%m-%d")} | ROOMS[room]()
        print(room, data[room], flush=True)
        DATA.write_text(json.dumps(data, indent=1) + "\n")
    page(data)


if __name__ == "__main__":
    main(sys.argv[1:])
