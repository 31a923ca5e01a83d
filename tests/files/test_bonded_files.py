"""Molecules in files: bonds, angles and dihedrals go out and come back, whatever the order."""

import pathlib
import re

import chains
import gsd.fl
import gsd.hoomd
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.bonded.forces import measured
from dpdjax.engine import order
from dpdjax.prepare.start import placed

KEY, DT, PLAN = jax.random.key(5), 0.002, dpd.Plan(3, 10)
COUNTS = [60, 40]
FILE = pathlib.Path(__file__).parent / "molecules.data"
"""Written by LAMMPS after 2000 steps: chains of two species and beads of solvent, ids that are no
row of numbers, a tilted box whose corner is elsewhere."""
ENERGIES = {"bond": 11.9086160892, "angle": 6.59253766204, "dihedral": 5.63643629649}
PAIRS = 13.5208585782
"""What LAMMPS itself found there."""
pytestmark = pytest.mark.filterwarnings("ignore:box side", "ignore:the run ends at")


@pytest.fixture(scope="module")
def fluid():
    """Two species, in chains with every kind of bond."""
    one = chains.fluid()
    pairs, terms = one.interactions[0], {b.name: b.terms for b in one.bonded}
    kinds = {"bonds": "strong", "angles": "bend", "dihedrals": "twist"}
    bonds = {kind: {name: terms[name]} for kind, name in kinds.items()}
    return dpd.fluid(pairs.conservative, pairs.drag, kT=1.0, mass=[1.0, 2.5], **bonds)


@pytest.fixture(scope="module")
def state(fluid):
    """Chains of beads far from each other in memory, of both species."""
    made = dpd.initial_state(fluid, KEY, box=(4.0, 4.4, 4.0), n=COUNTS)
    ids = scattered(np.arange(made.n))
    position = np.empty((made.n, 3))
    position[ids] = chains.placed(made).position
    grids = tuple(held.grid for held in made.neighbours)
    made = placed(fluid, KEY, made.box, jnp.asarray(position), COUNTS, grids)
    return made.bonded({name: ids[rows] for name, rows in chains.groups(made.n).items()})


def scattered(ids):
    return ids.reshape(chains.LENGTH, -1).T.ravel()


@pytest.fixture(scope="module")
def run(fluid, state, tmp_path_factory):
    """One that wrote a file."""
    return ran(fluid, state, out=tmp_path_factory.mktemp("gsd") / "out.gsd")


def ran(fluid, state, plan=PLAN, **how):
    return dpd.run(fluid, state, KEY, DT, plan, progress=False, **how)


@pytest.fixture
def path(run, tmp_path):
    dpd.write_gsd(tmp_path / "run.gsd", run)
    return tmp_path / "run.gsd"


def frames_of(path):
    with gsd.hoomd.open(str(path), "r") as file:
        return list(file)


def coordinates(fluid, state) -> dict:
    """Of each type the lengths or cosines, sorted."""
    return {b.name: np.sort(measured(fluid, state, b)[0]) for b in fluid.bonded}


def alike(one: dict, other: dict, **near):
    assert one.keys() == other.keys()
    for name, values in one.items():
        np.testing.assert_allclose(values, other[name], err_msg=name, **near)


def lengths_in(frame, pairs):
    """Distances of nearest images, by HOOMD's definition of the box."""
    lx, ly, lz, xy = map(float, frame.configuration.box[:4])
    x = frame.particles.position.astype(float)
    d = x[pairs[:, 0]] - x[pairs[:, 1]]
    d[:, 2] -= lz * np.round(d[:, 2] / lz)
    rows = np.round(d[:, 1] / ly)
    d[:, 1] -= ly * rows
    d[:, 0] -= xy * ly * rows
    d[:, 0] -= lx * np.round(d[:, 0] / lx)
    return np.linalg.norm(d, axis=1)


def test_molecules_are_in_the_file(fluid, state, run, path):
    frames = frames_of(path)
    wanted = {"bonds": ("strong", 2), "angles": ("bend", 3), "dihedrals": ("twist", 4)}
    for frame in (frames[0], frames[-1], frames_of(run.frames.path)[-1]):
        for kind, (name, width) in wanted.items():
            found = getattr(frame, kind)
            assert found.types == [name] and not np.any(found.typeid)
            assert found.N == len(found.group) == len(state.topology.beads[name])
            assert found.group.shape[1] == width
    own = coordinates(fluid, run.final)["strong"]
    np.testing.assert_allclose(
        np.sort(lengths_in(frames[-1], frames[-1].bonds.group)), own, atol=1e-5
    )


