"""A fluid in words, with its energies in kT."""

import jax.numpy as jnp
import numpy as np

from dpdjax.checks import is_concrete
from dpdjax.model.declare import name_of

GAPS = np.linspace(0.0, 1.0, 401)
"""Shares of the reach at which a potential is looked at for its lowest energy."""


def short(fluid) -> str:
    """One line: the laws between every two groups."""
    laws = lambda i: ", ".join(dict.fromkeys(name_of(t.law) for t in i.terms))
    pairs = "; ".join(f"{_groups(i)}: {laws(i)}" for i in fluid.interactions)
    return f"Fluid(kT={written(fluid.kT)}, {fluid.species} species, {pairs})"


def full(fluid) -> str:
    """A line for every law, with its numbers, and the energies of potentials in kT."""
    lines = [f"kT {written(fluid.kT)}, mass {written(fluid.mass)}"]
    for i in fluid.interactions:
        for t in i.terms:
            numbers = ", ".join(f"{k} {written(c)}" for k, c in t.coefficients.items())
            energies = f": {energies_in_kT(fluid, i, t)}" if any(t is u for u in i.conservative) else ""
            lines.append(f"{_groups(i)}  {name_of(t.law)}, {numbers}{energies}")
    return "\n".join(lines)


def energies_in_kT(fluid, interaction, term) -> str:
    """What a potential is at contact, and how deep, in kT; of scans and tables what is largest."""
    if not is_concrete(fluid) or not np.all(np.asarray(fluid.kT) > 0):
        return "no energies in kT"
    at_contact, depth, where = depth_in_kT(fluid, interaction, term)
    deep = f", {depth:.3g} kT deep at h = {where:.3g}" if depth > 0 else ""
    return f"{at_contact:.3g} kT at contact{deep}"


def depth_in_kT(fluid, interaction, term) -> tuple[float, float, float]:
    """Energy of a potential at contact and its depth [kT], and the gap where it is deepest [length].

    Of scans and tables the largest coefficients count, and the lowest kT.
    """
    kT = float(np.min(np.asarray(fluid.kT)))
    radius = lambda group: max(0.0 if fluid.radius[k] is None else float(np.max(fluid.radius[k])) for k in group)
    R_i, R_j = map(radius, interaction.groups)
    law, reach = term.between(np.max, R_i=R_i, R_j=R_j, kT=kT)
    h = jnp.asarray(GAPS * float(reach))
    energy = np.asarray(jnp.broadcast_to(law(h), h.shape), float) / kT
    energy = energy - energy[-1]
    lowest = int(np.nanargmin(energy))
    return energy[0], -energy[lowest], float(h[lowest])


def written(value) -> str:
    """A number, or the numbers of a table or a scan."""
    if not is_concrete(value):
        return f"traced {jnp.shape(value)}"
    return f"{float(value):.6g}" if jnp.ndim(value) == 0 else np.array2string(np.asarray(value), precision=6, separator=", ")


def _groups(interaction) -> str:
    return "-".join("".join(map(str, group)) if len(group) == 1 else str(group) for group in interaction.groups)
