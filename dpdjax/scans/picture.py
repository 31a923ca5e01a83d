"""The table of a scan as a picture."""

from typing import Any

import numpy as np

from dpdjax import drawing
from dpdjax.scans.table import ERROR, REPLICA


def plot_scan(
    table: Any, name: str | None = None, *, x: str | None = None, hue: str | None = None, ax=None
) -> Any:
    """A number of a scan along an axis, with error bars; a line for each value of another axis.

    Args:
        table: what :func:`dpdjax.scan` returns.
        name: of the number; by default the first there is.
        x: the axis that is drawn along; by default the one with most values.
        hue: the axis that the lines are of; by default the other one. Choose a value of any further
            axis first, ``table.sel(kT=0.1)``.
        ax: matplotlib axes, or None for new ones.

    Returns the axes. Raises ValueError for a name that the table does not have, or more axes than
    can be drawn.

    Example:
        >>> def thinning(key, rate, gamma):
        ...     return {"viscosity": dpd.Estimate(0.2 * gamma / (1 + rate), 0.01)}
        >>> table = dpd.scan(thinning, {"rate": [0.1, 1.0], "gamma": [4.5, 9.0]}, key=key, **quiet)
        >>> ax = dpd.plot_scan(table, x="rate", hue="gamma")
        >>> [text.get_text() for text in ax.get_legend().get_texts()]
        ['gamma = 4.5', 'gamma = 9']
    """
    numbers = [
        str(n)[: -len(ERROR)]
        for n in table
        if str(n).endswith(ERROR) and REPLICA not in table[n].dims
    ]
    if not numbers:
        raise ValueError("the table holds no numbers: no run is done, see its status and reason")
    name = numbers[0] if name is None else name
    if name not in numbers:
        raise ValueError(f"name is {name!r}; the table has {', '.join(numbers)}")
    dims = sorted(map(str, table[name].dims), key=lambda dim: -table.sizes[dim])
    x = next((dim for dim in dims if dim != hue), None) if x is None else x
    hue = (
        next((dim for dim in dims if dim != x and table.sizes[dim] > 1), None)
        if hue is None
        else hue
    )
    for axis in (x, hue):
        if axis not in (*dims, None):
            raise ValueError(f"{axis!r} is no axis of {name}; those are {', '.join(dims)}")
    rest = [dim for dim in dims if dim not in (x, hue)]
    if any(table.sizes[dim] > 1 for dim in rest):
        raise ValueError(f"choose values of the axes {', '.join(rest)}: table.sel({rest[0]}=...)")
    part = table.isel({dim: 0 for dim in rest})
    ax = drawing.axes(ax)
    for k in range(part.sizes[hue]) if hue else (None,):
        line = part if k is None else part.isel({hue: k})
        label = (
            None
            if k is None
            else f"{hue} = {line[hue].item():g}"
            if np.issubdtype(line[hue].dtype, np.number)
            else f"{line[hue].item()}"
        )
        ax.errorbar(
            line[x],
            line[name],
            np.nan_to_num(line[name + ERROR]),
            fmt="o-",
            ms=4,
            lw=1,
            capsize=2,
            label=label,
        )
    if hue:
        ax.legend()
    ax.set(xlabel=_named(table[x]), ylabel=_named(table[name]))
    return ax


def _named(values) -> str:
    """Long name and unit of what is drawn."""
    unit = values.attrs.get("units", "")
    return drawing.labelled(values.attrs.get("long_name", values.name), "" if unit == "1" else unit)
