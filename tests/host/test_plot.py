"""Pictures are drawn into the axes they are given, or new ones."""

import dataclasses
import importlib.util
import sys

import jax
import numpy as np
import pytest
from clouds import SIDES, thrown

import dpdjax as dpd
from dpdjax.engine.state import State
from dpdjax.host import projection
from dpdjax.measure import Spheres, contacts_of_each
from dpdjax.pairs.box import Box

if importlib.util.find_spec("matplotlib"):
    import matplotlib

    matplotlib.use("Agg")

needs_matplotlib = pytest.mark.skipif(
    not importlib.util.find_spec("matplotlib"), reason="plots are an extra"
)
TILT = 0.3


@pytest.fixture(autouse=True)
def closed_figures():
    yield
    if importlib.util.find_spec("matplotlib"):
        import matplotlib.pyplot as plt

        plt.close("all")


@pytest.fixture(scope="module")
def run(water, fresh, key):
    return dpd.run(water, fresh, key, 0.01, dpd.Plan(4, 2), progress=False)


@pytest.fixture(scope="module")
def both(water, fresh, key):
    return dpd.run(water, fresh, jax.random.split(key), 0.01, dpd.Plan(4, 2), progress=False)


@needs_matplotlib
@pytest.mark.parametrize("axis, shown", [(0, "yz"), (1, "xz"), (2, "xy")])
def test_box_shows_the_beads_of_a_slice(fresh, axis, shown):
    """Those next to the face that one looks at, the near ones over the far ones."""
    ax = dpd.plot_box(fresh, axis=axis, solvent=0.5)
    place = np.asarray(fresh.position)[:, axis]
    depth = place if axis == 1 else 4.2 - place
    near = np.sort(depth[depth < 0.5])[::-1]
    np.testing.assert_allclose(ax.collections[0].get_array(), near)
    assert ax.get_xlim() == (0.0, 4.2)
    assert ax.get_xlabel() + ax.get_ylabel() == "{} [length]{} [length]".format(*shown)


@needs_matplotlib
def test_a_slice_fills_the_tilted_box(fresh):
    ax = dpd.plot_box(tilted(fresh), solvent=0.5)
    x, y = ax.collections[0].get_offsets().T
    assert np.all((x - TILT * y > 0) & (x - TILT * y < 4.2)) and np.any(x > 4.2)
    np.testing.assert_allclose(ax.lines[0].get_xdata(), [0, 4.2, 4.2 * 1.3, 4.2 * 0.3, 0])


def tilted(state):
    return dataclasses.replace(state, box=Box(state.box.lengths, np.array(TILT)))


@needs_matplotlib
def test_box_is_drawn_where_asked(fresh, tmp_path):
    from matplotlib.figure import Figure

    ax = Figure().subplots()
    assert dpd.plot_box(fresh, ax) is ax
    ax.figure.savefig(tmp_path / "box.png")


