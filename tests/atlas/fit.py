"""The atlas of the package, from what the survey measured: writes dpdjax/surrogate/atlas.csv and
atlas.json.

    python tests/atlas/fit.py
"""

import datetime
import json
import platform
from pathlib import Path

import jax
import numpy as np

import dpdjax as dpd
from dpdjax.surrogate import atlas
from dpdjax.surrogate.process import Process, fitted

HERE = Path(__file__).parent
SHIPPED = Path(dpd.__file__).parent / "surrogate"
COLUMNS = (
    "density a gamma s viscosity viscosity_error viscosity_fast viscosity_fast_error rate "
    "diffusion diffusion_error pressure pressure_error"
).split()


def rows_of(path) -> np.ndarray:
    """States of a store that are done, as rows of numbers by name (n,)."""
    table = dpd.load_scan(path)
    frame = table[[name for name in table if table[name].dims == tuple(table.status.dims[:-1])]]
    frame = frame.to_dataframe().reset_index()
    done = (table.status.values == 1).all(axis=-1).ravel()
    frame = frame[done]
    rows = {name: frame[name].to_numpy(float) for name in COLUMNS if name in frame}
    rows |= _in_a_large_system(frame)
    return np.rec.fromarrays([rows[name] for name in COLUMNS], names=COLUMNS)


def _in_a_large_system(frame) -> dict:
    """Diffusion without the box, which takes of it what momentum that comes back would add: it
    spreads by viscosity and by beads alike."""
    D, error = frame["diffusion"].to_numpy(float), frame["diffusion_error"].to_numpy(float)
    each = frame[["viscosity", "density", "side"]].to_dict("records")
    large = [
        dpd.measure.large_system_diffusion(dpd.Estimate(value, 0.0), kT=1.0, **state).value
        for value, state in zip(D, each)
    ]
    added = np.array(large) - D
    return {"diffusion": D + added, "diffusion_error": np.hypot(error, 0.05 * added)}


def told(process: Process) -> dict:
    """Amplitudes, lengths and nugget of a process."""
    kernel = lambda k: {"amplitude": k.amplitude, "lengths": [float(x) for x in k.lengths]}
    bias = {} if process.bias is None else {"bias": kernel(process.bias)}
    return kernel(process.kernel) | {"nugget": process.nugget} | bias


def write(rows, folder: Path = SHIPPED, provenance: dict | None = None):
    """Fit the processes and write both files."""
    processes = {}
    for name, (where, y, noise) in atlas.told_by(rows).items():
        process = fitted(where, y, noise, biased=name == "viscosity")
        off, deviation = process.left_out()
        print(
            f"{name}: {len(y)} numbers, left out {np.std(off / deviation):.2f} of what is stated, "
            f"{np.median(np.abs(off)):.3%} in the median; {told(process)}",
            flush=True,
        )
        processes[name] = told(process)
    text = json.dumps({"provenance": provenance or made_with(), "processes": processes}, indent=1)
    (folder / "atlas.json").write_text(text + "\n")
    lines = [",".join(COLUMNS)] + [",".join(f"{x:.6g}" for x in row) for row in rows.tolist()]
    (folder / "atlas.csv").write_text("\n".join(lines) + "\n")


def made_with() -> dict:
    return {
        "date": datetime.date.today().isoformat(),
        "dpdjax": dpd.__version__,
        "jax": jax.__version__,
        "machine": platform.machine(),
        "precision": "single",
        "made_by": "tests/atlas/survey.py and tests/atlas/fit.py",
    }


if __name__ == "__main__":
    stores = [HERE / f"{name}.nc" for name in ("quadratic", "exponents")]
    there = [rows_of(store) for store in stores if store.exists()]
    write(np.concatenate(there).view(np.recarray))
