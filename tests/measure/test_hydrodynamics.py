"""Spheres in theory and as measured: periodic formulas, tails, drives and rotation read off made-up
runs."""

import dataclasses
import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine.flow import Flow
from dpdjax.measure.rotation import angle_turned
from dpdjax.measure.statistics import Estimate
from dpdjax.model.beads import masses

WATER = dict(kT=1.0, viscosity=1.23)


# ---------------------------------------------------------------------------- theory


def test_diffusion_of_the_published_marble():
    """R = 3, L = 20: 0.00846 without slip, 0.01545 with full slip."""
    assert dpd.theory.sphere_diffusion(**WATER, radius=3.0, box=20.0) == pytest.approx(
        0.00846, abs=5e-6
    )
    assert dpd.theory.sphere_diffusion(
        **WATER, radius=3.0, box=20.0, slip_length=math.inf
    ) == pytest.approx(0.01545, abs=5e-6)


def test_a_sphere_alone():
    assert dpd.theory.sphere_diffusion(**WATER, radius=2.0) == pytest.approx(
        1 / (6 * math.pi * 1.23 * 2)
    )
    assert dpd.theory.sphere_diffusion(**WATER, radius=2.0, slip_length=math.inf) == pytest.approx(
        1 / (4 * math.pi * 1.23 * 2)
    )
    slipping = dpd.theory.sphere_diffusion(**WATER, radius=2.0, slip_length=1e9)
    assert slipping == pytest.approx(1 / (4 * math.pi * 1.23 * 2))
    assert dpd.theory.sphere_rotational_diffusion(**WATER, radius=2.0) == pytest.approx(
        1 / (8 * math.pi * 1.23 * 8)
    )
    ratio = (
        dpd.theory.sphere_rotational_diffusion(**WATER, radius=2.0, slip_length=1.0)
        * 8
        * math.pi
        * 1.23
        * 8
    )
    assert ratio == pytest.approx(2.5)


def test_slip_goes_from_none_to_full():
    D = [
        dpd.theory.sphere_diffusion(**WATER, radius=3.0, box=20.0, slip_length=b)
        for b in (0.0, 0.1, 1.0, 10.0, math.inf)
    ]
    assert np.all(np.diff(D) > 0)


@pytest.mark.parametrize("power", [0, 1])
def test_periodic_tails_by_brute_force(power):
    k = 2 * math.pi / 7.0 * np.arange(-30, 31)
    square = (k[:, None, None] ** 2 + k[None, :, None] ** 2 + k[None, None, :] ** 2).ravel()
    square = square[square > 0]
    for t in (0.2, 3.0):
        decay = square**power * np.exp(-1.23 / 3.0 * square * t)
        tail = (dpd.theory.velocity_tail, dpd.theory.angular_velocity_tail)[power](
            t, **WATER, density=3.0, box=7.0
        )
        assert tail == pytest.approx((2, 0.5)[power] / (3.0 * 7.0**3) * decay.sum())


@pytest.mark.parametrize("tail", [dpd.theory.velocity_tail, dpd.theory.angular_velocity_tail])
def test_periodic_tails_begin_as_free_ones_and_end_sooner(tail):
    t = np.array([1.0, 600.0])
    free, periodic = tail(t, **WATER, density=3.0), tail(t, **WATER, density=3.0, box=60.0)
    assert periodic[0] == pytest.approx(free[0], rel=1e-3) and periodic[1] < 0.99 * free[1]
    assert tail(4.0, **WATER, density=3.0) / tail(1.0, **WATER, density=3.0) == pytest.approx(
        4 ** (-1.5 if tail is dpd.theory.velocity_tail else -2.5)
    )


def test_a_box_that_is_not_felt_yet_is_told():
    """The sum over its waves was cut off, at a length of some unit, and the answer too small."""
    with pytest.raises(ValueError, match="longest wave has decayed by .*: leave out box="):
        dpd.theory.velocity_tail(1e-7, **WATER, density=3.0, box=60.0)


