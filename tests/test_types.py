"""What users write passes a type checker: the examples of all public names and the README."""

import doctest
import re
import subprocess
import sys
from pathlib import Path

from test_examples import BEGINNING, PUBLIC

import dpdjax

ROOT = Path(dpdjax.__file__).parent.parent
NARROWED = ("missing-union-attribute", "missing-attribute", "incompatible-attribute-override")
"""What a reader knows and the checker does not: which of two results comes back, what one has where
it is there, JAX's configuration, and that a field of a frozen class may stand for another."""


def script() -> str:
    """Every example in a function of its own, after what all begin with."""
    lines = [BEGINNING.read_text()]
    for k, (name, value) in enumerate(sorted(PUBLIC.items())):
        examples = doctest.DocTestParser().get_examples(value.__doc__ or "")
        lines += [f"\n\ndef example_{k}():  # {name}", "    pass"]
        lines += ["    " + line for e in examples for line in e.source.splitlines()]
    readme = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    return "\n".join([*lines, "", *readme])


def test_examples_have_the_types_that_signatures_say(tmp_path):
    (tmp_path / "examples.py").write_text(script())
    ignored = [word for rule in NARROWED for word in ("--ignore", rule)]
    told = subprocess.run(
        [sys.executable, "-m", "ty", "check", "--python", sys.executable, *ignored,
         "--extra-search-path", str(ROOT), "--output-format", "concise", "examples.py"],
        cwd=tmp_path, capture_output=True, text=True,
    )  # fmt: skip
    assert told.returncode == 0, told.stdout + told.stderr
