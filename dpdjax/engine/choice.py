"""Which integrator covers most time for its cost."""

import contextlib

from dpdjax.checks import Numbers
from dpdjax.engine.implicit import ImplicitDrag
from dpdjax.engine.integrator import Integrator, VelocityVerlet
from dpdjax.engine.multistep import MultipleTimeStep
from dpdjax.model.advice import ERROR, suggest_dt
from dpdjax.model.fluid import Fluid


def suited(
    fluid: Fluid,
    density: Numbers,
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
    density: Numbers,
    sizes: tuple[float, float] = (1.0, 1.0),
    *,
    error: float = ERROR,
) -> Integrator:
    """The integrator that covers most physical time for its cost at the same accuracy.

    :class:`dpdjax.integrators.VelocityVerlet` for most fluids,
    :class:`dpdjax.integrators.ImplicitDrag` for strong drag between beads that hardly repel each
    other, :class:`dpdjax.integrators.MultipleTimeStep` where the contacts and the lubrication of a
    few beads with radii would set the step of all.

    Args:
        fluid, density, sizes, error: as for :func:`dpdjax.suggest_dt`.

    Example:
        >>> dpd.integrators.cheapest(water, density=3.0)
        VelocityVerlet(lam=0.5)
        >>> dpd.integrators.cheapest(water.set(gamma=100.0, a=0.0), density=3.0)
        ImplicitDrag(tolerance=0.003)
        >>> dpd.integrators.cheapest(made.fluid, density=[2.4, 0.05])
        MultipleTimeStep(inner=..., stiff=None, tolerance=0.003)
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
