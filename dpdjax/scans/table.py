"""The table of a scan: an xarray dataset, in a netCDF file that is whole at every moment."""

import contextlib
import json
import os
import time
from collections.abc import Sequence

import numpy as np
from scipy.special import stdtrit

import dpdjax
from dpdjax import drawing
from dpdjax.checks import file_name
from dpdjax.engine.tables import xarray_module
from dpdjax.errors import FileError, warn
from dpdjax.files.gsd import writing
from dpdjax.files.locks import held
from dpdjax.files.states import replacing
from dpdjax.files.told import differences
from dpdjax.measure.statistics import from_replicas
from dpdjax.scans.drive import Outcome
from dpdjax.scans.grid import EACH, ENDINGS, ERROR, REPLICA, TAKEN, Grid, Unit

OWN = ("dpdjax", "made_by", "complete")
"""Attributes of a table that are not its maker's."""
OPEN, DONE, FAILED = 0, 1, 2
"""States of a replica."""
TEXTS = {"reason": "why it failed", "note": "what was warned of"}
"""What is told of a replica."""
UNITS = drawing.UNITS | {
    "dt": "time",
    "phi": "1",
    "box": "length",
    "density": "1/length^3",
    "contact_number": "1",
    "largest_cluster": "1",
}
LONG_NAMES = {
    "gamma": "friction",
    "kT": "thermal energy",
    "a": "repulsion",
    "rate": "shear rate",
    "dt": "time step",
    "phi": "volume fraction",
    "box": "side of the box",
    "density": "beads per volume",
    "D0": "depth of the attraction",
    "kappa": "inverse range of the attraction",
    "eta_0": "viscosity of the solvent",
    "viscosity": "shear viscosity",
    "diffusion": "diffusion coefficient",
    "temperature": "kinetic temperature",
    "contact_number": "contacts of a colloid",
    "largest_cluster": "spheres in the largest cluster",
}
"""Units and long names of what scans often hold."""


