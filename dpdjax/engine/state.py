"""The state of a run: where the beads are, and all that a bitwise restart needs."""

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.checks import is_concrete, not_negative, positive, prng_key
from dpdjax.engine import box as boxes
from dpdjax.engine import neighbours as lists
from dpdjax.model.fluid import Fluid

POSITION_DOMAIN, VELOCITY_DOMAIN = 2, 3
"""Folded into the user's key, so that one key serves start and noise."""

REBUILD_COST = 1.0
"""One rebuild in units of one force pass over the same list (measured: tests/benchmarks)."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Tally:
    """Sums over pairs from the last force pass that was asked for them.

    Attributes:
        energy: potential energy [energy].
        conservative, drag, random: sum of ``r_ij F_ij`` by origin, (3, 3) [energy].
    """

    energy: Any
    conservative: Any
    drag: Any
    random: Any

    @classmethod
    def zero(cls, dtype) -> "Tally":
        square = jnp.zeros((3, 3), dtype)
        return cls(jnp.zeros((), dtype), square, square, square)

    def __add__(self, other: "Tally") -> "Tally":
        return jax.tree.map(jnp.add, self, other)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """One configuration of n beads.

    Attributes:
        position: wrapped Cartesian positions (n, 3) [length].
        velocity: peculiar velocities, the streaming velocity taken off, (n, 3).
        force: force of the last step, on which the next half kick depends, (n, 3).
        image: how many sides each bead was carried over since the start, (n, 3) int32.
        id: what the noise of a bead is keyed by, a permutation of 0 to n - 1, (n,) int32; travels with the bead.
        species: index into the tables of the fluid, (n,) int32.
        box: lengths and strain.
        step: absolute number of the step, which keys the noise.
        time: elapsed time, which body forces may depend on.
        neighbours: one list for each interaction.
        tally: sums over pairs, for the observables.
        started: whether ``force`` is known; if not, a run computes it first.
        status: sticky bits (``dpdjax.engine.status``).
    """

    position: Any
    velocity: Any
    force: Any
    image: Any
    id: Any
    species: Any
    box: boxes.Box
    step: Any
    time: Any
    neighbours: tuple[lists.Neighbours, ...]
    tally: Tally
    started: Any
    status: Any

    @property
    def n(self) -> int:
        """Number of beads."""
        return self.position.shape[-2]

    @property
    def unwrapped(self):
        """Positions followed through the periodic images (n, 3) [length]; without shear."""
        return self.position + self.image * self.box.lengths[..., None, :]

    def restarted(self) -> "State":
        """The same beads with the force forgotten: the next run computes it from its own fluid."""
        return dataclasses.replace(self, started=jnp.zeros_like(self.started))


def initial_state(
    fluid: Fluid,
    key,
    *,
    box,
    density=None,
    n=None,
    start: str = "random",
    fractions=None,
    skin: float | None = None,
    dt: float | None = None,
    sheared: bool = True,
) -> State:
    """Beads in a box, with Maxwell velocities of zero total momentum.

    Args:
        fluid: what the beads are.
        key: a PRNG key; the same one may drive the run.
        box: one side or three [length].
        density: beads per volume; or give ``n``.
        n: number of beads, instead of the density or as one count per species.
        start: ``"random"`` or ``"lattice"`` (simple cubic, filled evenly).
        fractions: share of each species, equal by default.
        skin: margin of the neighbour lists [length]; by default the cheapest for ``dt``.
        dt: time step the skin is chosen for; by default :func:`suggest_dt`.
        sheared: leave room in the lists for a tilted box.

    Returns a :class:`State`; works under ``vmap`` over ``key``.

    Raises:
        ValueError: a box below ``2 (reach + skin)``, density x volume below 2, counts
            and box that disagree.
        TypeError: no key.
    """
    key = prng_key(key)
    if key.ndim:
        raise ValueError(f"{key.size} keys for one state; use jax.vmap(lambda key: dpd.initial_state(fluid, key, ...))(keys)")
    if is_concrete(fluid) and (jnp.ndim(fluid.kT) or jnp.ndim(fluid.mass) > 1):
        raise ValueError(
            "kT or mass of the fluid is a batch, and one state has one temperature: build the state with "
            "one fluid, and give the batch to the run"
        )
    box = boxes.box(box)
    if not is_concrete(box):
        raise ValueError("the box of initial_state must be known when tracing: build the state outside jit")
    counts = _counts(fluid, np.asarray(box.lengths, float), density, n, fractions)
    total = sum(counts)
    species = jnp.asarray(np.repeat(np.arange(len(counts)), counts), jnp.int32)
    position = _positions(start, key, box, total)
    velocity = _velocities(key, fluid.mass[species], fluid.kT)
    if skin is None:
        skin = suggest_skin(fluid, suggest_dt(fluid, total / float(np.prod(box.lengths))) if dt is None else dt)
    not_negative(skin, "skin")
    grids = tuple(
        lists.plan_grid(total, np.asarray(box.lengths), interaction.reach, _number(skin), sheared)
        for interaction in jax.tree.map(_concrete, fluid.interactions)
    )
    return assemble(box, position, velocity, species, grids)


# One program: operation by operation, a first list takes seconds to compile.
@functools.partial(jax.jit, static_argnames="grids")
def assemble(box: boxes.Box, position, velocity, species, grids: tuple[lists.Grid, ...]) -> State:
    """A state from arrays: positions (n, 3) anywhere, peculiar velocities (n, 3), species (n,)."""
    n = position.shape[0]
    position, _ = boxes.wrap(box, position)
    integers = jnp.zeros((), jnp.int32)
    return State(
        position=position,
        velocity=velocity,
        force=jnp.zeros_like(position),
        image=jnp.zeros((n, 3), jnp.int32),
        id=jnp.arange(n, dtype=jnp.int32),
        species=species,
        box=box,
        step=integers,
        time=jnp.zeros((), position.dtype),
        neighbours=tuple(lists.allocate(grid, box, position) for grid in grids),
        tally=Tally.zero(position.dtype),
        started=jnp.asarray(False),
        status=jnp.zeros((), jnp.uint32),
    )


def grow(state: State, pairs: bool = True, windows: bool = True) -> State:
    """The same state with larger lists, one or a batch.

    A complete list keeps its pairs in order, so a replay is bitwise the same; one that
    overflowed is built anew.
    """
    grown = []
    for neighbours in state.neighbours:
        grid = neighbours.grid.grown(pairs, windows)
        if np.any(np.asarray(neighbours.list.error.code)):
            build = lambda box, position: lists.allocate(grid, box, position)
            build = jax.vmap(build) if state.position.ndim == 3 else build
            grown.append(build(state.box, state.position))
        else:
            grown.append(lists.pad(neighbours, grid))
    return dataclasses.replace(state, neighbours=tuple(grown), status=jnp.zeros_like(state.status))


def suggest_dt(fluid: Fluid, density: float) -> float:
    """The time step that keeps the temperature error of velocity-Verlet below 0.5 %.

    The error is about 0.7 omega dt in an unstructured fluid, with omega the
    :func:`damping_rate`, and 0.3 to 0.4 omega dt in one that repels like water (measured:
    tests/physics/RESULTS.md). Never above a hundredth of the thermal time
    ``r_c sqrt(m / kT)``.
    """
    numbers = jax.tree.map(_concrete, fluid)
    mass, kT = float(np.min(numbers.mass)), float(numbers.kT)
    error = 0.7 / (1.0 + min(repulsion_energy(numbers, density) / max(kT, 1e-12), 16.0) / 20.0)
    rate = max(damping_rate(numbers, density), 1e-12)
    reach = min(float(np.min(np.asarray(t.reach))) for i in numbers.interactions for t in i.terms)
    return min(0.005 / (error * rate), 0.01 * reach * math.sqrt(mass / max(kT, 1e-12)))


def damping_rate(fluid: Fluid, density: float) -> float:
    """Rate at which drag damps a velocity, ``density / 3 m`` times the volume integral of zeta [1/time]."""
    total = sum(_volume_integral(t) for i in fluid.interactions for t in i.drag)
    return density * total / 3.0 / float(np.min(fluid.mass))


def repulsion_energy(fluid: Fluid, density: float) -> float:
    """Mean-field repulsion of a bead, ``density`` times the volume integral of the potentials, at least 0."""
    return max(0.0, density * sum(_volume_integral(t) for i in fluid.interactions for t in i.conservative))


def pair_frequency(fluid: Fluid) -> float:
    """Fastest oscillation of two beads, ``sqrt(2 U'' / m)``, at distances they reach with 4 kT [1/time]."""
    stiffest = 0.0
    for term in (t for i in fluid.interactions for t in i.conservative):
        r, _, law = _profile(term)
        with jax.ensure_compile_time_eval():
            h, one = jnp.asarray(r), jnp.ones(r.shape)
            slope = lambda h: jax.jvp(law, (h,), (one,))[1]
            energy, curvature = np.asarray(law(h)), np.asarray(jax.jvp(slope, (h,), (one,))[1])
        reached = energy - energy.min() <= 4.0 * float(fluid.kT)
        stiffest = max(stiffest, float(np.max(curvature[reached], initial=0.0)))
    return math.sqrt(2.0 * stiffest / float(np.min(fluid.mass)))


def _volume_integral(term) -> float:
    """Integral of a law over a sphere of its reach, by the midpoint rule."""
    r, reach, law = _profile(term)
    with jax.ensure_compile_time_eval():
        values = np.asarray(law(jnp.asarray(r)))
    return float(np.sum(4 * np.pi * r**2 * values)) * reach / r.size


def _profile(term):
    """Midpoints of 400 equal steps up to the reach of a term, the reach, and the law with its numbers put in."""
    coefficients, reach = term.between(np.max)
    reach = float(reach)
    return (np.arange(400) + 0.5) / 400 * reach, reach, lambda h: term.law(h, **coefficients)


def suggest_skin(fluid: Fluid, dt) -> float:
    """The skin that costs least: wide lists hold more pairs, narrow ones are built more often."""
    numbers = jax.tree.map(_concrete, fluid)
    reach = min(interaction.reach for interaction in numbers.interactions)
    fastest = 4.5 * math.sqrt(float(numbers.kT) / float(np.min(numbers.mass)))
    skins = np.linspace(0.02, 0.6, 59) * reach
    cost = (1 + skins / reach) ** 3 * (1 + REBUILD_COST * 2 * fastest * _number(dt) / skins)
    return float(np.round(skins[np.argmin(cost)], 3))


def _number(value) -> float:
    return float(_concrete(value))


def _concrete(value):
    """The largest value of a number that is scanned over, when the scan itself is not traced."""
    if not is_concrete(value):
        raise ValueError(
            "initial_state needs plain numbers to lay out its lists: build the state with one "
            "fluid outside vmap or grad, then scan or differentiate the run"
        )
    return np.asarray(value)


def _counts(fluid, lengths, density, n, fractions):
    if (density is None) == (n is None):
        raise ValueError("give either density=... or n=... (beads in all, or one count per species)")
    if n is not None and np.ndim(n) == 1:
        counts = [int(c) for c in n]
    else:
        total = int(round(float(positive(density, "density")) * lengths.prod())) if n is None else int(n)
        counts = _shares(total, fluid.species, fractions)
    if len(counts) != fluid.species:
        raise ValueError(f"{len(counts)} counts for a fluid of {fluid.species} species")
    if sum(counts) < 2:
        raise ValueError(f"density x volume is {sum(counts)} beads; a fluid needs at least 2: use a larger box")
    return counts


def _shares(total, species, fractions):
    shares = np.full(species, 1 / species) if fractions is None else np.asarray(fractions, float)
    if len(shares) != species or not np.isclose(shares.sum(), 1) or np.any(shares < 0):
        raise ValueError(f"fractions {fractions} must be {species} shares that add up to 1")
    edges = np.round(np.cumsum(shares) * total).astype(int)
    return [int(c) for c in np.diff(edges, prepend=0)]


def _positions(start, key, box, n):
    if start == "random":
        u = jax.random.uniform(jax.random.fold_in(key, POSITION_DOMAIN), (n, 3), dtype=box.lengths.dtype)
        return u * box.lengths[None]
    if start == "lattice":
        return jnp.asarray(_lattice(n, np.asarray(box.lengths, float)), box.lengths.dtype)
    raise ValueError(f'start is {start!r}; it is "random" or "lattice"')


def _lattice(n, lengths):
    """n sites of a simple cubic lattice that fills the box, chosen evenly where there are more."""
    spacing = (lengths.prod() / n) ** (1 / 3)
    sites = np.maximum(1, np.round(lengths / spacing)).astype(int)
    while sites.prod() < n:
        sites[np.argmax(lengths / sites)] += 1
    chosen = np.floor(np.arange(n) * sites.prod() / n).astype(int)
    return (np.stack(np.unravel_index(chosen, sites), 1) + 0.5) / sites * lengths


@jax.jit
def _velocities(key, mass, kT):
    """Maxwell velocities, shifted to zero momentum."""
    draw = jax.random.normal(jax.random.fold_in(key, VELOCITY_DOMAIN), (mass.shape[0], 3), dtype=mass.dtype)
    velocity = draw * jnp.sqrt(kT / mass)[:, None]
    return velocity - jnp.sum(mass[:, None] * velocity, axis=0, keepdims=True) / jnp.sum(mass)
