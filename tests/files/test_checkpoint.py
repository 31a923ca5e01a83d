"""A run that is stopped, however it is, and begun again ends as if it had never stopped; and what
is not that run is told."""

import dataclasses
import os
import signal
import subprocess
import sys
import time

import gsd.hoomd
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.files import checkpoint as points
from dpdjax.files.gsd import reading

host = sys.modules[dpd.stream.__module__]
PLAN, FLOW, DT = dpd.Plan(12, 5), dpd.shear(0.3), 0.01
OFTEN = 1e-9
"""Seconds between two savings, so that there is one at every piece."""
pytestmark = pytest.mark.filterwarnings("ignore:the run ends at", "ignore:the later half")


@pytest.fixture(scope="module", autouse=True)
def pieces():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(host, "chunk_frames", lambda *_: 2)
        yield


@pytest.fixture
def run(water, fresh, key, tmp_path):
    """``run(**how)``: a sheared box that saves itself."""

    def go(plan=PLAN, fluid=water, state=fresh, key=key, dt=DT, flow=FLOW, **how):
        how = {"checkpoint": dpd.Checkpoint(tmp_path / "saved", OFTEN), "progress": False} | how
        return dpd.run(fluid, state, key, dt, plan, flow, **how)

    return go


def same_bits(a, b):
    a, b = (dataclasses.replace(x, neighbours=()) for x in (a, b))
    return all(jnp.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b)))


def interrupted(pieces: int):
    """A callback that presses Ctrl-C after some pieces."""
    seen = []

    def callback(piece):
        seen.append(piece)
        if len(seen) == pieces:
            os.kill(os.getpid(), signal.SIGINT)

    return callback


def steps_of(path):
    with gsd.hoomd.open(str(path), "r") as file:
        return [frame.configuration.step for frame in file]


@pytest.mark.parametrize("to_file", [False, True], ids=["in memory", "to a file"])
def test_interrupted_again_and_again(run, to_file, tmp_path, capsys):
    whole = run(checkpoint=None)
    how = {"out": tmp_path / "run.gsd"} if to_file else {}
    for count in (1, 2):
        part = run(callback=interrupted(count), **how)
        assert not part.complete and "interrupted by SIGINT" in capsys.readouterr().err
    assert part.frames["step"].tolist() == [5, 10, 15, 20, 25, 30]
    for _ in range(2):  # the second finds it finished
        ended = run(**how)
        assert ended.complete and same_bits(ended.final, whole.final)
        for name, values in whole.frames.items():
            np.testing.assert_array_equal(ended.frames[name], values)
    longer = run(dpd.Plan(16, 5), **how)
    assert same_bits(longer.final, run(dpd.Plan(16, 5), checkpoint=None).final)
    if to_file:
        assert steps_of(tmp_path / "run.gsd") == list(range(5, 81, 5))


def test_a_batch(run, key):
    keys, flow = jax.random.split(key, 2), dpd.shear(jnp.array([0.3, 90.0]))
    whole = run(key=keys, flow=flow, checkpoint=None)
    run(key=keys, flow=flow, callback=interrupted(3))
    ended = run(key=keys, flow=flow)
    assert ended.failed == whole.failed and ended.failed[0][0] == 1
    assert same_bits(ended.survivors.final, whole.survivors.final)
    for name, values in whole.frames.items():
        np.testing.assert_array_equal(ended.frames[name], values)


def test_uneven_frames(run, tmp_path):
    plan, out = dpd.Plan.logarithmic(60, per_decade=5), tmp_path / "log.gsd"
    whole = run(plan, checkpoint=None)
    run(plan, out=out, callback=interrupted(2))
    ended = run(plan, out=out)
    assert same_bits(ended.final, whole.final) and steps_of(out) == list(plan.schedule)
    later = dpd.Plan.at([*plan.schedule, 90, 100])
    assert same_bits(run(later, out=out).final, run(later, checkpoint=None).final)
    with pytest.raises(dpd.FileError, match="plan: frames at .* then, at .* now"):
        run(dpd.Plan.at([*range(1, 30), 60]), out=out)
    with pytest.raises(dpd.FileError, match="plan: 11 frames were done, and it has 3 now"):
        run(dpd.Plan.at([1, 2, 60]), out=out)