class Table:
    """What is known of a scan so far, a number for each replica of each point."""

    def __init__(self, grid: Grid, made: dict, about: dict[str, str] | None = None):
        self.grid, self.made, self.about = grid, made, about or {}
        self.status = np.zeros(grid.shape, np.int32)
        self.texts = {name: np.full(grid.shape, "", object) for name in TEXTS}
        self.cost = {name: np.zeros(grid.shape) for name in ("particle_steps", "seconds")}
        self.values: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def put(self, unit: Unit, outcome: Outcome):
        """Take in what a replica came to."""
        where = (*unit[0], unit[1])
        self.status[where] = FAILED if outcome.reason else DONE
        for name, values in self.texts.items():
            values[where] = getattr(outcome, name)
        for name, values in self.cost.items():
            values[where] = getattr(outcome, name)
        for name, estimate in outcome.values.items():
            value, error = self._of(name)
            value[where], error[where] = estimate.value, estimate.error

    def left(self) -> list[Unit]:
        """Replicas that are neither done nor failed."""
        return [(place, k) for place, k in self.grid.units() if self.status[(*place, k)] == OPEN]

    def forget_failures(self):
        """Take what failed as not yet done."""
        self.status[self.status == FAILED] = OPEN

    def told(self, name: str) -> list[str]:
        """Replicas of which a text tells something, each with it: the ``reason`` of those that
        failed, the ``note`` of those that are done."""
        of = {"reason": FAILED, "note": DONE}[name]
        return [
            f"{self.grid.named((place, k))}: {self.texts[name][(*place, k)]}"
            for place, k in self.grid.units()
            if self.status[(*place, k)] == of and self.texts[name][(*place, k)]
        ]

    def dataset(self):
        """As an ``xarray.Dataset``: of each number the mean of the replicas and its standard error,
        see :func:`_covering`; and each replica. Its attribute ``complete`` is 1 where none is
        missing."""
        xarray = xarray_module()
        axes = list(self.grid.axes)
        every, data = [*axes, REPLICA], {}
        for name, (value, error) in self.values.items():
            means, errors = _over_replicas(value, error)
            data[name] = axes, means, _attributes(name)
            data[name + ERROR] = axes, errors, _attributes(name, "standard error of the ")
            data[name + EACH] = every, value, _attributes(name, "replicas of the ")
            data[name + EACH + ERROR] = (
                every,
                error,
                _attributes(name, "errors of replicas of the "),
            )
        data["status"] = every, self.status, {"long_name": "0 open, 1 done, 2 failed"}
        for name, values in self.texts.items():
            data[name] = every, values.astype(str), {"long_name": TEXTS[name]}
        for name, values in self.cost.items():
            data[name] = every, values, {"long_name": name.replace("_", " ")}
        found = {name: (name, _axis(v), _attributes(name)) for name, v in self.grid.axes.items()}
        coordinates = found | {REPLICA: np.arange(self.grid.replicas)}
        about = {"dpdjax": dpdjax.__version__, "made_by": json.dumps(self.made)}
        about |= {"complete": int(not self.left())} | self.about
        return xarray.Dataset(data, coordinates, about)

    def take(self, dataset) -> None:
        """Take over what another table holds of the same points; FileError where the two
        contradict, or have other axes."""
        axes = list(self.grid.axes)
        theirs = {str(name) for name in dataset["status"].dims} - {REPLICA}
        if theirs != set(axes):
            raise FileError(
                f"the table has the axes {', '.join(sorted(theirs))}, the scan {', '.join(axes)}: "
                "give another store"
            )
        places = [{_plain(x): k for k, x in enumerate(dataset[name].values)} for name in axes] + [
            {int(x): k for k, x in enumerate(dataset[REPLICA].values)}
        ]
        names = [n[: -len(EACH)] for n in map(str, dataset) if n.endswith(EACH)]
        arrays = {
            name: dataset[name].transpose(*axes, REPLICA).values
            for name in map(str, dataset)
            if REPLICA in dataset[name].dims
        }
        for place, replica in self.grid.units():
            wanted = [*self.grid.point(place).values(), replica]
            if not all(x in known for x, known in zip(wanted, places)):
                continue
            there = tuple(known[x] for x, known in zip(wanted, places))
            if arrays["status"][there] == OPEN:
                continue
            here = (*place, replica)
            if self.status[here] == DONE == arrays["status"][there]:
                _check_agree(self, names, arrays, here, there)
            elif self.status[here] == DONE:
                continue  # what failed there was done here
            self.status[here] = arrays["status"][there]
            for name, values in self.texts.items():
                values[here] = str(arrays[name][there])
            for name, values in self.cost.items():
                values[here] = arrays[name][there]
            for name in names:
                value, error = self._of(name)
                value[here] = arrays[name + EACH][there]
                error[here] = arrays[name + EACH + ERROR][there]

    def _of(self, name: str):
        if name in (*self.grid.axes, *TAKEN) or name.endswith(ENDINGS):
            raise ValueError(
                f"the experiment returns {name!r}, the name of an axis or column of the table; "
                "return it under another name"
            )
        empty = lambda: np.full(self.grid.shape, np.nan)
        return self.values.setdefault(name, (empty(), empty()))


def _check_agree(table: Table, names, arrays, here, there):
    """Raise FileError where two tables hold other numbers of one replica."""
    for name in names:
        mine, other = table._of(name)[0][here], arrays[name + EACH][there]
        if not (mine == other or np.isnan(mine) or np.isnan(other)):
            where = table.grid.named((here[:-1], here[-1]))
            raise FileError(f"{name} at {where} is {mine} in one table and {other} in another")


def _axis(values) -> np.ndarray:
    """The values of an axis as a file holds them."""
    array = np.asarray(values)
    is_wide = array.dtype.kind in "iu" and np.abs(array).max() > np.iinfo(np.int32).max
    return array.astype(float) if is_wide else array


