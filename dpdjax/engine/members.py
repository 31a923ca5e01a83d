"""One program for a run or for a batch of them, each on a core of its own where there are any."""

import os
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.engine import compiling
from dpdjax.xla import on_cpu


def called(
    function,
    system,
    state,
    key,
    *rest,
    static: dict | None = None,
    functions: tuple = (),
    making: Callable = lambda: None,
):
    """What a jitted ``function(system, state, key, *rest, **static)`` gives, of one or of a batch.

    An accelerator has all members side by side in one program, which the function is to be of. A
    CPU, whose caches hold one box but not many, has the program of a single run, each member on a
    core of its own, as many at a time as there are cores. ``functions`` and ``making`` are those of
    :func:`compiling.program`.
    """
    is_apart = bool(key.ndim) and on_cpu()
    # Arrays, weak as they were: what a plain number is another thread would decide by its settings.
    system, rest = jax.tree.map(jnp.asarray, (system, rest))
    of = lambda k: (system.member(k), _taken(state, k), key[k], *rest)
    arguments = of(0) if is_apart else (system, state, key, *rest)
    program = compiling.program(function, arguments, static or {}, functions, making)
    if not is_apart:
        return program(*arguments)
    return jax.tree.map(jnp.asarray, on_cores(program, of, len(key)))


def cores() -> int:
    """Cores that this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def on_cores(program: Callable, arguments_of: Callable, count: int):
    """``program(*arguments_of(k))`` for each ``k < count``, as many at a time as there are cores;
    the results one upon the other, arrays of the host."""
    whole = _Stack(count)
    with ThreadPoolExecutor(cores()) as pool:
        running = {}
        for k in range(count):
            running[pool.submit(_finished, program, arguments_of(k))] = k
            if len(running) == cores():
                _collect(whole, running)
        while running:
            _collect(whole, running)
    return whole.tree


def _finished(program, arguments):
    return jax.block_until_ready(program(*arguments))


def _collect(whole, running: dict):
    """Wait for the next results and take them in."""
    for future in wait(running, return_when=FIRST_COMPLETED).done:
        whole.put(running.pop(future), future.result())


class _Stack:
    """Trees one upon the other, (count, ...) each leaf, put in one by one."""

    def __init__(self, count: int):
        self.count, self.tree = count, None

    def put(self, k: int, tree):
        tree = jax.device_get(tree)
        if self.tree is None:
            empty = lambda leaf: np.empty((self.count, *np.shape(leaf)), np.result_type(leaf))
            self.tree = jax.tree.map(empty, tree)
        jax.tree.map(lambda rows, leaf: rows.__setitem__(k, leaf), self.tree, tree)


@jax.jit
def _taken(tree, k):
    """Member ``k`` of a batch."""
    return jax.tree.map(lambda leaf: jax.lax.dynamic_index_in_dim(leaf, k, keepdims=False), tree)
