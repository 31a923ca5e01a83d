"""A fluid: which groups of beads interact by which terms, at which temperature and mass."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dpdjax.checks import Numbers, choice, is_concrete, not_negative, positive, whole
from dpdjax.errors import warn
from dpdjax.model import summary
from dpdjax.model.bonded import BEADS, Bonded, Terms, bonded, refuse_tables
from dpdjax.model.declare import CENTRAL, FRICTION, POTENTIAL, check_kind, name_of
from dpdjax.model.term import Term, Whole, check_table, coefficient, replace_coefficients, several

MOST_SPECIES = 1000
ORIGINS = ("conservative", "drag", "random")
"""Where stress comes from, unless a term has a name of its own for it."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Interaction:
    """The terms that act within a group of beads or between two; each interaction has its own list.

    Attributes:
        conservative: potentials; their energies add up.
        drag: frictions; their coefficients add up, and the noise follows from the sum.
        random: frictions the noise follows from instead, or None.
        groups: species of either group; twice the same for the pairs within one (static).

    Example:
        >>> [i.groups for i in made.fluid.interactions]
        [((0,), (0,)), ((0,), (1,)), ((1,), (1,))]
        >>> made.fluid.interactions[1].drag
        (balanced_drag(gamma=4.5, r_c=1),)
    """

    conservative: tuple[Term, ...]
    drag: tuple[Term, ...]
    random: tuple[Term, ...] | None
    groups: tuple[tuple[int, ...], tuple[int, ...]] = dataclasses.field(metadata={"static": True})

    @property
    def terms(self) -> tuple[Term, ...]:
        """All its terms, potentials, frictions and those of the noise."""
        return self.conservative + self.drag + (self.random or ())

    @property
    def is_central(self) -> bool:
        """Whether all forces act along the line of centres (static)."""
        return all(t.projector == CENTRAL for t in self.drag + (self.random or ()))

    def map_terms(self, function) -> "Interaction":
        """The same interaction with ``function(term)`` in place of every term."""
        each = lambda terms: None if terms is None else tuple(function(t) for t in terms)
        return Interaction(each(self.conservative), each(self.drag), each(self.random), self.groups)

    def reaches(self, R_i, R_j, kT) -> list:
        """Of each term the centre distance at which it ends between beads of these radii
        [length]."""
        return [t.between(R_i=R_i, R_j=R_j, kT=kT)[1] + R_i + R_j for t in self.terms]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, repr=False)
