"""A fluid in words, with its energies in kT; and tables for notebooks."""

import html
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.checks import is_concrete
from dpdjax.model.declare import CENTRAL, name_of

GAPS = np.linspace(0.0, 1.0, 401)
"""Shares of the reach at which a potential is looked at for its lowest energy."""


def short(fluid) -> str:
    """One line: the laws between every two groups and along bonds."""
    laws = lambda i: ", ".join(dict.fromkeys(name_of(t.law) for t in i.terms))
    parts = "; ".join(f"{_groups(part)}: {laws(part)}" for part in fluid.parts)
    return f"Fluid(kT={written(fluid.kT)}, {fluid.species} species, {parts})"


def full(fluid) -> str:
    """A line for every law, with its numbers, and the energies of potentials in kT."""
    lines = [
        f"{groups}  {law}, {numbers}" + (energies and f": {energies}")
        for groups, law, numbers, energies in laws_of(fluid)
    ]
    return "\n".join([f"kT {written(fluid.kT)}, mass {written(fluid.mass)}", *lines])


def laws_of(fluid) -> list[tuple[str, str, str, str]]:
    """Of every law the groups it acts between, or the type of bond it is of, its name, its numbers,
    and its energies in kT."""
    rows = []
    for part in fluid.parts:
        for t in part.terms:
            is_pair_potential = any(t is u for u in getattr(part, "conservative", ()))
            energies = energies_in_kT(fluid, part, t) if is_pair_potential else ""
            numbers = ", ".join(f"{k} {written(c)}" for k, c in t.coefficients.items())
            rows.append((_groups(part), name_of(t.law), numbers, energies))
    return rows


def as_table(title: str, rows: Iterable[tuple], head: tuple[str, ...] = ()) -> str:
    """Rows of words as a table of HTML under a title, for notebooks."""
    cells = lambda row, kind: "".join(f"<{kind}>{html.escape(str(x))}</{kind}>" for x in row)
    line = lambda row, kind: f"<tr style='text-align: left'>{cells(row, kind)}</tr>"
    lines = ([line(head, "th")] if head else []) + [line(row, "td") for row in rows]
    caption = f"<caption style='text-align: left'><b>{html.escape(title)}</b></caption>"
    return f"<table>{caption}{''.join(lines)}</table>"


def energies_in_kT(fluid, interaction, term) -> str:
    """What a potential is at contact, and how deep, in kT; of scans and tables what is largest."""
    if not is_known(fluid) or fluid.kT is None or not np.all(np.asarray(fluid.kT) > 0):
        return "no energies in kT"
    at_contact, depth, where = depth_in_kT(fluid, interaction, term)
    deep = f", {depth:.3g} kT deep at h = {where:.3g}" if depth > 0 else ""
    return f"{at_contact:.3g} kT at contact{deep}"


def depth_in_kT(fluid, interaction, term) -> tuple[float, float, float]:
    """Energy of a potential at contact and its depth [kT], and the gap where it is deepest
    [length].

    Of scans and tables the largest coefficients count, and the lowest kT.
    """
    kT = float(np.min(np.asarray(fluid.kT)))
    radius = lambda group: max(
        0.0 if fluid.radius[k] is None else float(np.max(fluid.radius[k])) for k in group
    )
    given = dict(zip(("R_i", "R_j"), map(radius, interaction.groups))) | {"kT": kT}
    found = [_depth(each, given) for each in term.members]
    return max(found, key=lambda one: one[1])


def _depth(term, given: dict) -> tuple[float, float, float]:
    """That of :func:`depth_in_kT` for one member."""
    law, reach = term.between(np.max, **given)
    h = jnp.asarray(GAPS * float(reach))
    energy = np.asarray(jnp.broadcast_to(law(h), h.shape), float) / given["kT"]
    energy = energy - energy[-1]
    lowest = int(np.nanargmin(energy))
    return energy[0], -energy[lowest], float(h[lowest])


def of_term(term) -> str:
    """One line: the law with its numbers, and what sets it apart from others of it."""
    numbers = [f"{name}={written(c)}" for name, c in term.coefficients.items()]
    numbers += [] if term.cut is None else [f"reach={written(term.cut)}"]
    numbers += [] if term.projector == CENTRAL else [f"projector={term.projector!r}"]
    numbers += [] if term.origin is None else [f"origin={term.origin!r}"]
    return f"{name_of(term.law)}({', '.join(numbers)})"


def is_known(*values) -> bool:
    """Whether all leaves are numbers: not traced, not shapes, not the axes of a batch."""
    return is_concrete(values) and all(
        hasattr(leaf, "__array__") for leaf in jax.tree.leaves(values)
    )


def span(value) -> str:
    """The one number that all have, or the least and the largest."""
    if not is_known(value) or value is None:
        return written(value)
    least, largest = float(np.min(np.asarray(value))), float(np.max(np.asarray(value)))
    return f"{least:.6g}" if least == largest else f"{least:.6g} to {largest:.6g}"


def written(value) -> str:
    """A number, or the numbers of a table or a scan; of what is no number, such as the axes of a
    batch, what Python says."""
    if not hasattr(value, "__array__") and hasattr(value, "is_batch"):
        return repr(value)
    if not is_concrete(value):
        return f"traced {jnp.shape(value)}"
    if not isinstance(value, (int, float)) and not hasattr(value, "__array__"):
        return repr(value)
    return (
        f"{float(value):.6g}"
        if jnp.ndim(value) == 0
        else np.array2string(np.asarray(value), precision=6, separator=", ")
    )


def _groups(part) -> str:
    """The two groups of an interaction, or the name of a type of bonds with its kind."""
    if not hasattr(part, "groups"):
        return part.name if part.name == part.kind else f"{part.kind} {part.name}"
    return "-".join(
        "".join(map(str, group)) if len(group) == 1 else str(group) for group in part.groups
    )
