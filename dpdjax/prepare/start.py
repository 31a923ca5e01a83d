"""Beads to start from: placed at random or on a lattice, with Maxwell velocities."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.checks import (
    Numbers,
    choice,
    is_concrete,
    not_negative,
    plain,
    positive,
    prng_key,
    truth,
    whole,
)
from dpdjax.engine import soundness
from dpdjax.engine.rotation import Rotation
from dpdjax.engine.state import State, assemble
from dpdjax.model.advice import suggest_dt, suggest_skins
from dpdjax.model.beads import inertia_of
from dpdjax.model.fluid import Fluid
from dpdjax.pairs import box as boxes
from dpdjax.pairs import neighbours as lists
from dpdjax.pairs.noise import Domain
from dpdjax.prepare import packing
from dpdjax.prepare.cores import START_ENERGY, start_radii

CLUSTERING = 2.0
"""Room in the lists of colloids, which gather."""
MOST_BEADS = 2**31
"""Beads are numbered in 32 bits."""
LEAST_SKIN = 0.02
"""Share of the reach that a default skin keeps in a narrow box."""


def initial_state(
    fluid: Fluid,
    key: jax.Array,
    *,
    box: Numbers,
    density: Numbers | None = None,
    n: int | Sequence[int] | None = None,
    start: str = "random",
    fractions: Sequence[float] | None = None,
    skin: float | None = None,
    dt: float | None = None,
    sheared: bool = True,
) -> State:
    """Beads in a box, with Maxwell velocities of zero total momentum.

    At random, spheres (species with a radius) do not overlap, and points lie outside them. Beads
    whose potential diverges, as that of Lennard-Jones, are placed no closer than where it is a few
    kT.

    Args:
        fluid: what the beads are.
        key: a PRNG key; the same one may drive the run.
        box: one side or three [length].
        density: beads per volume; or give ``n``.
        n: number of beads, instead of the density or as one count per species.
        start: ``"random"`` or ``"lattice"`` (simple cubic, filled evenly).
        fractions: share of each species, equal by default.
        skin: margin of the neighbour lists [length]; by default the cheapest for ``dt`` that the
            box has room for.
        dt: time step the skin is chosen for [time]; by default that of :func:`dpdjax.suggest_dt`.
        sheared: leave room in the lists for a tilted box.

    Returns a :class:`dpdjax.State`; works under ``vmap`` over ``key``, of points.

    Raises:
        ValueError: a box below ``2 (reach + skin)``, density x volume below 2, counts
            and box that disagree.
        TypeError: no key.

    Example:
        >>> dpd.initial_state(water, key, box=4.0, density=3.0)
        State(192 beads, box 4 x 4 x 4, step 0, time 0)
        >>> dpd.initial_state(water, key, box=[4.0, 4.0, 4.0], n=192, start="lattice")
        State(192 beads, box 4 x 4 x 4, step 0, time 0)
        >>> dpd.initial_state(water, key, box=1.5, density=3.0)
        Traceback (most recent call last):
            ...
        ValueError: box side 1.5 is below 2 (reach + skin) = ...
    """
    key = prng_key(key)
    if key.ndim:
        raise ValueError(
            f"{key.size} keys for one state; use jax.vmap(lambda key: dpd.initial_state(fluid, "
            "key, ...))(keys)"
        )
    if is_concrete(fluid) and (jnp.ndim(fluid.kT) or jnp.ndim(fluid.mass) > 1):
        raise ValueError(
            "kT or mass of the fluid is a batch, and one state has one temperature: build the "
            "state with one fluid, and give the batch to the run"
        )
    truth(sheared, "sheared")
    skin = None if skin is None else plain(skin, "skin", not_negative)
    choice(start, ("random", "lattice"), "start")
    box = boxes.box(box)
    if not is_concrete(box):
        raise ValueError(
            "the box of initial_state must be known when tracing: build the state outside jit"
        )
    if not is_concrete(fluid):
        raise ValueError(
            "initial_state needs plain numbers to lay out its lists: build the state with one "
            "fluid outside vmap or grad, then scan or differentiate the run"
        )
    counts = _counts(fluid, np.asarray(box.lengths, float), density, n, fractions)
    soundness.check_laws(fluid)
    # Planned first: what a box is too small for is told before anything is placed in it.
    grids = plan_lists(fluid, box, counts, skin=skin, dt=dt, sheared=sheared)
    radii = start_radii(fluid) if start == "random" else np.zeros(fluid.species)
    position = (
        _spheres_and_points(fluid, key, box, counts, radii)
        if radii.any()
        else _positions(start, key, box, sum(counts))
    )
    return placed(fluid, key, box, position, counts, grids)


def plan_lists(
    fluid: Fluid, box: boxes.Box, counts, *, size=None, skin=None, dt=None, sheared=True
) -> tuple[lists.Grid, ...]:
    """The grid of each interaction's list for ``counts`` beads of each species in turn; arguments
    as in :func:`initial_state`.

    ``size`` (n,): relative sizes of the beads. Raises ValueError for a box below
    ``2 (reach + skin)``.
    """
    species, size = _in_turn(counts, size)
    lengths = np.asarray(box.lengths, float)
    dt = suggest_dt(fluid, np.asarray(counts) / lengths.prod()) if dt is None else dt
    reaches = fluid.reaches([size[species == k].max(initial=1.0) for k in range(len(counts))])
    if skin is None:
        room = 0.5 * float(boxes.narrowest(lengths, sheared).min())
        skins = _fitting(suggest_skins(fluid, dt, counts, lengths.prod()), reaches, room)
    else:
        skins = [float(not_negative(skin, "skin"))]
    return _grids(fluid, lengths, counts, reaches, skins, sheared)


def placed(
    fluid: Fluid, key, box: boxes.Box, position, counts, grids: tuple[lists.Grid, ...], *, size=None
) -> State:
    """A state of beads at given positions (n, 3), ``counts`` of each species in turn, with lists on
    ``grids``.

    ``size`` (n,): relative sizes of the beads.
    """
    species, size = _in_turn(counts, size)
    species, size = jnp.asarray(species, jnp.int32), jnp.asarray(size, box.lengths.dtype)
    velocity = _velocities(key, fluid.mass[species] * size**3, fluid.kT)
    rotation = _rotation(fluid, key, counts, species, size) if fluid.rotating else None
    return assemble(box, position, velocity, species, grids, size, fluid.origins, rotation)


def _in_turn(counts, size):
    """Species and relative sizes (n,) of beads that lie together by species."""
    species = np.repeat(np.arange(len(counts)), counts)
    return species, np.ones(len(species)) if size is None else np.asarray(size, float)


def _fitting(skins, reaches, room: float) -> list[float]:
    """Skins that keep reach and skin within ``room``, down to the least one."""
    return [min(skin, max(room - reach, LEAST_SKIN * reach)) for skin, reach in zip(skins, reaches)]


def _rotation(fluid, key, counts, species, size) -> Rotation:
    """Maxwell angular velocities for the species that rotate."""
    edges = np.concatenate([[0], np.cumsum(counts)])
    slots = slice(int(edges[fluid.rotating[0]]), int(edges[fluid.rotating[-1] + 1]))
    inertia = inertia_of(fluid, species[slots], size[slots])
    draw = jax.random.normal(
        jax.random.fold_in(key, Domain.SPIN), (len(inertia), 3), dtype=inertia.dtype
    )
    return Rotation.of(draw * jnp.sqrt(fluid.kT / inertia)[:, None], slots.start)


def _grids(fluid, lengths, counts, reaches, skins, sheared) -> tuple[lists.Grid, ...]:
    """A grid for the list of each interaction; one skin is that of all."""
    edges = np.concatenate([[0], np.cumsum(counts)])
    skins = skins * len(reaches) if len(skins) == 1 else skins
    grids = []
    for interaction, reach, skin in zip(fluid.interactions, reaches, skins):
        groups = tuple(
            (int(edges[group[0]]), int(edges[group[-1] + 1])) for group in interaction.groups
        )
        for group, (begin, end) in zip(interaction.groups, groups):
            if begin == end:
                raise ValueError(
                    f"there is no bead of species {group}, and the fluid has an interaction for it"
                )
        gather = groups[0] == groups[1] and all(
            fluid.radius[k] is not None for k in interaction.groups[0]
        )
        room = {"room": CLUSTERING} if gather else {}
        grids.append(lists.plan_grid(groups, lengths, reach, skin, sheared, **room))
    return tuple(grids)


def _counts(fluid, lengths, density, n, fractions):
    if (density is None) == (n is None):
        raise ValueError(
            "give either density=... or n=... (beads in all, or one count per species)"
        )
    if n is not None and np.ndim(n) == 1:
        counts = [whole(c, "n", least=0) for c in n]
    else:
        total = round(beads_in(lengths, density)) if n is None else whole(n, "n")
        counts = _shares(total, fluid.species, fractions)
    if len(counts) != fluid.species:
        raise ValueError(f"{len(counts)} counts for a fluid of {fluid.species} species")
    if sum(counts) < 2:
        raise ValueError(
            f"density x volume is {sum(counts)} beads; a fluid needs at least 2: use a larger box"
        )
    return counts


def beads_in(lengths, density) -> float:
    """Beads in a box; ValueError for more than can be counted."""
    with np.errstate(over="ignore"):
        total = plain(density, "density", positive) * float(np.prod(lengths))
    if not total < MOST_BEADS:
        raise ValueError(f"box and density make {total:.3g} beads; give a smaller box or density")
    return total


def _shares(total, species, fractions):
    shares = np.full(species, 1 / species) if fractions is None else np.asarray(fractions, float)
    if len(shares) != species or not np.isclose(shares.sum(), 1) or np.any(shares < 0):
        raise ValueError(f"fractions {fractions} must be {species} shares that add up to 1")
    edges = np.round(np.cumsum(shares) * total).astype(int)
    return [int(c) for c in np.diff(edges, prepend=0)]


def _positions(start, key, box, n):
    if start == "random":
        u = jax.random.uniform(
            jax.random.fold_in(key, Domain.POSITION), (n, 3), dtype=box.lengths.dtype
        )
        return u * box.lengths[None]
    return jnp.asarray(_lattice(n, np.asarray(box.lengths, float)), box.lengths.dtype)


def _spheres_and_points(fluid, key, box, counts, radii):
    """Positions (n, 3) in the order of the species, none closer than the radii (species,) allow."""
    if not is_concrete(key):
        raise ValueError(
            "spheres are packed outside jit and vmap: build such states one by one, and stack them"
        )
    try:
        return jnp.asarray(packing.arrange(key, box, np.repeat(radii, counts)))
    except (ValueError, RuntimeError) as error:
        grown = [
            f"{2 * R:.3g}"
            for R, real in zip(radii, fluid.radius)
            if R > (0.0 if real is None else float(real))
        ]
        if not grown:
            raise
        raise type(error)(
            f"a potential of this fluid diverges, so beads start at least {', '.join(grown)} "
            "apart, where it is "
            f"{START_ENERGY:g} kT, and at random they do not fit: use a lower density, or "
            f'start="lattice" ({error})'
        ) from error


def _lattice(n, lengths):
    """n sites of a simple cubic lattice that fills the box, chosen evenly where there are more."""
    spacing = (lengths.prod() / n) ** (1 / 3)
    sites = np.maximum(1, np.round(lengths / spacing)).astype(int)
    while sites.prod() < n:
        sites[np.argmax(lengths / sites)] += 1
    chosen = np.floor(np.arange(n) * sites.prod() / n).astype(int)
    return (np.stack(np.unravel_index(chosen, sites), 1) + 0.5) / sites * lengths


def _velocities(key, mass, kT):
    """Maxwell velocities, shifted to zero momentum.

    In programs of their own: fused, they would be rounded by the number of threads.
    """
    velocity = _maxwell(key, mass, kT)
    return velocity - _mean_velocity(mass, velocity)


@jax.jit
def _maxwell(key, mass, kT):
    draw = jax.random.normal(
        jax.random.fold_in(key, Domain.VELOCITY), (mass.shape[0], 3), dtype=mass.dtype
    )
    return draw * jnp.sqrt(kT / mass)[:, None]


@jax.jit
def _mean_velocity(mass, velocity):
    return jnp.sum(mass[:, None] * velocity, axis=0, keepdims=True) / jnp.sum(mass)