class Fluid:
    """Everything the matter is, and nothing of where it is; build it with :func:`dpdjax.fluid`.

    Every number is a leaf, so ``jax.vmap`` and ``jax.grad`` work over any of them. Printed, it
    tells each law, its numbers and its energies in kT.

    Attributes:
        interactions: one for each pair of groups that interact.
        kT: thermal energy [energy].
        mass: mass of each species, shape (species,) [mass].
        radius: of each species its radius [length], or None for points.
        inertia: of each species its moment of inertia [mass length^2], or None where it does not
            rotate.
        bonded: one for each type of bonds, of angles and of dihedrals.

    Example:
        >>> water
        Fluid(kT=1, 1 species, 0-0: soft_repulsion, central_drag)
        >>> print(water.set(gamma=9.0))
        kT 1, mass [1.]
        0-0  soft_repulsion, a 25, r_c 1: 12.5 kT at contact
        0-0  central_drag, gamma 9, r_c 1
        >>> water.coefficients, float(water.value("a"))
        (('a', 'gamma', 'r_c'), 25.0)
    """

    interactions: tuple[Interaction, ...]
    kT: Any
    mass: Any
    radius: tuple[Any, ...]
    inertia: tuple[Any, ...]
    bonded: tuple[Bonded, ...] = ()

    def __repr__(self):
        return summary.short(self)

    def __str__(self):
        return summary.full(self)

    def _repr_html_(self):
        title = f"Fluid, kT {summary.written(self.kT)}, mass {summary.written(self.mass)}"
        return summary.as_table(
            title, summary.laws_of(self), ("species", "law", "numbers", "energies")
        )

    def only(self, places: Sequence[int]) -> "Fluid":
        """The same matter with some of its interactions alone, by their places, and no bonds."""
        return dataclasses.replace(
            self, interactions=tuple(self.interactions[place] for place in places), bonded=()
        )

    @property
    def parts(self) -> tuple[Interaction | Bonded, ...]:
        """All that has terms."""
        return self.interactions + self.bonded

    @property
    def species(self) -> int:
        """Number of species."""
        return len(self.radius)

    @property
    def has_radii(self) -> bool:
        """Whether any species has a radius."""
        return any(r is not None for r in self.radius)

    @property
    def rotating(self) -> tuple[int, ...]:
        """Species that rotate."""
        return tuple(k for k, inertia in enumerate(self.inertia) if inertia is not None)

    def is_turned(self, species: int) -> bool:
        """Whether some friction turns the beads of a species; along the line of centres none
        does."""
        of_species = (i for i in self.interactions if any(species in group for group in i.groups))
        return species in self.rotating and not all(i.is_central for i in of_species)

    def reaches(self, largest=None) -> tuple[float, ...]:
        """Largest centre distance at which each interaction acts [length]; needs concrete numbers.

        ``largest``: relative size of the largest bead of each species, 1 by default.
        """
        numbers = jax.tree.map(np.asarray, self)
        largest = (1.0,) * self.species if largest is None else largest
        radius = [
            0.0 if r is None else float(np.max(r)) * float(size)
            for r, size in zip(numbers.radius, largest)
        ]
        of_group = lambda group: max(radius[k] for k in group)
        kT = np.max(numbers.kT)
        farthest = lambda i: max(float(np.max(r)) for r in i.reaches(*map(of_group, i.groups), kT))
        return tuple(map(farthest, numbers.interactions))

    @property
    def origins(self) -> tuple[str, ...]:
        """Names under which the stresses of pairs are kept."""
        labels = self.origins_of("conservative") + self.origins_of("drag")
        return tuple(dict.fromkeys((*ORIGINS, *labels)))

    def origins_of(self, kind: str) -> tuple[str, ...]:
        """Names under which the stresses of potentials (``"conservative"``) or of frictions
        (``"drag"``) are kept."""
        labels = [
            t.origin for i in self.interactions for t in getattr(i, kind) if t.origin is not None
        ]
        if kind == ORIGINS[0]:
            labels += [origin for b in self.bonded for origin in b.by_origin()]
        return tuple(dict.fromkeys((kind, *labels)))

    @property
    def coefficients(self) -> tuple[str, ...]:
        """The names of all coefficients; ``value`` has their numbers."""
        return tuple(
            sorted({name for part in self.parts for t in part.terms for name in t.coefficients})
        )

    def value(self, name: str, *, between: Sequence | str | None = None) -> Any:
        """The number called ``name``: ``kT``, ``mass``, ``inertia`` (of the species that rotate) or
        a coefficient.

        ``between``: the two species (or groups of species) whose terms are asked, or the name of a
        type of bonds. Raises TypeError for a name that no term knows, ValueError where terms
        disagree; where numbers are traced, one on which they disagree is NaN.
        """
        if between is None and name in ("kT", "mass"):
            return getattr(self, name)
        if between is None and name == "inertia" and self.rotating:
            return self.inertia[self.rotating[0]] if len(self.rotating) == 1 else self.inertia
        found = [(i, t) for i in self._between(between) for t in i.terms if name in t.coefficients]
        if not found:
            raise TypeError(_unknown(name, self, between))
        return _agreed(name, found)

    def _between(self, between) -> tuple[Interaction | Bonded, ...]:
        """The interactions of two groups, or a type of bonds by its name; all by default.
        ValueError where there is none."""
        if between is None:
            return self.parts
        wanted = between if isinstance(between, str) else _groups(between)
        chosen = tuple(part for part in self.parts if _called(part) == wanted)
        if not chosen:
            what = "type of bond" if isinstance(between, str) else "interaction between"
            raise ValueError(
                f"no {what} {between!r}; there are "
                f"{', '.join(str(_called(part)) for part in self.parts)}"
            )
        return chosen

    def batch_axes(self) -> "Fluid":
        """The ``in_axes`` of this fluid for ``jax.vmap``: 0 for numbers that carry a batch.

        Coefficients are scalars or tables and masses vectors, so one more axis is a batch.
        """

        def axes(t: Term) -> Term:
            coefficients = {k: _batch_axis(c) for k, c in t.coefficients.items()}
            return dataclasses.replace(t, coefficients=coefficients, cut=None)

        one_more = lambda value, least: 0 if jnp.ndim(value) == least + 1 else None
        of_each = lambda values: tuple(None if x is None else one_more(x, 0) for x in values)
        return Fluid(
            tuple(i.map_terms(axes) for i in self.interactions),
            one_more(self.kT, 0),
            one_more(self.mass, 1),
            of_each(self.radius),
            of_each(self.inertia),
            tuple(b.map_terms(axes) for b in self.bonded),
        )

    @property
    def is_batch(self) -> bool:
        """Whether any number carries a batch axis."""
        return bool(jax.tree.leaves(self.batch_axes()))

    def set(
        self, *, between: Sequence | str | None = None, energies: str | None = None, **numbers
    ) -> "Fluid":
        """A copy with new numbers, fluid-wide: every term that has the coefficient takes it.

        ``between``: the two species (or groups of species) whose terms alone take them, or the
        name of a type of bonds. ``kT``, ``mass`` and ``inertia`` are set the same way, of the whole
        fluid; ``inertia`` of all species that rotate, which a new mass leaves as it is. Raises
        TypeError for a name that no term knows, ValueError for a value that no fluid can have.

        ``energies``: what a new ``kT`` does to the potentials. ``"keep"`` leaves their coefficients
        as they are, so that a repulsion of 25 kT is one of 250 at a tenth of kT; ``"scale"`` keeps
        them the same in kT, for laws that declare what they are ``dpd.laws.proportional_to``. A
        plain new ``kT`` alone keeps them with a warning; a scan, a traced number, or zero keeps
        them without.
        """
        choice(energies, ("keep", "scale", None), "energies")
        if energies == "scale" and "kT" not in numbers:
            raise ValueError('energies="scale" goes with a new kT, and none is given')
        chosen = self._between(between)
        known = {name for i in chosen for t in i.terms for name in t.coefficients}
        for name in numbers:
            if name not in known and (between is not None or name not in self._own_numbers):
                raise TypeError(_unknown(name, self, between))
        given = set(numbers)
        kT = not_negative(numbers.pop("kT"), "kT") if "kT" in numbers else self.kT
        if energies is None and "kT" in given:
            _warn_of_energies(self, kT, given)
        mass = _masses(numbers.pop("mass"), self.species) if "mass" in numbers else self.mass
        of_rotating = positive(numbers.pop("inertia"), "inertia") if "inertia" in numbers else None
        inertia = tuple(
            old if old is None or of_rotating is None else of_rotating for old in self.inertia
        )
        for name, value in numbers.items():
            check_table(name, coefficient(value, name, *_wholes(chosen, name)), self.species)
        if between is None:
            _refuse_several_kinds(self.bonded, given)
        named = [_called(part) for part in chosen]
        take = lambda t: replace_coefficients(t, numbers)
        changed = lambda part: part.map_terms(take) if _called(part) in named else part
        old = _scaled(self, kT, given) if energies == "scale" else self
        interactions, bonds = (tuple(map(changed, p)) for p in (old.interactions, old.bonded))
        for b in bonds:
            refuse_tables(b)
        return Fluid(interactions, kT, mass, self.radius, inertia, bonds)

    @property
    def _own_numbers(self) -> tuple[str, ...]:
        return ("kT", "mass", "inertia") if self.rotating else ("kT", "mass")


