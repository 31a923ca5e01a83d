"""How beads move on in time, and the parts that an integrator of your own is made of."""

from dpdjax.engine.barostat import CellRescaling
from dpdjax.engine.choice import cheapest
from dpdjax.engine.forces import EVERYTHING, UNDAMPED, forces_on, update_lists
from dpdjax.engine.implicit import ImplicitDrag, damped
from dpdjax.engine.integrator import (
    Drift,
    Integrator,
    VelocityVerlet,
    drifted,
    settled,
    with_forces,
)
from dpdjax.engine.multistep import MultipleTimeStep
from dpdjax.model.beads import inertias, masses
from dpdjax.pairs.sums import Forces

__all__ = [
    "CellRescaling",
    "cheapest",
    "damped",
    "Drift",
    "drifted",
    "EVERYTHING",
    "Forces",
    "forces_on",
    "ImplicitDrag",
    "inertias",
    "Integrator",
    "masses",
    "MultipleTimeStep",
    "settled",
    "UNDAMPED",
    "update_lists",
    "VelocityVerlet",
    "with_forces",
]
