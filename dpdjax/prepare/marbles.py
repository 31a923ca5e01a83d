"""Marbles to start from: spheres that do not overlap, solvent outside them."""

import dataclasses
import math
from collections.abc import Callable

import jax
import numpy as np

from dpdjax.checks import Numbers, positive, prng_key, whole
from dpdjax.engine.choice import suited
from dpdjax.engine.integrator import Integrator
from dpdjax.engine.state import State
from dpdjax.model.colloids import COLLOID, SOLVENT, sphere_volume
from dpdjax.model.declare import name_of
from dpdjax.model.fluid import Fluid
from dpdjax.model.marbles import marble_fluid
from dpdjax.model.summary import as_table, energies_in_kT, written
from dpdjax.pairs import box as boxes
from dpdjax.prepare import packing
from dpdjax.prepare.cores import closest
from dpdjax.prepare.start import beads_in, placed, plan_lists


@dataclasses.dataclass(frozen=True, repr=False)
class Marbles:
    """A fluid with marbles and a state of it; prints what it is made of.

    Attributes:
        fluid: the fluid, species 0 the solvent and species 1 the marbles.
        state: where the beads are.
        dt: a time step that suits it [time], under this integrator:
        integrator: what is to move it, ``dpd.run(..., integrator=made.integrator)``.
    """

    fluid: Fluid
    state: State
    dt: float
    integrator: Integrator

    @property
    def solvents(self) -> int:
        """Number of solvent beads."""
        return self.state.n - self.count

    @property
    def count(self) -> int:
        """Number of marbles."""
        return self.state.rotation.m

    @property
    def share(self) -> float:
        """Mass of the marbles over that of all beads; where there is one,
        ``<v^2> = 3 kT/M (1 - share)``."""
        solvent, marble = np.asarray(self.fluid.mass, float)
        return float(self.count * marble / (self.count * marble + self.solvents * solvent))

    def __str__(self):
        sides = " x ".join(f"{side:g}" for side in np.asarray(self.state.box.lengths))
        mass, inertia = float(self.fluid.mass[COLLOID]), float(self.fluid.inertia[COLLOID])
        return "\n".join(
            [
                f"{self.count} marble{'s' if self.count > 1 else ''} and {self.solvents} solvent "
                f"beads in {sides}",
                f"marbles: radius {float(self.fluid.radius[COLLOID]):g}, mass {mass:.4g} "
                f"({100 * self.share:.3g} % of the whole), inertia {inertia:.4g}",
                *self._energies(),
                f"kT {float(self.fluid.kT):g}, {self._frictions()}, "
                f"dt {self.dt:.4g} by {self.integrator}",
            ]
        )

    __repr__ = __str__

    def _repr_html_(self):
        return as_table("Marbles", [(line,) for line in str(self).split("\n")])

    def _frictions(self) -> str:
        """The frictions of the solvent with itself and of the surface."""
        among = self.fluid.interactions[:2]
        numbers = [
            (k, c) for i in among for t in i.drag for k, c in t.coefficients.items() if k != "r_c"
        ]
        return ", ".join(f"{k} {written(c)}" for k, c in numbers)

    def _energies(self) -> list[str]:
        """The potentials of the marbles, in kT."""
        names = ("marble and solvent", "two marbles")
        told = lambda i: "; ".join(
            f"{name_of(t.law)} {energies_in_kT(self.fluid, i, t)}" for t in i.conservative
        )
        return [
            f"{name}: {told(i)}"
            for name, i in zip(names, self.fluid.interactions[1:])
            if i.conservative
        ]


def marbles(
    key: jax.Array,
    *,
    box: Numbers,
    count: int = 1,
    radius: float | None = None,
    density: float | None = None,
    skin: float | None = None,
    dt: float | None = None,
    integrator: Integrator | None = None,
    sheared: bool = False,
    report: Callable[[str], None] | None = print,
    **numbers,
) -> Marbles:
    """Large spheres that rotate in a solvent, placed at random.

    ``density (V - V_marbles)`` solvent beads, rounded down, lie outside them. The solvent starts
    without structure: let it settle for some time units. At rest ``<v^2> = 3 kT/M (1 - M/M_total)``
    for each marble, and ``<omega^2> = 3 kT/I``.

    Args:
        key: a PRNG key; the same one may drive the run.
        box: one side or three [length], at least ``2 (radius + 1 + skin)``.
        count: number of marbles; of several the box holds ``2 (2 radius + skin)`` at least.
        radius: of a marble [length]; 3 r_c by default.
        density: solvent beads per volume outside the marbles; 3/r_c^3 by default.
        skin, dt: as for :func:`dpdjax.initial_state`.
        integrator: as for :func:`dpdjax.suspension`.
        sheared: leave room in the lists for a tilted box.
        report: told what was made; None for silence.
        **numbers: all that :func:`dpdjax.marble_fluid` takes: kT, gamma, gamma_cs, coupling, ...

    Raises ValueError for a box too small for the lists or the marbles, and numbers no fluid can
    have.

    Example:
        >>> marble = dpd.marbles(key, box=6.0, radius=1.0, gamma_cs=5.0, report=None)
        >>> marble.count, marble.solvents, round(marble.share, 4)
        (1, 635, 0.0194)
        >>> print(marble)
        1 marble and 635 solvent beads in 6 x 6 x 6
        marbles: radius 1, mass 12.57 (1.94 % of the whole), inertia 5.027
        ...
    """
    key = prng_key(key)
    count = whole(count, "count")
    r_c = float(positive(numbers.get("r_c", 1.0), "r_c"))
    radius, density = (
        3.0 * r_c if radius is None else radius,
        3.0 / r_c**3 if density is None else density,
    )
    fluid = marble_fluid(radius=radius, density=density, is_several=count > 1, **numbers)
    lengths = np.broadcast_to(np.asarray(positive(box, "box"), float), (3,))
    beads_in(lengths, density)
    space, volume, radii = (
        boxes.box(lengths),
        float(np.prod(lengths)),
        np.full(count, float(radius)),
    )
    free = volume - float(sphere_volume(radii).sum())
    if free <= 0:
        raise ValueError(
            f"{count} marbles of radius {float(radius):g} do not fit into a volume of {volume:g}; "
            "use a larger box"
        )
    # Outside the wall, where its energy is at most kT.
    clearance = float(closest(fluid, most=1.0)[SOLVENT, COLLOID])
    counts = (math.floor(float(density) * free * (1 + 1e-9)), count)
    integrator, dt = suited(fluid, np.asarray(counts) / volume, integrator=integrator, dt=dt)
    grids = plan_lists(fluid, space, counts, skin=skin, dt=dt, sheared=sheared)
    position = packing.arrange(
        key, space, np.concatenate([np.zeros(counts[0]), radii]), clearance=clearance
    )
    state = placed(fluid, key, space, position, counts, grids)
    made = Marbles(fluid, state, float(dt), integrator)
    if report is not None:
        report(str(made))
    return made
