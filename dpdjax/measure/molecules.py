"""Molecules as the bonds of a state tell them: which beads, in which order, and where, in one
piece."""

import bisect
import collections
import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from dpdjax.bonded.topology import bonds_among
from dpdjax.checks import whole
from dpdjax.engine.state import State
from dpdjax.engine.trajectory import Trajectory
from dpdjax.measure import needs
from dpdjax.measure.reading import frame_lengths, recorded, strains
from dpdjax.measure.replicas import species_of

BEADS_AT_ONCE = 2**20
"""Positions held in memory at a time."""
KINDS_TOLD = 4
"""Kinds of molecules that a message names."""


@dataclasses.dataclass(frozen=True, repr=False)
class Molecules:
    """All molecules of one architecture.

    Attributes:
        ids: of their beads, (molecules, beads), in an order that is the same for all; of linear
            chains along the chain, from the end whose species come first.
        species: of each place in that order, (beads,).
        bonds: the places that are bonded, (bonds, 2), each pair once.

    Example:
        >>> found = dpd.measure.chains(chains)
        >>> found.count, found.length, found.is_linear
        (307, 5, True)
        >>> found.bonds
        ((0, 1), (1, 2), (2, 3), (3, 4))
    """

    ids: np.ndarray
    species: tuple[int, ...]
    bonds: tuple[tuple[int, int], ...]

    def __repr__(self):
        return f"Molecules({self.told})"

    @property
    def count(self) -> int:
        """How many molecules there are."""
        return self.ids.shape[0]

    @property
    def length(self) -> int:
        """Beads of a molecule."""
        return self.ids.shape[1]

    @property
    def is_linear(self) -> bool:
        """Whether each is a chain without branches and rings."""
        return self.bonds == tuple((k, k + 1) for k in range(self.length - 1))

    @property
    def told(self) -> str:
        """What they are, in words."""
        shape = "linear" if self.is_linear else "branched or ringed"
        return f"{self.count} {shape} of length {self.length}, species {_in_turn(self.species)}"

    @property
    def tree(self) -> list[tuple[int, int]]:
        """Bonds of a spanning tree (place, place next to it that comes before), in an order in
        which each place but the first is reached once."""
        near, reached, found = _neighbours(self.bonds, self.length), {0}, []
        queue = collections.deque([0])
        while queue:
            place = queue.popleft()
            new = [k for k in near[place] if k not in reached]
            reached.update(new)
            queue.extend(new)
            found += [(k, place) for k in new]
        return found


def molecules_of(what: State | Trajectory) -> tuple[Molecules, ...]:
    """The molecules of more than one bead, by architecture: those whose species and bonds are the
    same lie together, the largest number first.

    Beads are of one molecule where bonds connect them. Architectures are told from one another by
    the species of their beads and by what is bonded to what, not by the names of the bonds.

    Args:
        what: a state, or a run; of a batch the members have the same bonds.

    Raises TypeError for what is neither; ValueError for one without bonds, or a batch whose members
    differ in their bonds or in the species of their beads.

    Example:
        >>> dpd.measure.molecules_of(melt.state)
        (Molecules(307 linear of length 5, species 0 x 5),)
    """
    state = _state_of(what)
    species, bonds = _by_id(state), _bonds_of(state)
    kinds = collections.defaultdict(list)
    known = {}
    for beads, own in _connected(bonds, len(species)):
        # Molecules are mostly made one like the other: the same order does for all.
        alike = tuple(species[beads].tolist()), own
        if alike not in known:
            known[alike] = _in_order(*alike)
        order, *kind = known[alike]
        ids = beads[list(order)]
        kinds[tuple(kind)].append(ids[::-1] if _is_backwards(ids, *kind) else ids)
    found = [Molecules(np.array(ids), *kind) for kind, ids in kinds.items()]
    return tuple(sorted(found, key=lambda m: (-m.count, -m.length, m.species, m.bonds)))


def chains(
    what: State | Trajectory,
    *,
    length: int | None = None,
    species: int | Sequence[int] | None = None,
) -> Molecules:
    """The molecules of a state or a run that are meant, all of one architecture.

    Args:
        what: a state, or a run, as :func:`molecules_of` takes it.
        length: beads of a molecule, where there are molecules of several kinds.
        species: of the beads of a molecule, along a chain from either end, of a branched molecule
            in any order; or one index, where all beads of a molecule have it.

    Raises ValueError, naming what is there, where several kinds fit or none does, and as
    :func:`molecules_of` does.

    Example:
        >>> ids = dpd.measure.chains(chains, length=5).ids
        >>> ids.shape
        (307, 5)
    """
    found = molecules_of(what)
    fitting = matching(found, length, species)
    if len(fitting) == 1:
        return fitting[0]
    there = "; ".join(m.told for m in found[:KINDS_TOLD])
    more = f"; and {len(found) - KINDS_TOLD} kinds more" if len(found) > KINDS_TOLD else ""
    wrong = f"{len(fitting)} kinds of molecules fit length = {length}, species = {species}"
    raise ValueError(
        f"{wrong}, and one is measured at a time; there are {there}{more}: choose by length=... or "
        "species=[...]"
    )


