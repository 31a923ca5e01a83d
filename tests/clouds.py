"""Spheres thrown at random and runs made up of them, and their surface gaps by trying all images;
for the measures of suspensions."""

import itertools
from types import SimpleNamespace

import numpy as np

from dpdjax.engine.flow import Flow
from dpdjax.measure.spheres import Spheres

SIDES = np.array([6.0, 7.0, 8.0])
STRAINS = [0.0, 0.25, -0.4]


def thrown(*shape, seed=0, sides=SIDES):
    return np.random.default_rng(seed).random((*shape, 3)) * sides


def mixed_radii(n, seed=0):
    return np.random.default_rng(seed + 100).uniform(0.2, 0.6, n)


def lattice_of(strain):
    lattice = np.diag(SIDES)
    lattice[1, 0] = strain * SIDES[1]
    return lattice


def gaps_by_force(position, radius, strain):
    """Surface gaps of all images up to two cells away, (n, n, images), and the images, (images,
    3)."""
    images = np.array(list(itertools.product((-2, -1, 0, 1, 2), repeat=3)))
    lattice = lattice_of(strain - SIDES[0] / SIDES[1] * np.round(strain * SIDES[1] / SIDES[0]))
    position = position @ np.linalg.inv(lattice) % 1 @ lattice
    d = position[None, :, None] + images @ lattice - position[:, None, None]
    return np.linalg.norm(d, axis=-1) - (radius[:, None] + radius[None, :])[..., None], images


def nearest_by_force(position, radius, strain):
    """Smallest gap of each pair i < j, (pairs,)."""
    h = gaps_by_force(position, radius, strain)[0].min(axis=-1)
    return h[np.triu_indices(len(radius), 1)]


def one_frame(position, radius=0.5, strain=0.0):
    return Spheres(position, radius, SIDES, strain)


def recorded(position, fluid=None, strain=None, flow=None, size=None):
    """What a run would leave behind of beads of species 1, radius 0.5."""
    n, frames = position.shape[-2], position.shape[-3]
    records = {
        "position": position,
        "time": np.broadcast_to(0.5 * np.arange(frames), position.shape[:-2]),
    }
    return SimpleNamespace(
        frames=records if strain is None else records | {"strain": strain},
        flow=Flow.of(flow),
        final=SimpleNamespace(
            box=SimpleNamespace(lengths=SIDES, strain=np.zeros(())),
            species=np.ones(n, int),
            size=np.ones(n) if size is None else size,
        ),
        fluid=fluid
        or SimpleNamespace(radius=(None, 0.5), interactions=(), batch_axes=lambda: None),
        interval=0.5,
        dt=0.5,
    )


def two_species(frames=3, a=20, b=30, strain=None):
    found = recorded(thrown(frames, a + b), strain=strain)
    found.final.species = np.arange(a + b) % 5 // 3
    return found
