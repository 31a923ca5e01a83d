"""Pictures of fits."""

import numpy as np

from dpdjax import drawing

BINS = 30
BAND = (0.16, 0.84)


def draw_fit(found, ax=None):
    """Data, what the posterior foretells, fresh runs: against rate or frequency, or each number
    over its datum where there is neither."""
    return (_draw_numbers if found.question.data.controlled is None else _draw_curves)(found, ax)


def _draw_numbers(found, ax):
    """Each number over its datum, in a row of its own."""
    ax, data = drawing.axes(ax), found.question.data
    place = np.arange(len(data))
    low, high = np.quantile(found.foretold(), BAND, axis=0) / data.value
    ax.errorbar(np.ones(len(data)), place, xerr=data.error / data.value, fmt="o", label="data")
    ax.barh(place, high - low, left=low, height=0.4, alpha=0.3, label="posterior, 68 %")
    shown = False
    for k, name in enumerate(data.names):
        for one in found.fresh:
            if name in one.found:
                fresh, label = one.found[name], None if shown else "fresh runs at draws"
                ratio, error = fresh.value / data.value[k], fresh.error / data.value[k]
                ax.errorbar(ratio, k + 0.3, xerr=error, fmt="k.", ms=4, lw=1, label=label)
                shown = True
    ax.set(yticks=place, yticklabels=data.names, xlabel="over what was measured")
    ax.set_ylim(-0.7, len(data) - 0.3)
    ax.legend()
    return ax


def _draw_curves(found, axes):
    """Curves, and below them everything over the middle of the posterior."""
    above, below = drawing.panels(2) if axes is None else np.ravel(axes)
    data, foretold = found.question.data, found.foretold()
    for k, name in enumerate(data.quantities):
        some = np.flatnonzero([each == name for each in data.names])
        some = some[np.argsort(data.control[some])]
        x, color = data.control[some], f"C{k}"
        low, middle, high = np.quantile(foretold[:, some], (BAND[0], 0.5, BAND[1]), axis=0)
        for ax, over in ((above, np.ones(len(x))), (below, middle)):
            band = {"color": color, "alpha": 0.3, "lw": 0, "label": "posterior, 68 %"}
            ax.fill_between(x, low / over, high / over, **band)
            bars = {"fmt": "o", "color": color, "label": drawing.labelled(name, "")}
            ax.errorbar(x, data.value[some] / over, data.error[some] / over, **bars)
            for j, (at, value, error) in enumerate(found.fresh_of(name)):
                scale = np.exp(np.interp(np.log(at), np.log(x), np.log(over)))
                label = None if j or k else "fresh runs at draws"
                point = {"fmt": "x", "color": "k", "ms": 5, "lw": 1, "label": label}
                ax.errorbar(at, value / scale, error / scale, **point)
    above.set(xscale="log", yscale="log")
    above.set(ylabel=", ".join(drawing.labelled(name) for name in data.quantities))
    above.legend(fontsize="small")
    below.set(xlabel=drawing.labelled(data.controlled), ylabel="over the posterior's middle")
    return np.array([above, below])


def draw_corner(found):
    """Histograms of each parameter, and of each two; returns the axes (names, names)."""
    names = found.question.names
    draws = {name: np.exp(z).ravel() for name, z in found.draws.items()}
    size = 1.0 + 1.9 * len(names)
    axes = drawing.grid(len(names), len(names), (size, size))
    for i, below in enumerate(names):
        for j, along in enumerate(names):
            ax = axes[i, j]
            if j > i:
                ax.axis("off")
                continue
            if i == j:
                ax.hist(draws[along], bins=BINS, density=True, color=drawing.COLOURS[0], alpha=0.6)
                ax.set_yticks([])
            else:
                ax.hist2d(draws[along], draws[below], bins=BINS, cmap="Blues")
            if i == len(names) - 1:
                ax.set_xlabel(drawing.labelled(along))
            if j == 0 and i > 0:
                ax.set_ylabel(drawing.labelled(below))
    return axes
