"""The surface tension of interfaces across an axis, and the pressure profile that it comes from."""

import dataclasses
from typing import Any

import numpy as np

from dpdjax.checks import choice, not_negative, plain, whole
from dpdjax.drawing import axes
from dpdjax.engine.trajectory import Trajectory
from dpdjax.measure import needs
from dpdjax.measure.blocks import average, error_of
from dpdjax.measure.reading import check_recorded, frame_lengths
from dpdjax.measure.results import Result
from dpdjax.measure.statistics import Estimate, block_average

PROFILE = "[dpd.mean(dpd.observe.pressure_in_slabs(50))]"


@dataclasses.dataclass(frozen=True, repr=False)
class PressureProfile(Result):
    """The pressure in slabs across an axis.

    Attributes:
        z: middle of each slab along the axis, (bins,) [length]; where the box changes, in that of
            the mean.
        normal: pressure along the axis, (bins,) [energy / volume].
        normal_error: its standard error, (bins,); NaN where there is a single frame.
        tangential: mean of the pressures across the axis, (bins,) [energy / volume].
        tangential_error: its standard error, (bins,).
        tension: of one interface, the integral of the difference over the interfaces
            [energy / area].

    Example:
        >>> slabs = dpd.mean(dpd.observe.pressure_in_slabs(8))
        >>> ran = dpd.run(water, state, key, 0.01, dpd.Plan(40, 5), observe=slabs, **quiet)
        >>> profile = dpd.measure.pressure_profile(ran)
        >>> profile.z.tolist()
        [0.25, 0.75, 1.25, 1.75, 2.25, 2.75, 3.25, 3.75]
        >>> profile.normal.shape, profile.tangential.shape
        ((8,), (8,))
    """

    z: np.ndarray
    normal: np.ndarray
    normal_error: np.ndarray
    tangential: np.ndarray
    tangential_error: np.ndarray
    tension: Estimate

    def plot(self, ax: Any = None) -> Any:
        """Draw both pressures with their errors; returns the matplotlib axes."""
        ax = axes(ax)
        parts = (
            (self.normal, self.normal_error, "normal"),
            (self.tangential, self.tangential_error, "tangential"),
        )
        for values, error, label in parts:
            style = {"fmt": "o-", "ms": 3, "lw": 1, "capsize": 2, "label": label}
            ax.errorbar(self.z, values, np.nan_to_num(error), **style)
        ax.set(xlabel="z [length]", ylabel="pressure [energy/length$^3$]")
        ax.legend()
        return ax


def pressure_profile(
    trajectory: Trajectory, *, interfaces: int = 2, skip: float = 0.1
) -> PressureProfile:
    """The pressure across the slabs that a run recorded, and the tension of its interfaces.

    In mechanical equilibrium the normal pressure is the same in all slabs; where it is not, the run
    is too short or the box not at rest. Errors come from blocks of frames (and of replicas).

    Args:
        trajectory: a run recorded with ``observe=dpd.mean(dpd.observe.pressure_in_slabs(bins))``,
            one or replicas.
        interfaces: across the axis, among which the tension is divided: 2 of a slab of liquid, 1
            for that of a membrane or a whole box.
        skip: share of the frames left out at the start.

    Warns where the tension still drifts over the frames used. Raises ValueError for a run that
    recorded no such profile or failed, a scan over numbers, ``interfaces`` below 1, ``skip``
    outside 0 to 1.

    Example:
        >>> slabs = dpd.mean(dpd.observe.pressure_in_slabs(8))
        >>> ran = dpd.run(water, state, key, 0.01, dpd.Plan(40, 5), observe=slabs, **quiet)
        >>> profile = dpd.measure.pressure_profile(ran)
        >>> abs(profile.tension.value) < 5  # one liquid, no interface
        True
    """
    profile, side = _recorded(trajectory, skip, pressure_profile=(-1, 3), pressure_profile_side=())
    normal, tangential = profile[..., 0], profile[..., 1:].mean(axis=-1)
    tension = side * (normal - tangential).mean(axis=-1) / whole(interfaces, "interfaces")
    needs.warn_of_drift({"tension": tension})
    bins = normal.shape[-1]
    of = lambda values: (values.mean(axis=(0, 1)), error_of(values))
    z = (np.arange(bins) + 0.5) * float(side.mean()) / bins
    return PressureProfile(z, *of(normal), *of(tangential), average(tension))


def surface_tension(
    trajectory: Trajectory,
    *,
    axis: str = "z",
    interfaces: int = 2,
    skip: float = 0.1,
    blocks: int = 20,
) -> Estimate:
    """The tension of interfaces across an axis, ``L_z (P_zz - (P_xx + P_yy) / 2)`` over their
    number, from the whole pressure tensor [energy / area].

    Args:
        trajectory: a run in equilibrium with interfaces across the axis that recorded
            ``pressure_tensor``, best as ``observe=dpd.mean(dpd.observe.standard)``, one or
            replicas; at constant pressure ``dpd.observe.box`` too.
        axis: ``"x"``, ``"y"`` or ``"z"``, normal to the interfaces.
        interfaces: 2 of a slab of liquid, 1 for the tension of a membrane or of a whole box.
        skip: share of the frames left out at the start.
        blocks: pieces for the error bar.

    Warns where the tension still drifts over the frames used. Raises ValueError for a run that
    recorded no pressure or failed, was sheared, changed its box without recording it, a scan over
    numbers, another axis, ``interfaces`` below 1, ``skip`` outside 0 to 1.

    Example:
        >>> tension = dpd.measure.surface_tension(rest)
        >>> abs(tension.value) < 5  # one liquid, no interface
        True
    """
    normal = "xyz".index(choice(axis, ("x", "y", "z"), "axis"))
    (pressure,) = _recorded(trajectory, skip, pressure_tensor=(3, 3))
    needs.unsheared(trajectory, "its surface tension", "run it without the shear")
    own = np.diagonal(pressure, axis1=-2, axis2=-1)
    across = np.delete(own, normal, axis=-1).mean(axis=-1)
    side = _later(frame_lengths(trajectory)[..., normal], skip)
    tension = side * (own[..., normal] - across) / whole(interfaces, "interfaces")
    needs.warn_of_drift({"tension": tension})
    return block_average(tension, blocks)


def _recorded(trajectory, skip, **shapes) -> list[np.ndarray]:
    """What was recorded under some names after the start, each (batch, frames, ...) by its shape in
    one frame, in double precision."""
    found = []
    for name, shape in shapes.items():
        observe = PROFILE if name.startswith("pressure_profile") else "dpd.observe.standard"
        check_recorded(trajectory, name, observe)
        values = np.asarray(trajectory.frames[name], float)
        needs.finite({name: values})
        frames = np.atleast_2d(trajectory.frames["time"]).shape
        found.append(_later(values.reshape(*frames, *shape), skip))
    return found


def _later(values, skip):
    """Values (batch, frames, ...) after the first ``skip`` share of the frames."""
    skip = plain(skip, "skip", not_negative)
    first = int(skip * values.shape[1])
    if first >= values.shape[1]:
        raise ValueError(f"skip is {skip:g}, and leaves no frame; give a share below 1")
    return values[:, first:]
