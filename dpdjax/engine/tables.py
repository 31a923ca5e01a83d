"""What a run recorded, as tables of xarray and pandas. They are an extra: ``dpdjax[scan]``."""

import itertools

import numpy as np

from dpdjax.drawing import UNITS

CLOCKS = ("time", "step")


def xarray_module():
    """The module ``xarray``; ImportError with the cure where it is missing."""
    try:
        import xarray
    except ImportError as error:
        raise ImportError('tables need xarray: pip install "dpdjax[scan]"') from error
    return xarray


def to_xarray(trajectory):
    """See :meth:`dpdjax.Trajectory.to_xarray`."""
    xarray = xarray_module()
    own = ("member", "frame") if trajectory.is_batch else ("frame",)
    data = {}
    for name in trajectory.shapes:
        values = np.asarray(trajectory.frames[name])
        dims = own + tuple(f"{name}_{k}" for k in range(values.ndim - len(own)))
        data[name] = dims, values, {"units": UNITS[name]} if name in UNITS else {}
    clocks = {name: _in_common(*data.pop(name)) for name in CLOCKS if name in data}
    return xarray.Dataset(data, clocks)


def _in_common(dims, values, attributes):
    """A clock that all members share, once."""
    if values.ndim == 2 and np.all(values == values[:1]):
        return dims[1:], values[0], attributes
    return dims, values, attributes


def to_pandas(trajectory):
    """See :meth:`dpdjax.Trajectory.to_pandas`."""
    xarray_module()
    import pandas

    time = np.asarray(trajectory.frames["time"])
    columns = {}
    for name, shape in trajectory.shapes.items():
        letters = _components(shape[time.ndim :])
        if name == "time" or letters is None:
            continue
        values = np.asarray(trajectory.frames[name]).reshape(time.size, -1)
        columns |= {name + end: values[:, k] for k, end in enumerate(letters)}
    index = pandas.Index(time.ravel(), name="time")
    if trajectory.is_batch:
        member = np.repeat(np.arange(len(time)), time.shape[1])
        index = pandas.MultiIndex.from_arrays([member, time.ravel()], names=["member", "time"])
    return pandas.DataFrame(columns, index)


def _components(shape) -> list[str] | None:
    """Endings of the names of the components of a number, a vector or a tensor; None of else."""
    if len(shape) > 2 or any(size != 3 for size in shape):
        return None
    return [
        "_" * bool(shape) + "".join(axes) for axes in itertools.product("xyz", repeat=len(shape))
    ]
