"""Suspensions: several groups of beads, each pair with its own law, against sums over all pairs by
hand."""

import dataclasses
import math
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small import with_cells

import dpdjax as dpd
from dpdjax.engine import order
from dpdjax.engine.system import System
from dpdjax.model.beads import masses, radii
from dpdjax.pairs import box as boxes
from dpdjax.pairs import neighbours as lists
from dpdjax.pairs import noise
from dpdjax.pairs.forces import pair_force

DT = 1e-3
NUMBERS = dict(kT=0.1, gamma=4.5, eta_0=0.3, D0=1.2, kappa=30.0)


@pytest.fixture(scope="module")
def suspended(key):
    """Polydisperse colloids and solvent in the smallest box that takes them."""
    return dpd.suspension(
        key, phi=0.2, box=8.0, spread=0.1, skin=0.1, density=2.0, dt=DT, report=None, **NUMBERS
    )


@pytest.fixture(scope="module")
def settled(suspended, simulate, key):
    """The same after 60 steps of shear."""
    final = simulate(
        suspended.fluid, suspended.state, key, DT, dpd.Plan(6, 10), dpd.shear(1.0)
    ).final
    assert final.status == 0
    return final


def test_counts_masses_and_cut_offs(suspended):
    made, sizes = suspended, np.asarray(suspended.state.size)[suspended.solvents :]
    assert made.solvents == math.floor(2.0 * (1 - made.phi) * 8.0**3)
    assert made.colloids == round(0.2 * 8.0**3 / (4 / 3 * math.pi * (1 + 3 * 0.1**2)))
    np.testing.assert_allclose(made.phi, 4 / 3 * math.pi * np.sum(sizes**3) / 8.0**3)
    heavy = np.asarray(masses(made.fluid, made.state))[made.solvents :]
    np.testing.assert_allclose(heavy, 2.0 * 4 / 3 * math.pi * sizes**3)
    assert np.all(np.asarray(radii(made.fluid, made.state))[: made.solvents] == 0)
    largest = sizes.max()
    reaches = [n.grid.reach for n in made.state.neighbours]
    np.testing.assert_allclose(reaches, [1.0, (1 + largest**3) ** (1 / 3), 1 + 2 * largest])
    assert made.tau == pytest.approx(6 * math.pi * 0.3 / 0.1)
    for part in (
        f"{made.colloids} colloids and {made.solvents} solvent",
        "diffusion time tau 56.55",
        "particle-steps",
    ):
        assert part in str(made)


def test_start_has_no_overlap_and_the_solvent_outside(suspended):
    state, fluid = suspended.state, suspended.fluid
    R = np.asarray(radii(fluid, state))
    d = np.asarray(
        boxes.displacement(
            state.box, state.position[:, None], state.position[None, suspended.solvents :]
        )
    )
    gap = np.linalg.norm(d, axis=-1) - R[:, None] - R[None, suspended.solvents :]
    gap[suspended.solvents :][np.eye(suspended.colloids, dtype=bool)] = np.inf
    assert gap.min() >= 0
    assert gap[suspended.solvents :].min() > 0.001


def test_the_spheres_of_a_state(settled, suspended):
    some, colloids = (
        dpd.measure.spheres_of(suspended.fluid, settled),
        slice(suspended.solvents, None),
    )
    np.testing.assert_array_equal(some.position[0, 0], settled.position[colloids])
    np.testing.assert_array_equal(
        some.radius[0], np.asarray(radii(suspended.fluid, settled))[colloids]
    )
    assert some.strain[0, 0] == settled.box.strain != 0 and some.time == settled.time
    with pytest.raises(ValueError, match="species 0 has no radius.*spheres are of species 1"):
        dpd.measure.spheres_of(suspended.fluid, settled, species=0)
    with pytest.raises(
        TypeError, match=r"not a State; of one state, dpd.measure.spheres_of\(fluid, state\)"
    ):
        dpd.measure.contact_number(settled, gap=0.1)
    with pytest.raises(ValueError, match="the state is a batch"):
        dpd.measure.spheres_of(suspended.fluid, jax.tree.map(lambda x: jnp.stack([x, x]), settled))


