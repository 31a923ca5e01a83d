"""The tilted box on paper: a slice of its points, or all its spheres at an angle and without
perspective."""

import dataclasses
import itertools

import numpy as np

from dpdjax.drawing import COLOURS, labelled

TURNED, RAISED = np.radians(25.0), np.radians(20.0)
"""How far one looks from the right and from above."""
TOWARD = (1, -1, 1)
"""Which way along each axis the viewer is."""
LAYERS = 7
"""Discs that a shaded sphere is painted of."""
FADED = 0.4
"""How much white the furthest spheres are mixed with."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """A tilted box seen along an axis.

    Attributes:
        lattice: its vectors as rows, (3, 3) [length].
        axis: 0, 1 or 2, what one looks along.
    """

    lattice: np.ndarray
    axis: int

    @classmethod
    def of(cls, state, axis: int) -> "Cell":
        lattice = np.diag(np.asarray(state.box.lengths, float))
        lattice[1, 0] = float(state.box.strain) * lattice[1, 1]
        return cls(lattice, axis)

    def inside(self, position):
        """The images (n, 3) of positions that are in the box, and how far along the axis they are
        behind the face that one looks at, (n,)."""
        shares = position @ np.linalg.inv(self.lattice) % 1.0
        along = shares[:, self.axis] if TOWARD[self.axis] < 0 else 1.0 - shares[:, self.axis]
        return shares @ self.lattice, along * self.lattice[self.axis, self.axis]

    @property
    def flat(self) -> list[int]:
        """The two other axes, to the right and up."""
        return [k for k in range(3) if k != self.axis]

    def seen(self, position):
        """Positions (n, 3) as to the right, up and toward the viewer."""
        toward = TOWARD[self.axis] * np.eye(3)[self.axis]
        axes = np.stack([*np.eye(3)[self.flat], toward])
        (a, b), (c, d) = (np.cos([TURNED, RAISED]), np.sin([TURNED, RAISED]))
        turn = np.array([[a, 0, -c], [0, 1, 0], [c, 0, a]])
        rise = np.array([[1, 0, 0], [0, b, -d], [0, d, b]])
        return position @ (rise @ turn @ axes).T

    def edges(self):
        """Of the 12 edges as they are seen: ends (12, 2, 3), direction (12,), and whether each is
        behind or in front of the box, (12,) bool."""
        corners = list(itertools.product((0, 1), repeat=3))
        place = self.seen(np.array(corners, float) @ self.lattice)
        far, near = np.argmin(place[:, 2]), np.argmax(place[:, 2])
        pairs = [
            (i, j, k)
            for i, j in itertools.combinations(range(8), 2)
            for k in range(3)
            if np.array_equal(np.subtract(corners[j], corners[i]), np.eye(3)[k])
        ]
        first, second, along = np.array(pairs).T
        touches = lambda corner: (first == corner) | (second == corner)
        return np.stack([place[first], place[second]], 1), along, touches(far), touches(near)


def draw_slice(ax, cell: Cell, position, depth, radius: float, paint=None):
    """Discs at positions (n, 3), shaded by depth (n,) or in colours ``paint`` (n, 3), and the
    outline of the box; returns the axes."""
    order = np.argsort(-depth)
    own = (
        {"array": depth[order], "cmap": "Blues_r"} if paint is None else {"facecolor": paint[order]}
    )
    style = own | {"edgecolor": "0.3", "linewidth": 0.5}
    shade = _discs(ax, position[order][:, cell.flat], radius, alpha=0.9, **style)
    first, second = cell.lattice[np.ix_(cell.flat, cell.flat)]
    outline = np.array([0 * first, first, first + second, second, 0 * first])
    ax.plot(*outline.T, color="k", lw=1)
    if paint is None:
        ax.figure.colorbar(shade, ax=ax, label=labelled("depth", "length"))
    (left, low), (right, high) = outline.min(axis=0), outline.max(axis=0)
    across, up = (labelled("xyz"[k], "length") for k in cell.flat)
    ax.set(xlim=(left, right), ylim=(low, high), aspect="equal", xlabel=across, ylabel=up)
    return ax


def draw_box(ax, cell: Cell):
    """The edges of the box with their lengths, those in front above all else."""
    ends, along, behind, before = cell.edges()
    for (a, b), hidden, front in zip(ends, behind, before):
        look = {"ls": ":" if hidden else "-", "lw": 1.0, "alpha": 0.5 if front else 1.0}
        ax.plot([a[0], b[0]], [a[1], b[1]], color="0.3", zorder=5 if front else 1, **look)
    middle = ends.mean(axis=1)[:, :2]
    centre = middle.mean(axis=0)
    for k in range(3):
        outer = np.flatnonzero((along == k) & ~behind & ~before)
        place = middle[outer[np.argmin(middle[outer].sum(axis=1))]]
        told = f"$L_{'xyz'[k]}$ = {np.diag(cell.lattice)[k]:.4g}"
        out = (place - centre) / np.linalg.norm(place - centre)
        side = "left" if out[0] > 0.3 else "right" if out[0] < -0.3 else "center"
        high = "bottom" if out[1] > 0.3 else "top" if out[1] < -0.3 else "center"
        ax.annotate(told, place, 9 * out, textcoords="offset points", ha=side, va=high, zorder=6)
    ax.set_axis_off()
    ax.set_aspect("equal")


def draw_spheres(ax, cell: Cell, position, radius, colours, fade: bool):
    """Shaded spheres at positions (n, 3), with radii (n,) and colours (n, 3), the far ones first
    and, to ``fade``, lighter; returns the axes."""
    place = cell.seen(position)
    order = np.argsort(place[:, 2])
    place, radius, colours = place[order], radius[order], colours[order]
    away = 1.0 - (place[:, 2] - place[:, 2].min()) / max(np.ptp(place[:, 2]), 1e-9)
    colours = colours + FADED * fade * away[:, None] * (1.0 - colours)
    # From the rim to the highlight, each disc of a sphere upon the one before.
    share = np.linspace(0.0, 1.0, LAYERS)[:, None]
    light = np.stack([(1 - s) * 0.7 * colours + s * (1 - 0.45 * (1 - colours)) for s in share], 1)
    size = radius[:, None] * (1 - 0.85 * share[:, 0])
    offset = radius[:, None, None] * share * [-0.35, 0.35]
    rim = np.tile(np.r_[0.7, np.zeros(LAYERS - 1)], len(radius))
    centres = (place[:, None, :2] + offset).reshape(-1, 2)
    face = np.clip(light.reshape(-1, 3), 0, 1)
    _discs(ax, centres, size.ravel(), facecolor=face, edgecolor="0.15", linewidth=rim, zorder=3)
    ax.update_datalim(np.concatenate([place[:, :2] + d * radius[:, None] for d in (-1, 1)]))
    ax.autoscale_view()
    return ax


def draw_points(ax, cell: Cell, position, radius: float):
    """Small faint dots at positions (n, 3), behind all spheres."""
    style = {"facecolor": COLOURS[0], "alpha": 0.35, "linewidth": 0, "zorder": 2}
    _discs(ax, cell.seen(position)[:, :2], radius, **style)


def _discs(ax, centres, radius, **style):
    from matplotlib.collections import EllipseCollection

    diameter = np.broadcast_to(2.0 * np.asarray(radius), len(centres))
    style |= {"units": "xy", "offset_transform": ax.transData}
    discs = EllipseCollection(diameter, diameter, np.zeros(len(centres)), offsets=centres, **style)
    return ax.add_collection(discs, autolim=False)
