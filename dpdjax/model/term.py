"""A term: one pair law with the numbers that go into it."""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.checks import is_concrete, number, positive
from dpdjax.model import summary
from dpdjax.model.declare import (
    CENTRAL,
    FULL,
    TRANSVERSE,
    check_bounds,
    known_projector,
    name_of,
    names_declared,
)

GIVEN = ("R_i", "R_j", "kT")
"""What a law may ask for by name without being given it: the radii of the two beads, the thermal
energy."""
GAPS = (5,)
"""Shape of the gaps that a law is tried with: one that no pair of numbers has by accident."""
CURES = {
    "TracerBoolConversionError": "branches with `if` on a traced value; use jnp.where",
    "truth value": "branches with `if` on a traced value; use jnp.where",
    "TracerArrayConversionError": "takes a traced value out of JAX; use jax.numpy, not numpy or "
    "math",
    "ConcretizationTypeError": "takes a traced value out of JAX; use jax.numpy, not numpy or math",
    "Python scalars": "takes a traced value out of JAX; use jax.numpy, not numpy or math",
    "valid JAX": "does not return numbers; an energy or a friction is wanted for each gap",
}
"""What Python and JAX say of a law that cannot be traced, and what is told instead."""
RESERVED = ("kinetic", "conservative", "drag", "random", "tensor")
"""Names of stresses that no term may take for its own."""
ALONG, ACROSS = (CENTRAL, FULL), (TRANSVERSE, FULL)
"""Projectors of what acts along the line of centres, and of what acts across it."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, repr=False)
class Term:
    """A law and its coefficients; build it with :func:`term`.

    Attributes:
        law: the pair function (static).
        coefficients: name -> scalar or (species, species) table (leaves).
        cut: gap beyond which the law is zero, where that is a number of its own (leaf).
        reach: function of the coefficients and of what is given, where it is computed (static).
        origin: name under which its stress is kept, where that is not its kind (static).
        projector: of a friction, the part of the relative velocity it acts on (static).
    """

    law: Callable = dataclasses.field(metadata={"static": True})
    coefficients: dict[str, Any]
    cut: Any = None
    reach: Callable | None = dataclasses.field(default=None, metadata={"static": True})
    origin: str | None = dataclasses.field(default=None, metadata={"static": True})
    projector: str = dataclasses.field(default=CENTRAL, metadata={"static": True})

    def __repr__(self):
        return summary.of_term(self)

    def between(self, table_of=lambda c: c, **given):
        """The law as a function of the gap, and its reach; ``table_of`` looks tables up, ``given``
        is of ``GIVEN``."""
        numbers = {name: table_of(c) for name, c in self.coefficients.items()} | given
        call = lambda function: functools.partial(
            function, **{k: numbers[k] for k in _keywords(function) if k in numbers}
        )
        if self.cut is not None:
            return call(self.law), table_of(self.cut)
        return call(self.law), numbers["r_c"] if self.reach is None else call(self.reach)()


def term(
    law: Callable,
    *,
    reach=None,
    origin: str | None = None,
    projector: str | None = None,
    **coefficients,
) -> Term:
    """Bind a pair law to its coefficients.

    Args:
        law: a function ``law(h, *, ...)`` of the gap, returning an energy (used under
            ``conservative=``) or a friction coefficient (under ``drag=``). It may ask for the radii
            ``R_i``, ``R_j`` of the two beads and for ``kT`` by name; those are not given here.
        reach: gap beyond which the law is cut to zero [length], a number or a function of
            coefficients; by default what the law declares with ``dpd.reaches``, else its
            coefficient ``r_c``. A potential is shifted to be zero there.
        origin: name under which the stress of this term is kept, by default ``"conservative"`` or
            ``"drag"``.
        projector: the part of the relative velocity of the two *surfaces* that a friction acts on:
            ``"central"``, along the line of centres; ``"transverse"``, across it, which turns beads
            that can rotate; ``"full"``, all of it. By default what the law declares with
            ``dpd.projected``, else ``"central"``.
        **coefficients: a scalar or a symmetric (species, species) table each.

    Raises:
        TypeError: a coefficient the law does not know, declares something of, or lacks; a law that
            branches with ``if`` on what is traced, or that does not return real numbers of the
            shape of ``h``.
        ValueError: a table that is not square and symmetric; no reach; an origin that is taken; an
            unknown projector; a number outside what the law declares with ``dpd.bounded``.
    """
    name = name_of(law)
    if origin in RESERVED:
        raise ValueError(
            f"origin {origin!r} of {name} is taken: give the stress another name, or none"
        )
    declared = getattr(law, "reach", None) if reach is None else reach if callable(reach) else None
    wanted = dict(_keywords(declared) if declared else {}) | _keywords(law)
    wanted = {k: needed for k, needed in wanted.items() if k not in GIVEN}
    for given in coefficients:
        if given not in wanted:
            takes = ", ".join(wanted) or "none: coefficients come after a star, def law(h, *, ...)"
            raise TypeError(f"{name} has no coefficient {given!r}; it takes {takes}")
    missing = [w for w, needed in wanted.items() if needed and w not in coefficients]
    if missing:
        raise TypeError(f"{name} lacks {', '.join(missing)}; give {missing[0]}=... to dpd.term")
    unknown = names_declared(law) - set(_keywords(law)) - set(wanted) - set(GIVEN)
    if unknown:
        raise TypeError(
            f"{name} declares something of {', '.join(sorted(unknown))}, which it does not take; "
            f"it takes {', '.join(wanted)}"
        )
    values = {k: number(v, k) for k, v in coefficients.items()}
    for k, v in values.items():
        if v.ndim in (1, 3):
            raise ValueError(
                f"{k} has shape {v.shape}; give a number or a square (species, species) table"
            )
        check_table(k, v)
    if reach is None and declared is None and "r_c" not in values:
        raise ValueError(
            f"{name} has no coefficient r_c: say where it ends, dpd.term({name}, reach=...)"
        )
    check_bounds(law, values)
    cut = None if reach is None or callable(reach) else positive(reach, f"reach of {name}")
    if reach is None and declared is None:
        positive(values["r_c"], "r_c")
    names = (*values, *GIVEN)
    _check_value(
        law, tuple(k for k in names if k in _keywords(law)), GAPS, "its energy or friction"
    )
    if declared is not None:
        _check_value(
            declared, tuple(k for k in names if k in _keywords(declared)), None, "its reach"
        )
    projector = (
        getattr(law, "projector", CENTRAL) if projector is None else known_projector(projector)
    )
    return Term(law, values, cut, declared, origin, projector)


def several(terms) -> list[Term]:
    """One term or a sequence of them, as a list; TypeError for anything else."""
    terms = [terms] if isinstance(terms, Term) or callable(terms) else list(terms)
    for t in terms:
        if not isinstance(t, Term):
            raise TypeError(
                f"{getattr(t, '__name__', repr(t))} is not a term; write dpd.term(law, "
                "coefficient=...)"
            )
    return terms


@functools.lru_cache(maxsize=256)
def _check_value(function, names: tuple[str, ...], gaps, what: str):
    """Raise TypeError unless a law, or a reach, gives floats of the right shape for traced
    numbers."""
    scalar = jax.ShapeDtypeStruct((), float)
    h = () if gaps is None else (jax.ShapeDtypeStruct(gaps, float),)
    try:
        given = jax.eval_shape(
            lambda h, numbers: function(*h, **numbers), h, dict.fromkeys(names, scalar)
        )
    except (TypeError, ValueError) as error:
        cures = [cure for said, cure in CURES.items() if said in f"{type(error).__name__}: {error}"]
        if not cures:
            raise
        raise TypeError(f"{name_of(function)} {cures[0]}") from error
    if not hasattr(given, "dtype") or not jnp.issubdtype(given.dtype, jnp.floating):
        kind = getattr(given, "dtype", type(given).__name__)
        raise TypeError(
            f"{name_of(function)} returns {kind}; {what} is wanted, real floating-point numbers"
        )
    if given.shape not in ((), gaps):
        raise TypeError(
            f"{name_of(function)} returns shape {given.shape} for gaps of shape {gaps}; {what} is "
            "wanted for each gap"
        )


@functools.cache
def _keywords(function) -> dict[str, bool]:
    """The keyword-only parameters of a function, and whether each must be given."""
    parameters = inspect.signature(function).parameters.values()
    return {p.name: p.default is p.empty for p in parameters if p.kind is p.KEYWORD_ONLY}


def check_table(name, value, species: int | None = None):
    """Raise ValueError unless ``value`` is a number or a symmetric table, or a batch of either."""
    if value.ndim in (0, 1):
        return
    if (
        value.ndim > 3
        or value.shape[-1] != value.shape[-2]
        or species not in (None, value.shape[-1])
    ):
        wanted = "square (species, species)" if species is None else f"({species}, {species})"
        raise ValueError(f"{name} has shape {value.shape}; give a number or a {wanted} table")
    if is_concrete(value) and not np.allclose(value, np.swapaxes(value, -1, -2)):
        raise ValueError(f"the table of {name} is not symmetric: pair (i, j) and (j, i) must agree")


def replace_coefficients(term: Term, changes: dict) -> Term:
    """A copy with the coefficients named in ``changes``."""
    mine = {k: number(v, k) for k, v in changes.items() if k in term.coefficients}
    check_bounds(term.law, mine)
    return dataclasses.replace(term, coefficients={**term.coefficients, **mine})
