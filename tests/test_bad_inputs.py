"""Whatever is given, something happens that can be understood: it works, with finite numbers, or an
error of this package, a TypeError or a ValueError names the argument."""

import dataclasses
import math
import pathlib
import warnings

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from odd import ALIKE, LONGEST
from small import water_toml

import dpdjax as dpd
from dpdjax.configs.running import run_file

ODD = {
    "none": None,
    "true": True,
    "minus one": -1,
    "zero": 0,
    "a half": 0.5,
    "huge": 1e300,
    "tiny": 1e-300,
    "nan": math.nan,
    "infinite": math.inf,
    "text": "much",
    "empty text": "",
    "empty list": [],
    "list": [1.0, 2.0],
    "list of texts": ["a"],
    "matrix": np.ones((2, 3)),
    "column": np.ones((3, 1)),
    "integers": np.arange(3),
    "nan array": jnp.array([1.0, jnp.nan]),
    "complex": 1j,
    "dict": {"a": 1},
    "object": object(),
    "function": lambda x: x,
    "class": dict,
}
OTHERWISE = {
    "trajectory": ["a run", "positions alone"],
    "series": ["values"],
    "path": ["No such file"],
    "t_max": ["longest lag"],
    "steps": ["step of Plan.at"],
    "modulus": ["f "],
    "radius": ["mass"],
    "density": ["mass", "beads"],
    "time": ["time unit"],
    "experiment": ["<lambda>()", "key array"],
    "flow": ["rate"],
    "observe": ["<lambda>()", "dict"],
}
"""What an argument may be called in a message."""
KEY = jax.random.key(0)
SOFT = {"a": 25.0, "r_c": 1.0}
RUB = {"gamma": 4.5, "r_c": 1.0}


def water():
    return dpd.fluid(
        [dpd.term(dpd.soft_repulsion, **SOFT)], [dpd.term(dpd.central_drag, **RUB)], kT=1.0
    )


