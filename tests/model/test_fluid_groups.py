"""Fluids of several groups: what acts between whom, how far, under which name, and what is
refused."""

import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.pairs import box as boxes
from dpdjax.pairs.forces import pair_force
from dpdjax.prepare.start import placed, plan_lists


def refused(kind, *parts):
    """Expect an error of one line that has every part in it."""
    return pytest.raises(
        kind, check=lambda e: "\n" not in str(e) and all(p in str(e) for p in parts)
    )


def soft(a=25.0, r_c=1.0, **how):
    return dpd.term(dpd.soft_repulsion, a=a, r_c=r_c, **how)


def rub(gamma=4.5, r_c=1.0):
    return dpd.term(dpd.central_drag, gamma=gamma, r_c=r_c)


def between(groups, *terms, **how):
    return dpd.interaction(groups, list(terms) or soft(), **how)


def mixture(**how):
    """Three species: the first two of one kind, apart from the third."""
    interactions = [
        between(((0, 1), (0, 1)), soft(10.0)),
        between((2, (0, 1)), soft(20.0, r_c=1.5)),
    ]
    return dpd.fluid(interactions=interactions, **{"kT": 0.0} | how)


def test_groups_are_sorted_tuples_of_species():
    assert between((1, 0)).groups == between((0, 1)).groups == ((0,), (1,))
    assert between((2, (0, 1))).groups == ((0, 1), (2,))
    assert between((1, 1)).groups == ((1,), (1,))
    everything = dpd.fluid([soft()], kT=1.0, species=3).interactions[0]
    assert everything.groups == ((0, 1, 2), (0, 1, 2))
    assert mixture().species == 3


def test_each_pair_of_groups_has_its_own_law():
    """On a line, one bead of each species and two of the last, which ignore each other."""
    fluid, box = mixture(), boxes.box(6.0)
    x = np.array([1.0, 1.6, 2.2, 2.4])
    position = jnp.asarray(np.stack([x, 0 * x + 1, 0 * x + 1], axis=1))
    state = placed(
        fluid,
        jax.random.key(0),
        box,
        position,
        (1, 1, 2),
        plan_lists(fluid, box, (1, 1, 2), skin=0.1),
    )
    assert [n.grid.groups for n in state.neighbours] == [((0, 2), (0, 2)), ((0, 2), (2, 4))]
    force, _, _ = jax.jit(lambda s: pair_force(fluid, s, s.velocity, 0.0, jax.random.key(0), 0.01))(
        state
    )
    expected = np.zeros(4)
    for i, j, push in (
        (0, 1, 10 * 0.4),
        (0, 2, 20 * (1 - 1.2 / 1.5)),
        (0, 3, 20 * (1 - 1.4 / 1.5)),
        (1, 2, 20 * (1 - 0.6 / 1.5)),
        (1, 3, 20 * (1 - 0.8 / 1.5)),
    ):
        expected[i] -= push
        expected[j] += push
    np.testing.assert_allclose(force[:, 0], expected, atol=1e-12)


@pytest.mark.parametrize(
    "make, parts",
    [
        (lambda: between(((0, 1), (1, 2))), ["(0, 1) and (1, 2) share a species"]),
        (lambda: between((0, (0, 1))), ["(0,) and (0, 1) share a species"]),
        (lambda: between(((0, 2), 1)), ["(0, 2) is no group", "follow one another"]),
        (lambda: between(((), 1)), ["() is no group"]),
        (lambda: between((0, 1, 2)), ["between is (0, 1, 2)", "two species"]),
        (lambda: between(1), ["between is 1", "two species"]),
        (lambda: dpd.interaction((0, 1)), ["without terms"]),
        (lambda: dpd.interaction((0, 1), random=[rub()]), ["without terms"]),
        (lambda: between((0, 1), soft(r_c=-1.0)), ["r_c is -1.0"]),
        (lambda: dpd.interaction((0, 1), drag=rub(-1.0)), ["gamma is -1.0"]),
    ],
    ids=[
        "overlap",
        "part of",
        "gap",
        "empty",
        "three",
        "one",
        "no terms",
        "noise alone",
        "range",
        "friction",
    ],
)
def test_interactions_that_cannot_be(make, parts):
    with refused(ValueError, *parts):
        make()