def laws_by_hand(kind, h, Ri, Rj):
    """Conservative force and friction of a pair, written out from PHYSICS of the fluid; numpy."""
    kT, gamma, eta_0, D0, kappa = NUMBERS.values()
    if kind == "ss":
        return np.where(h < 1, 25 * kT * (1 - h), 0), np.where(h < 1, gamma * (1 - h) ** 2, 0)
    if kind == "cs":
        cut = (1 + (Ri + Rj) ** 3) ** (1 / 3) - (Ri + Rj)
        w = np.where(h < cut, 1 - h / cut, 0)
        return 25 * kT / cut * w, gamma * w**2
    contact = 1e4 * kT * np.where(h <= 0, 1 - h, np.where(h < 1e-3, 1 - h / 1e-3, 0) ** 3)
    e = np.exp(-kappa * h)
    morse = 2 * D0 * kappa * (e * e - e)
    squeeze = 1.5 * np.pi * eta_0 / np.maximum(h, 1e-3) * ((Ri + Rj) / 2) ** 2
    return np.where(h < 1, contact + morse, 0), np.where(h < 1, gamma * (1 - h) ** 2 + squeeze, 0)


def forces_by_hand(fluid, state, solvents, rate, key):
    """Sum over all pairs, with the engine's own noise for each."""
    x, v, R = (np.asarray(a) for a in (state.position, state.velocity, radii(fluid, state)))
    i, j = np.triu_indices(state.n, 1)
    d = np.asarray(boxes.displacement(state.box, state.position[i], state.position[j]))
    r = np.linalg.norm(d, axis=1)
    e = d / r[:, None]
    approach = np.sum((v[i] - v[j]) * e, axis=1) + rate * d[:, 1] * e[:, 0]
    h = r - R[i] - R[j]
    total = np.zeros_like(x)
    for channel, kind in enumerate(("ss", "cs", "cc")):
        mine = (np.add(i >= solvents, j >= solvents, dtype=int) == channel) & (h < 1)
        conservative, zeta = laws_by_hand(kind, h[mine], R[i[mine]], R[j[mine]])
        words = noise.step_words(key, state.step, channel)
        of_bead = noise.bead_words(words, state.id)
        xi = np.asarray(noise.pair_noise(words, of_bead[i[mine]], of_bead[j[mine]], np.float64))
        f = (conservative - zeta * approach[mine] + np.sqrt(2 * NUMBERS["kT"] * zeta / DT) * xi)[
            :, None
        ] * e[mine]
        np.add.at(total, i[mine], f)
        np.subtract.at(total, j[mine], f)
    return total


def test_forces_equal_the_sum_over_all_pairs(suspended, settled, key):
    # Some colloids in each other's wells, lubrication layers and contacts.
    position = np.array(settled.position)
    R = np.asarray(radii(suspended.fluid, settled))
    first = suspended.solvents
    for k, gap in enumerate((0.05, 0.02, 5e-4, -0.01)):
        a, b = first + 2 * k, first + 2 * k + 1
        position[b] = position[a] + (R[a] + R[b] + gap) * np.array([0.6, 0.0, 0.8])
    position = boxes.wrap(settled.box, jnp.asarray(position))[0]
    neighbours = tuple(
        lists.allocate(n.grid.grown(), settled.box, position) for n in settled.neighbours
    )
    assert not any(int(n.list.error.code) for n in neighbours)
    state = dataclasses.replace(settled, position=position, neighbours=neighbours)
    force, _, tally = jax.jit(
        lambda s: pair_force(suspended.fluid, s, s.velocity, 1.0, key, DT, tally=True)
    )(state)
    expected = forces_by_hand(suspended.fluid, state, first, 1.0, key)
    np.testing.assert_allclose(force, expected, atol=1e-9 * np.abs(expected).max())
    assert jnp.max(jnp.abs(jnp.sum(force, axis=0))) < 1e-10 * jnp.max(jnp.abs(force))
    assert all(jnp.any(v != 0) for v in tally.virial.values())
    assert set(tally.virial) == {
        "conservative",
        "drag",
        "random",
        "contact",
        "colloid",
        "lubrication",
    }


