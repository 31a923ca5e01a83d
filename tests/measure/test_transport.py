"""Displacements, velocity memory and diffusion against motions known in closed form."""

import dataclasses
import warnings
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine.flow import Flow
from dpdjax.measure import transport
from dpdjax.measure.transport import diffusion, mean_squared_displacement, velocity_autocorrelation


def trajectory(unwrapped, velocity, interval, species=None, mass=(1.0,), flow=None):
    """What a run would leave behind, from arrays (..., frames, n, 3)."""
    species = np.zeros(velocity.shape[-2], int) if species is None else species
    # Beads that nothing slows in common: no flow of theirs comes back to them.
    fluid = dpd.fluid(
        [dpd.term(dpd.soft_repulsion, a=np.zeros((len(mass), len(mass))), r_c=1.0)],
        [],
        kT=1.0,
        mass=mass,
    )
    return SimpleNamespace(
        frames={"unwrapped": unwrapped, "velocity": velocity},
        interval=interval,
        dt=interval,
        flow=Flow.of(flow),
        final=SimpleNamespace(
            species=species,
            size=np.ones(len(species)),
            box=SimpleNamespace(lengths=np.full(3, 10.0)),
        ),
        fluid=fluid,
    )


def langevin(rng, rate, frames, h, kT=1.0):
    """Independent beads with damping ``rate`` (n,), sampled exactly: positions and velocities
    (frames, n, 3)."""
    rate = np.broadcast_to(rate, (np.size(rate),))[:, None]
    e = np.exp(-rate * h)
    var_v, cov = kT * (1 - e**2), kT / rate * (1 - e) ** 2
    var_x = kT / rate**2 * (2 * rate * h - 3 + 4 * e - e**2)
    v, x = np.sqrt(kT) * rng.normal(size=(rate.size, 3)), np.zeros((rate.size, 3))
    xs, vs = np.empty((2, frames, rate.size, 3))
    for k in range(frames):
        xs[k], vs[k] = x, v
        a, b = rng.normal(size=(2, rate.size, 3))
        x = x + v * (1 - e) / rate + cov / np.sqrt(var_v) * a + np.sqrt(var_x - cov**2 / var_v) * b
        v = e * v + np.sqrt(var_v) * a
    return xs, vs


RATE, BEADS, H = 2.0, 60, 0.1
KEPT = 1 - 1 / BEADS
"""What is left of independent motions relative to the centre of mass."""


@pytest.fixture(scope="module")
def brownian():
    return trajectory(*langevin(np.random.default_rng(5), np.full(BEADS, RATE), 3000, H), H)


def test_free_flight():
    rng = np.random.default_rng(0)
    velocity = rng.normal(size=(500, 3))
    time = 0.1 * np.arange(60)[:, None, None]
    drift = np.array([5.0, 0.0, -1.0])
    free = trajectory(
        (velocity + drift) * time, np.broadcast_to(velocity + drift, (60, 500, 3)), 0.1
    )
    speed = np.mean(np.sum((velocity - velocity.mean(0)) ** 2, axis=1))
    msd, vacf = (
        mean_squared_displacement(free, t_max=2.0),
        velocity_autocorrelation(free, t_max=2.0),
    )
    assert np.allclose(msd.time, 0.1 * np.arange(21))
    assert np.allclose(msd.value, speed * msd.time**2, atol=1e-9)
    assert np.allclose(vacf.value, speed)
    assert speed == pytest.approx(3.0, rel=0.1)


def test_products_are_the_averages_over_origins():
    x = np.random.default_rng(1).normal(size=(30, 7, 3))
    origins = range(30 - 12)
    by_hand = [np.mean([np.sum(x[o] * x[o + lag], axis=1) for o in origins]) for lag in range(13)]
    assert np.allclose(transport.autocorrelation(x, 12), by_hand)
    by_hand = [
        np.mean([np.sum((x[o] - x[o + lag]) ** 2, axis=1) for o in origins]) for lag in range(13)
    ]
    assert np.allclose(transport.squared_displacement(x, 12), by_hand)


def test_beads_in_several_groups_are_all_counted(monkeypatch):
    x = np.random.default_rng(1).normal(size=(30, 7, 3))
    whole = transport._products(x, 5)
    monkeypatch.setattr(transport, "BEADS_AT_ONCE", 3)
    assert np.allclose(transport._products(x, 5), whole)


def test_brownian_curves(brownian):
    msd, vacf = (
        mean_squared_displacement(brownian, t_max=5.0),
        velocity_autocorrelation(brownian, t_max=5.0),
    )
    t = msd.time
    expected = 6 / RATE**2 * (RATE * t - 1 + np.exp(-RATE * t)) * KEPT
    assert np.all(np.abs(msd.value - expected)[1:] < 4.5 * msd.error[1:])
    assert np.all(np.abs(vacf.value - 3 * np.exp(-RATE * t) * KEPT) < 4.5 * vacf.error)
    assert np.all(msd.error[1:] < 0.05 * msd.value[1:])


