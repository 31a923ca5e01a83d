"""Compiled programs, and what they cost to be made."""

import functools
import threading
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp

from dpdjax.errors import warn

MAKING = "/jax/core/compile/"
"""Events of JAX: tracing, lowering and compiling, a program inside another included in both."""
ANEW = 3
"""Programs from one code under functions made anew, from which on it is told."""

_made: list[tuple[float, float]] = []
_programs: dict = {}
_making: dict = {}
_listening = threading.Lock()


def _listen(event: str, seconds: float, **_):
    if not event.startswith(MAKING):
        return
    start = time.monotonic() - seconds
    with _listening:
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


def program(
    function,
    arguments: tuple,
    static: dict,
    functions: tuple = (),
    making: Callable = lambda: None,
):
    """The compiled program of a jitted function for arguments like these.

    Kept, and made where there is none yet, after ``making()``. Other threads may call it: nothing
    is traced again under what is set for them. ``functions`` are among what is static. Warns where
    one code is compiled again and again because the function is another.
    """
    if jax.config.jax_disable_jit:
        return functools.partial(function, **static)
    leaves, tree = jax.tree.flatten(arguments)
    own = tuple(value for value in static.values() if value is not functions)
    settings = jax.config.jax_enable_x64, jax.config.jax_default_matmul_precision
    key = function, tree, tuple(map(_kind, leaves)), own, settings
    others = _programs.setdefault(key, {})
    if functions not in others:
        # Several threads may want it: one makes it, those that want another are not kept waiting.
        with _making.setdefault((key, functions), threading.Lock()):
            if functions not in others:
                _warn_of_twins(functions, others)
                making()
                others[functions] = function.lower(*arguments, **static).compile()
    return others[functions]


def programs() -> int:
    """How many are kept."""
    return sum(map(len, _programs.values()))


def forget():
    """Drop all programs that are kept, as ``jax.clear_caches`` does those of JAX."""
    _programs.clear()


def _kind(leaf):
    """What of an argument a program is made for."""
    weak = getattr(leaf, "weak_type", isinstance(leaf, int | float))
    return jnp.shape(leaf), jnp.result_type(leaf), weak, getattr(leaf, "sharding", None)


def _warn_of_twins(functions: tuple, others):
    codes = _codes(functions)
    if codes is not None and sum(codes == _codes(other) for other in others) == ANEW - 1:
        warn(
            f"{_names(functions)} is made anew each time, and a program is compiled for it each "
            "time: define it once, outside the loop, and give its numbers by the fluid, the flow "
            "or the state",
        )


def _codes(functions):
    """What the functions do, or None where one has no code of its own."""
    codes = tuple(getattr(getattr(f, "observe", f), "__code__", None) for f in functions)
    return None if None in codes else codes


def _names(functions) -> str:
    return " and ".join(getattr(getattr(f, "observe", f), "__name__", repr(f)) for f in functions)
