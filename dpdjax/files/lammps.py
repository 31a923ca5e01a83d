"""States from data files of LAMMPS.

Read here: MDAnalysis gives them in single precision, without images, and takes velocities to be in
the order of the atoms; ASE gives bonds as text, and converts units that DPD has not.
"""

import dataclasses
import os
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dpdjax.checks import choice, file_name, whole
from dpdjax.engine.flow import Driving, Flow
from dpdjax.engine.refusals import check_fluid
from dpdjax.engine.state import State
from dpdjax.errors import FileError
from dpdjax.files import molecules
from dpdjax.files.frames import wrapped
from dpdjax.files.loading import Configuration, state_of
from dpdjax.model.bonded import BEADS
from dpdjax.model.fluid import Fluid

COLUMNS = {
    "atomic": (1, 2),
    "charge": (1, 3),
    "bond": (2, 3),
    "angle": (2, 3),
    "molecular": (2, 3),
    "full": (2, 4),
}
"""Of each style of atoms the columns of the type and of x; id is the first, and after z come three
images, or nothing."""


def load_lammps(
    path: str | os.PathLike,
    *,
    fluid: Fluid,
    atom_style: str | None = None,
    flow: Driving = None,
    groups: Mapping[str, ArrayLike] | None = None,
    exclude: int = 0,
    skin: float | None = None,
    dt: float | None = None,
    sheared: bool = True,
) -> State:
    """A state out of a data file of LAMMPS, such as its ``write_data`` writes.

    Types 1, 2, ... of atoms are the species in turn, and those of bonds, of angles and of dihedrals
    the types of each kind in the order in which the fluid has them. Numbers are taken as they are,
    as in LAMMPS's units ``lj``; coefficients are those of the fluid, not of the file. Atoms are put
    in order of their species, and of their ids within one; without velocities they are at rest.
    Step and time are 0.

    Args:
        path: file name.
        fluid: what the beads are.
        atom_style: ``"atomic"``, ``"charge"``, ``"bond"``, ``"angle"``, ``"molecular"`` or
            ``"full"``; by default what the file says behind ``Atoms #``.
        flow: what streams; its velocities are taken off, and with them what drifts along it, since
            LAMMPS has the flow at rest where its own history left it. Written during a run, the
            file wants ``write_data ... noinit``: without, atoms beyond an edge are put back
            without the step of their velocity.
        groups: by the names of the types in the fluid the atoms that are bonded, by their places in
            the order of their ids, from 0, in place of what the file says; ``{}`` for none.
        exclude: pairs up to so many bonds apart do not act on each other, as for
            :meth:`dpdjax.State.bonded` (LAMMPS: ``special_bonds``).
        skin, dt, sheared: of the lists, as for :func:`dpdjax.initial_state`.

    Raises FileError for a damaged file or one that is none; ValueError for a style of atoms that is
    not known, types, masses or bonds that are not those of the fluid, a box tilted otherwise than
    along xy.

    Example:
        >>> lines = ["two atoms", "", "2 atoms", "1 atom types", ""]
        >>> lines += [f"0 4 {axis}lo {axis}hi" for axis in "xyz"]
        >>> lines += ["", "Atoms # atomic", "", "1 1 0.5 0.5 0.5", "2 1 1.5 0.5 0.5"]
        >>> with open("two.data", "w") as file:
        ...     print(*lines, sep=chr(10), file=file)
        >>> dpd.load_lammps("two.data", fluid=water).position.tolist()
        [[0.5, 0.5, 0.5], [1.5, 0.5, 0.5]]
    """
    check_fluid(fluid)
    choice(atom_style, (None, *COLUMNS), "atom_style")
    whole(exclude, "exclude", least=0)
    rate = float(Flow.of(flow).rate_at(0.0))
    file = DataFile.read(path)
    atoms = file.atoms(atom_style)
    if groups is None:
        groups = molecules.groups_of(fluid, file.bonds(fluid, atoms.ids))
    given = file.configuration(atoms, rate)
    return state_of(fluid, given, groups, exclude, skin=skin, dt=dt, sheared=sheared)


