"""How the cost of a step depends on the size of the box, on batching and on derivatives.

    python tests/benchmarks/scaling.py

Every figure is from a process of its own (so that its peak memory is its own), in rounds of all;
medians over the rounds. Half an hour on two cores. Writes ``tests/benchmarks/SCALING.md``. Water: a
25, gamma 4.5, kT 1, dt 0.01, density 3.
"""

import argparse
import datetime
import json
import platform
import statistics
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
SIZES = (3_000, 24_000, 192_000, 1_000_000)
REVERSE_BEADS, REVERSE_FRAMES, REVERSE_EVERY = 3_000, 125, 8

FIRST_FRAME = """
import jax, dpdjax as dpd
repulsion = dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)
fluid = dpd.fluid([repulsion], [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)], kT=1.0)
key = jax.random.key(0)
state = dpd.initial_state(fluid, key, box=10.0, density=3.0)
print(dpd.run(fluid, state, key, 0.01, dpd.Plan(1, 10), progress=False).frames["temperature"])
"""


def bench(*options):
    """The figures of ``dpdjax bench`` at water conditions."""
    numbers = "--dt 0.01 --kT 1 --repulsion 25 --gamma 4.5 --json".split()
    command = [sys.executable, "-m", "dpdjax.cli", "bench", *numbers, *options]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def reverse():
    """Seconds of a run and of its gradient, and the peak memory of the process [bytes]."""
    import jax

    import dpdjax as dpd
    from dpdjax.host.bench import peak_memory

    fluid = dpd.fluid(
        [dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)],
        [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)],
        kT=1.0,
    )
    key, plan = jax.random.key(0), dpd.Plan(REVERSE_FRAMES, REVERSE_EVERY)
    state = dpd.initial_state(fluid, key, box=10.0, n=REVERSE_BEADS, dt=0.01, sheared=False)
    state = dpd.run(fluid, state, key, 0.01, dpd.Plan(20, 10), progress=False).final

    def kinetic(gamma):
        final = dpd.simulate(fluid.set(gamma=gamma), state, key, 0.01, plan, remat=True).final
        return jax.numpy.mean(final.velocity**2)

    compiled = {
        name: jax.jit(function).lower(4.5).compile()
        for name, function in (("primal", kinetic), ("gradient", jax.value_and_grad(kinetic)))
    }
    seconds = {name: [] for name in compiled}
    for _ in range(6):
        for name, program in compiled.items():
            began = time.perf_counter()
            jax.block_until_ready(program(4.5))
            seconds[name].append(time.perf_counter() - began)
    # The first of each is to warm up.
    return {name: statistics.median(s[1:]) for name, s in seconds.items()} | {
        "peak_memory_bytes": peak_memory()
    }


def first_frame():
    """Seconds from the start of a process to its first recorded frame, nothing cached."""
    began = time.perf_counter()
    subprocess.run([sys.executable, "-c", FIRST_FRAME], check=True, capture_output=True)
    return time.perf_counter() - began


def in_process(option):
    command = [sys.executable, __file__, option]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--largest", type=int, default=SIZES[-1], help="largest box")
    parser.add_argument(
        "--reverse", action="store_true", help="print the figures of reverse mode alone, as JSON"
    )
    arguments = parser.parse_args()
    if arguments.reverse:
        print(json.dumps(reverse()))
        return
    jobs = {
        f"{n} beads": lambda n=n: bench("--beads", str(n)) for n in SIZES if n <= arguments.largest
    }
    jobs["64 x 3000 beads"] = lambda: bench("--beads", "3000", "--batch", "64")
    jobs["tangent"] = lambda: bench("--beads", "3000", "--tangent")
    jobs["reverse"] = lambda: in_process("--reverse")
    jobs["first frame"] = first_frame
    found = {name: [] for name in jobs}
    for _ in range(arguments.rounds):
        for name, job in jobs.items():
            found[name].append(job())
            print(name, found[name][-1], file=sys.stderr, flush=True)
    text = table(found)
    print(text)
    where = (
        f"{datetime.date.today()}, Python {platform.python_version()}, {arguments.rounds} rounds"
    )
    head = (
        "# Size, batches and derivatives\n\nWritten by `python tests/benchmarks/scaling.py`; "
        f"{where}; water conditions.\n\n"
    )
    (HERE / "SCALING.md").write_text(head + text + "\n")


def table(found):
    median = lambda name, figure: statistics.median(r[figure] for r in found[name])
    boxes = [name for name in found if name.endswith("beads")]
    speed = {name: median(name, "particle_steps_per_second") for name in boxes}
    best = max(v for name, v in speed.items() if " x " not in name)
    columns = (
        "box",
        "particle-steps/s",
        "best over it",
        "steps per rebuild",
        "rebuild, ms",
        "peak memory, GiB",
    )
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for name in boxes:
        rebuild, steps, memory = (
            median(name, f) for f in ("rebuild_seconds", "steps_per_rebuild", "peak_memory_bytes")
        )
        costs = f"{steps:.2g} | {1e3 * rebuild:.3g} | {memory / 2**30:.2f}"
        lines.append(f"| {name} | {speed[name]:.3g} | {best / speed[name]:.2f} | {costs} |")
    gradient = statistics.median(r["gradient"] / r["primal"] for r in found["reverse"])
    run = (
        f"{REVERSE_FRAMES * REVERSE_EVERY} steps of {REVERSE_BEADS} beads, kept every "
        f"{REVERSE_EVERY}"
    )
    return "\n".join(
        [
            *lines,
            "",
            "| derivative or start | |",
            "|---|---|",
            "| forward tangent over primal, 3,000 beads | "
            f"{median('tangent', 'tangent_over_primal'):.2f} |",
            f"| gradient over primal, {run} | {gradient:.2f} |",
            "| peak memory of that process, GiB | "
            f"{median('reverse', 'peak_memory_bytes') / 2**30:.2f} |",
            "| first frame of 3,000 beads from a cold start, s | "
            f"{statistics.median(found['first frame']):.1f} |",
        ]
    )


if __name__ == "__main__":
    main()
