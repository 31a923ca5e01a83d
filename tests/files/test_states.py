"""States on disk are the same states, and what is no state is told."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.files import states

FLOW = dpd.shear(1.0)


@pytest.fixture(scope="module")
def run(water, key):
    """``run(state, frames)``: water under shear."""
    return lambda state, frames: dpd.run(
        water, state, key, 0.01, dpd.Plan(frames, 5), FLOW, progress=False
    )


@pytest.fixture(scope="module")
def state(run, fresh):
    return run(fresh, 10).final


def same_bits(a, b):
    return all(
        jnp.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


def test_saved_state_is_the_same_state(run, state, tmp_path):
    dpd.save_state(tmp_path / "state.npz", state)
    loaded = dpd.load_state(tmp_path / "state.npz")
    assert jax.tree.structure(loaded) == jax.tree.structure(state)
    assert same_bits(loaded, state)
    assert same_bits(run(loaded, 12), run(state, 12))


def test_saved_batch_is_the_same_batch(state, tmp_path):
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
    dpd.save_state(tmp_path / "batch", batch)
    assert same_bits(dpd.load_state(tmp_path / "batch"), batch)


def test_file_that_is_no_state(tmp_path, state):
    np.save(tmp_path / "array.npy", np.ones(3))
    np.savez(tmp_path / "arrays.npz", x=np.ones(3))
    (tmp_path / "text").write_text("hello")
    (tmp_path / "empty").touch()
    for name in ("array.npy", "arrays.npz", "text", "empty"):
        with pytest.raises(
            dpd.FileError,
            match=f"{name} is not a dpdjax state, or a damaged one; write one with dpd.save_state",
        ):
            dpd.load_state(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        dpd.load_state(tmp_path / "nowhere.npz")
    np.savez(tmp_path / "future.npz", meta='{"format": 99, "grids": []}')
    with pytest.raises(
        dpd.FileError, match=f"future.npz has format 99, this version reads {states.FORMAT}"
    ):
        dpd.load_state(tmp_path / "future.npz")
    dpd.save_state(tmp_path / "state.npz", state)
    with np.load(tmp_path / "state.npz") as file:
        np.savez(tmp_path / "torn.npz", **{name: file[name] for name in file if name != "velocity"})
    with pytest.raises(
        dpd.FileError, match="torn.npz lacks the array 'velocity'; save the state again"
    ):
        dpd.load_state(tmp_path / "torn.npz")


def test_float64_state_needs_float64(state, tmp_path):
    dpd.save_state(tmp_path / "state.npz", state)
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(dpd.FileError, match="holds float64; start with JAX_ENABLE_X64=1"):
            dpd.load_state(tmp_path / "state.npz")
    finally:
        jax.config.update("jax_enable_x64", True)


def test_a_state_that_is_not_written_whole_leaves_the_old_one(state, tmp_path, monkeypatch):
    path = tmp_path / "state.npz"
    dpd.save_state(path, state)
    before = path.read_bytes()

    def cut(file, **arrays):
        file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez_compressed", cut)
    with pytest.raises(KeyboardInterrupt):
        dpd.save_state(path, state)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
