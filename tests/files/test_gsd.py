"""GSD files: what is written is what was there, in boxes of any tilt, whatever the pieces."""

import dataclasses
import importlib.util
import subprocess
import sys

import gsd.hoomd
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine.rotation import axis_of
from dpdjax.engine.system import System
from dpdjax.pairs import box as boxes
from dpdjax.prepare.start import placed, plan_lists

SIDES, DT = np.array([5.0, 4.5, 6.0]), 0.002
FLOW, PLAN = dpd.shear(1.0), dpd.Plan(8, 40)
RADIUS, MASSES, COUNTS = 0.3, [1.0, 5.0], (100, 8)
RECORDS = [dpd.observe.standard, dpd.observe.gsd_record]
pytestmark = pytest.mark.filterwarnings("ignore:box side")
host = sys.modules[dpd.stream.__module__]


@pytest.fixture(scope="module")
def fluid():
    """Points, and spheres of mixed sizes."""
    soft, rub = (
        dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0),
        dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0),
    )
    return dpd.fluid([soft], [rub], kT=1.0, mass=MASSES, radius=(None, RADIUS))


@pytest.fixture(scope="module")
def state(fluid, key):
    size = np.concatenate([np.ones(COUNTS[0]), np.linspace(0.7, 1.2, COUNTS[1])])
    position = jax.random.uniform(key, (sum(COUNTS), 3)) * SIDES[None]
    box = boxes.box(SIDES)
    return placed(
        fluid,
        key,
        box,
        position,
        COUNTS,
        plan_lists(fluid, box, COUNTS, size=size, skin=0.15),
        size=size,
    )


@pytest.fixture(scope="module")
def run(fluid, state, key):
    """The frames as ``dpd.run`` keeps them; the strain goes from 0 past the half."""
    return dpd.run(fluid, state, key, DT, PLAN, FLOW, observe=RECORDS, progress=False)


@pytest.fixture(scope="module")
def to_file(fluid, state, key):
    return lambda path, plan=PLAN, mode="x": dpd.run(
        fluid, state, key, DT, plan, FLOW, out=dpd.GSD(path, mode), progress=False
    )


@pytest.fixture(scope="module")
def written(to_file, tmp_path_factory):
    """The file of a run in pieces, and what the run returned."""
    path = tmp_path_factory.mktemp("gsd") / "run.gsd"
    return path, to_file(path)


def frames_of(path):
    with gsd.hoomd.open(str(path), "r") as file:
        return list(file)


@pytest.fixture(scope="module")
def frames(written):
    return frames_of(written[0])


def lattice_of(frame):
    """Lattice vectors in rows, by HOOMD's definition of the box."""
    lx, ly, lz, xy, xz, yz = map(float, frame.configuration.box)
    return np.array([[lx, 0, 0], [xy * ly, ly, 0], [xz * lz, yz * lz, lz]])


def unwrapped(frame):
    return frame.particles.position + frame.particles.image @ lattice_of(frame)


def test_beads_are_described(frames, state):
    assert len(frames) == PLAN.frames
    for frame in (frames[0], frames[-1]):
        beads = frame.particles
        assert beads.N == sum(COUNTS) and beads.types == ["A", "B"]
        assert np.array_equal(beads.typeid, np.repeat([0, 1], COUNTS))
        size = np.asarray(state.size)[COUNTS[0] :]
        np.testing.assert_allclose(
            beads.mass, np.concatenate([np.ones(COUNTS[0]), 5 * size**3]), rtol=1e-6
        )
        np.testing.assert_allclose(
            beads.diameter, np.concatenate([np.ones(COUNTS[0]), 2 * RADIUS * size]), rtol=1e-6
        )


def test_steps_and_boxes_are_those_of_the_run(frames, run):
    assert (
        [f.configuration.step for f in frames]
        == run.frames["step"].tolist()
        == list(range(40, 321, 40))
    )
    for frame, strain in zip(frames, run.frames["strain"]):
        np.testing.assert_allclose(frame.configuration.box, [*SIDES, strain, 0, 0], rtol=1e-6)
    tilts = [f.configuration.box[3] for f in frames]
    assert min(tilts) < 0 < 0.4 < max(tilts), "the tilt has gone through the half"


