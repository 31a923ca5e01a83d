"""Rotation of spheres: autocorrelation of angular velocity and orientation, rotational diffusion.

Recorded with ``observe=dpd.observe.rotations``. Error bars come from pieces in time and replicas,
as in :mod:`dpdjax.measure.transport`.
"""

import dataclasses

import numpy as np

from dpdjax.drawing import curve, labelled
from dpdjax.engine.batching import each_fluid
from dpdjax.engine.rotation import axis_of
from dpdjax.engine.trajectory import Trajectory
from dpdjax.errors import warn
from dpdjax.measure import needs, transport
from dpdjax.measure.blocks import standard_error
from dpdjax.measure.forgetting import Memory
from dpdjax.measure.reading import recorded
from dpdjax.measure.replicas import shared
from dpdjax.measure.results import Result
from dpdjax.measure.statistics import Estimate
from dpdjax.measure.transport import correlated, read_diffusion
from dpdjax.model.beads import inertias

RECORD = "dpd.observe.rotations"


@dataclasses.dataclass(frozen=True, repr=False)
class RotationalCorrelation(Result):
    """How long rotation is remembered.

    Attributes:
        time: lags from 0, (lags,) [time].
        value: (lags,), ``<omega(t) . omega(0)>`` [1/time^2] or ``<u(t) . u(0)>`` of a unit vector.
        error: its standard error, (lags,); NaN where there is a single piece.
        name: what it is, for drawing.
    """

    time: np.ndarray
    value: np.ndarray
    error: np.ndarray
    name: str

    def plot(self, ax=None):
        """Draw it with its error band; returns the matplotlib axes."""
        return curve(ax, self.time, self.value, self.error, "t [time]", self.name)


def angular_velocity_autocorrelation(
    trajectory: Trajectory, *, t_max: float | None = None
) -> RotationalCorrelation:
    """The autocorrelation of the angular velocity of all spheres that rotate [1/time^2].

    ``<omega(t) . omega(0)>``, ``3 kT / I`` at t = 0.

    Args:
        trajectory: a run without shear recorded with ``observe=dpd.observe.rotations``, batched or
            not.
        t_max: longest lag [time]; by default as long as leaves 12 independent pieces.

    Raises ValueError for a sheared or failed run, one without rotations, a ``t_max`` outside the
    run.

    Example:
        >>> memory = dpd.measure.angular_velocity_autocorrelation(turning, t_max=0.2)
        >>> bool(memory.value[-1] < memory.value[0])
        True
    """
    values = _unsheared(trajectory, "angular_velocity")
    time, curves = correlated(trajectory, values, values.shape, transport.autocorrelation, t_max)
    name = labelled("angular velocity autocorrelation", "1/time^2")
    return RotationalCorrelation(time, curves.mean(axis=0), standard_error(curves), name)


def orientation_correlation(
    trajectory: Trajectory, *, t_max: float | None = None
) -> RotationalCorrelation:
    """The autocorrelation of the axis of all spheres that rotate.

    ``<u(t) . u(0)>`` of a unit vector, ``exp(-2 D_r t)`` at late times.

    Arguments and errors as in :func:`angular_velocity_autocorrelation`.

    Example:
        >>> memory = dpd.measure.orientation_correlation(turning, t_max=0.2)
        >>> round(float(memory.value[0]), 3)
        1.0
    """
    values = axis_of(_orientations(trajectory))
    time, curves = correlated(trajectory, values, values.shape, transport.autocorrelation, t_max)
    return RotationalCorrelation(
        time, curves.mean(axis=0), standard_error(curves), "orientation autocorrelation"
    )


