"""Bonds of spheres: contacts followed from frame to frame, with a band between forming and
breaking."""

import dataclasses

import numpy as np

from dpdjax.drawing import curve
from dpdjax.engine.trajectory import Trajectory
from dpdjax.measure.blocks import average, pieces_of_member, standard_error
from dpdjax.measure.contacts import spheres_and_gap
from dpdjax.measure.results import Result
from dpdjax.measure.spheres import Spheres, close_pairs, frames_of
from dpdjax.measure.statistics import Estimate

SURVIVAL_PIECES = 4
"""Independent pieces that the lags of the survival leave unless told otherwise, replicas counted.
"""


@dataclasses.dataclass(frozen=True, repr=False)
class Bonds(Result):
    """Bonds that form closer than they break.

    Attributes:
        time: of each frame, (frames,) [time].
        number: bonds in each frame, (batch, frames).
        formed: since the frame before, 0 in the first, (batch, frames).
        broken: as many as ended since then, (batch, frames).
        per_colloid: bonds that a sphere has, over spheres and frames; each bond counts for both of
            its ends.
        lag: times from 0, (lags,) [time].
        survival: share of the bonds of a frame that were there without a break up to ``lag`` later,
            (lags,); NaN where there was no bond.
        error: standard error of ``survival``, (lags,); NaN where there is a single piece.
    """

    time: np.ndarray
    number: np.ndarray
    formed: np.ndarray
    broken: np.ndarray
    per_colloid: Estimate
    lag: np.ndarray
    survival: np.ndarray
    error: np.ndarray

    def plot(self, ax=None):
        """Draw the survival with its error band; returns the matplotlib axes."""
        return curve(
            ax, self.lag, self.survival, self.error, "t [time]", "share of bonds that survive"
        )


def contact_bonds(
    what: Trajectory | Spheres,
    *,
    gap: float | None = None,
    forms: float = 0.8,
    breaks: float = 1.0,
    t_max: float | None = None,
) -> Bonds:
    """Bonds with hysteresis: one forms at ``h < forms gap`` and breaks at ``h > breaks gap``.

    The band between keeps a pair that trembles at the limit from counting as many bonds. In the
    first frame the pairs below ``forms gap`` are bonded. What happens between two frames goes
    unseen: record them closer than bonds live.

    Survival looks at the bonds of every frame that the longest lag still finds an end for. Its
    error comes from replicas, and stretches of time at least twice the longest lag.

    Args:
        what: :class:`Spheres`, or a run as :func:`spheres` takes it.
        gap: surface gap [length], as in :func:`contact_number`.
        forms, breaks: fractions of the gap, ``0 < forms <= breaks``.
        t_max: longest lag of the survival [time]; by default as long as leaves 4 independent
            pieces.

    Raises ValueError for fractions out of order, a ``t_max`` outside the run, and as
    :func:`contact_number` does.

    Example:
        >>> found = dpd.measure.contact_bonds(gel, gap=0.2)
        >>> found.number.shape
        (1, 24)
        >>> count = found.number[0]
        >>> bool(np.all(np.diff(count) == (found.formed - found.broken)[0, 1:]))
        True
    """
    what, keys = _followed(what, gap, forms, breaks)
    # Entry [member, a, b]: bonds that were there from frame a or before to frame b or after.
    lasting = np.stack([_lasting(member) for member in keys])
    number, kept = (np.einsum("baa->ba", counts) for counts in (lasting, lasting[:, :-1, 1:]))
    formed, broken = (
        np.pad(there - kept, ((0, 0), (1, 0))) for there in (number[:, 1:], number[:, :-1])
    )
    per_colloid = average(2 * number / what.n)
    return Bonds(
        what.time, number, formed, broken, per_colloid, *_survival(what.time, lasting, t_max)
    )


