"""Suspensions to start from: colloids that do not overlap, solvent outside them."""

import dataclasses
import math
from collections.abc import Callable

import jax
import numpy as np

from dpdjax.checks import Numbers, positive, prng_key, whole
from dpdjax.engine.choice import suited
from dpdjax.engine.integrator import Integrator
from dpdjax.engine.state import State
from dpdjax.model.colloids import COLLOID, SOLVENT, colloid_fluid, diffusion_time, sphere_volume
from dpdjax.model.declare import name_of
from dpdjax.model.fluid import Fluid
from dpdjax.model.summary import as_table, energies_in_kT
from dpdjax.pairs import box as boxes
from dpdjax.pairs.noise import Domain
from dpdjax.prepare import packing
from dpdjax.prepare.start import MOST_BEADS, beads_in, placed, plan_lists

CUT_SIZES = 3.0
"""Gaussian sizes are drawn again beyond this many standard deviations."""
CUT_DEVIATION = 0.98658
"""Standard deviation of a unit Gaussian cut off there."""


@dataclasses.dataclass(frozen=True, repr=False)
class Suspension:
    """A fluid with colloids and a state of it; prints what it is made of.

    Attributes:
        fluid: the fluid, species 0 the solvent and species 1 the colloids.
        state: where the beads are.
        phi: volume fraction of the colloids, as placed.
        tau: bare diffusion time of a colloid [time].
        dt: a time step that suits it [time], under this integrator:
        integrator: what is to move it, ``dpd.run(..., integrator=made.integrator)``.
    """

    fluid: Fluid
    state: State
    phi: float
    tau: float
    dt: float
    integrator: Integrator

    @property
    def solvents(self) -> int:
        """Number of solvent beads."""
        return int(np.sum(np.asarray(self.state.species) == SOLVENT))

    @property
    def colloids(self) -> int:
        """Number of colloids."""
        return self.state.n - self.solvents

    @property
    def steps_per_tau(self) -> int:
        """Steps of ``dt`` in one diffusion time."""
        return round(self.tau / self.dt)

    def __str__(self):
        names = ("solvent-solvent", "colloid-solvent", "colloid-colloid")
        sides = " x ".join(f"{side:g}" for side in np.asarray(self.state.box.lengths))
        lists = "; ".join(
            f"{name} {n.grid.reach:.4g} + {n.grid.skin:.2g}"
            for name, n in zip(names, self.state.neighbours)
        )
        mass = np.asarray(self.fluid.mass)
        return "\n".join(
            [
                f"{self.colloids} colloids and {self.solvents} solvent beads in {sides}, phi "
                f"{self.phi:.4f}",
                f"colloids: radius {float(self.fluid.radius[COLLOID]):g}{self._spread()}, mass "
                f"{mass[COLLOID]:.4g}; solvent mass {mass[SOLVENT]:g}",
                f"cut-offs between centres, and skins: {lists}",
                *self._energies(),
                f"kT {float(self.fluid.kT):g}, diffusion time tau {self.tau:.4g}: "
                f"{self.steps_per_tau:,} steps of dt {self.dt:.2g} by {self.integrator}",
                f"one tau is {self.steps_per_tau * self.state.n:.2g} particle-steps (dpdjax bench "
                "tells how many a second)",
            ]
        )

    __repr__ = __str__

    def _repr_html_(self):
        return as_table("Suspension", [(line,) for line in str(self).split("\n")])

    def _energies(self) -> list[str]:
        """The potentials between colloids, in kT."""
        pairs = self.fluid.interactions[-1]
        told = [
            f"{name_of(t.law)} {energies_in_kT(self.fluid, pairs, t)}" for t in pairs.conservative
        ]
        return [f"between colloids: {'; '.join(told)}"]

    def _spread(self) -> str:
        sizes = np.asarray(self.state.size)[self.solvents :]
        return f" ({sizes.min():.3g} to {sizes.max():.3g} of it)" if np.ptp(sizes) else ""