def test_they_are_stored_once(path, state, fluid, run):
    """Also where a run goes on with the file."""
    with dpd.gsd_writer(path, fluid, run.final, "r+") as write:
        write(run.frames)
    with gsd.fl.open(str(path), "r") as file:
        for name in ("bonds/group", "bonds/types", "angles/group", "dihedrals/N"):
            there = [file.chunk_exists(k, name) for k in range(file.nframes)]
            assert there == [True] + [False] * (2 * PLAN.frames - 1)
    assert all(frame.dihedrals.N == frames_of(path)[0].dihedrals.N for frame in frames_of(path))


def test_a_loaded_state_has_its_bonds_and_goes_on(fluid, state, run):
    path = run.frames.path
    again = dpd.load_gsd(path, fluid=fluid)
    assert again.topology.counts == state.topology.counts and again.excluded is None
    alike(coordinates(fluid, again), coordinates(fluid, run.final), atol=1e-5)
    np.testing.assert_array_equal(again.image, run.final.image)
    for name, sides in run.final.topology.sides.items():
        np.testing.assert_array_equal(again.topology.sides[name], sides)
    more = ran(fluid, again, out=dpd.GSD(path, "a"))
    assert int(more.final.status) == 0 and len(frames_of(path)) == 2 * PLAN.frames
    assert dpd.load_gsd(path, fluid=fluid, exclude=2).excluded is not None


def test_other_bonds_are_another_file(fluid, state, path):
    rows = {name: np.asarray(ids) for name, ids in state.topology.beads.items()}
    fewer = state.bonded(rows | {"bend": rows["bend"][1:]})
    with pytest.raises(ValueError, match="with other bonds than those of this state; give another"):
        ran(fluid, fewer, out=dpd.GSD(path, "a"))


def test_types_in_any_order_of_beads(fluid, state, path, tmp_path):
    """A file of another program, whose beads are not in order of their species."""
    (*_, frame) = frames_of(path)
    shuffled = np.random.default_rng(0).permutation(state.n)
    row = np.argsort(shuffled)
    for name in ("position", "velocity", "image", "mass", "diameter", "typeid"):
        setattr(frame.particles, name, getattr(frame.particles, name)[shuffled])
    for kind in ("bonds", "angles", "dihedrals"):
        bonds = getattr(frame, kind)
        bonds.group = row[bonds.group]
    with gsd.hoomd.open(str(tmp_path / "other.gsd"), "w") as file:
        file.append(frame)
    one, other = (dpd.load_gsd(p, fluid=fluid) for p in (path, tmp_path / "other.gsd"))
    assert np.all(np.diff(other.species) >= 0)
    alike(coordinates(fluid, other), coordinates(fluid, one), atol=1e-12)


def test_one_species_alone(fluid, state, tmp_path):
    """Bonds with beads that are not written are left out, and the others name rows of the file."""
    ends = state.bonded(
        {"strong": np.array([[60, 99], [3, 61], [70, 65]]), "bend": np.array([[61, 62, 5]])}
        | {"twist": np.array([[99, 98, 97, 96]])}
    )
    with dpd.gsd_writer(tmp_path / "second.gsd", fluid, ends, species=1) as write:
        recorded = dpd.observe.gsd_record(fluid, ends) | {"step": ends.step, "time": ends.time}
        write({name: np.asarray(value)[None] for name, value in recorded.items()})
    (frame,) = frames_of(tmp_path / "second.gsd")
    assert frame.particles.N == 40
    assert frame.bonds.group.tolist() == [[0, 39], [10, 5]] and frame.bonds.types == ["strong"]
    assert frame.angles.N == 0 and frame.angles.types == ["bend"]
    assert frame.dihedrals.group.tolist() == [[39, 38, 37, 36]]


def test_ids_that_are_not_the_slots(fluid, state, tmp_path):
    """The file has rows, whatever the beads are called."""
    parts = [
        np.random.default_rng(1).permutation(COUNTS[0]),
        COUNTS[0] + np.arange(COUNTS[1])[::-1],
    ]
    moved = order.permuted(state, jnp.asarray(np.concatenate(parts)))
    for name, of in (("plain", state), ("moved", moved)):
        with dpd.gsd_writer(tmp_path / name, fluid, of) as write:
            recorded = dpd.observe.gsd_record(fluid, of) | {"step": of.step, "time": of.time}
            write({key: np.asarray(value)[None] for key, value in recorded.items()})
    one, other = (frames_of(tmp_path / name)[0] for name in ("plain", "moved"))
    assert np.any(one.bonds.group != other.bonds.group)
    np.testing.assert_array_equal(
        lengths_in(one, one.bonds.group), lengths_in(other, other.bonds.group)
    )


