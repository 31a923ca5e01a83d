"""Telling a run whose beads are not at the temperature they were given."""

import numpy as np

from dpdjax.engine.batching import each_fluid
from dpdjax.engine.observables import temperature
from dpdjax.errors import warn
from dpdjax.measure.needs import FLUCTUATIONS, HOT, doubt, fluctuation, is_off, trend

FEW = 20
"""Frames from which on a mean temperature is looked at."""


def warn_if_hot(trajectory):
    """Warns, with the likely cause, where beads end well above kT, or are steadily off it in the
    later half of the run.

    Of a batch the worst member is told.
    """
    fluid, state = trajectory.fluid, trajectory.final
    if not any(i.drag for i in fluid.interactions):
        return
    many = np.ndim(state.position) == 3
    observe = each_fluid(temperature, fluid, many)
    last = np.atleast_1d(np.asarray(observe(fluid, state), float))
    kT = np.broadcast_to(np.asarray(fluid.kT, float), last.shape)
    recorded = np.atleast_2d(np.asarray(trajectory.frames.get("temperature", np.nan), float))
    recorded = np.broadcast_to(recorded, (len(last), recorded.shape[1]))
    allowed = 1.0 + HOT + FLUCTUATIONS * fluctuation(3 * state.n - 3)
    chance = np.broadcast_to(doubt(trajectory, recorded.shape[1] // 2), last.shape)
    each = zip(last, kT, recorded, chance)
    told = [_told(*of, allowed, trajectory.flow) for of in each]
    excess = [abs(found[0]) if found else 0.0 for found in told]
    if any(told):
        worst = int(np.argmax(excess))
        member = f"member {worst}: " if many else ""
        warn(member + told[worst][1])


def _told(last: float, kT: float, recorded, chance: float, allowed: float, flow):
    """The excess over kT and what to say of it; None where there is none."""
    later = recorded[len(recorded) // 2 :]
    if np.isfinite(last) and kT > 0 and last > allowed * kT:
        ends = (
            f"the run ends at a kinetic temperature of {last:.3g}, {last / kT:.3g} times its kT "
            f"= {kT:.3g}"
        )
        return last / kT - 1, f"{ends}: {_cause(flow, trend(recorded))}"
    steady = None if len(later) < FEW or trend(later) else is_off(later, kT, chance)
    if steady is None:
        return None
    stays = (
        f"the later half of the run is steadily at a kinetic temperature of {steady:.4g} where "
        f"kT is {kT:.4g}"
    )
    return steady / kT - 1, f"{stays}: {_cause(flow, 0)}"


def _cause(flow, drifts: int) -> str:
    if drifts < 0:
        return "it still cools from its start; run on before measuring"
    if np.any(np.asarray(flow.rate) != 0):
        return (
            "the shear heats it faster than drag cools it, or dt is too large; use a smaller "
            "rate, or a smaller dt"
        )
    if drifts > 0:
        return "it heats up; use a smaller dt or, where a force drives it, a smaller one"
    if flow.drivers:
        return "the flow that a force drives counts in it, or dt is too large; use a smaller force"
    return "dt is too large, dpd.suggest_dt gives one that is not, or it still cools from its start"
