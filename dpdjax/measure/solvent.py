"""The solvent between colloids: its density where no colloid is near."""

import numpy as np
from scipy.spatial import cKDTree

from dpdjax.engine.state import State
from dpdjax.measure.spheres import frame_of, shift_of, with_images
from dpdjax.model.beads import radii
from dpdjax.model.colloids import solvent_reach
from dpdjax.model.fluid import Fluid

CLEARANCE, PROBE = 0.8, 0.5
"""Of the reach of the solvent."""


def solvent_density(
    fluid: Fluid,
    state: State,
    *,
    clearance: float | None = None,
    probe: float | None = None,
    points: int = 20_000,
    seed: int = 0,
) -> float:
    """Solvent beads per volume away from all colloids [1/volume].

    A colloid displaces less solvent than its volume, so the solvent between colloids is thinner
    than planned; viscosities of suspensions are to be compared with the solvent *at this density*.
    Beads are counted in small spheres around random points that keep clear of every surface.

    Args:
        fluid, state: one state; species without a radius are solvent.
        clearance: least distance from a probe to the surface of a colloid [length], beyond which
            layers have faded; by default 0.8 of the reach of the solvent.
        probe: radius of the spheres beads are counted in [length]; by default half of it.
        points: how many are thrown into the box.
        seed: of their places.

    Raises ValueError where no point is clear of the colloids, and for a batch.

    Example:
        >>> density = dpd.measure.solvent_density(made.fluid, gel.final)
        >>> abs(density - 3.0) < 0.3
        True
    """
    if np.ndim(state.position) != 2:
        raise ValueError(
            "the state is a batch; give one member: jax.tree.map(lambda leaf: leaf[0], state)"
        )
    reach = solvent_reach(fluid)
    clearance, probe = (
        share * reach if x is None else x for x, share in ((clearance, CLEARANCE), (probe, PROBE))
    )
    lengths, position = (np.asarray(x, float) for x in (state.box.lengths, state.position))
    radius = np.asarray(radii(fluid, state), float)
    shift = shift_of(float(state.box.strain), lengths)
    trial = np.random.default_rng(seed).random((points, 3)) * lengths
    frame = lambda beads: frame_of(position[beads], radius[beads], lengths, shift)
    colloids, kept_off = frame(radius > 0), radius[radius > 0] + clearance + probe
    centres, owner = with_images(colloids, kept_off.max(initial=0.0))
    taken = cKDTree(trial).query_ball_point(centres, kept_off[owner]) if len(kept_off) else []
    trial = np.delete(trial, np.unique([k for near in taken for k in near]).astype(int), axis=0)
    if not len(trial):
        raise ValueError(
            f"no point is {clearance + probe:g} away from all colloids; take a smaller clearance "
            "or probe"
        )
    counts = cKDTree(with_images(frame(radius == 0), probe)[0]).query_ball_point(
        trial, probe, return_length=True
    )
    return float(np.mean(counts) / (4 / 3 * np.pi * probe**3))
