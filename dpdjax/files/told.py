"""What made a run, in words and numbers that a file holds and another run is compared with."""

import dataclasses
import functools
import hashlib
import inspect
import re
import textwrap

import jax
import numpy as np

LARGE = 64
"""Numbers of an array up to which they are written in full."""


def told(value):
    """A value as what JSON holds: numbers in full, functions by name and source, classes by their
    fields, large arrays by a hash."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, dict):
        return {str(name): told(x) for name, x in value.items()}
    if isinstance(value, tuple | list):
        return [told(x) for x in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        parts = {f.name: told(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"is": type(value).__qualname__} | parts
    if isinstance(value, functools.partial):
        return {"is": told(value.func), "args": told(value.args), "numbers": told(value.keywords)}
    if isinstance(value, type) or callable(value):
        return _function(value)
    return _array(value)


def _array(value):
    if isinstance(value, jax.Array) and jax.dtypes.issubdtype(value.dtype, jax.dtypes.prng_key):
        return {"key": np.asarray(jax.random.key_data(value)).tolist()}
    array = np.asarray(value)
    if array.dtype == object:
        return re.sub(r" at 0x[0-9a-f]+", "", repr(value))
    if array.size <= LARGE:
        return array.tolist()
    digest = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16]
    return {"shape": list(array.shape), "sha256": digest}


def _function(value) -> str | dict:
    """A function by its name; one that is not of this package by its source and what it closes
    over too."""
    value = inspect.unwrap(value)
    name = f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', type(value))}"
    inside = inspect.getclosurevars(value).nonlocals if inspect.isfunction(value) else {}
    if name.startswith("dpdjax."):
        return {"is": name} | told(inside) if inside else name
    try:
        source = textwrap.dedent(inspect.getsource(value))
    except (OSError, TypeError):
        source = repr(getattr(getattr(value, "__code__", None), "co_code", ""))
    digest = hashlib.sha256(source.encode()).hexdigest()[:16]
    return {"is": name, "source": digest} | told(inside)


def differences(before, now, name: str = "") -> list[str]:
    """Where two told values differ, each with its name and both values."""
    if isinstance(before, dict) and isinstance(now, dict):
        names = dict.fromkeys([*before, *now])
        inside = lambda part: f"{name}.{part}".strip(".")
        return [
            line
            for part in names
            for line in differences(before.get(part), now.get(part), inside(part))
        ]
    if isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        pairs = enumerate(zip(before, now))
        return [line for k, (a, b) in pairs for line in differences(a, b, f"{name}[{k}]")]
    return [] if before == now else [f"{name}: {_short(before)} then, {_short(now)} now"]


def _short(value) -> str:
    return textwrap.shorten(str(value), 60)