def interaction(
    between: Sequence,
    conservative: Term | Sequence[Term] = (),
    drag: Term | Sequence[Term] = (),
    random: Term | Sequence[Term] | None = None,
) -> Interaction:
    """What acts between two groups of beads, or within one.

    Args:
        between: the two groups, each a species or several that follow one another: ``(0, 1)``,
            ``((0, 1), 2)``; twice the same for the pairs within a group.
        conservative: potentials of the gap between the surfaces.
        drag: frictions.
        random: frictions from which the noise follows; by default those of ``drag``, which keeps
            the temperature. Give others only to reproduce what was computed with them.

    Raises ValueError for groups that overlap, without any term, or for a law that declares itself
    of the other kind; TypeError for what is not a term.

    Example:
        >>> soft = dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)
        >>> drag = dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)
        >>> dpd.fluid(kT=1.0, interactions=[dpd.interaction((0, 0), soft, drag),
        ...                                 dpd.interaction((0, 1), soft)])
        Fluid(kT=1, 2 species, 0-0: soft_repulsion, central_drag; 0-1: soft_repulsion)
    """
    given = {"conservative": conservative, "drag": drag, "random": () if random is None else random}
    parts = [tuple(several(terms, name)) for name, terms in given.items()]
    for terms, kind in zip(parts, (POTENTIAL, FRICTION, FRICTION)):
        for t in terms:
            check_kind(t.law, kind)
    for t in (t for terms in parts for t in terms):
        if not t.is_bounded:
            name = name_of(t.law)
            raise ValueError(
                f"{name} has no coefficient r_c: say where it ends, dpd.term({name}, reach=...)"
            )
    for t in parts[0]:
        if t.projector != CENTRAL:
            raise ValueError(
                f"{t.law.__name__} is {t.projector}, and the force of a potential is central: give "
                "it as a drag"
            )
    if not parts[0] + parts[1]:
        raise ValueError(
            "a fluid without terms does nothing; give conservative=[...] or drag=[...]"
        )
    return Interaction(parts[0], parts[1], None if random is None else parts[2], _groups(between))


