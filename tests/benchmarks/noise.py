"""The pair noise through TestU01's SmallCrush, as the engine consumes it, beside JAX's own
generator.

    apt-get install libtestu01-0-dev gcc
    python tests/benchmarks/noise.py

Streams of 32-bit words are made of 16 bits of each number: the top ones, and the lowest ones of
the 23 that a number has. Writes ``tests/benchmarks/NOISE.md``.
"""

import argparse
import datetime
import functools
import re
import subprocess
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import dpdjax as dpd
from dpdjax.pairs import noise

HERE = Path(__file__).parent
CHUNK = 1 << 22

DRIVER = """
#include <stdio.h>
#include <stdlib.h>
#include <testu01/unif01.h>
#include <testu01/bbattery.h>
static unsigned int next(void) {
    static unsigned int buffer[1 << 16];
    static size_t at = 0, filled = 0;
    if (at == filled) {
        filled = fread(buffer, 4, 1 << 16, stdin);
        at = 0;
        if (!filled) { printf("THE STREAM ENDED\\n"); exit(1); }
    }
    return buffer[at++];
}
int main(void) {
    unif01_Gen *gen = unif01_CreateExternGenBits("stdin", next);
    bbattery_SmallCrush(gen);
    return 0;
}
"""


def pair_noise(key, step, i, j):
    """The noise of pairs of ids at a step."""
    words = noise.step_words(key, step)
    return noise.pair_noise(
        words, noise.bead_words(words, i), noise.bead_words(words, j), np.float64
    )


def integers(xi):
    """The 23 bits a number of the noise was made of."""
    return jnp.round(xi / 12.0**0.5 * 2.0**23 + (2.0**22 - 0.5)).astype(jnp.uint32)


def words(k, low: bool):
    """Pairs of 23-bit integers as 32-bit words."""
    half = (k & 0xFFFF if low else k >> 7).ravel()
    half = half[: half.size // 2 * 2]
    return half[::2] << 16 | half[1::2]


@functools.cache
def listed_pairs():
    """The ids of the pairs of a settled box of water, in the order of its list."""
    fluid = dpd.fluid(
        [dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)],
        [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)],
        kT=1.0,
    )
    key = jax.random.key(1)
    state = dpd.initial_state(fluid, key, box=20.0, density=3.0, dt=0.01)
    state = dpd.run(fluid, state, key, 0.01, dpd.Plan(2, 50), progress=False).final
    i, j = state.neighbours[0].list.idx
    return i[i < state.n], j[i < state.n]


def by_list(key, block):
    """All pairs of a real list at one step after the other: what a run consumes, as it does."""
    i, j = listed_pairs()
    steps = CHUNK // i.size
    at = lambda step: pair_noise(key, step, i, j)
    return jax.vmap(at)(block * steps + jnp.arange(steps))


def by_pair(key, block):
    """1,024 fixed pairs, each at 4,096 consecutive steps before the next."""
    i, j = (jax.lax.dynamic_slice_in_dim(x, block * 1024 % 200_000, 1024) for x in listed_pairs())
    at = lambda step: pair_noise(key, step, i, j)
    return jax.vmap(at)(4096 * block + jnp.arange(4096)).T


def by_id(key, block):
    """At one step, beads 0, 1, 2, ... each with its 2,048 successors."""
    i = jnp.arange(2048, dtype=jnp.int32)
    first, second = jnp.broadcast_arrays(i[:, None], i[:, None] + 1 + i[None])
    return pair_noise(key, block, first, second)


def threefry(key, block):
    """JAX's own generator, as the control."""
    bits = jax.random.bits(jax.random.fold_in(key, block), (CHUNK,), jnp.uint32)
    return (bits >> 9).astype(jnp.float64) * 12.0**0.5 * 2.0**-23 - (
        2.0**22 - 0.5
    ) * 12.0**0.5 * 2.0**-23


STREAMS = {"list": by_list, "pair": by_pair, "id": by_id, "threefry": threefry}


def battery(driver, stream, low, seed):
    """Run SmallCrush on a stream: chunks used, and the p-values outside [0.001, 0.999] by name of
    their test."""
    key = jax.random.key(seed)
    make = jax.jit(lambda block: words(integers(stream(key, block)), low))
    process = subprocess.Popen([driver], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    block = 0
    try:
        while process.poll() is None:
            process.stdin.write(np.asarray(make(jnp.asarray(block, jnp.int32))).tobytes())
            block += 1
    except BrokenPipeError:
        pass
    text = process.stdout.read().decode()
    if "All tests were passed" in text:
        return block, ""
    summary = text[text.index("Summary results") :]
    return block, "; ".join(
        " ".join(f).strip() for f in re.findall(r"^\s*\d+\s+(\S+)\s+(\S.*)$", summary, re.M)
    ) or summary


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=STREAMS, default=None)
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    listed_pairs()
    lines = ["| order of the numbers | bits | 32-bit words | SmallCrush |", "|---|---|---|---|"]
    with tempfile.TemporaryDirectory() as folder:
        source, driver = Path(folder, "driver.c"), str(Path(folder, "driver"))
        source.write_text(DRIVER)
        libraries = ["-ltestu01", "-ltestu01probdist", "-ltestu01mylib", "-lm"]
        subprocess.run(["gcc", "-O2", str(source), "-o", driver, *libraries], check=True)
        for name, stream in STREAMS.items():
            if arguments.only in (None, name):
                for low in (False, True):
                    blocks, verdict = battery(driver, stream, low, 2026)
                    if verdict:
                        # A lone p-value of one in a thousand is expected among 120: another key
                        # tells.
                        again = battery(driver, stream, low, 2027)[1]
                        verdict += f" (another key: {again or 'all 15 passed'})"
                    what, bits = stream.__doc__.rstrip("."), "low 16" if low else "top 16"
                    lines.append(
                        f"| {what} | {bits} | {blocks * CHUNK // 2:.2g} | "
                        f"{verdict or 'all 15 passed'} |"
                    )
                    print(lines[-1], flush=True)
    if arguments.only is None:
        head = (
            "# The pair noise through SmallCrush\n\nWritten by `python tests/benchmarks/noise.py`; "
        )
        head += f"{datetime.date.today()}, TestU01 1.2.3.\n\n"
        (HERE / "NOISE.md").write_text(head + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