@pytest.fixture(scope="module")
def calls(fresh):
    """Public functions, each with arguments that will do."""
    matter = water()
    ran = dpd.run(
        matter,
        fresh,
        KEY,
        0.01,
        dpd.Plan(40, 2),
        dpd.shear(0.1),
        progress=False,
        observe=[dpd.observe.standard, dpd.observe.positions],
    )
    trios = np.arange(60).reshape(20, 3)
    bonds = {"bond": np.concatenate([trios[:, :2], trios[:, 1:]]), "angle": trios}
    chained = dataclasses.replace(ran, final=ran.final.bonded(bonds))
    box = {
        "box": 3.5,
        "density": 3.0,
        "n": None,
        "start": "random",
        "skin": 0.3,
        "dt": 0.01,
        "sheared": True,
    }
    how_to_load = {"flow": None, "groups": {}, "exclude": 0, "skin": 0.3, "dt": 0.01}
    how_to_load["sheared"] = True
    one = lambda key, gamma: {"y": 1.0}
    written = dpd.run(
        matter, fresh, KEY, 0.01, dpd.Plan(2, 2), observe=dpd.observe.gsd_record, progress=False
    )
    return {
        "written": written,
        "term of repulsion": (
            lambda **x: dpd.term(dpd.soft_repulsion, **x),
            SOFT | {"reach": None, "origin": None},
        ),
        "term of drag": (lambda **x: dpd.term(dpd.central_drag, **x), RUB | {"projector": None}),
        "term of law": (lambda law: dpd.term(law, **SOFT), {"law": dpd.soft_repulsion}),
        "fluid": (
            dpd.fluid,
            {
                "conservative": list(matter.interactions[0].conservative),
                "drag": list(matter.interactions[0].drag),
                "kT": 1.0,
                "mass": 1.0,
                "species": 1,
                "radius": None,
            },
        ),
        "set": (matter.set, {"gamma": 4.5, "a": 25.0, "kT": 1.0, "mass": 1.0, "energies": "keep"}),
        "colloid_fluid": (
            dpd.colloid_fluid,
            {
                "kT": 0.1,
                "gamma": 4.5,
                "eta_0": 0.3,
                "D0": 0.0,
                "kappa": 30.0,
                "radius": 1.0,
                "density": 3.0,
                "modulus": 1e4,
            },
        ),
        "initial_state": (lambda **x: dpd.initial_state(matter, KEY, **x), box),
        "Plan": (dpd.Plan, {"frames": 3, "every": 2}),
        "Plan.at": (dpd.Plan.at, {"steps": [1, 5]}),
        "Plan.logarithmic": (dpd.Plan.logarithmic, {"steps": 100, "first": 1, "per_decade": 5}),
        "shear": (dpd.shear, {"rate": 0.1}),
        "oscillatory_shear": (dpd.oscillatory_shear, {"amplitude": 0.1, "frequency": 1.0}),
        "drive": (dpd.drive, {"force": 1.0, "torque": 0.0, "species": 1, "reaction": "all"}),
        "sinusoidal_force": (
            dpd.flows.sinusoidal_force,
            {"amplitude": 0.1, "side": 3.5, "waves": 1},
        ),
        "run": (
            dpd.run,
            {
                "fluid": matter,
                "state": fresh,
                "key": KEY,
                "dt": 0.01,
                "plan": dpd.Plan(4, 2),
                "flow": dpd.shear(0.1),
                "observe": None,
                "integrator": None,
                "out": None,
                "checkpoint": None,
                "hours": None,
            },
        ),
        "suggest_dt": (lambda **x: dpd.suggest_dt(matter, **x), {"density": 3.0, "error": 0.005}),
        "shear_viscosity": (dpd.shear_viscosity, {"trajectory": ran, "skip": 0.0, "blocks": 4}),
        "mean_squared_displacement": (
            dpd.measure.mean_squared_displacement,
            {"trajectory": ran, "species": None, "t_max": 0.06, "axes": "yz"},
        ),
        "molecules_of": (dpd.measure.molecules_of, {"what": chained}),
        "chains": (dpd.measure.chains, {"what": chained, "length": 3, "species": [0, 0, 0]}),
        "end_to_end": (
            dpd.measure.end_to_end,
            {"trajectory": chained, "length": 3, "species": 0, "t_max": 0.1},
        ),
        "radius_of_gyration": (
            dpd.measure.radius_of_gyration,
            {"trajectory": chained, "length": None, "species": 0},
        ),
        "rouse_modes": (
            lambda **x: dpd.measure.rouse_modes(**x).error,
            {"trajectory": chained, "t_max": 0.1},
        ),
        "bond_lengths": (
            dpd.measure.bond_lengths,
            {"trajectory": chained, "name": "bond", "bins": 5},
        ),
        "angles": (dpd.measure.angles, {"trajectory": chained, "name": "angle", "bins": 5}),
        "order_parameter": (
            dpd.measure.order_parameter,
            {"trajectory": chained, "name": "bond", "head": None, "normal": "y"},
        ),
        "area_per_lipid": (
            dpd.measure.area_per_lipid,
            {"trajectory": chained, "normal": "z", "leaflets": 2, "length": 3, "species": 0},
        ),
        "molecular_displacement": (
            dpd.measure.molecular_displacement,
            {"trajectory": chained, "length": 3, "species": 0, "t_max": 0.06, "axes": "yz"},
        ),
        "radial_distribution": (dpd.measure.radial_distribution, {"trajectory": ran}),
        "block_average": (dpd.measure.block_average, {"series": np.arange(20.0), "blocks": 4}),
        "scan": (
            dpd.scan,
            {
                "experiment": one,
                "grid": {"gamma": [4.5, 9.0]},
                "key": KEY,
                "replicas": 2,
                "store": None,
                "shard": (1, 2),
                "hours": None,
            },
        ),
        "load_state": (dpd.load_state, {"path": "nowhere.npz"}),
        "load_gsd": (
            dpd.load_gsd,
            {"path": "water.gsd", "frame": 0, "fluid": matter} | how_to_load,
        ),
        "load_lammps": (
            dpd.load_lammps,
            {"path": "water.data", "fluid": matter, "atom_style": "atomic"} | how_to_load,
        ),
        "water_units": (dpd.water_units, {"time": "thermal"}),
        "Estimate": (lambda **x: str(dpd.Estimate(**x)), {"value": 1.0, "error": 0.1}),
    }


def lammps_data(state) -> str:
    """The beads of a state as a data file of LAMMPS."""
    sides = [f"0 {side} {a}lo {a}hi" for a, side in zip("xyz", state.box.lengths)]
    rows = [f"{k + 1} 1 {x} {y} {z}" for k, (x, y, z) in enumerate(state.position.tolist())]
    head = ["water", "", f"{state.n} atoms", "1 atom types", *sides, "", "Atoms", ""]
    return "\n".join([*head, *rows, ""])