@pytest.mark.parametrize("method", ["msd", "vacf"])
def test_brownian_diffusion(brownian, method):
    D = diffusion(brownian, method=method, fit=(2.0, 5.0))
    assert D.deviation(KEPT / RATE) < 3.5
    assert 0.002 < D.error / D.value < 0.05 and D.blocks == 12
    assert diffusion(brownian, method=method).deviation(KEPT / RATE) < 3.5


@pytest.mark.parametrize("method", ["msd", "vacf"])
def test_lags_at_which_velocities_are_remembered(brownian, method):
    """A memory ``exp(-2 t)`` leaves ``D exp(-2 t)`` to come: refused where that is a quarter, else
    told as what it is."""
    with pytest.raises(
        ValueError,
        match=r"between lags of 0.1 and 0.4 the velocities are not yet forgotten.* fit later "
        r"lags, fit=",
    ):
        diffusion(brownian, method=method, fit=(0.1, 0.4))
    with pytest.warns(
        UserWarning, match="velocities are still remembered.*too small by about"
    ) as told:
        found = diffusion(brownian, method=method, fit=(0.8, 1.2))
    missing = float(str(told[0].message).split("too small by about ")[1].split(",")[0])
    assert missing == pytest.approx(np.exp(-2.0) / RATE, rel=0.15)
    assert found.value + missing == pytest.approx(KEPT / RATE, abs=3.5 * found.error)
    later = str(told[0].message).split("fit=(")[1].split(")")[0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (
            diffusion(brownian, method=method, fit=tuple(map(float, later.split(", ")))).deviation(
                KEPT / RATE
            )
            < 3.5
        )


def test_short_runs_have_no_diffusion(brownian):
    """Whatever is fitted by default."""
    for frames in (60, 120):
        short = SimpleNamespace(**vars(brownian))
        short.frames = {name: values[:frames] for name, values in brownian.frames.items()}
        for method in ("msd", "vacf"):
            with pytest.raises(ValueError, match="not yet forgotten"):
                diffusion(short, method=method)


def test_a_curve_that_bends_otherwise_is_not_straight(brownian):
    """Where beads are so light that they forget at once, and yet speed up."""
    light = SimpleNamespace(**vars(brownian))
    light.fluid = brownian.fluid.set(kT=1e3, energies="keep")
    with pytest.warns(UserWarning, match="not yet straight between 0.1 and 1: its slope grows by"):
        diffusion(light, fit=(0.1, 1.0))


def test_frames_too_far_apart_to_integrate():
    rng = np.random.default_rng(6)
    coarse = trajectory(*langevin(rng, np.full(BEADS, RATE), 3000, 0.5), 0.5)
    with pytest.warns(
        UserWarning, match="frames 0.5 apart are too far for the integral.*too large by about"
    ):
        found = diffusion(coarse, method="vacf", fit=(4.0, 8.0))
    assert found.value > 0.53
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert diffusion(coarse, fit=(4.0, 8.0)).deviation(KEPT / RATE) < 3.5


@pytest.mark.filterwarnings("error")
def test_a_fit_of_late_lags_is_not(brownian):
    diffusion(brownian, fit=(2.0, 5.0))
    diffusion(brownian)


@pytest.mark.parametrize("method", ["msd", "vacf"])
def test_replicas_are_pieces(method):
    rng = np.random.default_rng(7)
    runs = [langevin(rng, np.full(40, RATE), 200, H) for _ in range(16)]
    batch = trajectory(*(np.stack(x) for x in zip(*runs)), np.full(16, H))
    D = diffusion(batch, method=method, fit=(2.0, 5.0))
    assert D.blocks == 16
    assert D.deviation((1 - 1 / 40) / RATE) < 3.5


def test_species_apart():
    rng = np.random.default_rng(8)
    species = np.repeat([0, 1], 50)
    runs = langevin(rng, np.where(species == 0, 2.0, 8.0), 2500, H)
    pair = trajectory(*runs, H, species=species, mass=(1.0, 1.0))
    # A hundredth of the mean over species comes back through the centre of mass.
    for which, D in enumerate((0.5, 0.125)):
        expected = D * (1 - 2 / 100) + np.mean([0.5, 0.125]) / 100
        assert diffusion(pair, fit=(2.0, 5.0), species=which).deviation(expected) < 3.5


def test_drift_is_that_of_the_mass():
    """A heavy bead at rest and a light one moving: the frame moves with the centre of mass."""
    velocity = np.zeros((20, 2, 3))
    velocity[:, 1, 0] = 4.0
    moving = trajectory(
        velocity * 0.5 * np.arange(20)[:, None, None], velocity, 0.5, np.array([0, 1]), (3.0, 1.0)
    )
    heavy, light = (velocity_autocorrelation(moving, species=s, t_max=1.0).value for s in (0, 1))
    assert np.allclose(heavy, 1.0) and np.allclose(light, 9.0)


def test_one_species_recorded_alone():
    """As if all were recorded, where these have no momentum."""
    rng, species, mass = np.random.default_rng(9), np.repeat([0, 1], [12, 8]), np.array([1.0, 3.0])
    x, v = (
        np.stack(values)
        for values in zip(*(langevin(rng, np.full(20, RATE), 100, H) for _ in range(4)))
    )
    x, v = (
        values - np.average(values, axis=2, weights=mass[species])[:, :, None] for values in (x, v)
    )
    whole = trajectory(x, v, H, species, mass)
    alone = SimpleNamespace(**vars(whole))
    alone.frames = {name: values[:, :, species == 1] for name, values in whole.frames.items()}
    for measure in (mean_squared_displacement, velocity_autocorrelation):
        a, b = measure(whole, species=1), measure(alone, species=1)
        assert np.allclose(a.value, b.value) and np.allclose(a.error, b.error)
    D = diffusion(alone, species=1, fit=(3.0, 4.0))
    assert D.value == pytest.approx(diffusion(whole, species=1, fit=(3.0, 4.0)).value)
    for wrong in (None, 0):
        with pytest.raises(
            ValueError,
            match="recorded 8 of its 20 beads, not the .* to be measured; name their species",
        ):
            diffusion(alone, species=wrong)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"method": "slope"}, 'method is .slope.; it is "msd" or "vacf"'),
        ({"species": 3}, "no bead is of species 3; there are 0"),
        ({"fit": (1.0, 1.05)}, "fit = .* holds 1 lags"),
        ({"fit": (1.0, 100.0)}, "1 independent pieces"),
        (
            {"fit": (1.0, 1000.0)},
            "longest lag 1000 is outside the run; frames are 0.1 apart over 299.9",
        ),
    ],
)
def test_wrong_arguments(brownian, arguments, message):
    with pytest.raises(ValueError, match=message):
        diffusion(brownian, **arguments)