def test_hours_end_a_run(run, capsys):
    part = run(hours=1e-9)
    assert not part.complete and len(part.frames["step"]) == 2
    assert "interrupted by 1e-09 hours after 2 of 12 frames" in capsys.readouterr().err
    assert run(hours=1.0).complete
    with pytest.raises(ValueError, match="hours is -1; it must be above zero"):
        run(hours=-1)


def stretched(h, *, a):
    return 0.5 * a * jnp.maximum(0.0, 1.0 - h) ** 2


def test_another_run_is_told_by_what_differs(run, water, fresh, key, tmp_path):
    run()
    other = dpd.initial_state(water, jax.random.key(8), box=3.5, density=3.0, skin=0.3)
    of_function = dpd.fluid(
        [dpd.term(stretched, a=25.0, reach=1.0)], list(water.interactions[0].drag), kT=1.0
    )
    faster = dataclasses.replace(fresh, velocity=3 * fresh.velocity)
    turned = dataclasses.replace(fresh, position=fresh.position[::-1])
    for how, told in (
        ({"fluid": water.set(gamma=5.0)}, "gamma: 4.5 then, 5.0 now"),
        ({"fluid": of_function}, "law"),
        ({"dt": 0.009}, "dt: 0.01 then, 0.009 now"),
        ({"flow": dpd.shear(0.4)}, "rate: 0.3 then, 0.4 now"),
        ({"flow": None}, "flow.deformation"),
        ({"key": jax.random.key(1)}, "key.key"),
        ({"plan": dpd.Plan(12, 4)}, "plan: frames at 5 then, at 4 now"),
        ({"observe": dpd.observe.temperature}, "observe"),
        ({"integrator": dpd.integrators.ImplicitDrag()}, "integrator"),
        ({"out": tmp_path / "run.gsd"}, "out.file: None then, run.gsd now"),
        ({"state": turned}, "it began with other places of its beads"),
        ({"state": faster}, "it began with other velocities of its beads"),
        ({"state": other}, "beads"),
    ):
        with pytest.raises(dpd.FileError, match=f"of another run: .*{told}.*or another folder"):
            run(**how)
    nearly = dataclasses.replace(fresh, position=fresh.position * (1 - 1e-9))
    assert run(state=nearly).complete, "rounding of another processor is no difference"


def test_another_version_or_precision(run, monkeypatch, tmp_path):
    run()
    monkeypatch.setattr(points.dpdjax, "__version__", "9.9")
    with pytest.raises(dpd.FileError, match="version: .* then, 9.9 now"):
        run()
    monkeypatch.undo()
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(dpd.FileError, match="holds float64; start with JAX_ENABLE_X64=1"):
            points.Checkpoint(tmp_path / "saved").load()
    finally:
        jax.config.update("jax_enable_x64", True)


