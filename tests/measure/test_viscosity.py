"""Four roads to the viscosity: known answers, small real runs, and errors that say what to
record."""

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine.flow import Flow
from dpdjax.measure.viscosity import controlled

KT, SIDES, DT, H = 1.3, (5.0, 5.0, 4.0), 0.01, 0.02
REPLICAS, FRAMES = 4, 4000
RHO = 3.0


def trajectory(frames, flow=None, dt=DT, kT=KT):
    """What replicas of one system would leave behind, from arrays (replicas, frames, ...)."""
    replicas, count = next(iter(frames.values())).shape[:2]
    time = np.broadcast_to(H * np.arange(count), (replicas, count))
    lengths = np.array([SIDES] * replicas)
    return SimpleNamespace(
        frames=frames | {"time": time},
        is_batch=True,
        fluid=dpd.fluid(drag=[dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)], kT=kT),
        flow=Flow.of(flow),
        dt=np.asarray(dt),
        every=round(H / DT),
        interval=np.asarray(dt) * round(H / DT),
        final=SimpleNamespace(box=SimpleNamespace(lengths=lengths), n=round(RHO * np.prod(SIDES))),
    )


def stress(seed, viscosity, memory=0.2):
    """Symmetric stress with ``<P_xy(0) P_xy(t)> V / kT = viscosity / memory exp(-t / memory)``."""
    rng = np.random.default_rng(seed)
    x, keep = rng.normal(size=(REPLICAS, FRAMES, 3, 3)), np.exp(-H / memory)
    for k in range(1, FRAMES):
        x[:, k] = keep * x[:, k - 1] + np.sqrt(1 - keep**2) * x[:, k]
    return (x + np.swapaxes(x, -1, -2)) * np.sqrt(0.5 * KT * viscosity / memory / np.prod(SIDES))


def within(estimates, exact, bias=0.0):
    """Whether independent estimates scatter about the exact value as their errors say."""
    z = np.array([(e.value - exact) / e.error for e in estimates])
    return abs(z.mean()) < 4 / np.sqrt(z.size) and 0.6 < z.std() < 1.6


def test_green_kubo_integrates_the_memory():
    """The drag part counts negative, and what acts at once is added."""
    estimates = []
    for seed in range(12):
        smooth, drag = stress(seed, 1.5), stress(100 + seed, 0.4)
        instant = 0.3 + 0.05 * np.random.default_rng(seed).normal(size=(REPLICAS, FRAMES))
        frames = {
            "flux": smooth + drag,
            "reversed_flux": smooth - drag,
            "instantaneous_viscosity": instant,
        }
        estimates.append(dpd.measure.green_kubo(trajectory(frames), window=1.6))
    assert within(estimates, 0.3 + 1.5 - 0.4)
    assert max(e.error for e in estimates) < 0.2


def test_green_kubo_integrates_by_the_trapezoidal_rule():
    """Of one orientation all the time, a fifth is seen in the mean over all."""
    steady = np.broadcast_to(
        0.7 * np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0]]), (REPLICAS, 100, 3, 3)
    )
    frames = {
        "flux": steady,
        "reversed_flux": steady,
        "instantaneous_viscosity": np.ones((REPLICAS, 100)),
    }
    eta = dpd.measure.green_kubo(trajectory(frames), window=5 * H)
    assert eta.value == pytest.approx(1.0 + np.prod(SIDES) / KT * 0.2 * 0.7**2 * 5 * H)


def test_green_kubo_stops_at_the_window():
    frames = {"flux": stress(0, 1.5), "instantaneous_viscosity": np.zeros((REPLICAS, FRAMES))}
    run = trajectory(frames | {"reversed_flux": frames["flux"]})
    with pytest.warns(
        UserWarning,
        match="still remembered at the end of the window, to 5.% of.*leaves out about 0.8",
    ) as told:
        half = dpd.measure.green_kubo(run, window=0.2 * np.log(2))
    assert half.deviation(0.75) < 4 and half.error < 0.05
    assert len(told) == 1


@pytest.mark.filterwarnings("error")
def test_windows_in_which_the_stress_is_forgotten_are_not_told():
    for seed in range(12):
        flux = stress(seed, 1.5)
        frames = {
            "flux": flux,
            "reversed_flux": flux,
            "instantaneous_viscosity": np.zeros((REPLICAS, FRAMES)),
        }
        dpd.measure.green_kubo(trajectory(frames), window=1.6)
        dpd.measure.einstein_helfand(trajectory({"flux_integral": H * flux}), window=1.6)


