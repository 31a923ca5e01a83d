"""Errors: one clear line, before the work starts, that names the value and the cure."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine.flow import Flow
from dpdjax.engine.system import System
from dpdjax.model.rates import pair_frequency


def repulsion(**coefficients):
    return dpd.term(dpd.soft_repulsion, **{"a": 25.0, "r_c": 1.0} | coefficients)


def drag(**coefficients):
    return dpd.term(dpd.central_drag, **{"gamma": 4.5, "r_c": 1.0} | coefficients)


def refused(kind, *parts):
    """Expect an error of one line that has every part in it."""
    return pytest.raises(
        kind, check=lambda e: "\n" not in str(e) and all(p in str(e) for p in parts)
    )


PLAN = dpd.Plan(1)


@pytest.mark.parametrize(
    "make", [lambda water: dpd.fluid([repulsion()], kT=-1.0), lambda water: water.set(kT=-1.0)]
)
def test_negative_temperature(make, water):
    with refused(ValueError, "kT is -1.0", "must not be negative"):
        make(water)


@pytest.mark.parametrize(
    "make",
    [lambda water: dpd.fluid(drag=[drag(gamma=-2.0)], kT=1.0), lambda water: water.set(gamma=-2.0)],
)
def test_negative_drag(make, water):
    with refused(ValueError, "gamma is -2.0", "must not be negative"):
        make(water)


@pytest.mark.parametrize("mass", [0.0, -1.0, [1.0, 0.0]], ids=str)
def test_mass_not_above_zero(mass):
    with refused(ValueError, f"mass is {mass}", "above zero"):
        dpd.fluid([repulsion()], kT=1.0, mass=mass)


def test_numbers_that_are_none(water):
    with refused(ValueError, "gamma is nan", "finite"):
        water.set(gamma=float("nan"))
    with refused(TypeError, "gamma is 'big'", "a number"):
        water.set(gamma="big")
    with refused(TypeError, "kT is None", "a number"):
        dpd.fluid([repulsion()], kT=None)


def test_misspelt_coefficient(water):
    with refused(TypeError, "soft_repulsion", "'rc'", "a, r_c"):
        dpd.term(dpd.soft_repulsion, a=25.0, rc=1.0)
    with refused(TypeError, "'gama'", "a, gamma, r_c"):
        water.set(gama=4.5)


def test_missing_coefficient_and_missing_reach():
    with refused(TypeError, "soft_repulsion lacks a", "a=..."):
        dpd.term(dpd.soft_repulsion, r_c=1.0)
    with refused(ValueError, "spring", "reach=..."):
        dpd.fluid([dpd.term(spring, k=1.0)], kT=1.0)


def spring(h, *, k):
    return k * h**2


def test_wrong_tables():
    with refused(ValueError, "a has shape (2,)", "square"):
        repulsion(a=[1.0, 2.0])
    with refused(ValueError, "table of a", "not symmetric"):
        repulsion(a=[[1.0, 2.0], [3.0, 1.0]])
    with refused(ValueError, "species disagree", "a has 2", "gamma has 3"):
        dpd.fluid([repulsion(a=np.ones((2, 2)))], [drag(gamma=np.ones((3, 3)))], kT=1.0)


def test_things_that_are_no_terms():
    with refused(TypeError, "not a term", "dpd.term(law"):
        dpd.fluid([dpd.soft_repulsion], kT=1.0)
    with refused(ValueError, "without terms", "conservative=[...]"):
        dpd.fluid(kT=1.0)


def test_box_below_two_cuts(water, key):
    with refused(ValueError, "box side 2 ", "2 (reach + skin) = 2.4", "at least 2.69"):
        dpd.initial_state(water, key, box=2.0, density=3.0, skin=0.2)
    with refused(ValueError, "skin is -0.2", "must not be negative"):
        dpd.initial_state(water, key, box=4.2, density=3.0, skin=-0.2)


def test_side_that_a_message_asks_for_will_do(water, key):
    """The default skin gives way in a narrow box, down to a fiftieth of the reach."""
    with refused(ValueError, "box side 2.25 ", "2 (reach + skin) = 2.04", "at least 2.29"):
        dpd.initial_state(water, key, box=2.25, density=3.0)
    narrow = dpd.initial_state(water, key, box=2.29, density=3.0)
    assert 0.02 <= narrow.neighbours[0].grid.skin < 0.03


def test_box_of_the_wrong_shape(water, key):
    with refused(ValueError, "shape (2,)", "one side or three"):
        dpd.initial_state(water, key, box=[4.0, 4.0], density=3.0)


def test_fewer_than_two_beads(water, key):
    with refused(ValueError, "density x volume is 1", "at least 2", "larger box"):
        dpd.initial_state(water, key, box=3.0, density=0.03, skin=0.2)
    with refused(ValueError, "density is -3", "above zero"):
        dpd.initial_state(water, key, box=3.0, density=-3, skin=0.2)
    with refused(ValueError, "either density=... or n=..."):
        dpd.initial_state(water, key, box=3.0)


def test_dt_too_large_for_the_drag(water, fresh, key):
    with refused(ValueError, "dt 0.5", "too large for the drag", "use dt = 0.0094"):
        dpd.simulate(water, fresh, key, 0.5, PLAN)
    with refused(ValueError, "dt is -0.01", "above zero"):
        dpd.simulate(water, fresh, key, -0.01, PLAN)


def test_dt_too_large_for_the_repulsion(water, fresh, key):
    with refused(
        ValueError,
        "dt 0.1 is too large for the conservative force",
        "which allows 0.071",
        "use dt = 0.0094",
    ):
        dpd.simulate(water, fresh, key, 0.1, PLAN)
    singular = dpd.fluid([dpd.term(lambda h, *, q: q / h, q=1.0, reach=1.0)], [drag()], kT=1.0)
    assert 1 < pair_frequency(singular, singular.interactions[0]) < 30, (
        "only distances that beads reach count"
    )


def test_body_force_that_jumps_at_the_faces(water, fresh, key):
    side = float(fresh.box.lengths[1])
    with refused(ValueError, "body force is not periodic along y"):
        dpd.simulate(water, fresh, key, 0.01, PLAN, dpd.flows.sinusoidal_force(0.1, 0.9 * side))
    with refused(ValueError, "body force is not periodic along y", "0.5 waves", "waves="):
        dpd.simulate(water, fresh, key, 0.01, PLAN, dpd.flows.sinusoidal_force(0.1, 2 * side))
    dpd.flows.sinusoidal_force(0.1, side, waves=2).check(water, fresh)
    dpd.flows.body_force(dpd.flows.constant_field, acceleration=[1.0, 0.0, 0.0]).check(water, fresh)


def along_x(profile):
    """A body force along x from a profile of (position, time)."""
    return lambda position, time, **numbers: (
        profile(position, time)[:, None] * jnp.array([[1.0, 0.0, 0.0]])
    )


def test_body_forces_are_judged_inside_the_box(water, fresh):
    side = float(fresh.box.lengths[1])
    check = lambda profile, state=fresh, **how: dpd.flows.body_force(along_x(profile), **how).check(
        water, state
    )
    for axis in range(3):
        check(lambda x, t: x[:, axis] * (side - x[:, axis]))
        with refused(ValueError, f"not periodic along {'xyz'[axis]}", "jumps=True"):
            check(lambda x, t: x[:, axis])
    reverse = lambda x, t: jnp.where(x[:, 1] < side / 2, 1.0, -1.0)
    check(reverse, jumps=True)
    with refused(ValueError, "not periodic along y", "jumps=True"):
        check(reverse)
    with refused(ValueError, "not periodic along y"):
        check(lambda x, t: jnp.sin(t) * x[:, 1])
    tilted = dataclasses.replace(fresh, box=dataclasses.replace(fresh.box, strain=jnp.asarray(0.3)))
    k = 2 * jnp.pi / side
    check(lambda x, t: jnp.sin(k * (x[:, 0] - 0.3 * x[:, 1])), tilted)
    with refused(ValueError, "not periodic along y"):
        check(lambda x, t: jnp.sin(k * x[:, 0]), tilted)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Own(dpd.flows.Deformation):
    """A deformation as a user writes one."""

    rate: object


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Push(dpd.flows.Driver):
    """A driver as a user writes one."""

    push: object = None

    def force(self, state, mass):
        return self.push


class Bare(dpd.flows.Driver):
    """One that was not registered."""


def test_a_flow_of_the_users_own_is_checked(water, fresh, key):
    still = dpd.initial_state(water, key, box=5.0, density=1.0, sheared=False)
    for flow in (Own(0.3), dpd.shear(0.3), dpd.oscillatory_shear(0.1, 1.0)):
        with refused(ValueError, "sheared=False"):
            dpd.simulate(water, still, key, 0.01, PLAN, flow)
        assert flow.deforms and flow.is_steady == (flow.frequency is None)
    for flow in (dpd.drive(1.0), dpd.flows.sinusoidal_force(1.0, 5.0), None):
        assert not Flow.of(flow).deforms
    tilted = dataclasses.replace(still, box=dataclasses.replace(still.box, strain=jnp.asarray(0.3)))
    with refused(ValueError, "sheared=False"):
        dpd.simulate(water, tilted, key, 0.01, PLAN)
    x = fresh.position
    wrong = [
        (Own(jnp.ones(3)), ValueError, "the rate of Own has shape (3,)", "ranks = "),
        (Push(x[:, 0]), ValueError, "the force of Push has shape", "is wanted"),
        (Push(x.at[3].set(jnp.nan)), ValueError, "the force of Push is not finite"),
        (object.__new__(dpd.flows.Deformation), TypeError, "Deformation has no rate"),
    ]
    for flow, kind, *parts in wrong:
        with refused(kind, *parts):
            flow.check(water, fresh)
    with refused(TypeError, "derived from dpd.flows.Deformation or dpd.flows.Driver"):
        dpd.simulate(water, fresh, key, 0.01, PLAN, object())
    with refused(TypeError, "Bare is not registered", "register_dataclass"):
        dpd.simulate(water, fresh, key, 0.01, PLAN, Bare())
    with refused(ValueError, "Shear and Oscillation both deform the box", "give one"):
        dpd.simulate(water, fresh, key, 0.01, PLAN, [dpd.shear(0.1), dpd.oscillatory_shear(1, 1)])


def test_states_and_fluids_that_are_something_else(water, fresh, key):
    made = dpd.Trajectory(fresh, {}, System.of(water, 0.01))
    for door in (dpd.run, dpd.simulate):
        for fluid, state, parts in (
            (water, made, ("state is a Trajectory", "give its .final")),
            (made, fresh, ("fluid is a Trajectory", "give its .fluid")),
            (fresh, water, ("fluid is a State", "wrong way round")),
        ):
            with refused(TypeError, *parts):
                door(fluid, state, key, 0.01, PLAN)


@pytest.mark.parametrize("name", ["position", "velocity"])
def test_numbers_at_the_start_that_are_not_finite(name, water, fresh, key):
    bad = dataclasses.replace(fresh, **{name: getattr(fresh, name).at[5, 1].set(jnp.nan)})
    with refused(ValueError, f"the {name} of bead 5 is", "at the start"):
        dpd.run(water, bad, key, 0.01, PLAN)
    with refused(ValueError, f"the {name} of bead 5 of member 1 is"):
        both = jax.tree.map(lambda a, b: jnp.stack([a, b]), fresh, bad)
        dpd.run(water, both, jax.random.split(key, 2), 0.01, PLAN)


def test_names_that_are_recorded_twice(water, fresh, key):
    def temperature(fluid, state):
        return jnp.zeros(())

    def clock(fluid, state):
        return {"time": 0.0}

    record = lambda *observe: jax.eval_shape(
        lambda s: dpd.simulate(water, s, key, 0.01, PLAN, observe=observe), fresh
    )
    with refused(ValueError, "'temperature' is recorded by standard and by temperature"):
        record(dpd.observe.standard, temperature)
    with refused(ValueError, "'momentum' is recorded by momentum and by mean(momentum)"):
        record(dpd.observe.momentum, dpd.mean(dpd.observe.momentum))
    with refused(ValueError, "'time' is recorded by every frame and by clock"):
        record(clock)
    with refused(ValueError, "'wave_velocity' is recorded by"):
        record(dpd.observe.wave_of(1), dpd.observe.wave_of(2))
    record(dpd.observe.standard, dpd.observe.standard, dpd.observe.temperature)
    record(dpd.observe.shear_record, dpd.mean(dpd.observe.stresses), dpd.mean(dpd.observe.standard))


def test_names_that_are_not_there():
    names = {
        "rdf": "dpd.measure.radial_distribution",
        "msd": "dpd.measure.mean_squared_displacement",
        "shear_visc": "dpd.shear_viscosity",
    }
    for name, near in names.items():
        with pytest.raises(AttributeError, match=near):
            getattr(dpd, name)


def test_batches_given_to_one_state(water, key):
    with refused(ValueError, "4 keys for one state", "jax.vmap"):
        dpd.initial_state(water, jax.random.split(key, 4), box=5.0, density=3.0)
    with refused(ValueError, "kT or mass of the fluid is a batch"):
        dpd.initial_state(water.set(kT=jnp.array([1.0, 2.0])), key, box=5.0, density=3.0)


def test_dt_too_large_for_the_lightest_beads(fresh, key):
    with refused(ValueError, "dt 0.5", "too large for the drag"):
        dpd.simulate(dpd.fluid(drag=[drag()], kT=1.0, mass=[1.0, 1000.0]), fresh, key, 0.5, PLAN)


@pytest.mark.parametrize(
    "wrong, parts",
    [(None, ["no key", "jax.random.key(0)"]), (3, ["integer 3", "jax.random.key(3)"])],
)
def test_missing_or_integer_key(wrong, parts, water, fresh):
    with refused(TypeError, *parts):
        dpd.simulate(water, fresh, wrong, 0.01, PLAN)
    with refused(TypeError, *parts):
        dpd.initial_state(water, wrong, box=4.2, density=3.0)


@pytest.mark.parametrize(
    "wrong", [0, -1, 1.5, True, "3", "ten", None, float("nan"), float("inf")], ids=str
)
def test_bad_plan(wrong):
    with refused(ValueError, f"Plan frames is {wrong!r}", "whole number of at least 1"):
        dpd.Plan(frames=wrong)
    with refused(ValueError, f"Plan every is {wrong!r}", "whole number of at least 1"):
        dpd.Plan(frames=1, every=wrong)


def test_more_steps_than_are_counted(water, fresh, key):
    """Step numbers key the noise and are 32 bits wide: they would go on from -2147483648."""
    late = dataclasses.replace(fresh, step=jnp.asarray(2**31 - 5, jnp.int32))
    for door in (dpd.simulate, dpd.run):
        with refused(
            ValueError,
            "would end at step 2147483653",
            "counted up to 2147483647",
            "start the count anew",
        ):
            door(water, late, key, 0.01, dpd.Plan(1, 10))


def test_arguments_of_the_wrong_kind(water, fresh, key):
    with refused(TypeError, "fluid is a State", "dpd.fluid"):
        dpd.simulate(fresh, water, key, 0.01, PLAN)
    with refused(TypeError, "plan is 10", "dpd.Plan"):
        dpd.simulate(water, fresh, key, 0.01, 10)
    with refused(TypeError, "flow is 0.2", "dpd.shear"):
        dpd.simulate(water, fresh, key, 0.01, PLAN, 0.2)
    with refused(TypeError, "observe is 'temperature'", "observe(fluid, state)"):
        dpd.simulate(water, fresh, key, 0.01, PLAN, observe="temperature")


def test_wrong_shapes(water, fresh, key):
    with refused(ValueError, "(222, 3)", "(5, 3)", "(beads, 3)"):
        dpd.simulate(
            water, dataclasses.replace(fresh, velocity=fresh.velocity[:5]), key, 0.01, PLAN
        )
    with refused(ValueError, "a batch", "jax.vmap", "dpd.run"):
        dpd.simulate(water.set(gamma=jnp.ones(3)), fresh, key, 0.01, PLAN)
    with refused(ValueError, "a batch", "jax.vmap", "dpd.run"):
        dpd.simulate(water, fresh, key, jnp.array([0.01, 0.02]), PLAN)


@pytest.mark.parametrize(
    "wrong",
    [lambda fluid, state: state, lambda fluid, state: None, lambda fluid, state: {"x": fluid}],
)
def test_observables_that_record_nothing(water, fresh, key, wrong):
    """They were recorded as nothing at all, without a word."""
    for door in (dpd.simulate, dpd.run):
        with refused(TypeError, "lambda> returns", "dict of arrays by name"):
            door(water, fresh, key, 0.01, PLAN, observe=wrong)


def test_laws_in_the_other_place():
    with refused(
        ValueError, "central_drag is a friction and was given as a potential", "drag=[...]"
    ):
        dpd.fluid([drag()], kT=1.0)
    with refused(
        ValueError,
        "soft_repulsion is a potential and was given as a friction",
        "conservative=[...]",
    ):
        dpd.interaction((0, 0), drag=[repulsion()])
    with refused(ValueError, "soft_repulsion is a potential", "conservative=[...]"):
        dpd.interaction((0, 0), drag=[drag()], random=[repulsion()])


@pytest.mark.parametrize(
    "declare",
    [
        dpd.laws.bounded(gama="positive"),
        dpd.laws.proportional_to("gama"),
        dpd.laws.of_viscosity("gama"),
    ],
)
def test_declarations_of_what_a_law_does_not_take(declare):
    @declare
    def law(h, *, gamma, r_c):
        return gamma * (1 - h / r_c)

    with refused(TypeError, "law declares something of gama", "it takes gamma, r_c"):
        dpd.term(law, gamma=1.0, r_c=1.0)


def test_a_step_too_long_for_one_member_names_it(water, fresh, key):
    keys = jax.random.split(key, 3)
    first = "member 2 (gamma = 10000.): dt 0.01 is too large for the drag"
    with refused(ValueError, first, "use dt = 5.4e-05"):
        dpd.run(
            water.set(gamma=jnp.array([2.0, 4.5, 1e4])), fresh, keys, 0.01, PLAN, progress=False
        )
    with refused(ValueError, "member 1 (dt = 1.): dt 1 is too large"):
        dpd.run(water, fresh, keys, jnp.array([0.01, 1.0, 0.01]), PLAN, progress=False)


def test_positions_that_leave_most_of_the_box_empty_are_told(fresh):
    side = float(fresh.box.lengths[0])
    with pytest.warns(
        UserWarning, match="the positions span .* of a box of .* give the box they are in"
    ):
        dpd.measure.radial_distribution(fresh.position, box=2 * side)


def test_names_of_other_programs():
    with pytest.raises(AttributeError, match="near is dpd.shear_viscosity"):
        _ = dpd.viscocity