def linear_chains(what, length, species) -> Molecules:
    """Those of :func:`chains`; ValueError unless they are linear."""
    found = chains(what, length=length, species=species)
    if not found.is_linear:
        raise ValueError(
            f"this measures linear chains, and the molecules are {found.told}; choose others by "
            "length=... or species=[...], or measure dpd.measure.radius_of_gyration"
        )
    return found


def matching(found: Sequence[Molecules], length, species) -> list[Molecules]:
    """Those of a length and of species, where these are given; ValueError for what is neither."""
    if length is not None:
        length = whole(length, "length", least=2)
        found = [m for m in found if m.length == length]
    if species is None:
        return list(found)
    if np.ndim(species) == 0:
        only = whole(species, "species", least=0)
        return [m for m in found if set(m.species) == {only}]
    if np.ndim(species) != 1 or not len(species):
        raise ValueError(f"species is {species!r}; give that of each bead along the chain")
    wanted = tuple(whole(k, "species", least=0) for k in species)
    return [m for m in found if wanted in _readings(m, wanted)]


def rows_of(trajectory, ids, there: int) -> np.ndarray:
    """Of beads by their ids (...) the rows of frames, which hold ``there`` beads, in each member,
    (batch, ...).

    Raises ValueError where some of these beads were not recorded.
    """
    order = np.asarray(trajectory.final.id)
    slots = np.argsort(order.reshape(-1, order.shape[-1]), axis=1)
    rows, species = slots[:, ids], species_of(trajectory)
    if there == len(species):
        return rows
    kept = np.flatnonzero(np.isin(species, np.unique(species[rows])))
    if there != len(kept):
        raise ValueError(
            f"the run recorded {there} of its {len(species)} beads, not the {len(kept)} of the "
            "species of these molecules; use observe=dpd.observe.positions"
        )
    return np.searchsorted(kept, rows)


def by_molecule(trajectory, ids, tree, measure: Callable) -> np.ndarray:
    """``measure`` of where molecules are, each in one piece, (batch, frames, molecules, ...).

    Args:
        trajectory: a run that recorded positions.
        ids: of the beads of each molecule, (molecules, beads).
        tree: bonds along which each is put together, see :attr:`Molecules.tree`.
        measure: a function of positions (frames, molecules, beads, 3) in double precision.

    Raises as :func:`dpdjax.measure.reading.recorded` and :func:`rows_of` do.
    """
    position = recorded(trajectory, "position")
    lengths, strain = frame_lengths(trajectory), strains(trajectory)
    rows = rows_of(trajectory, ids, position.shape[2])
    pieces = -(-position.shape[1] * rows[0].size // BEADS_AT_ONCE)

    def of_member(x, mine, *boxes):
        parts = zip(*(np.array_split(part, min(pieces, len(x))) for part in (x, *boxes)))
        return np.concatenate([measure(in_one_piece(a[:, mine], tree, *b)) for a, *b in parts])

    return np.stack([of_member(*member) for member in zip(position, rows, lengths, strain)])


def in_one_piece(position, tree, lengths, strain) -> np.ndarray:
    """Molecules put together from the nearest images of bonded beads, the first where it is.

    ``position`` (frames, molecules, beads, 3), wrapped or not, in boxes of sides (frames, 3) at
    strains (frames,).
    """
    x = np.array(position, float)
    for bead, before in tree:
        apart = x[:, :, bead] - x[:, :, before]
        x[:, :, bead] = x[:, :, before] + nearest_images(apart, lengths, strain)
    return x


def nearest_images(apart, lengths, strain) -> np.ndarray:
    """Separations (frames, molecules, 3) as those of nearest images, as the engine takes them."""
    lx, ly, lz = lengths.T[..., None]
    x, y, z = np.moveaxis(apart, -1, 0)
    rows = np.rint(y / ly)
    x = x - rows * (strain[:, None] * ly)
    return np.stack([x - lx * np.rint(x / lx), y - ly * rows, z - lz * np.rint(z / lz)], axis=-1)


# ------------------------------------------------------------ reading a topology


def _state_of(what) -> State:
    """The state that holds the bonds; TypeError where there is none."""
    if isinstance(what, State):
        return what
    needs.finished(what)
    return what.final


def topology_of(state: State):
    """The bonds of a state; ValueError without any."""
    if state.topology is None or not any(state.topology.counts.values()):
        raise ValueError(
            "this state has no bonds, so there is no molecule of more than one bead; give it some, "
            "state.bonded({...}), before it is run"
        )
    return state.topology


def shared_rows(values, what: str) -> np.ndarray:
    """Those of the first member (rows, k) of (rows, k) or (batch, rows, k); ValueError unless all
    are the same."""
    values = np.asarray(values)
    members = values.reshape(-1, *values.shape[-2:])
    if np.any(members != members[:1]):
        raise ValueError(
            f"the members of this batch differ in their {what}; measure them one by one: "
            "run.members()"
        )
    return members[0]


def _by_id(state: State) -> np.ndarray:
    """The species of each bead by its id (n,)."""
    ids, species = np.asarray(state.id), np.asarray(state.species)
    order = np.argsort(ids, axis=-1)
    by_id = np.take_along_axis(species, order, axis=-1)
    return shared_rows(by_id[..., None], "species")[:, 0]


def _bonds_of(state: State) -> np.ndarray:
    """All bonds of a state as ids (bonds, 2)."""
    rows = topology_of(state).beads
    return bonds_among({name: shared_rows(own, "bonds") for name, own in rows.items()})


def labels_of(state: State) -> np.ndarray:
    """The number of the molecule that each bead is of, by its id (n,); single beads are molecules
    too."""
    return _labels(_bonds_of(state), np.asarray(state.id).shape[-1])


def _labels(bonds, n: int) -> np.ndarray:
    # The package it is in takes a while to load.
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(bonds), np.int8), tuple(np.asarray(bonds).T)), (n, n))
    return connected_components(graph, directed=False)[1]


