"""Which integrator covers most time for its cost."""

import contextlib

from jax.typing import ArrayLike

from dpdjax.engine.implicit import ImplicitDrag
from dpdjax.engine.integrator import Integrator, VelocityVerlet
from dpdjax.engine.multistep import MultipleTimeStep
from dpdjax.model.advice import ERROR, suggest_dt
from dpdjax.model.fluid import Fluid


def suited(
    fluid: Fluid,
    density: ArrayLike,
    sizes: tuple[float, float] = (1.0, 1.0),
    *,
    integrator: Integrator | None = None,
    dt: float | None = None,
) -> tuple[Integrator, float]:
    """An integrator and a time step that suit a fluid where they are not given: the cheapest, but
    velocity-Verlet for a step that is given, and the step that ``suggest_dt`` has for it."""
    if integrator is None:
        integrator = VelocityVerlet() if dt is not None else cheapest(fluid, density, sizes)
    if dt is None:
        dt = suggest_dt(fluid, density, sizes, integrator=integrator)
    return integrator, dt


def cheapest(
    fluid: Fluid,
    density: ArrayLike,
    sizes: tuple[float, float] = (1.0, 1.0),
    *,
    error: float = ERROR,
) -> Integrator:
    """The integrator that covers most physical time for its cost at the same accuracy.

    :class:`VelocityVerlet` for most fluids, :class:`ImplicitDrag` for strong drag between beads
    that hardly repel each other, :class:`MultipleTimeStep` where the contacts and the lubrication
    of a few beads with radii would set the step of all.

    Args:
        fluid, density, sizes, error: as for :func:`dpdjax.suggest_dt`.
    """
    stepwise = lambda: MultipleTimeStep.suited_to(fluid, density, sizes, error=error)
    found = [(0.0, VelocityVerlet())]
    for make in (VelocityVerlet, ImplicitDrag, stepwise):
        # An integrator that cannot move the fluid says so, as does one whose step nothing limits.
        with contextlib.suppress(TypeError, ValueError):
            how = make()
            how.check(fluid)
            dt = suggest_dt(fluid, density, sizes, integrator=how, error=error)
            found.append((dt / how.cost, how))
    return max(found, key=lambda one: one[0])[1]
