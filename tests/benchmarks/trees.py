"""Two trees of the package side by side: whether their runs have the same bits, and what they take.

    python tests/benchmarks/trees.py BEFORE AFTER

BEFORE and AFTER are folders with a checkout each, run in a process each, by turns. Writes
``tests/benchmarks/TREES.md``; 6 minutes on two cores.
"""

import argparse
import datetime
import hashlib
import json
import os
import platform
import statistics
import subprocess
import sys
import time
import warnings
from pathlib import Path

HERE = Path(__file__).parent
ROUNDS = 9


def jobs():
    """Runs by name, each a function without arguments, from states that earlier ones ended in."""
    import jax
    import jax.numpy as jnp

    import dpdjax as dpd

    warnings.simplefilter("ignore")
    key, shear = jax.random.key(3), dpd.shear(0.2)
    run = lambda fluid, state, key, dt, plan, flow=None: dpd.run(
        fluid, state, key, dt, plan, flow, progress=False
    )
    water = dpd.fluid(
        [dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)],
        [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)],
        kT=1.0,
    )
    start = dpd.initial_state(water, key, box=10.0, density=3.0)
    still = run(water, start, key, 0.01, dpd.Plan(10, 10)).final
    many = dpd.initial_state(water, key, box=16.0, density=3.0)
    verlet = dpd.integrators.VelocityVerlet()
    made = dpd.suspension(
        key, phi=0.2, box=10.0, kT=0.1, gamma=4.5, D0=1.2, integrator=verlet, report=None
    )
    marble = dpd.marbles(key, box=10.0, report=None)
    gammas, keys = jnp.array([2.0, 4.5, 9.0]), jax.random.split(key, 3)
    short = dpd.Plan(8, 2)
    stress = lambda gamma: dpd.simulate(
        water.set(gamma=gamma), still, key, 0.01, short, shear
    ).frames["pressure_tensor"][-1, 0, 1]
    tangent, gradient = jax.jit(lambda g: jax.jvp(stress, (g,), (1.0,))), jax.jit(jax.grad(stress))
    swing = dpd.oscillatory_shear(0.2, 3.0)
    return {
        "water, from its start": lambda: run(water, start, key, 0.01, dpd.Plan(10, 10)),
        "sheared, a frame in 40 steps": lambda: run(
            water, still, key, 0.01, dpd.Plan(10, 40), shear
        ),
        "sheared, a frame in 2 steps": lambda: run(
            water, still, key, 0.01, dpd.Plan(100, 2), shear
        ),
        "oscillated": lambda: run(water, still, key, 0.01, dpd.Plan(10, 10), swing),
        "scan of three gammas": lambda: run(
            water.set(gamma=gammas), still, keys, 0.01, dpd.Plan(5, 10), shear
        ),
        "12,288 beads, sorted": lambda: run(water, many, key, 0.01, dpd.Plan(2, 20), shear),
        "suspension": lambda: run(made.fluid, made.state, key, made.dt, dpd.Plan(5, 40)),
        "suspension, sheared": lambda: run(
            made.fluid, made.state, key, made.dt, dpd.Plan(5, 40), shear
        ),
        "marble": lambda: run(marble.fluid, marble.state, key, marble.dt, dpd.Plan(5, 40)),
        "forward mode": lambda: tangent(4.5),
        "reverse mode": lambda: gradient(4.5),
    }


def digest(result) -> str:
    """Of all numbers a run ends in and recorded, but for its lists."""
    import jax
    import numpy as np

    if hasattr(result, "final"):
        final = result.final
        rotation = (
            () if final.rotation is None else (final.rotation.velocity, final.rotation.torque)
        )
        beads = (final.position, final.velocity, final.force, final.image, final.id, rotation)
        result = beads, final.box.strain, final.tally.energy, dict(sorted(result.frames.items()))
    found = hashlib.sha256()
    for leaf in jax.tree.leaves(result):
        found.update(np.ascontiguousarray(leaf).tobytes())
    return found.hexdigest()


def work():
    """Answers each name on a line with a digest and the seconds it took."""
    known = jobs()
    print(json.dumps(list(known)), flush=True)
    for line in sys.stdin:
        began = time.perf_counter()
        result = digest(known[line.strip()]())
        print(json.dumps([result, time.perf_counter() - began]), flush=True)


def worker(tree):
    environment = os.environ | {
        "PYTHONPATH": str(Path(tree).resolve()),
        "TF_CPP_MIN_LOG_LEVEL": "3",
    }
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    return subprocess.Popen(
        [sys.executable, __file__, "--work"], env=environment, cwd=HERE, **pipes
    )


def ask(process, name: str):
    process.stdin.write(name + "\n")
    process.stdin.flush()
    return json.loads(process.stdout.readline())


def compared(trees, name: str) -> str:
    """A row: whether the bits are the same, the first call of either, and the ratio of the rest."""
    first = [ask(process, name) for process in trees]
    turns = [[ask(process, name)[1] for process in trees] for _ in range(ROUNDS)]
    before, after = (statistics.median(times) for times in zip(*turns))
    ratio = statistics.median(b / a for a, b in turns)
    same = "yes" if first[0][0] == first[1][0] else "no"
    print(f"{name}: {same}, {ratio:.3f}", flush=True)
    return (
        f"| {name} | {same} | {first[0][1]:.1f} | {first[1][1]:.1f} | {before:.3f} | {after:.3f} | "
        f"{ratio:.3f} |"
    )


def commit_of(tree) -> str:
    command = ["git", "-C", str(tree), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    arguments = parser.parse_args()
    folders = arguments.before, arguments.after
    trees = [worker(folder) for folder in folders]
    names = [json.loads(process.stdout.readline()) for process in trees][0]
    rows = [compared(trees, name) for name in names]
    for process in trees:
        process.kill()
    commits = [commit_of(folder) for folder in folders]
    (HERE / "TREES.md").write_text(
        "# Two trees side by side\n\n"
        f"`{commits[0]}` before, `{commits[1]}` after; float32, {os.cpu_count()} cores, "
        f"{platform.machine()}, {datetime.date.today()}. Seconds of the first call, compiling "
        f"included, and medians of {ROUNDS} later ones; the ratio is the median of those by turns. "
        "Written by `trees.py`.\n\n"
        "| run | same bits | first before | first after | later before | later after | ratio |\n"
        "|---|---|---|---|---|---|---|\n" + "\n".join(rows) + "\n"
    )


if __name__ == "__main__":
    work() if "--work" in sys.argv else main()
