"""What a run keeps of each frame: a value at its end, or a mean or integral over it."""

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from dpdjax.engine.batching import each_fluid
from dpdjax.engine.compensated import plus
from dpdjax.engine.observables import standard


@dataclasses.dataclass(frozen=True)
class Recorder:
    """An observable, and whether it is sampled, averaged or integrated over a frame.

    Attributes:
        observe: a function ``observe(fluid, state)``, of arrays by name or one array.
        how: ``"last"``, the value at the end of the frame; ``"mean"`` or ``"integral"``, over every
            step of its interval.

    Example:
        >>> averaged = dpd.mean(dpd.observe.standard)
        >>> averaged.how, averaged.accumulates
        ('mean', True)
        >>> sorted(averaged.now(water, rest.final))
        ['momentum', 'potential_energy', 'pressure_tensor', 'temperature']
    """

    observe: Callable
    how: str = "last"

    @property
    def accumulates(self) -> bool:
        """Whether it looks at every step, and not at the last of a frame alone."""
        return self.how != "last"

    def zero(self, fluid, state):
        """An empty sum, of the shape the observable has, and what rounding has left out of it."""
        if not self.accumulates:
            return ()
        zeros = jax.tree.map(
            lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(self._summand, fluid, state)
        )
        return zeros, zeros

    def add(self, sums, fluid, state):
        """The sums with the present value; plain ones would lose a per cent over a million steps in
        single precision."""
        if not self.accumulates:
            return ()
        totals, rests = sums
        pairs = jax.tree.map(plus, totals, rests, self._summand(fluid, state))
        return jax.tree.transpose(jax.tree.structure(totals), None, pairs)

    def now(self, fluid, state) -> dict:
        """The observable by name; one that returns an array goes under its own."""
        value = self.observe(fluid, state)
        return (
            value
            if isinstance(value, dict)
            else {getattr(self.observe, "__name__", "value"): value}
        )

    def value(self, fluid, state, sums, dt, every):
        if not self.accumulates:
            return self.now(fluid, state)
        of_total = (
            (lambda total: total / every) if self.how == "mean" else (lambda total: total * dt)
        )
        return jax.tree.map(of_total, sums[0])

    def _summand(self, fluid, state) -> dict:
        """The observable as floating numbers: a sum of truths would be a truth."""
        floating = lambda x: (
            x
            if jnp.issubdtype(jnp.result_type(x), jnp.inexact)
            else jnp.asarray(x, state.position.dtype)
        )
        return jax.tree.map(floating, self.now(fluid, state))


def averaged(how: list[Recorder], fluid, state) -> tuple[str, ...]:
    """Names of what is recorded as a mean over its frame's interval, of one state or a batch."""
    of = lambda now: each_fluid(now, fluid, state.position.ndim == 3)
    return tuple(
        name for r in how if r.how == "mean" for name in jax.eval_shape(of(r.now), fluid, state)
    )


def mean(observe: Callable) -> Recorder:
    """Record the mean of an observable over every step of a frame's interval.

    Returns a :class:`dpdjax.observe.Recorder`, for ``observe=``. Stresses, which fluctuate much,
    are best recorded so.

    Example:
        >>> seen = [dpd.mean(dpd.observe.standard), dpd.observe.positions]  # for observe=
        >>> seen[0].how
        'mean'
    """
    return Recorder(observe, "mean")


def integral(observe: Callable) -> Recorder:
    """Record the time integral of an observable over every step of a frame's interval.

    Returns a :class:`dpdjax.observe.Recorder`, for ``observe=``.

    Example:
        >>> flux = dpd.integral(dpd.observe.pressure_tensor)  # for observe=
        >>> flux.how, list(flux.now(water, rest.final))  # what goes by the name of its function
        ('integral', ['pressure_tensor'])
    """
    return Recorder(observe, "integral")


def check_names(how: list[Recorder], fluid, state) -> None:
    """Raise ValueError where two observables record different things under one name, or one takes
    ``time`` or ``step``.

    Raises TypeError for one that returns neither arrays by name nor an array.
    """
    taken = {}
    for one in how:
        for name in _recorded(one, fluid, state):
            if name in ("time", "step"):
                raise ValueError(
                    f"{name!r} is recorded by every frame and by {_told(one)}: return it under "
                    "another name"
                )
            other = taken.setdefault(name, one)
            if other != one and not _same(name, one, other, fluid, state):
                raise ValueError(
                    f"{name!r} is recorded by {_told(other)} and by {_told(one)}: return one of "
                    "them under another name"
                )


def _recorded(one: Recorder, fluid, state) -> dict:
    """The shapes that are recorded, by name."""
    found = jax.eval_shape(one.now, fluid, state)
    for name, values in found.items():
        if not isinstance(name, str) or not hasattr(values, "shape"):
            what = "None" if values is None else f"a {type(values).__name__}"
            raise TypeError(
                f"{_told(one)} returns {what} for {name!r}; an observable is a function "
                "observe(fluid, state) -> dict of arrays "
                "by name, such as lambda fluid, state: {'height': state.position[:, 2]}"
            )
    return found


def _same(name: str, one: Recorder, other: Recorder, fluid, state) -> bool:
    """Whether two recorders compute one name by the same program, as several of this package do."""
    shapes = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)), (fluid, state)
    )
    program = lambda recorder: (
        jax.jit(lambda fluid, state: recorder.now(fluid, state)[name]).lower(*shapes).as_text()
    )
    return one.how == other.how and program(one) == program(other)


def _told(recorder: Recorder) -> str:
    name = getattr(recorder.observe, "__name__", repr(recorder.observe))
    return name if recorder.how == "last" else f"{recorder.how}({name})"


Observing = Callable | Recorder | Sequence[Callable | Recorder] | None
"""What ``observe=`` takes."""


def recorders(observe: Observing) -> list[Recorder]:
    """One observable, recorder or a sequence of either, as a list of recorders."""
    if observe is None:
        observe = standard
    many = observe if isinstance(observe, (list, tuple)) else [observe]
    for one in many:
        if not callable(one) and not isinstance(one, Recorder):
            raise TypeError(
                f"observe is {one!r}; give a function observe(fluid, state) -> dict, or a list of "
                "them"
            )
    return [one if isinstance(one, Recorder) else Recorder(one) for one in many]