def fluid(
    conservative: Sequence[Term] = (),
    drag: Sequence[Term] = (),
    *,
    kT: ArrayLike,
    mass: Numbers = 1.0,
    radius: Any = None,
    inertia: Any = None,
    species: int | None = None,
    interactions: Sequence[Interaction] = (),
    bonds: Terms = (),
    angles: Terms = (),
    dihedrals: Terms = (),
) -> Fluid:
    """A fluid of one group of beads, of one or several species, or of several groups.

    Args:
        conservative: potentials between all beads, e.g. ``[dpd.term(dpd.soft_repulsion, a=25.0,
            r_c=1.0)]``.
        drag: frictions between all beads, e.g. ``[dpd.term(dpd.central_drag, gamma=4.5,
            r_c=1.0)]``.
        kT: thermal energy [energy], zero or above.
        mass: bead mass, a number or one for each species [mass].
        radius: of each species, None for points [length]; laws see the gap between the surfaces.
        inertia: of each species its moment of inertia [mass length^2], None where it does not
            rotate. What rotates has a radius; frictions that are not central turn it.
        species: how many; read off the tables, ``mass`` and ``radius`` where not given.
        interactions: of several groups, each with its own terms and its own list of neighbours, in
            place of ``conservative`` and ``drag``; from :func:`dpdjax.interaction`.
        bonds, angles, dihedrals: what acts along them, e.g. ``bonds=dpd.term(
            dpd.laws.harmonic_bond, k=4.0)``; of several types by name, ``bonds={"AA": ..., "AB":
            ...}``. Which beads they are of is the state's, ``state.bonded({"AA": pairs, ...})``.

    Returns a :class:`dpdjax.Fluid`.

    Raises:
        ValueError: negative ``kT`` or ``gamma``, mass, radius or inertia not above zero, tables of
            different size, groups that overlap in part, no term at all, points that rotate, two
            types of bonds of one name.
        TypeError: something that is not a term.

    Example:
        >>> repulsion = dpd.term(dpd.soft_repulsion, a=[[25.0, 40.0], [40.0, 25.0]], r_c=1.0)
        >>> drag = dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)
        >>> oil_and_water = dpd.fluid(conservative=[repulsion], drag=[drag], kT=1.0)
        >>> oil_and_water
        Fluid(kT=1, 2 species, (0, 1)-(0, 1): soft_repulsion, central_drag)
    """
    given = zip(BEADS, (bonds, angles, dihedrals))
    types = tuple(b for kind, terms in given for b in bonded(kind, terms))
    interactions = tuple(interactions)
    has_own = several(conservative, "conservative") + several(drag, "drag")
    terms = [t for i in interactions for t in i.terms]
    species = None if species is None else whole(species, "species", most=MOST_SPECIES)
    if has_own or not interactions:
        if interactions:
            raise ValueError(
                "give either interactions=[...], or conservative= and drag= between all beads"
            )
        alone = interaction((0, 0), conservative, drag)
        terms = alone.terms
    groups = [k for i in interactions for group in i.groups for k in group]
    count = _count_species(terms, mass, radius, inertia, species, groups)
    if not interactions:
        everything = tuple(range(count))
        interactions = (dataclasses.replace(alone, groups=(everything, everything)),)
    _check_groups(interactions)
    _check_types(types, interactions)
    radius, inertia = _of_each(radius, count, "radius"), _of_each(inertia, count, "inertia")
    _check_rotation(radius, inertia)
    return Fluid(interactions, not_negative(kT, "kT"), _masses(mass, count), radius, inertia, types)


