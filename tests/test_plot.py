"""Pictures are drawn into the axes they are given, or new ones."""

import importlib.util
import sys

import numpy as np
import pytest

import dpdjax as dpd

needs_matplotlib = pytest.mark.skipif(
    not importlib.util.find_spec("matplotlib"), reason="plots are an extra"
)


@needs_matplotlib
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_box_shows_the_beads_of_a_slice(fresh, axis):
    figure = dpd.plot_box(fresh, axis=axis, thickness=0.5)
    ax = figure.axes[0]
    assert len(ax.collections[0].get_offsets()) == np.sum(fresh.position[:, axis] < 0.5)
    assert ax.get_xlim() == (0.0, 4.2)
    assert ax.get_xlabel() == "yxx"[axis] + " (r_c)"


@needs_matplotlib
def test_box_is_drawn_where_asked(fresh, tmp_path):
    from matplotlib.figure import Figure

    ax = Figure().subplots()
    assert dpd.plot_box(fresh, ax) is ax.figure
    ax.figure.savefig(tmp_path / "box.png")


def test_missing_matplotlib_has_a_cure(fresh, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r'pip install "dpdjax\[plot\]"'):
        dpd.plot_box(fresh)
