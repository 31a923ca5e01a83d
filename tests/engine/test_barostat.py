"""The barostat: the ensemble it samples, the box it keeps, what it refuses."""

import dataclasses

import chains
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small import lists_from_cells

import dpdjax as dpd
from dpdjax.bonded.forces import bonded_force
from dpdjax.engine.integrator import stretched
from dpdjax.engine.observables import STATIC, pressure_tensor
from dpdjax.pairs import box as boxes
from dpdjax.pairs import neighbours as lists
from dpdjax.pairs.forces import pair_force

CellRescaling = dpd.integrators.CellRescaling
BASES = dpd.integrators.VelocityVerlet(), dpd.integrators.ImplicitDrag()


def run(fluid, state, key, plan, how, dt=0.01, **more):
    return dpd.run(fluid, state, key, dt, plan, integrator=how, progress=False, **more)


def same(a, b):
    leaves = lambda state: jax.tree.leaves(jax.tree.map(np.asarray, state))
    return all(np.array_equal(x, y) for x, y in zip(leaves(a), leaves(b), strict=True))


@pytest.mark.parametrize("base", BASES, ids=["Verlet", "implicit"])
def test_a_gas_has_the_volumes_of_its_ensemble(base, ideal, key):
    """``P(V) ~ V^n exp(-p V / kT)``: the mean is (n + 1) kT / p, the variance that times kT / p."""
    state = dpd.initial_state(ideal, key, box=4.0, n=100, skin=0.15)
    how = CellRescaling(1.6, relaxation=0.4, compressibility=1 / 1.6, base=base)
    done = run(ideal, state, key, dpd.Plan(300, every=10), how, 0.02, observe=dpd.observe.box)
    volume = np.prod(done.frames["lengths"], axis=-1)[20:]
    mean = dpd.measure.block_average(volume)
    spread = dpd.measure.block_average((volume - 101 / 1.6) ** 2)
    assert mean.error < 2.0 and abs(mean.value - 101 / 1.6) < 4 * mean.error
    assert spread.error < 16.0 and abs(spread.value - 101 / 1.6**2) < 4 * spread.error


def energy_of(fluid, state):
    given = state, state.velocity, 0.0, jax.random.key(0), 0.01, True, ("conservative",)
    return pair_force(fluid, *given).tally.energy + bonded_force(fluid, state, True).tally.energy


def test_the_pressure_is_minus_the_slope_of_energies_with_the_sides():
    """Of potentials and, by velocities that go the other way, of ``sum m v v / 2``, along each
    side, bonds and angles included."""
    fluid = chains.fluid()
    state = jax.jit(dpd.step)(fluid, chains.state(fluid), jax.random.key(1), 0.005)

    def energy(by):
        return energy_of(fluid, stretched(state, by)) + 0.5 * jnp.sum(
            (state.velocity / by[None]) ** 2
        )

    slope = jax.jit(jax.grad(energy))(jnp.ones(3))
    tensor = np.diagonal(pressure_tensor(fluid, state, STATIC))
    np.testing.assert_allclose(-slope / state.box.volume, tensor, rtol=1e-10)


@pytest.mark.parametrize(
    "coupling, groups",
    [("isotropic", [(0, 1, 2)]), ("semi-isotropic", [(0, 1), (2,)]), ("normal", [(2,)])],
)
def test_the_sides_change_by_the_published_equations(coupling, groups, water, quiet_water, key):
    """Without noise, kT being 0: de = k beta dt (P - p + gamma / L_z) / 3 tau of k sides, the
    tension in the plane alone."""
    cold, box = water.set(kT=0.0, energies="keep"), quiet_water.box
    how = CellRescaling(20.0, relaxation=2.0, compressibility=0.03, tension=5.0, coupling=coupling)
    system = dpd.engine.system.System.of(cold, 0.01, None, how)
    by = np.asarray(how.stretch(system, quiet_water, key))
    tensor = np.diagonal(pressure_tensor(cold, quiet_water, STATIC))
    excess = tensor - 20.0 + np.array([1, 1, 0]) * 5.0 / float(box.lengths[2])
    wanted = np.zeros(3)
    for sides in groups:
        change = len(sides) * 0.03 * 0.01 / (3 * 2.0) * np.mean(excess[list(sides)])
        wanted[list(sides)] = change / len(sides)
    np.testing.assert_allclose(np.log(by), wanted, rtol=1e-9, atol=1e-15)


