"""What made a run, in words and numbers that a file holds and another run is compared with."""

import dataclasses
import functools
import hashlib
import inspect
import io
import json
import math
import re
import sysconfig
import textwrap
import tokenize
import types

import jax
import numpy as np

LARGE = 64
"""Numbers of an array up to which they are written in full."""
INSTALLED = tuple({sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")})
PLAIN = (bool, int, str)


def told(value):
    """A value as what JSON holds: numbers in full, large arrays by a hash, objects by their class
    and what they hold, functions by their source and all that it refers to."""
    return _told(value, frozenset())


def _told(value, seen: frozenset):
    if value is None or type(value) in PLAIN:
        return value
    if id(value) in seen:
        return "itself"
    inside = functools.partial(_told, seen=seen | {id(value)})
    if isinstance(value, types.ModuleType):
        return value.__name__
    if isinstance(value, dict):
        return {str(name): inside(x) for name, x in value.items()}
    if isinstance(value, tuple | list):
        return [inside(x) for x in value]
    if isinstance(value, set | frozenset):
        return sorted(map(inside, value), key=json.dumps)
    if isinstance(value, functools.partial):
        return {"is": inside(value.func), "args": inside(value.args), "n": inside(value.keywords)}
    if isinstance(value, types.MethodType):
        return {"is": inside(value.__func__), "self": inside(value.__self__)}
    if isinstance(value, type):
        return _class(value)
    if inspect.isroutine(value) or hasattr(value, "__wrapped__"):
        return _function(inspect.unwrap(value), inside)
    if dataclasses.is_dataclass(value):
        parts = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        return {"is": _class(type(value))} | {name: inside(x) for name, x in parts.items()}
    if isinstance(value, float | complex | np.ndarray | np.generic | jax.Array):
        return _array(value)
    return {"is": _class(type(value)), "holds": inside(dict(getattr(value, "__dict__", {})))} | (
        {} if hasattr(value, "__dict__") else {"repr": re.sub(r" at 0x[0-9a-f]+", "", repr(value))}
    )


def _array(value):
    if isinstance(value, jax.Array) and jax.dtypes.issubdtype(value.dtype, jax.dtypes.prng_key):
        data = np.asarray(jax.random.key_data(value)).tolist()
        return {"key": data, "by": str(jax.random.key_impl(value))}
    array = np.asarray(value)
    if array.size <= LARGE and array.dtype.kind in "biuf":
        return _finite(array.tolist())
    digest = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16]
    return {"shape": list(array.shape), "sha256": digest}


def _finite(numbers):
    """Numbers, with words for those that JSON does not know."""
    if isinstance(numbers, list):
        return [_finite(x) for x in numbers]
    is_odd = isinstance(numbers, float) and not math.isfinite(numbers)
    return str(numbers) if is_odd else numbers


def _class(cls: type):
    """A class by its name; one of your own by its source too."""
    name = f"{cls.__module__}.{cls.__qualname__}"
    return name if _is_installed(cls) else {"name": name, "source": _source(cls)}


def _function(value, inside):
    """A function by its name; one of your own by its source, its defaults, and what of the world
    around it it uses."""
    name = f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', type(value))}"
    if not inspect.isfunction(value):
        return name
    around = inspect.getclosurevars(value)
    if _is_installed(value):
        return {"is": name, "of": inside(dict(around.nonlocals))} if around.nonlocals else name
    defaults = [value.__defaults__, value.__kwdefaults__]
    uses = dict(around.nonlocals) | dict(around.globals)
    found = {"is": name, "source": _source(value), "defaults": inside(defaults)}
    return found | {"uses": inside(uses)}


def _is_installed(value) -> bool:
    """Whether it is of this package, of Python or of another package, which have versions."""
    if str(getattr(value, "__module__", "")).partition(".")[0] == "dpdjax":
        return True
    try:
        return inspect.getfile(value).startswith(INSTALLED)
    except (TypeError, OSError):
        return getattr(value, "__module__", None) == "builtins"


def _source(value) -> str:
    """A hash of a source without its comments; of the code where there is none, and of lambdas, of
    which a line may hold several."""
    code = getattr(value, "__code__", None)
    try:
        text = _without_comments(textwrap.dedent(inspect.getsource(value)))
    except (OSError, TypeError):
        text = ""
    if code is not None and (not text or code.co_name == "<lambda>"):
        text += _in_words(code)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _without_comments(source: str) -> str:
    """Lines of a source that say something, without what stands behind a hash."""
    lines = source.splitlines()
    try:
        tokens = list(tokenize.generate_tokens(io.StringIO(source).readline))
    except (tokenize.TokenError, IndentationError):
        return source
    for token in tokens:
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    return "\n".join(line.rstrip() for line in lines if line.strip())


def _in_words(code: types.CodeType) -> str:
    consts = [_in_words(c) if isinstance(c, types.CodeType) else repr(c) for c in code.co_consts]
    return f"{code.co_code.hex()} {code.co_names} {consts}"


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
    return [] if before == now else [f"{name}: {' then, '.join(_short(before, now))} now"]


def _short(*values) -> list[str]:
    """Values in a few letters each; numbers of single precision as they were written."""
    if all(isinstance(x, float) for x in values):
        brief = [repr(float(f"{x:.7g}")) for x in values]
        return brief if len(set(brief)) == len(values) else [repr(x) for x in values]
    return [textwrap.shorten(str(x), 60) for x in values]
