"""Chains, rings, stars and lipids to start from, in a solvent or as a melt."""

import dataclasses
import math
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dpdjax.checks import Numbers, choice, plain, positive, prng_key, whole
from dpdjax.engine.choice import suited
from dpdjax.engine.integrator import Integrator
from dpdjax.engine.refusals import check_bonds
from dpdjax.engine.state import State
from dpdjax.errors import warn
from dpdjax.model import bonded_laws, laws
from dpdjax.model.bonded import Terms
from dpdjax.model.fluid import Fluid, fluid
from dpdjax.model.rates import extreme, thermal_length
from dpdjax.model.summary import as_table
from dpdjax.model.term import term
from dpdjax.pairs import box as boxes
from dpdjax.pairs.noise import Domain
from dpdjax.prepare import layout
from dpdjax.prepare.mixture import Order, counted, letters_of, of_letters, of_types, table
from dpdjax.prepare.push_off import pushed_off
from dpdjax.prepare.start import placed, plan_lists

ARRANGEMENTS = ("random", "bilayer", "lamella")
AXES = {"x": 0, "y": 1, "z": 2}
ROOMY = 14.0
"""Sides of a box, in roots of the mean square of a component of a bond, in which no bond becomes
as long as half a side."""
LAYERED = 0.9
"""Bonds of a molecule of a bilayer over the length that its beads take along the normal."""


@dataclasses.dataclass(frozen=True, repr=False)
class Molecules:
    """A fluid with molecules and a state of it; prints what it is made of.

    Attributes:
        fluid: the fluid.
        state: where the beads are, and which are bonded.
        dt: a time step that suits it [time], under this integrator:
        integrator: what is to move it, ``dpd.run(..., integrator=made.integrator)``.
        species: the number of each species by its letter.
        ids: of each kind of molecule, by its word, the ids of its beads in the order of the word,
            (molecules, beads).
    """

    fluid: Fluid
    state: State
    dt: float
    integrator: Integrator
    species: dict[str, int]
    ids: dict[str, np.ndarray]

    def __str__(self):
        sides = " x ".join(f"{side:g}" for side in np.asarray(self.state.box.lengths))
        kinds = ", ".join(f"{len(rows)} of {word}" for word, rows in self.ids.items())
        letters = ", ".join(f"{letter} is species {k}" for letter, k in self.species.items())
        counts = ", ".join(f"{v} {k}" for k, v in self.state.topology.counts.items()) or "no bonds"
        return "\n".join(
            [
                f"{self.state.n} beads in {sides}: {kinds}; {letters}",
                f"{counts}; dt {self.dt:.3g} by {self.integrator}",
                str(self.fluid),
            ]
        )

    __repr__ = __str__

    def _repr_html_(self):
        return as_table("Molecules", [(line,) for line in str(self).split("\n")])


