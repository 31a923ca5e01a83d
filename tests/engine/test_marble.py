"""Marbles: how a run is carried out leaves no trace, what cannot be is refused, and steps and
starts suit what turns."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marble import COUPLINGS, DT, FLOW, FORTY, rub
from small import with_cells

import dpdjax as dpd
from dpdjax.engine import order
from dpdjax.model import advice, declare
from dpdjax.pairs import box as boxes

TWENTY = dpd.Plan(2, 10)


# ------------------------------------------------------------ invariances


def same_bits(a, b):
    same = jax.tree.map(lambda x, y: bool(jnp.array_equal(x, y)), a.rotation, b.rotation)
    names = ("position", "velocity", "force", "image", "id")
    return all(jax.tree.leaves(same)) and all(
        jnp.array_equal(getattr(a, k), getattr(b, k)) for k in names
    )


@pytest.fixture(scope="module")
def run(simulate, marbled, key):
    return lambda state, plan=TWENTY: simulate(marbled.fluid, state, key, DT, plan, FLOW)


def test_chunks_capacity_and_files_are_bitwise_invisible(run, settled_marbles, tmp_path):
    whole = run(settled_marbles, FORTY).final
    assert same_bits(whole, run(run(settled_marbles).final).final)
    assert same_bits(whole, run(dpd.grow(settled_marbles), FORTY).final)
    dpd.save_state(tmp_path / "state.npz", settled_marbles)
    assert same_bits(whole, run(dpd.load_state(tmp_path / "state.npz"), FORTY).final)


def test_sorting_marbles_is_bitwise_invisible(monkeypatch, marbled, settled_marbles, key):
    settled_marbles = with_cells(settled_marbles)

    def go(smallest):
        monkeypatch.setattr(order, "SMALLEST", smallest)
        monkeypatch.setattr(order, "LASTS", 3)
        assert order.is_kept(settled_marbles) == (smallest == 2)
        return jax.jit(lambda s: dpd.simulate(marbled.fluid, s, key, DT, dpd.Plan(3, 5), FLOW))(
            settled_marbles
        ).final

    assert same_bits(go(2), go(10**9))
    turn = jnp.arange(settled_marbles.n).at[-3:].set(settled_marbles.n - 3 + jnp.array([2, 0, 1]))
    moved = order.permuted(settled_marbles, turn)
    np.testing.assert_array_equal(
        moved.rotation.velocity, settled_marbles.rotation.velocity[jnp.array([2, 0, 1])]
    )
    np.testing.assert_array_equal(
        moved.rotation.orientation, settled_marbles.rotation.orientation[jnp.array([2, 0, 1])]
    )


def test_gradients_equal_central_differences(marbled, settled_marbles, key):
    """Over ten steps, with respect to four numbers at once, by forward and by reverse mode."""
    names = ("gamma_cs", "gamma_t", "inertia", "epsilon")
    values = jnp.array([marbled.fluid.value(name) for name in names])

    def outcome(x):
        fluid = marbled.fluid.set(**dict(zip(names, x)))
        final = dpd.simulate(fluid, settled_marbles.restarted(), key, 1e-4, dpd.Plan(2, 5)).final
        return jnp.sum(final.rotation.velocity * jnp.array([[1.0, -0.5, 0.3]])) + jnp.sum(
            final.velocity[-3:, 0]
        )

    steps = 1e-4 * jnp.diag(values)
    at = jax.jit(jax.vmap(outcome))(jnp.concatenate([values[None] + steps, values[None] - steps]))
    central = (at[:4] - at[4:]) / (2e-4 * values)
    assert jnp.all(jnp.abs(central) > 1e-9)
    np.testing.assert_allclose(jax.jit(jax.grad(outcome))(values), central, rtol=1e-5)
    forward = jax.jit(lambda x: jax.jvp(outcome, (x,), (values,))[1])(values)
    np.testing.assert_allclose(forward, jnp.sum(central * values), rtol=1e-5)


def test_a_scan_over_couplings_strengths_and_inertia(marbled, settled_marbles, key):
    scan = dict(gamma_cs=jnp.array([1.0, 10.0]), inertia=jnp.array([10.0, 40.0]))
    both = dpd.run(
        marbled.fluid.set(**scan),
        settled_marbles,
        jax.random.split(key, 2),
        DT,
        dpd.Plan(2, 3),
        progress=False,
    )
    for k in range(2):
        fluid = marbled.fluid.set(**{name: values[k] for name, values in scan.items()})
        alone = dpd.run(
            fluid, settled_marbles, jax.random.split(key, 2)[k], DT, dpd.Plan(2, 3), progress=False
        )
        np.testing.assert_allclose(
            both.final.rotation.velocity[k], alone.final.rotation.velocity, atol=1e-10
        )
    assert [m.fluid.value("inertia") for m in both.members()] == [10.0, 40.0]


def test_starts_are_thermal_and_repeat(key):
    make = lambda key: dpd.marbles(
        key, box=40.0, count=300, radius=1.0, density=0.05, inertia=2.0, kT=0.5, report=None
    )
    some, again = make(key), make(key)
    assert same_bits(some.state, again.state)
    omega = np.asarray(some.state.rotation.velocity)
    assert abs(2.0 * np.mean(omega**2) / 0.5 - 1) < 5 * math.sqrt(2 / omega.size)
    assert "300 marbles" in str(some) and "inertia 2" in str(some)


# ------------------------------------------------------------ errors


@pytest.mark.parametrize(
    "wrong, words",
    [
        (dict(box=7.0), r"below 2 \(reach \+ skin\)"),
        (dict(box=10.0, count=0), "count is 0"),
        (dict(box=10.0, count=9), "do not fit"),
        (dict(box=10.0, count=2), r"below 2 \(reach \+ skin\).*use a side of at least 1[2-9]"),
        (dict(box=10.0, coupling="sticky"), "coupling is 'sticky'"),
        (dict(box=10.0, gamma_cs=-1.0), "gamma_cs is -1.0"),
        (dict(box=10.0, inertia=0.0), "inertia is 0.0"),
        (dict(box=10.0, friction=dpd.term(rub, gamma_cc=1.0, r_c=1.0)), "give is_several=True"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, dict) else None,
)
def test_marbles_that_cannot_be(wrong, words, key):
    with pytest.raises(ValueError, match=words):
        dpd.marbles(key, report=None, **wrong)


def test_what_cannot_rotate(marbled, settled_marbles, key, water, fresh):
    drag = [dpd.term(dpd.central_drag, gamma=1.0, r_c=1.0)]
    with pytest.raises(ValueError, match="species 0 has an inertia and no radius"):
        dpd.fluid(drag=drag, kT=1.0, inertia=1.0)
    with pytest.raises(
        ValueError,
        match=r"the species \[0, 2\] rotate; give inertia to species that follow one another",
    ):
        dpd.fluid(drag=drag, kT=1.0, radius=(1.0, 1.0, 1.0), inertia=(1.0, None, 1.0))
    with pytest.raises(TypeError, match="no term of this fluid has 'inertia'"):
        water.set(inertia=2.0)
    with pytest.raises(ValueError, match="beads of the fluid rotate and those of the state do not"):
        dpd.simulate(
            marbled.fluid, dataclasses.replace(settled_marbles, rotation=None), key, DT, dpd.Plan(1)
        )
    with pytest.raises(ValueError, match="no bead of this state rotates"):
        dpd.observe.rotations(water, fresh)
    shifted = dataclasses.replace(
        settled_marbles, rotation=dataclasses.replace(settled_marbles.rotation, begin=0)
    )
    with pytest.raises(ValueError, match="of other species"):
        dpd.simulate(marbled.fluid, shifted, key, DT, dpd.Plan(1))


def test_projectors_have_names():
    assert declare.PROJECTORS == COUPLINGS


# ------------------------------------------------------------ advice


def test_the_step_suits_the_spin(key):
    """A light spin is damped faster than the velocity, and asks for a shorter step; central drag
    leaves it alone."""
    step = lambda **numbers: dpd.suggest_dt(dpd.marble_fluid(radius=1.5, **numbers), (3.0, 0.005))
    assert step(inertia=0.05) < 0.05 * step(inertia=1000.0)
    assert step(inertia=0.05, coupling="central") == step(inertia=1000.0, coupling="central")
    light = dpd.marble_fluid(radius=1.5, inertia=0.05)
    made = dpd.marbles(key, box=6.0, radius=1.5, skin=0.3, report=None)
    with pytest.raises(ValueError, match="too large for the drag: dt times the damping rate"):
        dpd.simulate(light, made.state, key, 0.005, dpd.Plan(1))


def test_the_rate_of_rubbing_spheres_has_their_arms():
    """``zeta (1/M + R^2/I)`` across the line of centres, six neighbours, each giving way."""
    friction = lambda projector: dpd.term(rub, gamma_cc=3.0, r_c=1.0, projector=projector)
    fluid = lambda p: dpd.marble_fluid(
        is_several=True, radius=2.0, mass=10.0, inertia=4.0, friction=friction(p)
    )
    limits = [advice.dt_limits(fluid(p), (3.0, 0.01))[2][1] for p in COUPLINGS]
    np.testing.assert_allclose(
        limits, [10 / 18, 1 / (18 * (0.1 + 1.0)), 1 / (18 * (0.1 + 1.0))], rtol=1e-3
    )


def test_the_solvent_starts_outside_the_wall(key):
    """Wherever the wall is: no bead has more than its share of energy."""
    for r_0 in (0.5, 1.0, 1.4):
        made = dpd.marbles(key, box=6.0, radius=1.5, density=1.0, r_0=r_0, skin=0.3, report=None)
        r = jnp.linalg.norm(
            boxes.displacement(made.state.box, made.state.position[:-1], made.state.position[-1:]),
            axis=1,
        )
        assert jnp.min(r) >= max(1.5, r_0 + 1.0)
