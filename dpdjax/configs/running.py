"""``dpdjax run`` and ``dpdjax scan``: files at work."""

import concurrent.futures as futures
import dataclasses
import multiprocessing
import os
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

import dpdjax as dpd
from dpdjax.checks import not_negative
from dpdjax.configs.building import KINDS, MATTER, flow_of, fluid_of, made_of, observe_of, plan_of
from dpdjax.configs.reading import Section, function_named, load
from dpdjax.engine.compiling import Clock
from dpdjax.errors import ConfigError

TOP = ("seed", "float64", "dt", "integrator", "settle", "flow", "plan", "output")
OUTPUT = ("gsd", "species", "checkpoint", "seconds", "observe", "mean")


def run_file(
    path: str | os.PathLike,
    *,
    out: str | None = None,
    hours: float | None = None,
    resume: bool = False,
    report: Callable[[str], None] | None = None,
    progress: bool = True,
) -> tuple[dict, bool]:
    """Run what a file says; returns what it came to, and whether it is complete.

    Frames go to a GSD file, and what a stopped run goes on from into a folder beside it. Raises
    ConfigError for a file that is not right, and as :func:`dpdjax.run` does.
    """
    file, text = load(path)
    file.only(*KINDS, *TOP)
    with _precision(file):
        return _run(file, text, path, out, hours, resume, report, progress)


def _run(file: Section, text: str, path, out, hours, resume: bool, report, progress: bool):
    clock = Clock()
    key = jax.random.key(file.get("seed", int, 0))
    output = file.table("output").only(*OUTPUT)
    target = Path(out or output.get("gsd", str) or f"{Path(path).stem}.gsd")
    given = None if out else output.get("checkpoint", str)
    folder = Path(given or target.with_suffix(".checkpoint"))
    if not resume:
        _refuse_old(target, folder)
    observe, flow = observe_of(output), flow_of(file.table("flow"))
    settle = file.table("settle").only("time", "without")
    seconds = output.get("seconds", float, 60.0)
    saved = [output.guarded(lambda: dpd.Checkpoint(folder / x, seconds)) for x in ("settle", "run")]
    gsd = dpd.GSD(target, species=output.get("species", int), about={"toml": text})
    made = made_of(file, key, report)
    plan = plan_of(file.table("plan"), made)
    left = lambda: None if hours is None else max(1e-9, hours - clock.seconds / 3600)
    how = {"integrator": made.integrator, "progress": progress}
    rest = _settled(settle, made, key, saved[0], left(), how)
    if rest is None:
        return {"frames": 0, "file": str(target)}, False
    os.makedirs(target.parent, exist_ok=True)
    ran = dpd.run(
        made.fluid, rest, key, made.dt, plan, flow or None,
        observe=observe, out=gsd, checkpoint=saved[1], hours=left(), **how,
    )  # fmt: skip
    elapsed = float(ran.final.time) - float(rest.time)
    return _came_to(ran, made, plan, elapsed, target, clock), ran.complete


def _precision(file: Section):
    """That of the file, or else what is set, until the end."""
    return jax.enable_x64(file.get("float64", bool, bool(jax.config.jax_enable_x64)))


def _refuse_old(target: Path, folder: Path):
    for there in (target, folder):
        if there.exists():
            raise FileExistsError(
                f"{there} is there already: --resume goes on with it, --out takes another name"
            )


def _settled(section: Section, made, key, checkpoint, hours, how):
    """The state after settling, with some numbers at zero; None where that was interrupted."""
    length = float(not_negative(section.get("time", float, 0.0), "time of [settle]"))
    if length == 0:
        return made.state
    zero = {name: 0.0 for name in section.get("without", list, [])}
    fluid = section.guarded(lambda: made.fluid.set(**zero)) if zero else made.fluid
    plan = dpd.Plan.over(length, made.dt, 10)
    more = {"checkpoint": checkpoint, "hours": hours}
    settled = dpd.run(fluid, made.state, key, made.dt, plan, **more, **how)
    return settled.final.restarted() if settled.complete else None


