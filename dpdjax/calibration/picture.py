"""Pictures of a calibration and of a measurement."""

import math

import numpy as np

from dpdjax.drawing import COLOURS, axes, labelled, plain_log_ticks


def draw_calibration(fit, ax=None):
    """The measured points with their errors, their slopes, the fit and the target; returns the
    axes."""
    ax = axes(ax)
    xs = np.array([p.x for p in fit.history] + [math.log(fit.value)])
    low, high = xs.min() - 0.25, xs.max() + 0.25
    grid = np.linspace(low, high, 300)
    sigma = np.array([fit.curve.at(x).error for x in grid])
    ax.fill_between(
        np.exp(grid),
        fit.curve(grid) - sigma,
        fit.curve(grid) + sigma,
        color=COLOURS[0],
        alpha=0.2,
        lw=0,
    )
    ax.plot(np.exp(grid), fit.curve(grid), color=COLOURS[0], label="fit of all values and slopes")
    for k, p in enumerate(fit.history):
        near = np.array([p.x - 0.12, p.x + 0.12])
        label = "slope" if k == 0 else None
        ax.plot(
            np.exp(near),
            p.value.value + p.slope.value * (near - p.x),
            color=COLOURS[1],
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
        fmt="D", color=COLOURS[3], ms=5, capsize=3, label=f"fresh run: {fit.measured}",
    )  # fmt: skip
    ax.axhline(fit.target, color="0.4", ls="--", lw=1, label=f"target {fit.target:g}")
    ax.set_xscale("log")
    ax.set_xlim(np.exp(low), np.exp(high))
    plain_log_ticks(ax)
    ax.set_xlabel(labelled(fit.parameter))
    ax.set_ylabel(labelled(fit.name))
    ax.set_title(f"{fit.parameter} = {fit.estimate}")
    ax.legend(fontsize=8)
    return ax


def draw_measurement(measured, ax=None):
    """The running mean with its final error; returns the axes."""
    ax = axes(ax)
    series = np.asarray(measured.series)
    running = np.cumsum(series.mean(0)) / np.arange(1, series.shape[1] + 1)
    ax.plot(measured.time, running, color=COLOURS[0], label="running mean")
    e = measured.estimate
    ax.axhspan(
        e.value - e.error, e.value + e.error, color=COLOURS[3], alpha=0.25, lw=0, label=f"{e}"
    )
    ax.axhline(e.value, color=COLOURS[3], lw=1)
    late = running[len(running) // 10 :]
    spread = max(5 * e.error, 1.2 * np.abs(late - e.value).max())
    ax.set_ylim(e.value - spread, e.value + spread)
    ax.set_xlabel("t in each box [time]")
    ax.set_ylabel(labelled(measured.name))
    ax.legend()
    return ax
