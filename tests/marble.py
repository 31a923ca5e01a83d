"""Numbers of the marbles that the tests of several rooms turn, the law they rub each other with,
and lists made anew."""

import dataclasses

import dpdjax as dpd
from dpdjax.pairs import neighbours as lists

DT, R, GAMMA, GAMMA_CS, GAMMA_T = 5e-3, 1.5, 5.0, 8.0, 3.0
COUPLINGS = ("central", "transverse", "full")
FLOW, FORTY = dpd.shear(1.0), dpd.Plan(4, 10)


def rub(h, *, gamma_cc, r_c):
    return gamma_cc * (1.0 - h / r_c) ** 2


def relisted(state):
    """The state with lists of where its beads are now."""
    neighbours = tuple(lists.allocate(n.grid, state.box, state.position) for n in state.neighbours)
    return dataclasses.replace(state, neighbours=neighbours)
