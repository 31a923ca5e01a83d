"""Every public measure given every kind of run: the right number, or a refusal that says what to
give.

The runs are made up of random walks and noise whose viscosity, moduli, diffusion and structure are
known; see ``runs.py``.
"""

import dataclasses
import re
import warnings
from collections.abc import Callable

import numpy as np
import pytest
import runs
from runs import DIFFUSION, LOSS, ROTATION, STORAGE, VISCOSITY

import dpdjax as dpd
from dpdjax.measure.blocks import average

ERRORS = 4.5
"""How many of its errors an estimate may be off."""
ROUGH = 0.3
"""Share by which one of six frames may be off: they are all but the same configuration, and no
error bar tells that."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A measure, its right answer, the flows it works under, what it says under others, and
    whether a start-up changes it."""

    measure: Callable
    due: float
    flows: tuple = tuple(runs.FLOWS)
    refusal: str = ""
    settled: bool = False


RESTED, STEADY, WAVED = ("at rest",), ("sheared",), ("pushed",)
UNSHEARED = ("at rest", "pushed", "driven")
FIT = (1.0, 1.5)
LATER = 5.0
"""A lag at which the vector of a molecule is forgotten."""
AT_ONCE = 6 / runs.INTERVAL * np.tanh(0.5 * runs.INTERVAL / runs.MOTION)
"""Mean square of a velocity over its diffusion coefficient."""
HEAD_START = runs.INTERVAL / np.sinh(runs.INTERVAL / runs.MOTION) * (1 - np.exp(-1.0 / runs.MOTION))
"""By how much the mean square displacement over a time of 1 lags behind that of a random walk,
as a time."""
WITHOUT_DRIFT = DIFFUSION * (1 - 1 / (runs.POINTS + runs.SPHERES))
"""Of beads relative to their centre of mass."""
APART = float(np.sum(runs.SIDES**2)) / 12
"""Mean square of a vector anywhere in the box."""
MOLECULE = DIFFUSION * (0.5 - 1 / (runs.POINTS + runs.SPHERES))
"""Diffusion coefficient of the middle of two beads relative to the centre of mass."""
ANYWHERE = runs.SIDES * (np.random.default_rng(0).random((200_000, 3)) - 0.5)
"""Vectors anywhere in the box."""
ORDER = float(1.5 * np.mean(ANYWHERE[:, 2] ** 2 / np.sum(ANYWHERE**2, axis=1)) - 0.5)
CONTACTS = (runs.SPHERES - 1) * 4 / 3 * np.pi * (2 * runs.RADIUS + 0.5) ** 3 / runs.VOLUME
"""Of a sphere with gaps below 0.5 to others thrown at random."""
CLUSTER = 2.312
"""Mean size of the cluster of a sphere with gaps below 0.01, of 4,000 frames thrown at random:
2.312(11)."""


def curve_at(curve, lag, scale):
    """The value of a curve at a lag, over ``scale``."""
    return dpd.Estimate(float(curve.value[lag]), float(curve.error[lag])).scaled(1.0 / scale)