@pytest.fixture(scope="module")
def suspension():
    """A fluid, and a state of 30 colloids of two sizes and 50 solvent beads, tilted."""
    solvents, colloids = 50, 30
    size = np.r_[np.ones(solvents), np.repeat([1.0, 0.5], colloids // 2)]
    fields = dict.fromkeys(f.name for f in dataclasses.fields(State))
    given = {
        "position": thrown(solvents + colloids),
        "species": np.repeat([0, 1], [solvents, colloids]),
        "size": size,
        "box": Box(SIDES, np.array(TILT)),
    }
    return dpd.colloid_fluid(radius=0.8), State(**(fields | given))


def circles(ax):
    """Centres and radii of the spheres, without the discs that shade them: painted in this
    order."""
    discs = max(ax.collections, key=lambda found: found.get_zorder())
    outer = slice(None, None, projection.LAYERS)
    return discs.get_offsets()[outer], 0.5 * discs.get_widths()[outer], discs


@needs_matplotlib
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_every_sphere_is_seen_whole_and_the_near_ones_last(suspension, axis):
    fluid, state = suspension
    ax = dpd.plot_box(state, fluid=fluid, axis=axis)
    centres, radius, _ = circles(ax)
    assert sorted(radius) == pytest.approx(sorted(0.8 * state.size[50:]))
    cell = projection.Cell.of(state, axis)
    place = cell.seen(cell.inside(state.position[50:])[0])
    nearer = np.argsort(place[:, 2])
    np.testing.assert_allclose(centres, place[nearer, :2])
    assert len(ax.lines) == 12 and len(ax.texts) == 3
    ends = {tuple(np.round(p, 6)) for line in ax.lines for p in line.get_xydata()}
    corners = np.array(list(np.ndindex(2, 2, 2))) @ cell.lattice
    assert ends == {tuple(np.round(p[:2], 6)) for p in cell.seen(corners)}
    left, right = ax.get_xlim()
    assert left <= np.min(centres[:, 0] - radius) and right >= np.max(centres[:, 0] + radius)


def test_one_looks_from_outside():
    """The axes keep their handedness and their lengths, and the near face is toward the viewer."""
    for axis in range(3):
        cell = projection.Cell(np.diag(SIDES), axis)
        turn = cell.seen(np.eye(3)).T
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1.0)
        near, far = np.full((2, 3), 0.5) * SIDES
        near[axis], far[axis] = (0.1, SIDES[axis] - 0.1)[:: projection.TOWARD[axis] * -1]
        (_, shallow), (_, deep) = (cell.inside(x[None]) for x in (near, far))
        assert shallow < deep and cell.seen(near)[2] > cell.seen(far)[2]


@needs_matplotlib
def test_colours_of_spheres(suspension):
    fluid, state = suspension
    spheres = Spheres(state.position[50:], 0.8 * state.size[50:], SIDES, TILT)
    z = contacts_of_each(spheres, gap=0.3)[0, 0]
    ax = dpd.plot_box(state, fluid=fluid, colour="contacts", gap=0.3)
    bar = ax.figure.axes[1]
    assert bar.get_ylabel() == "contacts z" and bar.get_ylim() == (-0.5, z.max() + 0.5)
    hues = circles(ax)[2].get_facecolors()[:: projection.LAYERS]
    assert len(np.unique(np.round(hues, 6), axis=0)) > 1
    by_range = dpd.plot_box(state, fluid=fluid, colour="contacts").figure.axes[1]
    assert by_range.get_ylim()[1] >= 1.5
    ax = dpd.plot_box(state, fluid=fluid, colour="cluster", gap=0.05)
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    single = np.sum(contacts_of_each(spheres, gap=0.05) == 0)
    assert labels[0].startswith("cluster of ") and labels[-1] == f"{single} single"
    depth = dpd.plot_box(state, fluid=fluid).figure.axes[1]
    assert depth.get_ylabel() == "depth [length]"


@needs_matplotlib
def test_solvent_behind_the_spheres(suspension):
    fluid, state = suspension
    dots = lambda ax: len(ax.collections[0].get_offsets())
    assert dots(dpd.plot_box(state, fluid=fluid)) == 0
    ax = dpd.plot_box(state, fluid=fluid, solvent=2.0)
    assert dots(ax) == np.sum(state.position[:50, 2] < 2.0) > 0
    assert ax.collections[0].get_zorder() < ax.collections[-1].get_zorder()


@needs_matplotlib
def test_boxes_that_cannot_be_drawn(suspension, fresh, both):
    fluid, state = suspension
    with pytest.raises(ValueError, match="the state is a batch"):
        dpd.plot_box(both.final)
    with pytest.raises(ValueError, match="colour is 'speed'"):
        dpd.plot_box(state, fluid=fluid, colour="speed")
    with pytest.raises(ValueError, match="axis is 3"):
        dpd.plot_box(fresh, axis=3)
    with pytest.raises(ValueError, match="solvent"):
        dpd.plot_box(fresh, solvent=-1.0)
    marble = dpd.marble_fluid(radius=0.8)
    with pytest.raises(ValueError, match="no gap is given.*give gap="):
        dpd.plot_box(state, fluid=marble, colour="contacts")


@needs_matplotlib
def test_a_run_draws_what_it_recorded(run, both):
    """Of one run and of a batch: the temperature with kT, or what is asked for."""
    ax = run.plot()
    assert ax.get_ylabel() == "temperature [energy]" and len(ax.lines) == 2
    assert run.plot("potential_energy", ax) is ax and len(ax.lines) == 3
    assert len(both.plot("potential_energy").lines) == 2
    with pytest.raises(ValueError, match="'momentum' is no number.*temperature"):
        run.plot("momentum")


@needs_matplotlib
def test_panels_of_a_run(run, both, fresh):
    axes = dpd.plot_run(run)
    assert [len(ax.lines) for ax in axes] == [2, 1, 1, 3]
    stress, n = np.asarray(run.frames["pressure_tensor"]), fresh.n
    energy, momentum = run.frames["potential_energy"], run.frames["momentum"]
    due = [run.frames["temperature"], np.trace(stress, axis1=1, axis2=2) / 3, energy / n]
    for ax, values in zip(axes, [*due, momentum[:, 0] / n]):
        np.testing.assert_allclose(ax.lines[0].get_ydata(), values)
        np.testing.assert_allclose(ax.lines[0].get_xdata(), run.frames["time"])
    assert axes[0].lines[1].get_ydata()[0] == 1.0 and axes[-1].get_xlabel() == "t [time]"
    assert [len(ax.lines) for ax in dpd.plot_run(both)] == [3, 2, 2, 6]


@needs_matplotlib
def test_panels_are_of_what_was_recorded(run):
    import matplotlib.pyplot as plt

    kept = lambda *names: dataclasses.replace(run, frames={k: run.frames[k] for k in names})
    assert len(dpd.plot_run(kept("time", "step", "momentum"))) == 1
    given = plt.subplots(2)[1]
    assert list(dpd.plot_run(kept("time", "temperature", "momentum"), given)) == list(given)
    with pytest.raises(ValueError, match="2 axes are given for 4 panels"):
        dpd.plot_run(run, given)
    with pytest.raises(ValueError, match="recorded none of temperature.*observe=.*standard"):
        dpd.plot_run(kept("time", "step"))


@needs_matplotlib
def test_a_flow_curve():
    xarray = pytest.importorskip("xarray")
    rate, phi = np.array([0.01, 0.1, 1.0]), np.array([0.1, 0.2])
    eta = 1.0 + phi * rate[:, None] ** -0.2
    names = {"viscosity": eta, "viscosity_error": 0.1 * eta}
    data = {name: (("rate", "phi"), values) for name, values in names.items()}
    table = xarray.Dataset(data, {"rate": rate, "phi": phi})
    ax = dpd.plot_flow_curve(table)
    assert ax.get_xscale() == ax.get_yscale() == "log" and len(ax.containers) == 2
    np.testing.assert_allclose(ax.containers[1][0].get_ydata(orig=False), eta[:, 1])
    low, high = ax.containers[1][2][0].get_segments()[0][:, 1]
    assert (low, high) == pytest.approx((0.9 * eta[0, 1], 1.1 * eta[0, 1]))
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["phi = 0.1", "phi = 0.2"]
    assert ax.get_ylabel() == "viscosity [energy time/length$^3$]"
    assert len(dpd.plot_flow_curve(table.sel(phi=0.1), ax).containers) == 3
    with pytest.raises(ValueError, match="axis 'rate'; the axes of this table are gamma, phi"):
        dpd.plot_flow_curve(table.rename(rate="gamma"))


def test_missing_matplotlib_has_a_cure(fresh, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ImportError, match=r'pip install "dpdjax\[plot\]"'):
        dpd.plot_box(fresh)
