"""Pictures of the box. Matplotlib is an extra: ``pip install "dpdjax[plot]"``."""

from typing import Any

import numpy as np

from dpdjax.drawing import axes
from dpdjax.engine.state import State
from dpdjax.model.beads import radii
from dpdjax.model.fluid import Fluid


def plot_box(
    state: State,
    ax: Any = None,
    axis: int = 2,
    thickness: float | None = None,
    fluid: Fluid | None = None,
) -> Any:
    """A slice through the box: beads as discs of radius 0.5 shaded by depth, colloids as the discs
    they are cut in.

    Returns the axes.

    Args:
        state: one state.
        axis: 0, 1 or 2, the direction one looks along.
        thickness: of the slice [length]; one interaction range by default.
        fluid: tells the radii of the species; without it all beads are points.
    """
    ax = axes(ax)
    position, sides = np.asarray(state.position), np.asarray(state.box.lengths)
    thickness = 1.0 if thickness is None else thickness
    flat = [k for k in range(3) if k != axis]
    radius = np.zeros(len(position)) if fluid is None else np.asarray(radii(fluid, state))
    inside = (position[:, axis] < thickness) & (radius == 0)
    shallow = np.flatnonzero(inside)[np.argsort(position[inside, axis])]
    beads = _discs(
        ax,
        position[shallow][:, flat],
        0.5,
        array=position[shallow, axis],
        cmap="Blues",
        edgecolor="0.3",
        alpha=0.9,
    )
    depth = position[:, axis] - 0.5 * thickness
    depth -= sides[axis] * np.round(depth / sides[axis])
    sliced = np.flatnonzero(np.abs(depth) < radius)
    around = np.array([[i, j] for i in (-1, 0, 1) for j in (-1, 0, 1)]) * sides[flat]
    for image in around if len(sliced) else ():
        centres = position[sliced][:, flat] + image
        _discs(
            ax,
            centres,
            np.sqrt(radius[sliced] ** 2 - depth[sliced] ** 2),
            facecolor="C1",
            edgecolor="0.2",
            alpha=0.95,
        )
    ax.figure.colorbar(beads, ax=ax, label=f"{'xyz'[axis]} (r_c)")
    ax.set(
        xlim=(0, sides[flat[0]]), ylim=(0, sides[flat[1]]), aspect="equal",
        xlabel=f"{'xyz'[flat[0]]} (r_c)", ylabel=f"{'xyz'[flat[1]]} (r_c)",
    )  # fmt: skip
    return ax


def _discs(ax, centres, radius, **style):
    from matplotlib.collections import EllipseCollection

    diameter = np.broadcast_to(2.0 * np.asarray(radius), len(centres))
    style |= {"units": "xy", "offset_transform": ax.transData, "linewidth": 0.5}
    discs = EllipseCollection(diameter, diameter, np.zeros(len(centres)), offsets=centres, **style)
    return ax.add_collection(discs)
