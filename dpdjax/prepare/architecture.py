"""Molecules as words: ``A5B5``, ``H3(T4)2``, ``A(A10)4``, ``[AB]5``, ``cyclo-A20``."""

import dataclasses
import re
from collections.abc import Iterator, Mapping

import numpy as np

MOST = 100_000
"""Beads of a molecule."""
CYCLO = "cyclo-"
BEAD = re.compile(r"[A-Z][a-z]*")
TOKEN = re.compile(r"([A-Z][a-z]*|[()\[\]])(\d*)")
OTHERS = "*"
"""The type of what no other name fits."""


@dataclasses.dataclass(frozen=True)
class Architecture:
    """What a molecule is made of.

    Attributes:
        word: what it was read from.
        beads: the name of each bead's species, in the order of the word.
        parent: of each bead the one before it that it is bonded to, -1 of the first (beads,).
        closes: whether the last bead of the chain is bonded to the first.
    """

    word: str
    beads: tuple[str, ...]
    parent: tuple[int, ...]
    closes: bool = False

    @property
    def n(self) -> int:
        """Number of beads."""
        return len(self.beads)

    def runs(self, size: int) -> np.ndarray:
        """All (count, size) beads one after another along the chain and out along its branches:
        two are a bond, three an angle, four a dihedral."""
        rows = [row for bead in range(self.n) if (row := self._back_from(bead, size))]
        if self.closes and size <= self.n:
            rows += [
                [(k + s) % self.n for s in range(size)] for k in range(self.n - size + 1, self.n)
            ]
        return np.array(rows, int).reshape(-1, size)

    def _back_from(self, bead: int, size: int) -> list[int] | None:
        """``size`` beads that end at this one, from the first on; None where there are fewer."""
        row = [bead]
        while len(row) < size and self.parent[row[-1]] >= 0:
            row.append(self.parent[row[-1]])
        return row[::-1] if len(row) == size else None

    def depth(self) -> np.ndarray:
        """Bonds between each bead and the first (beads,)."""
        found = np.zeros(self.n, int)
        for bead in range(1, self.n):
            found[bead] = found[self.parent[bead]] + 1
        return found


def architecture(word: str) -> Architecture:
    """Read a word.

    A capital letter, with small ones after it, is a bead of that species, and a number after it
    says how often; each is bonded to the one before it. ``(...)`` is a branch from the bead before
    it, with a number so many; ``[...]`` with a number a part of the chain so many times;
    ``cyclo-`` in front makes a ring.

    Raises ValueError, with the place, for what is none.
    """
    if not isinstance(word, str):
        raise TypeError(f'a molecule is {word!r}; give a word, such as "A5B5"')
    body = word.removeprefix(CYCLO)
    reader = _Reader(word, list(_tokens(word, body)))
    beads, parent, last = reader.chain(-1, ")]")
    if reader.tokens:
        raise ValueError(f"{word!r} closes a bracket that is not open")
    if not beads:
        raise ValueError(f"{word!r} has no bead; give a word, such as A5B5")
    closes = word.startswith(CYCLO)
    if closes and (len(beads) < 3 or parent != list(range(-1, len(beads) - 1))):
        raise ValueError(f"{word!r} is no ring: it is one chain of three beads or more")
    return Architecture(word, tuple(beads), tuple(parent), closes)


def _tokens(word: str, body: str) -> Iterator[tuple[str, str]]:
    place = 0
    while place < len(body):
        found = TOKEN.match(body, place)
        if not found:
            raise ValueError(
                f"{word!r} has {body[place]!r} where a bead or a bracket is wanted; beads begin "
                "with a capital letter, and numbers come after them"
            )
        place = found.end()
        yield found.group(1), found.group(2)


@dataclasses.dataclass
class _Reader:
    """Takes tokens off the front of a word."""

    word: str
    tokens: list[tuple[str, str]]

    def chain(self, before: int, ends: str) -> tuple[list[str], list[int], int]:
        """Beads and parents of a chain up to a bracket that closes it, numbered from 0, bonded to
        ``before``; and its last bead."""
        beads, parent, last = [], [], before
        while self.tokens and self.tokens[0][0] not in ends:
            name, count = self.tokens.pop(0)
            if name == "(" and last < 0:
                raise ValueError(
                    f"{self.word!r} branches off before there is a bead; [...] repeats a part of "
                    "the chain"
                )
            part = ([name], [-1], 0)
            if name in "([":
                count, part = self._group(name)
            for _ in range(self._times(name, count)):
                own, within, end = part
                first = len(beads)
                beads += own
                parent += [last if p < 0 else first + p for p in within]
                last = last if name == "(" else first + end
                if len(beads) > MOST:
                    raise ValueError(f"{self.word!r} has more than {MOST} beads")
        return beads, parent, last

    def _group(self, name: str):
        """The number after a group, and what is in it."""
        closing = {"(": ")", "[": "]"}[name]
        part = self.chain(-1, closing)
        if not self.tokens or self.tokens[0][0] != closing:
            raise ValueError(f"{self.word!r} opens {name!r} and does not close it")
        if not part[0]:
            raise ValueError(f"{self.word!r} has empty brackets")
        return self.tokens.pop(0)[1], part

    def _times(self, name: str, count: str) -> int:
        if count and int(count) == 0:
            raise ValueError(f"{self.word!r} has {name}0; leave it out")
        return int(count or 1)


def type_of(names: tuple[str, ...], types: Mapping[str, tuple]) -> str | None:
    """Which of the types beads of these species are of, either way round; :data:`OTHERS` where no
    name fits and there is that, else None."""
    return next(
        (t for t in types if spelt(t) in (names, names[::-1])), OTHERS if OTHERS in types else None
    )


def spelt(name: str) -> tuple[str, ...]:
    """The species in the name of a type, ``HTT`` or ``Na-Cl``."""
    return tuple(name.split("-")) if "-" in name else tuple(BEAD.findall(name))
