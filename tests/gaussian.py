"""Runs made up of phantom chains drawn from what is exact: springs ``k r^2 / 2`` in a row, each
mode a random walk in its own well, the centre of mass a free one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import lfilter

import dpdjax as dpd
from dpdjax.engine.flow import Flow
from dpdjax.engine.state import State
from dpdjax.engine.system import System
from dpdjax.measure.rouse import modes_of
from dpdjax.pairs.box import Box, wrap
from dpdjax.pairs.sums import Tally

SPRING, FRICTION = 4.0, 2.0
SIDES = np.array([7.0, 8.0, 9.0])
INTERVAL = 0.5


def modes(rng, frames: int, chains: int, n: int, interval: float = INTERVAL):
    """Orthonormal modes 0 to n - 1 of chains (frames, chains, n, 3), in equilibrium, at times an
    interval apart; kT is 1."""
    rigidity = 4 * SPRING * np.sin(0.5 * np.pi * np.arange(1, n) / n) ** 2
    kept = np.exp(-interval * rigidity / FRICTION)[:, None]
    noise = rng.normal(size=(frames, chains, n - 1, 3)) / np.sqrt(rigidity)[:, None]
    noise[1:] *= np.sqrt(1 - kept**2)
    own = np.empty_like(noise)
    for k in range(n - 1):
        own[:, :, k] = lfilter([1.0], [1.0, -kept[k, 0]], noise[:, :, k], axis=0)
    centre = np.sqrt(2 * interval / FRICTION) * rng.normal(size=(frames, chains, 1, 3))
    centre[0] = np.sqrt(n) * SIDES * rng.random((chains, 1, 3))
    return np.concatenate([np.cumsum(centre, axis=0), own], axis=2)


def paths(seed: int, frames: int, chains: int, n: int, interval: float = INTERVAL):
    """Where the beads of phantom chains go, (frames, chains, n, 3)."""
    rows = np.concatenate([np.full((1, n), n**-0.5), modes_of(n)])
    return rows.T @ modes(np.random.default_rng(seed), frames, chains, n, interval)


def run(path, strain=0.0, order=None, interval: float = INTERVAL, groups=None, species=None):
    """A run of chains along a path (frames, chains, n, 3), wrapped into a box of a strain.

    ``order``: the id of the bead in each row of the frames; ``groups``: by name, by default the
    bonds along chains of consecutive ids; ``species``: by id.
    """
    frames, chains, n = path.shape[:3]
    count = chains * n
    ids = np.arange(count).reshape(chains, n)
    order = np.arange(count) if order is None else order
    kinds = 1 if species is None else int(np.max(species)) + 1
    table = jnp.ones((kinds, kinds)) if kinds > 1 else 1.0
    fluid = dpd.fluid(
        drag=[dpd.term(dpd.central_drag, gamma=table, r_c=1.0)],
        kT=1.0,
        mass=[1e-3] * kinds if kinds > 1 else 1e-3,
        bonds={"spring": dpd.term(dpd.laws.harmonic_bond, k=SPRING)},
    )
    box = Box(jnp.asarray(SIDES), jnp.asarray(strain))
    x = jnp.asarray(path.reshape(frames, count, 3)[:, order])
    position, image = jax.vmap(lambda x: wrap(box, x))(x)
    state = without_lists(box, position[-1], image[-1], order, species)
    if groups is None:
        bonds = np.stack([ids[:, :-1], ids[:, 1:]], axis=-1).reshape(-1, 2)
        groups = {"spring": bonds}
    state = state.bonded(groups)
    recorded = {
        "time": interval * np.arange(1, frames + 1),
        "step": np.arange(1, frames + 1),
        "position": np.asarray(position),
        "image": np.asarray(image),
        "strain": np.full(frames, strain),
    }
    return dpd.Trajectory(state, recorded, System.of(fluid, interval, Flow()), 1)


def without_lists(box, position, image, order, species=None) -> State:
    """A state of beads whose ids are ``order``, with all that measures look at."""
    n, zero = len(order), jnp.zeros(())
    of_bead = dict.fromkeys(("velocity", "force", "position_rest"), jnp.zeros((n, 3)))
    kinds = np.zeros(n, int) if species is None else np.asarray(species)[order]
    clock = {"step": jnp.zeros((), int), "time": zero, "strain_rest": zero, "time_rest": zero}
    return State(
        position=position,
        image=image,
        id=jnp.asarray(order, jnp.int32),
        species=jnp.asarray(kinds, jnp.int32),
        size=jnp.ones(n),
        box=box,
        neighbours=(),
        tally=Tally.zero(position.dtype, ()),
        started=jnp.zeros((), int),
        status=jnp.zeros((), jnp.uint32),
        **of_bead,
        **clock,
    )


def joined(members):
    """Runs as the members of a batch."""
    stack = lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves])
    final = jax.tree.map(stack, *[m.final for m in members])
    frames = {k: np.stack([m.frames[k] for m in members]) for k in members[0].frames}
    return dataclasses.replace(members[0], final=final, frames=frames)
