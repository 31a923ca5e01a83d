"""Which molecules there are and how many, their species and bonds, and which bead is which."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from dpdjax.checks import plain, whole
from dpdjax.model.bonded import BEADS, Bonded, Terms
from dpdjax.model.fluid import Fluid
from dpdjax.model.term import several
from dpdjax.prepare.architecture import OTHERS, Architecture, architecture, spelt, type_of
from dpdjax.prepare.start import beads_in


def counted(amounts, lengths, density, r_c) -> tuple[list[Architecture], list[int]]:
    """The molecules and how many there are of each."""
    amounts = {amounts: 1.0} if isinstance(amounts, str) else amounts
    if not isinstance(amounts, Mapping) or not amounts:
        raise TypeError(f'amounts are {amounts!r}; give {{"A5B5": 0.2, "W": 0.8}}')
    kinds, given = [architecture(word) for word in amounts], list(amounts.values())
    if all(isinstance(x, int | np.integer) and not isinstance(x, bool) for x in given):
        if density is not None:
            raise ValueError("numbers of molecules and a box make a density: leave out density=")
        return kinds, [whole(x, word, least=0) for word, x in amounts.items()]
    shares = np.array([plain(x, word) for word, x in amounts.items()])
    if np.any(shares < 0) or not np.isclose(shares.sum(), 1):
        raise ValueError(
            f"the shares {shares.tolist()} add up to {shares.sum():g}; give shares of all beads "
            "that add up to 1, or whole numbers of molecules"
        )
    beads = beads_in(lengths, 3.0 / r_c**3 if density is None else density)
    counts = _nearest(shares * beads, [kind.n for kind in kinds])
    for kind, share, count in zip(kinds, shares, counts):
        if share > 0 and not count:
            raise ValueError(
                f"{kind.word!r} has a share of {share:g}, and in this box that is no whole "
                f"molecule of {kind.n} beads: give a larger box or share, or numbers of molecules"
            )
    return kinds, counts


def _nearest(beads, sizes) -> list[int]:
    """Numbers of molecules whose beads add up as nearly as they can: the smallest molecules make
    up for what the others are rounded by."""
    counts = [round(b / n) for b, n in zip(beads, sizes)]
    least = int(np.argmin(sizes))
    lacks = sum(beads) - sum(c * n for c, n in zip(counts, sizes))
    counts[least] = max(0, counts[least] + round(lacks / sizes[least]))
    return counts


def letters_of(kinds) -> list[str]:
    """The species of all molecules, as they come."""
    return list(dict.fromkeys(letter for kind in kinds for letter in kind.beads))


def table(value, letters: dict[str, int], name: str):
    """A number, or a table (species, species) from numbers by pairs of species."""
    if not isinstance(value, Mapping):
        return value
    table = np.full((len(letters),) * 2, np.nan)
    table[:] = value.get(OTHERS, np.nan)
    for pair, number in value.items():
        if pair == OTHERS:
            continue
        names = spelt(pair)
        if len(names) != 2 or not set(names) <= set(letters):
            raise ValueError(
                f"{name} has {pair!r}, which is no pair of {', '.join(letters)}; give "
                f'{name}={{"AA": ..., "AB": ...}}'
            )
        i, j = (letters[letter] for letter in names)
        for other in value:
            if _alike(other) == _alike(pair) and value[other] != number:
                raise ValueError(f"{name} has two numbers for {pair!r} and {other!r}")
        table[i, j] = table[j, i] = number
    lacks = [
        f"{a}{b}"
        for a, i in letters.items()
        for b, j in letters.items()
        if i <= j and np.isnan(table[i, j])
    ]
    if lacks:
        raise ValueError(
            f'{name} has no number for {", ".join(lacks)}; give it, or "*" for all others'
        )
    return table


def of_letters(value, letters):
    """A number, or one for each species from numbers by letters."""
    if not isinstance(value, Mapping):
        return value
    unknown = sorted(set(value) - set(letters) - {OTHERS})
    lacks = [letter for letter in letters if letter not in value and OTHERS not in value]
    if unknown or lacks:
        raise ValueError(
            f"mass names {', '.join(value)}, and the species are {', '.join(letters)}: give one "
            'for each, or "*" for all others'
        )
    return np.array([value.get(letter, value.get(OTHERS)) for letter in letters], float)


def of_types(kind: str, terms: Terms, kinds) -> Terms:
    """The types of bonds that some molecule has; ValueError for a name that fits none."""
    named = terms if isinstance(terms, Mapping) else {}
    there = {names for made in kinds for names in _names(made, BEADS[kind])}
    for name in named:
        fits = any(type_of(names, {name: ()}) for names in there)
        if not fits:
            told = ", ".join(sorted("".join(names) for names in there)) or "none"
            raise ValueError(f"{kind}s has {name!r}, and the molecules have {told}")
    for name in named:
        twins = [other for other in named if _alike(other) == _alike(name)]
        if len(twins) > 1:
            told = " and ".join(map(repr, twins))
            raise ValueError(f"{kind}s has {told}, which are the same beads: give one of them")
    if kind == "bond" and (isinstance(terms, Mapping) or not several(terms, "bonds")):
        _refuse_unbonded(there, named)
    if not there:
        return ()
    return {kind if n == OTHERS else n: t for n, t in named.items()} if named else terms


def _alike(name: str) -> tuple[str, ...]:
    """The species in the name of a type, the same whichever way round it is read."""
    return min(spelt(name), spelt(name)[::-1]) if name != OTHERS else (OTHERS,)


def _refuse_unbonded(there, named):
    """Raise ValueError where beads that follow one another in a word would have no bond."""
    lacks = {
        "".join(min(names, names[::-1]))
        for names in there
        if type_of(names, dict.fromkeys(named, ())) is None
    }
    if lacks:
        raise ValueError(
            f"bonds has none for {', '.join(sorted(lacks))}, and the molecules would fall apart "
            'there; give it, or "*" for all others'
        )


def _names(made: Architecture, size: int) -> list[tuple[str, ...]]:
    """The species of all bonds, angles or dihedrals of a molecule."""
    return [tuple(made.beads[k] for k in row) for row in made.runs(size)]


@dataclasses.dataclass(frozen=True)
class Order:
    """Which bead is which: molecule after molecule as they are laid out, species after species in
    the state.

    Attributes:
        counts: beads of each species.
        by_species: of each id its place among the beads of the molecules in turn (n,).
        ids: of each molecule, by word, the ids of its beads (molecules, beads).
    """

    counts: list[int]
    by_species: np.ndarray
    ids: dict[str, np.ndarray]

    @classmethod
    def of(cls, kinds, counts, letters) -> "Order":
        each = [np.tile([letters[x] for x in kind.beads], c) for kind, c in zip(kinds, counts)]
        species = np.concatenate(each).astype(int)
        if not len(species):
            raise ValueError("there is no molecule at all; give more, or a larger box")
        order = np.argsort(species, kind="stable")
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        edges = np.cumsum([0, *(kind.n * c for kind, c in zip(kinds, counts))])
        ids = {
            kind.word: place[begin:end].reshape(-1, kind.n)
            for kind, begin, end in zip(kinds, edges, edges[1:])
        }
        return cls(np.bincount(species, minlength=len(letters)).tolist(), order, ids)

    def groups(self, made: Fluid, kinds) -> dict[str, np.ndarray]:
        """Of each type of bond in the fluid the ids of its beads."""
        found = {b.name: [np.zeros((0, BEADS[b.kind]), int)] for b in made.bonded}
        for kind in BEADS:
            types = [b for b in made.bonded if b.kind == kind]
            for molecule in kinds:
                runs = molecule.runs(BEADS[kind])
                named = [_type_name(types, names) for names in _names(molecule, BEADS[kind])]
                for name in dict.fromkeys(n for n in named if n is not None):
                    rows = runs[[n == name for n in named]]
                    found[name].append(self.ids[molecule.word][:, rows].reshape(-1, BEADS[kind]))
        return {name: np.concatenate(rows) for name, rows in found.items()}


def _type_name(types: list[Bonded], names) -> str | None:
    """The type of one bond between these species: the one so named, or that of all others, which
    is called by its kind."""
    others = next((b.name for b in types if b.name == b.kind), None)
    return type_of(names, {b.name: () for b in types}) or others
