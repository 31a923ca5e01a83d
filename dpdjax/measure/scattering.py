"""What spheres scatter: the structure factor."""

import dataclasses

import numpy as np

from dpdjax.measure.spheres import as_spheres, by_frame, shift_of
from dpdjax.measure.structure import draw, pieces_of, standard_error, whole_bins


@dataclasses.dataclass(frozen=True)
class StructureFactor:
    """The structure factor, by shells that hold a wave vector.

    Attributes:
        q: mean length of the wave vectors in each shell, (shells,) [1 / length].
        s: mean of S over them, (shells,).
        error: standard error of ``s``, (shells,); NaN where there is a single frame.
        vectors: wave vectors in each shell, both of each opposite two counted, (shells,).
    """

    q: np.ndarray
    s: np.ndarray
    error: np.ndarray
    vectors: np.ndarray

    def plot(self, ax=None):
        """Draw S with its error band; returns the matplotlib axes."""
        return draw(ax, self.q, self.s, self.error, "q [1 / length]", "S(q)")


def structure_factor(what, *, q_max: float | None = None, bins: int = 60) -> StructureFactor:
    """The structure factor ``S(q) = |sum exp(-i q . r)|^2 / n``, at the wave vectors ``2 pi m / L`` of the box.

    All spheres count alike, whatever their radii. Averages run over the wave vectors of a shell and over frames;
    shells without any are left out.

    Args:
        what: :class:`Spheres`, or a run as :func:`spheres` takes it.
        q_max: largest wave vector [1 / length], by default 2 pi over the mean radius. The work grows as its cube.
        bins: shells of equal width between 0 and ``q_max``.

    Raises ValueError for tilted frames, ``q_max`` below the smallest wave vector, and as :func:`spheres` does.
    """
    what, bins = as_spheres(what), whole_bins(bins)
    if np.any(shift_of(what.strain, what.lengths) != 0):
        raise ValueError("the box is tilted and its wave vectors change from frame to frame; measure this without shear")
    q_max = 2 * np.pi / np.mean(what.radius) if q_max is None else float(q_max)
    lowest = 2 * np.pi / np.max(what.lengths)
    if not q_max >= lowest * (1 - 1e-9):
        raise ValueError(f"q_max is {q_max:.6g}; it must reach the smallest wave vector of the box, {lowest:.6g}")
    indices, q, shell = _wave_vectors(what.lengths, q_max, bins)
    by_shell = lambda weights: np.bincount(shell, weights, bins + 1)[:bins]
    vectors = by_shell(None)
    mean = lambda values: by_shell(values.ravel())[vectors > 0] / vectors[vectors > 0]
    s = by_frame(what, lambda frame: mean(_spectrum(frame, indices)))
    return StructureFactor(mean(q), s.mean((0, 1)), standard_error(pieces_of(s)), 2 * vectors[vectors > 0])


def _wave_vectors(lengths, q_max, bins):
    """Indices along x, y, z, and length and shell of each wave vector; those left out are in shell ``bins``."""
    # Vectors of one length stay together where it falls on an edge of a shell.
    q_max = q_max * (1 + 1e-9)
    most = (q_max * lengths / (2 * np.pi)).astype(int)
    # One of each opposite two: x is not negative.
    indices = [np.arange(0 if axis == 0 else -m, m + 1) for axis, m in enumerate(most)]
    x, y, z = np.meshgrid(*indices, indexing="ij")
    q = 2 * np.pi * np.sqrt(sum((m / side) ** 2 for m, side in zip((x, y, z), lengths)))
    kept = (q < q_max) & ((x > 0) | (y > 0) | ((y == 0) & (z > 0)))
    return indices, q, np.where(kept, (q * (bins / q_max)).astype(int), bins).ravel()


def _spectrum(frame, indices):
    """``|sum exp(-i q . r)|^2 / n`` of each wave vector, (x, y, z)."""
    phase = 2 * np.pi * frame.position / frame.lengths
    x, y, z = (np.exp(-1j * phase[:, axis, None] * m) for axis, m in enumerate(indices))
    waves = np.stack([(along[:, None] * y).T @ z for along in x.T])
    return (waves.real**2 + waves.imag**2) / len(frame.position)
