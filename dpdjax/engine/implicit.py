"""Drag and noise of a step by the implicit midpoint rule, which keeps the temperature at any dt."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from dpdjax.engine import order
from dpdjax.engine import status as bits
from dpdjax.engine.forces import UNDAMPED, forces_on
from dpdjax.engine.integrator import Integrator, drifted, settled
from dpdjax.engine.state import State
from dpdjax.model import advice
from dpdjax.model.beads import inertias, masses
from dpdjax.model.fluid import Fluid
from dpdjax.pairs.friction import Motion, frictions_of

MOST = 200
"""Iterations after which a solve is given up."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ImplicitDrag(Integrator):
    """Velocity-Verlet for all that velocities do not matter to, then drag and noise by the implicit
    midpoint rule, the beads held where they are.

    With ``G`` the friction of all pairs, ``F_R`` the noise and ``v`` the velocities after both half
    kicks, ``(M + dt G/2) dv = dt (F_R - G v)`` and ``v' = v + dv``.

    In mass-weighted velocities, ``A = dt M^-1/2 G M^-1/2 / 2``, the covariance goes from kT to
    ``kT ((1 - A)^2 + 4 A) / (1 + A)^2 = kT``: the Maxwell distribution is kept whatever dt is, and
    what errs is what potentials do in so long a step. (The self-consistent scheme of Pagonabarraga,
    Hagen & Frenkel 1998, solved.) It pays where drag is strong: a step is four times as dear as
    one of velocity-Verlet.

    Velocities are recorded after the drag of a step; under a steady force f they are short of what
    carries the beads by ``dt f / 2 m``, which the momentum that they carry is mended for.

    By conjugate gradients, preconditioned by the masses, so that each iteration is a sum of forces
    between pairs and momentum is kept to rounding. They go on until the rest is ``tolerance`` of
    the right side, in each member of a batch by itself; a derivative is that of the solved
    equation, by a solve of its own, and not of the iterations. Noise is normal, for what is left of
    the velocities of the step before may be little.

    Attributes:
        tolerance: of the solve, relative.

    Example:
        >>> thick = water.set(gamma=100.0, a=0.0)
        >>> steps = [dpd.integrators.VelocityVerlet(), dpd.integrators.ImplicitDrag()]
        >>> [round(dpd.suggest_dt(thick, 3.0, integrator=how), 4) for how in steps]
        [0.0008, 0.0202]
    """

    ranks = {"tolerance": 0}
    kinds = UNDAMPED
    cost = 4.0

    tolerance: Any = 0.003

    def dt_limits(self, fluid, density, sizes):
        """Those of the potentials: no drag is too strong."""
        kept = advice.REPULSION, advice.CONTACT, advice.BOND
        return [one for one in super().dt_limits(fluid, density, sizes) if one[0] in kept]

    def dt_errors(self, fluid, density, error=advice.ERROR):
        """Those of the potentials and of motion in a step: drag and noise keep the temperature at
        any dt.
        """
        return advice.held_errors(fluid, density, error)

    def check(self, fluid: Fluid) -> None:
        """Raise ValueError for noise of its own, which no step balances with the drag."""
        if any(interaction.random is not None for interaction in fluid.interactions):
            raise ValueError(
                "ImplicitDrag needs noise that follows from the drag, and this fluid has random=: "
                "leave it out, or run with dpd.integrators.VelocityVerlet()"
            )

    def step(self, system, state: State, key: jax.Array, tally: bool) -> State:
        """One step: kick, drift and kick without drag, then drag and noise alone."""
        moved, drift = drifted(system, state, 0.5)
        forces = forces_on(system, moved, drift.predicted(0.5), key, tally, self.kinds)
        kicked = settled(system, state, moved, drift, forces)
        return damped(system, kicked, key, tally, self.tolerance)


