"""Runs of bonded beads: what does not matter does not matter, to the last bit."""

import dataclasses

import chains
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine import status as bits
from dpdjax.model import advice
from dpdjax.model.rates import extreme, thermal_length

KEY = jax.random.key(3)
PLAN = dpd.Plan(4, 5)


@pytest.fixture(scope="module")
def fluid():
    return chains.fluid()


@pytest.fixture(scope="module")
def start(fluid):
    return chains.state(fluid)


def run(fluid, state, plan=PLAN, **how):
    return dpd.run(fluid, state, KEY, 0.005, plan, progress=False, **how)


def same(a, b):
    np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def test_restart_and_saving_are_bitwise(fluid, start, tmp_path):
    whole = run(fluid, start)
    half = run(fluid, start, dpd.Plan(2, 5)).final
    dpd.save_state(tmp_path / "half.npz", half)
    again = run(fluid, dpd.load_state(tmp_path / "half.npz"), dpd.Plan(2, 5))
    same(whole.final.position, again.final.position)
    same(whole.final.velocity, again.final.velocity)
    same(whole.final.topology.beads["bend"], again.final.topology.beads["bend"])


def test_room_in_the_lists_is_bitwise(fluid, start):
    same(run(fluid, start).final.position, run(fluid, dpd.grow(start)).final.position)


def test_order_of_the_beads_is_bitwise(fluid, monkeypatch):
    """Sorted by cell, or as they were made."""
    from dpdjax.engine import order

    start = chains.state(fluid, box=(8.0, 8.0, 8.0))
    plan = dpd.Plan(2, 100)
    plain = run(fluid, start, plan)
    monkeypatch.setattr(order, "SMALLEST", 10)
    jax.clear_caches()
    sorted_ = run(fluid, start, plan)
    same(plain.final.position, sorted_.final.position)
    same(plain.final.id, sorted_.final.id)


def test_members_of_a_batch_are_as_alone(fluid, start):
    keys = jnp.stack([KEY, KEY])
    batch = dpd.run(
        fluid.set(k=jnp.array([20.0, 40.0]), between="strong"),
        start,
        keys,
        0.005,
        PLAN,
        progress=False,
    )
    alone = dpd.run(
        fluid.set(k=20.0, between="strong"), start, keys[:1], 0.005, PLAN, progress=False
    )
    same(batch.final.position[0], alone.final.position[0])
    assert np.any(np.asarray(batch.final.position[1]) != np.asarray(batch.final.position[0]))


def test_gradient_with_k_is_that_of_differences():
    fluid = chains.fluid()
    start = chains.state(fluid, box=(4.0, 4.0, 4.0))

    def energy(k):
        made = dpd.simulate(fluid.set(k=k, between="strong"), start, KEY, 0.005, dpd.Plan(1, 10))
        return made.frames["potential_energy"][-1]

    _, forward = jax.jvp(energy, (20.0,), (1.0,))
    reverse = jax.grad(energy)(20.0)
    wanted = (energy(20.0 + 1e-5) - energy(20.0 - 1e-5)) / 2e-5
    np.testing.assert_allclose([forward, reverse], wanted, rtol=1e-5)


def test_bonds_hold_under_shear(fluid, start):
    """Across the tilted boundary, and through the folds of the tilt."""
    sheared = run(fluid, start, dpd.Plan(40, 10), flow=dpd.shear(0.8))
    assert int(sheared.final.status) == 0
    assert chains.stretched(fluid, sheared.final).max() < 2.0


def test_a_bond_that_tears_is_told(fluid, start):
    loose = (
        fluid.set(k=0.0, between="strong").set(k=0.0, between="bend").set(k=0.0, between="twist")
    )
    with pytest.raises(dpd.RunError, match="a bond became longer than half a box"):
        run(loose, start, dpd.Plan(100, 100), flow=dpd.shear(1.0))


def test_what_cannot_run_is_refused(fluid, start):
    bare = dataclasses.replace(start, topology=None)
    with pytest.raises(ValueError, match="the fluid has bonds of the types 'strong', 'bend'"):
        run(fluid, bare)
    with pytest.raises(ValueError, match="is a type of angle, of 3 beads, and the state has 2"):
        rows = chains.groups(start.n)
        run(fluid, start.bonded(rows | {"bend": rows["strong"]}))
    with pytest.raises(ValueError, match="one bead twice"):
        start.bonded({"strong": np.array([[3, 3]])})
    with pytest.raises(ValueError, match=r"'strong' 2 is \[4, 3\], which is there before"):
        start.bonded({"strong": np.array([[3, 4], [4, 5], [4, 3]])})
    with pytest.raises(ValueError, match="names beads 0 to 999999; the state has 0 to"):
        start.bonded({"strong": np.array([[0, 999999]])})
    short = dpd.fluid(
        drag=[dpd.term(dpd.central_drag, gamma=1.0, r_c=1.0)],
        kT=1.0,
        bonds={"strong": dpd.term(dpd.laws.fene_bond, k=10.0, r_max=0.3)},
    )
    made = chains.placed(dpd.initial_state(short, jax.random.key(0), box=6.0, density=3.0))
    made = made.bonded({"strong": start.topology.beads["strong"]})
    with pytest.raises(ValueError, match="'strong' 0, of the beads .* where its energy is inf"):
        run(short, made)