def _called(part: Interaction | Bonded):
    """What :meth:`Fluid.set` calls a part of a fluid: its two groups, or the name of its type."""
    return part.name if isinstance(part, Bonded) else part.groups


def _refuse_several_kinds(types: tuple[Bonded, ...], names):
    """Raise ValueError for a number that bonds have and angles too: it is not the same one."""
    for name in names:
        kinds = {b.kind: b.name for b in types for t in b.terms if name in t.coefficients}
        if len(kinds) > 1:
            told = " and ".join(f"{kind}s" for kind in kinds)
            raise ValueError(
                f"{name} is a number of {told}: say which is meant, between="
                f"{next(iter(kinds.values()))!r}"
            )


def _check_types(types: tuple[Bonded, ...], interactions):
    names = [b.name for b in types]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"two types of bonds, angles or dihedrals are called {name!r}")
    drags = {t.origin or ORIGINS[1] for i in interactions for t in i.drag}
    for origin in (origin for b in types for origin in b.by_origin()):
        if origin in drags:
            raise ValueError(
                f"the origin {origin!r} is that of a friction and of a bond: give two names"
            )


def _wholes(parts, name: str) -> list[Whole]:
    """The first coefficient of a name that some term takes whole, if any."""
    terms = [t for part in parts for t in part.terms]
    found = [t.coefficients[name] for t in terms if name in t.coefficients]
    return [c for c in found if isinstance(c, Whole)][:1]


def _times(c, factor):
    """A coefficient times a number; of what is taken whole every entry."""
    return jax.tree.map(lambda leaf: leaf * factor, c)


def _batch_axis(c):
    """0 for a coefficient that is a batch, else None: coefficients are scalars, tables or taken
    whole, so that one more axis is a batch."""
    if isinstance(c, Whole):
        ones = jax.tree.map(lambda _: 0, c.value)
        return dataclasses.replace(c, value=ones) if c.is_batch else None
    return 0 if jnp.ndim(c) in (1, 3) else None


