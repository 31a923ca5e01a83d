"""Oscillatory shear: the strain it imposes, the clock it follows, and the moduli that are read
off."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine.flow import Flow

AMPLITUDE, FREQUENCY, DT = 1.0, 1.3, 0.01
FLOW = dpd.oscillatory_shear(AMPLITUDE, FREQUENCY)


def test_strain_of_all_steps_adds_up_to_a_sine():
    time = DT * np.arange(1000)
    strain = np.cumsum(FLOW.strain_in(time, DT))
    np.testing.assert_allclose(strain, AMPLITUDE * np.sin(FREQUENCY * (time + DT)), atol=1e-12)


def test_rate_is_the_slope_of_the_strain():
    time = np.linspace(0.0, 7.0, 50)
    np.testing.assert_allclose(
        FLOW.rate_at(time), FLOW.strain_in(time - 1e-5, 2e-5) / 2e-5, rtol=1e-8, atol=1e-8
    )
    assert float(FLOW.rate) == pytest.approx(float(np.max(FLOW.rate_at(np.linspace(0, 7, 10_001)))))
    steady = dpd.shear(0.3)
    assert steady.rate_at(5.0) == 0.3 and steady.strain_in(5.0, DT) == pytest.approx(0.3 * DT)


def test_strain_of_a_small_step_is_right_in_single_precision():
    """A difference of two sines would lose four digits."""
    time = np.linspace(0.1, 1.0, 20)
    with jax.enable_x64(False):
        single = dpd.oscillatory_shear(1.0, 1.0).strain_in(
            jnp.asarray(time, jnp.float32), jnp.float32(1e-3)
        )
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, 2 * np.sin(5e-4) * np.cos(time + 5e-4), rtol=1e-6)


# Stress known in closed form.

G, MEMORY = 5.0, 0.4
STORAGE = G * (FREQUENCY * MEMORY) ** 2 / (1 + (FREQUENCY * MEMORY) ** 2)
LOSS = G * FREQUENCY * MEMORY / (1 + (FREQUENCY * MEMORY) ** 2)
EVERY, CYCLES = 37, 10
WATER = dpd.fluid(drag=[dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)], kT=1.0)


def maxwell(time):
    """Stress of a Maxwell fluid under the strain, less a constant."""
    return AMPLITUDE * (STORAGE * np.sin(FREQUENCY * time) + LOSS * np.cos(FREQUENCY * time)) - 2.0


def trajectory(stress, time, every=EVERY, flow=FLOW, fluid=WATER, dt=DT):
    """What a run would leave behind; stress (frames,) or (replicas, frames)."""
    pressure = -np.asarray(stress)[..., None, None] * np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0]])
    time = np.broadcast_to(time, np.shape(stress))
    return SimpleNamespace(
        frames={"time": time, "pressure_tensor": pressure},
        flow=Flow.of(flow),
        fluid=fluid,
        every=every,
        interval=np.asarray(dt) * every,
        dt=np.asarray(dt),
    )


def steps_of(cycles=CYCLES, every=EVERY):
    """Times at the end of each step, (frames, every)."""
    frames = int(cycles * 2 * np.pi / (FREQUENCY * DT * every)) + 1
    return DT * (1 + np.arange(frames * every)).reshape(frames, every)


def means(signal=maxwell, **how):
    """Frames that are means over their steps."""
    time = steps_of(**how)
    return trajectory(signal(time).mean(1), time[:, -1], time.shape[1])


@pytest.mark.parametrize("every", [1, 5, EVERY])
def test_moduli_of_a_maxwell_fluid_from_means(every):
    found = dpd.measure.moduli(means(every=every))
    np.testing.assert_allclose(found.cycles, [[STORAGE, LOSS]] * (CYCLES - 1), rtol=1e-9)
    assert found.storage.value == pytest.approx(STORAGE) and found.loss.value == pytest.approx(LOSS)
    assert found.frequency == FREQUENCY and found.viscosity.value == pytest.approx(LOSS / FREQUENCY)


def test_moduli_of_a_maxwell_fluid_from_snapshots():
    time = steps_of()[:, -1]
    found = dpd.measure.moduli(trajectory(maxwell(time), time), averaged=False)
    np.testing.assert_allclose(found.cycles, [[STORAGE, LOSS]] * (CYCLES - 1), rtol=1e-9)


def test_moduli_of_noisy_replicas_have_honest_errors():
    rng, time = np.random.default_rng(0), steps_of()
    off = []
    for _ in range(40):
        noisy = maxwell(time).mean(1) + rng.normal(size=(3, len(time)))
        found = dpd.measure.moduli(trajectory(noisy, time[:, -1]))
        assert found.cycles.shape == (3 * (CYCLES - 1), 2)
        off += [
            (e.value - exact) / e.error
            for e, exact in ((found.storage, STORAGE), (found.loss, LOSS))
        ]
    assert abs(np.mean(off)) < 4 / np.sqrt(len(off)) and 0.75 < np.std(off) < 1.3


def test_the_start_is_left_out():
    late = lambda time: maxwell(time) + 30 * np.exp(-time / 0.2)
    assert dpd.measure.moduli(means(late), skip=1).storage.value == pytest.approx(STORAGE)
    assert dpd.measure.moduli(means(late), skip=0).storage.value > 1.05 * STORAGE
    assert len(dpd.measure.moduli(means(), skip=4).cycles) == CYCLES - 4


def scan(**how):
    time = steps_of()
    return trajectory(np.zeros((2, len(time))), time[:, -1], **how)


@pytest.mark.parametrize(
    "run, message",
    [
        (lambda: scan(flow=dpd.shear(0.2)), r"flow=dpd.oscillatory_shear\(amplitude, frequency\)"),
        (lambda: scan(flow=None), "oscillatory_shear"),
        (
            lambda: scan(flow=dpd.oscillatory_shear(jnp.array([0.1, 0.2]), 1.0)),
            "differ in amplitude; .*members",
        ),
        (
            lambda: scan(flow=dpd.oscillatory_shear(0.1, jnp.array([1.0, 2.0]))),
            "differ in frequency",
        ),
        (lambda: scan(fluid=WATER.set(gamma=jnp.array([1.0, 2.0]))), "differ in gamma"),
        (
            lambda: trajectory(
                np.zeros((2, 99)), DT * np.outer([1, 2], np.arange(99)), dt=[DT, 2 * DT]
            ),
            "differ in dt",
        ),
        (
            lambda: trajectory(np.zeros((2, 99)), DT * (np.arange(99) + np.array([[0], [1]]))),
            "at different times",
        ),
        (
            lambda: means(every=70),
            "6.9 frames in a cycle are too few; record at least 8, with every=60",
        ),
        (
            lambda: means(cycles=2),
            "1 whole cycles after the first 1 give no error bar; run at least 3",
        ),
    ],
    ids=[
        "steady",
        "quiet",
        "amplitudes",
        "frequencies",
        "fluids",
        "steps",
        "starts",
        "sparse",
        "short",
    ],
)
def test_runs_that_tell_no_moduli(run, message):
    with pytest.raises(ValueError, match=message):
        dpd.measure.moduli(run())


def test_missing_stress_is_named():
    blind = means()
    del blind.frames["pressure_tensor"]
    with pytest.raises(ValueError, match="recorded no 'pressure_tensor'"):
        dpd.measure.moduli(blind)


def test_oscillating_shear_has_no_steady_viscosity():
    with pytest.raises(ValueError, match="oscillates; use dpd.measure.moduli"):
        dpd.shear_viscosity(means())


# A real run.

SLOW, PLAN = 0.8, dpd.Plan(240, 30)


@pytest.fixture(scope="module")
def water_in_oscillation(water, fresh, key):
    flow, observe = dpd.oscillatory_shear(AMPLITUDE, SLOW), dpd.mean(dpd.observe.standard)
    return dpd.run(water, fresh, key, DT, PLAN, flow, observe=observe, progress=False)


def test_box_follows_the_strain(water_in_oscillation):
    final = water_in_oscillation.final
    assert float(final.time) == pytest.approx(PLAN.steps * DT, rel=1e-12)
    off = float(final.box.strain) - AMPLITUDE * np.sin(SLOW * PLAN.steps * DT)
    assert abs(off - round(off)) < 1e-9, "modulo the period, a whole side"
    assert abs(float(final.box.strain)) <= 0.5


def test_oscillation_moves_no_momentum(water_in_oscillation):
    assert np.max(np.abs(water_in_oscillation.frames["momentum"])) < 1e-9


def test_a_run_knows_its_means(water_in_oscillation, water, fresh, key):
    assert "pressure_tensor" in water_in_oscillation.means
    by_hand = dpd.measure.moduli(water_in_oscillation, averaged=True)
    assert by_hand.loss.value == dpd.measure.moduli(water_in_oscillation).loss.value
    assert (
        dpd.measure.moduli(water_in_oscillation, averaged=False).storage.value
        != by_hand.storage.value
    )
    keys, frequency = jax.random.split(key, 2), jnp.array([SLOW, 2 * SLOW])
    flow = dpd.oscillatory_shear(AMPLITUDE, frequency)
    observe = [dpd.mean(dpd.observe.momentum), dpd.observe.stresses]
    scan = dpd.run(
        water.set(kT=jnp.array([1.0, 2.0])),
        fresh,
        keys,
        DT,
        dpd.Plan(2, 2),
        flow,
        observe=observe,
        progress=False,
    )
    assert [m.means for m in scan.members()] == [("momentum",), ("momentum",)]
    assert dpd.simulate(water, fresh, key, DT, dpd.Plan(1), observe=observe).means == ("momentum",)


def test_water_is_viscous_and_hardly_elastic(water_in_oscillation):
    found = dpd.measure.moduli(water_in_oscillation)
    assert len(found.cycles) == 8 and found.viscosity.error < 0.06
    # Of 128 beads at this frequency, whatever the sample; that of a large box at rest is 0.85.
    assert abs(found.viscosity.value - 0.85) < 0.2
    assert abs(found.storage.value) < 0.2 * found.loss.value + 3 * found.storage.error
