"""A term: one pair law with the numbers that go into it."""

import dataclasses
import functools
import inspect
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

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
NUMBER = (jax.tree.structure(0), ((),))
"""The kind of a number, as :attr:`Whole.kind`."""
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
OF_FLUIDS = ("mass", "inertia", "between", "energies")
"""Names that ``fluid.set`` takes and no coefficient may have."""
RESERVED = ("kinetic", "conservative", "drag", "random", "tensor")
"""Names of stresses that no term may take for its own."""
ALONG, ACROSS = (CENTRAL, FULL), (TRANSVERSE, FULL)
"""Projectors of what acts along the line of centres, and of what acts across it."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, repr=False)
class Whole:
    """A coefficient that a law takes as it is, whatever its shape: no number, no table of species.

    Attributes:
        value: an array, or a pytree of arrays (leaves); of a batch with one more axis in front.
        ranks: of each array, the axes that one member has (static).
    """

    value: Any
    ranks: tuple[int, ...] = dataclasses.field(metadata={"static": True})

    def __repr__(self):
        shapes = jax.tree.map(lambda leaf: getattr(leaf, "shape", leaf), self.value)
        return f"whole({shapes}{', batch=True' if self.is_batch else ''})"

    @property
    def is_batch(self) -> bool:
        """Whether the arrays have an axis more than one member."""
        return any(jnp.ndim(x) > rank for x, rank in zip(jax.tree.leaves(self.value), self.ranks))

    @property
    def members(self) -> list["Whole"]:
        """Each member of a batch; itself, where it is none."""
        if not self.is_batch:
            return [self]
        of_member = lambda k: jax.tree.map(lambda leaf: leaf[k], self)
        return [of_member(k) for k in range(len(jax.tree.leaves(self.value)[0]))]

    @property
    def kind(self) -> tuple:
        """Its structure and the shapes of one member."""
        leaves, structure = jax.tree.flatten(self.value)
        shapes = [jnp.shape(x)[jnp.ndim(x) - rank :] for x, rank in zip(leaves, self.ranks)]
        return structure, tuple(shapes)


def whole(value: Any, *, batch: bool = False) -> Whole:
    """A coefficient of any shape, for a law that takes arrays: values at knots, the weights of a
    network.

    Args:
        value: an array of floats, or a pytree of them.
        batch: whether its first axis is that of a batch, a member for each key of a run.

    Returns a :class:`dpdjax.model.term.Whole`. Raises TypeError for what is no array, ValueError
    for what is not finite, or is a batch without an axis for it.

    Example:
        >>> def tabled(h, *, values, r_c):
        ...     return jnp.interp(h / r_c, jnp.linspace(0.0, 1.0, 5), values)
        >>> values = dpd.whole(jnp.array([12.5, 7.0, 3.1, 0.8, 0.0]))
        >>> dpd.term(tabled, values=values, r_c=1.0)
        tabled(values=whole((5,)), r_c=1)
    """
    arrays = jax.tree.map(lambda leaf: number(leaf, "whole"), value)
    ranks = tuple(leaf.ndim - int(batch) for leaf in jax.tree.leaves(arrays))
    if min(ranks, default=0) < 0:
        raise ValueError("a batch of numbers has an axis for its members; one of these has none")
    return Whole(arrays, ranks)


def coefficient(value, name: str, old=None):
    """A number, a table, or what is taken :func:`whole`, as arrays; in place of an ``old`` one
    taken whole bare arrays will do, of one member or of a batch."""
    if isinstance(value, Whole):
        return value
    if not isinstance(old, Whole):
        return number(value, name)
    new = whole(value)
    more = {mine - rank for mine, rank in zip(new.ranks, old.ranks)}
    return Whole(new.value, old.ranks) if more <= {0} or more == {1} else new


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, repr=False)
class Term:
    """A law and its coefficients; build it with :func:`dpdjax.term`.

    Attributes:
        law: the pair function (static).
        coefficients: name -> scalar, (species, species) table, or
            :class:`dpdjax.model.term.Whole` (leaves).
        cut: gap beyond which the law is zero, where that is a number of its own [length] (leaf).
        reach: function of the coefficients and of what is given, where it is computed (static).
        origin: name under which its stress is kept, where that is not its kind (static).
        projector: of a friction, the part of the relative velocity it acts on (static).

    Example:
        >>> repulsion, *_ = water.interactions[0].conservative
        >>> repulsion
        soft_repulsion(a=25, r_c=1)
        >>> float(repulsion.coefficients["a"]), repulsion.law is dpd.soft_repulsion
        (25.0, True)
    """

    law: Callable = dataclasses.field(metadata={"static": True})
    coefficients: dict[str, Any]
    cut: Any = None
    reach: Callable | None = dataclasses.field(default=None, metadata={"static": True})
    origin: str | None = dataclasses.field(default=None, metadata={"static": True})
    projector: str = dataclasses.field(default=CENTRAL, metadata={"static": True})

    def __repr__(self):
        return summary.of_term(self)

    def _repr_html_(self):
        rows = [(k, summary.written(c)) for k, c in self.coefficients.items()]
        return summary.as_table(name_of(self.law), rows)

    @property
    def members(self) -> list["Term"]:
        """The term with each member of what is taken whole and is a batch; itself, where none
        is."""
        most = max(
            [len(c.members) for c in self.coefficients.values() if isinstance(c, Whole)] + [1]
        )
        pick = lambda c, k: c.members[k % len(c.members)] if isinstance(c, Whole) else c
        each = [{name: pick(c, k) for name, c in self.coefficients.items()} for k in range(most)]
        return [dataclasses.replace(self, coefficients=coefficients) for coefficients in each]

    def between(self, table_of=lambda c: c, **given):
        """The law as a function of the gap, and its reach, None for one without end; ``table_of``
        looks tables up, ``given`` is of ``GIVEN``."""
        value = lambda c: c.value if isinstance(c, Whole) else table_of(c)
        numbers = {name: value(c) for name, c in self.coefficients.items()} | given
        call = lambda function: functools.partial(
            function, **{k: numbers[k] for k in _keywords(function) if k in numbers}
        )
        if self.cut is not None:
            return call(self.law), table_of(self.cut)
        return call(self.law), numbers.get("r_c") if self.reach is None else call(self.reach)()

    @property
    def is_bounded(self) -> bool:
        """Whether the law ends anywhere; one of a bond need not (static)."""
        return not (self.cut is None and self.reach is None and "r_c" not in self.coefficients)


def term(
    law: Callable,
    *,
    reach: ArrayLike | Callable | None = None,
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
            coefficients; by default what the law declares with ``dpd.laws.reaches``, else its
            coefficient ``r_c``. A potential is shifted to be zero there. A law of a bond, of an
            angle or of a dihedral may do without.
        origin: name under which the stress of this term is kept, by default ``"conservative"`` or
            ``"drag"``.
        projector: the part of the relative velocity of the two *surfaces* that a friction acts on:
            ``"central"``, along the line of centres; ``"transverse"``, across it, which turns beads
            that can rotate; ``"full"``, all of it. By default what the law declares with
            ``dpd.laws.projected``, else ``"central"``.
        **coefficients: a scalar or a symmetric (species, species) table each; or
            ``dpd.whole(array)``, which the law gets as it is.

    Raises:
        TypeError: a coefficient whose name is taken, or that the law does not know, declares
            something of, or lacks; a law that branches with ``if`` on what is traced, or that does
            not return real numbers of the shape of ``h``.
        ValueError: a table that is not square and symmetric; an origin that is taken; an unknown
            projector; a number outside what the law declares with ``dpd.laws.bounded``.

    Example:
        >>> def yukawa(h, *, strength, kappa):
        ...     return strength * jnp.exp(-kappa * h) / h
        >>> dpd.term(yukawa, strength=2.0, kappa=3.0, reach=1.0)
        yukawa(strength=2, kappa=3, reach=1)
    """
    if not callable(law) or isinstance(law, type):
        raise TypeError(f"law is {law!r}; give a function law(h, *, ...)")
    if reach is not None and isinstance(reach, type):
        raise TypeError(f"reach is {reach!r}; give a number, or a function of coefficients")
    if not (origin is None or isinstance(origin, str)):
        raise TypeError(f"origin is {origin!r}; give a name, or None")
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
    taken = [k for k in wanted if k in OF_FLUIDS]
    if taken:
        raise TypeError(
            f"{name} has a coefficient {taken[0]!r}, which fluid.set(...) takes for something "
            "else: call it otherwise"
        )
    unknown = names_declared(law) - set(_keywords(law)) - set(wanted) - set(GIVEN)
    if unknown:
        raise TypeError(
            f"{name} declares something of {', '.join(sorted(unknown))}, which it does not take; "
            f"it takes {', '.join(wanted)}"
        )
    values = {k: coefficient(v, k) for k, v in coefficients.items()}
    for k, v in values.items():
        if not isinstance(v, Whole) and v.ndim in (1, 3):
            raise ValueError(
                f"{k} has shape {v.shape}; give a number or a square (species, species) table, or "
                "dpd.whole(...) where the law takes an array"
            )
        check_table(k, v)
    check_bounds(law, values)
    cut = None if reach is None or callable(reach) else positive(reach, f"reach of {name}")
    if reach is None and declared is None and "r_c" in values:
        positive(values["r_c"], "r_c")
    kinds = [(k, v.kind if isinstance(v, Whole) else NUMBER) for k, v in values.items()]
    kinds += [(k, NUMBER) for k in GIVEN]
    taken = lambda function: tuple((k, kind) for k, kind in kinds if k in _keywords(function))
    _check_value(law, taken(law), GAPS, "its energy or friction")
    if declared is not None:
        try:
            _check_value(declared, taken(declared), None, "its reach")
        except TypeError as error:
            raise TypeError(f"reach of {name}: {error}") from error
    projector = (
        getattr(law, "projector", CENTRAL) if projector is None else known_projector(projector)
    )
    return Term(law, values, cut, declared, origin, projector)


