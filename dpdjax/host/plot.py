"""Pictures of results. Matplotlib is an extra: ``pip install "dpdjax[plot]"``."""

import math

import numpy as np

from dpdjax.engine.state import radii


def _axes(ax):
    """The given axes, or new ones; raises ImportError with the cure."""
    if ax is not None:
        return ax
    try:
        import matplotlib.figure
    except ImportError as error:
        raise ImportError('plots need matplotlib: pip install "dpdjax[plot]"') from error
    return matplotlib.figure.Figure(figsize=(6.0, 4.2), layout="constrained").subplots()


def plot_calibration(fit, ax=None):
    """The measured points with their errors, their slopes, the fit and the target; returns the
    figure."""
    ax = _axes(ax)
    xs = np.array([p.x for p in fit.history] + [math.log(fit.value)])
    low, high = xs.min() - 0.25, xs.max() + 0.25
    grid = np.linspace(low, high, 300)
    sigma = np.array([fit.curve.at(x).error for x in grid])
    ax.fill_between(
        np.exp(grid), fit.curve(grid) - sigma, fit.curve(grid) + sigma, color="C0", alpha=0.2, lw=0
    )
    ax.plot(np.exp(grid), fit.curve(grid), color="C0", label="fit of all values and slopes")
    for k, p in enumerate(fit.history):
        near = np.array([p.x - 0.12, p.x + 0.12])
        label = "slope, by forward differentiation" if k == 0 else None
        ax.plot(
            np.exp(near),
            p.value.value + p.slope.value * (near - p.x),
            color="C1",
            lw=2.5,
            label=label,
        )
    values = [p.value for p in fit.history]
    ax.errorbar(
        np.exp([p.x for p in fit.history]), [v.value for v in values], [v.error for v in values],
        fmt="ko", ms=4, capsize=3, label="sheared boxes",
    )  # fmt: skip
    ax.errorbar(
        [fit.value], [fit.measured.value], [fit.measured.error], xerr=[fit.error],
        fmt="D", color="C3", ms=5, capsize=3, label=f"fresh run: {fit.measured}",
    )  # fmt: skip
    ax.axhline(fit.target, color="0.4", ls="--", lw=1, label=f"target {fit.target:g}")
    ax.set_xscale("log")
    ax.set_xlim(np.exp(low), np.exp(high))
    _plain_log_ticks(ax)
    ax.set_xlabel(f"{fit.parameter} (DPD units)")
    ax.set_ylabel(f"{fit.name} (DPD units)")
    ax.set_title(f"{fit.parameter} = {fit.estimate}")
    ax.legend(fontsize=8)
    return ax.figure


def _plain_log_ticks(ax):
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    low, high = ax.get_xlim()
    many = high / low > 10
    ax.xaxis.set_major_locator(
        LogLocator(subs=(1.0, 2.0, 5.0) if many else (1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9))
    )
    ax.xaxis.set_major_formatter(ScalarFormatter())
    ax.xaxis.set_minor_formatter(NullFormatter())


def plot_convergence(measured, ax=None):
    """The running mean of a viscosity with its final error; returns the figure."""
    ax = _axes(ax)
    series = np.asarray(measured.series)
    running = np.cumsum(series.mean(0)) / np.arange(1, series.shape[1] + 1)
    ax.plot(measured.time, running, color="C0", label="running mean")
    e = measured.estimate
    ax.axhspan(e.value - e.error, e.value + e.error, color="C3", alpha=0.25, lw=0, label=f"{e}")
    ax.axhline(e.value, color="C3", lw=1)
    late = running[len(running) // 10 :]
    spread = max(5 * e.error, 1.2 * np.abs(late - e.value).max())
    ax.set_ylim(e.value - spread, e.value + spread)
    ax.set_xlabel("time in each box (DPD units)")
    ax.set_ylabel("viscosity (DPD units)")
    ax.legend()
    return ax.figure


def plot_box(state, ax=None, axis: int = 2, thickness: float | None = None, fluid=None):
    """A slice through the box: beads as discs of radius 0.5 shaded by depth, colloids as the discs
    they are cut in.

    Returns the figure.

    Args:
        state: one state.
        axis: 0, 1 or 2, the direction one looks along.
        thickness: of the slice [length]; one interaction range by default.
        fluid: tells the radii of the species; without it all beads are points.
    """
    ax = _axes(ax)
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
    cut = np.flatnonzero(np.abs(depth) < radius)
    around = np.array([[i, j] for i in (-1, 0, 1) for j in (-1, 0, 1)]) * sides[flat]
    for image in around if len(cut) else ():
        centres = position[cut][:, flat] + image
        _discs(
            ax,
            centres,
            np.sqrt(radius[cut] ** 2 - depth[cut] ** 2),
            facecolor="C1",
            edgecolor="0.2",
            alpha=0.95,
        )
    ax.figure.colorbar(beads, ax=ax, label=f"{'xyz'[axis]} (r_c)")
    ax.set(
        xlim=(0, sides[flat[0]]), ylim=(0, sides[flat[1]]), aspect="equal",
        xlabel=f"{'xyz'[flat[0]]} (r_c)", ylabel=f"{'xyz'[flat[1]]} (r_c)",
    )  # fmt: skip
    return ax.figure


def _discs(ax, centres, radius, **style):
    from matplotlib.collections import EllipseCollection

    diameter = np.broadcast_to(2.0 * np.asarray(radius), len(centres))
    style |= {"units": "xy", "offset_transform": ax.transData, "linewidth": 0.5}
    discs = EllipseCollection(diameter, diameter, np.zeros(len(centres)), offsets=centres, **style)
    return ax.add_collection(discs)
