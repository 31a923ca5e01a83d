"""What one reads off a run, with error bars: transport, viscosity, structure, molecules,
contacts."""

from dpdjax.measure.bonds import angles, bond_lengths, dihedrals
from dpdjax.measure.centres import molecular_diffusion, molecular_displacement
from dpdjax.measure.clusters import cluster_of_each, clusters
from dpdjax.measure.conformation import end_to_end, radius_of_gyration
from dpdjax.measure.contact_bonds import bonded_pairs, contact_bonds
from dpdjax.measure.contacts import contact_number, contacts_of_each
from dpdjax.measure.distribution import pair_distribution, partial_distribution
from dpdjax.measure.drive import Driven, driven_diffusion, driven_rotation
from dpdjax.measure.lipids import area_per_lipid, order_parameter
from dpdjax.measure.molecules import Molecules, chains, molecules_of
from dpdjax.measure.profile import VelocityProfile, velocity_profile
from dpdjax.measure.rheology import Moduli, moduli
from dpdjax.measure.rotation import (
    angular_velocity_autocorrelation,
    orientation_correlation,
    rotational_diffusion,
)
from dpdjax.measure.rouse import RouseModes, rouse_modes
from dpdjax.measure.scattering import structure_factor
from dpdjax.measure.solvent import solvent_density
from dpdjax.measure.spheres import Spheres, spheres, spheres_of
from dpdjax.measure.statistics import Estimate, block_average
from dpdjax.measure.structure import RadialDistribution, radial_distribution
from dpdjax.measure.tension import PressureProfile, pressure_profile, surface_tension
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
    "angles",
    "angular_velocity_autocorrelation",
    "area_per_lipid",
    "block_average",
    "bond_lengths",
    "bonded_pairs",
    "chains",
    "cluster_of_each",
    "clusters",
    "contact_bonds",
    "contact_number",
    "contacts_of_each",
    "diffusion",
    "dihedrals",
    "Driven",
    "driven_diffusion",
    "driven_rotation",
    "einstein_helfand",
    "end_to_end",
    "Estimate",
    "extrapolate",
    "green_kubo",
    "large_system_diffusion",
    "mean_squared_displacement",
    "Moduli",
    "moduli",
    "molecular_diffusion",
    "molecular_displacement",
    "Molecules",
    "molecules_of",
    "order_parameter",
    "orientation_correlation",
    "pair_distribution",
    "partial_distribution",
    "pressure_profile",
    "PressureProfile",
    "radial_distribution",
    "RadialDistribution",
    "radius_of_gyration",
    "rotational_diffusion",
    "rouse_modes",
    "RouseModes",
    "shear_viscosity",
    "sinusoidal_viscosity",
    "solvent_density",
    "Spheres",
    "spheres",
    "spheres_of",
    "structure_factor",
    "surface_tension",
    "velocity_autocorrelation",
    "velocity_profile",
    "VelocityProfile",
]