@pytest.mark.parametrize("kind", ["conservative", "drag", "random"])
def test_laws_without_numbers_are_no_terms(kind):
    with refused(TypeError, "not a term", "dpd.term(law"):
        dpd.interaction((0, 0), **{"conservative": [soft()]} | {kind: [dpd.soft_repulsion]})


@pytest.mark.parametrize(
    "how, parts",
    [
        (
            {"interactions": [between((0, 1)), between((1, 0))]},
            ["two interactions between ((0,), (1,))"],
        ),
        (
            {"conservative": [soft()], "interactions": [between((0, 0))]},
            ["either interactions=[...], or conservative="],
        ),
        (
            {"drag": [rub()], "interactions": [between((0, 0))]},
            ["either interactions=[...], or conservative="],
        ),
        (
            {"interactions": [between((0, 1))], "mass": [1.0, 1.0, 2.0]},
            ["disagree", "mass has 3", "the interactions has 2"],
        ),
        (
            {"interactions": [between((0, 1))], "radius": (None,)},
            ["disagree", "radius has 1", "the interactions has 2"],
        ),
        (
            {"interactions": [between((0, 1))], "species": 3},
            ["disagree", "species has 3", "the interactions has 2"],
        ),
        (
            {"interactions": [between((0, 0), soft(a=np.ones((2, 2))))]},
            ["disagree", "a has 2", "the interactions has 1"],
        ),
        ({"interactions": [between((0, 0))], "radius": (-1.0,)}, ["radius is -1.0"]),
        ({"interactions": [between((0, 0))], "mass": 0.0}, ["mass is 0.0"]),
        ({"interactions": [between((0, 0))], "kT": -1.0}, ["kT is -1.0"]),
    ],
    ids=[
        "twice",
        "both",
        "both drags",
        "mass",
        "radii",
        "species",
        "table",
        "radius",
        "no mass",
        "kT",
    ],
)
def test_fluids_that_cannot_be(how, parts):
    with refused(ValueError, *parts):
        dpd.fluid(**{"kT": 1.0} | how)


NUMBERS = dict(kT=0.1, gamma=4.5, eta_0=0.3, D0=1.2, kappa=30.0)


@pytest.fixture(scope="module")
def colloids():
    return dpd.colloid_fluid(**NUMBERS)


def numbers_of(fluid, name):
    """The number of every interaction that has it."""
    found = [
        {float(t.coefficients[name]) for t in i.terms if name in t.coefficients}
        for i in fluid.interactions
    ]
    return [values.pop() if len(values) == 1 else values or None for values in found]


def test_set_between_two_groups_leaves_the_others(colloids):
    assert numbers_of(colloids.set(gamma=45.0), "gamma") == [45.0, 45.0, 45.0]
    assert numbers_of(colloids.set(between=(1, 1), gamma=45.0), "gamma") == [4.5, 4.5, 45.0]
    assert numbers_of(colloids.set(between=(1, 0), gamma=45.0), "gamma") == [4.5, 45.0, 4.5]
    assert numbers_of(colloids.set(between=((1,), (1,)), D0=3.0), "D0") == [None, None, 3.0]
    assert (
        mixture().set(between=((0, 1), 2), a=7.0).interactions[1].conservative[0].coefficients["a"]
        == 7.0
    )


