"""What one reads off a run, with error bars: transport, viscosity, structure, contacts."""

from dpdjax.measure.clusters import cluster_of_each, clusters
from dpdjax.measure.contact_bonds import bonded_pairs, contact_bonds
from dpdjax.measure.contacts import contact_number, contacts_of_each
from dpdjax.measure.distribution import pair_distribution, partial_distribution
from dpdjax.measure.drive import Driven, driven_diffusion, driven_rotation
from dpdjax.measure.profile import VelocityProfile, velocity_profile
from dpdjax.measure.rheology import Moduli, moduli
from dpdjax.measure.rotation import (
    angular_velocity_autocorrelation,
    orientation_correlation,
    rotational_diffusion,
)
from dpdjax.measure.scattering import structure_factor
from dpdjax.measure.solvent import solvent_density
from dpdjax.measure.spheres import Spheres, spheres, spheres_of
from dpdjax.measure.statistics import Estimate, block_average
from dpdjax.measure.structure import RadialDistribution, radial_distribution
from dpdjax.measure.transport import (
    diffusion,
    large_system_diffusion,
    mean_squared_displacement,
    velocity_autocorrelation,
)
from dpdjax.measure.viscosity import (
    einstein_helfand,
    extrapolate,
    green_kubo,
    shear_viscosity,
    sinusoidal_viscosity,
)

__all__ = [
    "angular_velocity_autocorrelation",
    "block_average",
    "bonded_pairs",
    "cluster_of_each",
    "clusters",
    "contact_bonds",
    "contact_number",
    "contacts_of_each",
    "diffusion",
    "Driven",
    "driven_diffusion",
    "driven_rotation",
    "einstein_helfand",
    "Estimate",
    "extrapolate",
    "green_kubo",
    "large_system_diffusion",
    "mean_squared_displacement",
    "Moduli",
    "moduli",
    "orientation_correlation",
    "pair_distribution",
    "partial_distribution",
    "radial_distribution",
    "RadialDistribution",
    "rotational_diffusion",
    "shear_viscosity",
    "sinusoidal_viscosity",
    "solvent_density",
    "Spheres",
    "spheres",
    "spheres_of",
    "structure_factor",
    "velocity_autocorrelation",
    "velocity_profile",
    "VelocityProfile",
]
