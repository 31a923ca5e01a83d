"""Two runs of which one goes on where the other ended, as one."""

import dataclasses

import jax
import numpy as np


def end_to_end(parts, axis: int) -> dict:
    """Recorded values by name of parts that follow one another, as one; ``axis`` is that of the
    frames."""
    return jax.tree.map(lambda *values: np.concatenate(values, axis), *parts) if parts else {}


def joined(first, second):
    """See :meth:`dpdjax.Trajectory.__add__`."""
    _check_alike(first, second)
    _check_follows(first, second)
    both = [{name: run.frames[name] for name in first.frames} for run in (first, second)]
    frames = end_to_end(both, 1 if first.is_batch else 0)
    failed = tuple((dict(second.failed) | dict(first.failed)).items())
    return dataclasses.replace(second, frames=frames, failed=failed)


def _check_alike(first, second):
    """Raise ValueError, naming it, where two runs are of other beads, numbers or records."""
    pairs = {
        "recorded": [sorted(run.frames) for run in (first, second)],
        "recorded means of": [sorted(run.means) for run in (first, second)],
        "have frames every": [run.every for run in (first, second)],
        "have beads of shape": [np.shape(run.final.position) for run in (first, second)],
    }
    for what, (one, other) in pairs.items():
        if one != other:
            raise ValueError(f"the runs {what} {one} and {other}; only the same can be joined")
    differ = _differing(first.system, second.system)
    if differ:
        raise ValueError(
            f"the runs differ in {', '.join(differ)}; measure them one by one, or keep the numbers "
            "as they are from one to the next"
        )


def _differing(one, other) -> list[str]:
    """Names of the numbers in which two systems differ, or what kind of thing does."""
    (numbers, kind), (others, other_kind) = (
        jax.tree_util.tree_flatten_with_path(system) for system in (one, other)
    )
    if kind != other_kind:
        parts = [f.name for f in dataclasses.fields(one)]
        of = lambda system, name: jax.tree.structure(getattr(system, name))
        return [name for name in parts if of(one, name) != of(other, name)]
    return [
        str(getattr(path[-1], "name", getattr(path[-1], "key", path[-1])))
        for (path, value), (_, x) in zip(numbers, others)
        if np.shape(value) != np.shape(x) or not np.allclose(value, x, rtol=1e-6, atol=0)
    ]


def _check_follows(first, second):
    """Raise ValueError unless the second run begins where the first ended."""
    ended = np.max(np.asarray(first.frames["step"])[..., -1])
    begins = np.min(np.asarray(second.frames["step"])[..., 0])
    follows = begins > ended if second.every is None else begins == ended + second.every
    if not follows:
        due = "later" if second.every is None else f"step {ended + second.every}"
        raise ValueError(
            f"the first run ends at step {ended} and the second one's first frame is at step "
            f"{begins}, not {due}: run it from the final state of the first"
        )