def test_what_does_not_fit_is_told(fluid, path, tmp_path):
    bare = dpd.fluid(fluid.interactions[0].conservative, kT=1.0, mass=[1.0, 2.5])
    with pytest.raises(
        ValueError, match="file has bonds of the types 'strong', and the fluid has none: give it"
    ):
        dpd.load_gsd(path, fluid=bare)
    assert dpd.load_gsd(path, fluid=bare, groups={}).topology is None
    (*_, frame) = frames_of(path)
    frame.angles.N, frame.angles.types = 0, []
    frame.angles.typeid, frame.angles.group = np.zeros(0, int), np.zeros((0, 3), int)
    with gsd.hoomd.open(str(tmp_path / "less.gsd"), "w") as file:
        file.append(frame)
    less = re.escape("the file has none: say which beads they are of, by their rows in the file, ")
    with pytest.raises(ValueError, match=f"angles of the types 'bend', and {less}"):
        dpd.load_gsd(tmp_path / "less.gsd", fluid=fluid)
    rows = frame.bonds.group
    given = {"strong": rows, "bend": np.zeros((0, 3), int), "twist": frame.dihedrals.group}
    found = dpd.load_gsd(tmp_path / "less.gsd", fluid=fluid, groups=given)
    assert found.topology.counts == {name: len(group) for name, group in given.items()}
    with pytest.raises(ValueError, match="'strong' names beads 0 to 100; the state has 0 to 99"):
        dpd.load_gsd(path, fluid=fluid, groups=given | {"strong": np.array([[0, 100]])})
    with pytest.raises(ValueError, match="groups has the types 'strong', and the fluid 'strong', "):
        dpd.load_gsd(path, fluid=fluid, groups={"strong": rows})
    with pytest.raises(TypeError, match="groups is 3; give the beads of each type"):
        dpd.load_gsd(path, fluid=fluid, groups=3)
    frame.impropers.N, frame.impropers.types = 1, ["flat"]
    frame.impropers.typeid, frame.impropers.group = [0], [[0, 1, 2, 3]]
    with gsd.hoomd.open(str(tmp_path / "flat.gsd"), "w") as file:
        file.append(frame)
    with pytest.raises(ValueError, match="the file has 1 impropers, and there is no law"):
        dpd.load_gsd(tmp_path / "flat.gsd", fluid=fluid)


def lammps_fluid(**other):
    """That of the file: K of LAMMPS is k/2 for every one of these."""
    given = {
        "bonds": {
            "equal": dpd.term(dpd.laws.harmonic_bond, k=20.0, r0=0.6),
            "mixed": dpd.term(dpd.laws.harmonic_bond, k=40.0, r0=0.7),
        },
        "angles": dpd.term(dpd.laws.harmonic_cosine, k=10.0, theta0=2 * np.pi / 3),
        "dihedrals": dpd.term(dpd.laws.cosine_dihedral, k=2.0, n=3, d=-1.0),
        "mass": [1.0, 2.5],
    }
    soft = dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)
    rub = dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)
    return dpd.fluid([soft], [rub], kT=1.0, **given | other)


@pytest.fixture(scope="module")
def melt():
    return dpd.load_lammps(FILE, fluid=lammps_fluid())


def test_a_file_of_lammps_is_the_same_matter(melt):
    fluid = lammps_fluid()
    assert melt.topology.counts == {"equal": 4, "mixed": 12, "angle": 12, "dihedral": 8}
    np.testing.assert_allclose(melt.box.lengths, [6.0, 5.4, 5.6], rtol=1e-12)
    np.testing.assert_allclose(melt.box.strain, 0.9 / 5.4, rtol=1e-12)
    found = dict.fromkeys(ENERGIES, 0.0)
    for b in fluid.bonded:
        found[b.kind] += float(jnp.sum(measured(fluid, melt, b)[1]))
    for kind, energy in ENERGIES.items():
        np.testing.assert_allclose(found[kind], energy, rtol=1e-9)
    total = jax.jit(dpd.forces)(fluid, melt, KEY, DT).tally.energy
    np.testing.assert_allclose(total, PAIRS + sum(ENERGIES.values()), rtol=1e-9)


def test_beads_of_lammps_are_in_order_of_species_and_id(melt):
    rows = [line.split() for line in FILE.read_text().splitlines() if len(line.split()) == 10]
    rows = np.array(sorted(rows, key=lambda row: (int(row[2]), int(row[0]))), float)
    lattice = np.array([[6.0, 0, 0], [0.9, 5.4, 0], [0, 0, 5.6]])
    np.testing.assert_array_equal(melt.species, rows[:, 2] - 1)
    np.testing.assert_allclose(
        melt.unwrapped, rows[:, 4:7] - [[-1.0, 0.5, 0.0]] + rows[:, 7:] @ lattice, atol=1e-12
    )
    section = FILE.read_text().split("Velocities\n\n")[1].split("\n\n")[0]
    velocity = {int(k): v for k, *v in (line.split() for line in section.splitlines())}
    wanted = np.array([velocity[int(k)] for k in rows[:, 0]], float)
    np.testing.assert_array_equal(melt.velocity, wanted)
    sheared = dpd.load_lammps(FILE, fluid=lammps_fluid(), flow=dpd.shear(0.5))
    still = wanted[:, 0] - 0.5 * rows[:, 5]
    mass = np.array([1.0, 2.5])[sheared.species]
    still -= (mass * still).sum() / mass.sum()
    np.testing.assert_allclose(sheared.velocity[:, 0], still, atol=1e-12)


