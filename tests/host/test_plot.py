"""Pictures are drawn into the axes they are given, or new ones."""

import importlib.util
import sys

import jax
import numpy as np
import pytest

import dpdjax as dpd

if importlib.util.find_spec("matplotlib"):
    import matplotlib

    matplotlib.use("Agg")

needs_matplotlib = pytest.mark.skipif(
    not importlib.util.find_spec("matplotlib"), reason="plots are an extra"
)


@needs_matplotlib
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_box_shows_the_beads_of_a_slice(fresh, axis):
    ax = dpd.plot_box(fresh, axis=axis, thickness=0.5)
    assert len(ax.collections[0].get_offsets()) == np.sum(fresh.position[:, axis] < 0.5)
    assert ax.get_xlim() == (0.0, 4.2)
    assert ax.get_xlabel() == "yxx"[axis] + " (r_c)"


@needs_matplotlib
def test_box_is_drawn_where_asked(fresh, tmp_path):
    from matplotlib.figure import Figure

    ax = Figure().subplots()
    assert dpd.plot_box(fresh, ax) is ax
    ax.figure.savefig(tmp_path / "box.png")


@needs_matplotlib
def test_a_run_draws_what_it_recorded(water, fresh, key):
    """Of one run and of a batch: the temperature with kT, or what is asked for."""
    run = dpd.run(water, fresh, key, 0.01, dpd.Plan(4, 2), progress=False)
    ax = run.plot()
    assert ax.get_ylabel() == "temperature" and len(ax.lines) == 2
    assert run.plot("potential_energy", ax) is ax and len(ax.lines) == 3
    both = dpd.run(water, fresh, jax.random.split(key), 0.01, dpd.Plan(4, 2), progress=False)
    assert len(both.plot("potential_energy").lines) == 2
    with pytest.raises(ValueError, match="'momentum' is no number.*temperature"):
        run.plot("momentum")


def test_missing_matplotlib_has_a_cure(fresh, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ImportError, match=r'pip install "dpdjax\[plot\]"'):
        dpd.plot_box(fresh)