def test_damaged_files(run, tmp_path):
    out = tmp_path / "run.gsd"
    run(out=out)
    state, before = tmp_path / "saved" / "state.npz", out.read_bytes()
    whole = state.read_bytes()
    for damaged in (
        b"",
        b"hello",
        whole[:1000],
        whole[:-40],
        whole[:5000] + b"x" * 400 + whole[5400:],
    ):
        state.write_bytes(damaged)
        with pytest.raises(dpd.FileError, match="state.npz .*To begin anew give another folder"):
            run(out=out)
    assert out.read_bytes() == before
    state.write_bytes(whole)
    out.write_bytes(before[: len(before) // 2])
    with pytest.raises(dpd.FileError, match="run.gsd"):
        run(out=out)
    out.unlink()
    with pytest.raises(dpd.FileError, match="run.gsd is gone"):
        run(out=out)
    run(dpd.Plan(2, 5), checkpoint=None, out=out)
    with pytest.raises(dpd.FileError, match="holds 2 frames and its checkpoint is at frame 12"):
        run(out=out)
    out.write_bytes(before)
    assert run(out=out).complete


def test_frames_that_are_gone(run, tmp_path):
    run()
    (part, *_) = (tmp_path / "saved").glob("frames-*.npz")
    part.unlink()
    with pytest.raises(dpd.FileError, match="lacks some of its 12 frames; begin anew"):
        run()


def test_places_that_cannot_be_written(run, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(dpd.FileError, match="checkpoint .*file.* cannot be written"):
        run(checkpoint=tmp_path / "file")
    with pytest.raises(dpd.FileError, match="there is no folder .*nowhere"):
        run(checkpoint=None, out=tmp_path / "nowhere" / "run.gsd")
    with pytest.raises(ValueError, match="out is 'run.xyz'; give the name of a GSD file"):
        run(out="run.xyz")
    for name in ("out", "checkpoint"):
        with pytest.raises(TypeError, match=f"{name} is 3; give"):
            run(**{name: 3})


SMALL = """
import sys, jax, dpdjax as dpd
from dpdjax.host import stream
stream.CHUNK, stream.LEAST = 1, 10
repulsion = dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)
water = dpd.fluid([repulsion], [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)], kT=1.0)
key = jax.random.key(0)
state = dpd.initial_state(water, key, box=3.5, density=3.0)
flow = dpd.shear(0.5)
go = lambda folder, frames=2000: dpd.run(water, state, key, 0.01, dpd.Plan(frames, 2), flow,
    out=folder + "/run.gsd", checkpoint=dpd.Checkpoint(folder + "/saved", 1e-9), progress=False)
"""


def python(code, folder, **how):
    command = [sys.executable, "-W", "ignore", "-c", SMALL + code, str(folder)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **how)


def wait_for(path, frames=40):
    """Until a file holds so many frames, read as it is written."""
    for _ in range(1200):
        if path.exists():
            with reading(path) as file:
                if len(file) >= frames:
                    return
        time.sleep(0.05)
    raise TimeoutError(path)


def test_killed_and_terminated(tmp_path):
    """Three times by SIGKILL and SIGTERM at moments of their own; a file that another process
    writes is refused meanwhile."""
    path = tmp_path / "run.gsd"
    code = "go(sys.argv[1])"
    for number, signal_, frames in (
        (0, signal.SIGKILL, 40),
        (1, signal.SIGTERM, 400),
        (2, signal.SIGKILL, 900),
    ):
        process = python(code, tmp_path)
        wait_for(path, frames)
        if number == 0:
            process.send_signal(signal.SIGSTOP)
            second = python(code, tmp_path)
            assert "is being written by another process" in second.communicate(timeout=100)[1]
        process.send_signal(signal_)
        process.communicate(timeout=100)
        expected = dpd.Stopped.STATUS if signal_ == signal.SIGTERM else -signal_
        assert process.returncode == expected
    assert python(code, tmp_path).wait(200) == 0
    (tmp_path / "whole").mkdir()
    assert python(code, tmp_path / "whole").wait(200) == 0
    assert steps_of(path) == steps_of(tmp_path / "whole" / "run.gsd") == list(range(2, 4001, 2))
    folders = tmp_path / "saved", tmp_path / "whole" / "saved"
    assert same_bits(*(points.Checkpoint(folder).load().state for folder in folders))


FULL = """
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
go(sys.argv[1], 10)
resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, resource.RLIM_INFINITY))
go(sys.argv[1])
"""


def test_a_full_disk(tmp_path):
    """Files may not grow beyond a size: what was written before is there, and can be gone on with
    when there is room."""
    process = python(FULL, tmp_path)
    told = process.communicate(timeout=200)[1].strip().splitlines()[-1]
    assert process.returncode == 1 and "FileError" in told and "cannot be written" in told
    there = steps_of(tmp_path / "run.gsd")
    assert there == list(range(2, 2 * len(there) + 1, 2)) and len(there) >= 10
    assert python("go(sys.argv[1], 60)", tmp_path).wait(200) == 0
    assert steps_of(tmp_path / "run.gsd") == list(range(2, 121, 2))


def test_killed_before_the_first_saving(run, tmp_path):
    """What a run had begun to write is its own."""
    out = tmp_path / "run.gsd"
    seldom = dpd.Checkpoint(tmp_path / "saved", 1e9)

    def killed(piece):
        raise SystemError

    with pytest.raises(SystemError):
        run(out=out, checkpoint=seldom, callback=killed)
    (tmp_path / "saved" / "frames-0000000004.npz.part").touch()
    assert run(out=out, checkpoint=seldom).complete and steps_of(out) == list(range(5, 61, 5))


def test_a_file_that_another_run_went_on_with(run, tmp_path):
    """It is neither cut nor taken for that of its checkpoint."""
    out = tmp_path / "run.gsd"
    first = run(dpd.Plan(6, 5), out=out)
    more = dpd.GSD(out, "a")
    second = run(dpd.Plan(6, 5), state=first.final, out=more, checkpoint=tmp_path / "second")
    assert second.frames["step"].tolist() == list(range(35, 61, 5))
    with pytest.raises(dpd.FileError, match="was gone on with by another run, after frame 6"):
        run(dpd.Plan(6, 5), out=out)
    again = run(dpd.Plan(8, 5), state=first.final, out=more, checkpoint=tmp_path / "second")
    assert again.complete and steps_of(out) == list(range(5, 71, 5))
    with pytest.raises(dpd.FileError, match="no longer the file that these frames"):
        run(dpd.Plan(6, 5), checkpoint=None, out=dpd.GSD(out, "w"))
        np.asarray(first.frames["temperature"])


def test_a_file_of_another_run(run, tmp_path):
    run(dpd.Plan(6, 5), out=tmp_path / "run.gsd")
    other = tmp_path / "other"
    other.mkdir()
    run(dpd.Plan(6, 5), key=jax.random.key(5), out=other / "run.gsd", checkpoint=None)
    (tmp_path / "run.gsd").write_bytes((other / "run.gsd").read_bytes())
    with pytest.raises(dpd.FileError, match="is of another run than its checkpoint: key"):
        run(dpd.Plan(8, 5), out=tmp_path / "run.gsd")
    with pytest.raises(dpd.FileError, match="out.species: None then, 0 now"):
        run(dpd.Plan(8, 5), out=dpd.GSD(tmp_path / "run.gsd", species=0))


def test_everything_that_is_observed_comes_back(water, fresh, key, tmp_path):
    """Under any name, of any shape and kind."""

    def odd(fluid, state):
        return {
            "rate": 2.0 * state.time,
            "velocity": 2.0 * state.velocity,
            "orientation": state.position[0],
            "up": state.position[:, 1] > 1.75,
            "file": state.step,
            "many": jnp.ones((2, 3, 4, 5)) * state.time,
            "small": state.position[:2, 0].astype(jnp.float16),
        }

    observe = [odd, dpd.mean(lambda fluid, state: {"position": state.position})]
    go = lambda **how: dpd.run(
        water, fresh, key, DT, dpd.Plan(4, 2), FLOW, observe=observe, progress=False, **how
    )
    memory, file = go(), go(out=tmp_path / "odd.gsd")
    saved = go(checkpoint=tmp_path / "odd")
    for name, values in memory.frames.items():
        for other in (file, saved):
            assert other.frames[name].dtype == values.dtype, name
            np.testing.assert_array_equal(other.frames[name], values, name)
    np.testing.assert_allclose(
        dpd.load_gsd(tmp_path / "odd.gsd", fluid=water).velocity, memory.final.velocity, atol=1e-5
    )
    with pytest.raises(TypeError, match="'z' is recorded as complex.*, which files do not hold"):
        dpd.run(
            water, fresh, key, DT, PLAN, out=tmp_path / "z.gsd", progress=False,
            observe=lambda fluid, state: {"z": state.time * 1j},
        )  # fmt: skip


def test_a_failed_member_stays_failed(run, key):
    """It was run again at each piece, and a shorter last one could survive."""
    keys, flow = jax.random.split(key, 2), dpd.shear(jnp.array([0.3, 60.0]))
    ran = run(dpd.Plan(7, 5), key=keys, flow=flow, checkpoint=None)
    lost = np.isnan(ran.frames["temperature"][1])
    assert ran.failed and lost.any() and np.all(lost[np.argmax(lost) :])