def test_set_refuses_what_is_not_there(colloids):
    with refused(TypeError, "no term of this fluid has 'd0'", "D0, Delta", "kT, mass"):
        colloids.set(d0=3.0)
    with refused(TypeError, "no term between (0, 1) has 'D0'; they have gamma, r_c, strength"):
        colloids.set(between=(0, 1), D0=3.0)
    with refused(TypeError, "no term between (0, 0) has 'kT'"):
        colloids.set(between=(0, 0), kT=3.0)
    with refused(ValueError, "no interaction between (0, 2)", "((0,), (1,))", "((1,), (1,))"):
        colloids.set(between=(0, 2), gamma=3.0)
    with refused(ValueError, "gamma is -1.0"):
        colloids.set(between=(1, 1), gamma=-1.0)
    with refused(TypeError, "no term of this fluid has 'eta'"):
        colloids.value("eta")


def test_reaches_are_between_centres_of_the_largest_beads(colloids):
    np.testing.assert_allclose(colloids.reaches(), [1.0, 2 ** (1 / 3), 3.0])
    np.testing.assert_allclose(colloids.reaches((1.0, 1.3)), [1.0, (1 + 1.3**3) ** (1 / 3), 3.6])
    assert mixture(radius=(None, 0.2, 0.5)).reaches() == (1.4, 2.2)
    depletion = dpd.colloid_fluid(
        **NUMBERS, attraction=dpd.term(dpd.laws.asakura_oosawa, phi_p=0.2, r_g=0.1)
    )
    assert depletion.set(r_g=jnp.array([0.1, 0.7])).reaches()[2] == pytest.approx(3.4), (
        "of a scan the farthest"
    )


@dpd.laws.reaches(lambda *, width, R_i, R_j: width * (R_i + R_j))
def shell(h, *, k, kT):
    return k * kT * h**2


def test_a_law_of_a_user_says_where_it_ends():
    t = dpd.term(shell, k=2.0, width=0.1)
    law, reach = t.between(R_i=1.0, R_j=2.0, kT=0.5)
    assert law(3.0) == 9.0 and reach == pytest.approx(0.3)
    assert dpd.term(shell, k=2.0, reach=0.7).between(kT=0.5)[1] == 0.7, "a number in its place"
    other = dpd.term(shell, k=2.0, far=3.0, reach=lambda *, far, kT: far * kT)
    assert other.between(kT=0.5)[1] == 1.5, "or a function"
    with refused(TypeError, "shell lacks width"):
        dpd.term(shell, k=2.0)
    with refused(TypeError, "shell has no coefficient 'kT'", "width, k"):
        dpd.term(shell, k=2.0, width=0.1, kT=1.0)


def test_stresses_have_the_names_of_their_terms(colloids):
    assert mixture().origins == ("conservative", "drag", "random")
    assert colloids.origins == (
        "conservative",
        "drag",
        "random",
        "contact",
        "colloid",
        "lubrication",
    )
    named = dpd.fluid([soft(origin="soft"), soft()], [rub()], kT=1.0)
    assert named.origins == ("conservative", "drag", "random", "soft")


def test_scans_are_batches(colloids):
    assert not colloids.is_batch
    for name in ("kT", "D0", "eta_0", "gamma"):
        assert colloids.set(**{name: jnp.array([0.1, 0.2])}).is_batch
    sizes = dpd.fluid([soft()], kT=1.0, radius=(jnp.array([0.1, 0.2]),))
    assert sizes.is_batch and sizes.batch_axes().radius == (0,) and sizes.batch_axes().kT is None