class Store:
    """A table in a file that is written again, whole, as results come."""

    def __init__(self, path: str | os.PathLike | None, seconds: float = 1.0):
        if path is not None:
            file_name(path, "store", "give the name of a netCDF file")
            if not os.fspath(path).endswith(".nc"):
                raise ValueError(
                    f"store is {os.fspath(path)!r}; it is a netCDF file, give a name in .nc"
                )
        self.path, self._seconds, self._last = path, seconds, -np.inf
        folder = os.path.dirname(os.fspath(path or "")) or "."
        if not os.path.isdir(folder):
            raise FileError(f"store is {os.fspath(path)!r}, and there is no folder {folder}")

    def begin(self, table: Table) -> None:
        """Take over what the file holds; FileError where it is of another scan."""
        if self.path is None or not os.path.exists(self.path):
            return
        dataset = load_scan(self.path)
        lines = differences(json.loads(dataset.attrs["made_by"]), table.made)
        if lines:
            raise FileError(
                f"{os.fspath(self.path)} holds another scan: {'; '.join(lines)}. Give what that "
                "began with, or another store"
            )
        table.take(dataset)
        lost = [
            f"{name} = {_plain(x)}"
            for name, values in table.grid.axes.items()
            for x in dataset[name].values
            if _plain(x) not in values
        ]
        if dataset.sizes[REPLICA] > table.grid.replicas:
            lost.append(f"{dataset.sizes[REPLICA]} replicas")
        if lost:
            raise FileError(
                f"{os.fspath(self.path)} holds what this grid lacks, {', '.join(lost[:4])}: give a "
                "grid that has it too, or another store"
            )

    @contextlib.contextmanager
    def held(self):
        """Hold the store until the end; FileError where another scan does."""
        if self.path is None:
            yield
            return
        lock = f"{os.fspath(self.path)}.lock"
        with writing(self.path), open(lock, "a"):
            pass
        with held(lock, self.path):
            try:
                yield
            finally:
                with contextlib.suppress(OSError):
                    os.remove(lock)

    def save(self, table: Table, now: bool = False) -> None:
        """Write the table, if some time has gone by since the last, or ``now``."""
        if self.path is None or not (now or time.monotonic() - self._last > self._seconds):
            return
        write(self.path, table.dataset())
        self._last = time.monotonic()


def write(path, dataset) -> None:
    """Write a dataset as netCDF, whole or not at all."""
    with writing(path), replacing(path) as file:
        dataset.to_netcdf(file.name, engine="scipy")


def load_scan(path: str | os.PathLike):
    """Read the table of a scan, an ``xarray.Dataset``; FileError for a file that is none.

    Example:
        >>> def line(key, x):
        ...     return {"y": dpd.Estimate(2.0 * x, 0.1)}
        >>> table = dpd.scan(line, {"x": [1.0, 2.0]}, key=key, store="line.nc", **quiet)
        >>> dpd.load_scan("line.nc").y.values.tolist()
        [2.0, 4.0]
    """
    xarray = xarray_module()
    try:
        with xarray.open_dataset(path, engine="scipy") as file:
            dataset = file.load()
    except FileNotFoundError:
        raise
    except (ValueError, TypeError, OSError, IndexError, KeyError) as error:
        raise FileError(
            f"{os.fspath(path)} is no table of a scan, or a damaged one: {error}"
        ) from error
    if "made_by" not in dataset.attrs:
        raise FileError(f"{os.fspath(path)} is no table of a scan: it does not tell what made it")
    return dataset