def bonded_pairs(
    what: Trajectory | Spheres, *, gap: float | None = None, forms: float = 0.8, breaks: float = 1.0
) -> list[list[np.ndarray]]:
    """The bonds of :func:`contact_bonds` as pairs of indices ``i < j``, (bonds, 2), by member and
    frame: ``pairs[member][frame]``.

    Arguments and errors as in :func:`contact_bonds`.

    Example:
        >>> pairs = dpd.measure.bonded_pairs(gel, gap=0.2)
        >>> len(pairs), len(pairs[0]), pairs[0][-1].shape[1]
        (1, 24, 2)
    """
    what, keys = _followed(what, gap, forms, breaks)
    return [[np.stack(np.divmod(bonded, what.n), axis=1) for bonded in member] for member in keys]


def _followed(what, gap, forms, breaks):
    """The spheres, and the bonds as sorted numbers ``i n + j`` by member and frame."""
    if not 0 < forms <= breaks < np.inf:
        raise ValueError(
            f"forms is {forms!r} and breaks {breaks!r}; they are fractions of the gap, 0 < forms "
            "<= breaks"
        )
    what, gap = spheres_and_gap(what, gap)
    spheres_and_gap(what, breaks * gap)
    members = []
    for member in range(len(what.position)):
        keys = [np.array([], int)]
        for frame in frames_of(what, member):
            pairs = close_pairs(frame, np.nextafter(breaks * gap, np.inf))
            key = pairs.first * what.n + pairs.second
            keys.append(np.sort(key[(pairs.gap < forms * gap) | np.isin(key, keys[-1])]))
        members.append(keys[1:])
    return what, members


def _lasting(keys):
    """Bonds that were there in all of the frames a to b: entry [a, b] for a <= b, (frames,
    frames)."""
    spans = np.zeros((len(keys), len(keys)), int)
    alive, born = np.array([], int), np.array([], int)
    for now, there in enumerate([*keys, np.array([], int)]):
        stays = np.isin(alive, there)
        np.add.at(spans, (born[~stays], now - 1), 1)
        new = np.setdiff1d(there, alive)
        alive = np.concatenate([alive[stays], new])
        born = np.concatenate([born[stays], np.full(len(new), now)])
    # spans[a, b]: from a to b exactly. Add those that began earlier or ended later.
    return np.cumsum(np.cumsum(spans, axis=0)[:, ::-1], axis=1)[:, ::-1]


def _survival(time, lasting, t_max):
    """Lags, the share that survives, and its error, (lags,) each, from counts (batch, frames,
    frames)."""
    batch, frames = lasting.shape[:2]
    interval = _interval(time)
    longest = _longest_lag(frames, batch, interval, t_max)
    each = pieces_of_member(batch, frames, longest)
    length, lags = frames // each, np.arange(longest + 1)
    origins = length * np.arange(each)[:, None, None] + np.arange(length - longest)[:, None]
    counts = lasting[:, origins, origins + lags].sum(axis=2).reshape(-1, longest + 1)
    with np.errstate(invalid="ignore"):
        shares, total = counts / counts[:, :1], counts.sum(axis=0)
        return interval * lags, total / total[0], standard_error(shares)


def _interval(time) -> float:
    """Time between two frames; 0 for a single one."""
    steps = np.diff(time) if len(time) > 1 else np.zeros(1)
    # Times in single precision are off by a part of a step late in a long run.
    if not np.allclose(steps, np.mean(steps), rtol=0.05, atol=0):
        raise ValueError(
            f"frames are between {steps.min():.4g} and {steps.max():.4g} apart; lags need them "
            "evenly spaced"
        )
    return float(np.mean(steps))


def _longest_lag(frames, batch, interval, t_max) -> int:
    """The longest lag in frames."""
    if t_max is None:
        return min(frames - 1, max(1, frames // (2 * -(-SURVIVAL_PIECES // batch))))
    run = interval * (frames - 1)
    if not 0 < t_max <= run * (1 + 1e-4):
        raise ValueError(
            f"t_max is {t_max:.6g}; it must be above zero and within the run, {run:.6g}"
        )
    return int(t_max / interval + 1e-4)