def test_colloids_have_the_numbers_of_the_page(colloids):
    """PHYSICS, section 2: a = 25 kT/r_c, f = 10^4 kT/r_c, Delta = delta = 0.001, mass of the
    displaced solvent."""
    solvent, mixed, pairs = colloids.interactions
    assert solvent.conservative[0].coefficients == {"a": 2.5, "r_c": 1.0}
    assert mixed.conservative[0].coefficients == {"strength": 2.5, "r_c": 1.0}
    assert pairs.conservative[0].coefficients == {"f": 1000.0, "Delta": 1e-3, "r_c": 1.0}
    assert pairs.conservative[1].coefficients == {"D0": 1.2, "kappa": 30.0, "r0": 0.0, "r_c": 1.0}
    assert pairs.conservative[1].between()[1] == 1.0
    assert (
        pairs.drag[1].coefficients == {"eta_0": 0.3, "delta": 1e-3, "r_c": 1.0}
        and pairs.drag[1].between()[1] == 1.0
    )
    assert all(i.random is None for i in colloids.interactions), "noise follows from drag"
    np.testing.assert_allclose(colloids.mass, [1.0, 4 * math.pi])
    assert colloids.radius == (None, 1.0)
    wide = dpd.colloid_fluid(kT=0.2, r_c=2.0, radius=3.0, density=4.0)
    assert (
        wide.value("a") == 25 * 0.2 / 2
        and wide.value("strength") == 25 * 0.2
        and wide.value("f") == 1e4 * 0.2 / 2
    )
    np.testing.assert_allclose(wide.mass, [1.0, 4 * 36 * math.pi])


def laws_of(terms):
    return [t.law for t in terms]


def test_other_laws_by_name():
    laws = dict(
        solvent_repulsion=dpd.laws.scripts_repulsion,
        contact=dpd.laws.scaled_contact,
        lubrication=dpd.laws.unequal_lubrication,
    )
    _, mixed, pairs = dpd.colloid_fluid(**NUMBERS, **laws).interactions
    assert laws_of(mixed.conservative) == [dpd.laws.scripts_repulsion]
    assert laws_of(pairs.conservative) == [dpd.laws.scaled_contact, dpd.laws.morse]
    assert laws_of(pairs.drag) == [dpd.central_drag, dpd.laws.unequal_lubrication]


def test_an_attraction_is_a_term_and_the_only_one():
    depletion = dpd.term(dpd.laws.asakura_oosawa, phi_p=0.2, r_g=0.1)
    with pytest.warns(
        UserWarning, match="D0 is 1.2, the depth of the Morse attraction, and not used"
    ):
        dpd.colloid_fluid(D0=1.2, attraction=depletion)
    with pytest.raises(TypeError, match=r"asakura_oosawa is not a term; write dpd.term\(law"):
        dpd.colloid_fluid(attraction=dpd.laws.asakura_oosawa)
    with pytest.raises(
        TypeError,
        match=r"'depth'; it takes none: coefficients come after a star, def law\(h, \*, ...\)",
    ):
        dpd.term(lambda h, depth: depth * h, depth=1.0, reach=1.0)


def test_spheres_start_apart_and_points_outside():
    among = [
        dpd.interaction((0, 0), soft()),
        dpd.interaction((0, 1), dpd.term(dpd.laws.balanced_repulsion, strength=2.5, r_c=1.0)),
        dpd.interaction((1, 1), soft()),
    ]
    fluid = dpd.fluid(interactions=among, kT=0.1, mass=[1.0, 12.0], radius=(None, 1.0))
    state = dpd.initial_state(fluid, jax.random.key(0), box=7.0, n=[300, 12], sheared=False)
    d = boxes.displacement(state.box, state.position[:, None], state.position[None, 300:])
    r = np.asarray(jnp.linalg.norm(d, axis=-1))
    assert r[:300].min() >= 1.0 and np.min(r[300:] + 9.0 * np.eye(12)) > 2.0
    with pytest.raises(ValueError, match="volume fraction"):
        dpd.initial_state(fluid, jax.random.key(0), box=7.0, density=3.0, sheared=False)
    with pytest.raises(ValueError, match="outside jit and vmap"):
        jax.vmap(lambda key: dpd.initial_state(fluid, key, box=7.0, n=[300, 12]).position)(
            jax.random.split(jax.random.key(0), 2)
        )


