"""TOML files as tables whose every name is known."""

import difflib
import importlib
import inspect
import math
import os
import sys
import tomllib
from collections.abc import Callable, Iterable
from typing import Any

import dpdjax
from dpdjax.errors import ConfigError


class Section:
    """A table of a file; what is asked of it and not there, or there and not asked, is an error
    that says where.

    Attributes:
        where: its name, such as ``[flow]``.
        values: by name.
    """

    def __init__(self, values: dict[str, Any], where: str):
        self.values, self.where = values, where

    def only(self, *names: str) -> "Section":
        """The section, whose names are among these; ConfigError names the nearest otherwise."""
        for name in self.values:
            if name not in names:
                raise _unknown(name, names, f"{self.where} has")
        return self

    def one_of(self, *names: str) -> str:
        """The one of these names that is there; ConfigError for none or several."""
        there = [name for name in names if name in self.values]
        if len(there) != 1:
            what = f"both {' and '.join(there)}" if there else "none of them"
            raise ConfigError(f"{self.where} gives {what}; give one of {', '.join(names)}")
        return there[0]

    def table(self, name: str) -> "Section":
        """A table within, empty where it is not there."""
        value = self.values.get(name, {})
        if not isinstance(value, dict):
            raise ConfigError(f"{self.where} has {name} = {value!r}; it is a table, [{name}]")
        inside = name if self.where == "the file" else f"{self.where.strip('[]')}.{name}"
        return Section(value, f"[{inside}]")

    def tables(self, name: str) -> list["Section"]:
        """A list of tables within."""
        values = self.values.get(name, [])
        if not isinstance(values, list) or not all(isinstance(x, dict) for x in values):
            raise ConfigError(
                f"{self.where} has {name} = {values!r}; it is a list of tables, [[...{name}]]"
            )
        inside = self.where.strip("[]")
        return [Section(x, f"[[{inside}.{name}]] {k + 1}") for k, x in enumerate(values)]

    def get(self, name: str, kinds: type | tuple, default=None):
        """A value of these kinds; a whole number will do for a real one."""
        value = self.values.get(name, default)
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{self.where} has {name} = {value}; a finite number is wanted")
        kinds = kinds if isinstance(kinds, tuple) else (kinds,)
        kinds += (int,) if float in kinds else ()
        is_odd = isinstance(value, bool) and bool not in kinds
        if name in self.values and (is_odd or not isinstance(value, kinds)):
            wanted = {
                float: "a number",
                int: "a whole number",
                str: "a text",
                bool: "true or false",
            }
            raise ConfigError(
                f"{self.where} has {name} = {value!r}; {wanted.get(kinds[0], 'a list')} is wanted"
            )
        return value

    def need(self, name: str, kinds: type | tuple):
        """:meth:`get` of what must be there."""
        if name not in self.values:
            raise ConfigError(f"{self.where} lacks {name!r}")
        return self.get(name, kinds)

    def names(self, name: str, known: Iterable[str]) -> list[str]:
        """A list of names, each among those known."""
        found = self.get(name, list, [])
        return [_known(x, list(known), f"{self.where} has {name}") for x in found]

    def called(self, function: Callable, *arguments, **more):
        """``function(*arguments, **more)`` with the values of the section; ConfigError for what it
        does not take, and with its own errors."""
        taken = tuple(p for p in keywords(function) if p not in more)
        self.only(*taken)
        return self.guarded(lambda: function(*arguments, **self.values, **more))

    def guarded(self, work: Callable):
        """What ``work()`` gives; its errors of arguments as ConfigError with the section."""
        try:
            return work()
        except (ValueError, TypeError) as error:
            if isinstance(error, ConfigError):
                raise
            raise ConfigError(f"{self.where}: {error}") from error


def keywords(function: Callable, only: bool = False) -> list[str]:
    """Names that a function takes as keywords, those of what it hands on included; ``only`` those
    that it takes no other way."""
    names = []
    for name, parameter in inspect.signature(function).parameters.items():
        if parameter.kind == parameter.KEYWORD_ONLY or (
            parameter.kind == parameter.POSITIONAL_OR_KEYWORD and name != "key" and not only
        ):
            names.append(name)
    handed_on = {dpdjax.suspension: dpdjax.colloid_fluid, dpdjax.marbles: dpdjax.marble_fluid}
    return names + (keywords(handed_on[function]) if function in handed_on else [])


def load(path: str | os.PathLike) -> tuple[Section, str]:
    """A TOML file as a section, and its text; modules beside it can be imported from now on.

    Raises ConfigError for what is none.
    """
    beside = os.path.dirname(os.path.abspath(path))
    if beside not in sys.path:
        sys.path.insert(0, beside)
    try:
        with open(path, encoding="utf-8") as file:
            text = file.read()
        return Section(tomllib.loads(text), "the file"), text
    except OSError as error:
        raise ConfigError(f"{os.fspath(path)} cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{os.fspath(path)} is no TOML: {error}") from error


def function_named(name: str, where: str, homes: Iterable[Any]) -> Any:
    """A thing of the package by its name, or one of yours, ``"module:name"`` beside the file."""
    if ":" in name:
        return _imported(*name.split(":", 1), where)
    known = {n: home for home in homes for n in getattr(home, "__all__", dir(home))}
    return getattr(known[_known(name, list(known), where)], name)


def _imported(module: str, name: str, where: str):
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"{where}: {module}:{name} cannot be imported: {error}") from error


def _known(name, known: Iterable[str], where: str) -> str:
    if name not in known:
        raise _unknown(name, known, where)
    return name


def _unknown(name, known: Iterable[str], where: str) -> ConfigError:
    """The error for a name that is not known, with the nearest one that is."""
    plain = {other.lower(): other for other in known}
    near = difflib.get_close_matches(str(name).lower(), plain, 1)
    hint = f"near is {plain[near[0]]!r}" if near else f"there are {', '.join(known)}"
    return ConfigError(f"{where} {name!r}, which is not known; {hint}")