def changed(tmp_path, *changes):
    """The file with some text in place of other."""
    text = FILE.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    (tmp_path / "changed.data").write_text(text)
    return tmp_path / "changed.data"


def test_styles_of_atoms(melt, tmp_path):
    """The column of the charge is one of the style ``full`` alone; images and velocities need not
    be there."""
    text = FILE.read_text()
    atoms = text.split("Atoms # full\n\n")[1].split("\n\n")[0]
    keep = {"molecular": [0, 1, 2, 4, 5, 6], "atomic": [0, 2, 4, 5, 6, 7, 8, 9]}
    head, tail = text.split(atoms)
    velocities = tail[tail.index("Velocities") : tail.index("Bonds")]
    for style, columns in keep.items():
        rows = [[line.split()[k] for k in columns] for line in atoms.splitlines()]
        less = head.replace("Atoms # full", "Atoms") + "\n".join(map(" ".join, rows))
        (tmp_path / style).write_text(less + tail.replace(velocities, ""))
        with pytest.raises(ValueError, match="are of the style that nothing tells: give atom_styl"):
            dpd.load_lammps(tmp_path / style, fluid=lammps_fluid())
        found = dpd.load_lammps(tmp_path / style, fluid=lammps_fluid(), atom_style=style)
        np.testing.assert_array_equal(found.position, melt.position)
        np.testing.assert_array_equal(found.topology.beads["mixed"], melt.topology.beads["mixed"])
        assert not np.any(found.velocity)
    with pytest.raises(ValueError, match='atom_style is "bond", and the Atoms of .* style full'):
        dpd.load_lammps(FILE, fluid=lammps_fluid(), atom_style="bond")


def test_what_of_lammps_cannot_be_taken(tmp_path):
    def refused(match, *changes, error=ValueError, **fluid):
        with pytest.raises(error, match=match):
            dpd.load_lammps(changed(tmp_path, *changes), fluid=lammps_fluid(**fluid))

    spring = dpd.term(dpd.laws.harmonic_bond, k=1.0)
    refused("file has bonds of the types '2', and the fluid has 'one'", bonds={"one": spring})
    three = {"one": spring, "two": spring, "three": spring}
    refused("fluid has bonds of the types 'three', and the file has 'one', 'two'", bonds=three)
    refused("mass 2.5 for species 1, whose mass in the fluid is 2;", mass=[1.0, 2.0])
    refused("beads of type 2, number 1, and the fluid knows 1 species", mass=1.0)
    refused("tilted by xz = 0.1 and yz = 0", ("0.9 0 0 xy", "0.9 0.1 0 xy"))
    refused("has 2 impropers", ("8 dihedrals", "8 dihedrals\n2 impropers"))
    refused("style sphere: give atom_style, one of atomic", ("Atoms # full", "Atoms # sphere"))
    for match, *changes in (
        ("Atoms of .* are 44 rows of 10 numbers, where 45 of", ("44 atoms", "45 atoms")),
        ("are 44 rows of 10 numbers, where 44 of 6 or 9", ("Atoms # full", "Atoms # bond")),
        ("Bonds of .* speak of number 7, which is not there", ("\n1 2 96 60\n", "\n1 2 96 7\n")),
        ("Masses of .* types by number", ("1 1\n", "1 heavy\n")),
        ("does not say what the box is", ("0.5 5.9 ylo yhi", "")),
        ("has sides", ("0.5 5.9 ylo", "5.9 0.5 ylo")),
        ("not all finite", ("2.575024743148739", "nan")),
    ):
        refused(match, *changes, error=dpd.FileError)
    (tmp_path / "text").write_text("hello\n\nworld\n")
    (tmp_path / "bytes").write_bytes(bytes(range(256)))
    for name in ("text", "bytes"):
        with pytest.raises(dpd.FileError, match="data file of LAMMPS"):
            dpd.load_lammps(tmp_path / name, fluid=lammps_fluid())
    with pytest.raises(FileNotFoundError):
        dpd.load_lammps(tmp_path / "nowhere", fluid=lammps_fluid())