def test_the_radius_behind_diffusion_coefficients():
    sides = [10.0, 15.0, 20.0]
    exact = [dpd.theory.sphere_diffusion(**WATER, radius=3.15, box=side) for side in sides]
    fit = dpd.theory.hydrodynamic_radius(sides, [Estimate(D, 0.02 * D) for D in exact], **WATER)
    assert fit.value == pytest.approx(3.15, rel=1e-6)
    # The scatter of fits to noisy numbers is what the error says.
    rng = np.random.default_rng(0)
    noisy = [[Estimate(D * (1 + 0.02 * rng.normal()), 0.02 * D) for D in exact] for _ in range(200)]
    found = np.array([dpd.theory.hydrodynamic_radius(sides, D, **WATER).value for D in noisy])
    assert (
        found.std() == pytest.approx(fit.error, rel=0.2)
        and abs(found.mean() - 3.15) < 0.3 * fit.error
    )
    alone = dpd.theory.hydrodynamic_radius([10.0], [Estimate(exact[0], 1e-4)], **WATER)
    assert alone.value == pytest.approx(3.15, rel=1e-6)


def test_radii_that_cannot_be_fitted():
    with pytest.raises(ValueError, match="2 sides and 1 estimates"):
        dpd.theory.hydrodynamic_radius([10.0, 20.0], [Estimate(0.01, 0.001)], **WATER)
    with pytest.raises(ValueError, match="no radius between"):
        dpd.theory.hydrodynamic_radius([10.0], [Estimate(-1.0, 0.001)], **WATER)


# ---------------------------------------------------------------------------- rotation


H, BATCH, FRAMES = 0.1, 16, 1200


def made_up(flow=None, inertia=0.1, **frames):
    """What a run would leave behind of two solvent beads and one marble of mass 3."""
    species = np.array([0, 0, 1])
    final = SimpleNamespace(
        species=species, size=np.ones(3), n=3, rotation=SimpleNamespace(slots=slice(2, 3))
    )
    fluid = dataclasses.replace(
        dpd.marble_fluid(kT=2.0, mass=3.0), inertia=(None, jnp.asarray(inertia))
    )
    interval = np.asarray(H)
    return SimpleNamespace(
        frames=frames, flow=Flow.of(flow), final=final, fluid=fluid, interval=interval, dt=interval
    )


def rolled(D_r=0.02, seed=0):
    """Orientations (batch, frames, 1, 4) of a random walk of turns, by rotation matrices' own
    quaternion product."""
    rng = np.random.default_rng(seed)
    turn = rng.normal(size=(BATCH, FRAMES, 1, 3)) * math.sqrt(2 * D_r * H)
    q = np.zeros((BATCH, FRAMES, 1, 4))
    now = np.zeros((BATCH, 1, 4))
    now[..., 0] = 1.0
    for k in range(FRAMES):
        angle = np.linalg.norm(turn[:, k], axis=-1, keepdims=True)
        w, v = np.cos(angle / 2), np.sin(angle / 2) * turn[:, k] / angle
        w0, v0 = now[..., :1], now[..., 1:]
        now = np.concatenate(
            [w * w0 - np.sum(v * v0, -1, keepdims=True), w * v0 + w0 * v + np.cross(v, v0)], -1
        )
        q[:, k] = now
    return q, turn


def test_turns_are_added_up():
    q, turn = rolled()
    np.testing.assert_allclose(np.diff(angle_turned(q), axis=1), turn[:, 1:], atol=1e-9)
    flipped = q * np.random.default_rng(1).choice([-1.0, 1.0], size=(BATCH, FRAMES, 1, 1))
    np.testing.assert_allclose(angle_turned(flipped), angle_turned(q), atol=1e-9)


def test_rotational_diffusion_of_a_random_walk():
    q, turn = rolled()
    run = made_up(orientation=q, angular_velocity=turn / H)
    D = dpd.measure.rotational_diffusion(run, fit=(1.0, 3.0))
    assert D.deviation(0.02) < 3.5 and D.error < 0.001
    decay = dpd.measure.orientation_correlation(run, t_max=10.0)
    off = decay.value - np.exp(-2 * 0.02 * decay.time)
    assert np.all(np.abs(off[1:]) < 4.5 * decay.error[1:]) and decay.value[0] == pytest.approx(1.0)