def merge_scans(paths: Sequence[str | os.PathLike], store: str | os.PathLike | None = None):
    """The tables of parts of one scan as one ``xarray.Dataset``, written to ``store`` if given.

    Raises FileError for tables of other scans, ValueError for none.

    Example:
        >>> def line(key, x):
        ...     return {"y": dpd.Estimate(2.0 * x, 0.1)}
        >>> for k in (1, 2):  # each a job of its own
        ...     grid, store = {"x": [1.0, 2.0]}, f"part-{k}.nc"
        ...     table = dpd.scan(line, grid, key=key, store=store, shard=(k, 2), **quiet)
        >>> dpd.merge_scans(["part-1.nc", "part-2.nc"]).y.values.tolist()
        [2.0, 4.0]
    """
    if not paths:
        raise ValueError("paths is empty; give the tables of the parts")
    parts = [load_scan(path) for path in paths]
    made = json.loads(parts[0].attrs["made_by"])
    for path, part in zip(paths[1:], parts[1:]):
        lines = differences(made, json.loads(part.attrs["made_by"]))
        if lines:
            raise FileError(f"{paths[0]} and {path} are of other scans: {'; '.join(lines)}")
    names = [name for name in map(str, parts[0].coords) if name != REPLICA]
    values = lambda name: list(dict.fromkeys(_plain(x) for p in parts for x in p[name].values))
    replicas = max(part.sizes[REPLICA] for part in parts)
    about = {n: x for n, x in parts[0].attrs.items() if n not in OWN}
    grid = Grid.of({name: values(name) for name in names}, replicas)
    table = Table(grid, made, about)
    for part in parts:
        table.take(part)
    dataset = table.dataset()
    if store is not None:
        write(store, dataset)
    return dataset


def scan_points(table):
    """The points of a scan as a ``pandas.DataFrame``, a row for each: its numbers with their
    standard errors, and how many replicas are done.

    ``table`` is what :func:`dpdjax.scan` returns; ``table.to_dataframe()`` has a row for each
    replica.

    Example:
        >>> def line(key, x):
        ...     return {"y": dpd.Estimate(2.0 * x, 0.1)}
        >>> table = dpd.scan(line, {"x": [1.0, 2.0]}, key=key, replicas=2, **quiet)
        >>> points = dpd.scan_points(table)
        >>> points[["x", "y", "replicas"]].values.tolist()
        [[1.0, 2.0, 2.0], [2.0, 4.0, 2.0]]
    """
    names = [str(name) for name in table if REPLICA not in table[name].dims]
    done = (table["status"] == DONE).sum(REPLICA).rename("replicas")
    points = table[names].assign(replicas=done).drop_vars(REPLICA, errors="ignore")
    return points.to_dataframe().reset_index()


def _plain(value):
    return value.item() if isinstance(value, np.generic) else value


def _over_replicas(value, error):
    """Means over the replicas that are there, and standard errors that cover."""
    means, errors = np.full((2, *value.shape[:-1]), np.nan)
    for place in np.ndindex(*means.shape):
        there = ~np.isnan(value[place])
        if there.any():
            means[place] = value[place][there].mean()
            errors[place] = _covering(value[place][there], error[place][there])
    return means, errors


def _covering(values, errors) -> float:
    """Standard error of the mean of replicas: the larger of what their own errors come to, and of
    their scatter, so widened that few of them cover (68 % by Student's t). Two that happen to agree
    tell little, and neither do blocks that remember the one before."""
    count = len(values)
    own = np.sqrt(np.sum(errors**2)) / count
    if count == 1:
        return float(own)
    scatter = from_replicas(values).error * stdtrit(count - 1, ONE_SIGMA)
    return float(np.fmax(own, scatter))


ONE_SIGMA = 0.8413447460685429
"""Of a normal distribution, the share below one standard deviation."""


def _attributes(name: str, before: str = "") -> dict:
    found = {"long_name": before + LONG_NAMES.get(name, name.replace("_", " "))}
    return found | ({"units": UNITS[name]} if name in UNITS else {})


def tell(table: Table) -> None:
    """Warn of replicas that failed, and of those that warned of something, a few by name."""
    runs = len(table.grid.units())
    for name, what in (("reason", "failed"), ("note", "warned of something")):
        told = table.told(name)
        if told:
            more = f"; and {len(told) - 3} more" if len(told) > 3 else ""
            warn(
                f"{len(told)} of {runs} runs {what}, see the table's {name}: "
                f"{'; '.join(told[:3])}{more}",
            )
