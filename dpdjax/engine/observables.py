"""Observables: functions ``observe(fluid, state) -> dict`` of one state.

A run evaluates them inside its compiled loop. Stresses are kept as pressure tensors
(positive in compression), apart by origin; under shear all velocities are peculiar.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dpdjax.bonded.forces import bonded_force, bonded_laplacian
from dpdjax.engine.state import State
from dpdjax.model.beads import inertias, masses
from dpdjax.model.fluid import Fluid
from dpdjax.model.term import CENTRAL, FULL, TRANSVERSE
from dpdjax.pairs import box as boxes
from dpdjax.pairs.cells import inverse
from dpdjax.pairs.forces import interactions_of
from dpdjax.pairs.geometry import Columns, Moment, geometry
from dpdjax.pairs.laws import CONSERVATIVE, DRAG, RANDOM, evaluate
from dpdjax.pairs.sums import sum_onto_beads

HIGHEST = jax.lax.Precision.HIGHEST
KINETIC = "kinetic"
STATIC = (KINETIC, CONSERVATIVE)
SMOOTH = (*STATIC, DRAG)
"""Parts of the pressure: what it is in equilibrium; and all but the random one, which has mean zero
and is only noise."""


def pressure_tensor(fluid: Fluid, state: State, parts: tuple[str, ...] = SMOOTH) -> jax.Array:
    """The pressure tensor (3, 3) [energy / volume], positive in compression.

    Args:
        parts: what of it: ``"kinetic"``, ``sum m c c / V`` from peculiar velocities, the
            mean over a step where its end changes them at once;
            ``"conservative"``, of all potentials; ``"drag"``, of all frictions, odd under time
            reversal and of mean zero in equilibrium; ``"random"``, that of the noise, wanted where
            the whole flux of momentum is integrated over time.

    Raises ValueError for another part.

    Example:
        >>> p = dpd.observe.pressure_tensor(water, rest.final)
        >>> p.shape, bool(18.0 < jnp.trace(p) / 3 < 30.0)
        ((3, 3), True)
        >>> ideal = dpd.observe.pressure_tensor(water, rest.final, ("kinetic",))
        >>> bool(1.8 < jnp.trace(ideal) / 3 < 4.2)  # density kT, 3
        True
    """
    wanted = {origin for part in parts for origin in _origins(fluid, part)}
    return sum(p for origin, p in _by_origin(fluid, state).items() if origin in wanted)


def _origins(fluid, part: str) -> tuple[str, ...]:
    """The names under which a part of the pressure is kept."""
    if part in (KINETIC, RANDOM):
        return (part,)
    if part not in SMOOTH:
        raise ValueError(f"parts has {part!r}; they are {', '.join((*SMOOTH, RANDOM))}")
    return fluid.origins_of(part)


def _by_origin(fluid, state) -> dict:
    """The pressure tensor by origin, (3, 3) each: kinetic, conservative, drag, random and what
    terms have names for."""
    weighted = masses(fluid, state)[:, None] * state.velocity
    carried = jnp.einsum("na,nb->ab", weighted, state.velocity, precision=HIGHEST)
    kinetic = (carried + state.tally.carried) / state.box.volume
    pairs = {origin: virial / state.box.volume for origin, virial in state.tally.virial.items()}
    return {KINETIC: kinetic} | pairs


def temperature(fluid: Fluid, state: State) -> jax.Array:
    """Kinetic temperature ``sum m c^2 / (3 n - 3)`` [energy]; three momenta are fixed.

    Example:
        >>> bool(0.6 < dpd.observe.temperature(water, rest.final) < 1.4)
        True
        >>> rest.frames["temperature"].shape  # it is among the standard ones
        (40,)
    """
    twice = jnp.sum(masses(fluid, state)[:, None] * state.velocity**2)
    return twice / (3 * state.position.shape[0] - 3)


def rotational_temperature(fluid: Fluid, state: State) -> jax.Array:
    """``sum I omega^2 / 3 m`` of the m beads that rotate [energy]; ValueError where none does.

    Example:
        >>> fluid, now = marble.fluid, turning.final
        >>> inertia = dpd.integrators.inertias(fluid, now)
        >>> T = (inertia[:, None] * now.rotation.velocity**2).mean()
        >>> bool(jnp.allclose(dpd.observe.rotational_temperature(fluid, now), T))
        True
    """
    rotation = _rotation(state)
    return jnp.mean(inertias(fluid, state)[:, None] * rotation.velocity**2)


def rotations(fluid: Fluid, state: State) -> dict:
    """Angular velocities (m, 3) [1 / time], torques (m, 3) [energy] and orientations (m, 4), unit
    quaternions with the scalar first, of the m beads that rotate.

    Raises ValueError where none does.

    Example:
        >>> now = dpd.observe.rotations(marble.fluid, turning.final)
        >>> {name: values.shape for name, values in now.items()}
        {'angular_velocity': (1, 3), 'torque': (1, 3), 'orientation': (1, 4)}
        >>> turning.frames["orientation"].shape
        (40, 1, 4)
    """
    rotation = _rotation(state)
    return {
        "angular_velocity": rotation.velocity,
        "torque": rotation.torque,
        "orientation": rotation.orientation,
    }


def _rotation(state):
    if state.rotation is None:
        raise ValueError(
            "no bead of this state rotates; give a species an inertia, dpd.fluid(..., inertia=...)"
        )
    return state.rotation


def momentum(fluid: Fluid, state: State) -> jax.Array:
    """Total peculiar momentum (3,) [mass length / time].

    Example:
        >>> bool(jnp.abs(dpd.observe.momentum(water, rest.final)).max() < 1e-2)
        True
    """
    return jnp.sum(masses(fluid, state)[:, None] * state.velocity, axis=0)


def standard(fluid: Fluid, state: State) -> dict:
    """What a run records unless told otherwise: ``temperature`` [energy], ``pressure_tensor`` (3,
    3) [energy / volume], ``potential_energy`` [energy], ``momentum`` (3,).

    Example:
        >>> sorted(dpd.observe.standard(water, rest.final))
        ['momentum', 'potential_energy', 'pressure_tensor', 'temperature']
    """
    return {
        "temperature": temperature(fluid, state),
        "pressure_tensor": pressure_tensor(fluid, state),
        "potential_energy": state.tally.energy,
        "momentum": momentum(fluid, state),
    }


def stresses(fluid: Fluid, state: State) -> dict:
    """The pressure tensor by origin, (3, 3) each [energy / volume], under the names
    ``pressure_kinetic`` and so on: ``conservative``, ``drag``, ``random``, and what terms have
    names for.

    ``pressure_conservative`` is that of pairs without a name of their own; bonds are in
    ``pressure_bond``, contacts in ``pressure_contact``. In :func:`dpdjax.observe.pressure_tensor`
    ``"conservative"`` is all potentials.

    Example:
        >>> sorted(dpd.observe.stresses(water, rest.final))
        ['pressure_conservative', 'pressure_drag', 'pressure_kinetic', 'pressure_random']
        >>> sorted(set(dpd.observe.stresses(made.fluid, gel.final)) - set(rest.frames))
        ['pressure_colloid', 'pressure_contact', 'pressure_lubrication']
    """
    return {f"pressure_{origin}": p for origin, p in _by_origin(fluid, state).items()}


def positions(fluid: Fluid, state: State) -> dict:
    """Wrapped and unwrapped positions, images, velocities, (n, 3) each, and the ``strain`` and
    ``lengths`` of the box, for structure and diffusion.

    Measures unwrap by the images, in double precision: far from where it began a bead's single one
    moves in jumps.

    Example:
        >>> now = dpd.observe.positions(water, rest.final)
        >>> sorted(now)
        ['image', 'lengths', 'position', 'strain', 'unwrapped', 'velocity']
        >>> rest.frames["unwrapped"].shape
        (40, 192, 3)
    """
    of_beads = {
        "position": state.position,
        "unwrapped": state.unwrapped,
        "velocity": state.velocity,
        "image": state.image,
    }
    return of_beads | box(fluid, state)


def box(fluid: Fluid, state: State) -> dict:
    """The box: its ``lengths`` (3,) [length] and its ``strain``.

    Example:
        >>> now = dpd.observe.box(water, sheared.final)
        >>> now["lengths"].tolist(), round(float(now["strain"]), 3)
        ([4.0, 4.0, 4.0], 0.4)
    """
    return {"strain": state.box.strain, "lengths": state.box.lengths}


@functools.cache
def positions_of(species: int) -> Callable:
    """An observable like :func:`dpdjax.observe.positions` of the beads of one species alone, with
    the ``strain`` and the ``lengths`` of the box.

    A run raises ValueError where no interaction of the fluid has this species as a group of its
    own.

    Example:
        >>> colloids = dpd.observe.positions_of(1)(made.fluid, gel.final)
        >>> colloids["position"].shape, gel.frames["position"].shape
        ((16, 3), (24, 16, 3))
    """

    def positions_of_species(fluid, state) -> dict:
        begin, end = _slots(fluid, state, species)
        of_box = box(fluid, state)
        return {
            name: x if name in of_box else x[begin:end]
            for name, x in positions(fluid, state).items()
        }

    return positions_of_species


def sizes_of(ids: ArrayLike) -> Callable:
    """An observable of molecules of one kind, the means over them of ``squared_gyration`` and of
    ``squared_end_to_end``, from the first bead to the last [length^2].

    ``ids`` (molecules, beads), as :func:`dpdjax.molecules` returns them; beads that follow one
    another in a row are taken for nearest images, and all for equally heavy.
    :func:`dpdjax.measure.end_to_end` and :func:`dpdjax.measure.radius_of_gyration` read the same
    off recorded positions; this is for gradients, and goals of ``calibrate``. Raises ValueError for
    ids of another shape.

    Example:
        >>> sizes = dpd.observe.sizes_of(melt.ids["A5"])  # for observe=
        >>> now = sizes(melt.fluid, chains.final)
        >>> sorted(now), bool(0.4 < now["squared_gyration"] < 1.2)
        (['squared_end_to_end', 'squared_gyration'], True)
    """
    ids = np.asarray(ids)
    if ids.ndim != 2 or ids.shape[1] < 2 or ids.dtype.kind not in "iu":
        raise ValueError(f"ids has {ids.dtype} of shape {ids.shape}; give (molecules, beads)")
    return _sizes_of(ids.astype(np.int32).tobytes(), ids.shape)


@functools.cache
def _sizes_of(held: bytes, shape: tuple[int, int]) -> Callable:
    """One function for the same molecules, so that runs of them share a program."""
    ids = np.frombuffer(held, np.int32).reshape(shape)

    def sizes(fluid, state) -> dict:
        x = state.position[inverse(state.id)[ids]]
        ahead = boxes.displacement(state.box, x[:, 1:], x[:, :-1])
        place = jnp.pad(jnp.cumsum(ahead, axis=1), ((0, 0), (1, 0), (0, 0)))
        from_middle = place - jnp.mean(place, axis=1, keepdims=True)
        return {
            "squared_gyration": jnp.mean(jnp.sum(from_middle**2, axis=(1, 2))) / shape[1],
            "squared_end_to_end": jnp.mean(jnp.sum(place[:, -1] ** 2, axis=1)),
        }

    return sizes


def _slots(fluid, state, species: int) -> tuple[int, int]:
    """First slot and end of the beads of a species, known while tracing: beads of a species lie
    together."""
    for interaction, neighbours in interactions_of(fluid, state):
        for group, slots in zip(interaction.groups, neighbours.grid.groups):
            if group == (species,):
                return slots
    groups = sorted({group for interaction in fluid.interactions for group in interaction.groups})
    raise ValueError(
        f"species {species} is no group of its own, the groups of this fluid are "
        f"{', '.join(map(str, groups))}; give it an interaction of its own, "
        f"dpd.interaction(({species}, {species}), ...), or use observe=dpd.observe.positions"
    )


def _geometries(fluid, state):
    beads, moment = Columns.of(fluid, state, state.velocity), Moment(state.box)
    for interaction, neighbours in interactions_of(fluid, state):
        yield interaction, geometry(fluid, interaction, beads, neighbours.list.idx, moment)


def configurational_temperature(fluid: Fluid, state: State) -> jax.Array:
    """``<|grad U|^2> / <laplacian U>`` [energy] (Rugh 1997; Butler et al. 1998).

    A thermometer that never looks at velocities. Needs a conservative force. Right on average over
    many frames, of a few hundred beads to a tenth in each.

    Example:
        >>> bool(0.5 < dpd.observe.configurational_temperature(water, rest.final) < 1.5)
        True
    """
    n = state.position.shape[0]
    gradient, laplacian = jnp.zeros_like(state.position), 0.0
    for interaction, pairs in _geometries(fluid, state):
        force = lambda h: evaluate(
            interaction.conservative, pairs._replace(h=h), fluid.kT, derivative=True
        )[1]
        f, slope = jax.jvp(force, (pairs.h,), (jnp.ones_like(pairs.h),))
        gradient += sum_onto_beads(pairs, f, n)
        # Beads at one place, where a Laplacian may be infinite, weigh nothing in the mean.
        apart = pairs.real & (pairs.r > 0)
        curvature = -slope - 2 * f / jnp.where(apart, pairs.r, 1.0)
        laplacian += 2 * jnp.sum(jnp.where(apart, curvature, 0.0))
    if fluid.bonded:
        gradient += bonded_force(fluid, state).force
        laplacian += bonded_laplacian(fluid, state)
    return jnp.sum(gradient**2) / laplacian


def instantaneous_viscosity(fluid: Fluid, state: State) -> jax.Array:
    """``sum zeta r^2 e_x^2 e_y^2 / V`` [energy time / volume]: the part of the viscosity with no
    delay.

    The mean over all off-diagonals; the response of the drag stress to a sudden shear. Across the
    line of centres it is ``sum zeta r^2 e_y^2 (1 - e_x^2) / V``; spheres that rotate go on as they
    did.

    Example:
        >>> eta = dpd.observe.instantaneous_viscosity(water, rest.final)
        >>> bool(0.5 < eta / dpd.theory.drag_viscosity(water, 3.0) < 1.5)
        True
    """
    total = 0.0
    for interaction, pairs in _geometries(fluid, state):
        x, y, z = (e * e for e in pairs.e)
        squares = x * y + x * z + y * z
        shares = {CENTRAL: squares, TRANSVERSE: 1.0 - squares, FULL: 1.0}
        r = jnp.where(pairs.real, pairs.r, 0.0)
        for t in interaction.drag:
            zeta = evaluate([t], pairs, fluid.kT, derivative=False)
            total += jnp.sum(zeta * r * r * shares[t.projector]) / 3.0
    return total / state.box.volume