def _came_to(ran, made, plan, elapsed: float, target: Path, clock: Clock) -> dict:
    done = ran.frames
    count = len(done["step"]) if len(done) else 0
    result = {"frames": count, "of": plan.frames, "beads": ran.final.n, "dt": made.dt}
    result |= {"integrator": str(made.integrator), "time": elapsed, "file": str(target)}
    if made.tau is not None:
        result |= {"tau": made.tau, "times": elapsed / made.tau}
    if count:
        heat = np.asarray(done["temperature"])
        result["temperature"] = float(heat[count // 2 :].mean())
    spent = {"seconds": clock.seconds, "compile_seconds": clock.compile_seconds}
    return result | {name: round(value, 1) for name, value in spent.items()}


def scan_file(
    path: str | os.PathLike,
    *,
    out: str | None = None,
    hours: float | None = None,
    shard: tuple[int, int] | None = None,
    workers: int | None = None,
    retry: bool = False,
    progress: bool = True,
) -> tuple[dict, bool]:
    """Scan what a file says; returns what it came to, and whether nothing is missing.

    Raises ConfigError for a file that is not right, and as :func:`dpdjax.scan` does.
    """
    file, text = load(path)
    file.only("seed", "float64", "fluid", "scan")
    with _precision(file):
        return _scan(
            file, text, path, out, workers, progress, shard=shard, hours=hours, retry=retry
        )


def _scan(file: Section, text: str, path, out, workers, progress: bool, *, shard, **more):
    section = file.table("scan").only("experiment", "settings", "grid", "replicas", "store")
    experiment = _experiment(section, file)
    store = Path(out or section.get("store", str) or f"{Path(path).stem}.nc")
    if shard is not None:
        store = _part_of(store, "-{}of{}".format(*shard))
    key = jax.random.key(file.get("seed", int, 0))
    grid = section.table("grid")
    twice = sorted(set(grid.values) & set(section.table("settings").values))
    if twice:
        raise ConfigError(f"{', '.join(twice)} is in [scan.grid] and in [scan.settings]; give one")
    how = {"key": key, "replicas": section.get("replicas", int, 1), "shard": shard} | more
    go = lambda executor: section.guarded(
        lambda: dpd.scan(
            experiment, grid.values, store=store, executor=executor, progress=progress,
            about={"toml": text}, **how,
        )
    )  # fmt: skip
    if workers is None:
        table = go(None)
    else:
        spawn = multiprocessing.get_context("spawn")
        with futures.ProcessPoolExecutor(workers, mp_context=spawn) as pool:
            table = go(pool)
    mine = int(np.prod(table.status.shape))
    if shard is not None:
        mine = len(range(shard[0] - 1, mine, shard[1]))
    done, failed = (int((table.status == k).sum()) for k in (1, 2))
    result = {"runs": mine, "done": done, "failed": failed, "store": str(store)}
    return result | {"table": table}, done + failed >= mine


def _part_of(store: Path, part: str) -> Path:
    """The store of a shard; the name of one that is there, copied from another machine, is kept."""
    return store if store.stem.endswith(part) else store.with_name(store.stem + part + store.suffix)


def _experiment(section: Section, file: Section):
    """The experiment that is named, with its settings; one of yours by ``"module:name"``."""
    name = section.need("experiment", str)
    where = f"{section.where} has experiment"
    found = function_named(name, where, (dpd.experiments,))
    settings = section.table("settings")
    if not (isinstance(found, type) and dataclasses.is_dataclass(found)):
        if settings.values:
            raise ConfigError(f"{settings.where} is for the experiments of dpd.experiments")
        return found
    names = [f.name for f in dataclasses.fields(found)]
    if "fluid" not in names:
        return (
            Section(settings.values, settings.where)
            .only(*names)
            .guarded(lambda: found(**settings.values))
        )
    if "fluid" not in file.values:
        raise ConfigError(f"the experiment {name} needs a fluid; give a table [fluid]")
    fluid = fluid_of(file.table("fluid").only(*MATTER))
    settings.only(*(n for n in names if n != "fluid"))
    return settings.guarded(lambda: found(fluid=fluid, **settings.values))
