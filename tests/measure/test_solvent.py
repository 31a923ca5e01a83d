"""The density of the solvent between colloids, in any tilt and unit of length."""

from types import SimpleNamespace

import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.pairs import box as boxes


@pytest.mark.parametrize("strain, unit", [(0.0, 1.0), (0.4, 1.0), (0.4, 6.46)])
def test_density_of_the_solvent_between_colloids(strain, unit):
    """Uniform solvent of density 2 outside two spheres that displace twice their radius' worth."""
    rng, side = np.random.default_rng(7), 12.0
    colloids = np.array([[3.0, 3.0, 3.0], [8.0, 11.5, 8.0]])
    box = boxes.Box(np.full(3, side), strain)
    points = rng.random((int(2 * side**3), 3)) * side
    clear = np.ones(len(points), bool)
    for centre in colloids:
        d = np.asarray(boxes.displacement(box, points, centre[None]))
        clear &= np.sum(d * d, axis=1) > 1.5**2
    position = unit * np.concatenate([points[clear], colloids])
    box = boxes.Box(unit * box.lengths, strain)
    species = np.repeat([0, 1], [clear.sum(), 2])
    state = SimpleNamespace(position=position, species=species, size=np.ones(len(species)), box=box)
    among = [
        dpd.interaction(pair, dpd.term(dpd.soft_repulsion, a=0.0, r_c=unit))
        for pair in ((0, 0), (0, 1))
    ]
    fluid = dpd.fluid(kT=1.0, radius=(None, unit), interactions=among)
    measured = dpd.measure.solvent_density(fluid, state, points=4000) * unit**3
    assert abs(measured - 2.0) < 4 * 2.0 / np.sqrt(2 * side**3)
    with pytest.raises(ValueError, match="smaller clearance"):
        dpd.measure.solvent_density(fluid, state, clearance=20.0 * unit)