def test_rotational_green_kubo_of_a_relaxing_spin():
    """An Ornstein-Uhlenbeck angular velocity of rate 2 and variance 0.3: D_r = 0.15."""
    rng, keep = np.random.default_rng(3), math.exp(-0.2)
    omega = np.zeros((BATCH, FRAMES, 1, 3))
    omega[:, 0] = rng.normal(size=(BATCH, 1, 3)) * math.sqrt(0.3)
    for k in range(1, FRAMES):
        omega[:, k] = keep * omega[:, k - 1] + rng.normal(size=(BATCH, 1, 3)) * math.sqrt(
            0.3 * (1 - keep**2)
        )
    run = made_up(angular_velocity=omega, inertia=2.0 / 0.3)
    curve = dpd.measure.angular_velocity_autocorrelation(run, t_max=3.0)
    assert np.all(np.abs(curve.value - 0.9 * np.exp(-2 * curve.time)) < 4.5 * curve.error)
    assert (
        dpd.measure.rotational_diffusion(run, method="vacf", fit=(3.0, 5.0)).deviation(
            0.15 * 0.2 / 2 / math.tanh(0.1)
        )
        < 3.5
    )


def test_wrong_rotation_measures():
    with pytest.raises(
        ValueError, match="recorded no 'orientation'.*use observe=dpd.observe.rotations"
    ):
        dpd.measure.rotational_diffusion(made_up(angular_velocity=np.zeros((1, 50, 1, 3))))
    with pytest.raises(ValueError, match="method is 'gk'"):
        dpd.measure.rotational_diffusion(made_up(), method="gk")
    q = np.zeros((1, 50, 1, 4))
    q[:, ::2, :, 0] = q[:, 1::2, :, 1] = 1.0
    with pytest.raises(ValueError, match="record frames closer together"):
        dpd.measure.rotational_diffusion(made_up(orientation=q))


# ---------------------------------------------------------------------------- drives


def drifting(velocity, flow, noise=0.07):
    rng = np.random.default_rng(2)
    steps = np.array([velocity, 0.0, 0.0]) * H + noise * rng.normal(size=(4, 500, 1, 3))
    return made_up(flow, unwrapped=np.cumsum(steps, axis=1), angular_velocity=steps / H)


def test_driven_diffusion_is_velocity_over_force():
    found = dpd.measure.driven_diffusion(drifting(5.0, dpd.drive(400.0)))
    assert found.diffusion.deviation(2.0 * 5.0 / 400.0) < 3.5 and found.velocity.error < 0.03
    assert found.friction.value == pytest.approx(2.0 / found.diffusion.value)
    assert found.reynolds(density=3.0, viscosity=1.5, radius=2.0) == pytest.approx(
        3.0 * found.velocity.value * 2.0 / 1.5
    )


def test_the_reaction_on_the_others_is_corrected_for():
    """F on a sphere of share x and -F on the rest is a drive of F/(1 - x) with the reaction on
    all."""
    all_of_them, others = (
        dpd.measure.driven_diffusion(drifting(5.0, dpd.drive(400.0, reaction=r)))
        for r in ("all", "others")
    )
    assert others.diffusion.value / all_of_them.diffusion.value == pytest.approx(1 - 3 / 5)
    published = 2.0 * others.velocity.value / (1 - 3 / 5) / 400.0
    assert published == pytest.approx(others.diffusion.value / (1 - 3 / 5) ** 2)


def test_driven_rotation_is_angular_velocity_over_torque():
    found = dpd.measure.driven_rotation(drifting(5.0, dpd.drive(torque=(300.0, 0.0, 0.0))))
    assert found.diffusion.deviation(2.0 * 5.0 / 300.0) < 3.5 and found.is_torque
    assert found.reynolds(density=3.0, viscosity=1.5, radius=2.0) == pytest.approx(
        6.0 * 2.0 * found.velocity.value * 2.0 / 3.0
    )


def test_only_the_driven_species_is_read():
    """Two rotating species, the torque on one."""
    run = drifting(5.0, dpd.drive(torque=300.0))
    both = np.concatenate(
        [np.full_like(run.frames["angular_velocity"], 7.0), run.frames["angular_velocity"]], axis=2
    )
    run.frames["angular_velocity"] = both
    run.final.species, run.final.rotation.slots = np.array([0, 2, 1]), slice(1, 3)
    assert dpd.measure.driven_rotation(run).velocity.deviation(5.0) < 3.5


def test_spheres_that_nothing_turns_have_no_rotational_diffusion():
    run = drifting(0.05, dpd.drive(torque=3.0))
    run.frames["orientation"], run.fluid = (
        rolled()[0],
        dpd.marble_fluid(kT=2.0, mass=3.0, coupling="central"),
    )
    for measure in (dpd.measure.driven_rotation, dpd.measure.rotational_diffusion):
        with pytest.raises(
            ValueError, match='no friction turns the beads of species 1.*give one projector="full"'
        ):
            measure(run)