@dataclasses.dataclass(frozen=True)
class Atoms:
    """The atoms of a file in order of their ids: those (n,), types (n,) from 1, positions (n, 3)
    and images (n, 3)."""

    ids: np.ndarray
    types: np.ndarray
    position: np.ndarray
    image: np.ndarray


@dataclasses.dataclass(frozen=True)
class DataFile:
    """A data file, taken apart.

    Attributes:
        path: its name.
        header: by what they are called (``atoms``, ``xlo xhi``) the numbers before the sections.
        sections: by their titles the lines of each, without comments.
        comments: by their titles what stands behind those.
    """

    path: str
    header: dict[str, list[float]]
    sections: dict[str, list[str]]
    comments: dict[str, str]

    @classmethod
    def read(cls, path) -> "DataFile":
        """Raises FileError for what is none."""
        file_name(path, "path")
        try:
            with open(path, encoding="utf-8") as file:
                lines = [line.partition("#") for line in file.read().splitlines()]
        except FileNotFoundError:
            raise
        except (OSError, UnicodeDecodeError) as error:
            raise FileError(f"{path} cannot be read as a data file of LAMMPS: {error}") from error
        found = cls(os.fspath(path), {}, {}, {})
        found._take(lines)
        if "Atoms" not in found.sections or not found.count("atoms"):
            raise FileError(
                f"{path} has no atoms, so is no data file of LAMMPS: write one with write_data"
            )
        return found

    def _take(self, lines):
        """Sort lines, each parted at its comment, into header and sections. The first is a comment,
        and a title is what is followed by an empty line."""
        section = None
        for (text, _, comment), (after, _, _) in zip(lines[1:], [*lines[2:], ("", "", "")]):
            text = text.strip()
            if text[:1].isalpha() and not after.strip():
                section = self.sections.setdefault(text, [])
                self.comments[text] = comment.strip()
            elif text and section is not None:
                section.append(text)
            elif text:
                numbers, name = _parted(text)
                self.header.update({name: numbers} if numbers else {})

    def count(self, what: str) -> int:
        """How many the header says there are, 0 where it does not."""
        return int(self.header.get(what, [0])[0])

    def rows(self, section: str, widths: tuple[int, ...], count: int) -> np.ndarray:
        """The numbers of a section (count, one of the widths); FileError for others."""
        lines = self.sections.get(section, [])
        try:
            rows = np.array([line.split() for line in lines], float)
        except ValueError as error:
            raise FileError(
                f"{section} of {self.path} are not rows of numbers, types by number: {error}"
            ) from error
        rows = rows if lines else np.zeros((0, widths[0]))
        if len(rows) != count or rows.shape[1] not in widths:
            raise FileError(
                f"{section} of {self.path} are {len(rows)} rows of {rows.shape[-1]} numbers, where "
                f"{count} of {' or '.join(map(str, widths))} are due"
            )
        if not np.all(np.isfinite(rows)):
            raise FileError(f"{section} of {self.path} are not all finite")
        return rows

    def atoms(self, atom_style: str | None) -> Atoms:
        """The atoms of a style, that of the file by default; ValueError for one not known."""
        kind, x = COLUMNS[self._style(atom_style)]
        rows = self.rows("Atoms", (x + 3, x + 6), self.count("atoms"))
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        ids, types = rows[:, 0].astype(int), rows[:, kind].astype(int)
        if np.any(ids[1:] == ids[:-1]) or np.any(types < 1):
            raise FileError(f"{self.path} has an id of an atom twice, or a type below 1")
        image = rows[:, x + 3 :] if rows.shape[1] == x + 6 else np.zeros((len(rows), 3))
        return Atoms(ids, types, rows[:, x : x + 3], image.astype(np.int32))

    def _style(self, given: str | None) -> str:
        """The style of the atoms, from the argument or the file."""
        words = self.comments["Atoms"].split()
        own = words[0].split("/")[0] if words else None
        if given is None and own not in COLUMNS:
            raise ValueError(
                f"the Atoms of {self.path} are of the style {own or 'that nothing tells'}: give "
                f"atom_style, one of {', '.join(COLUMNS)}, or write them so"
            )
        if given is not None and own in COLUMNS and COLUMNS[own] != COLUMNS[given]:
            raise ValueError(
                f'atom_style is "{given}", and the Atoms of {self.path} are of the style {own}'
            )
        return own if given is None else given

    def box(self) -> tuple[np.ndarray, np.ndarray, float]:
        """The corner of the box, its sides and its strain."""
        if "avec" in self.header:
            raise ValueError(
                f"the box of {self.path} is a general triclinic one: write it without "
                "triclinic/general"
            )
        try:
            edges = np.array([self.header[f"{a}lo {a}hi"] for a in "xyz"]).reshape(3, 2)
            xy, xz, yz = self.header.get("xy xz yz", (0.0, 0.0, 0.0))
        except (KeyError, ValueError) as error:
            raise FileError(f"{self.path} does not say what the box is: {error}") from error
        if xz or yz:
            raise ValueError(
                f"the box is tilted by xz = {xz:g} and yz = {yz:g}; one tilted along xy alone can "
                "run"
            )
        lengths = edges[:, 1] - edges[:, 0]
        if not np.all(lengths > 0):
            raise FileError(f"the box of {self.path} has sides {lengths.tolist()}")
        return edges[:, 0], lengths, xy / lengths[1]

    def configuration(self, atoms: Atoms, rate: float) -> Configuration:
        """The atoms in a box that streams at a rate."""
        corner, lengths, strain = self.box()
        place = atoms.position - corner
        velocity, mass = self._velocities(atoms.ids), self._masses(atoms.types)
        if rate:
            velocity[:, 0] -= rate * place[:, 1]
            velocity[:, 0] -= np.average(velocity[:, 0], weights=mass)
        position, crossed = wrapped(place, lengths, strain, np.dtype(jnp.result_type(float)))
        return Configuration(
            lengths,
            strain,
            position,
            velocity,
            atoms.image + crossed,
            atoms.types - 1,
            [str(k + 1) for k in range(atoms.types.max(initial=0))],
            mass,
        )

    def _velocities(self, ids) -> np.ndarray:
        if "Velocities" not in self.sections:
            return np.zeros((len(ids), 3))
        rows = self.rows("Velocities", (4,), len(ids))
        velocity = np.empty((len(ids), 3))
        velocity[self._places(ids, rows[:, 0], "Velocities")] = rows[:, 1:]
        return velocity

    def _masses(self, types) -> np.ndarray | None:
        """Of each atom, or None where the file does not say."""
        if "Masses" not in self.sections:
            return None
        kinds, mass = self.rows("Masses", (2,), self.count("atom types")).T
        order = np.argsort(kinds)
        return mass[order[self._places(kinds[order], types, "Atoms")]]

    def bonds(self, fluid: Fluid, ids) -> dict[str, molecules.Rows]:
        """By kind the bonds, with the names that the fluid has for their types; ValueError for
        impropers."""
        if self.count("impropers"):
            raise ValueError(
                f"{self.path} has {self.count('impropers')} impropers, and there is no law for "
                "them here: leave them out by groups={...}, the beads of each type of the fluid"
            )
        found = {}
        for kind, width in BEADS.items():
            title = molecules.PLURAL[kind].capitalize()
            rows = self.rows(title, (width + 2,), self.count(title.lower())).astype(int)
            known = molecules.names(fluid, kind)[: self.count(f"{kind} types")]
            typeid, group = rows[:, 1] - 1, self._places(ids, rows[:, 2:], title)
            found[kind] = molecules.Rows(molecules.numbered(known, typeid), typeid, group)
        return found

    def _places(self, known, wanted, section: str) -> np.ndarray:
        """Where numbers stand among sorted ones; FileError for one that is not there."""
        places = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
        wrong = np.asarray(wanted)[np.asarray(known)[places] != wanted]
        if wrong.size:
            raise FileError(
                f"{section} of {self.path} speak of number {wrong.flat[0]:g}, which is not there"
            )
        return places


def _parted(text: str) -> tuple[list[float], str]:
    """The numbers that a line of the header begins with, and what they are."""
    words, numbers = text.split(), []
    for word in words:
        try:
            numbers.append(float(word))
        except ValueError:
            break
    return numbers, " ".join(words[len(numbers) :])
