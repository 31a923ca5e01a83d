"""What drives a fluid from outside: deformations of the box, and forces on its beads."""

from dpdjax.engine.deformation import Deformation, oscillatory_shear, shear
from dpdjax.engine.drivers import Driver, body_force, constant_field, drive, sinusoidal_force

__all__ = [
    "body_force",
    "constant_field",
    "Deformation",
    "drive",
    "Driver",
    "oscillatory_shear",
    "shear",
    "sinusoidal_force",
]
