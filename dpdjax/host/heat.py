"""Telling a run whose beads end far from the temperature they were given."""

import warnings

import jax
import numpy as np

from dpdjax.engine.observables import temperature
from dpdjax.measure.needs import HOT

FLUCTUATIONS = 5.0
"""Standard deviations of the temperature of few beads that are no excess."""


def warn_if_hot(fluid, state, flow, stacklevel: int = 3):
    """Warns, with the likely cause, where the beads of a state, or of a member of a batch, are well above kT."""
    if not any(i.drag for i in fluid.interactions):
        return
    observe = jax.vmap(temperature, (fluid.batch_axes(), 0)) if np.ndim(state.position) == 3 else temperature
    measured, kT = np.atleast_1d(np.asarray(observe(fluid, state), float)), np.asarray(fluid.kT, float)
    allowed = 1.0 + HOT + FLUCTUATIONS * np.sqrt(2.0 / (3 * state.n - 3))
    hot = np.isfinite(measured) & (measured > allowed * kT) & (kT > 0)
    if hot.any():
        worst = int(np.argmax(np.where(hot, measured / np.where(kT > 0, kT, 1.0), 0.0)))
        warnings.warn(_told(measured[worst], np.broadcast_to(kT, measured.shape)[worst], flow), stacklevel=stacklevel)


def _told(measured: float, kT: float, flow) -> str:
    ends = f"the run ends at a kinetic temperature of {measured:.3g}, {measured / kT:.3g} times its kT = {kT:.3g}"
    if np.any(np.asarray(flow.rate) != 0):
        return f"{ends}: the shear heats it faster than drag cools it; use a smaller rate"
    return f"{ends}: it still cools from its start, or dt is too large; run on before measuring, or use a smaller dt"