def test_noise_has_the_variance_of_the_equation(water, quiet_water):
    """``2 k kT beta dt / 3 V tau`` of the logarithm of k sides."""
    how = CellRescaling(0.0, compressibility=0.03, coupling="semi-isotropic")
    system = dpd.engine.system.System.of(water, 0.01, None, how)
    keys = jax.random.split(jax.random.key(3), 4000)
    by = jnp.log(jax.vmap(lambda key: how.stretch(system, quiet_water, key))(keys))
    plane, normal = 2 * np.std(by[:, 0]), np.std(by[:, 2])
    one = np.sqrt(2 * 0.03 * 0.01 / (3 * float(quiet_water.box.volume)))
    np.testing.assert_allclose([plane, normal], [np.sqrt(2) * one, one], rtol=0.05)
    assert np.array_equal(by[:, 0], by[:, 1])
    assert abs(np.corrcoef(by[:, 0], by[:, 2])[0, 1]) < 0.06


def watch(fluid, state):
    """What it takes to check a list afterwards."""
    return {"position": state.position, "idx": state.neighbours[0].list.idx} | dpd.observe.box(
        fluid, state
    )


@pytest.mark.parametrize("pressure", [10.0, 60.0], ids=["grows", "shrinks"])
def test_no_pair_is_missed_while_the_box_changes(pressure, water, key):
    """Fast, and by so much that cells become too narrow and are made wider."""
    with lists_from_cells():
        state = dpd.initial_state(water, key, box=5.5, density=3.0, skin=0.2, sheared=False)
    start = state.neighbours[0].grid
    assert start.cells is not None
    how = CellRescaling(pressure, relaxation=0.3, coupling="semi-isotropic")
    done = run(water, state, key, dpd.Plan(150), how, observe=watch)
    lengths = np.asarray(done.frames["lengths"])
    assert np.max(np.abs(lengths[-1] / lengths[0] - 1)) > 0.06
    grid = done.final.neighbours[0].grid
    assert (grid.cells != start.cells) == (pressure > 30)
    for k in range(0, 150, 7):
        x, idx = done.frames["position"][k], np.asarray(done.frames["idx"][k])
        listed = set(map(frozenset, idx.T[idx[0] < state.n].tolist()))
        d = x[:, None] - x[None]
        d -= lengths[k] * np.round(d / lengths[k])
        close = np.argwhere(np.triu(np.sum(d * d, axis=-1) < 1.0, 1))
        assert {frozenset(pair) for pair in close.tolist()} <= listed
    assert np.all(done.frames["position"] <= lengths[:, None] * (1 + 1e-12))


@pytest.mark.parametrize(
    "by, strain", [([0.97, 1.0, 1.0], 0.0), ([1.0, 0.96, 1.04], 0.2), ([0.95] * 3, 0.0)]
)
def test_a_list_is_stale_once_a_shorter_box_can_bring_a_pair_within_reach(by, strain):
    """Beads that go with the box: stale where the shortest side takes more than the skin off the
    list radius; and nothing else is."""
    grid = lists.plan_grid(300, [6.0, 6.0, 6.0], 1.0, 0.2)
    box = boxes.box(6.0).strained(strain)
    x = jnp.asarray(np.random.default_rng(0).random((300, 3)) * 6.0)
    held, by = lists.allocate(grid, box, x), jnp.asarray(by)
    assert not lists.is_stale(held, box, x)
    smaller = boxes.Box(box.lengths * by, box.strain * by[0] / by[1])
    off = 1.2 * (1 - float(by.min()))
    assert bool(lists.is_stale(held, smaller, x * by[None])) == (off > 0.2)
    slack = 0.5 * (0.2 - off)
    move = lambda d: (x * by[None]).at[5, 1].add(d)
    assert not lists.is_stale(held, smaller, move(0.98 * slack))
    assert lists.is_stale(held, smaller, move(1.02 * slack))


def test_a_run_is_that_of_its_parts_and_of_its_members(water, quiet_water, key, tmp_path):
    """In one go, saved and gone on with, and as a member of a batch over pressures."""
    how = CellRescaling(jnp.array([20.0, 30.0]), relaxation=0.5)
    one = CellRescaling(30.0, relaxation=0.5)
    whole = run(water, quiet_water, key, dpd.Plan(2, every=20), one).final
    half = run(water, quiet_water, key, dpd.Plan(1, every=20), one).final
    dpd.save_state(tmp_path / "half.npz", half)
    again = run(water, dpd.load_state(tmp_path / "half.npz"), key, dpd.Plan(1, every=20), one)
    assert same(whole, again.final)
    keys = jnp.stack([key, key])
    both = run(water, quiet_water, keys, dpd.Plan(2, every=20), how).final
    assert same(jax.tree.map(lambda leaf: leaf[1], both), whole)
    assert both.box.lengths[0, 0] > both.box.lengths[1, 0]


