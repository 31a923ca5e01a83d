"""What a run says before it begins: what is allowed but seldom meant."""

import dataclasses
import math

import numpy as np

from dpdjax.model import summary
from dpdjax.model.colloids import diffusion_time
from dpdjax.model.declare import name_of
from dpdjax.model.fluid import Fluid
from dpdjax.model.rates import at_largest, extreme, worst_cases

DEEP = 40.0
"""Depth of a potential [kT] that is seldom meant."""
PRODUCTION_SIDE = 30.0
"""Shortest side at which a suspension counts as large, in reaches of its solvent."""


def cautions(fluid: Fluid, state, dt, plan) -> list[str]:
    """What is allowed in a run with colloids but seldom meant, each with the number that would
    pass."""
    numbers = extreme(fluid)
    if not numbers.has_radii:
        return deep_wells(fluid)
    side, tau = float(np.min(state.box.lengths)), _diffusion_time(numbers)
    found = []
    least = PRODUCTION_SIDE * min(numbers.reaches())
    if side < least * (1 - 1e-6) and not fluid.rotating:
        small = f"box side {side:.4g} is small for a suspension, whose images are felt"
        found.append(f"{small}: use {least:.4g} or more for production")
    found += cut_short(fluid) + deep_wells(fluid)
    interval = float(np.max(np.asarray(dt))) * plan.longest
    # A schedule of growing intervals means its last ones.
    if interval > tau and not plan.schedule:
        found.append(
            f"frames are {interval:.4g} apart, more than the diffusion time {tau:.4g}: "
            f"use Plan(every={max(1, math.floor(tau / float(np.max(np.asarray(dt)))))}) or less"
        )
    return found


def deep_wells(fluid: Fluid) -> list[str]:
    """Which potentials are so deep that beads never leave: often a depth meant in kT."""
    if not np.all(np.asarray(fluid.kT) > 0):
        return []
    depths = [
        (t, summary.depth_in_kT(fluid, i, t)[1]) for i in fluid.interactions for t in i.conservative
    ]
    return [
        f"{name_of(t.law)} is {depth:.3g} kT deep, and beads that meet there stay for good: "
        "energies are given in the unit of energy, in which kT is "
        f"{float(np.min(np.asarray(fluid.kT))):.3g}"
        for t, depth in depths
        if depth > DEEP
    ]


def cut_short(fluid: Fluid) -> list[str]:
    """Which potentials are cut off before the reach that their law declares."""
    worst = {}
    for case in worst_cases(fluid):
        for k, i in enumerate(case.interactions):
            for n, t in enumerate(i.conservative):
                declared = getattr(t.law, "reach", None)
                if declared is None:
                    continue
                given = at_largest(case, i)
                far = float(dataclasses.replace(t, cut=None, reach=declared).between(**given)[1])
                cut = float(t.between(**given)[1])
                if cut < far * (1 - 1e-6) and far > worst.get((k, n), ("", 0.0, 0.0))[1]:
                    worst[k, n] = name_of(t.law), far, cut
    return [
        f"{name} is cut off at h = {cut:.3g}, short of the reach that its law declares: give it a "
        f"reach of {far:.3g}"
        for name, far, cut in worst.values()
    ]


def _diffusion_time(numbers) -> float:
    """That of the colloids, the last species; infinite without a viscosity to tell it from."""
    known = any(hasattr(t.law, "viscosity") for i in numbers.interactions for t in i.drag)
    if not known or numbers.kT <= 0 or numbers.radius[-1] is None:
        return math.inf
    tau = float(diffusion_time(numbers))
    return tau if tau > 0 else math.inf
