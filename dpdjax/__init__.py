"""dpdjax: differentiable, vectorised dissipative particle dynamics on JAX.

``import dpdjax as dpd`` is quick: every public name is imported when it is first used.
"""

import ast
import difflib
import importlib
import importlib.util
from pathlib import Path

_NAMED = [
    (name.asname, node.module)
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text()).body
    if isinstance(node, ast.ImportFrom)
    for name in node.names
]
"""Each public name and the module it is in, as the stub beside this file tells type checkers."""
_HOME_OF = {name: home for name, home in _NAMED if home != __name__}
__all__ = sorted(_HOME_OF)
NAMESPACES = tuple(name for name, home in _NAMED if home == __name__)
"""Modules of the package with what else there is."""
_ELSEWHERE = {
    "rdf": "measure.radial_distribution",
    "gr": "measure.radial_distribution",
    "g_r": "measure.radial_distribution",
    "sq": "measure.structure_factor",
    "msd": "measure.mean_squared_displacement",
    "vacf": "measure.velocity_autocorrelation",
    "temp": "observe.temperature",
    "press": "observe.pressure_tensor",
    "pressure": "observe.pressure_tensor",
    "viscosity": "shear_viscosity",
    "body": "flows.body_force",
    "force": "flows.body_force",
    "nemd": "shear",
    "box": "Box",
    "simulation": "simulate",
    "dump": "write_gsd",
    "run_to_gsd": "run",
    "restart": "load_state",
    "read_data": "load_lammps",
}
"""What it is called in other programs, and here."""
__version__ = "0.2.0"


def __getattr__(name):
    if name in NAMESPACES:
        return importlib.import_module(f"dpdjax.{name}")
    if name not in _HOME_OF:
        # ``from dpdjax import drawing`` asks here first, and then imports the file.
        is_file = importlib.util.find_spec(f"dpdjax.{name}") is not None
        raise AttributeError(f"dpdjax has no {name!r}{'' if is_file else _near(name)}")
    value = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def _near(name: str) -> str:
    """Where a name that is none of the package itself may be meant to be."""
    known = {other: other for other in __all__} | _ELSEWHERE
    for space in NAMESPACES:
        inside = importlib.import_module(f"dpdjax.{space}").__all__
        known |= {other: f"{space}.{other}" for other in inside if other not in __all__}
    exact = next((other for other in (name, name.lower()) if other in known), None)
    close = [exact] if exact else difflib.get_close_matches(name, known)
    near = dict.fromkeys(known[other] for other in close)
    return f"; near is dpd.{' or dpd.'.join(near)}" if near else ""


def __dir__():
    return [*__all__, *NAMESPACES]