FLOW, TWENTY = dpd.shear(1.0), dpd.Plan(2, 10)


@pytest.fixture(scope="module")
def run(simulate, suspended, key):
    return lambda state, plan=TWENTY: simulate(suspended.fluid, state, key, DT, plan, FLOW)


def same_bits(a, b):
    return all(
        jnp.array_equal(getattr(a, name), getattr(b, name))
        for name in ("position", "velocity", "force", "image", "id")
    )


def test_momentum_of_a_sheared_suspension(run, settled):
    moved = dataclasses.replace(settled, velocity=settled.velocity + jnp.array([[0.3, 0.0, -0.2]]))
    momentum = run(moved).frames["momentum"]
    np.testing.assert_allclose(momentum, momentum[:1] + 0 * momentum, atol=1e-9)


def test_capacity_and_chunks_are_bitwise_invisible(run, settled):
    whole = run(settled, dpd.Plan(4, 10)).final
    assert same_bits(whole, run(run(settled).final).final)
    assert same_bits(whole, run(dpd.grow(settled), dpd.Plan(4, 10)).final)


def test_sorting_groups_is_bitwise_invisible(monkeypatch, suspended, settled, key):
    def go(sort, state):
        monkeypatch.setattr(order, "SMALLEST", 20 if sort else 10**9)
        monkeypatch.setattr(order, "LASTS", 3)
        return jax.jit(lambda s: dpd.simulate(suspended.fluid, s, key, DT, dpd.Plan(3, 5), FLOW))(
            state
        ).final

    settled = with_cells(settled)
    monkeypatch.setattr(order, "SMALLEST", 20)
    first = order.in_cell_order(settled)
    assert not jnp.array_equal(first.id[: suspended.solvents], settled.id[: suspended.solvents])
    assert jnp.all(jnp.sort(first.id[: suspended.solvents]) == jnp.arange(suspended.solvents)), (
        "groups stay together"
    )
    assert same_bits(go(True, settled), go(False, settled))


def test_no_pair_of_any_group_is_missed(run, simulate, suspended, settled, key):
    hot = suspended.fluid.set(kT=1.0)
    watch = lambda fluid, state: {
        "position": state.position,
        "strain": state.box.strain,
        **{f"idx{k}": n.list.idx for k, n in enumerate(state.neighbours)},
    }
    seen = simulate(hot, settled, key, DT, dpd.Plan(12, 20), dpd.shear(2.0), observe=watch)
    assert seen.final.status == 0
    R = np.asarray(radii(suspended.fluid, settled))
    n, first = settled.n, suspended.solvents
    for f in range(12):
        box = boxes.Box(settled.box.lengths, seen.frames["strain"][f])
        x = seen.frames["position"][f]
        r = np.linalg.norm(np.asarray(boxes.displacement(box, x[:, None], x[None])), axis=-1)
        for k, (a, b) in enumerate(
            (((0, first), (0, first)), ((0, first), (first, n)), ((first, n), (first, n)))
        ):
            reach = (
                1.0
                if k == 0
                else (1 + R[None, :] ** 3) ** (1 / 3)
                if k == 1
                else 1 + R[:, None] + R[None]
            )
            close = np.triu(r < reach, 1)
            wanted = {
                (i, j)
                for i, j in np.argwhere(close).tolist()
                if a[0] <= i < a[1] and b[0] <= j < b[1]
            }
            i, j = np.asarray(seen.frames[f"idx{k}"][f])
            assert wanted <= set(zip(i[i < n].tolist(), j[i < n].tolist()))


