"""Style, axes and curves, for results that draw themselves. Matplotlib is an extra:
``dpdjax[plot]``."""

import re

import numpy as np

COLOURS = (
    "#0072b2",
    "#e69f00",
    "#009e73",
    "#d55e00",
    "#56b4e9",
    "#cc79a7",
    "#7f7f7f",
)
"""Of lines and species, in this order: those of Okabe & Ito (2008), which colour-blind readers tell
apart, and a grey."""
STYLE = {"font.size": 11.0, "axes.labelsize": 11.0, "errorbar.capsize": 2.0}
"""Of new figures, legible at the width of a column; what a user has set otherwise stays."""

UNITS = {
    "time": "time",
    "temperature": "energy",
    "configurational_temperature": "energy",
    "rotational_temperature": "energy",
    "potential_energy": "energy",
    "momentum": "mass length/time",
    "pressure": "energy/length^3",
    "pressure_tensor": "energy/length^3",
    "viscosity": "energy time/length^3",
    "diffusion": "length^2/time",
    "position": "length",
    "unwrapped": "length",
    "velocity": "length/time",
    "angular_velocity": "1/time",
    "gamma": "mass/time",
    "kT": "energy",
    "a": "energy/length",
    "rate": "1/time",
    "frequency": "1/time",
    "stress": "energy/length^3",
    "storage_modulus": "energy/length^3",
    "loss_modulus": "energy/length^3",
    "D0": "energy",
    "kappa": "1/length",
    "eta_0": "energy time/length^3",
}
"""Of what is often recorded, measured and calibrated."""


def labelled(name: str, unit: str | None = None) -> str:
    """``name [unit]`` as axes have it, the unit by default that of :data:`UNITS`; a name without
    one stays as it is."""
    unit = UNITS.get(name, "") if unit is None else unit
    told = re.sub(r"\^(\d+)", r"$^\1$", unit)
    return f"{name.replace('_', ' ')} [{told}]" if told else name


def axes(ax=None):
    """The given axes, or new ones; raises ImportError with the cure where matplotlib is missing."""
    return panels(1)[0] if ax is None else ax


def panels(count: int):
    """So many new axes (count,) one below the other, which share x; ImportError as :func:`axes`."""
    return grid(count, 1, (6.0, 4.2 if count == 1 else 0.6 + 1.8 * count), sharex=True)[:, 0]


def grid(rows: int, columns: int, size: tuple[float, float], **how):
    """New axes (rows, columns) in a figure of a size in inches; ImportError as :func:`axes`."""
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError('plots need matplotlib: pip install "dpdjax[plot]"') from error
    with plt.rc_context(_style(plt)):
        figure = plt.figure(figsize=size, layout="constrained")
        return figure.subplots(rows, columns, squeeze=False, **how)


def _style(plt) -> dict:
    """Ours, of what a user has not set."""
    ours = STYLE | {"axes.prop_cycle": plt.cycler(color=COLOURS)}
    return {k: v for k, v in ours.items() if plt.rcParams[k] == plt.rcParamsDefault[k]}


def grows(time) -> bool:
    """Whether times are further and further apart, as those of what ages."""
    time = np.ravel(time)
    apart = np.diff(time)
    return len(time) > 4 and time[0] > 0 and apart[-1] > 5 * apart[0] > 0


def time_scale(time) -> str:
    """The scale of an axis of times: logarithmic for those of what ages."""
    return "log" if grows(time) else "linear"


def curve(ax, x, y, error, xlabel: str, ylabel: str):
    """A line in a band of one standard error; returns the axes, new ones for None."""
    ax = axes(ax)
    (line,) = ax.plot(x, y)
    ax.fill_between(x, y - error, y + error, color=line.get_color(), alpha=0.3, linewidth=0)
    ax.set(xlabel=xlabel, ylabel=ylabel)
    return ax


def plain_log_ticks(ax, which: str = "x"):
    """Numbers in full along a logarithmic axis, ``"x"`` or ``"y"``."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

    axis = {"x": ax.xaxis, "y": ax.yaxis}[which]
    low, high = axis.get_view_interval()
    subs = (1.0, 2.0, 5.0) if high / low > 10 else (1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9)
    axis.set_major_locator(MaxNLocator(5) if high / low < 2.5 else LogLocator(subs=subs))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.6g}"))
    axis.set_minor_formatter(NullFormatter())
