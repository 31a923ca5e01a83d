"""What is different is told differently, what is the same alike, in any process."""

import dataclasses
import functools
import json
import math
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.files.told import _without_comments, differences, told

FACTOR = 1.0


def scaled(fluid, state):
    return {"x": FACTOR * state.time}


class Plain:
    """Holds a number."""

    def __init__(self, k):
        self.k = k

    def __call__(self, key):
        return {"y": self.k}

    def go(self, key):
        return {"y": self.k}


@dataclasses.dataclass
class Held:
    k: float


def closing_over(k):
    return lambda key: {"y": k}


def recursive():
    def inner(n):
        return inner(n - 1) if n else 0

    return inner


one, other = lambda x: x + 1, lambda x: x - 1

DIFFERENT = {
    "defaults": (lambda x, k=1: k, lambda x, k=2: k),
    "keyword defaults": (lambda x, *, k=1: k, lambda x, *, k=2: k),
    "callables": (Plain(1), Plain(2)),
    "methods": (Plain(1).go, Plain(2).go),
    "closures": (closing_over(1.0), closing_over(2.0)),
    "closures over objects": (closing_over(Plain(1)), closing_over(Plain(2))),
    "lambdas of one line": (one, other),
    "partials": (functools.partial(scaled, 1), functools.partial(scaled, 2)),
    "dataclasses": (Held(1.0), Held(2.0)),
    "observables": (dpd.observe.positions_of(0), dpd.observe.positions_of(1)),
    "means": (dpd.mean(dpd.observe.standard), dpd.integral(dpd.observe.standard)),
    "arrays": (np.zeros(100), np.ones(100)),
    "shapes": (np.zeros((10, 10)), np.zeros((4, 25))),
    "keys": (jax.random.key(0), jax.random.key(0, impl="rbg")),
    "integrators": (dpd.integrators.VelocityVerlet(), dpd.integrators.VelocityVerlet(0.6)),
    "without source": (eval("lambda x: 1.5"), eval("lambda x: 2.5")),
}


@pytest.mark.parametrize("name", DIFFERENT)
def test_what_differs_is_told_differently(name):
    a, b = map(told, DIFFERENT[name])
    assert differences(a, b) and not differences(a, json.loads(json.dumps(a)))


def test_globals_count(monkeypatch):
    before = told(scaled)
    monkeypatch.setattr(sys.modules[__name__], "FACTOR", 2.0)
    assert differences(before, told(scaled)) == ["uses.FACTOR: 1.0 then, 2.0 now"]


@pytest.mark.parametrize(
    "value", [{"c", "b", "a"}, math.nan, jnp.array([1.0, jnp.nan]), recursive(), np, object()]
)
def test_what_is_the_same_is_told_alike(value):
    assert not differences(told(value), json.loads(json.dumps(told(value))))


CODE = """
import json, numpy as np, dpdjax as dpd
from dpdjax.files.told import told
water = dpd.fluid([dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)], kT=1.0)
print(json.dumps(told([water, {"c", "b", "a"}, object(), np, lambda x: x, dpd.observe.standard])))
"""


def test_other_processes_tell_alike():
    run = lambda: (
        subprocess.run(
            [sys.executable, "-c", CODE], capture_output=True, text=True, check=True
        ).stdout
    )
    assert run() == run()


def test_comments_do_not_count():
    """Of a source only what it does, as long as strings keep their hashes."""
    plain = "def f(x):\n    return '#' + x\n"
    noted = "def f(x):  # of x\n    # more of it\n\n    return '#' + x  # done\n"
    assert _without_comments(noted) == _without_comments(plain) == plain.strip()
    assert _without_comments(plain.replace("#", "%")) != plain.strip()
    assert _without_comments("not ( python") == "not ( python"
