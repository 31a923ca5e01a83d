"""The solvent between colloids: its density where no colloid is near."""

import numpy as np
from scipy.spatial import cKDTree

from dpdjax.engine.state import radii
from dpdjax.measure.spheres import Frame, shift_of, with_images


def solvent_density(fluid, state, *, clearance: float = 0.8, probe: float = 0.5, points: int = 20_000, seed: int = 0) -> float:
    """Solvent beads per volume away from all colloids [1/volume].

    A colloid displaces less solvent than its volume, so the solvent between colloids is thinner than planned; viscosities of
    suspensions are to be compared with the solvent *at this density*. Beads are counted in small spheres around random
    points that keep clear of every surface.

    Args:
        fluid, state: one state; species without a radius are solvent.
        clearance: least distance from a probe to the surface of a colloid [length], beyond which layers have faded.
        probe: radius of the spheres beads are counted in [length].
        points: how many are thrown into the box.
        seed: of their places.

    Raises ValueError where no point is clear of the colloids, and for a batch.
    """
    if np.ndim(state.position) != 2:
        raise ValueError("the state is a batch; give one member: jax.tree.map(lambda leaf: leaf[0], state)")
    lengths, position = (np.asarray(x, float) for x in (state.box.lengths, state.position))
    radius = np.asarray(radii(fluid, state), float)
    shift = shift_of(float(state.box.strain), lengths)
    trial = np.random.default_rng(seed).random((points, 3)) * lengths
    for R in np.unique(radius[radius > 0]):
        reach = R + clearance + probe
        trial = trial[_tree(position[radius == R], lengths, shift, reach).query(trial, distance_upper_bound=reach)[0] >= reach]
    if not len(trial):
        raise ValueError(f"no point is {clearance + probe:g} away from all colloids; take a smaller clearance or probe")
    counts = _tree(position[radius == 0], lengths, shift, probe).query_ball_point(trial, probe, return_length=True)
    return float(np.mean(counts) / (4 / 3 * np.pi * probe**3))


def _tree(position, lengths, shift, reach) -> cKDTree:
    """Beads and their images around the box."""
    x = position.copy()
    x[:, 0] -= shift * np.floor(x[:, 1] / lengths[1])
    wrapped = x - lengths * np.floor(x / lengths)
    return cKDTree(with_images(Frame(wrapped, np.zeros(len(x)), lengths, shift), reach)[0])
