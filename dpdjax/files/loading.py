"""States from GSD files, of this package or another."""

import dataclasses
import os
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dpdjax.checks import not_negative, plain, positive, truth, whole
from dpdjax.engine.flow import Driving, Flow
from dpdjax.engine.refusals import check_fluid
from dpdjax.engine.rotation import Rotation
from dpdjax.engine.state import State, assemble
from dpdjax.errors import FileError
from dpdjax.files import molecules
from dpdjax.files.frames import as_run, told
from dpdjax.files.gsd import angular_velocity, reading
from dpdjax.model.beads import masses
from dpdjax.model.fluid import Fluid
from dpdjax.pairs import box as boxes
from dpdjax.prepare.start import plan_lists

RIGHT = 1e-4
"""Relative difference of masses and sizes up to which beads are those of a fluid."""


def load_gsd(
    path: str | os.PathLike,
    frame: int = -1,
    *,
    fluid: Fluid,
    flow: Driving = None,
    groups: Mapping[str, ArrayLike] | None = None,
    exclude: int = 0,
    skin: float | None = None,
    dt: float | None = None,
    sheared: bool = True,
) -> State:
    """A state to go on from, out of a frame of a GSD file, of this package or of HOOMD-blue.

    Types are the species in turn. Positions and velocities are in the single precision of the file:
    a run that is to go on to the last bit needs its checkpoint, or :func:`dpdjax.save_state`. Beads
    are put in order of their species; their diameters are sizes where the species has a radius.
    Bonds, angles and dihedrals are those of the file, of the types of the fluid by name.

    Args:
        path: file name.
        frame: number of the frame, from the end if negative.
        fluid: what the beads are.
        flow: what streamed when the file was written, by another program; a file of this package
            says so itself.
        groups: by the names of the types in the fluid the beads that are bonded, by their rows in
            the file, in place of what the file says of bonds; ``{}`` for none.
        exclude: pairs up to so many bonds apart do not act on each other, as for
            :meth:`dpdjax.State.bonded`; the file does not say.
        skin, dt, sheared: of the lists, as for :func:`dpdjax.initial_state`.

    Raises FileError for a damaged file or one that is none; ValueError for a frame that is not
    there, types, masses or bonds that are not those of the fluid, a box tilted otherwise than along
    xy.

    Example:
        >>> dpd.write_gsd("rest.gsd", rest)
        >>> last = dpd.load_gsd("rest.gsd", fluid=water)
        >>> last
        State(192 beads, box 4 x 4 x 4, step 400, time 4)
        >>> dpd.load_gsd("rest.gsd", frame=0, fluid=water).step.item()
        205
    """
    check_fluid(fluid)
    whole(exclude, "exclude", least=0)
    is_number = isinstance(frame, int | np.integer) and not isinstance(frame, bool)
    if not is_number:
        raise TypeError(f"frame is {frame!r}; give its number")
    with reading(path) as file:
        if not -len(file) <= frame < len(file):
            raise ValueError(f"frame is {frame}, and {path} holds {len(file)} frames")
        frame = range(len(file))[frame]
        try:
            found = file[frame]
        except (RuntimeError, OSError, KeyError) as error:
            raise FileError(f"frame {frame} of {path} cannot be read: {error}") from error
        time, rate = told(file, frame, "time", 0.0), told(file, frame, "rate", None)
    rate = float(Flow.of(flow).rate_at(time)) if rate is None else rate
    if groups is None:
        groups = molecules.groups_of(fluid, molecules.taken(found))
    given = _configuration(found, rate, time)
    return state_of(fluid, given, groups, exclude, skin=skin, dt=dt, sheared=sheared)


@dataclasses.dataclass(frozen=True)
class Configuration:
    """What a file tells of n beads, in its own order.

    Attributes:
        lengths, strain: of the box.
        position, velocity, image: (n, 3), as in a state.
        species: (n,), from 0.
        types: what the file calls those.
        mass, diameter: (n,), or None where the file does not say.
        turned: orientation (n, 4), angular momentum (n, 4) as HOOMD-blue means it and moment of
            inertia (n, 3), or None.
        step, time: when it was.
    """

    lengths: np.ndarray
    strain: float
    position: np.ndarray
    velocity: np.ndarray
    image: np.ndarray
    species: np.ndarray
    types: list[str]
    mass: np.ndarray | None
    diameter: np.ndarray | None = None
    turned: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    step: int = 0
    time: float = 0.0


