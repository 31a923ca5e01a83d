"""Linear viscoelasticity: storage and loss modulus from oscillatory shear."""

import dataclasses

import numpy as np

from dpdjax.engine.trajectory import Trajectory
from dpdjax.measure import needs
from dpdjax.measure.replicas import refuse_scan, shared
from dpdjax.measure.results import Result
from dpdjax.measure.statistics import Estimate, from_replicas


@dataclasses.dataclass(frozen=True, repr=False)
class Moduli(Result):
    """The response to a strain ``amplitude sin(frequency t)``: stress over amplitude, by phase.

    Attributes:
        storage: G', in phase with the strain [energy / volume].
        loss: G'', in phase with its rate [energy / volume].
        frequency: angular [1/time].
        cycles: both moduli of every whole cycle, (cycles, 2).

    Example:
        >>> flow = dpd.oscillatory_shear(0.5, 2 * np.pi / 4.16)  # a cycle of 32 frames
        >>> plan, record = dpd.Plan(96, 13), dpd.observe.shear_record
        >>> ran = dpd.run(water, state, key, 0.01, plan, flow, observe=record, **quiet)
        >>> found = dpd.measure.moduli(ran)
        >>> found.cycles.shape, round(found.loss.value / found.viscosity.value, 3)  # the frequency
        ((2, 2), 1.51)
    """

    storage: Estimate
    loss: Estimate
    frequency: float
    cycles: np.ndarray

    @property
    def viscosity(self) -> Estimate:
        """``G'' / frequency``, the dynamic viscosity."""
        return self.loss.scaled(1.0 / self.frequency)


def moduli(trajectory: Trajectory, *, skip: int = 1, averaged: bool | None = None) -> Moduli:
    """Storage and loss modulus of a run under ``dpd.oscillatory_shear``.

    The stress ``-P_xy`` of every whole cycle is fitted by a constant, a sine and a cosine; the
    error is the scatter of the cycles (and of replicas).

    Args:
        trajectory: a run, one or replicas, with ``pressure_tensor`` recorded at least 8 times a
            cycle.
        skip: cycles left out at the start.
        averaged: whether frames are means over their interval,
            ``observe=dpd.mean(dpd.observe.standard)``, which are less noisy than snapshots; the
            sine is then averaged too. By default what the run knows of itself.

    Raises ValueError for another flow, a scan, no recorded stress, and less than two whole cycles
    after those left out.

    Example:
        >>> flow = dpd.oscillatory_shear(0.5, 2 * np.pi / 4.16)  # a cycle of 32 frames
        >>> plan, record = dpd.Plan(96, 13), dpd.observe.shear_record
        >>> ran = dpd.run(water, state, key, 0.01, plan, flow, observe=record, **quiet)
        >>> found = dpd.measure.moduli(ran)
        >>> found.loss.value > found.storage.value  # a liquid
        True
    """
    needs.finished(trajectory)
    amplitude, frequency = _oscillation(trajectory)
    time = _common_time(trajectory.frames)
    needs.finite(trajectory.frames)
    stress = -np.asarray(trajectory.frames["pressure_tensor"], float)[..., 0, 1].reshape(
        -1, time.size
    )
    interval = float(np.ravel(trajectory.interval)[0])
    averaged = (
        "pressure_tensor" in getattr(trajectory, "means", ["pressure_tensor"])
        if averaged is None
        else averaged
    )
    steps = trajectory.every if averaged else 1
    per_cycle = 2 * np.pi / (frequency * interval)
    if per_cycle < 8:
        every = max(1, int(per_cycle * trajectory.every / 8))
        raise ValueError(
            f"{per_cycle:.3g} frames in a cycle are too few; record at least 8, with every={every}"
        )
    # The mean of a sine over equal steps, the last at the time of the frame, is the sine in their
    # middle, less a factor.
    half = 0.5 * frequency * interval / trajectory.every
    phases = frequency * time - (steps - 1) * half
    cycle = np.floor((phases - phases[0]) / (2 * np.pi) + 1e-6).astype(int)
    whole = [k for k in range(skip, cycle[-1] + 1) if np.sum(cycle == k) >= np.floor(per_cycle)]
    if len(whole) * len(stress) < 2:
        raise ValueError(
            f"{len(whole)} whole cycles after the first {skip} give no error bar; run at least "
            f"{skip + 2}"
        )
    damped = np.sin(steps * half) / (steps * np.sin(half))
    fits = [_fit(phases[cycle == k], member[cycle == k]) for member in stress for k in whole]
    cycles = np.array(fits) / (amplitude * damped)
    _warn(
        trajectory, time >= time[cycle == whole[0]][0], cycles.reshape(len(stress), len(whole), 2)
    )
    return Moduli(from_replicas(cycles[:, 0]), from_replicas(cycles[:, 1]), frequency, cycles)


def _warn(trajectory, used, cycles):
    """Warn of beads that are hot in the frames used (frames,), and of cycles (replicas, cycles, 2)
    that drift."""
    heat = (
        {"temperature": np.asarray(trajectory.frames["temperature"])[..., used]}
        if "temperature" in trajectory.frames
        else {}
    )
    needs.warn_of_heat(trajectory, heat)
    needs.warn_of_drift({"storage modulus": cycles[..., 0], "loss modulus": cycles[..., 1]})


def _oscillation(trajectory):
    oscillation = trajectory.flow.deformation
    if oscillation.frequency is None:
        raise ValueError("moduli need a run with flow=dpd.oscillatory_shear(amplitude, frequency)")
    refuse_scan(trajectory)
    needs.warn_of_others(trajectory)
    return shared(oscillation.amplitude), shared(oscillation.frequency)


def _common_time(frames):
    """Times (frames,) that all replicas share."""
    if "pressure_tensor" not in frames:
        raise ValueError(
            "the run recorded no 'pressure_tensor'; use observe=dpd.mean(dpd.observe.standard)"
        )
    times = np.atleast_2d(np.asarray(frames["time"], float))
    if np.ptp(times, axis=0).any():
        raise ValueError(
            "members of the batch were recorded at different times; measure them one by one, "
            "trajectory.members()"
        )
    return times[0]


def _fit(phase, stress):
    """Amplitudes of sine and cosine."""
    design = np.stack([np.sin(phase), np.cos(phase), np.ones_like(phase)], axis=1)
    return np.linalg.lstsq(design, stress, rcond=None)[0][:2]
