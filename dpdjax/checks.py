"""Small helpers for arguments: make a number an array, and know whether its value can be read."""

import json
import os
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

Numbers = ArrayLike | Sequence
"""What becomes an array of numbers: also a list of them, and a list of lists."""


def is_concrete(*values) -> bool:
    """True unless a value is being traced by jit, vmap or grad."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def number(value, name: str):
    """``value`` as a float array of the default precision.

    Raises TypeError where it is not a number, ValueError where it is not finite.
    """
    try:
        array = jnp.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise TypeError(
            f"{name} is {value!r}; a number or an array of numbers is wanted"
        ) from error
    if is_concrete(array, value):
        _refuse_unrepresentable(np.asarray(value, float), np.asarray(array), value, name)
    return array


def _refuse_unrepresentable(exact, array, value, name):
    """Raise ValueError where a number is not finite, or is not a normal number of the default
    precision; in double precision, where the host takes powers in the same, one whose cube is."""
    if not np.all(np.isfinite(exact)):
        raise ValueError(f"{name} is {value}; it must be finite")
    kind, power = np.finfo(array.dtype), 1 / 3 if array.dtype == np.float64 else 1
    least, largest = float(kind.tiny) ** power, float(kind.max) ** power
    if np.any(np.abs(exact) > largest) or np.any((exact != 0) & (np.abs(exact) < least)):
        raise ValueError(
            f"{name} is {value}, which {array.dtype} cannot hold (from {least:.2g} to "
            f"{largest:.2g}): choose units in which kT, masses and reaches are nearer 1, see "
            "dpd.water_units"
        )


def positive(value, name: str, cure: str = ""):
    """:func:`number`, and above zero."""
    array = number(value, name)
    if is_concrete(array) and not np.all(np.asarray(array) > 0):
        raise ValueError(f"{name} is {value}; it must be above zero{'; ' + cure if cure else ''}")
    return array


def not_negative(value, name: str):
    """:func:`number`, and zero or above."""
    array = number(value, name)
    if is_concrete(array) and not np.all(np.asarray(array) >= 0):
        raise ValueError(f"{name} is {value}; it must not be negative")
    return array


def angle(value, name: str):
    """:func:`number`, and from 0 to pi."""
    array = number(value, name)
    if is_concrete(array) and not np.all((np.asarray(array) >= 0) & (np.asarray(array) < 3.1416)):
        raise ValueError(f"{name} is {value}; it is in radians, from 0 to pi")
    return array


def one(value, name: str, check=number):
    """:func:`number`, or another check, of what is no array; TypeError with its shape for one."""
    array = check(value, name)
    if array.ndim:
        raise TypeError(f"{name} has shape {array.shape}; one number is wanted")
    return array


def plain(value, name: str, check=number) -> float:
    """:func:`one`, known now, as a number of Python."""
    if not is_concrete(value):
        raise TypeError(f"{name} is being traced by jit, vmap or grad; it must be known")
    # Inside of jit known numbers would be traced too.
    with jax.ensure_compile_time_eval():
        return float(one(value, name, check))


def whole(value, name: str, least: int = 1, most: int = 2**53) -> int:
    """``value`` as an integer; ValueError unless it is a whole number within bounds."""
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not is_number or not least <= value <= most or value % 1:
        is_large = is_number and most < value < np.inf
        bound = f"at most {most}" if is_large else f"at least {least}"
        raise ValueError(f"{name} is {value!r}; it must be a whole number of {bound}")
    return int(value)


def choice(value, known, name: str):
    """``value`` itself; ValueError unless it is one of the known words."""
    if not (value is None or isinstance(value, str)) or value not in known:
        words = [json.dumps(word) if isinstance(word, str) else str(word) for word in known]
        raise ValueError(f"{name} is {value!r}; it is {' or '.join(words)}")
    return value


def file_name(value, name: str, cure: str = "give a file name"):
    """``value`` itself; TypeError, with the cure, unless it is a name of a file or a folder."""
    if not isinstance(value, str | os.PathLike) or not os.fspath(value):
        raise TypeError(f"{name} is {value!r}; {cure}")
    return value


def truth(value, name: str) -> bool:
    """``value`` itself; TypeError unless it is True or False."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} is {value!r}; it is True or False")
    return bool(value)


def prng_key(key):
    """``key`` as a typed PRNG key; raises TypeError with the cure where it is none."""
    if key is None:
        raise TypeError("no key: every random number needs one; give key=jax.random.key(0)")
    if isinstance(key, (int, np.integer)):
        raise TypeError(f"key is the integer {key}; give jax.random.key({key})")
    if jnp.issubdtype(getattr(key, "dtype", None), jax.dtypes.prng_key):
        return key
    if getattr(key, "dtype", None) == jnp.uint32:
        return jax.random.wrap_key_data(key)
    raise TypeError(f"key is {key!r}; give jax.random.key(0)")
