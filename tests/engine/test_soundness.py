"""Laws are judged by their values: before a run with the law, the gap and the cure, inside one by a
status bit."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine import status as bits
from dpdjax.engine.soundness import check_laws
from dpdjax.pairs.laws import safe_sqrt


def rub(h, *, zeta0, r_c):
    return zeta0 * (1 - h / r_c) ** 2


def soft(**changes):
    return dpd.term(dpd.soft_repulsion, **{"a": 25.0, "r_c": 1.0} | changes)


def rubbing(zeta0, **how):
    return dpd.fluid([soft()], [dpd.term(rub, zeta0=zeta0, r_c=1.0)], kT=1.0, **how)


def pushing(law, reach=2.5, **how):
    return dpd.fluid(
        [dpd.term(law, reach=reach)],
        [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)],
        kT=1.0,
        **how,
    )


def lennard_jones(h):
    x = h**-6
    return 4.0 * (x * x - x)


def test_a_friction_of_a_user_below_zero_is_refused_before_a_run(fresh, key):
    told = (
        r"friction rub\(zeta0=-3.0, r_c=1.0\) between species 0 and 0 at a gap of .* is -3: "
        r".*jnp.maximum"
    )
    for door in (dpd.simulate, dpd.run):
        with pytest.raises(ValueError, match=told):
            door(rubbing(-3.0), fresh, key, 1e-3, dpd.Plan(1))
    with pytest.raises(ValueError, match=told):
        dpd.initial_state(rubbing(-3.0), key, box=4.2, density=3.0)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_tables_scans_and_precisions(dtype):
    with jax.enable_x64(dtype == jnp.float64):
        check_laws(rubbing(1.0).set(zeta0=jnp.array([0.0, 1.0])))
        with pytest.raises(ValueError, match="zeta0=-2.0.*of member 1 at"):
            check_laws(rubbing(1.0).set(zeta0=jnp.array([1.0, -2.0, 3.0])))
        with pytest.raises(ValueError, match="between species 0 and 1 at"):
            check_laws(rubbing([[1.0, -0.1], [-0.1, 1.0]]))


def test_the_noise_follows_from_the_sum_and_from_random():
    """A negative part of a positive sum has its noise; a friction behind the noise may not be
    negative either."""
    terms = [dpd.term(rub, zeta0=z, r_c=1.0) for z in (3.0, -1.0)]
    check_laws(dpd.fluid(drag=terms, kT=1.0))
    with pytest.raises(ValueError, match="zeta0=-1.0"):
        check_laws(
            dpd.fluid(
                interactions=[dpd.interaction((0, 0), drag=terms[:1], random=terms[1:])], kT=1.0
            )
        )
    across = dpd.term(rub, zeta0=-1.0, r_c=1.0, projector="transverse")
    with pytest.raises(ValueError, match="zeta0=-1.0"):
        check_laws(dpd.fluid(drag=[terms[0], across], kT=1.0))


def test_the_smallest_and_the_largest_bead_are_judged():
    by_size = lambda h, *, c, R_i, R_j: (c - R_i) * jnp.ones_like(h)
    fluid = dpd.fluid(drag=[dpd.term(by_size, c=1.2, reach=0.5)], kT=1.0, radius=(1.0,))
    check_laws(fluid)
    state = SimpleNamespace(species=jnp.zeros(4, int), size=jnp.array([1.0, 1.0, 1.0, 1.5]))
    with pytest.raises(ValueError, match=r"is -0.3: .*not negative"):
        check_laws(fluid, state)


def test_a_traced_friction_below_zero_ends_the_run_and_not_its_neighbour(fresh, key):
    @jax.jit
    @jax.vmap
    def member(zeta0):
        return dpd.simulate(rubbing(zeta0), fresh, key, 1e-3, dpd.Plan(1, 2))

    run = member(jnp.array([-3.0, 3.0]))
    assert run.final.status[0] & bits.BAD_LAW and run.final.status[1] == 0
    assert np.all(np.isnan(run.frames["temperature"][0])) and np.all(
        np.isfinite(run.frames["temperature"][1])
    )
    assert "friction is negative" in bits.describe(run.final.status)


def test_a_fluid_that_a_traced_function_closes_over_is_judged_too(fresh, key):
    hot = rubbing(-3.0)
    with pytest.raises(ValueError, match="zeta0=-3.0"):
        jax.jit(lambda key: dpd.simulate(hot, fresh, key, 1e-3, dpd.Plan(1)).final.position)(key)


def test_noise_of_a_negative_friction_is_no_number():
    assert np.isnan(safe_sqrt(jnp.array(-1.0))) and np.isnan(safe_sqrt(jnp.array(jnp.nan)))
    assert (
        safe_sqrt(jnp.array(0.0)) == 0
        and jax.grad(safe_sqrt)(0.0) == 0
        and safe_sqrt(jnp.array(4.0)) == 2
    )


@pytest.mark.parametrize(
    "law, told",
    [
        (lambda h: jnp.sqrt(h - 0.5), "is nan, and beads can be there"),
        (lambda h: -1.0 / h, r"is -.*e\+19, and beads can be there"),
    ],
    ids=["nan", "endless"],
)
def test_potentials_that_are_not_finite_where_beads_can_be(law, told):
    with pytest.raises(ValueError, match=told):
        check_laws(pushing(law))


def test_potentials_that_keep_beads_out_may_diverge():
    check_laws(pushing(lennard_jones))
    for fluid in (
        dpd.marble_fluid(a=25.0, gamma_t=1.0, is_several=True),
        dpd.colloid_fluid(noise="literal"),
    ):
        check_laws(fluid)


# Laws that cannot run, told where they are bound.


def branching(h, *, k):
    return k if h > 0.5 else 0.0


@pytest.mark.parametrize(
    "law, told",
    [
        (branching, "branching branches with `if` on a traced value; use jnp.where"),
        (lambda h, *, k: np.exp(h) * k, "use jax.numpy, not numpy or math"),
        (lambda h, *, k: float(h) * k, "use jax.numpy, not numpy or math"),
        (lambda h, *, k: "energy", "does not return numbers"),
        (lambda h, *, k: None, "returns NoneType"),
        (lambda h, *, k: 1j * h, "returns complex"),
        (lambda h, *, k: h > k, "returns bool"),
        (lambda h, *, k: 1, "returns int"),
        (lambda h, *, k: k * h[:2], r"returns shape \(2,\)"),
        (lambda h, *, k: (h, k), "returns tuple"),
    ],
)
def test_laws_that_cannot_be_traced_or_return_no_numbers(law, told):
    with pytest.raises(TypeError, match=told):
        dpd.term(law, k=1.0, reach=1.0)


def test_reaches_are_tried_too():
    with pytest.raises(TypeError, match="far branches with `if`"):

        def far(*, k):
            return 1.0 if k > 0 else 2.0

        dpd.term(lambda h, *, k: k * h, k=1.0, reach=far)
    assert dpd.term(lambda h, *, k: 3.0, k=1.0, reach=1.0), "a constant is a law"


def test_a_term_can_be_made_of_traced_numbers():
    energy = lambda k: dpd.term(rub, zeta0=k, r_c=1.0).between()[0](0.5)
    assert jax.jit(jax.vmap(jax.grad(energy)))(jnp.array([1.0, 2.0])).tolist() == [0.25, 0.25]


# Bounds.


def test_laws_declare_the_numbers_they_take():
    @dpd.laws.bounded(k="positive")
    def spring(h, *, k):
        return k * h**2

    t = dpd.term(spring, k=1.0, reach=1.0)
    with pytest.raises(ValueError, match="k is 0.0; it must be above zero"):
        dpd.fluid([t], kT=1.0).set(k=0.0)
    with pytest.raises(ValueError, match="k is -1.0"):
        dpd.term(spring, k=-1.0, reach=1.0)
    with pytest.raises(
        ValueError, match="bound of k is 'large'; it is one of positive, not negative"
    ):
        dpd.laws.bounded(k="large")
    negative = lambda h, *, gamma: gamma * h
    assert dpd.fluid([dpd.term(negative, gamma=-1.0, reach=1.0)], kT=1.0), (
        "a name alone says nothing"
    )


def test_an_attraction_has_no_negative_depth():
    with pytest.raises(ValueError, match="D0 is -1.0; it must not be negative"):
        dpd.colloid_fluid(D0=-1.0)
    with pytest.raises(ValueError, match="phi_p is -0.1"):
        dpd.term(dpd.laws.asakura_oosawa, phi_p=-0.1, r_g=0.1)
