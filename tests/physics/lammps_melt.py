"""A sheared melt of DPD chains from LAMMPS: the independent referee of tests/physics/molecules.py.

Shares no code with dpdjax and is not run by the tests.  It needs an MPI build of LAMMPS.

    python lammps_melt.py --steps 100000 --append lammps_melt.json

Chains of springs U = k r^2/2 (``bond_style harmonic`` with K = k/2 and r0 = 0), all beads
pairs of each other (``special_bonds lj 1 1 1``), in the fluid and the flow of lammps_shear.py.
"""

import argparse
import json
import os
import re
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from lammps_shear import block_error, find

INPUT = """\
units           lj
atom_style      bond
newton          on
comm_modify     vel yes cutoff {ghost}
special_bonds   lj 1.0 1.0 1.0
read_data       melt.data
pair_style      dpd 1.0 1.0 {seed}
pair_coeff      1 1 {repulsion} {gamma}
bond_style      harmonic
bond_coeff      1 {half_k} 0.0
neighbor        0.4 bin
neigh_modify    every 1 delay 0 check yes
velocity        all create 1.0 {seed2} mom yes rot no dist gaussian
velocity        all ramp vx 0 $({rate}*{side}) y 0 {side} sum yes units box
timestep        {dt}
fix             1 all nve
fix             2 all deform 1 xy erate {rate} remap v flip yes
compute         T all temp/deform
compute         P all pressure T
thermo_style    custom step time c_T c_P c_P[4] xy
thermo          {thermo}
run             {equilibration}
fix             stress all ave/time {every} {repeat} {window} c_T c_P c_P[4] file stress.txt
dump            1 all custom {window} places.txt id x y z
dump_modify     1 sort id format line "%d %.6f %.6f %.6f"
run             {steps}
"""


def data_file(chains, length, side, seed):
    """Random walks of springs as a LAMMPS data file."""
    draw = np.random.default_rng(seed)
    x = draw.normal(size=(chains, length, 3)) * 0.5
    x[:, 0] = draw.uniform(size=(chains, 3)) * side
    x = np.cumsum(x, axis=1).reshape(-1, 3) % side
    n = chains * length
    first = np.arange(1, n + 1).reshape(chains, length)
    bonds = np.stack([first[:, :-1].ravel(), first[:, 1:].ravel()], axis=1)
    lines = ["chains", "", f"{n} atoms", f"{len(bonds)} bonds", "1 atom types", "1 bond types", ""]
    lines += [f"0 {side} {a}lo {a}hi" for a in "xyz"] + [
        "0 0 0 xy xz yz",
        "",
        "Masses",
        "",
        "1 1.0",
    ]
    lines += ["", "Atoms # bond", ""]
    lines += [
        f"{k + 1} {k // length + 1} 1 {a:.6f} {b:.6f} {c:.6f}" for k, (a, b, c) in enumerate(x)
    ]
    lines += ["", "Bonds", ""] + [f"{k + 1} 1 {a} {b}" for k, (a, b) in enumerate(bonds)]
    return "\n".join(lines) + "\n"


def squared_ends(text, length):
    """Mean squared end-to-end distance of each snapshot, by nearest images along the chain."""
    found = []
    for snapshot in text.split("ITEM: TIMESTEP\n")[1:]:
        lines = snapshot.splitlines()
        (xlo, xhi, xy), (ylo, yhi, _), (zlo, zhi, _) = (
            map(float, line.split()) for line in lines[4:7]
        )
        xlo, xhi = xlo - min(0.0, xy), xhi - max(0.0, xy)
        sides = np.array([xhi - xlo, yhi - ylo, zhi - zlo])
        x = np.array([line.split()[1:4] for line in lines[8:]], float).reshape(-1, length, 3)
        d = np.diff(x, axis=1)
        for k, lattice in ((2, [0, 0, sides[2]]), (1, [xy, sides[1], 0]), (0, [sides[0], 0, 0])):
            d -= np.round(d[..., k : k + 1] / sides[k]) * np.array(lattice)
        found.append(np.mean(np.sum(d.sum(axis=1) ** 2, axis=-1)))
    return np.array(found)


def sheared_melt(
    length=10,
    k=4.0,
    repulsion=25.0,
    gamma=4.5,
    rate=0.1,
    dt=0.01,
    side=10.0,
    density=3.0,
    steps=100_000,
    equilibration=20_000,
    every=5,
    windows=400,
    seed=1,
    ranks=2,
):
    """Run one sheared melt; return its parameters and averages as a dict."""
    chains = round(density * side**3 / length)
    window = steps // windows // every * every
    repeat, steps = window // every, window * windows
    given = dict(locals())
    lmp, mpiexec = find("lmp"), find("mpiexec")
    paths = [str(Path(lmp).parent.parent / "lib"), os.environ.get("LD_LIBRARY_PATH", "")]
    environment = dict(
        os.environ, OMP_NUM_THREADS="1", LD_LIBRARY_PATH=os.pathsep.join(filter(None, paths))
    )
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        (folder / "melt.data").write_text(data_file(chains, length, side, seed))
        more = {"half_k": k / 2, "seed2": seed + 1, "thermo": max(1, steps // 20), "ghost": 4.0}
        (folder / "in.melt").write_text(INPUT.format(**given, **more))
        start = time.perf_counter()
        done = subprocess.run(
            [mpiexec, "-n", str(ranks), lmp, "-in", "in.melt"],
            cwd=folder,
            env=environment,
            text=True,
            capture_output=True,
        )
        wall = time.perf_counter() - start
        if done.returncode:
            raise RuntimeError(f"LAMMPS failed:\n{done.stdout[-3000:]}{done.stderr[-1000:]}")
        table = np.loadtxt(folder / "stress.txt")
        ends = squared_ends((folder / "places.txt").read_text(), length)
    _, temperature, pressure, stress = table[-windows:].T
    loops = [float(x) for x in re.findall(r"Loop time of (\S+)", done.stdout)]
    names = ("temperature", "pressure", "viscosity", "squared_end_to_end")
    series = (temperature, pressure, -stress / rate, ends)
    found = {name: [float(s.mean()), block_error(s, 20)] for name, s in zip(names, series)}
    keep = ("length", "k", "repulsion", "gamma", "rate", "dt", "side", "density", "steps", "seed")
    return (
        {name: given[name] for name in keep}
        | found
        | {
            "particle_steps_per_second": chains * length * steps / loops[-1],
            "wall_seconds": wall,
            "ranks": ranks,
            "lammps": re.search(r"LAMMPS \(([^)]*)\)", done.stdout).group(1),
        }
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (("steps", 100_000), ("seed", 1), ("ranks", 2), ("length", 10)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--append", help="JSON file, a list that the result is added to")
    arguments = vars(parser.parse_args())
    path = arguments.pop("append")
    found = sheared_melt(**arguments)
    print(json.dumps(found, indent=1))
    if path:
        old = json.loads(Path(path).read_text()) if Path(path).exists() else []
        Path(path).write_text(json.dumps([*old, found], indent=1) + "\n")


if __name__ == "__main__":
    main()
