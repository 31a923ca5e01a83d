"""One point of a calibration: a number and its slope, measured in a batch of boxes."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.calibration.goal import Goal, check_observed
from dpdjax.calibration.picture import draw_measurement
from dpdjax.engine import status as bits
from dpdjax.engine.choice import suited
from dpdjax.engine.chunk import batched, begun, complete_lists, replayed, shape_of, trips_of
from dpdjax.engine.integrator import Integrator, VelocityVerlet
from dpdjax.engine.members import called
from dpdjax.engine.observables import standard
from dpdjax.engine.record import mean, recorders
from dpdjax.engine.refusals import check_dt, check_run, fitted
from dpdjax.engine.simulate import proceed
from dpdjax.engine.state import grow
from dpdjax.engine.system import System
from dpdjax.engine.trajectory import Plan
from dpdjax.errors import RunError, warn
from dpdjax.measure.molecules import molecules_of
from dpdjax.measure.needs import FLUCTUATIONS, HOT, WARM, fluctuation
from dpdjax.measure.statistics import Estimate, block_average, from_replicas
from dpdjax.measure.viscosity import controlled
from dpdjax.model.advice import suggest_dt, suggest_skin
from dpdjax.model.laws import central_drag
from dpdjax.model.rates import (
    damping_rate,
    extreme,
    over,
    repulsion_energy,
    stiffness,
    thermal_length,
    thermal_time,
)
from dpdjax.model.term import term
from dpdjax.pairs.noise import Domain
from dpdjax.prepare.start import initial_state
from dpdjax.xla import each_member

PIECE, PIECE_TIME = Plan(frames=25, every=40), 0.5
"""A run is extended by whole pieces until its error bar is met: of so many steps at most, and of
about so many thermal times."""
LEAST_PIECES, LEAST_BLOCKS = 16, 8
"""Pieces and blocks of the shortest run, over all boxes."""
BLOCKS = 32
"""Blocks an error is read off, over all boxes, or fewer that are longer."""
REMEMBERED, IDLE = 2.0, 6.0
"""Thermal times a block spans at least, and how many more where strong drag, and no repulsion,
rules the structure. In the colloid solvent (a 2.5, kT 0.1, gamma 50) blocks of a fifth of one gave
errors a sixth too small; at (a 0, kT 1, gamma 92) blocks of two a fifth."""
WINDOW_FRAMES = 16


@dataclasses.dataclass
class Ensemble:
    """Boxes that stay in their stationary state from one point to the next.

    Attributes:
        fluid: the fluid at its first guess.
        goal: what is measured.
        density: beads per volume.
        state: a batch of states.
        keys: one noise key per box.
        dt: fixed time step, or None to follow the drag.
        integrator: how the boxes move on in time.
        memory: ``memory(fluid)``, how long slow parts of the matter remember, as chains do [time];
            blocks last as long at least.
        steps: particle-steps spent so far.
        report: ``report(text)`` is told of the progress.
    """

    fluid: Any
    goal: Goal
    density: float
    state: Any
    keys: Any
    dt: float | None = None
    integrator: Integrator = VelocityVerlet()
    memory: Callable = lambda fluid: 0.0
    steps: int = 0
    report: Callable = lambda text: None

    def step_for(self, fluid) -> float:
        if self.dt is not None:
            return self.dt
        return suggest_dt(fluid, self.density, integrator=self.integrator)

    def system_of(self, fluid, dt: float) -> System:
        """A fluid in the flow of the goal."""
        return System.of(fluid, dt, self.goal.flow, self.integrator)

    @property
    def beads(self) -> int:
        return int(np.prod(self.state.position.shape[:2]))


def begin_afresh(ensemble):
    """Let the boxes go on with noise that no earlier measurement has seen."""
    fresh = lambda key: jax.random.fold_in(key, Domain.FRESH_RUN)
    ensemble.keys = jax.vmap(fresh)(ensemble.keys)


def prepare(
    fluid,
    goal: Goal,
    key,
    *,
    density,
    side,
    boxes,
    dt=None,
    integrator=None,
    report=lambda text: None,
) -> Ensemble:
    """A batch of boxes in equilibrium.

    Equilibrium does not depend on the drag, so the boxes are equilibrated with a weak one
    and a long step, for five thermal times at least.

    Raises ValueError for a fluid of several groups, whose boxes would be filled with as many of
    each, or with bonds.
    """
    if fluid.bonded:
        raise ValueError(
            "this fluid has bonds, and which beads they are between is not in it: give a state of "
            "it to begin from, state=..."
        )
    if fluid.has_radii or len(fluid.interactions) > 1:
        raise ValueError(
            "this measures one kind of bead, and the fluid has colloids or groups: give "
            "dpd.pure_solvent(fluid), or a state to begin from, state=..."
        )
    build_key, noise_key = jax.random.split(key)
    integrator, step = suited(fluid, density, integrator=integrator, dt=dt)
    skin = suggest_skin(fluid, step, passes=integrator.cost)
    build = functools.partial(initial_state, fluid, box=side, density=density, skin=skin)
    state = jax.vmap(build)(jax.random.split(build_key, boxes))
    _check_dt(System.of(fluid, step, None, integrator), state)
    check_observed(goal, fluid, jax.tree.map(lambda leaf: leaf[0], state))
    keys = jax.random.split(noise_key, boxes)
    ensemble = Ensemble(
        fluid, goal, density, complete_lists(state), keys, dt, integrator, report=report
    )
    _equilibrate(ensemble)
    return ensemble


def adopt(
    fluid,
    goal: Goal,
    key,
    *,
    state,
    boxes,
    dt=None,
    integrator=None,
    memory=None,
    report=lambda text: None,
) -> Ensemble:
    """A batch of boxes that begin as one state, and go on until they are strangers.

    ``memory``: how long that takes, by default as long as the molecules of the state remember.
    Raises ValueError for colloids without one.
    """
    if fluid.has_radii and memory is None:
        raise ValueError(
            "how long a suspension remembers is not known: give memory=, its diffusion time or the "
            "part of it that matters"
        )
    density = state.n / float(state.box.volume)
    integrator, step = suited(fluid, density, integrator=integrator, dt=dt)
    state = complete_lists(fitted(fluid, state.restarted()))
    check_run(System.of(fluid, step, None, integrator), state, key)
    check_observed(goal, fluid, state)
    keys = jax.random.split(key, boxes)
    memory_of = memory_in(state, memory)
    own = {"memory": memory_of, "report": report}
    ensemble = Ensemble(fluid, goal, density, batched(state, keys), keys, dt, integrator, **own)
    plan = piece(fluid, step)
    times = max(5 * thermal_time(fluid), STRANGERS * memory_of(fluid)) / (step * plan.steps)
    for _ in range(math.ceil(times)):
        _extend(ensemble, fluid, step, plan)
    return ensemble


STRANGERS = 2.0
"""Memories after which boxes that began as one have nothing in common."""
CROWDED = 2.0
"""By which beads that repel each other rub more than drag alone does: water's beads diffuse half as
fast as its drag would let them."""


def memory_in(state, memory: float | None = None) -> Callable:
    """``memory(fluid)`` of a state: that of its molecules where no time is given."""
    return lambda fluid: chain_memory(fluid, state) if memory is None else memory


def chain_memory(fluid, state) -> float:
    """The longest relaxation time of the molecules of a state by the model of Rouse, ``zeta b^2 /
    (12 kT sin^2(pi / 2 N))`` (Doi & Edwards 1986, section 4.1) [time]; 0 without bonds.

    The friction is twice that of the drag, for beads that repel each other; ``b^2`` is that of
    bonds as stiff as angles make them, of a rod at most.
    """
    if state.topology is None or not _bonds(fluid, state):
        return 0.0
    numbers, density = extreme(fluid), state.n / float(state.box.volume)
    longest = max(molecule.length for molecule in molecules_of(state))
    bond = max(thermal_length(numbers, b) for b in _bonds(numbers, state))
    swollen = min(stiffness(numbers), float(longest))
    friction = CROWDED * float(np.max(numbers.mass)) * damping_rate(numbers, density)
    slowest = 12.0 * float(numbers.kT) * math.sin(0.5 * math.pi / longest) ** 2
    return over(friction * swollen * bond**2, slowest)


def _bonds(fluid, state) -> list:
    """The types of bonds that a state has any of."""
    counts = state.topology.counts
    return [b for b in fluid.bonded if b.kind == "bond" and counts.get(b.name)]


EQUILIBRATION = Plan(10, 50)
WEAK = 1.9
"""Damping rate of the drag that equilibrates, in inverse thermal times: that of gamma 4.5 in units
of one at density 3."""


def _equilibrate(ensemble):
    weak = weakly_damped(ensemble.fluid, ensemble.density)
    thermal = thermal_time(weak)
    dt = min(0.01 * thermal, 2 * suggest_dt(weak, ensemble.density))
    for _ in range(math.ceil(5 * thermal / (dt * EQUILIBRATION.steps) * (1 - 1e-6))):
        ensemble.state, _ = replay(ensemble, System.of(weak, dt), EQUILIBRATION, standard)
        ensemble.steps += EQUILIBRATION.steps * ensemble.beads


def weakly_damped(fluid, density: float):
    """The fluid of one kind of bead with its potentials, and in place of its drag one that
    equilibrates fast."""
    (among,) = fluid.interactions
    reach, mass, thermal = max(fluid.reaches()), float(jnp.min(fluid.mass)), thermal_time(fluid)
    # omega = 4 pi gamma density r_c^3 / 90 m for zeta = gamma w^2.
    gamma = WEAK / thermal * 90 * mass / (4 * math.pi * density * reach**3)
    drag = term(central_drag, gamma=gamma, r_c=reach)
    return dataclasses.replace(
        fluid, interactions=(dataclasses.replace(among, drag=(drag,), random=None),)
    )


@dataclasses.dataclass(frozen=True)
class Measurement:
    """A measured number and how it came about.

    Attributes:
        estimate: the number with its standard error.
        series: its values over time in each box, (boxes, frames).
        time: time of each frame since the start of the measurement.
        dt, rate: time step and shear rate.
        temperature: mean kinetic temperature, where the goal records it.
        particle_steps: what it took.
        seconds: wall time.
        compile_seconds: what of it was making programs.
        name: of the number.
    """

    estimate: Estimate
    series: Any
    time: Any
    dt: float
    rate: float
    particle_steps: int
    seconds: float = math.nan
    compile_seconds: float = math.nan
    temperature: float = math.nan
    name: str = "viscosity"

    def plot(self, ax=None):
        """Draw the running mean with its final error; returns the axes."""
        return draw_measurement(self, ax)

    def __str__(self):
        cost = f"{self.particle_steps:.2g} particle-steps, {self.seconds:.0f} s"
        return f"{self.estimate} ({cost}, dt {self.dt:.3g}, rate {self.rate:.3g})"


FAR = 8.0
"""Standard errors off the target at which a point that only shows the way is good enough."""


def measure(
    ensemble: Ensemble, fluid, error: float, settle: float, most: int, report, far: float = math.inf
) -> Measurement:
    """Run until the mean of the goal has the wanted standard error, or is ``far`` of them off its
    target.

    Args:
        ensemble: the boxes; they are moved along.
        fluid: the fluid now.
        error: wanted standard error.
        settle: time left out at the start.
        most: particle-steps at most.
        report: ``report(text)``, told of the progress.
        far: by default no distance is far enough.
    """
    dt = ensemble.step_for(fluid)
    _check_dt(ensemble.system_of(fluid, dt), ensemble.state)
    plan = piece(fluid, dt)
    piece_time = dt * plan.steps
    for _ in range(math.ceil(max(settle, ensemble.memory(fluid)) / piece_time)):
        _extend(ensemble, fluid, dt, plan)
    series, noise, heat, spent = [], [], [], 0
    memory = max(remembered(fluid, ensemble.density), ensemble.memory(fluid))
    block = math.ceil(memory / piece_time)
    pieces = -(-max(LEAST_PIECES, LEAST_BLOCKS * block) // ensemble.state.position.shape[0])
    cost = max(pieces * plan.steps * ensemble.beads, _cost(ensemble, fluid, error, dt))
    report(f"about {min(cost, most):.1g} particle-steps for {ensemble.goal.name} to {error:.2g}")
    while True:
        frames = _extend(ensemble, fluid, dt, plan)
        spent += plan.steps * ensemble.beads
        heat.append(np.mean(frames.get("temperature", math.nan)))
        _refuse_heat(ensemble, fluid, dt, heat[-1])
        series.append(frames["value"])
        noise.append(frames.get("noise"))
        if len(series) < pieces and spent < most:
            continue
        estimate = _estimate(series, noise, ensemble.goal.scale, block)
        enough = max(error, abs(estimate.value - ensemble.goal.target) / far)
        report(f"{ensemble.goal.name} {estimate}, wanted error {enough:.2g}")
        if estimate.error <= enough or spent >= most:
            break
        pieces = planned(len(series), estimate.error / enough)
    # What short runs of few beads scatter by is no heat.
    _tell_heat(ensemble, fluid, dt, np.mean(heat) - 2 * np.std(heat) / math.sqrt(len(heat)))
    count = len(series) * plan.frames
    times = dt * plan.every * np.arange(1, count + 1)
    values = ensemble.goal.scale * np.concatenate(series, axis=1)
    rate, temperature = float(ensemble.goal.flow.rate), float(np.mean(heat))
    spent = ensemble.steps
    return Measurement(
        estimate, values, times, dt, rate, spent, temperature=temperature, name=ensemble.goal.name
    )


def _cost(ensemble, fluid, error: float, dt: float) -> float:
    """Particle-steps that a viscosity to a standard error takes; 0 of what is no viscosity, of
    which nothing is known before.

    A mean stress of a volume V over a time t scatters by ``sqrt(2 viscosity kT/(V t))``, as of
    Green and Kubo, whatever the fluid.
    """
    goal = ensemble.goal
    rate = float(goal.flow.rate)
    if goal.name != "viscosity" or rate == 0 or error <= 0:
        return 0.0
    volume = ensemble.beads / ensemble.density
    time = 2 * abs(goal.target) * float(fluid.kT) / (volume * (rate * error) ** 2)
    return time / dt * ensemble.beads


def _tell_heat(ensemble, fluid, dt, temperature):
    """Warn where the whole measurement was warmer than the wanted fluid."""
    if math.isnan(temperature) or temperature <= (1 + WARM) * float(fluid.kT):
        return
    warn(
        f"{ensemble.goal.name} was measured {100 * (temperature / float(fluid.kT) - 1):.0f} % "
        f"above kT, with shear rate {float(ensemble.goal.flow.rate):.3g} and dt {dt:.3g}: give a "
        "smaller rate= or dt=",
    )


def _refuse_heat(ensemble, fluid, dt, temperature):
    """Raise where the flow, or too long a step, keeps the beads far from kT."""
    if math.isnan(temperature):
        return
    kT = float(fluid.kT)
    # A mean over a few beads and a short piece is off by chance.
    chance = FLUCTUATIONS * fluctuation(3 * ensemble.beads)
    if temperature > (1 + HOT + chance) * kT:
        raise RunError(
            f"the fluid runs at a temperature of {temperature:.3g} instead of kT = {kT:.3g}, with "
            f"shear rate {float(ensemble.goal.flow.rate):.3g} and dt {dt:.3g}: give a smaller "
            "rate= or dt="
        )


def _check_dt(system: System, state):
    """What a run would refuse of the integrator and its step, for a batch of boxes, which are
    alike; a fixed step may not suit the next drag."""
    one = jax.tree.map(lambda leaf: leaf[0], state)
    system.integrator.check(system.fluid)
    check_dt(system, one)


def remembered(fluid, density: float) -> float:
    """How long a stress is remembered [time]."""
    thermal = thermal_time(fluid)
    slow = damping_rate(fluid, density) * thermal / 20.0
    hard = repulsion_energy(fluid, density) / float(fluid.kT) if float(fluid.kT) > 0 else 0.0
    return thermal * (REMEMBERED + IDLE * slow / ((1.0 + slow) * (1.0 + hard)))


def piece(fluid, dt: float) -> Plan:
    """The plan by which a run is extended; those of all fluids are one program."""
    every = round(PIECE_TIME * thermal_time(fluid) / (dt * PIECE.frames))
    return Plan(PIECE.frames, min(max(1, every), PIECE.every))


def _extend(ensemble, fluid, dt, plan):
    system, observe = ensemble.system_of(fluid, dt), ensemble.goal.observe
    ensemble.state, frames = replay(ensemble, system, plan, mean(observe))
    ensemble.steps += plan.steps * ensemble.beads
    return jax.device_get(frames)


def replay(ensemble, system: System, plan, observe):
    """:func:`replayed` from the states of an ensemble, with an error where growth could not repair
    the run."""
    say = lambda: ensemble.report("compiling")
    after, frames = replayed(
        system, ensemble.state, ensemble.keys, plan, tuple(recorders(observe)), compiling=say
    )
    trouble = bits.describe(after.status)
    if trouble:
        raise RunError(f"the calibration stopped: {trouble}")
    return after, frames


LEAST, CAUTION = 1.15, 0.6
"""Least growth of a run that is not good enough, and the share of a long way to go before its
length is planned anew."""


def planned(pieces: int, ratio: float) -> int:
    """Pieces to run, for one whose error is ``ratio`` times the wanted one after ``pieces``.

    A run is looked at seldom, and where its error is far from small enough: whoever stops at the
    first estimate of an error that will do picks one that is too small (by a fifth with 16 blocks
    looked at after every piece).
    """
    growth = ratio**2 if ratio**2 < 2.0 else max(CAUTION * ratio**2, 1.5)
    return math.ceil(pieces * min(max(growth, LEAST), 16.0))


def _estimate(series, noise, scale, block: int) -> Estimate:
    """Mean with an error that covers though it is read off few blocks, each of as many pieces at
    least.

    Student's t of ``n`` blocks scatters as ``sqrt((n - 1)/(n - 3))``, and the control variate takes
    one degree of freedom.
    """
    blocks, fitted = min(BLOCKS, max(1, len(series) // block) * len(series[0])), 0
    series = scale * np.concatenate(series, axis=1)
    if noise[0] is not None:
        series, fitted = controlled(series, np.concatenate(noise, axis=1), blocks), 1
    return widened(block_average(series, blocks), fitted)


def widened(found: Estimate, fitted: int = 0) -> Estimate:
    """With an error that covers though it is read off few blocks, as Student's t scatters;
    ``fitted`` numbers were told by the same blocks."""
    wide = math.sqrt((found.blocks - 1) / max(found.blocks - 3 - fitted, 1))
    return dataclasses.replace(found, error=found.error * wide)


def window_time(fluid, density: float) -> float:
    """How long a tangent is followed: four velocity damping times, at most 0.7 thermal times.

    Longer windows gain nothing: the tangent has reached its plateau, and its noise grows
    as ``exp(2.8 t)`` at a = 0 and ``exp(4 t)`` in water, in thermal times (measured:
    tests/physics/RESULTS.md).
    """
    damping = damping_rate(fluid, density)
    return (
        min(0.7 * thermal_time(fluid), 4.0 / damping) if damping > 0 else 0.7 * thermal_time(fluid)
    )


def measure_slopes(
    ensemble: Ensemble, fluid, names: tuple[str, ...], windows: int
) -> list[Estimate]:
    """Slopes of the goal in the logarithm of each parameter, from short tangent windows.

    Starts in the stationary state of ``fluid``, switches the tangent on and follows
    ``d value / d ln parameter`` by forward mode; the boxes move along.
    """
    dt = ensemble.step_for(fluid)
    every = max(1, round(window_time(fluid, ensemble.density) / dt / WINDOW_FRAMES))
    plan = Plan(WINDOW_FRAMES, every)
    tangents = [[] for _ in names]
    for _ in range(windows):
        for k in range(len(names)):
            slopes = window_tangents(ensemble, fluid, names, k, dt, plan)
            tangents[k].append(ensemble.goal.scale * np.asarray(slopes, float))
            ensemble.steps += plan.steps * ensemble.beads
    return [plateau(np.concatenate(t)) for t in tangents]


def window_tangents(ensemble, fluid, names, k, dt, plan):
    """One window for all boxes along parameter ``k`` of those named, replayed with larger lists
    where one overflows."""
    shape = shape_of(plan, ensemble.beads)
    trips = trips_of(plan, shape.frames)
    how = tuple(recorders(mean(ensemble.goal.observe)))
    along = np.eye(len(names))[k]
    for _ in range(8):
        system = ensemble.system_of(fluid, dt)
        slopes, after = called(
            _tangent,
            system,
            begun(system, ensemble.state, ensemble.keys),
            ensemble.keys,
            along,
            trips,
            static={"names": names, "shape": shape, "how": how},
            functions=how,
            making=lambda: ensemble.report("compiling"),
        )
        slopes = slopes[:, : plan.frames]
        status = np.bitwise_or.reduce(np.asarray(after.status))
        if not status:
            ensemble.state = after
            return slopes
        if status & ~np.uint32(bits.OVERFLOWS):
            break
        ensemble.state = grow(ensemble.state)
    raise RunError(f"tangent window failed: {bits.describe(status)}")


@functools.partial(jax.jit, static_argnames=("names", "shape", "how"))
def _tangent(system: System, state, keys, along, trips, names, shape, how):
    """Derivative of the value along a direction in ``ln parameters``, (frames,) of each box, and
    the state after the window.

    The direction is given to the program: one serves all parameters.
    """
    value = lambda name: jnp.asarray(system.fluid.value(name), state.position.dtype)
    here = jnp.log(jnp.stack([value(name) for name in names]))

    def values(x, state, key):
        fluid = system.fluid.set(energies="keep", **dict(zip(names, jnp.exp(x))))
        moved = dataclasses.replace(system, fluid=fluid)
        trajectory = proceed(moved, state, key, shape, how, trips=trips)
        return trajectory.frames["value"], trajectory.final

    def one(state, key):
        _, slopes, final = jax.jvp(
            lambda x: values(x, state, key), (here,), (along.astype(here.dtype),), has_aux=True
        )
        return slopes, final

    return each_member(one)(state, keys) if keys.ndim else one(state, keys)


def plateau(tangents) -> Estimate:
    """The latest tangent whose error is still a tenth of its size, else the least noisy late one.

    Args:
        tangents: slopes over time in independent windows, (windows, frames).
    """
    estimates = [from_replicas(column) for column in tangents.T]
    good = [e for e in estimates if e.error <= 0.1 * abs(e.value)]
    if good:
        return good[-1]
    return min(estimates[len(estimates) // 4 :], key=lambda e: e.error)