def test_a_drift_surer_than_its_fluctuations_allow():
    """kT 2, F 4, v 0.05 and D 0.025 over 4 times 49.9: the error of D is 0.0079 at least."""
    with pytest.warns(
        UserWarning, match=r"cannot be below 0.0079 in a run of 200 time units in all.*run longer"
    ):
        dpd.measure.driven_diffusion(drifting(0.05, dpd.drive(4.0), noise=1e-6), skip=0.0)


def test_no_drift_at_all():
    still = made_up(dpd.drive(4.0), unwrapped=np.zeros((4, 100, 1, 3)))
    assert dpd.measure.driven_diffusion(still).friction.value == math.inf


def test_means_of_orientations_are_refused():
    run = made_up(orientation=rolled()[0])
    run.means = ("orientation",)
    for measure in (dpd.measure.rotational_diffusion, dpd.measure.orientation_correlation):
        with pytest.raises(
            ValueError,
            match="means of 'orientation', not its value at a time; use "
            "observe=dpd.observe.rotations",
        ):
            measure(run)


def test_drives_balance(key, simulate):
    """Neither reaction changes the momentum, and a torque turns the marble the right way."""
    made = dpd.marbles(key, box=5.6, radius=1.5, density=0.5, skin=0.25, dt=0.005, report=None)
    for reaction in ("all", "others"):
        flow = dpd.drive((40.0, 0.0, 20.0), (0.0, 20.0, 0.0), reaction=reaction)
        ran = simulate(made.fluid, made.state, key, made.dt, dpd.Plan(10, 20), flow)
        assert ran.final.status == 0
        np.testing.assert_allclose(ran.frames["momentum"], 0.0, atol=1e-9)
        assert ran.final.velocity[-1, 0] > 0.5 and ran.final.velocity[-1, 2] > 0.2
        assert ran.final.rotation.velocity[0, 1] > 0.3
        mass = np.asarray(masses(made.fluid, made.state))
        f, x = np.asarray(flow.force(made.state, mass[:, None])), made.share
        on_marble, on_bead = (
            (1 - x, -1 / mass.sum()) if reaction == "all" else (1.0, -1 / mass[:-1].sum())
        )
        np.testing.assert_allclose(f[-1], on_marble * np.array([40.0, 0.0, 20.0]))
        np.testing.assert_allclose(
            f[:-1], np.tile(on_bead * np.array([40.0, 0.0, 20.0]), (made.solvents, 1))
        )
        np.testing.assert_allclose(flow.torque(made.state), [[0.0, 20.0, 0.0]])


def test_drives_scan_over_forces(key):
    made = dpd.marbles(key, box=5.6, radius=1.5, density=0.5, skin=0.25, dt=0.005, report=None)
    flow = dpd.drive(np.array([[50.0, 0.0, 0.0], [-50.0, 0.0, 0.0]]))
    keys = jax.random.split(key, 2)
    ran = dpd.run(
        made.fluid,
        made.state,
        keys,
        made.dt,
        dpd.Plan(4, 20),
        flow,
        observe=dpd.observe.positions_of(1),
        progress=False,
    )
    assert ran.final.velocity[0, -1, 0] > 0.3 > -0.3 > ran.final.velocity[1, -1, 0]
    with pytest.raises(ValueError, match="the members of this batch differ in applied_force"):
        dpd.measure.driven_diffusion(ran)


def test_wrong_drives(water, fresh, key):
    for wrong, words in (
        (dict(), "nothing is driven"),
        (dict(force=1.0, reaction="none"), "reaction is 'none'"),
        (dict(force=[1.0, 2.0]), r"force has shape \(2,\)"),
    ):
        with pytest.raises(ValueError, match=words):
            dpd.drive(**wrong)
    go = lambda flow: dpd.simulate(water, fresh, key, 0.005, dpd.Plan(1), flow)
    with pytest.raises(ValueError, match="no bead is of the driven species 1"):
        go(dpd.drive(1.0))
    with pytest.raises(ValueError, match="do not rotate, and a torque is given"):
        go(dpd.drive(torque=1.0, species=0))
    with pytest.raises(ValueError, match='use reaction="all"'):
        go(dpd.drive(1.0, species=0, reaction="others"))
    with pytest.raises(
        ValueError, match=r"no driving force; run it with flow=dpd.drive\(force=...\)"
    ):
        dpd.measure.driven_diffusion(made_up(position=np.zeros((4, 3, 3))))
