"""States from GSD files, of this package or another."""

import dataclasses
import os

import jax.numpy as jnp
import numpy as np

from dpdjax.engine.flow import Driving, Flow
from dpdjax.engine.refusals import check_fluid
from dpdjax.engine.rotation import Rotation
from dpdjax.engine.state import State, assemble
from dpdjax.errors import FileError
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
    skin: float | None = None,
    dt: float | None = None,
    sheared: bool = True,
) -> State:
    """A state to go on from, out of a frame of a GSD file, of this package or of HOOMD-blue.

    Types are the species in turn. Positions and velocities are in the single precision of the file:
    a run that is to go on to the last bit needs its checkpoint, or :func:`dpdjax.save_state`. Beads
    are put in order of their species; their diameters are sizes where the species has a radius.

    Args:
        path: file name.
        frame: number of the frame, from the end if negative.
        fluid: what the beads are.
        flow: what streamed when the file was written, by another program; a file of this package
            says so itself.
        skin, dt, sheared: of the lists, as for :func:`dpdjax.initial_state`.

    Raises FileError for a damaged file or one that is none; ValueError for a frame that is not
    there, types or masses that are not those of the fluid, a box tilted otherwise than along xy.
    """
    check_fluid(fluid)
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
    return _state(fluid, found, rate, time, skin=skin, dt=dt, sheared=sheared)


def _state(fluid, frame, rate, time, **lists) -> State:
    beads = frame.particles
    species = np.zeros(beads.N, int) if beads.typeid is None else beads.typeid.astype(int)
    if species.max(initial=0) >= fluid.species:
        raise ValueError(
            f"the file has beads of type {beads.types[species.max()]}, number {species.max()}, and "
            f"the fluid knows {fluid.species} species"
        )
    order = np.argsort(species, kind="stable")
    position, velocity, image, strain = (x[order] if np.ndim(x) else x for x in as_run(frame))
    velocity[:, 0] -= rate * beads.position[order, 1]
    species, counts = species[order], np.bincount(species, minlength=fluid.species)
    size = _sizes(fluid, beads.diameter[order], species)
    box = boxes.box(frame.configuration.box[:3])
    box, periods = boxes.Box(box.lengths, jnp.asarray(strain, box.lengths.dtype)).folded()
    image[:, 0] += int(periods) * image[:, 1]
    grids = plan_lists(fluid, box, counts, size=size, **lists)
    real = lambda x: jnp.asarray(x, box.lengths.dtype)
    state = assemble(
        box,
        real(position),
        real(velocity),
        jnp.asarray(species, jnp.int32),
        grids,
        real(size),
        fluid.origins,
        _rotation(fluid, beads, order, counts, real),
    )
    _check_masses(fluid, state, beads.mass[order])
    step = jnp.asarray(frame.configuration.step, state.step.dtype)
    return dataclasses.replace(state, image=jnp.asarray(image), step=step, time=real(time))


def _sizes(fluid, diameter, species) -> np.ndarray:
    """Relative sizes (n,): 1 for points."""
    radius = np.array([np.nan if r is None else float(r) for r in fluid.radius])[species]
    return np.where(np.isnan(radius), 1.0, 0.5 * diameter / radius)


def _rotation(fluid, beads, order, counts, real) -> Rotation | None:
    """How the beads of rotating species are turned; at rest where the file does not say."""
    if not fluid.rotating:
        return None
    edges = np.concatenate([[0], np.cumsum(counts)])
    slots = order[int(edges[fluid.rotating[0]]) : int(edges[fluid.rotating[-1] + 1])]
    inertia = beads.moment_inertia[slots, :1]
    orientation, momentum = beads.orientation[slots], beads.angmom[slots]
    spin = angular_velocity(orientation, momentum, np.where(inertia > 0, inertia, np.inf))
    turning = Rotation.of(real(spin), int(edges[fluid.rotating[0]]))
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
