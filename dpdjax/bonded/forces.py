"""What acts along bonds, in angles and in dihedrals: forces, energy and stress by the derivative of
each law."""

import jax
import jax.numpy as jnp

from dpdjax.bonded.coordinates import COORDINATES
from dpdjax.bonded.topology import each_type
from dpdjax.model.bonded import Bonded
from dpdjax.model.fluid import Fluid
from dpdjax.pairs.sums import Forces, Tally, onto_beads

HIGHEST = jax.lax.Precision.HIGHEST


def bonded_force(fluid: Fluid, state, tally: bool = False) -> Forces:
    """Forces (n, 3) of all bonds, angles and dihedrals of a state, and, if asked for by ``tally``
    (static), their energy and virials by origin."""
    if state.topology is None:
        raise ValueError("the fluid has bonds and the state has none: state.bonded({name: ids})")
    n, dtype = state.position.shape[0], state.position.dtype
    total = Tally.zero(dtype, fluid.origins) if tally else None
    rows, pulls = [], []
    for b, slots, v in each_type(fluid.bonded, state):
        energy, pull = along(b, v, fluid.kT)
        rows.append(slots.ravel())
        pulls.append(on_each(sum(pull.values())).reshape(3, -1))
        if tally:
            virial = {
                k: jnp.einsum("amc,bmc->ab", g, v, precision=HIGHEST) for k, g in pull.items()
            }
            total = total.plus(jnp.sum(energy), virial)
    force = onto_beads(jnp.concatenate(rows), jnp.concatenate(pulls, axis=1), n)
    return Forces(force, None, total)


def bonded_laplacian(fluid: Fluid, state):
    """The sum over beads of the Laplacian of the energy of bonds, angles and dihedrals."""
    total = jnp.zeros((), state.position.dtype)
    for b, _, v in each_type(fluid.bonded, state):
        total += jnp.sum(jax.vmap(lambda one, b=b: _laplacian(b, one, fluid.kT), -1)(v))
    return total


def _laplacian(b: Bonded, v, kT):
    """That of one bond, angle or dihedral, of vectors (3, beads - 1)."""

    def force(shift):
        moved = v + shift[:, :-1] - shift[:, 1:]
        _, pulls = along(b, moved[..., None], kT)
        return on_each(sum(pulls.values()))[..., 0]

    at = jnp.zeros((3, v.shape[1] + 1), v.dtype)
    return -jnp.trace(jax.jacfwd(force)(at).reshape(at.size, at.size))


def measured(fluid: Fluid, state, b: Bonded):
    """Of each bond, angle or dihedral of one type its coordinate, its energy, and the slope of
    that (count,)."""
    ((_, _, v),) = each_type((b,), state)
    q = COORDINATES[b.kind](v)
    return q, *evaluate(b.terms, q, fluid.kT)


def along(b: Bonded, v, kT):
    """Energies (count,) of one type, and by origin minus their slope with the vectors ``v``
    (3, beads - 1, count)."""
    q, back = jax.vjp(COORDINATES[b.kind], v)
    energy, pulls = jnp.zeros_like(q), {}
    for origin, terms in b.by_origin().items():
        u, slope = evaluate(terms, q, kT)
        energy, pulls[origin] = energy + u, back(-slope)[0]
    return energy, pulls


def evaluate(terms, q, kT):
    """Energy and slope of the sum of laws at coordinates (count,); a law that ends somewhere is
    zero there."""
    value = slope = jnp.zeros_like(q)
    for t in terms:
        law, reach = t.between(kT=kT)
        inside = True if reach is None else q < reach
        at = q if reach is None else jnp.where(inside, q, 0.5 * reach)
        u, du = jax.jvp(law, (at,), (jnp.ones_like(at),))
        u = u if reach is None else u - law(jnp.asarray(reach, q.dtype))
        value, slope = value + jnp.where(inside, u, 0.0), slope + jnp.where(inside, du, 0.0)
    return value, slope


def on_each(pull):
    """What each bead of a row feels (3, beads, count), of pulls on the vectors between them."""
    nothing = jnp.zeros_like(pull[:, :1])
    return jnp.concatenate([pull, nothing], axis=1) - jnp.concatenate([nothing, pull], axis=1)
