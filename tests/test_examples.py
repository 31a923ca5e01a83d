"""Every public name has an example in its docstring, and it runs.

An example begins with the lines of ``docs/reference/beginning.py``, as the reference says. What it
prints is compared, with ``...`` for what another processor rounds otherwise.
"""

import doctest
import importlib
import pathlib
import re

import jax
import pytest

import dpdjax as dpd

BEGINNING = pathlib.Path(__file__).parent.parent / "docs" / "reference" / "beginning.py"
HOW = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
NO_EXAMPLE = {
    "integrators.EVERYTHING",
    "integrators.UNDAMPED",
    "observe.einstein_helfand_record",
}
"""Tuples and a list, whose docstrings are those of their class."""


def public() -> dict:
    """Every public object by its name below ``dpd``."""
    named = {name: getattr(dpd, name) for name in dpd.__all__}
    for space in dpd.NAMESPACES:
        module = getattr(dpd, space)
        named |= {f"{space}.{name}": getattr(module, name) for name in module.__all__}
    return named


PUBLIC = public()


@pytest.fixture(scope="module")
def beginning():
    # Users have single precision and no strict ranks.
    with jax.enable_x64(False), jax.numpy_rank_promotion("allow"):
        names = {}
        exec(compile(BEGINNING.read_text(), str(BEGINNING), "exec"), names)
        yield names


def examples_of(name: str, names: dict) -> doctest.DocTest:
    text = PUBLIC[name].__doc__ or ""
    return doctest.DocTestParser().get_doctest(text, dict(names), name, None, None)


ONCE = {id(value): name for name, value in PUBLIC.items()}.values()
"""One name of each object: some stand at the top and in a namespace."""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", sorted(set(ONCE) - NO_EXAMPLE))
def test_an_example_that_runs(name, beginning, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    example = examples_of(name, beginning)
    assert example.examples, f"dpd.{name} has no example: end its docstring with one"
    said = []
    doctest.DocTestRunner(optionflags=HOW).run(example, out=said.append)
    assert not said, "".join(said)


def documented() -> set[int]:
    """What the pages of the reference show, as the directive of ``docs/names.py`` reads them."""
    found = set()
    for page in BEGINNING.parent.glob("*.md"):
        blocks = re.findall(r"```{names} ?(\S*)\n(.*?)```", page.read_text(), re.DOTALL)
        for space, names in blocks:
            home = importlib.import_module(".".join(filter(None, ["dpdjax", space])))
            found |= {id(getattr(home, name)) for name in names.split()}
    return found


def test_every_name_has_a_page():
    shown = documented()
    missing = [name for name, value in PUBLIC.items() if id(value) not in shown]
    assert not missing, f"docs/reference shows nowhere {', '.join(missing)}"
