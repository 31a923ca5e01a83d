"""dpdjax: differentiable, vectorised dissipative particle dynamics on JAX.

``import dpdjax as dpd`` is quick: every public name is imported when it is first used.
"""

import difflib
import importlib

_HOMES = {
    "dpdjax.model.laws": ["soft_repulsion", "central_drag", "power_drag", "transverse_drag"],
    "dpdjax.model.colloid_laws": [
        "asakura_oosawa",
        "balanced_cut",
        "balanced_drag",
        "balanced_repulsion",
        "contact",
        "literal_drag",
        "literal_noise",
        "morse",
        "scaled_contact",
        "scripts_repulsion",
        "solvent_cut",
        "squeezing_lubrication",
        "unequal_lubrication",
        "yukawa",
    ],
    "dpdjax.model.marble_laws": ["shifted_repulsion", "surface_drag"],
    "dpdjax.model.declare": [
        "attracts",
        "bounded",
        "friction",
        "of_viscosity",
        "potential",
        "projected",
        "proportional_to",
        "reaches",
    ],
    "dpdjax.model.term": ["Term", "term", "whole"],
    "dpdjax.model.fluid": ["Fluid", "Interaction", "fluid", "interaction"],
    "dpdjax.model.colloids": ["colloid_fluid", "diffusion_time", "pure_solvent"],
    "dpdjax.model.marbles": ["marble_fluid"],
    "dpdjax.model.units": ["Units", "repulsion_from_compressibility", "water", "water_units"],
    "dpdjax.pairs.box": ["Box", "displacement"],
    "dpdjax.engine.deformation": ["Deformation", "oscillatory_shear", "shear"],
    "dpdjax.engine.drivers": [
        "Driver",
        "body_force",
        "constant_field",
        "drive",
        "sinusoidal_force",
    ],
    "dpdjax.model.advice": ["suggest_dt", "suggest_skin"],
    "dpdjax.engine.state": ["State", "grow"],
    "dpdjax.prepare.start": ["initial_state"],
    "dpdjax.prepare.suspension": ["Suspension", "suspension"],
    "dpdjax.prepare.marbles": ["Marbles", "marbles"],
    "dpdjax.engine.rotation": ["Rotation"],
    "dpdjax.engine.record": ["mean", "integral"],
    "dpdjax.engine.integrator": ["Integrator", "VelocityVerlet"],
    "dpdjax.engine.trajectory": ["Plan", "Trajectory"],
    "dpdjax.engine.simulate": ["forces", "simulate", "step"],
    "dpdjax.engine.observables": [
        "configurational_temperature",
        "instantaneous_viscosity",
        "momentum",
        "positions",
        "positions_of",
        "pressure_by_origin",
        "pressure_tensor",
        "rotational_temperature",
        "rotations",
        "standard",
        "static_pressure",
        "stresses",
        "temperature",
        "total_pressure",
    ],
    "dpdjax.measure.statistics": ["Estimate", "block_average"],
    "dpdjax.measure.structure": ["radial_distribution"],
    "dpdjax.measure.spheres": ["Spheres", "spheres", "spheres_of"],
    "dpdjax.measure.distribution": ["pair_distribution", "partial_distribution"],
    "dpdjax.measure.contacts": ["contact_number"],
    "dpdjax.measure.contact_bonds": ["bonded_pairs", "contact_bonds"],
    "dpdjax.measure.clusters": ["clusters"],
    "dpdjax.measure.solvent": ["solvent_density"],
    "dpdjax.measure.scattering": ["structure_factor"],
    "dpdjax.measure.transport": [
        "diffusion",
        "mean_squared_displacement",
        "velocity_autocorrelation",
    ],
    "dpdjax.measure.rotation": [
        "angular_velocity_autocorrelation",
        "orientation_correlation",
        "rotational_diffusion",
    ],
    "dpdjax.measure.drive": ["Driven", "driven_diffusion", "driven_rotation"],
    "dpdjax.measure.hydrodynamics": [
        "angular_velocity_tail",
        "hydrodynamic_radius",
        "sphere_diffusion",
        "sphere_rotational_diffusion",
        "velocity_tail",
    ],
    "dpdjax.measure.rheology": ["Moduli", "moduli"],
    "dpdjax.measure.viscosity": [
        "einstein_helfand",
        "einstein_helfand_record",
        "extrapolate",
        "green_kubo",
        "green_kubo_record",
        "shear_record",
        "shear_viscosity",
        "sine_record",
        "sinusoidal_viscosity",
    ],
    "dpdjax.calibration.calibrate": [
        "Calibration",
        "TargetError",
        "calibrate",
        "measure_viscosity",
    ],
    "dpdjax.calibration.relative": ["relative_viscosity"],
    "dpdjax.calibration.joint": ["JointCalibration"],
    "dpdjax.host.bench": ["bench"],
    "dpdjax.host.compilation": ["compilation_cache"],
    "dpdjax.host.run": ["run"],
    "dpdjax.host.stream": ["RunError", "stream"],
    "dpdjax.host.gsd": ["gsd_record", "gsd_writer", "run_to_gsd", "write_gsd"],
    "dpdjax.host.io": ["load_state", "save_state"],
    "dpdjax.host.plot": ["plot_box"],
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}
__all__ = sorted(_HOME_OF)
_ELSEWHERE = {
    "rdf": "radial_distribution",
    "gr": "radial_distribution",
    "g_r": "radial_distribution",
    "sq": "structure_factor",
    "msd": "mean_squared_displacement",
    "vacf": "velocity_autocorrelation",
    "temp": "temperature",
    "press": "static_pressure",
    "pressure": "static_pressure",
    "viscosity": "shear_viscosity",
    "body": "body_force",
    "force": "body_force",
    "nemd": "shear",
    "box": "Box",
    "simulation": "simulate",
    "dump": "write_gsd",
    "gsd": "write_gsd",
    "restart": "load_state",
}
"""What it is called in other programs, and here."""
__version__ = "0.1.0"


def __getattr__(name):
    if name not in _HOME_OF:
        known = {other: other for other in __all__} | _ELSEWHERE
        close = (
            [name.lower()] if name.lower() in _ELSEWHERE else difflib.get_close_matches(name, known)
        )
        near = dict.fromkeys(known[other] for other in close)
        raise AttributeError(
            f"dpdjax has no {name!r}" + (f"; near is dpd.{' or dpd.'.join(near)}" if near else "")
        )
    value = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__():
    return __all__
