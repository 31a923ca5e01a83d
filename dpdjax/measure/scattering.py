"""What spheres scatter: the structure factor."""

import dataclasses
import functools

import numpy as np

from dpdjax.drawing import curve
from dpdjax.engine.trajectory import Trajectory
from dpdjax.measure import needs
from dpdjax.measure.blocks import error_of
from dpdjax.measure.reading import chosen_beads
from dpdjax.measure.results import Result
from dpdjax.measure.spheres import Spheres, as_spheres, by_frame, of_run, shift_of, spheres
from dpdjax.measure.structure import whole_bins
from dpdjax.model.colloids import solvent_reach


@dataclasses.dataclass(frozen=True, repr=False)
class StructureFactor(Result):
    """The structure factor, by shells that hold a wave vector.

    Attributes:
        q: mean length of the wave vectors in each shell, (shells,) [1/length].
        s: mean of S over them, (shells,).
        error: standard error of ``s``, (shells,); NaN where there is a single frame.
        vectors: wave vectors in each shell, both of each opposite two counted, (shells,); the mean
            over frames.
    """

    q: np.ndarray
    s: np.ndarray
    error: np.ndarray
    vectors: np.ndarray

    def plot(self, ax=None):
        """Draw S with its error band; returns the matplotlib axes."""
        return curve(ax, self.q, self.s, self.error, "q [1/length]", "S(q)")


def structure_factor(
    what: Trajectory | Spheres,
    *,
    species: int | None = None,
    q_max: float | None = None,
    bins: int = 60,
) -> StructureFactor:
    """The structure factor at the wave vectors of the box.

    ``S(q) = |sum exp(-i q . r)|^2 / n``, where q is ``2 pi m / L``, and in a tilted box
    ``2 pi (m_x / L_x, m_y / L_y - strain m_x / L_x, m_z / L_z)``, which changes from frame to
    frame. All spheres count alike, whatever their radii. Averages run over the wave vectors of a
    shell, so over all directions, and over frames; shells without any are left out.

    The error is that of the scatter between stretches of frames. Of one gel, whose frames are all
    alike, it leaves out that the box holds few wave vectors: ``s / sqrt(vectors / 2)``.

    Args:
        what: :class:`Spheres`, or a run as :func:`spheres` takes it.
        species: of a run, whose beads scatter, spheres or points; by default the spheres.
        q_max: largest wave vector [1/length], by default 2 pi over the mean radius, of points over
            their reach. The work grows as its cube.
        bins: shells of equal width between 0 and ``q_max``.

    Raises ValueError for ``q_max`` below the smallest wave vector, and as :func:`spheres` does.

    Example:
        >>> found = dpd.measure.structure_factor(rest, species=0, q_max=6.0, bins=10)
        >>> round(float(found.q[0]), 4)  # 2 pi over the side
        1.5708
        >>> bool(found.s[0] < 1)  # dense fluids hardly scatter at small q
        True
    """
    needs.warn_of_ages(what, "S(q)")
    what = as_spheres(what) if species is None else _of_species(what, species)
    bins = whole_bins(bins)
    q_max = 2 * np.pi / np.mean(what.radius) if q_max is None else float(q_max)
    lowest = 2 * np.pi / np.max(what.lengths)
    if not q_max >= lowest * (1 - 1e-9):
        raise ValueError(
            f"q_max is {q_max:.6g}; it must reach the smallest wave vector of the box, {lowest:.6g}"
        )
    # Vectors of one length stay together where it falls on an edge of a shell.
    q_max = q_max * (1 + 1e-9)
    indices = _indices(what, q_max)
    waves = functools.lru_cache(1)(
        lambda shift: _wave_vectors(what.lengths, shift, indices, q_max, bins)
    )

    def sums_of_shells(frame):
        q, shell = waves(frame.shift)
        weights = (None, q.ravel(), _spectrum(frame, indices).ravel())
        return np.stack([np.bincount(shell, w, bins + 1)[:bins] for w in weights])

    # Sums before quotients: a shell holds other vectors, or none, in another frame.
    sums = by_frame(what, sums_of_shells)
    there = sums[:, :, 0].sum(axis=(0, 1)) > 0
    vectors, q, s = sums.mean(axis=(0, 1))[:, there]
    # Of a quotient of sums; a tilt changes the vectors of a shell little.
    scattered = (sums[:, :, 2, there] - s / vectors * sums[:, :, 0, there]) / vectors
    return StructureFactor(q / vectors, s / vectors, error_of(scattered), 2 * vectors)


def _of_species(trajectory, species: int) -> Spheres:
    """The beads of a species, points as spheres as large as their reach."""
    if not hasattr(trajectory, "frames"):
        raise TypeError("species=... is of a run; the spheres given are of one already")
    needs.finished(trajectory)
    beads = chosen_beads(trajectory, species)
    if trajectory.fluid.radius[species] is not None:
        return spheres(trajectory, species=species)
    return of_run(trajectory, beads, np.full((1, len(beads)), solvent_reach(trajectory.fluid)))


def _indices(what, q_max):
    """Indices along x, y, z of all wave vectors up to ``q_max``, whatever the tilt; x is not
    negative, one of each opposite two."""
    x, y, z = (q_max * what.lengths / (2 * np.pi)).astype(int)
    tilt = np.max(np.abs(shift_of(what.strain, what.lengths))) / what.lengths[0]
    y += int(np.ceil(x * tilt))
    return [np.arange(x + 1), np.arange(-y, y + 1), np.arange(-z, z + 1)]


def _wave_vectors(lengths, shift, indices, q_max, bins):
    """Length of each wave vector (x, y, z), and its shell; those left out are in shell ``bins``."""
    x, y, z = np.meshgrid(*indices, indexing="ij")
    lx, ly, lz = lengths
    q = 2 * np.pi * np.sqrt((x / lx) ** 2 + ((y - x * shift / lx) / ly) ** 2 + (z / lz) ** 2)
    kept = (q < q_max) & ((x > 0) | (y > 0) | ((y == 0) & (z > 0)))
    return q, np.where(kept, (q * (bins / q_max)).astype(int), bins).ravel()


def _spectrum(frame, indices):
    """``|sum exp(-i q . r)|^2 / n`` of each wave vector, (x, y, z)."""
    place = frame.position.copy()
    place[:, 0] -= frame.shift / frame.lengths[1] * place[:, 1]
    phase = 2 * np.pi * place / frame.lengths
    x, y, z = (np.exp(-1j * phase[:, axis, None] * m) for axis, m in enumerate(indices))
    waves = np.stack([(along[:, None] * y).T @ z for along in x.T])
    return (waves.real**2 + waves.imag**2) / len(frame.position)