def test_positions_are_inside_a_centred_box_and_right_modulo_its_lattice(frames, run):
    for frame, position, image in zip(frames, run.frames["position"], run.frames["image"]):
        lattice = lattice_of(frame)
        middle = 0.5 * lattice.sum(0)
        fraction = frame.particles.position @ np.linalg.inv(lattice)
        assert np.max(np.abs(fraction)) <= 0.5 + 1e-6
        turns = (frame.particles.position + middle - position) @ np.linalg.inv(lattice)
        np.testing.assert_allclose(turns, np.round(turns), atol=1e-5)
        np.testing.assert_allclose(unwrapped(frame) + middle, position + image @ lattice, atol=2e-5)
    assert any(
        np.any(f.particles.image != image) for f, image in zip(frames, run.frames["image"])
    ), "some were moved along x"


def test_velocities_are_those_of_the_lab(frames, run):
    for frame, velocity in zip(frames, run.frames["velocity"]):
        streaming = frame.particles.velocity - velocity
        np.testing.assert_allclose(streaming[:, 0], 1.0 * frame.particles.position[:, 1], atol=1e-5)
        assert not np.any(np.abs(streaming[:, 1:]) > 1e-6)


def test_velocities_carry_beads_from_frame_to_frame(fluid, run, key, tmp_path):
    """One step apart; the image of a bead in the next row streams by a side times the rate
    faster."""
    path = tmp_path / "steps.gsd"
    dpd.run(fluid, run.final, key, 1e-4, dpd.Plan(2), FLOW, out=path, progress=False)
    before, after = frames_of(tmp_path / "steps.gsd")
    moved = (unwrapped(after) - unwrapped(before)) / 1e-4
    carried = 0.5 * (before.particles.velocity + after.particles.velocity)
    carried[:, 0] += 1.0 * SIDES[1] * after.particles.image[:, 1]
    assert np.sqrt(np.mean((moved - carried) ** 2)) < 0.02 * np.std(before.particles.position[:, 1])


def test_rotation_is_written_as_hoomd_means_it(key, tmp_path):
    """By its own definitions: the body's axes by q v q*, the angular momentum by q* p / 2 in the
    body's axes."""
    made = dpd.marbles(key, box=6.0, radius=1.5, density=1.0, skin=0.2, dt=0.005, report=None)
    how = made.fluid, made.state, key, 0.005, dpd.Plan(4, 50), dpd.drive(torque=(0.0, 30.0, 20.0))
    ran = dpd.run(*how, out=tmp_path / "turning.gsd", progress=False)
    dpd.write_gsd(
        tmp_path / "memory.gsd", dpd.run(*how, observe=dpd.observe.gsd_record, progress=False)
    )
    inertia = float(made.fluid.value("inertia"))
    product = lambda a, b: np.array(
        [a[0] * b[0] - a[1:] @ b[1:], *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))]
    )
    against = lambda q: q * [1, -1, -1, -1]
    files = [frames_of(tmp_path / name) for name in ("turning.gsd", "memory.gsd")]
    for k, (frame, other) in enumerate(zip(*files, strict=True)):
        beads = frame.particles
        for name in ("orientation", "angmom", "moment_inertia"):
            np.testing.assert_allclose(
                getattr(beads, name), getattr(other.particles, name), rtol=1e-6, atol=1e-6
            )
        assert np.all(beads.orientation[:-1] == [1, 0, 0, 0])
        assert not np.any(beads.angmom[:-1]) and not np.any(beads.moment_inertia[:-1])
        np.testing.assert_allclose(beads.moment_inertia[-1], inertia, rtol=1e-6)
        q, p = beads.orientation[-1].astype(float), beads.angmom[-1].astype(float)
        omega = ran.frames["angular_velocity"][k, 0]
        body = 0.5 * product(against(q), p)
        np.testing.assert_allclose(
            product(product(q, body), against(q)), [0, *(inertia * omega)], rtol=1e-5, atol=1e-4
        )
        axis = product(product(q, np.array([0.0, 0.0, 0.0, 1.0])), against(q))[1:]
        np.testing.assert_allclose(axis, axis_of(ran.frames["orientation"][k, 0]), atol=1e-6)
    assert abs(q[0]) < 0.99, "it has turned"
    blind = dataclasses.replace(ran, frames={name: ran.frames[name] for name in ("step", "time")})
    with pytest.raises(
        ValueError, match="no angular_velocity, image, lengths, orientation, position"
    ):
        dpd.write_gsd(tmp_path / "none.gsd", blind)