def molecules(
    key: jax.Array,
    amounts: str | Mapping[str, float],
    *,
    box: Numbers,
    density: float | None = None,
    a: ArrayLike | Mapping[str, float] | None = None,
    gamma: ArrayLike | Mapping[str, float] = 4.5,
    kT: ArrayLike = 1.0,
    mass: ArrayLike | Mapping[str, float] = 1.0,
    r_c: float = 1.0,
    bonds: Terms | None = None,
    angles: Terms = (),
    dihedrals: Terms = (),
    exclude: int = 0,
    arrangement: str | Mapping[str, str] = "random",
    axis: str = "z",
    periods: int = 1,
    integrator: Integrator | None = None,
    dt: float | None = None,
    skin: float | None = None,
    sheared: bool = True,
    report: Callable[[str], None] | None = print,
) -> Molecules:
    """Molecules in a box, placed at random or as bilayers and pushed apart.

    Args:
        key: a PRNG key; the same one may drive the run.
        amounts: of each molecule, as a word, its share of the beads (floats that add up to 1) or
            how many there are (integers); a word alone for nothing else. ``"A5B5"`` is a chain,
            ``"H3(T4)2"`` has two branches at its third bead, ``"A(B10)4"`` is a star, ``"[AB]5"``
            repeats, ``"cyclo-A20"`` is a ring, ``"W"`` a bead by itself.
        box: one side or three [length].
        density: beads per volume, 3/r_c^3 by default; not given with numbers of molecules.
        a: repulsion of every two beads [energy / length], a number, or one for each pair of
            species, ``{"AA": 25, "AB": 40, "BB": 25}``; ``"*"`` is for all that is not named. By
            default 25 kT/r_c, so it follows ``kT``.
        gamma: friction likewise [mass / time].
        kT, r_c: thermal energy, and reach of both.
        mass: of a bead, or of each species by its letter.
        bonds: terms of a bond, by default a spring of k = 4 kT/r_c^2 and no length (Groot & Warren
            1997); or by the species it is between, ``{"AA": ..., "AB": ...}``, ``"*"`` for all that
            is not named. In the fluid types have these names, and that of all others is ``"bond"``.
        angles, dihedrals: likewise, of three and four beads one after another, ``{"TTT":
            dpd.term(dpd.laws.cosine_angle, k=20.0)}``. Terms by themselves are for all that there
            are along the chain and out along its branches; of those by name, ones that no name fits
            have none.
        exclude: pairs up to so many bonds apart do not act on each other as pairs; none by default.
        arrangement: ``"random"`` walks; ``"bilayer"``, first beads outside, with the molecules of
            one bead outside it; ``"lamella"``, bilayers that fill the box. Of all molecules, or of
            each by its word, the others at random.
        axis, periods: the normal of the bilayers, and how many there are.
        integrator, dt, skin, sheared: as for :func:`dpdjax.suspension`.
        report: told what was made; None for silence.

    Raises:
        ValueError: a word that is none, shares that do not add up to 1, pairs without a number,
            names of bonds that no molecule has, a box too small for the lists.
        TypeError: amounts or terms of another kind.

    Example:
        >>> melt = dpd.molecules(key, "A5", box=7.0, report=None)
        >>> melt.ids["A5"].shape, melt.species
        ((206, 5), {'A': 0})
        >>> melt.state
        State(1030 beads, 824 bond, box 7 x 7 x 7, step 0, time 0)
    """
    key = prng_key(key)
    lengths = np.broadcast_to(np.asarray(positive(box, "box"), float), (3,))
    r_c = plain(r_c, "r_c", positive)
    kinds, counts = counted(amounts, lengths, density, r_c)
    letters = {letter: k for k, letter in enumerate(letters_of(kinds))}
    a = 25.0 * positive(kT, "kT", "or give a=") / r_c if a is None else a
    given = {"bond": _springs(kT, r_c) if bonds is None else bonds}
    given |= {"angle": angles, "dihedral": dihedrals}
    given = {kind: of_types(kind, terms, kinds) for kind, terms in given.items()}
    made = fluid(
        [term(laws.soft_repulsion, a=table(a, letters, "a"), r_c=r_c)],
        [term(laws.central_drag, gamma=table(gamma, letters, "gamma"), r_c=r_c)],
        kT=kT,
        mass=of_letters(mass, letters),
        species=len(letters),
        **{f"{kind}s": terms for kind, terms in given.items()},
    )
    order = Order.of(kinds, counts, letters)
    density = sum(order.counts) / float(np.prod(lengths))
    _warn_of_short_sides(made, lengths)
    integrator, dt = suited(made, density, integrator=integrator, dt=dt)
    space = boxes.box(lengths)
    grids = plan_lists(made, space, order.counts, skin=skin, dt=dt, sheared=sheared)
    how = _arrangements(arrangement, kinds), AXES[choice(axis, AXES, "axis")]
    position = _positions(key, made, kinds, counts, lengths, *how, whole(periods, "periods"))
    position = jnp.asarray(position[order.by_species], space.lengths.dtype)
    state = placed(made, key, space, position, order.counts, grids)
    # Images that make molecules whole: unwrapped positions are those they were laid out at.
    state = dataclasses.replace(state, image=boxes.wrap(space, position)[1])
    state = state.bonded(order.groups(made, kinds), exclude=exclude)
    _refuse_wrapped(made, state)
    check_bonds(made, state)
    state = pushed_off(made, state, key)
    found = Molecules(made, state, float(dt), integrator, letters, order.ids)
    if report is not None:
        report(str(found))
    return found


