"""Pictures of a run, of its box, and of a flow curve. Matplotlib is an extra:
``pip install "dpdjax[plot]"``."""

from typing import Any

import numpy as np

from dpdjax import drawing
from dpdjax.checks import choice, not_negative
from dpdjax.engine.state import State
from dpdjax.engine.trajectory import Trajectory
from dpdjax.host import projection
from dpdjax.measure.clusters import cluster_of_each
from dpdjax.measure.contacts import contacts_of_each, gap_of_fluid
from dpdjax.measure.profile import velocity_profile
from dpdjax.measure.spheres import Spheres
from dpdjax.model.beads import radii
from dpdjax.model.colloids import solvent_reach
from dpdjax.model.fluid import Fluid
from dpdjax.scans.picture import plot_scan

DOT = 0.15
"""Radius of points behind spheres, in their reach."""
SINGLE = 0.75
"""Grey of spheres that are in no cluster."""
NAMED = 5
"""Clusters whose sizes the legend tells."""


def plot_run(trajectory: Trajectory, axes: Any = None) -> np.ndarray:
    """Draw how a run went: kinetic temperature with kT, pressure, potential energy and momentum of
    a bead against time, those of them that were recorded; of a batch a line for each member.

    Args:
        trajectory: a run, one or a batch.
        axes: matplotlib axes, one for each panel, or None for new ones that share time.

    Returns the axes (panels,). Raises ValueError where none of these was recorded, or for another
    number of axes.

    Example:
        >>> axes = dpd.plot_run(rest)
        >>> axes.shape  # temperature, pressure, energy, momentum
        (4,)
    """
    drawn = [name for name in PANELS if name in trajectory.frames]
    if not drawn:
        raise ValueError(
            f"the run recorded none of {', '.join(PANELS)} but {', '.join(trajectory.frames)}; use "
            "observe=[dpd.observe.standard, ...]"
        )
    axes = drawing.panels(len(drawn)) if axes is None else np.ravel(axes)
    if len(axes) != len(drawn):
        raise ValueError(f"{len(axes)} axes are given for {len(drawn)} panels, {', '.join(drawn)}")
    time = np.atleast_2d(trajectory.frames["time"])
    for ax, name in zip(axes, drawn):
        PANELS[name](ax, time, np.asarray(trajectory.frames[name]), trajectory)
    axes[-1].set(xlabel="t [time]", xscale=drawing.time_scale(time[0]))
    return axes


def _draw_temperature(ax, time, values, trajectory):
    ax.plot(time.T, np.atleast_2d(values).T, lw=1)
    for kT in np.unique(np.asarray(trajectory.fluid.kT)):
        ax.axhline(kT, color="0.4", ls="--", lw=1)
    ax.set_ylabel("temperature\n[energy]")


def _draw_pressure(ax, time, values, trajectory):
    ax.plot(time.T, np.atleast_2d(np.trace(values, axis1=-2, axis2=-1)).T / 3, lw=1)
    ax.set_ylabel("pressure\n[energy/length$^3$]")


def _draw_energy(ax, time, values, trajectory):
    ax.plot(time.T, np.atleast_2d(values).T / trajectory.final.n, lw=1)
    ax.set_ylabel("potential energy\nper bead [energy]")


def _draw_momentum(ax, time, values, trajectory):
    per_bead = np.reshape(values, (*time.shape, 3)) / trajectory.final.n
    for k, axis in enumerate("xyz"):
        lines = ax.plot(time.T, per_bead[..., k].T, lw=1, color=drawing.COLOURS[k])
        lines[0].set_label(axis)
    ax.legend(ncols=3, loc="upper left")
    ax.set_ylabel("momentum per bead\n[mass length/time]")


PANELS = {
    "temperature": _draw_temperature,
    "pressure_tensor": _draw_pressure,
    "potential_energy": _draw_energy,
    "momentum": _draw_momentum,
}
"""What a run is told by, as it is recorded."""


