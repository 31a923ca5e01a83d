"""What a program cost to be made, and whether the next one is there already."""

import time
import warnings

import jax
import jax.numpy as jnp

MAKING = "/jax/core/compile/"
"""Events of JAX: tracing, lowering and compiling, a program inside another included in both."""
ANEW = 3
"""Programs from one code under functions made anew, from which on it is told."""

_made: list[tuple[float, float]] = []
_seen: dict = {}


def _listen(event: str, seconds: float, **_):
    if not event.startswith(MAKING):
        return
    start = time.monotonic() - seconds
    while _made and _made[-1][0] >= start:
        _made.pop()
    _made.append((start, seconds))


jax.monitoring.register_event_duration_secs_listener(_listen)


def seconds() -> float:
    """Seconds this process has spent so far on making programs."""
    return sum(spent for _, spent in _made)


class Clock:
    """What has gone by since it was made: seconds in all, and those spent on making programs."""

    def __init__(self):
        self._began, self._compiled = time.monotonic(), seconds()

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._began

    @property
    def compile_seconds(self) -> float:
        return seconds() - self._compiled


def is_new(arguments, static, functions: tuple) -> bool:
    """Whether a program of these arguments has yet to be made; it is then taken to have been.

    ``functions`` are among what is static. Warns where one code is compiled again and again because
    the function is another.
    """
    shapes = tuple((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in jax.tree.leaves(arguments))
    others = _seen.setdefault((jax.tree.structure(arguments), shapes, static), [])
    if functions in others:
        return False
    codes = _codes(functions)
    if codes is not None and sum(codes == _codes(other) for other in others) == ANEW - 1:
        warnings.warn(
            f"{_names(functions)} is made anew each time, and a program is compiled for it each "
            "time: define it once, outside the loop, and give its numbers by the fluid, the flow "
            "or the state",
            stacklevel=5,
        )
    others.append(functions)
    return True


def _codes(functions):
    """What the functions do, or None where one has no code of its own."""
    codes = tuple(getattr(getattr(f, "observe", f), "__code__", None) for f in functions)
    return None if None in codes else codes


def _names(functions) -> str:
    return " and ".join(getattr(getattr(f, "observe", f), "__name__", repr(f)) for f in functions)
