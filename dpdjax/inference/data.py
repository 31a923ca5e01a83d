"""What was measured, as one list: a number with its error, and the rate or frequency it is of."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dpdjax.checks import number, positive
from dpdjax.measure.statistics import Estimate
from dpdjax.model.units import DIMENSIONS

CONTROLS = {"rate": ("rate", "shear_rate"), "frequency": ("frequency", "omega")}
"""What an experimenter sets, and what columns of it are called."""
QUANTITIES = {
    "viscosity": ("viscosity", "eta"),
    "stress": ("stress", "shear_stress"),
    "storage_modulus": ("storage_modulus", "G'", "Gp", "G_prime"),
    "loss_modulus": ("loss_modulus", "G''", "Gpp", "G_double_prime"),
    "diffusion": ("diffusion", "D"),
    "pressure": ("pressure", "p"),
    "schmidt": ("schmidt",),
    "compressibility": ("compressibility",),
}
"""What is measured, and what columns of it are called."""
DIMENSION = {
    "rate": (0, 0, -1),
    "frequency": (0, 0, -1),
    "viscosity": DIMENSIONS["viscosity"],
    "stress": DIMENSIONS["pressure"],
    "storage_modulus": DIMENSIONS["pressure"],
    "loss_modulus": DIMENSIONS["pressure"],
    "diffusion": DIMENSIONS["diffusion"],
    "pressure": DIMENSIONS["pressure"],
    "schmidt": (0, 0, 0),
    "compressibility": tuple(-power for power in DIMENSIONS["pressure"]),
}
"""Powers of length, mass and time."""
OF_MODELS = {"stress": "viscosity"}
"""Quantities that models tell by another one, over the rate."""


@dataclasses.dataclass(frozen=True)
class Observations:
    """Measured numbers (n,).

    Attributes:
        names: of each what it is.
        value, error: the number and its standard error.
        control: rate or frequency it was measured at; NaN of what has none.
        controlled: the name of what was set; None where nothing was.
    """

    names: tuple[str, ...]
    value: np.ndarray
    error: np.ndarray
    control: np.ndarray
    controlled: str | None = None

    def __len__(self):
        return len(self.names)

    @property
    def quantities(self) -> tuple[str, ...]:
        """What was measured, each once."""
        return tuple(dict.fromkeys(self.names))

    def __add__(self, other: "Observations") -> "Observations":
        controlled = {self.controlled, other.controlled} - {None}
        if len(controlled) > 1:
            raise ValueError(
                f"the data have both {' and '.join(sorted(controlled))}; fit one after the other"
            )
        join = lambda name: np.concatenate([getattr(self, name), getattr(other, name)])
        return Observations(
            self.names + other.names,
            join("value"),
            join("error"),
            join("control"),
            controlled.pop() if controlled else None,
        )


def observations(data: Any, error: float | None = None) -> Observations:
    """Numbers of a table, of a file of one, of a dataset of RheoJAX, or by name; or of several of
    them.

    Args:
        data: by name ``{"viscosity": (1.1, 0.01)}`` or estimates; a DataFrame, or a CSV file, with
            columns such as ``rate``, ``stress`` and ``error`` or ``stress_error``; what has ``x``
            and ``y``, of which complex ones are moduli over frequencies; a list of those.
        error: relative, of numbers that state none.

    Raises ValueError, TypeError for what is none of these, names that are not known, numbers
    without errors, and what is not above zero.
    """
    if error is not None:
        positive(error, "error")
    if isinstance(data, str | os.PathLike):
        return _of_table(_read(data), error)
    if hasattr(data, "columns"):
        return _of_table(data, error)
    if hasattr(data, "x") and hasattr(data, "y"):
        return _of_curve(data, error)
    if isinstance(data, Mapping):
        return _of_names(data, error)
    if isinstance(data, Sequence) and data:
        parts = [observations(part, error) for part in data]
        return sum(parts[1:], parts[0])
    raise TypeError(
        f"data is a {type(data).__name__}; give numbers by name, a DataFrame, a CSV file, or a "
        "dataset with x and y"
    )


def _read(path):
    import pandas

    return pandas.read_csv(path, comment="#", skipinitialspace=True)


def _of_names(data: Mapping, error) -> Observations:
    names, values, errors = [], [], []
    for name, told in data.items():
        known = _known(name, QUANTITIES)
        if known is None:
            raise ValueError(f"data has {name!r}; it knows {', '.join(QUANTITIES)}")
        told = (told.value, told.error) if isinstance(told, Estimate) else told
        value, own = told if np.ndim(told) else (told, None)
        names.append(known)
        values.append(float(value))
        errors.append(_error_of(value, own, error, name))
    return _checked(names, values, errors, np.full(len(names), np.nan), None)


def _of_table(table, error) -> Observations:
    columns = {str(name).strip(): np.asarray(table[name]) for name in table.columns}
    controls = {c: _known(c, CONTROLS) for c in columns if _known(c, CONTROLS)}
    quantities = {c: _known(c, QUANTITIES) for c in columns if _known(c, QUANTITIES)}
    errors = {c for c in columns if c == "error" or c.endswith("_error")}
    odd = set(columns) - set(controls) - set(quantities) - errors
    if odd or len(controls) > 1 or not quantities:
        raise ValueError(
            f"the table has the columns {', '.join(columns)}; give one of "
            f"{', '.join(CONTROLS)}, one or more of {', '.join(QUANTITIES)}, and their errors as "
            "error, or as stress_error and the like"
        )
    if "error" in errors and len(quantities) > 1:
        raise ValueError(
            "the table has one column of errors for several numbers; name each, ..._error"
        )
    control = next((number(columns[c], c) for c in controls), None)
    parts = []
    for column, name in quantities.items():
        value = columns[column].astype(float)
        own = next(
            (columns[e] for e in (f"{column}_error", f"{name}_error", "error") if e in errors), None
        )
        each = [
            _error_of(v, None if own is None else own[k], error, column)
            for k, v in enumerate(value)
        ]
        at = np.full(len(value), np.nan) if control is None else np.asarray(control, float)
        controlled = next(iter(controls.values()), None)
        parts.append(_checked([name] * len(value), value, each, at, controlled))
    return sum(parts[1:], parts[0])


def _of_curve(data, error) -> Observations:
    """Of a dataset with ``x`` and ``y``, as RheoJAX has them: complex numbers are moduli."""
    x, y = np.asarray(data.x, float), np.asarray(data.y)
    moduli = np.iscomplexobj(y)
    unit = str(getattr(data, "y_units", "") or "").replace("·", " ").replace("*", " ").strip()
    flow = "viscosity" if unit.lower() in ("pa s", "pa.s", "mpa s") else "stress"
    columns = {"storage_modulus": y.real, "loss_modulus": y.imag} if moduli else {flow: y}
    controlled = "frequency" if moduli else "rate"
    parts = [
        _checked(
            [name] * len(x), v, [_error_of(each, None, error, name) for each in v], x, controlled
        )
        for name, v in columns.items()
    ]
    return sum(parts[1:], parts[0])


def _known(name, known: dict) -> str | None:
    """The name that something goes by here."""
    return next((own for own, others in known.items() if str(name).strip() in others), None)


def _error_of(value, own, relative: float | None, name: str) -> float:
    if own is not None and np.isfinite(own):
        return float(own)
    if relative is None:
        raise ValueError(f"{name} states no error; give error=, relative to each number")
    return float(relative) * abs(float(value))


def _checked(names, values, errors, control, controlled) -> Observations:
    """Observations of numbers above zero, and errors and controls above zero."""
    value, error = np.asarray(values, float), np.asarray(errors, float)
    control = np.asarray(control, float)
    for what, numbers in (("", value), ("error of ", error)):
        bad = np.flatnonzero(~(np.isfinite(numbers) & (numbers > 0)))
        if len(bad):
            raise ValueError(f"{what}{names[bad[0]]} is {numbers[bad[0]]:g}; it must be above zero")
    if controlled is not None and not np.all(np.isfinite(control) & (control > 0)):
        raise ValueError(f"{controlled} is {np.min(control):g}; it must be above zero")
    return Observations(tuple(names), value, error, control, controlled)