def _groups(between) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Both groups as tuples of species, the lower first."""
    if not hasattr(between, "__len__") or len(between) != 2:
        raise ValueError(f"between is {between}; give two species, or two groups of species")
    first, second = sorted(
        (int(k),) if np.ndim(k) == 0 else tuple(int(s) for s in k) for k in between
    )
    for group in (first, second):
        if not group or group != tuple(range(group[0], group[-1] + 1)):
            raise ValueError(f"{group} is no group: give species that follow one another")
    if first != second and set(first) & set(second):
        raise ValueError(
            f"the groups {first} and {second} share a species: make them equal, or apart"
        )
    return first, second


def _check_groups(interactions):
    labels = [
        {t.origin for i in interactions for t in getattr(i, kind)} - {None} for kind in ORIGINS[:2]
    ]
    if labels[0] & labels[1]:
        raise ValueError(
            f"the origin {', '.join(labels[0] & labels[1])} is that of a potential and of a "
            "friction: give two names"
        )
    seen = set()
    for i in interactions:
        if i.groups in seen:
            raise ValueError(f"two interactions between {i.groups}: give all their terms to one")
        seen.add(i.groups)


def _warn_of_energies(fluid, kT, given):
    """Tell once for each place in a program that potentials stay while kT changes, where neither is
    said."""
    strengths = {name for t in _potentials(fluid) for name in t.coefficients}
    if (
        not strengths
        or strengths & given
        or not is_concrete(kT, fluid.kT)
        or jnp.ndim(kT)
        or not np.all(np.asarray(kT) > 0)
    ):
        return
    if not np.array_equal(kT, fluid.kT):
        warn(
            f"kT is now {float(kT):.9g} and was {float(fluid.kT):.9g}, and potentials keep their "
            "coefficients, "
            'so that they are others in kT: say energies="keep" if that is meant, '
            'energies="scale" to keep them the same in kT',
        )


def _potentials(fluid) -> list[Term]:
    pairs = [t for i in fluid.interactions for t in i.conservative]
    return pairs + [t for b in fluid.bonded for t in b.terms]


def _scaled(fluid, kT, given) -> Fluid:
    """The fluid with every potential scaled by the new kT over the old one."""
    if is_concrete(fluid.kT) and not np.all(np.asarray(fluid.kT) > 0):
        raise ValueError(
            'kT was 0, and energies="scale" has nothing to scale by: set the coefficients'
        )

    def scaled(t: Term) -> Term:
        name = getattr(t.law, "strength", None)
        if name is None and not given & set(t.coefficients):
            raise ValueError(
                f"{name_of(t.law)} does not say which coefficient it is proportional to: mark it "
                "with "
                '@dpd.laws.proportional_to("..."), or give that coefficient beside kT'
            )
        return (
            t
            if name not in t.coefficients
            else replace_coefficients(t, {name: _times(t.coefficients[name], kT / fluid.kT)})
        )

    return dataclasses.replace(
        fluid,
        interactions=tuple(
            dataclasses.replace(i, conservative=tuple(map(scaled, i.conservative)))
            for i in fluid.interactions
        ),
        bonded=tuple(b.map_terms(scaled) for b in fluid.bonded),
    )


def _masses(mass, species):
    mass = positive(mass, "mass")
    if mass.ndim > 1 or (mass.ndim == 1 and mass.shape[0] != species):
        raise ValueError(
            f"mass has shape {mass.shape}; give a number or {species} of them, one for each species"
        )
    return jnp.broadcast_to(mass, (species,))


def _of_each(values, species, name) -> tuple:
    """A tuple with one entry for each species: its number, or None where it has none."""
    each = tuple(values) if isinstance(values, (tuple, list)) else (values,) * species
    return tuple(None if x is None else positive(x, name) for x in each)


def _check_rotation(radius, inertia):
    rotating = [k for k, x in enumerate(inertia) if x is not None]
    if rotating and rotating != list(range(rotating[0], rotating[-1] + 1)):
        raise ValueError(
            f"the species {rotating} rotate; give inertia to species that follow one another"
        )
    for k in rotating:
        if radius[k] is None:
            raise ValueError(
                f"species {k} has an inertia and no radius: a point does not rotate; give it a "
                "radius"
            )


def _count_species(terms, mass, radius, inertia, species, groups):
    sizes = {
        value.shape[0]: name
        for t in terms
        for name, value in t.coefficients.items()
        if not isinstance(value, Whole) and value.ndim == 2
    }
    if np.ndim(mass) == 1:
        sizes.setdefault(np.shape(mass)[0], "mass")
    for name, values in (("radius", radius), ("inertia", inertia)):
        if isinstance(values, (tuple, list)):
            sizes.setdefault(len(values), name)
    if groups:
        sizes.setdefault(max(groups) + 1, "the interactions")
    if species is not None:
        sizes.setdefault(species, "species")
    if len(sizes) > 1:
        raise ValueError(
            "numbers of species disagree: " + ", ".join(f"{n} has {k}" for k, n in sizes.items())
        )
    return next(iter(sizes), 1)


def _agreed(name, found):
    """The number of terms ``found``, (interaction, term) each, that have to agree on it."""
    values = [t.coefficients[name] for _, t in found]
    first = values[0]
    if all(v is first for v in values):
        return first.value if isinstance(first, Whole) else first
    if any(isinstance(v, Whole) for v in values):
        raise ValueError(
            f"several terms take {name!r} whole, or some do; ask for one of them, "
            f"fluid.value({name!r}, between=(0, 0))"
        )
    alike = all(jnp.shape(v) == jnp.shape(first) for v in values)
    if alike and not is_concrete(values):
        same = jnp.all(jnp.stack([jnp.all(v == first) for v in values]))
        return first * jnp.where(same, 1.0, jnp.nan).astype(first.dtype)
    if alike and all(np.array_equal(v, first) for v in values):
        return first
    told = "; ".join(
        f"{_shown(v)} of {name_of(t.law)} between {_called(part)}"
        for v, (part, t) in zip(values, found)
    )
    raise ValueError(
        f"the terms of this fluid disagree on {name!r}: {told}. Ask for one, fluid.value({name!r}, "
        "between=(0, 0))"
    )


def _shown(value) -> str:
    return (
        str(np.asarray(value).tolist())
        if is_concrete(value)
        else f"a traced number of shape {jnp.shape(value)}"
    )


def _unknown(name, fluid, between=None):
    if between is None:
        return (
            f"no term of this fluid has {name!r}; it has "
            f"{', '.join((*fluid._own_numbers, *fluid.coefficients))}"
        )
    known = sorted(
        {k for part in fluid._between(between) for t in part.terms for k in t.coefficients}
    )
    return f"no term between {between} has {name!r}; they have {', '.join(known)}"