def test_wrong_trajectories():
    x = np.zeros((30, 4, 3))
    with pytest.raises(
        ValueError,
        match="sheared.*recorded without their images is unknown; use "
        "observe=dpd.observe.positions",
    ):
        diffusion(trajectory(x, x, H, flow=dpd.shear(0.1)))
    with pytest.raises(ValueError, match="differ in dt"):
        diffusion(trajectory(np.stack([x, x]), np.stack([x, x]), np.array([0.1, 0.2])))
    with pytest.raises(ValueError, match="20 frames are too few"):
        mean_squared_displacement(trajectory(x[:20], x[:20], H))
    with pytest.raises(ValueError, match="NaN"):
        diffusion(trajectory(x + np.nan, x, H))
    missing = trajectory(x, x, H)
    del missing.frames["unwrapped"]
    with pytest.raises(
        ValueError, match="no 'position' but velocity; use observe=dpd.observe.positions"
    ):
        diffusion(missing)


def test_one_piece_has_no_error_bar(brownian):
    assert np.all(np.isnan(mean_squared_displacement(brownian, t_max=200.0).error))


def test_results_draw_themselves(brownian):
    pytest.importorskip("matplotlib").use("Agg")
    msd, vacf = (
        mean_squared_displacement(brownian, t_max=2.0),
        velocity_autocorrelation(brownian, t_max=2.0),
    )
    assert msd.plot().get_ylabel() == "mean squared displacement [length$^2$]"
    ax = msd.plot(fit=(1.0, 2.0))
    late = msd.time >= 1.0 - 1e-6
    slope = np.polyfit(msd.time[late], msd.value[late], 1)[0]
    assert ax.lines[1].get_label() == f"6 D t + const, D = {slope / 6:.4g}"
    with pytest.raises(ValueError, match="holds 0 lags"):
        msd.plot(fit=(5.0, 6.0))
    across = mean_squared_displacement(brownian, t_max=2.0, axes="yz").scaled(length=2.0)
    assert across.plot(fit=(1.0, 2.0)).lines[1].get_label().startswith("4 D t")
    ax = vacf.plot()
    assert ax.get_ylabel() == "velocity autocorrelation [length$^2$/time$^2$]"
    assert ax.get_xlabel() == "t [time]" and vacf.plot(ax) is ax


def test_water_of_a_real_run():
    """Two replicas under vmap: free flight at first, ``3 kT`` at lag 0, then the diffusion of
    water."""
    water, key = dpd.water(), jax.random.key(4)
    state = dpd.initial_state(water, key, box=5.0, density=3.0)
    simulate = lambda key: dpd.simulate(
        water, state, key, 0.02, dpd.Plan(225, every=4), observe=dpd.observe.positions
    )
    run = jax.vmap(simulate)(jax.random.split(key, 2))
    run = dataclasses.replace(
        run, frames={name: values[:, 25:] for name, values in run.frames.items()}
    )
    vacf = velocity_autocorrelation(run)
    assert vacf.value[0] == pytest.approx(3.0, rel=0.05)
    assert np.all(np.diff(vacf.value[:6]) < 0)
    msd = mean_squared_displacement(run)
    assert msd.time[1] == pytest.approx(0.08)
    assert msd.value[1] == pytest.approx(3.0 * 0.08**2, rel=0.1)
    by_slope, by_memory = (
        diffusion(run, fit=(1.0, 1.5)),
        diffusion(run, method="vacf", fit=(1.0, 1.5)),
    )
    assert by_slope.deviation(by_memory) < 4
    assert abs(by_slope.value - 0.28) < 5 * by_slope.error