def several(terms, name: str) -> list[Term]:
    """One term or a sequence of them, as a list; TypeError, with the name they were given under,
    for anything else."""
    is_many = isinstance(terms, Iterable) and not isinstance(terms, str | dict | type | jax.Array)
    terms = list(terms) if is_many and not isinstance(terms, np.ndarray) else [terms]
    for t in terms:
        if not isinstance(t, Term):
            raise TypeError(
                f"{name}: {getattr(t, '__name__', repr(t))} is not a term; write dpd.term(law, "
                "coefficient=...)"
            )
    return terms


@functools.lru_cache(maxsize=256)
def _check_value(function, kinds: tuple[tuple, ...], gaps, what: str):
    """Raise TypeError unless a law, or a reach, gives floats of the right shape for traced numbers
    of these kinds, a name and :attr:`Whole.kind` each."""
    traced = lambda shape: jax.ShapeDtypeStruct(shape, float)
    numbers = {k: jax.tree.unflatten(tree, map(traced, shapes)) for k, (tree, shapes) in kinds}
    h = () if gaps is None else (jax.ShapeDtypeStruct(gaps, float),)
    try:
        given = jax.eval_shape(lambda h, numbers: function(*h, **numbers), h, numbers)
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


def takes(law: Callable, *names: str) -> bool:
    """Whether a law takes a coefficient of one of these names."""
    return bool(set(names) & set(_keywords(law)))


@functools.cache
def _keywords(function) -> dict[str, bool]:
    """The keyword-only parameters of a function, and whether each must be given."""
    parameters = inspect.signature(function).parameters.values()
    return {p.name: p.default is p.empty for p in parameters if p.kind is p.KEYWORD_ONLY}


def check_table(name, value, species: int | None = None):
    """Raise ValueError unless ``value`` is a number or a symmetric table, or a batch of either."""
    if isinstance(value, Whole) or value.ndim in (0, 1):
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
    old = term.coefficients
    mine = {k: coefficient(v, k, old[k]) for k, v in changes.items() if k in old}
    for k, v in mine.items():
        _check_kind(term, k, v)
    check_bounds(term.law, mine)
    return dataclasses.replace(term, coefficients={**term.coefficients, **mine})


def _check_kind(term: Term, name: str, new):
    """Raise TypeError for what is taken whole in place of a number, or of another structure."""
    old = term.coefficients[name]
    build = lambda c: (jax.tree.structure(c.value), c.ranks) if isinstance(c, Whole) else ()
    if build(old) != build(new):
        raise TypeError(f"{name} of {name_of(term.law)} is {old!r}, and {new!r} is none like it")