def rotational_diffusion(
    trajectory: Trajectory, *, method: str = "msd", fit: tuple[float, float] | None = None
) -> Estimate:
    """The rotational diffusion coefficient ``D_r`` [1/time] of the spheres of a run.

    Two readings of one number over the lags of ``fit``: a sixth of the slope of the mean square of
    the angle turned by (Einstein), added up from the turns between frames, each of which is to stay
    well below pi; or a third of the integral of the angular velocity autocorrelation up to t,
    averaged over t (Green-Kubo), which needs frames much closer than the angular velocity lives.

    Args:
        trajectory: a run without shear recorded with ``observe=dpd.observe.rotations``, batched or
            not.
        method: ``"msd"`` or ``"vacf"``.
        fit: first and last lag [time], after the spin is forgotten; by default the later half of
            the lags that leave 12 independent pieces.

    Raises ValueError as :func:`dpdjax.diffusion` does, for frames so far apart that turns are lost
    count of, and spheres that no friction turns, as with ``coupling="central"``.

    Example:
        >>> rough = marble.fluid.set(gamma_cs=50.0)  # forgets its spin sooner
        >>> record = [dpd.observe.positions_of(1), dpd.observe.rotations]
        >>> plan = dpd.Plan(40, 20)
        >>> ran = dpd.run(rough, marble.state, key, marble.dt, plan, observe=record, **quiet)
        >>> D = dpd.measure.rotational_diffusion(ran, fit=(0.1, 0.2))
        >>> 0 < D.value < 0.1
        True
    """
    if method not in ("msd", "vacf"):
        raise ValueError(f'method is {method!r}; it is "msd" or "vacf"')
    needs.finished(trajectory)
    check_turned(trajectory.fluid, trajectory.fluid.rotating)
    if method == "vacf":
        values, how = (
            _unsheared(trajectory, "angular_velocity"),
            (transport.autocorrelation, transport.green_kubo_integral),
        )
    else:
        values, how = (
            angle_turned(_orientations(trajectory)),
            (transport.squared_displacement, transport.einstein),
        )
    # The tail of the spin, of the power 5/2, leaves too little out to be looked after.
    memory = Memory(_inertia(trajectory), shared(trajectory.fluid.kT))
    return read_diffusion(trajectory, values, values.shape, *how, fit, memory)


def _inertia(trajectory) -> float:
    """Mean moment of inertia of the beads that rotate."""
    final = trajectory.final
    of_all = each_fluid(inertias, trajectory.fluid, np.ndim(final.species) == 2)
    return float(np.mean(of_all(trajectory.fluid, final)))


def check_turned(fluid, species):
    """ValueError where nothing but the start decides how fast the beads of one of these species
    rotate."""
    for k in species:
        if not fluid.is_turned(k):
            raise ValueError(
                f"no friction turns the beads of species {k}: all of theirs act along the line of "
                "centres, and they spin as they "
                'started; give one projector="full" or "transverse" (for marbles the coupling)'
            )


def _orientations(trajectory):
    return _unsheared(trajectory, "orientation", components=4)


def _unsheared(trajectory, name: str, components: int = 3):
    """What was recorded of the beads that rotate; ValueError where a shear turns them, warns where
    a force or a torque may."""
    values = recorded(trajectory, name, observe=RECORD, components=components)
    needs.unsheared(
        trajectory,
        "how spheres would turn without the flow",
        "measure rotation in a run without a flow",
    )
    needs.warn_unsettled(trajectory.frames)
    if needs.is_pushed(trajectory):
        warn(
            "a force or a torque drove this run, and how it turned spheres is not taken off; "
            "measure in a run without it, or by dpd.measure.driven_rotation",
        )
    return values


def angle_turned(orientation) -> np.ndarray:
    """The turns between frames, as vectors, added up: (..., frames, m, 3) from quaternions (...,
    frames, m, 4)."""
    q = np.asarray(orientation, float)
    before, after = q[..., :-1, :, :], q[..., 1:, :, :]
    w = np.sum(before * after, axis=-1)
    a, b = before[..., 1:], after[..., 1:]
    v = before[..., :1] * b - after[..., :1] * a - np.cross(b, a)
    # A quaternion and its negative are the same turn: take the shorter.
    v, w = v * np.where(w < 0, -1.0, 1.0)[..., None], np.abs(w)
    sine = np.linalg.norm(v, axis=-1)
    half = np.arctan2(sine, w)
    if np.max(half, initial=0.0) > 0.4 * np.pi:
        raise ValueError(
            "between two frames a sphere turned by most of half a turn; record frames closer "
            "together"
        )
    angles = 2.0 * v * (half / np.where(sine > 0, sine, 1.0))[..., None]
    start = np.zeros_like(q[..., :1, :, :3])
    return np.concatenate([start, np.cumsum(angles, axis=-3)], axis=-3)
