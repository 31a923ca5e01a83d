"""What the parts of a run are, and what a deformation or a driver answers, checked before it."""

import dataclasses
from collections.abc import Callable
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.checks import is_concrete
from dpdjax.engine.batching import chosen


class Part:
    """What deformations, drivers and integrators have in common.

    One of your own is a frozen dataclass derived from ``dpd.flows.Deformation``,
    ``dpd.flows.Driver`` or ``dpd.integrators.Integrator`` and registered with
    ``jax.tree_util.register_dataclass``, its numbers leaves.

    Attributes:
        ranks: of each number that may differ from member to member of a batch, by name, how many
            axes it has in one; with one more it is a batch.
    """

    ranks: ClassVar[dict[str, int]] = {}

    def __init_subclass__(cls, **kwargs):
        """The class is a static number of its objects: JAX takes two dataclasses of as many leaves
        for one structure, and may then run the program of the other."""
        super().__init_subclass__(**kwargs)
        cls.__annotations__ = {**cls.__dict__.get("__annotations__", {}), "of_class": type}
        cls.of_class = dataclasses.field(
            default=cls, repr=False, compare=False, kw_only=True, metadata={"static": True}
        )

    def batch_axes(self):
        """The ``in_axes`` for ``jax.vmap``: 0 for what is a batch by ``ranks``."""
        axis = lambda x, rank: 0 if jnp.ndim(x) == rank + 1 else None
        axes = {
            name: jax.tree.map(lambda x: axis(x, rank), getattr(self, name))
            for name, rank in self.ranks.items()
        }
        if not jax.tree.leaves(axes):
            return None
        static = {f.name for f in dataclasses.fields(self) if f.metadata.get("static")}
        others = {f.name: None for f in dataclasses.fields(self) if f.name not in static}
        return dataclasses.replace(self, **(others | axes))


def check_part(part, kinds: tuple[type, ...], name: str, wanted: str) -> None:
    """Raise TypeError for a part of a run that is of none of these kinds, or whose numbers JAX does
    not know; ``wanted``: what to give under that name."""
    if not isinstance(part, kinds):
        raise TypeError(f"{name} is {part!r}; give {wanted}, or None")
    if any(leaf is part for leaf in jax.tree.leaves(part)):
        raise TypeError(
            f"{type(part).__name__} is not registered: put @jax.tree_util.register_dataclass and "
            "@dataclasses.dataclass(frozen=True) on it, so that its numbers are known"
        )


def check_answers(part, state, answers: dict[str, tuple[Callable, tuple]]) -> None:
    """Raise where an answer of the part has the wrong shape or kind, or is not finite.

    ``answers``: by name a function of the part, with the numbers of one member, and its shape.
    """
    kind, dtype = type(part).__name__, state.position.dtype
    part = jax.tree.map(lambda x: jnp.asarray(x, dtype), chosen(part, part.batch_axes(), 0))
    for name, (answer, shape) in answers.items():
        concrete = is_concrete(part, state)
        _check_answer(f"{name} of {kind}", lambda: answer(part), shape, dtype, concrete)


def _check_answer(what: str, answer: Callable, shape, dtype, concrete: bool) -> None:
    try:
        value = answer() if concrete else jax.eval_shape(answer)
    except (TypeError, ValueError, AttributeError) as error:
        raise type(error)(
            f"the {what} fails on one state, with the numbers of one member: {error}. Numbers of a "
            "batch are declared, ranks = {{'name': axes of one member}}"
        ) from error
    if value is None:
        return
    if jnp.shape(value) != shape:
        raise ValueError(
            f"the {what} has shape {jnp.shape(value)}; {shape} is wanted. Numbers of a batch are "
            "declared, ranks = {'name': axes of one member}"
        )
    if jnp.result_type(value, dtype) != dtype:
        raise TypeError(
            f"the {what} has dtype {jnp.result_type(value)}, the state {dtype}; return it as "
            "state.position.dtype"
        )
    if concrete and not np.all(np.isfinite(np.asarray(value))):
        raise ValueError(f"the {what} is not finite at the start; look at its numbers")
