"""Marbles shared by the files of this room: as they are made, and after some steps of shear."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from marble import DT, FLOW, FORTY, GAMMA, GAMMA_CS, GAMMA_T, R, relisted, rub

import dpdjax as dpd
from dpdjax.pairs import box as boxes


@pytest.fixture(scope="session")
def marbled(key):
    """Three marbles that rub each other too, in a solvent with transverse drag; the smallest box
    that takes them."""
    friction = [
        dpd.term(rub, gamma_cc=g, r_c=1.0, projector=p)
        for g, p in ((4.0, "full"), (2.0, "transverse"), (1.0, "central"))
    ]
    return dpd.marbles(
        key,
        box=9.6,
        count=3,
        radius=R,
        density=0.7,
        gamma_t=GAMMA_T,
        gamma=GAMMA,
        gamma_cs=GAMMA_CS,
        friction=friction,
        skin=0.2,
        dt=DT,
        sheared=True,
        report=None,
    )


@pytest.fixture(scope="session")
def settled_marbles(marbled, simulate, key):
    """The same after 40 steps of shear, two marbles a small gap apart."""
    position = np.array(marbled.state.position)
    position[-1] = position[-2] + (2 * R + 0.2) * np.array([0.48, 0.6, 0.64])
    # Solvent where the marble is now goes to its surface: left inside, it would run away.
    away = np.asarray(
        boxes.displacement(
            marbled.state.box, jnp.asarray(position[:-3]), jnp.asarray(position[-1:])
        )
    )
    r = np.linalg.norm(away, axis=1, keepdims=True)
    position[:-3] += np.where(r < R + 0.2, away / r * (R + 0.2 - r), 0.0)
    position = jnp.asarray(position)
    state = dataclasses.replace(marbled.state, position=boxes.wrap(marbled.state.box, position)[0])
    state = relisted(dpd.grow(state))
    final = simulate(marbled.fluid, state, key, 1e-3, FORTY, FLOW).final
    assert final.status == 0
    return final