def level_of(values, error):
    """The mean over shells, leaving out the innermost, with the mean of their errors: shells of
    a frame are not independent."""
    later = slice(len(error) // 4, None)
    return dpd.Estimate(float(np.mean(values[later])), float(np.mean(error[later])))


def level_of_profile(profile):
    """The mean temperature, with the mean of the errors."""
    return dpd.Estimate(float(profile.temperature.mean()), float(profile.temperature_error.mean()))


def bonded(run):
    """Contacts of a sphere, from the pairs that are bonded in each frame."""
    members = dpd.measure.bonded_pairs(run, gap=0.5, forms=1.0)
    return average(
        np.array([[2 * len(pairs) / runs.SPHERES for pairs in member] for member in members])
    )


def displacement(run, axes):
    return curve_at(
        dpd.measure.mean_squared_displacement(run, t_max=1.0, axes=axes), -1, 2.0 * len(axes)
    )


def first_mode(run):
    """The mean square of the only Rouse mode of two beads, half of that of their distance."""
    found = dpd.measure.rouse_modes(run, t_max=LATER)
    return dpd.Estimate(float(found.mean_square[0]), float(found.error[0]))


def displacement_of_molecules(run, axes):
    return curve_at(
        dpd.measure.molecular_displacement(run, t_max=1.0, axes=axes), -1, 2.0 * len(axes)
    )


def structure(measure, **numbers):
    """A function of a run: the level of its distribution or structure factor."""

    def of(run):
        found = measure(run, **numbers)
        return level_of(found.s if hasattr(found, "s") else found.g, found.error)

    return of


AT_REST = "of a fluid in equilibrium.*run it without a flow"
CASES = {
    "shear_viscosity": Case(
        dpd.shear_viscosity,
        VISCOSITY,
        STEADY,
        r"run it with flow=dpd.shear|use dpd.measure.moduli",
        True,
    ),
    "green_kubo": Case(
        lambda run: dpd.measure.green_kubo(run, window=0.5), VISCOSITY, RESTED, AT_REST, True
    ),
    "einstein_helfand": Case(
        lambda run: dpd.measure.einstein_helfand(run, window=0.5), VISCOSITY, RESTED, AT_REST, True
    ),
    "sinusoidal_viscosity": Case(
        dpd.measure.sinusoidal_viscosity,
        VISCOSITY,
        WAVED,
        r"run it with flow=dpd.flows.sinusoidal_force",
        True,
    ),
    "moduli, storage": Case(
        lambda run: dpd.measure.moduli(run).storage,
        STORAGE,
        ("oscillated",),
        "need.*dpd.oscillatory_shear",
        True,
    ),
    "moduli, loss": Case(
        lambda run: dpd.measure.moduli(run).loss,
        LOSS,
        ("oscillated",),
        "need.*dpd.oscillatory_shear",
        True,
    ),
    "mean_squared_displacement": Case(
        lambda run: displacement(run, "xyz"), WITHOUT_DRIFT, settled=True
    ),
    "mean_squared_displacement, yz": Case(
        lambda run: displacement(run, "yz"), WITHOUT_DRIFT, settled=True
    ),
    "velocity_profile": Case(
        lambda run: level_of_profile(dpd.measure.velocity_profile(run, bins=5, species=1)),
        DIFFUSION * runs.LIGHT * AT_ONCE / 3 / (1 - 1 / (runs.POINTS + runs.SPHERES)),
    ),
    "velocity_autocorrelation": Case(
        lambda run: curve_at(dpd.measure.velocity_autocorrelation(run, t_max=1.0), 0, AT_ONCE),
        WITHOUT_DRIFT,
        settled=True,
    ),
    "diffusion": Case(lambda run: dpd.diffusion(run, fit=FIT), WITHOUT_DRIFT, settled=True),
    "diffusion, yz": Case(
        lambda run: dpd.diffusion(run, fit=FIT, axes="yz"), WITHOUT_DRIFT, settled=True
    ),
    "diffusion, vacf": Case(
        lambda run: dpd.diffusion(run, fit=FIT, method="vacf"), WITHOUT_DRIFT, settled=True
    ),
    "radial_distribution": Case(structure(dpd.measure.radial_distribution, bins=20), 1.0),
    "partial_distribution": Case(
        structure(dpd.measure.partial_distribution, species_a=0, species_b=1, bins=20), 1.0
    ),
    "pair_distribution": Case(
        structure(dpd.measure.pair_distribution, bins=20, h_min=-2 * runs.RADIUS), 1.0
    ),
    "structure_factor": Case(structure(dpd.measure.structure_factor, q_max=3.0, bins=10), 1.0),
    "contact_number": Case(lambda run: dpd.measure.contact_number(run, gap=0.5).mean, CONTACTS),
    "clusters": Case(lambda run: dpd.measure.clusters(run, gap=0.01).average("mean_size"), CLUSTER),
    "contact_bonds": Case(
        lambda run: dpd.measure.contact_bonds(run, gap=0.5, forms=1.0, t_max=0.2).per_colloid,
        CONTACTS,
    ),
    "bonded_pairs": Case(bonded, CONTACTS),
    "end_to_end": Case(lambda run: dpd.measure.end_to_end(run, t_max=LATER).mean_square, APART),
    "radius_of_gyration": Case(
        lambda run: dpd.measure.radius_of_gyration(run).mean_square, APART / 4
    ),
    "rouse_modes": Case(first_mode, APART / 6),
    "bond_lengths": Case(lambda run: dpd.measure.bond_lengths(run, "pair").mean_square, APART),
    "order_parameter": Case(lambda run: dpd.measure.order_parameter(run, head=0), ORDER),
    "molecular_displacement": Case(
        lambda run: displacement_of_molecules(run, "xyz"), MOLECULE, settled=True
    ),
    "molecular_displacement, yz": Case(
        lambda run: displacement_of_molecules(run, "yz"), MOLECULE, settled=True
    ),
    "molecular_diffusion": Case(
        lambda run: dpd.measure.molecular_diffusion(run, fit=FIT), MOLECULE, settled=True
    ),
    "molecular_diffusion, yz": Case(
        lambda run: dpd.measure.molecular_diffusion(run, fit=FIT, axes="yz"), MOLECULE, settled=True
    ),
    "angular_velocity_autocorrelation": Case(
        lambda run: curve_at(
            dpd.measure.angular_velocity_autocorrelation(run, t_max=1.0), 0, AT_ONCE
        ),
        ROTATION,
        UNSHEARED,
        "run without a flow",
        True,
    ),
    "orientation_correlation": Case(
        lambda run: curve_at(
            dpd.measure.orientation_correlation(run, t_max=1.0),
            -1,
            np.exp(-2 * ROTATION * (1.0 - HEAD_START)) / ROTATION,
        ),
        ROTATION,
        UNSHEARED,
        "run without a flow",
        True,
    ),
    "rotational_diffusion": Case(
        lambda run: dpd.measure.rotational_diffusion(run, fit=FIT),
        ROTATION,
        UNSHEARED,
        "run without a flow",
        True,
    ),
    "rotational_diffusion, vacf": Case(
        lambda run: dpd.measure.rotational_diffusion(run, fit=FIT, method="vacf"),
        ROTATION,
        UNSHEARED,
        "run without a flow",
        True,
    ),
    "driven_diffusion": Case(
        lambda run: dpd.measure.driven_diffusion(run).diffusion,
        DIFFUSION,
        ("driven",),
        r"run it with flow=dpd.drive\(force",
        True,
    ),
    "driven_rotation": Case(
        lambda run: dpd.measure.driven_rotation(run).diffusion,
        ROTATION,
        ("driven",),
        r"run it with flow=dpd.drive\(torque",
        True,
    ),
}
TOO_SHORT = "run longer|outside the run|too few|no error bar|within the run|too short"


def outcome(measure, run):
    """The value, or how it was refused; and what was warned of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found = measure(run)
        except ValueError as error:
            found = str(error)
    return found, " | ".join(str(w.message) for w in caught)


@pytest.mark.parametrize("flow", runs.FLOWS)
@pytest.mark.parametrize("name", CASES)
def test_the_right_number_or_what_to_give(name, flow):
    case = CASES[name]
    for form in runs.FORMS:
        found, told = outcome(case.measure, runs.made(flow, form))
        where = f"{name}, {flow}, {form}: {found}; {told}"
        if flow not in case.flows or form == "scan":
            cure = "differ in .*run.members" + (
                f"|{case.refusal}" if flow not in case.flows else ""
            )
            assert isinstance(found, str) and re.search(cure, found), where
        elif isinstance(found, str):
            assert form == "short" and re.search(TOO_SHORT, found), where
        elif form == "started up" and case.settled:
            assert re.search("not stationary|where kT is 1", told), where
        elif flow in ("pushed", "driven") and re.search("drove this run", told):
            assert name in PUSHED
        else:
            assert (
                form == "started up" or not told or (form == "short" and re.search(TOO_SHORT, told))
            ), where
            assert abs(found.value - case.due) < max(
                ERRORS * found.error, ROUGH * case.due * (form == "short")
            ), where


PUSHED = [
    name
    for name, case in CASES.items()
    if case.settled and set(UNSHEARED) <= set(case.flows) and "yz" not in name
]
"""Measures of motion that does not tell the flow that a force made from that of the beads, and
say so."""
