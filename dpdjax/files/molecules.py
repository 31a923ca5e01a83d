"""Bonds, angles and dihedrals as files have them: of each kind the names of its types, and of every
bond its type and the rows of its beads in the file."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dpdjax.engine.state import State
from dpdjax.model.bonded import BEADS
from dpdjax.model.fluid import Fluid

PLURAL = {kind: f"{kind}s" for kind in BEADS}
"""What the kinds are called in a GSD file, and as arguments of :func:`dpdjax.fluid`."""
STRANGE = ("impropers", "constraints", "pairs")
"""What else a frame of a GSD file can have between beads, and no fluid has."""


@dataclasses.dataclass(frozen=True)
class Rows:
    """The bonds, angles or dihedrals of a file.

    Attributes:
        types: their names.
        typeid: of each the place of its type among those (count,).
        group: the rows of its beads in the file (count, 2 to 4).
    """

    types: Sequence[str]
    typeid: np.ndarray
    group: np.ndarray

    @property
    def chunks(self) -> dict[str, Any]:
        """By the names in a GSD file."""
        own = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {"N": len(self.group)} | own

    def of_type(self, name: str) -> np.ndarray:
        """The rows of the beads of one type."""
        return self.group[self.typeid == self.types.index(name)].astype(np.int64)

    @property
    def used(self) -> list[str]:
        """The types that there are bonds of."""
        return [self.types[k] for k in np.unique(self.typeid)]


def names(fluid: Fluid, kind: str) -> list[str]:
    """The types of a kind that a fluid has, in turn."""
    return [b.name for b in fluid.bonded if b.kind == kind]


def rows_of(fluid: Fluid, state: State, slots: np.ndarray) -> dict[str, Rows]:
    """By kind the bonds of a state among the beads in ``slots``, which are written in that order;
    those with other beads are left out. Empty for a state without bonds."""
    if state.topology is None:
        return {}
    beads = {name: np.asarray(ids) for name, ids in state.topology.beads.items()}
    row = np.full(state.n, -1)
    row[np.asarray(state.id)[slots]] = np.arange(len(slots))
    found = {}
    for kind, width in BEADS.items():
        types = [name for name in names(fluid, kind) if name in beads]
        groups = [row[beads[name]] for name in types]
        groups = [group[np.all(group >= 0, axis=1)] for group in groups]
        if types:
            typeid = np.repeat(np.arange(len(types)), [len(group) for group in groups])
            group = np.concatenate(groups).reshape(-1, width)
            found[kind] = Rows(types, typeid.astype(np.uint32), group.astype(np.uint32))
    return found


def put(frame, rows: Mapping[str, Rows]) -> None:
    """Bonds into a frame of a GSD file; it stores them once, for as long as they stay the same."""
    for kind, of_kind in rows.items():
        for name, value in of_kind.chunks.items():
            setattr(getattr(frame, PLURAL[kind]), name, value)


def taken(frame) -> dict[str, Rows]:
    """By kind the bonds of a frame of a GSD file; ValueError for what no fluid has."""
    for name in STRANGE:
        if getattr(frame, name).N:
            raise ValueError(
                f"the file has {getattr(frame, name).N} {name}, and there is no law for them here: "
                "leave them out by groups={...}, the beads of each type of the fluid"
            )
    found = {kind: getattr(frame, plural) for kind, plural in PLURAL.items()}
    return {
        kind: Rows(numbered(b.types or [], b.typeid), b.typeid, b.group.reshape(-1, BEADS[kind]))
        for kind, b in found.items()
        if b.types or b.N
    }


def numbered(types: Sequence[str], typeid: np.ndarray) -> list[str]:
    """Names of types, and after them the numbers, from 1, of those that have none."""
    count = int(typeid.max()) + 1 if len(typeid) else 0
    return [*types, *(str(k + 1) for k in range(len(types), count))]


def are_same(frame, rows: Mapping[str, Rows]) -> bool:
    """Whether a frame of a GSD file has these bonds and no others."""
    for kind, plural in PLURAL.items():
        there, own = getattr(frame, plural), rows.get(kind)
        if own is None or not len(own.group):
            if there.N:
                return False
        elif not all(np.array_equal(getattr(there, k), v) for k, v in own.chunks.items()):
            return False
    return True


def groups_of(fluid: Fluid, rows: Mapping[str, Rows]) -> dict[str, np.ndarray]:
    """By the names of the types of a fluid the rows of the beads in the file.

    Raises ValueError for bonds of a type that the fluid lacks, and for a type of the fluid that the
    file does not know.
    """
    found = {}
    for kind, plural in PLURAL.items():
        wanted, own = names(fluid, kind), rows.get(kind)
        strange = [] if own is None else [name for name in own.used if name not in wanted]
        if strange:
            raise ValueError(
                f"the file has {plural} of the types {_told(strange)}, and the fluid has "
                f"{_told(wanted)}: give it those, {plural}={{{strange[0]!r}: dpd.term(...)}}, or "
                "say which beads are bonded by groups={...}"
            )
        missing = [name for name in wanted if own is None or name not in own.types]
        if missing:
            raise ValueError(
                f"the fluid has {plural} of the types {_told(missing)}, and the file has "
                f"{_told([] if own is None else own.types)}: say which beads they are of, by their "
                f"rows in the file, groups={{{missing[0]!r}: rows, ...}}"
            )
        found |= {name: own.of_type(name) for name in wanted}
    return found


def bonded(
    state: State, fluid: Fluid, groups: Mapping[str, Any], order: np.ndarray, exclude: int
) -> State:
    """A state with the bonds of a file; ``order`` (n,): the row of each bead. As it was where no
    groups are given.

    Raises TypeError for groups that are not by name; ValueError for those of other types than the
    fluid has, and as :meth:`State.bonded` does.
    """
    if not isinstance(groups, Mapping):
        raise TypeError(f"groups is {groups!r}; give the beads of each type, {{name: rows}}")
    if not groups:
        return state
    types = [b.name for b in fluid.bonded]
    if set(groups) != set(types):
        raise ValueError(
            f"groups has the types {_told(groups)}, and the fluid {_told(types)}: give the beads "
            "of each, {name: rows}"
        )
    slot = np.empty_like(order)
    slot[order] = np.arange(len(order))
    return state.bonded({k: _moved(rows, slot) for k, rows in groups.items()}, exclude=exclude)


def _moved(rows, slot: np.ndarray):
    """Rows of the file as ids of the state; what is none as it is, which the state refuses."""
    rows = np.asarray(rows)
    is_known = rows.dtype.kind in "iu" and np.all((rows >= 0) & (rows < len(slot)))
    return slot[rows] if is_known else rows


def _told(types) -> str:
    return ", ".join(map(repr, types)) or "none"
