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


def water():
    """The standard fluid."""
    return dpd.fluid(
        [dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)],
        [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)],
        kT=1.0,
    )


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
        return {
            "kills": KILLS,
            "frames at each": frames,
            "frames at the end": _frames(folder / "run.gsd"),
            "same final state, bits": all(
                jnp.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, ends), strict=True)
            ),
            "same frames, bits": _same_frames(folder / "run.gsd", folder / "whole" / "run.gsd"),
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


def _same_frames(path, other) -> bool:
    a, b = StoredFrames(path), StoredFrames(other)
    return set(a) == set(b) and all(np.array_equal(a[name], b[name]) for name in b)


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
    matter = water()
    state = dpd.initial_state(matter, KEY, box=10.0, density=3.0)
    go = lambda state, plan, **how: dpd.run(matter, state, KEY, 0.01, plan, progress=False, **how)
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


GRID = {"gamma": np.geomspace(2.0, 60.0, 24).round(3).tolist()}
"""Of the scan, with four replicas."""


def viscosities():
    """Viscosity in small boxes."""
    return dpd.experiments.Viscosity(fluid=water(), box=5.0, time=8.0, settle=2.0, rate=0.3)


def scanned(store: str, **how):
    """The scan that is computed in many ways."""
    return dpd.scan(viscosities(), GRID, key=KEY, replicas=4, store=store, progress=False, **how)


def scans():
    """24 frictions, 4 replicas: interrupted and resumed, on two forced devices, by two Dask workers
    of which one is killed, in three shards; and its speed beside the same boxes in one call."""
    with tempfile.TemporaryDirectory() as name:
        at = lambda store: str(Path(name) / f"{store}.nc")
        began = time.monotonic()
        whole = scanned(at("whole"))
        found = {"runs": int(whole.status.size), "seconds": time.monotonic() - began}
        half = _scanning("plain", at("half"))
        while not Path(at("half")).exists() or (dpd.load_scan(at("half")).status == 1).sum() < 48:
            time.sleep(0.2)
        half.send_signal(signal.SIGTERM)
        found["status after SIGTERM"] = half.wait()
        found["runs done by then"] = int((dpd.load_scan(at("half")).status == 1).sum())
        flags = "--xla_force_host_platform_device_count=2"
        for way, given in (("half", ""), ("devices", flags), ("dask", "")):
            mode = "dask" if way == "dask" else "plain"
            assert _scanning(mode, at(way), XLA_FLAGS=given).wait() == 0
            found[f"same bits, {WAYS[way]}"] = _same(dpd.load_scan(at(way)), whole)
        parts = [at(f"part{i}") for i in (1, 2, 3)]
        for i, part in enumerate(parts):
            scanned(part, shard=(i + 1, 3))
        found["same bits, three shards merged"] = _same(dpd.merge_scans(parts), whole)
    return found | {"speed over one batch": sorted(_speed() for _ in range(5))}


WAYS = {
    "half": "ended by SIGTERM and gone on with",
    "devices": "two forced devices",
    "dask": "two Dask workers, one killed",
}


def _scanning(mode: str, store: str, **environment):
    more = {"TF_CPP_MIN_LOG_LEVEL": "3"} | environment
    return subprocess.Popen(
        [sys.executable, __file__, "scanning", mode, store], env=os.environ | more
    )


def scan_by_dask(store: str):
    """By two workers, one of which is killed on the way."""
    import threading

    import distributed

    how = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**how) as cluster, distributed.Client(cluster) as client:
        pid = client.submit(os.getpid).result()
        threading.Timer(30.0, os.kill, (pid, signal.SIGKILL)).start()
        scanned(store, executor=client.get_executor())


def _same(a, b) -> bool:
    drop = ["seconds", "note"]
    return bool(a.drop_vars(drop).identical(b.drop_vars(drop)))


def _speed() -> float:
    """Particle-steps a second of a scan of 24 runs over those of one call with the same boxes."""
    matter, plan = water(), dpd.Plan(50, 20)
    state = dpd.initial_state(matter, KEY, box=7.0, density=3.0)

    def one(key, gamma):
        ran = yield dpd.Run(matter.set(gamma=gamma), state, key, 0.01, plan)
        return {"T": ran.frames["temperature"].mean()}

    spent = []
    for work in (
        lambda: dpd.run(
            matter.set(gamma=jnp.array(GRID["gamma"])), state, jax.random.split(KEY, 24), 0.01,
            plan, progress=False,
        ),
        lambda: dpd.scan(one, GRID, key=KEY, progress=False),
    ):  # fmt: skip
        work()
        began = time.monotonic()
        work()
        spent.append(time.monotonic() - began)
    return spent[0] / spent[1]


LARGE = """
[suspension]
phi = 0.2
box = 70.0
kT = 0.1
gamma = 45.0
eta_0 = 0.95
D0 = 0.6
kappa = 30.0

[plan]
steps = 200
every = 10

[output]
gsd = "large.gsd"
checkpoint = "large.checkpoint"
seconds = 0.001
"""


def large():
    """A box of side 70 at phi .2, from a TOML file by ``dpdjax run``: to its first frame, killed
    (-9) after that, gone on with, and against the unbroken run."""
    with tempfile.TemporaryDirectory() as name:
        broken, whole = (Path(name) / folder for folder in ("broken", "whole"))
        found = {}
        for folder in (whole, broken):
            folder.mkdir()
            (folder / "large.toml").write_text(LARGE)
        began = time.monotonic()
        process = _large(whole)
        found["seconds to the first frame"] = _first_frame(whole / "large.gsd", process, began)
        told, peak = _ended(process)
        names = ("beads", "seconds", "compile_seconds", "frames", "temperature")
        found |= {name: told[name] for name in names} | {"peak resident GB": peak}
        process = _large(broken)
        _first_frame(broken / "large.gsd", process, began)
        time.sleep(5.0)
        process.send_signal(signal.SIGKILL)
        process.wait()
        found["frames when killed"] = _frames(broken / "large.gsd")
        told, peak = _ended(_large(broken, "--resume"))
        found |= {"frames in the end": told["frames"], "peak resident GB, resumed": peak}
        return found | {
            "same frames, bits": _same_frames(broken / "large.gsd", whole / "large.gsd")
        }


def _large(folder: Path, *more: str):
    """``dpdjax run``, which compiles what it needs."""
    command = [sys.executable, "-m", "dpdjax.cli", "run", "large.toml", "--json", "--no-cache"]
    return subprocess.Popen(
        [*command, *more], cwd=folder, stdout=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": str(HERE.parent.parent)},
    )  # fmt: skip


def _first_frame(path: Path, process, began: float) -> float:
    while not _frames(path):
        assert process.poll() is None, "it ended without a frame"
        time.sleep(0.1)
    return time.monotonic() - began


def _ended(process) -> tuple[dict, float]:
    """What a process said, and the most memory that it held [GB]."""
    said = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    assert status == 0, said
    return json.loads(said), usage.ru_maxrss * 1024 / 1e9


ROOMS = {"kills": kills, "output": output, "scans": scans, "large": large}


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
    if names[:1] == ["scanning"]:
        scan_by_dask(names[2]) if names[1] == "dask" else scanned(names[2])
        return
    data = json.loads(DATA.read_text()) if DATA.exists() else {}
    for room in [] if names == ["page"] else names or ROOMS:
        data[room] = {"date": time.strftime("%Y-%m-%d")} | ROOMS[room]()
        print(room, data[room], flush=True)
        DATA.write_text(json.dumps(data, indent=1) + "\n")
    page(data)


if __name__ == "__main__":
    main(sys.argv[1:])
