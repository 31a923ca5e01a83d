"""The public names of dpdjax and where they are, for type checkers and for ``__getattr__``."""

from dpdjax import (
    laws as laws,
    flows as flows,
    integrators as integrators,
    observe as observe,
    measure as measure,
    theory as theory,
    experiments as experiments,
)
from dpdjax.calibration.calibrate import (
    calibrate as calibrate,
    measure_viscosity as measure_viscosity,
)
from dpdjax.calibration.goal import suggest_rate as suggest_rate
from dpdjax.calibration.relative import relative_viscosity as relative_viscosity
from dpdjax.engine.deformation import oscillatory_shear as oscillatory_shear, shear as shear
from dpdjax.engine.drivers import drive as drive
from dpdjax.engine.record import integral as integral, mean as mean
from dpdjax.engine.simulate import forces as forces, simulate as simulate, step as step
from dpdjax.engine.state import State as State, grow as grow
from dpdjax.engine.trajectory import Plan as Plan, Trajectory as Trajectory
from dpdjax.errors import (
    ConfigError as ConfigError,
    DPDError as DPDError,
    FileError as FileError,
    RunError as RunError,
    Stopped as Stopped,
    TargetError as TargetError,
)
from dpdjax.files.checkpoint import Checkpoint as Checkpoint
from dpdjax.files.gsd import GSD as GSD, gsd_writer as gsd_writer, write_gsd as write_gsd
from dpdjax.files.lammps import load_lammps as load_lammps
from dpdjax.files.loading import load_gsd as load_gsd
from dpdjax.files.states import load_state as load_state, save_state as save_state
from dpdjax.host.bench import bench as bench
from dpdjax.host.compilation import compilation_cache as compilation_cache
from dpdjax.host.plot import (
    plot_box as plot_box,
    plot_flow_curve as plot_flow_curve,
    plot_profile as plot_profile,
    plot_run as plot_run,
)
from dpdjax.host.run import run as run
from dpdjax.host.stream import stream as stream
from dpdjax.inference.fit import fit as fit
from dpdjax.measure.statistics import Estimate as Estimate
from dpdjax.measure.transport import diffusion as diffusion
from dpdjax.measure.viscosity import shear_viscosity as shear_viscosity
from dpdjax.model.advice import suggest_dt as suggest_dt
from dpdjax.model.colloids import colloid_fluid as colloid_fluid, pure_solvent as pure_solvent
from dpdjax.model.fluid import Fluid as Fluid, fluid as fluid, interaction as interaction
from dpdjax.model.laws import central_drag as central_drag, soft_repulsion as soft_repulsion
from dpdjax.model.marbles import marble_fluid as marble_fluid
from dpdjax.model.term import term as term, whole as whole
from dpdjax.model.units import Units as Units, water as water, water_units as water_units
from dpdjax.pairs.box import Box as Box
from dpdjax.prepare.marbles import marbles as marbles
from dpdjax.prepare.molecules import molecules as molecules
from dpdjax.prepare.start import initial_state as initial_state
from dpdjax.prepare.suspension import suspension as suspension
from dpdjax.scans.drive import Run as Run
from dpdjax.scans.picture import plot_scan as plot_scan
from dpdjax.scans.scan import scan as scan
from dpdjax.scans.table import (
    load_scan as load_scan,
    merge_scans as merge_scans,
    scan_points as scan_points,
)
from dpdjax.surrogate.atlas import atlas as atlas
from dpdjax.surrogate.design import design as design
from dpdjax.surrogate.picture import plot_atlas as plot_atlas

__version__: str
__all__: list[str]
NAMESPACES: tuple[str, ...]