def test_einstein_helfand_is_the_growth_of_the_integral():
    flux = [trajectory({"flux_integral": H * stress(seed, 1.5)}) for seed in range(12)]
    assert within([dpd.measure.einstein_helfand(t, window=1.6) for t in flux], 1.5)
    # From lag 0 the ballistic start is missing: eta (1 - (memory / t) (1 - exp(-t / memory))).
    with pytest.warns(UserWarning, match="not yet straight: its slope changes by 0.*start later"):
        assert within(
            [dpd.measure.einstein_helfand(t, start=0.0, window=1.6) for t in flux],
            1.5 * (1 - 0.125),
        )


def test_pressure_of_any_trace_has_no_viscosity():
    isotropic = np.random.default_rng(0).normal(size=(REPLICAS, FRAMES, 1, 1)) * np.eye(3)
    frames = {"flux_integral": isotropic}
    assert dpd.measure.einstein_helfand(trajectory(frames), window=0.4).value == pytest.approx(
        0.0, abs=1e-12
    )


def test_sinusoidal_viscosity_of_a_known_wave():
    noise = 0.01 * np.random.default_rng(0).normal(size=(REPLICAS, FRAMES))
    flow = dpd.flows.sinusoidal_force(0.2, side=SIDES[1])
    eta = dpd.measure.sinusoidal_viscosity(trajectory({"wave_velocity": 0.5 + noise}, flow))
    k = 2 * np.pi / SIDES[1]
    assert eta.deviation(RHO * 0.2 / (0.5 * k**2)) < 4
    assert eta.error / eta.value == pytest.approx(0.01 / 0.5 / np.sqrt(0.8 * noise.size), rel=0.4)


def test_sine_record_reads_the_amplitude(water, fresh):
    y = fresh.position[:, 1] / fresh.box.lengths[1]
    waves = 0.7 * jnp.stack([jnp.sin(4 * jnp.pi * y), y, y], axis=1)
    state = dataclasses.replace(fresh, velocity=waves)
    record = dpd.observe.wave_of(2).observe(water, state)
    assert record["wave_velocity"] == pytest.approx(0.7, rel=0.2)
    assert record["momentum"][1] == pytest.approx(0.7 * float(y.sum()))
    assert dpd.observe.wave_of(2) is dpd.observe.wave_of(2), (
        "one object for each, or every run compiles anew"
    )


def test_control_variate_removes_noise_and_keeps_the_mean():
    rng = np.random.default_rng(0)
    noise, signal = rng.normal(size=(2, REPLICAS, FRAMES))
    cleaned = controlled(1.0 + 0.1 * signal + 2.0 * noise, noise)
    plain = dpd.measure.block_average(1.0 + 0.1 * signal + 2.0 * noise)
    assert dpd.measure.block_average(cleaned).error < 0.3 * plain.error
    assert dpd.measure.block_average(cleaned).deviation(1.0) < 4
    assert np.all(controlled(signal, np.zeros_like(noise)) == signal)