CASES = """term of repulsion, term of drag, term of law, fluid, set, colloid_fluid, initial_state,
Plan,
Plan.at, Plan.logarithmic, shear, oscillatory_shear, drive, sinusoidal_force, run, suggest_dt,
shear_viscosity, mean_squared_displacement, molecules_of, chains, end_to_end, radius_of_gyration,
rouse_modes, bond_lengths, angles, order_parameter, area_per_lipid, molecular_displacement,
radial_distribution, block_average, scan, load_state, load_gsd, load_lammps, water_units"""
CASES = [name.strip() for name in CASES.split(",")]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", CASES)
def test_odd_values_are_taken_or_told(name, calls, tmp_path, monkeypatch):
    """Every odd value in place of every argument, in turn."""
    monkeypatch.chdir(tmp_path)
    function, good = calls[name]
    if name == "load_gsd":
        dpd.write_gsd("water.gsd", calls["written"])
    if name == "load_lammps":
        pathlib.Path("water.data").write_text(lammps_data(calls["written"].final))
    bad = []
    for argument in good:
        for kind, value in ODD.items():
            told = judged(function, good | {argument: value}, argument)
            bad += [f"{argument} = {kind}: {told}"] if told else []
    assert not bad, "\n".join(bad)


@pytest.mark.filterwarnings("ignore")
@hypothesis.given(data=st.data())
@hypothesis.settings(ALIKE, max_examples=60)
def test_several_odd_values_at_once(calls, data):
    """Any two arguments, with numbers of any size too."""
    name = data.draw(
        st.sampled_from([n for n in CASES if n != "run" and n != "scan" and "load" not in n])
    )
    function, good = calls[name]
    values = st.one_of(
        st.sampled_from(list(ODD.values())), st.floats(), st.integers(), st.text(max_size=5)
    )
    arguments = data.draw(
        st.lists(st.sampled_from(sorted(good)), min_size=1, max_size=2, unique=True)
    )
    given = good | {argument: data.draw(values) for argument in arguments}
    told = judged(function, given, None)
    assert not told, f"{name}, {[(a, given[a]) for a in arguments]}: {told}"


def judged(function, arguments: dict, argument: str | None) -> str:
    """What is wrong with what a call did; empty where nothing is."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = function(**arguments)
    except (dpd.DPDError, ValueError, TypeError, FileNotFoundError) as error:
        return _judged_message(error, argument)
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:200]}"
    return "" if _is_finite(result) else f"a result that is not finite: {result!r:.100}"


def _judged_message(error, argument) -> str:
    text = str(error)
    if (
        len(text) > LONGEST
        or "Tracer" in text
        or "jax.errors" in text
        or type(error).__module__.startswith("jax")
    ):
        return f"a page: {type(error).__name__} {text[:200]}"
    words = {argument, argument.rstrip("s"), *OTHERWISE.get(argument, ())} if argument else {""}
    return (
        ""
        if any(word in text for word in words)
        else f"not named: {type(error).__name__} {text[:200]}"
    )


def _is_finite(result) -> bool:
    if dataclasses.is_dataclass(result) or isinstance(result, jax.Array | np.ndarray | float):
        leaves = [
            np.asarray(x)
            for x in jax.tree.leaves(result)
            if hasattr(x, "dtype") or isinstance(x, float)
        ]
        floats = [x for x in leaves if np.issubdtype(x.dtype, np.floating)]
        return all(np.all(np.isfinite(x)) for x in floats)
    return True


TOML = (
    "seed = 0\n"
    + water_toml("box = 3.5\ndensity = 3.0\nskin = 0.3")
    + """
[plan]
steps = 4
frames = 2
[output]
gsd = "odd.gsd"
"""
)
WORDS = st.sampled_from(
    ["1e400", "nan", "-3", "0", '"x"', "[]", "{}", "true", "1979-05-27", "[1, 2]", '""']
)


@pytest.mark.filterwarnings("ignore")
@hypothesis.given(data=st.data())
@hypothesis.settings(ALIKE, max_examples=80)
def test_odd_files(data, tmp_path_factory):
    """A line of a file left out, doubled, misspelt, or with an odd value."""
    lines = [line for line in TOML.splitlines() if line]
    k = data.draw(st.integers(0, len(lines) - 1))
    how = data.draw(st.sampled_from(["left out", "doubled", "misspelt", "odd value"]))
    line = lines[k]
    if how == "left out":
        lines[k] = ""
    elif how == "doubled":
        lines[k] = f"{line}\n{line}"
    elif how == "misspelt":
        lines[k] = line.replace("a", "q", 1).replace("e", "3", 1)
    else:
        lines[k] = f"{line.partition('=')[0]} = {data.draw(WORDS)}"
    folder = tmp_path_factory.mktemp("odd")
    path = folder / "odd.toml"
    path.write_text("\n".join(lines).replace("odd.gsd", str(folder / "odd.gsd")))
    told = judged(lambda: run_file(path, out=str(folder / "out.gsd"), progress=False), {}, None)
    assert not told, f"{how}: {line!r} -> {lines[k]!r}: {told}"