def test_a_small_box_grows_its_lists_and_says_when_it_cannot(water, quiet_water, key):
    how = CellRescaling(400.0, relaxation=0.1)
    with pytest.raises(dpd.RunError, match=r"a side of the box fell below 2 \(reach \+ skin\)"):
        run(water, quiet_water, key, dpd.Plan(40, every=5), how)


def test_velocities_go_the_other_way(water, quiet_water, key):
    """Two steps at a kT of 0 and without forces: what the sides gain the velocities lose."""
    free = water.set(a=0.0, gamma=0.0, kT=0.0, energies="keep")
    how = CellRescaling(5.0, relaxation=0.2)
    start = quiet_water.restarted()
    moved = run(free, start, key, dpd.Plan(2), how).final
    by = moved.box.lengths / start.box.lengths
    assert jnp.all(jnp.abs(by - 1) > 1e-4)
    np.testing.assert_allclose(moved.velocity * by[None], start.velocity, rtol=1e-12)


def test_gradients_go_through(water, quiet_water, key):
    """Of a volume with the pressure, against differences."""
    plan = dpd.Plan(3)

    def volume(p):
        how = CellRescaling(p, relaxation=0.5)
        return dpd.simulate(water, quiet_water, key, 0.01, plan, integrator=how).final.box.volume

    slope = jax.jit(jax.jacfwd(volume))(25.0)
    difference = (volume(25.0 + 1e-4) - volume(25.0 - 1e-4)) / 2e-4
    assert slope < 0
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


@dataclasses.dataclass(frozen=True)
class Own(dpd.integrators.Integrator):
    """Moves nothing by ``drifted``."""

    def step(self, system, state, key, tally):
        forces = dpd.integrators.forces_on(system, state, state.velocity, key, tally)
        later = dataclasses.replace(state, step=state.step + 1)
        return dpd.integrators.with_forces(later, forces)


jax.tree_util.register_dataclass(Own)


@pytest.mark.parametrize(
    "how, flow, error, told",
    [
        (CellRescaling(20.0, coupling="xy"), None, ValueError, "coupling of CellRescaling is 'xy'"),
        (CellRescaling(20.0, relaxation=0.0), None, ValueError, "relaxation of Cell.* above zero"),
        (CellRescaling(20.0, relaxation=0.05), None, ValueError, "too large for the barostat"),
        (CellRescaling(20.0), dpd.shear(0.1), ValueError, "Shear deforms the box"),
        (CellRescaling(np.nan), None, ValueError, "pressure of CellRescaling is nan"),
        (CellRescaling(20.0, base=None), None, TypeError, "base of CellRescaling is None"),
        (
            CellRescaling(20.0, base=dpd.integrators.MultipleTimeStep()),
            None,
            ValueError,
            "base of CellRescaling is MultipleTimeStep, in which the box cannot change",
        ),
        (
            CellRescaling(20.0, base=CellRescaling(1.0)),
            None,
            ValueError,
            "base of CellRescaling is",
        ),
        (
            CellRescaling(20.0, base=Own()),
            None,
            TypeError,
            "leaves the box as it is: begin it with",
        ),
    ],
)
def test_what_cannot_be_is_refused(how, flow, error, told, water, quiet_water, key):
    with pytest.raises(error, match=told):
        run(water, quiet_water, key, dpd.Plan(1), how, flow=flow)


def test_measures_of_one_box_refuse_one_that_changed(water, quiet_water, key, tmp_path):
    how = CellRescaling(30.0, relaxation=0.2)
    observe = [dpd.observe.standard, dpd.observe.positions]
    out = tmp_path / "run.gsd"
    done = run(water, quiet_water, key, dpd.Plan(4, every=5), how, observe=observe, out=str(out))
    for measure in (
        lambda run: dpd.measure.mean_squared_displacement(run),
        lambda run: dpd.measure.velocity_profile(run),
        lambda run: dpd.measure.green_kubo(run, window=0.05),
    ):
        with pytest.raises(ValueError, match="changed its sides|recorded no"):
            measure(done)
    found = dpd.measure.radial_distribution(done, bins=20)
    frames = done.frames["position"]
    each = [
        dpd.measure.radial_distribution(x, box=sides, bins=20, r_max=found.r[-1] + found.r[0])
        for x, sides in zip(frames, np.asarray(done.frames["lengths"]))
    ]
    np.testing.assert_allclose(found.g, np.mean([one.g for one in each], axis=0), rtol=1e-6)
    hoomd = pytest.importorskip("gsd.hoomd")
    with hoomd.open(str(out)) as file:
        boxed = [frame.configuration.box[:3] for frame in file]
    np.testing.assert_allclose(boxed, done.frames["lengths"], rtol=1e-6)
    assert np.ptp(np.asarray(boxed)[:, 0]) > 1e-4