def plot_profile(trajectory: Trajectory, ax: Any = None, **how) -> Any:
    """Measure the velocity and temperature across the gap of a run and draw them; returns the axes.

    ``how`` and errors are those of :func:`dpdjax.measure.velocity_profile`.

    Example:
        >>> ax = dpd.plot_profile(sheared, bins=4)
        >>> ax.get_xlabel()
        'y [length]'
    """
    return velocity_profile(trajectory, **how).plot(ax)


def plot_flow_curve(table: Any, ax: Any = None) -> Any:
    """Draw the viscosity against the shear rate, both logarithmic, with error bars; a line for each
    value of another axis.

    Args:
        table: what :func:`dpdjax.scan` returns for an axis ``rate`` and an experiment with a
            ``viscosity``; choose a value of all other axes but one first, ``table.sel(kT=0.1)``.
        ax: matplotlib axes, or None for new ones.

    Returns the axes. Raises ValueError for a table without these.

    Example:
        >>> def thinning(key, rate):
        ...     return {"viscosity": dpd.Estimate(1 / (1 + rate), 0.01)}
        >>> table = dpd.scan(thinning, {"rate": [0.1, 1.0, 10.0]}, key=key, **quiet)
        >>> dpd.plot_flow_curve(table).get_xscale()
        'log'
    """
    if "status" in table and not (table["status"] == 1).any():
        raise ValueError("no run of the table is done, see its status and reason")
    if "rate" not in table.dims or "viscosity" not in table:
        raise ValueError(
            f"a flow curve is the viscosity along an axis 'rate'; the axes of this table are "
            f"{', '.join(map(str, table.dims))}, its numbers {', '.join(map(str, table))}"
        )
    ax = plot_scan(table, "viscosity", x="rate", ax=ax)
    labels = drawing.labelled("shear rate", "1/time"), drawing.labelled("viscosity")
    ax.set(xscale="log", yscale="log", xlabel=labels[0], ylabel=labels[1])
    for which in "xy":
        drawing.plain_log_ticks(ax, which)
    return ax


def plot_box(
    state: State,
    ax: Any = None,
    *,
    fluid: Fluid | None = None,
    colour: str = "depth",
    gap: float | None = None,
    solvent: float | None = None,
    axis: int = 2,
) -> Any:
    """Draw the beads of a state in the tilted box.

    Where the fluid has spheres, all of them, seen at an angle and without perspective, so that
    equal ones look equal: each where its centre is inside the box, those further off in front of
    others lighter. Of a fluid of points a slice next to one face of the box.

    Args:
        state: one state.
        ax: matplotlib axes, or None for new ones.
        fluid: tells the radii; without it all beads are points.
        colour: ``"depth"``, along the line of sight; of points alone ``"species"``; of spheres
            ``"contacts"``, the number of others closer than ``gap``, or ``"cluster"``, those joined
            by such contacts.
        gap: surface gap of a contact [length]; by default the range of the attraction.
        solvent: thickness of the slice of points that is drawn [length]; by default one reach of
            theirs where there are no spheres, and none behind spheres.
        axis: 0, 1 or 2, the direction one looks along.

    Returns the axes. Raises ValueError for a batch, another colour, no gap where one is needed.

    Example:
        >>> ax = dpd.plot_box(gel.final, fluid=made.fluid, colour="contacts")
        >>> ax.figure.savefig("gel.png")
    """
    if np.ndim(state.position) != 2:
        raise ValueError("the state is a batch; draw one member, trajectory[0].final")
    choice(colour, ("depth", "species", "contacts", "cluster"), "colour")
    if axis not in (0, 1, 2):
        raise ValueError(f"axis is {axis!r}; it is 0, 1 or 2")
    solvent = None if solvent is None else float(not_negative(solvent, "solvent"))
    radius = np.zeros(state.n) if fluid is None else np.asarray(radii(fluid, state), float)
    reach, is_round = 1.0 if fluid is None else solvent_reach(fluid), radius > 0
    cell = projection.Cell.of(state, axis)
    place, depth = cell.inside(np.asarray(state.position, float))
    ax = drawing.axes(ax)
    if not np.any(is_round):
        sliced = depth < (reach if solvent is None else solvent)
        paint = _by_species(ax, np.asarray(state.species)[sliced]) if colour == "species" else None
        return projection.draw_slice(ax, cell, place[sliced], depth[sliced], 0.5 * reach, paint)
    if colour == "species":
        raise ValueError("colour is 'species', which is for points alone; spheres are of one")
    projection.draw_box(ax, cell)
    behind = ~is_round & (depth > cell.lattice[axis, axis] - (solvent or 0.0))
    projection.draw_points(ax, cell, place[behind], DOT * reach)
    lengths, strain = np.diag(cell.lattice), float(state.box.strain)
    spheres = Spheres(place[is_round], radius[is_round], lengths, strain)
    paint = (
        _by_depth(ax, cell, spheres)
        if colour == "depth"
        else _by_contacts(ax, spheres, colour, gap_of_fluid(fluid) if gap is None else gap)
    )
    return projection.draw_spheres(
        ax, cell, place[is_round], radius[is_round], paint, colour != "depth"
    )