def _configuration(frame, rate: float, time: float) -> Configuration:
    """That of a frame of a GSD file, in which the box streams at a rate."""
    beads = frame.particles
    position, velocity, image, strain = as_run(frame)
    velocity[:, 0] -= rate * beads.position[:, 1]
    return Configuration(
        frame.configuration.box[:3],
        strain,
        position,
        velocity,
        image,
        np.zeros(beads.N, int) if beads.typeid is None else beads.typeid.astype(int),
        beads.types,
        beads.mass,
        beads.diameter,
        (beads.orientation, beads.angmom, beads.moment_inertia),
        frame.configuration.step,
        time,
    )


def state_of(
    fluid: Fluid,
    given: Configuration,
    groups: Mapping[str, Any],
    exclude: int,
    *,
    skin: float | None,
    dt: float | None,
    sheared: bool,
) -> State:
    """The state of what a file tells, the beads in order of their species.

    ``groups``: by the names of the types in the fluid the rows in the file of beads that are
    bonded; ``skin``, ``dt``, ``sheared``: of the lists. Raises ValueError for beads or bonds that
    are not those of the fluid.
    """
    skin = None if skin is None else plain(skin, "skin", not_negative)
    dt = None if dt is None else plain(dt, "dt", positive)
    truth(sheared, "sheared")
    species = given.species
    if species.max(initial=0) >= fluid.species:
        raise ValueError(
            f"the file has beads of type {given.types[species.max()]}, number {species.max()}, and "
            f"the fluid knows {fluid.species} species"
        )
    order = np.argsort(species, kind="stable")
    species, counts = species[order], np.bincount(species, minlength=fluid.species)
    size = _sizes(fluid, given.diameter, order, species)
    box = boxes.box(given.lengths)
    box, periods = boxes.Box(box.lengths, jnp.asarray(given.strain, box.lengths.dtype)).folded()
    image = given.image[order]
    image[:, 0] += int(periods) * image[:, 1]
    grids = plan_lists(fluid, box, counts, size=size, skin=skin, dt=dt, sheared=sheared)
    real = lambda x: jnp.asarray(x, box.lengths.dtype)
    state = assemble(
        box,
        real(given.position[order]),
        real(given.velocity[order]),
        jnp.asarray(species, jnp.int32),
        grids,
        real(size),
        fluid.origins,
        _rotation(fluid, given.turned, order, counts, real),
    )
    if given.mass is not None:
        _check_masses(fluid, state, given.mass[order])
    step = jnp.asarray(given.step, state.step.dtype)
    when = {"image": jnp.asarray(image), "step": step, "time": real(given.time)}
    return molecules.bonded(dataclasses.replace(state, **when), fluid, groups, order, exclude)


def _sizes(fluid, diameter, order, species) -> np.ndarray:
    """Relative sizes (n,): 1 for points, and where the file does not say."""
    if diameter is None:
        return np.ones(len(species))
    radius = np.array([np.nan if r is None else float(r) for r in fluid.radius])[species]
    return np.where(np.isnan(radius), 1.0, 0.5 * diameter[order] / radius)


def _rotation(fluid, turned, order, counts, real) -> Rotation | None:
    """How the beads of rotating species are turned; at rest where the file does not say."""
    if not fluid.rotating:
        return None
    edges = np.concatenate([[0], np.cumsum(counts)])
    begin, end = int(edges[fluid.rotating[0]]), int(edges[fluid.rotating[-1] + 1])
    if turned is None:
        return Rotation.of(real(np.zeros((end - begin, 3))), begin)
    orientation, momentum, inertia = (values[order[begin:end]] for values in turned)
    inertia = inertia[:, :1]
    spin = angular_velocity(orientation, momentum, np.where(inertia > 0, inertia, np.inf))
    turning = Rotation.of(real(spin), begin)
    return dataclasses.replace(turning, orientation=real(orientation))


def _check_masses(fluid, state, given):
    """Raise ValueError for masses in a file that are not those of the fluid."""
    wanted = np.asarray(masses(fluid, state))
    off = np.abs(given - wanted) > RIGHT * wanted
    if off.any():
        k = int(np.argmax(off))
        raise ValueError(
            f"the file has beads of mass {given[k]:g} for species {int(state.species[k])}, whose "
            f"mass in the fluid is {wanted[k]:g}; give the fluid that made the file"
        )