def suspension(
    key: jax.Array,
    *,
    phi: float,
    box: Numbers | None = None,
    colloids: int | None = None,
    radius: Numbers | None = None,
    spread: float = 0.0,
    density: float | None = None,
    skin: float | None = None,
    dt: float | None = None,
    integrator: Integrator | None = None,
    sheared: bool = True,
    report: Callable[[str], None] | None = print,
    **numbers,
) -> Suspension:
    """Colloids at a volume fraction in a solvent, placed at random.

    ``density (1 - phi) V`` solvent beads, rounded down, lie outside the colloids, which keep a
    small gap from each other. The solvent starts without structure and warm: let it settle for some
    time units.

    Args:
        key: a PRNG key; the same one may drive the run.
        phi: volume fraction of the colloids, up to about 0.45.
        box: one side or three [length]; or give ``colloids``, and the box is a cube.
        colloids: number of colloids, instead of the box.
        radius: of a colloid, or the radii of all of them (colloids,) [length]; r_c by default.
        spread: standard deviation of the radius over its mean, Gaussian. Masses go as the cube.
        density: solvent beads per volume outside the colloids; 3/r_c^3 by default.
        skin, dt, sheared: as for :func:`dpdjax.initial_state`.
        integrator: that of the runs to come, whose step ``dt`` is; by default the one that covers
            most time for its cost (:func:`dpdjax.integrators.cheapest`), with ``dt`` given
            velocity-Verlet.
        report: told what was made; None for silence.
        **numbers: all that :func:`dpdjax.colloid_fluid` takes: kT, gamma, eta_0, D0, ...

    Raises ValueError for a box and a number or neither, a volume fraction that cannot be packed, a
    box too small for the lists.

    Example:
        >>> made = dpd.suspension(key, phi=0.2, box=7.0, kT=0.1, D0=1.2, kappa=30.0, report=None)
        >>> made.colloids, made.solvents, round(made.phi, 4), round(made.tau, 2)
        (16, 823, 0.1954, 56.55)
        >>> made.integrator  # of the step made.dt
        MultipleTimeStep(inner=..., stiff=None, tolerance=0.003)
    """
    key = prng_key(key)
    r_c = float(positive(numbers.get("r_c", 1.0), "r_c"))
    radius, density = (
        r_c if radius is None else radius,
        3.0 / r_c**3 if density is None else density,
    )
    phi, density = (float(positive(x, name)) for x, name in ((phi, "phi"), (density, "density")))
    if phi >= 1:
        raise ValueError(f"phi is {phi:g}; it must be below 1, and can be packed up to about 0.45")
    radii, lengths = _radii_and_sides(key, phi, box, colloids, radius, spread)
    beads_in(lengths, density)
    mean = float(np.mean(radii)) if np.ndim(radius) else float(radius)
    fluid = colloid_fluid(radius=mean, density=density, **numbers)
    positive(fluid.kT, "kT", "without it there is no diffusion time to tell results in")
    space, volume = boxes.box(lengths), float(np.prod(lengths))
    placed_phi = float(sphere_volume(radii).sum()) / volume
    # Of drawn radii the fraction is not quite the wanted one, of equal ones it is but for whole
    # colloids.
    solvents = math.floor(
        density * (1.0 - (placed_phi if np.ptp(radii) else phi)) * volume * (1 + 1e-9)
    )
    counts = (solvents, len(radii))
    size = np.concatenate([np.ones(solvents), radii / mean])
    numbers = fluid, np.asarray(counts) / volume, (size.min(), size.max())
    integrator, dt = suited(*numbers, integrator=integrator, dt=dt)
    grids = plan_lists(fluid, space, counts, size=size, skin=skin, dt=dt, sheared=sheared)
    position = packing.arrange(key, space, np.concatenate([np.zeros(solvents), radii]))
    state = placed(fluid, key, space, position, counts, grids, size=size)
    made = Suspension(fluid, state, placed_phi, float(diffusion_time(fluid)), float(dt), integrator)
    if report is not None:
        report(str(made))
    return made


def _radii_and_sides(key, phi, box, colloids, radius, spread):
    """Radii (colloids,) and sides (3,) that agree with the volume fraction, one of which is
    given."""
    given = np.ndim(radius) == 1
    colloids = len(radius) if given and colloids is None and box is None else colloids
    if (box is None) == (colloids is None):
        raise ValueError("give either box=... (one side or three) or colloids=... (their number)")
    if given and (spread or box is not None or colloids != len(radius)):
        raise ValueError(
            f"{len(radius)} radii are given: leave out box and spread, and give no other number of "
            "colloids"
        )
    if not 0 <= spread < 1 / CUT_SIZES:
        raise ValueError(
            f"spread is {spread:g}; it must lie between 0 and {1 / CUT_SIZES:.2f}, so that no "
            "radius is negative"
        )
    positive(radius, "radius")
    if box is not None:
        lengths = np.broadcast_to(np.asarray(positive(box, "box"), float), (3,))
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            each = np.float64(sphere_volume(radius)) * (1 + 3 * spread**2)
            wanted = phi * np.prod(lengths) / each
        if not wanted < MOST_BEADS:
            raise ValueError(
                f"phi {phi:g} of radius {radius:g} makes {wanted:.3g} colloids in this box; use a "
                "smaller box or a larger radius"
            )
        colloids = round(wanted)
        if colloids < 1:
            raise ValueError(
                f"phi {phi:g} is less than one colloid of radius {radius:g} in this box; use a "
                "larger box"
            )
        return radius * _sizes(key, colloids, spread), lengths
    colloids = whole(colloids, "colloids", most=MOST_BEADS)
    radii = np.asarray(radius, float) if given else radius * _sizes(key, colloids, spread)
    return radii, np.full(3, (sphere_volume(radii).sum() / phi) ** (1 / 3))


def _sizes(key, count: int, spread: float) -> np.ndarray:
    """Relative sizes (count,) of mean about 1."""
    draw = jax.random.truncated_normal(
        jax.random.fold_in(key, Domain.SIZE), -CUT_SIZES, CUT_SIZES, (count,)
    )
    return 1.0 + spread / CUT_DEVIATION * np.asarray(draw, float)
