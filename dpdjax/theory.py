"""Numbers from theory that runs are compared with, and lengths and times that follow from a
fluid."""

from dpdjax.measure.hydrodynamics import (
    angular_velocity_tail,
    hydrodynamic_radius,
    sphere_diffusion,
    sphere_rotational_diffusion,
    velocity_tail,
)
from dpdjax.model.advice import suggest_skin
from dpdjax.model.colloids import diffusion_time
from dpdjax.model.rates import damping_rate, drag_viscosity, kinetic_theory_viscosity, thermal_time
from dpdjax.model.units import flory_huggins, repulsion_from_compressibility

__all__ = [
    "angular_velocity_tail",
    "damping_rate",
    "diffusion_time",
    "drag_viscosity",
    "flory_huggins",
    "hydrodynamic_radius",
    "kinetic_theory_viscosity",
    "repulsion_from_compressibility",
    "sphere_diffusion",
    "sphere_rotational_diffusion",
    "suggest_skin",
    "thermal_time",
    "velocity_tail",
]
