"""Displacement and structure under shear: through the images, relative to the flow, each frame in
its own tilted box."""

import dataclasses
import itertools

import jax
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.measure.reading import displaced
from dpdjax.measure.spheres import Spheres

SIDES, DT, EVERY = np.array([5.0, 7.0, 6.0]), 0.005, 10
AMPLITUDE, FREQUENCY, RATE = 1.5, 2.0, 0.8


@pytest.fixture(scope="module", params=["steady", "oscillating"])
def flight(request):
    """Beads that meet nobody, thrown through a box that tilts by more than its period; where from,
    and the strain of each frame."""
    fluid = dpd.fluid(drag=[dpd.term(dpd.central_drag, gamma=0.0, r_c=1.0)], kT=4.0)
    state = dpd.initial_state(fluid, jax.random.key(0), box=SIDES, n=30, dt=DT)
    flow = (
        dpd.shear(RATE)
        if request.param == "steady"
        else dpd.oscillatory_shear(AMPLITUDE, FREQUENCY)
    )
    run = dpd.run(
        fluid,
        state,
        jax.random.key(1),
        DT,
        dpd.Plan(80, EVERY),
        flow,
        observe=dpd.observe.positions,
        progress=False,
    )
    time = np.asarray(run.frames["time"], float)
    steady = request.param == "steady"
    strain = RATE * time if steady else AMPLITUDE * np.sin(FREQUENCY * time)
    integral = (
        0.5 * RATE * time**2 if steady else AMPLITUDE / FREQUENCY * (1 - np.cos(FREQUENCY * time))
    )
    assert np.ptp(strain) > SIDES[0] / SIDES[1]
    return state, run, strain, integral


def test_unwrapped_positions_go_through_any_tilt(flight):
    """What no force acts on goes on across the flow, and along it as the flow and its inertia say,
    whatever the images do.

    With the strain s, the velocity relative to the flow is ``c - s v_y`` and ``dx/dt`` that and
    ``s' y``, so ``x = x_0 + c t + s y_0 + v_y (s t - 2 integral of s)``.
    """
    start, run, strain, integral = flight
    time = np.asarray(run.frames["time"], float)[:, None]
    (x, y, z), (c, vy, vz) = np.asarray(start.position).T, np.asarray(start.velocity).T
    moved = run.frames["unwrapped"]
    assert np.ptp(run.frames["image"][..., 1]) > 3, "beads crossed several boxes"
    np.testing.assert_allclose(moved[..., 1], y + vy * time, atol=1e-9)
    np.testing.assert_allclose(moved[..., 2], z + vz * time, atol=1e-9)
    along = (
        x + c * time + strain[:, None] * y + vy * (strain[:, None] * time - 2 * integral[:, None])
    )
    np.testing.assert_allclose(moved[..., 0], along, atol=0.02)


def test_the_flow_is_taken_off(flight):
    """What is left is what the velocities relative to the flow add up to."""
    start, run, _, integral = flight
    c, vy = np.asarray(start.velocity)[:, :2].T
    left = displaced(run)[0, ..., 0] - displaced(run)[0, :1, :, 0]
    time = np.asarray(run.frames["time"], float)[:, None]
    due = c * time - vy * integral[:, None]
    np.testing.assert_allclose(left, due - due[0], atol=0.02)
    assert np.ptp(run.frames["unwrapped"][..., 0] - left) > 10


def test_without_a_flow_nothing_is_taken_off(water, fresh, key):
    run = dpd.run(
        water, fresh, key, 0.01, dpd.Plan(20, 5), observe=dpd.observe.positions, progress=False
    )
    np.testing.assert_allclose(displaced(run)[0], run.frames["unwrapped"], atol=1e-12)


def test_frames_too_far_apart_are_told(flight):
    _, run, _, _ = flight
    rare = dataclasses.replace(
        run, every=200, frames={name: values[19::20] for name, values in run.frames.items()}
    )
    with pytest.raises(
        ValueError,
        match="strained by up to .* between frames.* record frames closer together, every=(75|20)",
    ):
        dpd.measure.mean_squared_displacement(rare)


def test_averaged_positions_are_refused(flight):
    _, run, _, _ = flight
    averaged = dataclasses.replace(run, means=("position", "velocity"))
    for measure in (
        dpd.measure.mean_squared_displacement,
        dpd.measure.velocity_autocorrelation,
        dpd.measure.radial_distribution,
    ):
        with pytest.raises(
            ValueError,
            match="recorded means of '(position|velocity)'.*use observe=dpd.observe.positions "
            "without dpd.mean",
        ):
            measure(averaged)


def test_axes_are_some_of_three(flight):
    _, run, _, _ = flight
    for axes in ("", "xx", "xw"):
        with pytest.raises(ValueError, match=f"axes is '{axes}'; give some of"):
            dpd.measure.mean_squared_displacement(run, axes=axes)
    apart = [dpd.measure.mean_squared_displacement(run, axes=axis).value for axis in "xyz"]
    np.testing.assert_allclose(
        sum(apart), dpd.measure.mean_squared_displacement(run).value, rtol=1e-9, atol=1e-12
    )


def test_distances_are_those_of_each_frame(flight):
    """Counted by hand over all images of the tilted box."""
    _, run, _, _ = flight
    position, strain = run.frames["position"][::20], run.frames["strain"][::20]
    counts = np.zeros(4)
    for x, s in zip(position, strain):
        lattice = np.diag(SIDES)
        lattice[1, 0] = s * SIDES[1]
        images = np.array(list(itertools.product((-2, -1, 0, 1, 2), repeat=3))) @ lattice
        r = np.linalg.norm(x[:, None, None] - x[None, :, None] - images, axis=-1).min(axis=-1)
        counts += np.histogram(r[~np.eye(len(x), dtype=bool)], 4, (0.0, 2.5))[0]
    some = dataclasses.replace(
        run, frames={name: values[::20] for name, values in run.frames.items()}
    )
    g = dpd.measure.radial_distribution(some, bins=4, r_max=2.5)
    shells = 4 / 3 * np.pi * np.diff(np.linspace(0, 2.5, 5) ** 3) / SIDES.prod()
    np.testing.assert_allclose(g.g, counts / (len(position) * 30 * 29 * shells))


def test_wave_vectors_are_those_of_each_frame():
    """By force: every wave vector of each tilted lattice."""
    position = np.random.default_rng(0).random((1, 3, 25, 3)) * SIDES
    strain, most, bins = np.array([[0.0, 0.3, -0.21]]), 3.0, 5
    sums, vectors = np.zeros((2, bins))
    for x, s in zip(position[0], strain[0]):
        lattice = np.diag(SIDES)
        lattice[1, 0] = s * SIDES[1]
        waves = np.array(list(itertools.product(range(-5, 6), repeat=3))) @ (
            2 * np.pi * np.linalg.inv(lattice).T
        )
        length = np.linalg.norm(waves, axis=1)
        waves, length = (
            waves[(length > 0) & (length < most)],
            length[(length > 0) & (length < most)],
        )
        spectrum = np.abs(np.exp(-1j * x @ waves.T).sum(axis=0)) ** 2 / len(x)
        shell = (length * bins / most).astype(int)
        sums += np.bincount(shell, spectrum, bins)
        vectors += np.bincount(shell, minlength=bins)
    found = dpd.measure.structure_factor(
        Spheres(position, 0.5, SIDES, strain), q_max=most, bins=bins
    )
    np.testing.assert_allclose(found.s, (sums / vectors)[vectors > 0])
    np.testing.assert_allclose(found.vectors, vectors[vectors > 0] / 3)