def test_other_attractions():
    depletion = dpd.term(dpd.laws.asakura_oosawa, phi_p=0.2, r_g=0.1)
    repulsion = dpd.term(dpd.laws.yukawa, epsilon=1.0, kappa=5.0, origin="charge")
    of_pairs = lambda attraction: (
        dpd.colloid_fluid(**NUMBERS, attraction=attraction).interactions[2].conservative[1:]
    )
    assert laws_of(of_pairs(depletion)) == [dpd.laws.asakura_oosawa]
    assert [t.origin for t in of_pairs([depletion, repulsion])] == ["colloid", "charge"]
    assert of_pairs([]) == ()


def test_literal_noise_by_name():
    exact, literal = (
        dpd.colloid_fluid(**NUMBERS, noise=noise).interactions for noise in ("exact", "literal")
    )
    assert exact[2].random is None
    assert laws_of(literal[2].drag) == [dpd.laws.literal_drag] and laws_of(literal[2].random) == [
        dpd.laws.literal_noise
    ]
    assert literal[2].drag[0].coefficients == {
        "gamma": 4.5,
        "r_c": 1.0,
        "eta_0": 0.3,
        "delta": 1e-3,
    }
    assert (
        laws_of(literal[0].drag) == [dpd.central_drag]
        and literal[0].random is literal[1].random is None
    )


@pytest.mark.parametrize(
    "wrong, parts",
    [
        ({"noise": "letter"}, ["noise is 'letter'", '"exact" or "literal"']),
        ({"kT": -0.1}, ["kT is -0.1"]),
        ({"radius": 0.0}, ["radius is 0.0"]),
        ({"density": 0.0}, ["density is 0.0"]),
        ({"r_c": 0.0}, ["r_c is 0.0"]),
        ({"eta_0": -1.0}, ["eta_0 is -1.0"]),
        ({"gamma": -1.0}, ["gamma is -1.0"]),
    ],
    ids=lambda value: next(iter(value), "") if isinstance(value, dict) else "",
)
def test_colloids_that_cannot_be(wrong, parts):
    with refused(ValueError, *parts):
        dpd.colloid_fluid(**wrong)


def test_diffusion_time_of_the_page(colloids):
    """R 1, kT 0.1, eta 0.3: 56.5."""
    assert float(dpd.theory.diffusion_time(colloids)) == pytest.approx(56.5, abs=0.1)
    assert dpd.theory.diffusion_time(dpd.colloid_fluid(**NUMBERS, radius=2.0)) == pytest.approx(
        8 * 6 * math.pi * 3
    )
    with refused(TypeError, "no radius"):
        dpd.theory.diffusion_time(dpd.fluid([soft()], kT=1.0))
    with refused(TypeError, "'eta_0'"):
        dpd.theory.diffusion_time(dpd.fluid([soft()], kT=1.0, radius=(1.0,)))


def test_colloids_of_traced_numbers(colloids):
    """Forces on two touching colloids and two solvent beads, over kT, D0 and eta_0 at once, and
    their slopes."""
    box, key = boxes.box(8.0), jax.random.key(0)
    position = jnp.array([[1.0, 1.0, 2.1], [1.0, 1.0, 7.8], [1.0, 1.0, 1.0], [3.02, 1.0, 1.0]])
    state = placed(
        colloids,
        key,
        box,
        position,
        (2, 2),
        plan_lists(colloids, box, (2, 2), skin=0.1, sheared=False),
    )

    def force(kT, D0, eta_0):
        fluid = dpd.colloid_fluid(**NUMBERS | dict(kT=kT, D0=D0, eta_0=eta_0))
        return pair_force(fluid, state, state.velocity, 0.0, key, 1e-3)[0]

    numbers = jnp.array([0.1, 0.2, 0.2]), jnp.array([0.0, 1.2, 2.4]), jnp.array([0.3, 0.3, 1.1])
    together, one = jax.jit(jax.vmap(force))(*numbers), jax.jit(force)
    for k in range(3):
        np.testing.assert_allclose(together[k], one(*(n[k] for n in numbers)), atol=1e-12)
    assert not np.allclose(together[1], together[2])
    slope = jax.jit(jax.jacfwd(lambda D0: force(0.1, D0, 0.3)))(1.2)
    e = math.exp(-30 * 0.02)
    np.testing.assert_allclose(
        slope[2:, 0], [2 * 30 * (e - e * e), -2 * 30 * (e - e * e)], rtol=1e-9
    )


