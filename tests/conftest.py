"""Shared fixtures: float64, strict ranks, two fluids, small states, one compiled run; programs
shared by all workers."""

import atexit
import os
import pathlib
import shutil
import tempfile

if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    # Many files compile the same programs, in workers of their own: they share what one of them has
    # made.
    folder = tempfile.mkdtemp(prefix="dpdjax-tests-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ |= {
        "JAX_COMPILATION_CACHE_DIR": folder,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3",
    }
# Tests mostly compile. Notebooks and benchmarks run what users do.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")
# Or jax logs a page of the processor's features for each program that it reads back.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import jax  # noqa: E402
import pytest  # noqa: E402
from small import SIDE, SKIN, equilibrated, quiet_water, sheared_water  # noqa: E402, F401

import dpdjax as dpd  # noqa: E402
from dpdjax.engine import compiling  # noqa: E402
from dpdjax.pairs import neighbours  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
# Cells are half of what a program takes to compile. What they find is tested in tests/pairs, whose
# states have them; elsewhere all pairs are tried, which gives the same lists.
neighbours.IN_CELLS = 1000


@pytest.fixture(scope="session")
def water():
    """a = 25, gamma = 4.5: the standard DPD fluid."""
    return dpd.fluid(
        conservative=[dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)],
        drag=[dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)],
        kT=1.0,
    )


@pytest.fixture(scope="session")
def ideal():
    """a = 0, gamma = 5: beads that only rub."""
    return dpd.fluid(drag=[dpd.term(dpd.central_drag, gamma=5.0, r_c=1.0)], kT=1.0)


@pytest.fixture(scope="session")
def key():
    return jax.random.key(7)


@pytest.fixture(scope="session")
def simulate():
    """``dpd.simulate``, compiled; shared, so that equal shapes compile once for all tests."""
    return jax.jit(dpd.simulate, static_argnames=("plan", "observe", "remat"))


@pytest.fixture(scope="session")
def long():
    """200 steps: what equilibrates a small box, for every test that needs as many."""
    return dpd.Plan(frames=50, every=4)


@pytest.fixture(scope="session")
def ten():
    """Ten steps: few enough that rounding has not grown."""
    return dpd.Plan(frames=2, every=5)


@pytest.fixture(scope="session")
def fresh(water, key):
    """Random beads of water, no step run."""
    return dpd.initial_state(water, key, box=SIDE, density=3.0, skin=SKIN)


MOST_MAPPINGS = 30_000
"""Memory mappings of the process from which compiled programs are dropped; Linux allows 65,530."""


@pytest.fixture(autouse=True, scope="module")
def room_for_programs():
    """Every compiled program takes some mappings, and a process that runs out of them is
    aborted."""
    yield
    maps = pathlib.Path("/proc/self/maps")
    if maps.exists() and maps.read_text().count("\n") > MOST_MAPPINGS:
        compiling.forget()
        jax.clear_caches()
