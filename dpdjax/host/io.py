"""States on disk: one ``.npz`` file that any numpy reads."""

import contextlib
import dataclasses
import json
import os
import zipfile

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.engine import neighbours as lists
from dpdjax.engine.box import Box
from dpdjax.engine.rotation import Rotation
from dpdjax.engine.state import State, Tally

FORMAT = 5
TURNING = ("velocity", "torque", "orientation", "orientation_rest")
ARRAYS = (
    "position",
    "velocity",
    "force",
    "image",
    "id",
    "species",
    "size",
    "step",
    "time",
    "started",
    "status",
)
ARRAYS += ("position_rest", "strain_rest", "time_rest")


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
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.remove(unfinished)


def save_state(path, state: State) -> None:
    """Write a state; ``load_state`` gives back the same bits, lists and all.

    A run goes on from it exactly, given the key it was started with. A file of that name is
    replaced when the new one is whole.
    """
    arrays = {name: np.asarray(getattr(state, name)) for name in ARRAYS}
    arrays |= {
        "box_lengths": np.asarray(state.box.lengths),
        "box_strain": np.asarray(state.box.strain),
    }
    arrays |= {"tally_energy": np.asarray(state.tally.energy)}
    arrays |= {f"tally_virial_{origin}": np.asarray(v) for origin, v in state.tally.virial.items()}
    for k, n in enumerate(state.neighbours):
        arrays |= {
            f"list{k}_pairs": np.asarray(n.list.idx),
            f"list{k}_reference": np.asarray(n.list.reference_position),
            f"list{k}_code": np.asarray(n.list.error.code),
            f"list{k}_strain": np.asarray(n.strain),
        }
    if state.rotation is not None:
        arrays |= {
            f"rotation_{name}": np.asarray(getattr(state.rotation, name)) for name in TURNING
        }
    grids = [dataclasses.asdict(n.grid) for n in state.neighbours]
    with replacing(path) as file:
        meta = {"format": FORMAT, "grids": grids, "origins": list(state.tally.virial)}
        meta |= {"turning_from": None if state.rotation is None else state.rotation.begin}
        np.savez_compressed(file, meta=json.dumps(meta), **arrays)


def load_state(path) -> State:
    """Read what ``save_state`` wrote.

    Raises ValueError where the file is no such state, or needs float64 that is off.
    """
    try:
        with np.load(path) as file:
            saved = dict(file)
        meta = json.loads(str(saved.pop("meta")))
    except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is not a dpdjax state; write one with dpd.save_state") from error
    if meta["format"] != FORMAT:
        raise ValueError(f"{path} has format {meta['format']}, this version reads {FORMAT}")
    if saved["position"].dtype == np.float64 and not jax.config.jax_enable_x64:
        raise ValueError(f"{path} holds float64; start with JAX_ENABLE_X64=1")
    try:
        return _assembled({name: jnp.asarray(array) for name, array in saved.items()}, meta)
    except KeyError as error:
        raise ValueError(
            f"{path} lacks the array {error}; save the state again with dpd.save_state"
        ) from error


def _assembled(saved, meta) -> State:
    return State(
        **{name: saved[name] for name in ARRAYS},
        box=Box(saved["box_lengths"], saved["box_strain"]),
        neighbours=tuple(_list(saved, k, grid) for k, grid in enumerate(meta["grids"])),
        tally=Tally(
            saved["tally_energy"],
            {origin: saved[f"tally_virial_{origin}"] for origin in meta["origins"]},
        ),
        rotation=_rotation(saved, meta["turning_from"]),
    )


def _rotation(saved, begin) -> Rotation | None:
    return (
        None if begin is None else Rotation(*(saved[f"rotation_{name}"] for name in TURNING), begin)
    )


def _list(saved, k, fields):
    cells, groups = fields["cells"], tuple(tuple(group) for group in fields["groups"])
    grid = lists.Grid(**{**fields, "cells": tuple(cells) if cells else None, "groups": groups})
    return lists.restore(
        grid,
        saved[f"list{k}_pairs"],
        saved[f"list{k}_reference"],
        saved[f"list{k}_code"],
        saved[f"list{k}_strain"],
    )