def test_freud_opens_it(written, frames):
    freud = pytest.importorskip("freud")
    with gsd.hoomd.open(str(written[0]), "r") as file:
        count = freud.density.RDF(bins=20, r_max=2.0)
        for frame in file:
            count.compute(frame, reset=False)
    assert np.all(np.isfinite(count.rdf)) and count.box.Lx == 5.0
    # The coordination within a distance, counted over all images by hand.
    found = freud.locality.AABBQuery.from_system(frames[3]).query(
        frames[3].particles.position, {"r_max": 1.2, "exclude_ii": True}
    )
    lattice, x = lattice_of(frames[3]), frames[3].particles.position.astype(float)
    shifts = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), -1).reshape(-1, 3) @ lattice
    r = np.linalg.norm(x[:, None, None] - x[None, :, None] + shifts, axis=-1)
    assert len(found.toNeighborList()) == np.sum((r > 0) & (r < 1.2))


@pytest.mark.parametrize("piece", [1, 10])
def test_pieces_change_nothing(piece, to_file, run, written, tmp_path, monkeypatch):
    monkeypatch.setattr(host, "chunk_frames", lambda *_: piece)
    ended = to_file(tmp_path / "other.gsd")
    for name in ("position", "velocity", "force", "image", "step", "time"):
        assert np.array_equal(getattr(ended.final, name), getattr(run.final, name)), name
    assert set(ended.frames) == {*run.frames, "unwrapped"}
    for name, values in run.frames.items():
        near = 1e-6 if name in ("position", "velocity") else 1e-12
        np.testing.assert_allclose(ended.frames[name], values, rtol=near, atol=near)
    assert ended.complete and ended.every == PLAN.every
    assert (tmp_path / "other.gsd").stat().st_size > 0
    for one, other in zip(frames_of(tmp_path / "other.gsd"), frames_of(written[0]), strict=True):
        assert np.array_equal(one.particles.position, other.particles.position)


def test_a_run_in_memory_is_written_alike(run, frames, tmp_path):
    dpd.write_gsd(tmp_path / "memory.gsd", run)
    for one, other in zip(frames_of(tmp_path / "memory.gsd"), frames, strict=True):
        assert one.configuration.step == other.configuration.step
        for name in ("position", "velocity", "image", "mass", "diameter"):
            assert np.array_equal(getattr(one.particles, name), getattr(other.particles, name)), (
                name
            )


def test_a_file_is_gone_on_with(run, fluid, state, tmp_path):
    path = tmp_path / "more.gsd"
    half = lambda part: {name: values[part] for name, values in run.frames.items()}
    for mode, part in (("w", slice(0, 3)), ("r+", slice(3, None))):
        with dpd.gsd_writer(path, fluid, state, mode) as write:
            write(half(part), FLOW)
    assert [f.configuration.step for f in frames_of(path)] == run.frames["step"].tolist()


