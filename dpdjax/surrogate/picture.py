"""Pictures of the atlas."""

from typing import Any

import numpy as np

from dpdjax.checks import choice, plain, positive
from dpdjax.drawing import curve, labelled, plain_log_ticks
from dpdjax.model.fluid import Fluid
from dpdjax.surrogate.atlas import NAMES, QUANTITIES, Table, ranges, refuse_outside
from dpdjax.surrogate.reduced import Reduced, scale_of

POINTS = 200


def plot_atlas(
    fluid: Fluid,
    density: float,
    quantity: str = "viscosity",
    *,
    ax: Any = None,
    label: str | None = None,
) -> Any:
    """Draw what the atlas has of a quantity against gamma, for a fluid of any gamma, in a band of
    one standard error.

    Args:
        fluid, density: as for :func:`dpdjax.atlas`.
        quantity: ``"viscosity"``, ``"diffusion"`` or ``"schmidt"``.
        ax: matplotlib axes, or None for new ones.
        label: of the line.

    Returns the axes. Raises ValueError as :func:`dpdjax.atlas`, and for another quantity.

    Example:
        >>> ax = dpd.plot_atlas(dpd.water(), 3.0, label="a = 25")
        >>> ax = dpd.plot_atlas(dpd.water(a=0.0), 3.0, ax=ax, label="a = 0")
    """
    quantity = choice(quantity, QUANTITIES[:3], "quantity")
    state = Reduced.of(fluid, plain(density, "density", positive))
    table = Table.shipped()
    gamma = np.geomspace(*ranges(state.exponent)[NAMES[2]], POINTS)
    numbers = np.repeat(state.numbers[None], POINTS, axis=0)
    numbers[:, 2] = gamma
    refuse_outside(Reduced(*numbers[0], units=state.units))
    value, error = table.at(numbers)[quantity]
    value = value * scale_of(quantity, state.units)
    unit = state.units.scale("friction")
    ax = curve(ax, unit * gamma, value, value * error, labelled("gamma"), labelled(quantity))
    ax.set(xscale="log", yscale="log")
    plain_log_ticks(ax)
    plain_log_ticks(ax, "y")
    if label is not None:
        ax.lines[-1].set_label(label)
        ax.legend()
    return ax