def _by_species(ax, species):
    """Colours (n, 3) by the species of each, and which is which."""
    import matplotlib as mpl

    # The third is that of a solvent, and grey.
    hues = mpl.colors.to_rgba_array([drawing.COLOURS[k] for k in (0, 1, 6, 2, 3, 4, 5)])[:, :3]
    told = [(f"species {k}", hues[k % len(hues)]) for k in np.unique(species)]
    patches = [mpl.patches.Patch(color=hue, label=label) for label, hue in told]
    ax.legend(handles=patches, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return hues[species % len(hues)]


def _by_depth(ax, cell, spheres):
    """Colours (n, 3) by how far behind the foremost corner, and their bar."""
    ends = cell.edges()[0][..., 2]
    depth = ends.max() - cell.seen(spheres.position[0, 0])[:, 2]
    return _mapped(ax, depth, "YlGnBu_r", (0.0, np.ptp(ends)), drawing.labelled("depth", "length"))


def _by_contacts(ax, spheres, colour, gap):
    """Colours (n, 3) by the number of contacts, or the cluster, and what they mean."""
    if colour == "cluster":
        return _by_cluster(ax, cluster_of_each(spheres, gap=gap)[0, 0])
    z = contacts_of_each(spheres, gap=gap)[0, 0]
    return _mapped(ax, z, "viridis", (-0.5, max(z.max(), 1) + 0.5), "contacts z")


def _mapped(ax, values, cmap: str, limits, label: str):
    """Colours (n, 3) of values (n,), a step of the map for each where they are whole numbers, and
    their bar."""
    import matplotlib as mpl

    whole = values.dtype.kind == "i"
    cmap = mpl.colormaps[cmap].resampled(round(np.ptp(limits)) if whole else 256)
    mapped = mpl.cm.ScalarMappable(mpl.colors.Normalize(*limits), cmap)
    ticks = {"ticks": mpl.ticker.MaxNLocator(integer=True)} if whole else {}
    ax.figure.colorbar(mapped, ax=ax, label=label, shrink=0.8, **ticks)
    return mapped.to_rgba(values)[:, :3]


def _by_cluster(ax, cluster):
    """Colours (n, 3) by the cluster of each, single ones grey, and the sizes of the largest."""
    import matplotlib as mpl

    size = np.bincount(cluster)
    hues = mpl.colors.to_rgba_array(drawing.COLOURS[:-1])[:, :3]
    of_cluster = np.where(size[:, None] > 1, hues[np.arange(len(size)) % len(hues)], SINGLE)
    told = [(f"cluster of {n}", of_cluster[k]) for k, n in enumerate(size[:NAMED]) if n > 1]
    told += [(f"{np.sum(size == 1)} single", [SINGLE] * 3)] if np.any(size == 1) else []
    patches = [mpl.patches.Patch(color=hue, label=label) for label, hue in told]
    ax.legend(handles=patches, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return of_cluster[cluster]
