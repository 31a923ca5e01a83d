"""What a run can record: functions ``observe(fluid, state)``, and ways to add them up."""

from dpdjax.engine.observables import (
    box,
    configurational_temperature,
    instantaneous_viscosity,
    momentum,
    positions,
    positions_of,
    pressure_tensor,
    rotational_temperature,
    rotations,
    sizes_of,
    standard,
    stresses,
    temperature,
)
from dpdjax.engine.profiles import pressure_in_slabs
from dpdjax.engine.record import Recorder, integral, mean
from dpdjax.files.gsd import gsd_record
from dpdjax.measure.viscosity import (
    einstein_helfand_record,
    green_kubo_record,
    shear_record,
    wave_of,
)
from dpdjax.pairs.box import displacement

__all__ = [
    "box",
    "configurational_temperature",
    "displacement",
    "einstein_helfand_record",
    "green_kubo_record",
    "gsd_record",
    "instantaneous_viscosity",
    "integral",
    "mean",
    "momentum",
    "positions",
    "positions_of",
    "pressure_in_slabs",
    "pressure_tensor",
    "Recorder",
    "rotational_temperature",
    "rotations",
    "shear_record",
    "sizes_of",
    "standard",
    "stresses",
    "temperature",
    "wave_of",
]
