"""What the atlas, designs and fits are right to: measures, writes inverse.json, and INVERSE.md from
it.

    python tests/physics/inverse.py              # everything, two hours on 2 cores
    python tests/physics/inverse.py fresh_states # one room

The fresh states are those of ``python tests/atlas/survey.py fresh``, which no fit has seen. Single
precision, as users run.
"""

import json
import math
import sys

import jax
import numpy as np
from rooms import HERE, measure, row

import dpdjax as dpd
from dpdjax.measure.statistics import Estimate
from dpdjax.surrogate import atlas

sys.path.insert(0, str(HERE.parent / "atlas"))
import fit as tables

KEY = jax.random.key(2027)
SHARES = {"68 %": 0.9945, "95 %": 1.96}
"""Half widths of intervals in standard errors."""


def fresh() -> np.recarray:
    """The fresh states that are measured."""
    return tables.rows_of(HERE.parent / "atlas" / "fresh.nc")


def deviations(rows) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Of each quantity what was measured less what the atlas has, relative, and the combined
    standard error of that (states,). Viscosities are at a small rate, and are brought to none by
    what twice the rate changes, as the atlas does."""
    states = atlas.states_of(rows)
    told = atlas.Table.shipped().at(states)
    times = atlas.thinning(rows["viscosity_fast"] / rows["viscosity"])
    # At none ln eta is ln slow less what one rate changes, (ln fast - ln slow)/(times - 1).
    slow, fast = np.log(rows["viscosity"]), np.log(rows["viscosity_fast"])
    of = lambda name: rows[f"{name}_error"] / rows[name]
    measured = {
        "viscosity": (slow, of("viscosity")),
        "viscosity at no rate": (
            slow - (fast - slow) / (times - 1),
            np.hypot(of("viscosity") * times, of("viscosity_fast")) / (times - 1),
        ),
        "diffusion": (np.log(rows["diffusion"]), of("diffusion")),
        "pressure": (np.log(rows["pressure"]), of("pressure")),
    }
    found = {}
    for name, (value, error) in measured.items():
        theirs, off = told[name.partition(" at ")[0]]
        found[name] = value - np.log(theirs), np.hypot(error, off)
    return found


def fresh_states():
    """The atlas against fresh states at random in it, half of them at exponent 2

    Off is what was measured less what the atlas has, in the median; an interval is of the combined
    error of both. The viscosities were measured at small shear rates, the atlas has those at none.
    """
    rows = fresh()
    where = f"{len(rows)} states"
    found = []
    for name, (off, error) in deviations(rows).items():
        median = float(np.median(np.abs(off)))
        limit = 0.003 if name == "pressure" else 0.01
        note = f"errors of the runs and the atlas together {np.median(error):.2%} in the median"
        found.append(row(f"{name}, median off", where, median, limit, "at most", note))
        for share, width in SHARES.items():
            inside = np.abs(off) <= width * error
            count = f"{int(inside.sum())} of {len(inside)}"
            expected = float(share.split()[0]) / 100
            found.append(
                row(f"{name}, within {share}", where, inside.mean(), expected, "exact", count)
            )
    return found


def lammps_states():
    """The atlas against LAMMPS

    Each run of lammps.json, at its rate; the atlas has viscosities at small ones. At rate 0.2 and a
    step of 0.01 the fluid of (a 0, gamma 5) is 1.4 % hot.
    """
    found = []
    for run in json.loads((HERE / "lammps.json").read_text()):
        numbers = {"a": run["repulsion"], "gamma": run["gamma"], "kT": run["kT"]}
        told = dpd.atlas(dpd.water(**numbers), run["density"])
        where = ", ".join(f"{name} {value:g}" for name, value in numbers.items())
        referee = Estimate(run["viscosity"], run["viscosity_error"])
        source = f"LAMMPS, rate {run['rate']:g}, dt {run['dt']:g}"
        note = f"off by {told.viscosity.value / referee.value - 1:+.1%}"
        found.append(row("viscosity", where, told.viscosity, referee, source, note))
    return found


def published_states():
    """The atlas against published numbers

    The viscosity of 1.23 was published without its method; four methods here, and LAMMPS, agree on
    four to five per cent more.
    """
    ideal, water = dpd.atlas(dpd.water(a=0.0, gamma=5.0), 3.0), dpd.atlas(dpd.water(), 3.0)
    seed = "a 0, gamma 5, density 3", Estimate(1.23, 0.01), "seed 001"
    monte_carlo = "a 25, density 3", Estimate(23.65, 0.02), "P. Warren, Monte Carlo"
    boromand = "a 25, gamma 4.5, density 3", Estimate(0.85, 0.1), "Boromand et al. 2015"
    compressible = "a 25, density 3", Estimate(0.020880, 0.000068), "p(density) of BAROSTAT.md"
    return [
        row("viscosity", seed[0], ideal.viscosity, *seed[1:]),
        row("viscosity", boromand[0], water.viscosity, *boromand[1:]),
        row("pressure", monte_carlo[0], water.pressure, *monte_carlo[1:]),
        row("compressibility", compressible[0], water.compressibility, *compressible[1:]),
    ]


def designed():
    """A design, at once, against calibrations, which run: the main job of the README"""
    told = dpd.design(viscosity=1.1, kT=0.1, repulsion=2.5)[0]
    main = json.loads((HERE / "results.json").read_text())["main_job"]["rows"]
    mean = next(r for r in main if r["quantity"].endswith("mean") and "gamma" in r["quantity"])
    calibrated = Estimate(*mean["value"])
    where, source = "a 2.5, kT 0.1", "12 calibrations"
    return [row("gamma of viscosity 1.1", where, told.gamma, calibrated, source)]


def hidden_truths():
    """Twenty hidden truths (gamma, s): posteriors from their viscosity and diffusion, given with
    errors of one per cent.

    The truths are the fresh states of other exponents than 2, what is given are their measured
    numbers with noise to one per cent. Density and repulsion are known.
    """
    truths, noise = fresh(), np.random.default_rng(5)
    truths = truths[truths["s"] < 2.0][:20]
    found = [posterior(truth, jax.random.fold_in(KEY, k), noise) for k, truth in enumerate(truths)]
    where = f"{len(truths)} truths"
    rows = []
    for name in ("gamma", "s"):
        for share in (0.68, 0.95):
            ends = [fit.interval(name, share) for fit in found]
            count = sum(low <= truth[name] <= high for truth, (low, high) in zip(truths, ends))
            told = f"{count} of {len(truths)}"
            quantity = f"{name}, within {share:.0%}"
            rows.append(row(quantity, where, count / len(truths), share, "exact", told))
    for truth, fit in zip(truths, found):
        told = ", ".join(
            f"{name} {fit.estimates[name]} of {truth[name]:.4g}" for name in fit.estimates
        )
        state = f"density {truth['density']:g}, a {truth['a']:g}"
        rows.append(row("particle-steps", state, fit.particle_steps, 3e9, "at most", told))
    return rows


def posterior(truth, key, noise):
    """That of gamma and s, from numbers of a truth with errors of one per cent."""
    density, a, gamma = (float(truth[name]) for name in ("density", "a", "gamma"))
    repulsion = dpd.term(dpd.soft_repulsion, a=a, r_c=1.0)
    drag = dpd.term(dpd.laws.power_drag, gamma=gamma, s=1.0, r_c=1.0)
    side = (1500 / density) ** (1 / 3)
    fluid = dpd.fluid([repulsion], [drag], kT=1.0)
    model = dpd.experiments.Solvent(fluid=fluid, density=density, box=side)
    data = {name: with_noise(truth, name, noise) for name in ("viscosity", "diffusion")}
    priors = {"gamma": (0.2 * gamma, 5.0 * gamma), "s": (0.25, 2.0)}
    return dpd.fit(model, data, priors, key=key, checks=1, progress=False)


def with_noise(truth, name: str, noise, relative: float = 0.01) -> Estimate:
    """A measured number with so much noise that its error is the relative one."""
    value, error = float(truth[name]), float(truth[f"{name}_error"])
    missing = math.sqrt(max((relative * value) ** 2 - error**2, 0.0))
    return Estimate(value + missing * noise.normal(), relative * value)


ROOMS = (fresh_states, lammps_states, published_states, designed, hidden_truths)

HEADING = """# The atlas, designs and fits

Written by `python tests/physics/inverse.py`; do not edit.
Thermal units, standard errors."""


if __name__ == "__main__":
    measure(ROOMS, sys.argv[1:], "inverse.json", "INVERSE.md", HEADING)