def damped(system, state: State, key: jax.Array, tally: bool, tolerance, channels=None) -> State:
    """The state with its velocities changed by the drag and the noise of a step.

    Once in a step, for its noise is keyed by the step, and after
    :func:`dpdjax.integrators.settled`, whose sums over pairs take the place of all before;
    ``tally`` (static): those of drag and noise are added to them. ``tolerance`` is that of
    :class:`dpdjax.integrators.ImplicitDrag`; ``channels``, by default the places of the
    interactions in the fluid, key their noise. A solve that does not get there is told by
    ``status``.

    Example:
        >>> system, now = rest.system, rest.final
        >>> after = dpd.integrators.damped(system, now, key, False, tolerance=0.003)
        >>> bool((after.position == now.position).all())
        True
        >>> bool(jnp.abs((after.velocity - now.velocity).sum(axis=0)).max() < 1e-2)
        True
    """
    fluid, dt = system.fluid, system.dt
    frictions = frictions_of(fluid, state, system.flow.rate_at(state.time), key, dt, channels)
    by_id = order.by_id(state) if order.is_kept(state) else lambda rows: rows
    before, mass = _motion(state), _inertia(fluid, state)
    operator = lambda v: jax.tree.map(
        lambda m, v, f: m * v + 0.5 * dt * f, mass, v, frictions.drag(v)
    )
    wanted = jax.tree.map(lambda f: dt * f, frictions.force(before))
    change, missed = solved(operator, wanted, mass, tolerance, _dot(by_id))
    after = jax.tree.map(jnp.add, before, change)
    new = {"velocity": after.velocity, "status": state.status | bits.flag(missed, bits.UNSOLVED)}
    if after.spin is not None:
        new["rotation"] = dataclasses.replace(state.rotation, velocity=after.spin)
    if tally:
        middle = jax.tree.map(lambda v, dv: v + 0.5 * dv, before, change)
        sums = frictions.tally(middle)
        half = 0.5 * (
            _carried(mass.velocity, before.velocity, by_id)
            - _carried(mass.velocity, after.velocity, by_id)
        )
        new["tally"] = state.tally + dataclasses.replace(sums, carried=half)
    return dataclasses.replace(state, **new)


def _motion(state: State) -> Motion:
    return Motion(state.velocity, None if state.rotation is None else state.rotation.velocity)


def _inertia(fluid, state: State) -> Motion:
    """Masses (n, 1), and moments of inertia (m, 1) of the beads that rotate."""
    spin = None if state.rotation is None else inertias(fluid, state)[:, None]
    return Motion(masses(fluid, state)[:, None], spin)


def _dot(by_id: Callable) -> Callable:
    """The scalar product of two motions, summed in the order of the ids: the order in memory is not
    to show."""
    product = lambda a, b: jnp.sum(by_id(jnp.sum(a * b, axis=1)))
    return lambda a, b: sum(jax.tree.leaves(jax.tree.map(product, a, b)))


def _carried(mass, velocity, by_id: Callable):
    """``sum m v v`` (3, 3), in that order too."""
    v = by_id(velocity)
    return jnp.einsum("na,nb->ab", by_id(mass) * v, v, precision=jax.lax.Precision.HIGHEST)


def solved(operator: Callable, wanted, mass, tolerance, dot: Callable):
    """``x`` with ``operator(x) = wanted``, and whether the iterations did not get there.

    ``operator`` is linear, symmetric and positive; ``mass``, a part of it, preconditions;
    ``dot(a, b)`` is the scalar product.
    """

    def iterate(operator, wanted):
        enough = tolerance**2 * dot(wanted, _over(wanted, mass))

        def goes_on(carry):
            _, _, _, left, count = carry
            return (left > enough) & (count < MOST)

        def better(carry):
            x, rest, along, left, count = carry
            image = operator(along)
            size = left / dot(along, image)
            x = jax.tree.map(lambda x, p: x + size * p, x, along)
            rest = jax.tree.map(lambda r, q: r - size * q, rest, image)
            gradient = _over(rest, mass)
            now = dot(rest, gradient)
            along = jax.tree.map(lambda z, p: z + now / left * p, gradient, along)
            return x, rest, along, now, count + 1

        nothing, along = jax.tree.map(jnp.zeros_like, wanted), _over(wanted, mass)
        start = nothing, wanted, along, dot(wanted, along), jnp.zeros((), jnp.int32)
        x, _, _, left, _ = jax.lax.while_loop(goes_on, better, start)
        return x, ~(left <= enough)

    return jax.lax.custom_linear_solve(
        operator, wanted, iterate, transpose_solve=iterate, symmetric=True, has_aux=True
    )


def _over(force, mass):
    return jax.tree.map(lambda f, m: f / m, force, mass)
