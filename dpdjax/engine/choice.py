"""Which integrator covers most time for its cost."""

from jax.typing import ArrayLike

from dpdjax.engine.implicit import ImplicitDrag
from dpdjax.engine.integrator import Integrator, VelocityVerlet
from dpdjax.engine.multistep import MultipleTimeStep
from dpdjax.model.advice import ERROR, suggest_dt
from dpdjax.model.fluid import Fluid


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
    ways = [VelocityVerlet(), ImplicitDrag()]
    if can_move(MultipleTimeStep(), fluid):
        ways.append(MultipleTimeStep.suited_to(fluid, density, sizes, error=error))
    covered = lambda how: suggest_dt(fluid, density, sizes, integrator=how, error=error) / how.cost
    return max((how for how in ways if can_move(how, fluid)), key=covered)


def can_move(how: Integrator, fluid: Fluid) -> bool:
    """Whether an integrator takes a fluid."""
    try:
        how.check(fluid)
    except (TypeError, ValueError):
        return False
    return True
