"""Axes and curves, for results that draw themselves. Matplotlib is an extra: ``dpdjax[plot]``."""


def axes(ax=None):
    """The given axes, or new ones; raises ImportError with the cure where matplotlib is missing."""
    if ax is not None:
        return ax
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError('plots need matplotlib: pip install "dpdjax[plot]"') from error
    return plt.subplots(figsize=(6.0, 4.2), layout="constrained")[1]


def curve(ax, x, y, error, xlabel: str, ylabel: str):
    """A line in a band of one standard error; returns the axes, new ones for None."""
    ax = axes(ax)
    (line,) = ax.plot(x, y)
    ax.fill_between(x, y - error, y + error, color=line.get_color(), alpha=0.3, linewidth=0)
    ax.set(xlabel=xlabel, ylabel=ylabel)
    return ax


def plain_log_ticks(ax):
    """Numbers in full along a logarithmic x-axis."""
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    low, high = ax.get_xlim()
    subs = (1.0, 2.0, 5.0) if high / low > 10 else (1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9)
    ax.xaxis.set_major_locator(LogLocator(subs=subs))
    ax.xaxis.set_major_formatter(ScalarFormatter())
    ax.xaxis.set_minor_formatter(NullFormatter())
