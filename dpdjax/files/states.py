"""States on disk: one ``.npz`` file that any numpy reads."""

import contextlib
import dataclasses
import json
import os
import zipfile

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.bonded.topology import Topology
from dpdjax.checks import file_name
from dpdjax.engine.rotation import Rotation
from dpdjax.engine.state import State, assemble
from dpdjax.errors import FileError
from dpdjax.pairs import neighbours as lists
from dpdjax.pairs.box import box

FORMAT = 9


def refuse_existing(path, cure: str) -> None:
    """Raise FileExistsError, with the cure, for a file that is there."""
    if os.path.exists(path):
        raise FileExistsError(f"{path} is there already; give another name, or {cure}")


@contextlib.contextmanager
def replacing(path):
    """A binary file that takes its name when it is whole: until then, and after an error, an old
    one stays as it was."""
    unfinished = f"{os.fspath(path)}.part"
    try:
        with open(unfinished, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, path)
        _settle(path)
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.remove(unfinished)


def _settle(path):
    """See to it that a name outlasts a loss of power, where the system can."""
    with contextlib.suppress(OSError):
        folder = os.open(os.path.dirname(os.path.abspath(path)), os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def save_state(path: str | os.PathLike, state: State) -> None:
    """Write a state; ``load_state`` gives back the same bits, lists and all.

    A run goes on from it exactly, given the key it was started with. A file of that name is
    replaced when the new one is whole.

    Example:
        >>> dpd.save_state("state.npz", state)
        >>> bool(np.all(dpd.load_state("state.npz").velocity == state.velocity))
        True
    """
    save(path, state, {}, np.savez_compressed)


def load_state(path: str | os.PathLike) -> State:
    """Read what ``save_state`` wrote.

    Raises FileError where the file is no such state, of another format, or needs float64 that is
    off; ValueError for a name that is none.

    Example:
        >>> dpd.save_state("state.npz", state)
        >>> dpd.load_state("state.npz")
        State(192 beads, box 4 x 4 x 4, step 200, time 2)
    """
    return load(path)[0]


def save(path, state: State, more: dict, save_arrays=np.savez) -> None:
    """Write a state, and ``more`` that JSON holds, uncompressed unless told otherwise."""
    arrays = _by_name(dataclasses.replace(state, neighbours=()))
    for k, n in enumerate(state.neighbours):
        arrays |= {f"neighbours.{k}.{name}": x for name, x in lists.arrays_of(n).items()}
    meta = {
        "format": FORMAT,
        "grids": [_written(n.grid) for n in state.neighbours],
        "origins": list(state.tally.virial),
        "rotation": None if state.rotation is None else state.rotation.begin,
        "topology": _types(state.topology),
        "more": more,
    }
    with replacing(path) as file:
        arrays = {name: np.asarray(x) for name, x in arrays.items()}
        save_arrays(file, meta=json.dumps(meta), **arrays)


def load(path) -> tuple[State, dict]:
    """Read what :func:`save` wrote; raises as :func:`load_state` does."""
    file_name(path, "path")
    try:
        with np.load(path) as file:
            saved = dict(file)
        meta = json.loads(str(saved.pop("meta")))
    except (ValueError, KeyError, TypeError, EOFError, OSError, zipfile.BadZipFile) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise FileError(
            f"{path} is not a dpdjax state, or a damaged one; write one with dpd.save_state"
        ) from error
    if meta["format"] != FORMAT:
        raise FileError(f"{path} has format {meta['format']}, this version reads {FORMAT}")
    if saved["position"].dtype == np.float64 and not jax.config.jax_enable_x64:
        raise FileError(f"{path} holds float64; start with JAX_ENABLE_X64=1")
    try:
        state = _assembled({name: jnp.asarray(array) for name, array in saved.items()}, meta)
    except KeyError as error:
        raise FileError(
            f"{path} lacks the array {error}; save the state again with dpd.save_state"
        ) from error
    return state, meta["more"]


def _assembled(saved: dict, meta: dict) -> State:
    skeleton = _skeleton(tuple(meta["origins"]), meta["rotation"], meta["topology"])
    leaves = [saved[name] for name in _by_name(skeleton)]
    state = jax.tree.unflatten(jax.tree.structure(skeleton), leaves)
    held = tuple(_list(saved, f"neighbours.{k}.", grid) for k, grid in enumerate(meta["grids"]))
    return dataclasses.replace(state, neighbours=held)


def _types(topology: Topology | None) -> dict | None:
    """The types of bonds of a topology, and whether it leaves out pairs."""
    if topology is None:
        return None
    return {"names": list(topology.beads), "partners": topology.partners is not None}


def _skeleton(origins: tuple[str, ...], rotation: int | None, topology: dict | None) -> State:
    """A state of the same parts, without lists and without numbers."""
    beads = jnp.zeros((1, 3))
    spin = None if rotation is None else Rotation.of(beads, rotation)
    species = jnp.zeros(1, jnp.int32)
    make = lambda: assemble(box(1.0), beads, beads, species, (), origins=origins, rotation=spin)
    state = jax.eval_shape(make)
    if topology is None:
        return state
    rows = {name: species for name in topology["names"]}
    bonds = Topology(rows, rows, species if topology["partners"] else None)
    return dataclasses.replace(state, topology=bonds)


def _by_name(tree) -> dict:
    """The leaves of a tree by where they are, as ``box.lengths``."""
    name_of = lambda path: jax.tree_util.keystr(path, simple=True, separator=".")
    return {name_of(path): leaf for path, leaf in jax.tree.leaves_with_path(tree)}


def _written(grid: lists.Grid) -> dict:
    """What of a grid is saved: the kernel is one of the machine that reads it."""
    fields = {f.name: getattr(grid, f.name) for f in dataclasses.fields(grid)}
    return {name: value for name, value in fields.items() if name != "kernel"}


def _list(saved: dict, prefix: str, fields: dict) -> lists.Neighbours:
    cells, groups = fields["cells"], tuple(tuple(group) for group in fields["groups"])
    grid = lists.Grid(**{**fields, "cells": tuple(cells) if cells else None, "groups": groups})
    # Before boxes could change their sides a list was of the sides that there are.
    saved = {prefix + "lengths": saved["box.lengths"]} | saved
    return lists.restore(grid, **{name: saved[prefix + name] for name in lists.ARRAYS})
