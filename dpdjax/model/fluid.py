"""A fluid: which groups of beads interact by which terms, at which temperature and mass."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.checks import not_negative, number, positive
from dpdjax.model.term import Term, check_table, replace_coefficients


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Interaction:
    """The terms that act between two groups of beads; each interaction has its own list.

    Attributes:
        conservative: potentials; their energies add up.
        drag: frictions; their coefficients add up, and the noise follows from the sum.
        groups: indices of the two groups (static).
    """

    conservative: tuple[Term, ...]
    drag: tuple[Term, ...]
    groups: tuple[int, int] = dataclasses.field(default=(0, 0), metadata={"static": True})

    @property
    def terms(self) -> tuple[Term, ...]:
        return self.conservative + self.drag

    @property
    def reach(self) -> float:
        """Largest distance at which any term acts [length]; needs concrete numbers."""
        return max(float(np.max(np.asarray(t.reach))) for t in self.terms)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Fluid:
    """Everything the matter is, and nothing of where it is; build it with :func:`fluid`.

    Every number is a leaf, so ``jax.vmap`` and ``jax.grad`` work over any of them.

    Attributes:
        interactions: one for each pair of groups that interact.
        kT: thermal energy [energy].
        mass: mass of each species, shape (species,) [mass].
    """

    interactions: tuple[Interaction, ...]
    kT: Any
    mass: Any

    @property
    def species(self) -> int:
        return self.mass.shape[-1]

    @property
    def coefficients(self) -> dict[str, Any]:
        """Every coefficient by name; the first term that has it decides."""
        found = {}
        for interaction in self.interactions:
            for t in interaction.terms:
                for name, value in t.coefficients.items():
                    found.setdefault(name, value)
        return found

    def value(self, name: str):
        """The number called ``name``: ``kT``, ``mass`` or a coefficient."""
        if name in ("kT", "mass"):
            return getattr(self, name)
        if name not in self.coefficients:
            raise TypeError(_unknown(name, self))
        return self.coefficients[name]

    def batch_axes(self) -> "Fluid":
        """The ``in_axes`` of this fluid for ``jax.vmap``: 0 for numbers that carry a batch.

        Coefficients are scalars or tables and masses vectors, so one more axis is a batch.
        """

        def axes(t: Term) -> Term:
            coefficients = {k: 0 if jnp.ndim(c) in (1, 3) else None for k, c in t.coefficients.items()}
            return dataclasses.replace(t, coefficients=coefficients, cut=None)

        interactions = tuple(
            dataclasses.replace(i, conservative=tuple(map(axes, i.conservative)), drag=tuple(map(axes, i.drag)))
            for i in self.interactions
        )
        return Fluid(interactions, 0 if jnp.ndim(self.kT) == 1 else None, 0 if jnp.ndim(self.mass) == 2 else None)

    @property
    def is_batch(self) -> bool:
        """Whether any number carries a batch axis."""
        return bool(jax.tree.leaves(self.batch_axes()))

    def set(self, **numbers) -> "Fluid":
        """A copy with new numbers, fluid-wide: every term that has the coefficient takes it.

        ``kT`` and ``mass`` are set the same way. Raises TypeError for a name that no
        term knows, ValueError for a value that no fluid can have.
        """
        for name in numbers:
            if name not in ("kT", "mass") and name not in self.coefficients:
                raise TypeError(_unknown(name, self))
        kT = not_negative(numbers.pop("kT"), "kT") if "kT" in numbers else self.kT
        mass = _masses(numbers.pop("mass"), self.species) if "mass" in numbers else self.mass
        _check_coefficients(numbers)
        for name, value in numbers.items():
            check_table(name, number(value, name), self.species)
        interactions = tuple(
            dataclasses.replace(
                interaction,
                conservative=tuple(replace_coefficients(t, numbers) for t in interaction.conservative),
                drag=tuple(replace_coefficients(t, numbers) for t in interaction.drag),
            )
            for interaction in self.interactions
        )
        return Fluid(interactions, kT, mass)


def fluid(
    conservative: Sequence[Term] = (), drag: Sequence[Term] = (), *, kT, mass=1.0, species: int | None = None
) -> Fluid:
    """A fluid of one group of beads, of one or several species.

    Args:
        conservative: potentials, e.g. ``[dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)]``.
        drag: frictions, e.g. ``[dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)]``.
        kT: thermal energy [energy], zero or above.
        mass: bead mass, a number or one for each species [mass].
        species: how many; read off the tables and ``mass`` where not given.

    Raises:
        ValueError: negative ``kT`` or ``gamma``, mass not above zero, tables of
            different size, no term at all.
        TypeError: something that is not a term.
    """
    conservative, drag = (((t,) if isinstance(t, Term) else tuple(t)) for t in (conservative, drag))
    for t in conservative + drag:
        if not isinstance(t, Term):
            raise TypeError(f"{t!r} is not a term; write dpd.term(law, coefficient=...)")
    if not conservative + drag:
        raise ValueError("a fluid without terms does nothing; give conservative=[...] or drag=[...]")
    for t in conservative + drag:
        _check_coefficients(t.coefficients)
    count = _count_species(conservative + drag, mass, species)
    return Fluid((Interaction(conservative, drag),), not_negative(kT, "kT"), _masses(mass, count))


def _check_coefficients(coefficients):
    if "gamma" in coefficients:
        not_negative(coefficients["gamma"], "gamma")
    if "r_c" in coefficients:
        positive(coefficients["r_c"], "r_c")


def _masses(mass, species):
    mass = positive(mass, "mass")
    if mass.ndim > 1 or (mass.ndim == 1 and mass.shape[0] != species):
        raise ValueError(f"mass has shape {mass.shape}; give a number or {species} of them, one for each species")
    return jnp.broadcast_to(mass, (species,))


def _count_species(terms, mass, species):
    sizes = {value.shape[0]: name for t in terms for name, value in t.coefficients.items() if value.ndim == 2}
    if np.ndim(mass) == 1:
        sizes.setdefault(np.shape(mass)[0], "mass")
    if species is not None:
        sizes.setdefault(species, "species")
    if len(sizes) > 1:
        raise ValueError("numbers of species disagree: " + ", ".join(f"{n} has {k}" for k, n in sizes.items()))
    return next(iter(sizes), 1)


def _unknown(name, fluid):
    return f"no term of this fluid has {name!r}; it has kT, mass, {', '.join(sorted(fluid.coefficients))}"