def test_same_key_same_suspension(key):
    make = lambda key: (
        dpd.suspension(key, phi=0.1, box=7.0, density=1.0, report=None, **NUMBERS).state
    )
    once, again, other = make(key), make(key), make(jax.random.key(99))
    assert same_bits(once, again)
    assert not jnp.any(once.position == other.position)


def test_gradients_equal_central_differences(suspended, settled, key):
    """Over ten steps, with respect to three numbers at once, in wells so wide that several pairs of
    colloids are in one."""
    names, values = ("D0", "kappa", "eta_0"), jnp.array([1.2, 5.0, 0.3])
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(suspended.colloids, 3)))

    @jax.jit
    def outcome(x):
        fluid = suspended.fluid.set(**dict(zip(names, x)))
        final = dpd.simulate(fluid, settled.restarted(), key, 1e-4, dpd.Plan(2, 5)).final
        return jnp.sum(weights * final.velocity[suspended.solvents :])

    steps = 1e-4 * jnp.diag(values)
    differences = [outcome(values + step) - outcome(values - step) for step in steps]
    central = jnp.stack(differences) / (2e-4 * values)
    assert jnp.all(jnp.abs(central) > 1e-9)
    np.testing.assert_allclose(jax.grad(outcome)(values), central, rtol=1e-5)


def test_scans_over_numbers_of_colloids(suspended, settled, key):
    """One number at a time, all scans in one batch."""
    first, second = dict(D0=0.6, kT=0.1, eta_0=0.3), dict(D0=1.2, kT=0.2, eta_0=1.0)

    @jax.jit
    def run(numbers):
        fluid = suspended.fluid.set(**numbers)
        return dpd.simulate(fluid, settled, key, DT, dpd.Plan(2, 3)).final.velocity

    members = [first] + [first | {name: second[name]} for name in first]
    together = jax.vmap(run)(jax.tree.map(lambda *x: jnp.stack(x), *members))
    for k, member in enumerate(members):
        np.testing.assert_allclose(together[k], run(member), atol=1e-9)
        assert k == 0 or not jnp.allclose(together[k], together[0])


def test_relative_viscosity_is_that_at_the_density_between(settled, suspended, key, monkeypatch):
    """Of replicas; the measurement of the solvent is replaced by one that says what it was
    asked."""
    asked = {}

    def measure(fluid, **how):
        asked.update(how, species=fluid.species)
        return SimpleNamespace(estimate=dpd.Estimate(0.5, 0.01))

    monkeypatch.setattr(
        sys.modules[dpd.relative_viscosity.__module__], "measure_viscosity", measure
    )
    wide = dataclasses.replace(
        settled, position=settled.position.at[suspended.solvents :].set(jnp.array([4.0, 4.0, 4.0]))
    )
    rng = np.random.default_rng(0)
    stress = -0.8 + 0.1 * rng.normal(size=(2, 40, 1, 1)) * np.ones((1, 1, 3, 3))
    final = jax.tree.map(lambda x: jnp.stack([x, x]), wide)
    frames = {"pressure_tensor": stress, "time": np.zeros((2, 40))}
    sheared = dpd.Trajectory(final, frames, System.of(suspended.fluid, DT, dpd.shear(1.0)))
    found = dpd.relative_viscosity(sheared, key=key, tolerance=0.1)
    assert (
        found.value == pytest.approx(dpd.shear_viscosity(sheared).value / 0.5)
        and found.deviation(1.6) < 4
    )
    assert asked["density"] == pytest.approx(dpd.measure.solvent_density(suspended.fluid, wide))
    assert asked["tolerance"] == 0.1 and asked["species"] == 1
    known = dpd.relative_viscosity(sheared, solvent=dpd.Estimate(0.25, 0.0))
    assert known.value == pytest.approx(2 * found.value)


def test_killed_and_repeated(suspended, settled, simulate, key):
    again = dpd.suspension(
        key, phi=0.2, box=8.0, spread=0.1, skin=0.1, density=2.0, dt=DT, report=None, **NUMBERS
    )
    assert same_bits(
        settled, simulate(again.fluid, again.state, key, DT, dpd.Plan(6, 10), dpd.shear(1.0)).final
    )


