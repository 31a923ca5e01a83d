"""What acts along bonds, in angles and in dihedrals: terms of one coordinate of a few beads."""

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp

from dpdjax.model.declare import POTENTIAL, check_kind, name_of
from dpdjax.model.term import Term, Whole, several, takes

BEADS = {"bond": 2, "angle": 3, "dihedral": 4}
"""The kinds, and the beads of each; they are also the names that stresses are kept under."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Bonded:
    """The terms of one type of bonds, of angles or of dihedrals.

    Attributes:
        terms: potentials of the coordinate; their energies add up.
        kind: ``"bond"``, of a distance; ``"angle"`` and ``"dihedral"``, of the cosine (static).
        name: of the type, under which the topology of a state has its beads (static).
    """

    terms: tuple[Term, ...]
    kind: str = dataclasses.field(metadata={"static": True})
    name: str = dataclasses.field(metadata={"static": True})

    def map_terms(self, function) -> "Bonded":
        """The same type with ``function(term)`` in place of every term."""
        return dataclasses.replace(self, terms=tuple(map(function, self.terms)))

    def by_origin(self) -> dict[str, list[Term]]:
        """The terms by the names that their stresses are kept under."""
        labels = dict.fromkeys(t.origin or self.kind for t in self.terms)
        return {
            label: [t for t in self.terms if (t.origin or self.kind) == label] for label in labels
        }


Terms = Term | Sequence[Term] | Mapping[str, Term | Sequence[Term]]
"""Terms of one type, or of several by name."""


def bonded(kind: str, terms: Terms) -> tuple[Bonded, ...]:
    """The types of one kind, each with its terms; terms without a name are of the type ``kind``.

    Raises TypeError for what is no term, or asks for the radii of beads; ValueError for a friction,
    a table, or a type without terms.
    """
    named = terms if isinstance(terms, Mapping) else {kind: terms} if _is_given(terms) else {}
    return tuple(_type(kind, name, several(own, f"{kind}s")) for name, own in named.items())


def _is_given(terms) -> bool:
    return terms is not None and (isinstance(terms, Term) or len(tuple(terms)) > 0)


def _type(kind: str, name, terms: list[Term]) -> Bonded:
    if not isinstance(name, str) or not name:
        raise TypeError(f"the type of {kind} {name!r} needs a name, a word")
    if not terms:
        raise ValueError(f"the type of {kind} {name!r} has no term: give one, or leave it out")
    for t in terms:
        check_kind(t.law, POTENTIAL)
        _check_coordinate(t, kind)
        if takes(t.law, "R_i", "R_j"):
            raise TypeError(
                f"{name_of(t.law)} asks for radii, and a {kind} has the distance of two centres or "
                "a cosine: give a law of that"
            )
    made = Bonded(tuple(terms), kind, name)
    refuse_tables(made)
    return made


def refuse_tables(b: Bonded):
    """Raise ValueError for a coefficient that is a table of species; a vector is a batch."""
    for t in b.terms:
        numbers = {k: c for k, c in t.coefficients.items() if not isinstance(c, Whole)}
        tables = [k for k, c in numbers.items() if jnp.ndim(c) > 1]
        if tables:
            raise ValueError(
                f"{tables[0]} of the {b.kind} {b.name!r} is a table of species; give each type of "
                f'{b.kind} its own number, {b.kind}s={{"AA": dpd.term(...), "AB": dpd.term(...)}}'
            )


def _check_coordinate(t: Term, kind: str):
    """Raise ValueError for a law of a cosine where a distance is, and the other way round."""
    kinds = getattr(t.law, "of_kinds", ("bond",) if t.is_bounded else (kind,))
    if kind not in kinds:
        article = "an" if kind == "angle" else "a"
        raise ValueError(
            f"{name_of(t.law)} is a law of {' and '.join(f'{k}s' for k in kinds)}, and was given "
            f"as that of {article} {kind}"
        )
