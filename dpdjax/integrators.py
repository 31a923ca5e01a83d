"""How beads move on in time, and the parts that an integrator of your own is made of."""

from dpdjax.engine.forces import EVERYTHING, forces_on, update_lists
from dpdjax.engine.integrator import Drift, Integrator, VelocityVerlet, drifted, settled
from dpdjax.model.beads import inertias, masses
from dpdjax.pairs.sums import Forces

__all__ = [
    "Drift",
    "drifted",
    "EVERYTHING",
    "Forces",
    "forces_on",
    "inertias",
    "Integrator",
    "masses",
    "settled",
    "update_lists",
    "VelocityVerlet",
]