def test_images_unwrap_without_shear(fluid, state, tmp_path):
    rng = np.random.default_rng(0)
    everywhere = rng.uniform(-20, 20, (1, state.n, 3))
    wrapped, image = boxes.wrap(state.box, jnp.asarray(everywhere[0]))
    frames = {
        "step": [7],
        "time": [0.1],
        "position": [wrapped],
        "velocity": 0 * everywhere,
        "image": [image],
        "strain": [0.0],
    }
    with dpd.gsd_writer(tmp_path / "still.gsd", fluid, state) as write:
        write(frames)
    (frame,) = frames_of(tmp_path / "still.gsd")
    np.testing.assert_allclose(unwrapped(frame) + SIDES / 2, everywhere[0], atol=1e-5)
    assert not np.any(frame.particles.velocity)


@pytest.mark.parametrize("third, kept", [(3, 4), (1, 0)], ids=["in the middle", "at once"])
def test_interrupt_leaves_the_whole_pieces(
    third, kept, to_file, monkeypatch, tmp_path, written, capsys
):
    genuine, count = host.replayed, []

    def interrupted(*arguments):
        count.append(None)
        if len(count) == third:
            raise KeyboardInterrupt
        return genuine(*arguments)

    monkeypatch.setattr(host, "replayed", interrupted)
    monkeypatch.setattr(host, "chunk_frames", lambda *_: 2)
    ended = to_file(tmp_path / "cut.gsd")
    assert not ended.complete and len(count) == third, "and no piece after"
    assert len(ended.frames.get("time", [])) == kept and ended.final.step == 40 * kept
    assert f"interrupted after {kept} of {PLAN.frames} frames" in capsys.readouterr().err
    assert (tmp_path / "cut.gsd").exists() == (kept > 0)
    here = frames_of(tmp_path / "cut.gsd") if kept else []
    for one, other in zip(here, frames_of(written[0])[:kept], strict=True):
        assert np.array_equal(one.particles.position, other.particles.position)


def test_a_run_interrupted_at_once_leaves_an_old_file(to_file, monkeypatch, tmp_path):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(host, "replayed", interrupted)
    (tmp_path / "old.gsd").write_bytes(b"precious")
    assert not to_file(tmp_path / "old.gsd", mode="w").complete
    assert (tmp_path / "old.gsd").read_bytes() == b"precious"


def test_a_failed_run_keeps_the_pieces_before(to_file, monkeypatch, tmp_path):
    genuine, count = host.replayed, []

    def broken(*arguments):
        count.append(None)
        if len(count) == 3:
            raise dpd.RunError("stopped", None)
        return genuine(*arguments)

    monkeypatch.setattr(host, "replayed", broken)
    monkeypatch.setattr(host, "chunk_frames", lambda *_: 2)
    with pytest.raises(dpd.RunError):
        to_file(tmp_path / "cut.gsd")
    assert len(frames_of(tmp_path / "cut.gsd")) == 4


KILLED = """
import os, signal, jax, dpdjax as dpd
from dpdjax.host import stream as host
repulsion = dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)
water = dpd.fluid([repulsion], [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)], kT=1.0)
key, genuine, ran = jax.random.key(0), host.replayed, []
state = dpd.initial_state(water, key, box=3.5, density=3.0)
def killed(*given, **how):
    if len(ran) == 2:
        os.kill(os.getpid(), signal.{name})
    ran.append(None)
    return genuine(*given, **how)
host.replayed, host.chunk_frames = killed, lambda *_: 4
dpd.run(water, state, key, 0.01, dpd.Plan(20, 2), out={path!r}, progress=False)
"""


@pytest.mark.parametrize(
    "name, status, frames", [("SIGTERM", dpd.Stopped.STATUS, 12), ("SIGKILL", -9, 4)]
)
def test_a_killed_run_keeps_the_whole_pieces(name, status, frames, tmp_path):
    """By SIGTERM those that were being computed too; by SIGKILL those that were written, and none
    is torn."""
    path = str(tmp_path / "killed.gsd")
    ended = subprocess.run([sys.executable, "-c", KILLED.format(name=name, path=path)], timeout=300)
    assert ended.returncode == status
    steps = [frame.configuration.step for frame in frames_of(path)]
    assert steps == list(range(2, 2 * len(steps) + 1, 2)) and len(steps) >= frames