def test_excluded_pairs_do_not_act(fluid, start):
    """No pair closer than three bonds is in a list, now or after it is built anew."""
    rows = chains.groups(start.n)
    apart = start.bonded(rows, exclude=2)
    final = run(fluid, apart, dpd.Plan(4, 25)).final
    for state in (apart, dpd.grow(apart), final):
        idx = np.asarray(state.neighbours[0].list.idx)
        real = idx[0] < state.n
        listed = {tuple(sorted(p)) for p in np.asarray(state.id)[idx[:, real]].T}
        assert not listed & {
            tuple(sorted(p)) for p in np.concatenate([rows["strong"], rows["bend"][:, ::2]])
        }
    kept = {tuple(sorted(p)) for p in np.asarray(start.neighbours[0].list.idx).T}
    assert kept & {tuple(sorted(p)) for p in rows["strong"]}
    assert bits.describe(final.status) == ""
    # And given up again.
    same(apart.bonded(rows).neighbours[0].list.idx, start.neighbours[0].list.idx)


def test_numbers_of_a_type_are_set_by_its_name(fluid):
    assert fluid.set(k=7.0, between="bend").value("k", between="bend") == 7.0
    assert fluid.set(k=7.0, between="bend").value("k", between="strong") == 20.0
    with pytest.raises(ValueError, match="no type of bond 'bent'"):
        fluid.set(k=7.0, between="bent")
    with pytest.raises(ValueError, match="disagree on 'k'"):
        fluid.value("k")
    assert "bond strong  harmonic_bond, k 20, r0 0.6" in str(fluid)


def test_laws_of_bonds_are_checked():
    with pytest.raises(ValueError, match="say where it ends"):
        dpd.fluid([dpd.term(dpd.laws.harmonic_bond, k=1.0)], kT=1.0)
    with pytest.raises(ValueError, match="goes with drag"):
        dpd.fluid(
            [dpd.term(dpd.soft_repulsion, a=1.0, r_c=1.0)],
            kT=1.0,
            bonds=dpd.term(dpd.central_drag, gamma=1.0, r_c=1.0),
        )
    pairs = [dpd.term(dpd.soft_repulsion, a=1.0, r_c=1.0)]
    with pytest.raises(ValueError, match="cosine_angle is a law of angles and dihedrals, and was"):
        dpd.fluid(pairs, kT=1.0, bonds=dpd.term(dpd.laws.cosine_angle, k=1.0))
    with pytest.raises(ValueError, match="harmonic_bond is a law of bonds, .* of an angle"):
        dpd.fluid(pairs, kT=1.0, angles=dpd.term(dpd.laws.harmonic_bond, k=1.0))
    with pytest.raises(ValueError, match="soft_repulsion is a law of bonds, .* of a dihedral"):
        dpd.fluid(pairs, kT=1.0, dihedrals=pairs)
    assert dpd.fluid(pairs, kT=1.0, bonds=None).bonded == ()
    with pytest.raises(ValueError, match="k must|k is"):
        dpd.term(dpd.laws.harmonic_bond, k=-1.0)


def test_a_state_of_a_fluid_without_bonds_can_be_given_some():
    """After a run too: it makes room for their stresses."""
    plain = dpd.fluid(
        [dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)],
        [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)],
        kT=1.0,
    )
    rest = run(plain, dpd.initial_state(plain, KEY, box=5.0, density=3.0)).final
    idx = np.asarray(rest.neighbours[0].list.idx)[:, :40]
    pairs = np.asarray(rest.id)[idx].T
    stiff = dpd.fluid(
        plain.interactions[0].conservative,
        plain.interactions[0].drag,
        kT=1.0,
        bonds=dpd.term(dpd.laws.harmonic_bond, k=20.0, r0=0.5),
    )
    tied = run(stiff, rest.bonded({"bond": pairs}), observe=dpd.observe.stresses)
    assert np.any(tied.frames["pressure_bond"])


def test_numbers_of_several_kinds_are_set_by_type():
    same = dpd.fluid(
        species=2,
        drag=[dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)],
        kT=1.0,
        bonds=dpd.term(dpd.laws.harmonic_bond, k=100.0),
        angles=dpd.term(dpd.laws.cosine_angle, k=15.0),
    )
    with pytest.raises(ValueError, match="k is a number of bonds and angles: say which is meant"):
        same.set(k=64.0)
    with pytest.raises(ValueError, match="k of the bond 'bond' is a table of species"):
        same.set(k=jnp.ones((2, 2)), between="bond")
    with pytest.raises(ValueError, match="theta0 is 120.0; it is in radians"):
        dpd.term(dpd.laws.cosine_angle, k=1.0, theta0=120.0)


@pytest.mark.parametrize("depth", [5.0, 20.0, 100.0])
def test_a_bond_that_can_break_is_as_long_as_while_it_holds(depth):
    """Its time step and its start follow from the well, not from what is beyond."""

    def morse(r, *, D):
        return D * (1 - jnp.exp(-4.0 * (r - 0.5))) ** 2

    made = dpd.fluid(
        drag=[dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)],
        kT=1.0,
        bonds=dpd.term(morse, D=depth),
    )
    assert 0.45 < thermal_length(extreme(made), made.bonded[0]) < 1.1


def test_the_stiffest_of_bonds_angles_and_dihedrals_sets_the_step():
    def allowed(**how):
        """The dt at which bonds err by half a per cent."""
        made = dpd.fluid(
            drag=[dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)],
            kT=1.0,
            bonds=dpd.term(dpd.laws.harmonic_bond, k=100.0, r0=0.5),
            **how,
        )
        return dict(advice.dt_errors(made, 3.0))[advice.LENGTH]

    bend = lambda k: allowed(angles=dpd.term(dpd.laws.cosine_angle, k=k))
    twist = lambda k: allowed(dihedrals=dpd.term(dpd.laws.cosine_dihedral, k=k, n=3))
    assert bend(200.0) < bend(2.0) == allowed() == twist(0.0) > twist(200.0)
    # (w dt)^2 / 4 is .005: two beads of mass 1 on k 100.
    np.testing.assert_allclose(allowed(), (4 * 0.005 / 200) ** 0.5, rtol=0.01)