def test_replicas_are_pooled_after_the_start():
    pressure = -0.4 * (1.0 + np.random.default_rng(0).normal(size=(REPLICAS, FRAMES)))
    pressure[:, : FRAMES // 4] = 100.0
    frames = {
        "pressure_tensor": pressure[..., None, None] * np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0]])
    }
    eta = dpd.shear_viscosity(trajectory(frames, dpd.shear(0.4)), skip=0.25)
    assert eta.value == pytest.approx(-pressure[:, FRAMES // 4 :].mean() / 0.4)
    assert eta.error == pytest.approx(1 / np.sqrt(0.75 * REPLICAS * FRAMES), rel=0.5)


def test_numbers_that_a_vmap_repeated_are_pooled():
    many = lambda x: np.full(REPLICAS, x)
    flux = {"flux_integral": stress(0, 1.0)}
    assert dpd.measure.einstein_helfand(
        trajectory(flux, kT=many(KT), dt=many(DT)), window=1.0
    ) == dpd.measure.einstein_helfand(trajectory(flux), window=1.0)
    sheared = {"pressure_tensor": stress(1, 1.0)}
    one, repeated = (
        dpd.shear_viscosity(trajectory(sheared, dpd.shear(rate))) for rate in (0.2, many(0.2))
    )
    assert one == repeated


def test_shear_viscosity_of_a_real_run(ideal, key):
    """a = 0, gamma = 5, at a rate that heats by 4 %."""
    state = dpd.initial_state(ideal, key, box=6.0, density=RHO, skin=0.2)
    run = dpd.run(
        ideal,
        state,
        key,
        0.02,
        dpd.Plan(300, 10),
        dpd.shear(0.5),
        observe=dpd.observe.shear_record,
        progress=False,
    )
    eta = dpd.shear_viscosity(run)
    assert eta.error < 0.06
    assert eta.deviation(1.26) < 4
    assert dpd.shear_viscosity(run, control=False).deviation(eta) < 4


def test_sinusoidal_viscosity_of_a_real_run(ideal, key):
    """At a wavelength of 10 the kinetic corrections are 9 %. The wave is there from the start."""
    state = dpd.initial_state(ideal, key, box=[3.0, 10.0, 3.0], density=RHO, skin=0.2)
    wave = jnp.sin(2 * jnp.pi * state.position[:, 1] / 10.0)
    state = dataclasses.replace(state, velocity=state.velocity.at[:, 0].add(wave - wave.mean()))
    flow = dpd.flows.sinusoidal_force(0.16, side=10.0)
    run = dpd.run(
        ideal,
        state,
        key,
        0.02,
        dpd.Plan(80, 40),
        flow,
        observe=dpd.observe.wave_of(),
        progress=False,
    )
    assert dpd.measure.sinusoidal_viscosity(run).value == pytest.approx(0.91 * 1.26, rel=0.2)
    assert np.allclose(run.frames["momentum"], 0, atol=1e-9)


RECORD = {"temperature": np.ones((REPLICAS, FRAMES))}


@pytest.mark.parametrize(
    "measure, flow, missing",
    [
        (dpd.shear_viscosity, dpd.shear(0.2), "pressure_tensor"),
        (lambda t: dpd.measure.green_kubo(t, window=1.0), None, "flux"),
        (lambda t: dpd.measure.einstein_helfand(t, window=1.0), None, "flux_integral"),
        (
            dpd.measure.sinusoidal_viscosity,
            dpd.flows.sinusoidal_force(0.1, side=5.0),
            "wave_velocity",
        ),
    ],
    ids=["shear", "green_kubo", "einstein_helfand", "sine"],
)
def test_missing_record_is_named(measure, flow, missing):
    with pytest.raises(ValueError, match=f"recorded no '{missing}'; use observe=dpd"):
        measure(trajectory(RECORD, flow))


def test_run_without_the_flow():
    pressure = {"pressure_tensor": np.zeros((REPLICAS, FRAMES, 3, 3))}
    with pytest.raises(ValueError, match=r"had no shear; run it with flow=dpd.shear\(rate\)"):
        dpd.shear_viscosity(trajectory(pressure))
    with pytest.raises(ValueError, match="had no dpd.flows.sinusoidal_force"):
        dpd.measure.sinusoidal_viscosity(trajectory(pressure, dpd.shear(0.2)))


def test_window_too_long_for_the_run():
    with pytest.raises(
        ValueError, match="4000 frames of 4 replicas are too few for a window of 5000: run longer"
    ):
        dpd.measure.einstein_helfand(trajectory({"flux_integral": stress(0, 1.0)}), window=100.0)


@pytest.mark.parametrize(
    "scan, name",
    [
        ({"kT": np.array([1.0, 1.0, 1.0, 2.0])}, "kT"),
        ({"dt": np.array([0.01, 0.01, 0.02, 0.02])}, "dt"),
        ({"flow": dpd.shear(np.array([0.1, 0.2, 0.3, 0.4]))}, "rate"),
    ],
    ids=["numbers", "dt", "rate"],
)
def test_scan_is_not_pooled(scan, name):
    frames = {
        "pressure_tensor": np.zeros((REPLICAS, FRAMES, 3, 3)),
        "flux_integral": stress(0, 1.0),
    }
    refused = pytest.raises(
        ValueError, match=f"the members of this batch differ in {name}; measure them one by one"
    )
    with refused:
        dpd.shear_viscosity(trajectory(frames, **({"flow": dpd.shear(0.2)} | scan)))
    if "flow" not in scan:
        with refused:
            dpd.measure.einstein_helfand(trajectory(frames, **scan), window=1.0)
