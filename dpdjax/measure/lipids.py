"""Bilayers: how bonds or lipids are aligned with the normal, and the area that each takes."""

from collections.abc import Sequence

import numpy as np

from dpdjax.checks import choice, whole
from dpdjax.engine.trajectory import Trajectory
from dpdjax.measure import needs
from dpdjax.measure.blocks import average
from dpdjax.measure.bonds import rows_named
from dpdjax.measure.molecules import by_molecule, chains, matching, molecules_of
from dpdjax.measure.pools import pooled
from dpdjax.measure.reading import frame_lengths
from dpdjax.measure.replicas import refuse_scan
from dpdjax.measure.statistics import Estimate


def order_parameter(
    trajectory: Trajectory,
    name: str | None = None,
    *,
    head: int | None = None,
    normal: str = "z",
    length: int | None = None,
    species: int | Sequence[int] | None = None,
) -> Estimate:
    """The orientational order ``<3 cos^2(theta) - 1> / 2``, theta between bonds, or lipids, and the
    normal of a bilayer: 1 along it, 0 in all directions, -1/2 across it.

    Args:
        trajectory: a run recorded with ``observe=dpd.observe.positions``, batched or not, sheared
            or not.
        name: of the type of bonds that are looked at; by default the only one there is.
        head: species of the heads, for the vectors from the mean place of the head beads of a
            lipid to that of all its others, in place of bonds.
        normal: axis of the normal.
        length, species: with ``head``, which molecules, where there are several kinds; see
            :func:`chains`.

    Bonds without a length have no direction, and count as 0. Raises ValueError for another axis, a
    type of bonds that is not there, lipids without head beads or of nothing else, and as
    :func:`end_to_end` does.

    Example:
        >>> order = dpd.measure.order_parameter(chains, normal="z")
        >>> abs(order.value) < 0.1  # a melt has no direction
        True
    """
    needs.finished(trajectory)
    axis = _axis(normal)
    if head is None:
        if length is not None or species is not None:
            raise ValueError(
                "length and species choose lipids, and bonds are chosen by name; give head=..., "
                "the species of the heads, for the order of lipids"
            )
        ids, tree = rows_named(trajectory.final, "bond", name), [(1, 0)]
        vectors = by_molecule(trajectory, ids, tree, lambda x: x[:, :, 1] - x[:, :, 0])
    else:
        vectors = _from_head(trajectory, head, name, length, species)
    square = np.sum(vectors**2, axis=-1)
    share = vectors[..., axis] ** 2 / np.where(square > 0, square, 1.0)
    return pooled(np.where(square > 0, 1.5 * share - 0.5, 0.0))


def area_per_lipid(
    trajectory: Trajectory,
    *,
    normal: str = "z",
    leaflets: int = 2,
    length: int | None = None,
    species: int | Sequence[int] | None = None,
) -> Estimate:
    """The area of the box across the normal over the lipids of one leaflet [length^2].

    Args:
        trajectory: a run of a state with bonds, batched or not. At constant pressure the area is
            that of the box in each frame; else there is one, and its error is 0.
        normal: axis of the normal.
        leaflets: into which the lipids are divided evenly, 2 of one bilayer.
        length, species: of the molecules that count as lipids, as in :func:`chains`; by default all
            of more than one bead, of several kinds too.

    Raises ValueError for another axis, ``leaflets`` below 1, no bonds or no such molecule, a failed
    run, and a scan over numbers.

    Example:
        >>> round(dpd.measure.area_per_lipid(chains).value, 4)  # 8 x 8 over half of 307
        0.4169
    """
    needs.finished(trajectory)
    refuse_scan(trajectory)
    axis, leaflets = _axis(normal), whole(leaflets, "leaflets")
    found = molecules_of(trajectory)
    lipids = sum(m.count for m in matching(found, length, species))
    if not lipids:
        raise ValueError(
            f"no molecule fits length = {length}, species = {species}; there are "
            f"{'; '.join(m.told for m in found[:4])}"
        )
    sides = np.delete(frame_lengths(trajectory), axis, axis=-1)
    return average(np.prod(sides, axis=-1) * (leaflets / lipids))


def _axis(normal) -> int:
    return "xyz".index(choice(normal, ("x", "y", "z"), "normal"))


def _from_head(trajectory, head, name, length, species):
    """From the mean place of the heads of lipids to that of their other beads, (batch, frames,
    lipids, 3)."""
    head = whole(head, "head", least=0)
    if name is not None:
        raise ValueError(f"name is {name!r}, of bonds, and head is {head}, of lipids; give one")
    which = chains(trajectory, length=length, species=species)
    is_head = np.array(which.species) == head
    if np.all(is_head) or not np.any(is_head):
        raise ValueError(
            f"head is species {head}, and these molecules have {is_head.sum()} such beads of "
            f"{which.length}: {which.told}; name the species of some of their beads"
        )
    of = lambda x: x[:, :, ~is_head].mean(axis=2) - x[:, :, is_head].mean(axis=2)
    return by_molecule(trajectory, which.ids, which.tree, of)
