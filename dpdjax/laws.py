"""Laws of pairs, and what a law of your own can declare of itself."""

from dpdjax.model.colloid_laws import (
    asakura_oosawa,
    balanced_cut,
    balanced_drag,
    balanced_repulsion,
    contact,
    literal_drag,
    literal_noise,
    morse,
    scaled_contact,
    scripts_repulsion,
    solvent_cut,
    squeezing_lubrication,
    unequal_lubrication,
    yukawa,
)
from dpdjax.model.declare import (
    attracts,
    bounded,
    friction,
    of_viscosity,
    potential,
    projected,
    proportional_to,
    reaches,
)
from dpdjax.model.fluid import Interaction, interaction
from dpdjax.model.laws import central_drag, power_drag, soft_repulsion, transverse_drag
from dpdjax.model.marble_laws import shifted_repulsion, surface_drag
from dpdjax.model.term import Term, term, whole

__all__ = [
    "asakura_oosawa",
    "attracts",
    "balanced_cut",
    "balanced_drag",
    "balanced_repulsion",
    "bounded",
    "central_drag",
    "contact",
    "friction",
    "Interaction",
    "interaction",
    "literal_drag",
    "literal_noise",
    "morse",
    "of_viscosity",
    "potential",
    "power_drag",
    "projected",
    "proportional_to",
    "reaches",
    "scaled_contact",
    "scripts_repulsion",
    "shifted_repulsion",
    "soft_repulsion",
    "solvent_cut",
    "squeezing_lubrication",
    "surface_drag",
    "Term",
    "term",
    "transverse_drag",
    "unequal_lubrication",
    "whole",
    "yukawa",
]