@pytest.mark.parametrize("origin", ["kinetic", "conservative", "drag", "random", "tensor"])
def test_names_of_stresses_that_are_taken(origin):
    with pytest.raises(ValueError, match=f"origin '{origin}' of central_drag is taken"):
        dpd.term(dpd.central_drag, gamma=1.0, r_c=1.0, origin=origin)


def test_one_name_for_a_potential_and_a_friction():
    soft = dpd.term(dpd.soft_repulsion, a=1.0, r_c=1.0, origin="mine")
    with pytest.raises(
        ValueError, match="the origin mine is that of a potential and of a friction"
    ):
        dpd.fluid([soft], [dpd.term(dpd.central_drag, gamma=1.0, r_c=1.0, origin="mine")], kT=1.0)


@pytest.mark.parametrize(
    "name, value", [("eta_0", -1.0), ("delta", 0.0), ("Delta", 0.0), ("kappa", -3.0)]
)
def test_numbers_no_colloid_can_have(name, value, colloids):
    with pytest.raises(ValueError, match=f"{name} is {value}"):
        colloids.set(**{name: value})


def test_all_reaches_follow_r_c(colloids):
    assert colloids.set(r_c=2.0).reaches() == pytest.approx((2.0, (2.0**3 + 1) ** (1 / 3), 4.0))


def test_solvent_of_a_suspension(colloids):
    solvent = dpd.pure_solvent(colloids)
    assert solvent.species == 1 and solvent.reaches() == (1.0,) and not solvent.has_radii
    with pytest.raises(ValueError, match=r"give dpd.pure_solvent\(fluid\)"):
        dpd.measure_viscosity(colloids, key=jax.random.key(0))
    pair = dpd.interaction((0, 1), dpd.term(dpd.soft_repulsion, a=1.0, r_c=1.0))
    with pytest.raises(ValueError, match="it is no solvent"):
        dpd.pure_solvent(dpd.fluid(interactions=[pair], kT=1.0))


def test_the_static_pressure_has_every_potential_and_the_drag_every_friction(colloids):
    assert colloids.origins_of("conservative") == ("conservative", "contact", "colloid")
    assert colloids.origins_of("drag") == ("drag", "lubrication")
    one = lambda k: jnp.full((3, 3), 10.0**k)
    origins = ("conservative", "drag", "random", "contact", "colloid", "lubrication")
    state = SimpleNamespace(
        tally=SimpleNamespace(
            virial={origin: one(k) for k, origin in enumerate(origins)}, carried=0.0
        ),
        box=SimpleNamespace(volume=1.0),
        velocity=jnp.zeros((2, 3)),
        species=jnp.array([0, 1]),
        size=jnp.ones(2),
    )
    pressure = dpd.observe.pressure_tensor
    np.testing.assert_allclose(
        pressure(colloids, state, ("kinetic", "conservative")), 1 + 1e3 + 1e4
    )
    np.testing.assert_allclose(pressure(colloids, state, ("drag",)), 10 + 1e5)
    np.testing.assert_allclose(pressure(colloids, state), 11011 + 1e5)
    everything = ("kinetic", "conservative", "drag", "random")
    np.testing.assert_allclose(pressure(colloids, state, everything), 111111)
    with pytest.raises(
        ValueError, match="parts has 'contact'; they are kinetic, conservative, drag"
    ):
        pressure(colloids, state, ("contact",))