def _connected(bonds, n: int):
    """Of each molecule of more than one bead its ids in rising order, and its bonds as places
    among them."""
    label = _labels(bonds, n)
    by_molecule = np.argsort(label, kind="stable")
    first = np.searchsorted(label[by_molecule], np.arange(label.max(initial=-1) + 2))
    place = np.empty(n, int)
    place[by_molecule] = np.arange(n) - first[label[by_molecule]]
    bonded = np.unique(np.sort(bonds, axis=1), axis=0)
    bonded = bonded[np.argsort(label[bonded[:, 0]], kind="stable")]
    cuts = np.searchsorted(label[bonded[:, 0]], np.arange(len(first)))
    for k in np.flatnonzero(np.diff(first) > 1):
        own = place[bonded[cuts[k] : cuts[k + 1]]]
        yield by_molecule[first[k] : first[k + 1]], tuple(map(tuple, own.tolist()))


def _in_order(species, bonds):
    """The places of a molecule in an order that depends on its architecture alone, the species of
    that order, and its bonds."""
    near = _neighbours(bonds, len(species))
    is_linear = len(bonds) == len(species) - 1 and max(map(len, near)) <= 2
    order = _along(near, species) if is_linear else _by_surroundings(near, species)
    place = {bead: k for k, bead in enumerate(order)}
    renamed = sorted(tuple(sorted((place[a], place[b]))) for a, b in bonds)
    return tuple(order), tuple(species[k] for k in order), tuple(renamed)


def _along(near, species) -> list[int]:
    """The places of a linear chain from one end to the other."""
    order, before = [next(k for k, own in enumerate(near) if len(own) == 1)], None
    while len(order) < len(species):
        before, here = (order[-2] if len(order) > 1 else None), order[-1]
        order.append(next(k for k in near[here] if k != before))
    there = [species[k] for k in order]
    return order[::-1] if there[::-1] < there else order


def _by_surroundings(near, species) -> list[int]:
    """The places sorted by their species and what is around them: colours refined until no two are
    alike, ties between those alike broken by taking one."""
    colour = list(species)
    while True:
        classes = -1
        while classes != len(set(colour)):
            classes = len(set(colour))
            seen = [
                (colour[k], tuple(sorted(colour[j] for j in near[k]))) for k in range(len(near))
            ]
            ranks = sorted(seen)
            colour = [bisect.bisect_left(ranks, value) for value in seen]
        if classes == len(colour):
            return sorted(range(len(colour)), key=colour.__getitem__)
        tied = min(c for c, many in collections.Counter(colour).items() if many > 1)
        # The rank after that of a tie is free.
        others = [k for k, c in enumerate(colour) if c == tied][1:]
        colour = [c + 1 if k in others else c for k, c in enumerate(colour)]


def _is_backwards(ids, species, bonds) -> bool:
    """Whether a linear chain that reads the same from either end begins at the larger id."""
    linear = bonds == tuple((k, k + 1) for k in range(len(ids) - 1))
    return linear and species == species[::-1] and ids[0] > ids[-1]


def _neighbours(bonds, n: int) -> list[list[int]]:
    near = [[] for _ in range(n)]
    for a, b in bonds:
        near[a].append(b)
        near[b].append(a)
    return near


def _readings(m: Molecules, wanted) -> tuple:
    """The ways in which the species of molecules may be written."""
    if m.is_linear:
        return m.species, m.species[::-1]
    return (wanted,) if sorted(m.species) == sorted(wanted) else ()


def _in_turn(species) -> str:
    """Species along a molecule, ``0 x 3, 1``, the first few runs of them."""
    runs = []
    for k in species:
        if runs and runs[-1][0] == k:
            runs[-1][1] += 1
        else:
            runs.append([k, 1])
    told = [f"{k} x {many}" if many > 1 else f"{k}" for k, many in runs]
    return ", ".join(told[:6]) + (", ..." if len(told) > 6 else "")
