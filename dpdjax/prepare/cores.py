"""How close beads may start: distances below which potentials are more than thermal, and which laws
diverge."""

import jax
import numpy as np

from dpdjax.engine import soundness
from dpdjax.model.fluid import Fluid

START_ENERGY = 3.0
"""Energy of a pair [kT] up to which beads are placed next to each other."""
HARD, STEEP = 1e3, 20.0
"""A potential is a core where it reaches this energy [kT], and falls by this factor from contact to
half of its reach."""


def closest(fluid: Fluid, only_cores: bool = False, most: float = START_ENERGY) -> np.ndarray:
    """Gaps (species, species) beyond which the energy of a pair stays below ``most`` kT [length].

    ``only_cores``: of potentials that diverge; 0 for others.
    """
    found, kT = np.zeros((fluid.species, fluid.species)), float(fluid.kT)
    for species, gaps, energy in _surveyed(fluid):
        apart = _low_from(gaps, energy, most * kT)
        apart = np.where(_is_core(gaps, energy, kT), apart, 0.0) if only_cores else apart
        for (a, b), gap in zip(species, apart):
            found[a, b] = found[b, a] = max(found[a, b], gap)
    return found


def start_radii(fluid: Fluid) -> np.ndarray:
    """Radii (species,) that keep every two beads apart by their cores where spheres of these radii
    do not overlap [length]."""
    gaps = closest(fluid, only_cores=True)
    real = np.array([0.0 if r is None else float(r) for r in fluid.radius])
    radii = real + np.diag(gaps) / 2
    for a, b in zip(*np.nonzero(gaps)):
        lacks = real[a] + real[b] + gaps[a, b] - radii[a] - radii[b]
        if lacks > 0:
            # Points stay points where they can.
            radii[a if radii[a] >= radii[b] else b] += lacks
    return radii


def _low_from(gaps, energy, most):
    """Of each kind (kinds,) the sampled gap next to the widest one at which the energy is high."""
    high = energy > most
    inner = np.max(np.where(high, gaps, 0.0), axis=1, keepdims=True)
    outer = np.min(np.where(gaps > inner, gaps, np.inf), axis=1)
    return np.where(high.any(1), np.where(np.isfinite(outer), outer, inner[:, 0]), 0.0)


def _is_core(gaps, energy, kT):
    """Which kinds of pairs (kinds,) have a potential that keeps random beads from starting."""
    reach = gaps.max(1, keepdims=True)
    nearest = np.where(gaps > 0, energy, -np.inf).max(1)
    halfway = np.abs(np.where((gaps > 0.4 * reach) & (gaps < 0.6 * reach), energy, 0.0)).max(1)
    return (nearest > HARD * kT) & (nearest > STEEP * halfway)


def _surveyed(fluid):
    """Of each interaction the species of its kinds of pairs, (kinds, 2), and gaps and energies
    (kinds, samples).

    Of pairs that touch or are apart; what is no number there is a wall.
    """
    with jax.ensure_compile_time_eval():
        found = jax.tree.map(np.asarray, soundness.survey(fluid, soundness.one_size(fluid))[0])
    for si, sj, h, energy in found:
        walled = np.nan_to_num(energy.astype(float), nan=np.inf, posinf=np.inf)
        yield np.stack([si, sj], 1), h.astype(float), np.where(h > 0, walled, 0.0)
