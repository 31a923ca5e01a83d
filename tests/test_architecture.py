"""Architecture: numbers flow model -> pairs -> bonded -> engine -> prepare -> measure -> surrogate
-> calibration, and imports point the same way."""

import ast
import importlib
import pathlib
import subprocess
import sys

import pytest

import dpdjax

ROOT = pathlib.Path(dpdjax.__file__).parent
ROOMS = [
    "model",
    "pairs",
    "bonded",
    "engine",
    "prepare",
    "measure",
    "surrogate",
    "calibration",
]
HELPERS = ["checks", "drawing", "errors", "xla"]
HOST = {"files", "host", "cli"}
PAIRS = "box noise cells geometry laws sums kernels neighbours forces friction".split()
ENGINE = (
    "compensated compiling status batching rotation state answers deformation drivers flow order "
    "forces observables profiles integrator implicit part system multistep barostat choice "
    "soundness motion record joining tables trajectory refusals simulate members chunk"
).split()
"""The files of two rooms, each built on those before it."""


def name_of(path):
    return ".".join(path.relative_to(ROOT.parent).with_suffix("").parts)


def imports_of(path):
    """Every module of dpdjax that a file imports, at its top or inside a function."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "dpdjax")
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} has a relative import"
            if node.module.split(".")[0] == "dpdjax":
                yield from (f"{node.module}.{alias.name}" for alias in node.names)


def room_of(module):
    return (module.split(".") + [""])[1]


FILES = [path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))]


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_imports_point_one_way(path):
    own = ROOMS.index(room_of(name_of(path)))
    for module in imports_of(path):
        room = room_of(module)
        assert room not in HOST, f"{module} belongs to the host side"
        assert room in ROOMS[: own + 1] + HELPERS, f"{module} is further down than {path.name}"


@pytest.mark.parametrize("room, order", [("pairs", PAIRS), ("engine", ENGINE)])
def test_a_room_is_in_order(room, order):
    files = {path.stem: path for path in (ROOT / room).glob("*.py") if path.stem != "__init__"}
    assert sorted(files) == sorted(order), "the order lists every file"
    for place, name in enumerate(order):
        own = {
            module.split(".")[2] for module in imports_of(files[name]) if room_of(module) == room
        }
        assert own <= set(order[:place]), f"{name} imports what comes after it"


def test_helpers_import_nothing_of_the_package():
    for name in HELPERS:
        assert not list(imports_of(ROOT / f"{name}.py"))


def in_fresh_python(code):
    """What a fresh interpreter prints, by word."""
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()


def test_import_is_quick():
    """Neither jax nor jax-md nor the plots are loaded before they are used."""
    loaded = in_fresh_python("import dpdjax, sys; dir(dpdjax); print(*sys.modules)")
    assert "dpdjax" in loaded
    assert not {"jax", "jax_md", "numpy", "matplotlib", "tqdm", "optax"} & set(loaded)
    assert len(loaded) < 300


@pytest.mark.parametrize("name", dpdjax.__all__)
def test_public_name_lives_in_its_home(name):
    value = getattr(importlib.import_module(dpdjax._HOME_OF[name]), name)
    assert value.__doc__, "has a docstring"


SPACES = {name: importlib.import_module(f"dpdjax.{name}") for name in dpdjax.NAMESPACES}


@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
def test_a_namespace_has_its_names_in_order(space):
    assert space.__all__ == sorted(set(space.__all__), key=lambda name: (name.lower(), name))
    assert all(getattr(space, name).__doc__ for name in space.__all__ if name.islower())
    shared = set(space.__all__) & set(dpdjax.__all__)
    assert all(getattr(space, name) is getattr(dpdjax, name) for name in shared)


def test_no_name_is_in_two_namespaces():
    names = [name for space in SPACES.values() for name in space.__all__]
    assert len(names) == len(set(names))


def test_public_names_are_no_modules_whatever_is_imported_first():
    """Importing ``dpdjax.host.run`` sets the attribute ``run`` of the package to the module."""
    code = """
import dpdjax, importlib, inspect
for home in dpdjax._HOME_OF.values():
    importlib.import_module(home)
print(*[name for name in dpdjax.__all__ if inspect.ismodule(getattr(dpdjax, name))])
"""
    assert in_fresh_python(code) == []


def test_unknown_name_is_an_attribute_error():
    for name, near in (
        ("viscocity", "dpd.shear_viscosity"),
        ("morse", "dpd.laws.morse"),
        ("rdf", "dpd.measure.radial_distribution"),
        ("Lubrication", "dpd.laws.squeezing_lubrication"),
    ):
        with pytest.raises(AttributeError, match=f"no '{name}'.*{near}"):
            getattr(dpdjax, name)