def _warn_of_short_sides(made: Fluid, lengths):
    """Warn of a box in which bonds reach half a side by chance, which ends a run."""
    numbers = extreme(made)
    longest = max([thermal_length(numbers, b) for b in numbers.bonded if b.kind == "bond"] or [0.0])
    least = ROOMY * longest / math.sqrt(3.0)
    if min(lengths) < least:
        warn(
            f"bonds {longest:.2g} long on average reach half of a side of {min(lengths):.3g} now "
            f"and then, and a run ends there: use sides of {_up(least):g} or more, or stiffer "
            "bonds",
        )


def _up(length: float) -> float:
    """Rounded up to two digits: advice that is as good as it says."""
    digit = 10.0 ** (math.floor(math.log10(length)) - 1)
    return math.ceil(length / digit - 1e-9) * digit


def _refuse_wrapped(made: Fluid, state: State):
    """Raise ValueError where a bond was laid out longer than half a side: it would be one with
    another image of the bead, and molecules would be closed around the box without a word."""
    if any(np.any(np.asarray(sides)) for sides in state.topology.sides.values()):
        raise ValueError(
            f"bonds start {_step(made):.3g} long, more than half of a side of the box, "
            f"{float(np.min(np.asarray(state.box.lengths))):.3g}: give a larger box, or shorter "
            "bonds"
        )


def _springs(kT, r_c):
    """The bonds of Groot & Warren (1997): springs of 4 kT/r_c^2 and no length."""
    kT = positive(kT, "kT", "bonds follow it, or give bonds=")
    return term(bonded_laws.harmonic_bond, k=4.0 * np.asarray(kT, float) / r_c**2)


def _arrangements(given, kinds) -> list[str]:
    """How each molecule is placed; single beads never in layers."""
    words = [kind.word for kind in kinds]
    if isinstance(given, Mapping):
        unknown = sorted(set(given) - set(words))
        if unknown:
            raise ValueError(
                f"arrangement names {unknown[0]!r}; the molecules are {', '.join(words)}"
            )
        return [choice(given.get(word, "random"), ARRANGEMENTS, "arrangement") for word in words]
    choice(given, ARRANGEMENTS, "arrangement")
    return ["random" if kind.n == 1 else given for kind in kinds]


def _positions(key, made: Fluid, kinds, counts, lengths, how, axis: int, periods: int):
    """Positions (n, 3), molecule after molecule."""
    seed = jax.random.bits(jax.random.fold_in(key, Domain.CHAINS), (4,), np.uint32)
    draw = np.random.default_rng(np.asarray(seed).tolist())
    step = _step(made)
    period = lengths[axis] / periods
    thickness = max(
        [
            2 * LAYERED * step * (kind.depth().max() + 1)
            for kind, h in zip(kinds, how)
            if h == "bilayer"
        ],
        default=0.0,
    )
    thickness = min(thickness, period)
    middles = (np.arange(periods) + 0.5) * period
    taken = [(m - 0.5 * thickness, m + 0.5 * thickness) for m in middles] if thickness else []
    rows = []
    for kind, count, arranged in zip(kinds, counts, how):
        if arranged == "random":
            alone = kind.n == 1 and bool(taken)
            given = draw, count, lengths, axis, taken
            x = (
                layout.outside(*given)[:, None]
                if alone
                else layout.walks(draw, kind, count, lengths, step)
            )
        else:
            size = thickness if arranged == "bilayer" else None
            x = layout.layers(draw, kind, count, lengths, step, axis, periods, size)
        rows.append(x.reshape(-1, 3))
    return np.concatenate(rows)


def _step(made: Fluid) -> float:
    """How far apart bonded beads start: the shortest thermal length of a bond."""
    numbers = extreme(made)
    each = [thermal_length(numbers, b) for b in numbers.bonded if b.kind == "bond"]
    return min(each, default=1.0)