def test_saved_and_loaded(run, settled, tmp_path):
    dpd.save_state(tmp_path / "state.npz", settled)
    loaded = dpd.load_state(tmp_path / "state.npz")
    assert [n.grid for n in loaded.neighbours] == [n.grid for n in settled.neighbours]
    assert same_bits(run(loaded).final, run(settled).final)


def test_only_the_list_that_overflowed_grows(suspended, settled, key):
    short = settled.neighbours[2]
    grid = dataclasses.replace(short.grid, capacity=4)
    tight = lists.allocate(grid, settled.box, settled.position)
    assert lists.overflow(tight) == 1
    state = dataclasses.replace(settled, neighbours=(*settled.neighbours[:2], tight))
    ran = dpd.run(suspended.fluid, state, key, 2e-4, dpd.Plan(2, 3), progress=False)
    before, after = ([n.grid.capacity for n in s.neighbours] for s in (state, ran.final))
    assert after[:2] == before[:2] and after[2] > before[2]


def test_suspension_of_given_radii_or_a_given_number(key):
    radii = np.array([1.0, 0.8, 1.2, 1.0, 0.9, 1.1, 1.0, 1.0])
    made = dpd.suspension(key, phi=0.05, radius=radii, density=0.2, report=None)
    np.testing.assert_allclose(made.phi, 0.05)
    np.testing.assert_allclose(np.asarray(radii_of(made)), radii)
    same = dpd.suspension(key, phi=0.05, colloids=8, density=0.2, report=None)
    np.testing.assert_allclose(same.state.box.volume, 8 * 4 / 3 * math.pi / 0.05)


def radii_of(made):
    return radii(made.fluid, made.state)[made.solvents :]


@pytest.mark.parametrize(
    "wrong, words",
    [
        (dict(phi=0.2), "give either box"),
        (dict(phi=0.2, box=9.0, colloids=10), "give either box"),
        (dict(phi=1.2, box=9.0), "phi is 1.2; it must be below 1"),
        (dict(phi=0.62, box=12.0), "0.6"),
        (dict(phi=-0.1, box=9.0), "phi is -0.1"),
        (dict(phi=0.2, box=9.0, spread=0.5), "spread is 0.5"),
        (dict(phi=0.2, box=9.0, radius=np.ones(5)), "5 radii are given"),
        (dict(phi=0.2, box=5.0), r"below 2 \(reach \+ skin\)"),
        (dict(phi=1e-4, box=9.0), "less than one colloid"),
        (dict(phi=0.2, box=9.0, noise="wrong"), "noise is 'wrong'"),
        (
            dict(phi=0.2, box=9.0, noise="literal", lubrication=dpd.laws.unequal_lubrication),
            "leave lubrication= out",
        ),
        (dict(phi=0.2, box=9.0, kT=0.0), "kT is 0"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, dict) else None,
)
def test_suspensions_that_cannot_be(wrong, words, key):
    with pytest.raises(ValueError, match=words):
        dpd.suspension(key, report=None, **wrong)


def test_groups_from_a_plain_start(key):
    soft, rub = (
        dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0),
        dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0),
    )
    fluid = dpd.fluid(
        interactions=[
            dpd.interaction((0, 0), soft, rub),
            dpd.interaction((1, 0), dpd.term(dpd.soft_repulsion, a=25.0, r_c=2.0)),
        ],
        kT=1.0,
        mass=[1.0, 5.0],
    )
    state = dpd.initial_state(fluid, key, box=5.0, n=[300, 20], sheared=False)
    assert [n.grid.groups for n in state.neighbours] == [
        ((0, 300), (0, 300)),
        ((0, 300), (300, 320)),
    ]
    final = dpd.simulate(fluid, state, key, 0.01, dpd.Plan(2, 5)).final
    assert final.status == 0
    with pytest.raises(ValueError, match="no bead of species"):
        dpd.initial_state(fluid, key, box=5.0, n=[300, 0])
