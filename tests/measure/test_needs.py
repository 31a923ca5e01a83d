"""What measures need of a run: equilibrium, a steady state, displacements by the lattice."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter

import dpdjax as dpd
from dpdjax.engine.system import System
from dpdjax.measure import needs
from dpdjax.measure.needs import warn_of_drift
from dpdjax.pairs.box import wrap


def memory(rng, shape, kept=0.8):
    """A stationary series that remembers five frames."""
    start = rng.normal(size=(*shape[:-1], 1))
    return lfilter([1], [1, -kept], np.sqrt(1 - kept**2) * rng.normal(size=shape), zi=kept * start)[
        0
    ]


@pytest.mark.parametrize("shape", [(400,), (3, 150)])
def test_a_stationary_series_is_seldom_told_to_drift(shape):
    rng, told = np.random.default_rng(0), 0
    for _ in range(400):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            warn_of_drift({"stress": memory(rng, shape)})
        told += bool(caught)
    assert told <= 4


@pytest.mark.parametrize("frames", [9, 20, 400])
def test_a_drifting_series_is_told(frames):
    rng = np.random.default_rng(1)
    series = 3.0 * np.exp(-5.0 * np.arange(frames) / frames) + 0.1 * rng.normal(size=frames)
    with pytest.warns(UserWarning, match="not stationary: its viscosity goes from .* skip="):
        warn_of_drift({"viscosity": series})


def test_a_start_up_is_told(water, fresh, key):
    """From a random start, 10 frames gave a viscosity of 2.7 where 0.85 is right."""
    run = dpd.run(water, fresh, key, 0.01, dpd.Plan(10, 10), dpd.shear(0.3), progress=False)
    with pytest.warns(
        UserWarning, match="not stationary: its (temperature|potential_energy|viscosity)"
    ):
        dpd.shear_viscosity(run)


def synthetic(fluid, state, flow, **frames):
    frames = {"time": np.arange(200.0), "step": np.arange(200)} | frames
    return dpd.Trajectory(state, frames, System.of(fluid, 0.01, flow))


def test_equilibrium_viscosities_refuse_driven_runs(water, fresh):
    """Sheared at 0.3 they answered 1.73 and 2.90 where 0.85 is right."""
    rng = np.random.default_rng(2)
    tensors = {
        name: rng.normal(size=(200, 3, 3)) for name in ("flux", "reversed_flux", "flux_integral")
    }
    frames = tensors | {"instantaneous_viscosity": np.ones(200), "temperature": np.ones(200)}
    measures = {
        "Green-Kubo": lambda run: dpd.measure.green_kubo(run, window=0.05),
        "Einstein-Helfand": lambda run: dpd.measure.einstein_helfand(run, window=0.05),
    }
    driven = [(dpd.shear(0.3), "sheared"), (dpd.oscillatory_shear(0.1, 3.0), "sheared")]
    driven += [
        (dpd.drive(1.0, species=0), "a force drove"),
        (dpd.flows.sinusoidal_force(0.1, 4.2), "a force drove"),
    ]
    for name, measure in measures.items():
        for flow, why in driven:
            with pytest.raises(
                ValueError, match=f"{name} viscosity is of a fluid in equilibrium, and .*{why}"
            ):
                measure(synthetic(water, fresh, flow, **frames))
        assert np.isfinite(measure(synthetic(water, fresh, dpd.shear(0.0), **frames)).value)


@pytest.mark.parametrize("batch", [False, True])
def test_displacements_in_a_tilted_box_are_those_of_the_lattice(fresh, batch):
    """A box left at a strain of 0.4 had a bead that left it by the top come back 0.4 of its height
    off."""
    state = dataclasses.replace(fresh, box=fresh.box.strained(0.4))
    moved = state.position + jnp.asarray([[1.3, 7.0, -9.0]])
    position, crossed = wrap(state.box, moved)
    state = dataclasses.replace(state, position=position, image=state.image + crossed)
    state = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state) if batch else state
    np.testing.assert_allclose(
        state.unwrapped, np.broadcast_to(moved, state.position.shape), atol=1e-12
    )


def test_displacements_far_from_the_start_keep_their_digits(fresh, ideal):
    """After a thousand sides a single-precision position moved by half as much again."""
    rng = np.random.default_rng(3)
    lengths, steps = np.asarray(fresh.box.lengths), 1e-3 * rng.normal(size=(40, fresh.n, 3))
    walk = np.asarray(fresh.position, float) + np.cumsum(steps, axis=0)
    turns = np.floor(walk / lengths)
    frames = {
        "position": (walk - turns * lengths).astype(np.float32),
        "image": turns.astype(np.int32),
        "strain": np.zeros(40),
    }
    measured = {}
    for far in (0, 100_000):
        image = frames["image"] + far
        unwrapped = (frames["position"] + image * lengths.astype(np.float32)).astype(np.float32)
        record = frames | {
            "time": np.arange(40.0),
            "step": np.arange(40),
            "image": image,
            "unwrapped": unwrapped,
        }
        run = dpd.Trajectory(fresh, record, System.of(ideal, 1.0))
        measured[far] = dpd.measure.mean_squared_displacement(run, t_max=4.0).value
    np.testing.assert_allclose(measured[100_000], measured[0], rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(measured[0][1:], 3e-6 * np.arange(1, 5), rtol=0.1)


def test_what_is_no_run_is_told(fresh, water):
    for given in ({"frames": 1}, fresh, water):
        for measure in (
            dpd.shear_viscosity,
            dpd.measure.mean_squared_displacement,
            dpd.measure.radial_distribution,
        ):
            if measure is dpd.measure.radial_distribution and given is not fresh:
                continue
            with pytest.raises(
                (TypeError, ValueError), match="this measures a run, and was given a|positions"
            ):
                measure(given)
    with pytest.raises(ValueError, match="recorded no frame: it was interrupted"):
        dpd.shear_viscosity(dpd.Trajectory(fresh, {}, System.of(water, 0.01, dpd.shear(0.1))))


def test_failed_and_hot_runs_are_told(water, fresh):
    rng = np.random.default_rng(5)
    stress = {"pressure_tensor": rng.normal(size=(200, 3, 3)) - 0.1}
    with pytest.warns(UserWarning, match="the beads were at 5 where kT is 1"):
        dpd.shear_viscosity(
            synthetic(water, fresh, dpd.shear(0.1), temperature=np.full(200, 5.0), **stress)
        )
    stress["pressure_tensor"][70] = np.nan
    with pytest.raises(ValueError, match="'pressure_tensor' holds NaN .*survivors"):
        dpd.shear_viscosity(synthetic(water, fresh, dpd.shear(0.1), **stress))


def test_few_beads_are_not_told_hot_by_chance(water, fresh):
    """Frames close together are of one moment, however many; those of a long run are not."""
    of = lambda frames: synthetic(water, fresh, dpd.shear(0.1), temperature=np.full(frames, 1.04))
    wave = 1.04 + 0.01 * np.sin(np.arange(40))
    assert needs.is_off(wave, 1.0)
    assert needs.is_off(wave, 1.0, needs.doubt(of(40), 40)) is None
    assert needs.doubt(of(40), 40) > 5 * needs.doubt(of(40), 40 * 10000)
    assert needs.is_off(wave, 1.0, needs.doubt(of(40), 40 * 10000))


def test_a_block_average_refuses_what_it_cannot_average():
    told = (
        r"shape \(40, 3, 3\); give \(frames,\) or \(replicas, frames\), of a tensor one component"
    )
    with pytest.raises(ValueError, match=told):
        dpd.measure.block_average(np.ones((40, 3, 3)))
    with pytest.raises(ValueError, match="holds NaN or infinity"):
        dpd.measure.block_average([1.0, np.nan, 2.0, 3.0])


def test_measures_have_no_derivative():
    with pytest.raises(TypeError, match="no derivative|numbers of the host"):
        jax.jvp(lambda x: dpd.measure.block_average(x).value, (jnp.ones(8),), (jnp.ones(8),))
