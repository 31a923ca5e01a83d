"""Small states with bonds, angles and dihedrals, for the tests."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import dpdjax as dpd
from dpdjax.bonded.forces import measured
from dpdjax.engine.state import assemble

LENGTH = 5
"""Beads of a chain."""


def fluid(**numbers):
    """Chains with every kind of bond, in a solvent that rubs."""
    given = {"k": 20.0, "bend": 5.0, "twist": 2.0} | numbers
    return dpd.fluid(
        [dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)],
        [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)],
        kT=1.0,
        bonds={"strong": dpd.term(dpd.laws.harmonic_bond, k=given["k"], r0=0.6)},
        angles={"bend": dpd.term(dpd.laws.cosine_angle, k=given["bend"], theta0=2.0)},
        dihedrals={"twist": dpd.term(dpd.laws.cosine_dihedral, k=given["twist"], n=3, d=-1.0)},
    )


def groups(n: int, length: int = LENGTH) -> dict:
    """The bonds, angles and dihedrals of chains of consecutive ids."""
    chains = np.arange(n - n % length).reshape(-1, length)
    windows = lambda k: np.concatenate([chains[:, s : s + k] for s in range(length - k + 1)])
    return {"strong": windows(2), "bend": windows(3), "twist": windows(4)}


def placed(state, key=0, step: float = 0.6):
    """The same beads with those of a chain next to each other: random walks from where its first
    bead is."""
    n = state.n - state.n % LENGTH
    walk = np.random.default_rng(key).normal(size=(n // LENGTH, LENGTH, 3))
    walk *= step / np.linalg.norm(walk, axis=-1, keepdims=True)
    walk[:, 0] = np.asarray(state.position)[:n:LENGTH]
    x = np.asarray(state.position).copy()
    x[:n] = np.cumsum(walk, axis=1).reshape(-1, 3)
    grids = tuple(held.grid for held in state.neighbours)
    given = jnp.asarray(x, state.position.dtype), state.velocity, state.species, grids
    return assemble(state.box, *given, origins=tuple(state.tally.virial))


def state(fluid, box=(6.0, 6.0, 6.0), key=0, strain: float = 0.0, **how):
    """Chains of :func:`groups` in a box, tilted by a strain."""
    made = placed(dpd.initial_state(fluid, jax.random.key(key), box=box, density=3.0))
    if strain:
        made = dataclasses.replace(made, box=made.box.strained(strain))
    return made.bonded(groups(made.n), **how)


def stretched(fluid, state) -> np.ndarray:
    """The lengths of the bonds of a state."""
    return np.asarray(measured(fluid, state, fluid.bonded[0])[0])
