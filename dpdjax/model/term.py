"""A term: one pair law with the numbers that go into it."""

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from dpdjax.checks import is_concrete, number, positive


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Term:
    """A law and its coefficients; build it with :func:`term`.

    Attributes:
        law: the pair function (static).
        coefficients: name -> scalar or (species, species) table (leaves).
        cut: gap beyond which the law is zero, where it is not ``r_c`` (leaf).
    """

    law: Callable = dataclasses.field(metadata={"static": True})
    coefficients: dict[str, Any]
    cut: Any = None

    @property
    def reach(self):
        """Gap beyond which the law is zero, scalar or table [length]."""
        return self.coefficients["r_c"] if self.cut is None else self.cut

    def between(self, table_of):
        """Coefficients and reach of each pair; ``table_of`` looks tables up."""
        return {name: table_of(c) for name, c in self.coefficients.items()}, table_of(self.reach)


def term(law: Callable, *, reach=None, **coefficients) -> Term:
    """Bind a pair law to its coefficients.

    Args:
        law: a function ``law(h, *, ...)`` of the gap, returning an energy (used
            under ``conservative=``) or a friction coefficient (under ``drag=``).
        reach: gap beyond which the law is cut to zero [length]; by default the
            coefficient ``r_c``.
        **coefficients: a scalar or a symmetric (species, species) table each.

    Raises:
        TypeError: a coefficient the law does not know, or one it lacks.
        ValueError: a table that is not square and symmetric; no reach.
    """
    wanted = _keyword_parameters(law)
    name = getattr(law, "__name__", repr(law))
    for given in coefficients:
        if given not in wanted:
            raise TypeError(f"{name} has no coefficient {given!r}; it takes {', '.join(wanted)}")
    missing = [w for w, needed in wanted.items() if needed and w not in coefficients]
    if missing:
        raise TypeError(f"{name} lacks {', '.join(missing)}; give {missing[0]}=... to dpd.term")
    values = {k: number(v, k) for k, v in coefficients.items()}
    for k, v in values.items():
        if v.ndim in (1, 3):
            raise ValueError(f"{k} has shape {v.shape}; give a number or a square (species, species) table")
        check_table(k, v)
    if reach is None and "r_c" not in values:
        raise ValueError(f"{name} has no coefficient r_c: say where it ends, dpd.term({name}, reach=...)")
    return Term(law, values, None if reach is None else positive(reach, f"reach of {name}"))


def _keyword_parameters(law) -> dict[str, bool]:
    parameters = inspect.signature(law).parameters.values()
    return {p.name: p.default is p.empty for p in parameters if p.kind is p.KEYWORD_ONLY}


def check_table(name, value, species: int | None = None):
    """Raise ValueError unless ``value`` is a number or a symmetric table, or a batch of either."""
    if value.ndim in (0, 1):
        return
    if value.ndim > 3 or value.shape[-1] != value.shape[-2] or species not in (None, value.shape[-1]):
        wanted = "square (species, species)" if species is None else f"({species}, {species})"
        raise ValueError(f"{name} has shape {value.shape}; give a number or a {wanted} table")
    if is_concrete(value) and not np.allclose(value, np.swapaxes(value, -1, -2)):
        raise ValueError(f"the table of {name} is not symmetric: pair (i, j) and (j, i) must agree")


def replace_coefficients(term: Term, changes: dict) -> Term:
    """A copy with the coefficients named in ``changes``."""
    mine = {k: number(v, k) for k, v in changes.items() if k in term.coefficients}
    return dataclasses.replace(term, coefficients={**term.coefficients, **mine})