def test_a_file_that_is_there_is_never_overwritten_unasked(
    to_file, run, fluid, state, key, written, tmp_path
):
    path = tmp_path / "kept.gsd"
    path.write_bytes(written[0].read_bytes())
    for go, cure in (
        (to_file, r'out=dpd.GSD\(..., mode="w"\) to replace it'),
        (lambda path: dpd.write_gsd(path, run), "overwrite=True to replace it"),
    ):
        with pytest.raises(FileExistsError, match=f"kept.gsd is there already; .* {cure}"):
            go(path)
    with (
        pytest.raises(FileExistsError, match='mode="w" to replace'),
        dpd.gsd_writer(path, fluid, state),
    ):
        pass
    with pytest.raises(ValueError, match="mode is 'r'; it is \"x\" for a new file"):
        dpd.GSD(path, "r")
    with pytest.raises(
        ValueError,
        match="kept.gsd ends at step 320 and the state is at step 0: go on from the final state",
    ):
        to_file(path, mode="a")
    other = dataclasses.replace(run.final, size=0.95 * run.final.size)
    with pytest.raises(ValueError, match="holds 108 beads .* give another file"):
        dpd.run(fluid, other, key, DT, PLAN, FLOW, out=dpd.GSD(path, "a"), progress=False)
    assert path.read_bytes() == written[0].read_bytes()
    more = dpd.GSD(path, "a")
    two = dpd.run(fluid, run.final, key, DT, dpd.Plan(2, 40), FLOW, out=more, progress=False)
    assert two.frames["step"].tolist() == [360, 400] and two.complete
    assert [frame.configuration.step for frame in frames_of(path)] == list(range(40, 401, 40))
    dpd.write_gsd(path, run, overwrite=True)
    assert len(frames_of(path)) == PLAN.frames


def test_what_cannot_be_written(fluid, state, key, run, tmp_path):
    kept = tmp_path / "kept.gsd"
    kept.write_bytes(b"precious")
    numbers = {"fluid": fluid, "state": state, "key": key, "dt": DT, "plan": PLAN}
    file = dpd.GSD(kept, "w")
    go = lambda **how: dpd.run(**numbers | how, out=file, progress=False)
    for how in (
        {"key": jax.random.split(key, 2)},
        {"fluid": fluid.set(kT=jnp.array([1.0, 2.0]))},
        {"dt": jnp.array([DT, DT])},
        {"state": jax.tree.map(lambda x: jnp.stack([x, x]), state)},
    ):
        with pytest.raises(ValueError, match="a GSD file holds one run|give 2 keys"):
            go(**how)
    with pytest.raises(ValueError, match="dt 5 is too large"):
        go(dt=5.0)
    with pytest.raises(TypeError, match="plan is 3"):
        go(plan=3)
    assert kept.read_bytes() == b"precious", "errors that can be told before leave the file alone"
    batch = dpd.Trajectory(
        jax.tree.map(lambda x: jnp.stack([x, x]), run.final), run.frames, System.of(fluid, DT, FLOW)
    )
    with pytest.raises(
        ValueError,
        match=r"one run; write the members of a batch one by one, trajectory.members\(\)",
    ):
        dpd.write_gsd(kept, batch)
    blind = dpd.Trajectory(
        run.final,
        {k: v for k, v in run.frames.items() if k not in ("image", "strain")},
        System.of(fluid, DT, FLOW),
    )
    with pytest.raises(
        ValueError, match="recorded no image, strain; use observe=dpd.observe.gsd_record"
    ):
        dpd.write_gsd(kept, blind)


def test_a_missing_package_is_named(fluid, state, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "gsd.hoomd", None)
    with (
        pytest.raises(ImportError, match="pip install gsd"),
        dpd.gsd_writer(tmp_path / "none.gsd", fluid, state),
    ):
        pass
    assert importlib.util.find_spec("gsd") is not None
