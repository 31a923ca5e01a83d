"""What a law declares of itself, by decorators: where it ends, which numbers suit it, and what they
stand for.

No layer knows a law or a coefficient by name; it reads what is declared here.
"""

from collections.abc import Callable
from typing import TypeVar

from dpdjax.checks import angle, not_negative, positive

Law = TypeVar("Law", bound=Callable)
"""A law comes out of its decorators as it was."""
CENTRAL, TRANSVERSE, FULL = "central", "transverse", "full"
PROJECTORS = (CENTRAL, TRANSVERSE, FULL)
"""What part of the relative velocity of two surfaces a friction acts on: along the line of centres,
across it, all of it."""
POTENTIAL, FRICTION = "potential", "friction"
BOUNDS = {"positive": positive, "not negative": not_negative, "angle": angle}
"""What :func:`bounded` may say of a coefficient."""


def reaches(function: Callable) -> Callable[[Law], Law]:
    """A decorator that says where a law ends: ``function(*, ...)`` of its coefficients, ``R_i``,
    ``R_j`` and ``kT`` [length].

    ``dpd.term(..., reach=...)`` says otherwise for one term.

    Example:
        >>> @dpd.laws.reaches(lambda *, kappa: 8.0 / kappa)
        ... def screened(h, *, strength, kappa):
        ...     return strength * jnp.exp(-kappa * h)
        >>> dpd.fluid([dpd.term(screened, strength=2.0, kappa=16.0)], kT=1.0).reaches()
        (0.5,)
    """
    return _declared("reach", function)


def projected(projector: str) -> Callable[[Law], Law]:
    """A decorator that says which part of the relative velocity a friction acts on: ``"central"``,
    along the line of centres, ``"transverse"``, across it, or ``"full"``.

    Raises ValueError for another.

    Example:
        >>> @dpd.laws.projected("transverse")
        ... def rub(h, *, gamma, r_c):
        ...     return gamma * (1.0 - h / r_c)
        >>> dpd.term(rub, gamma=4.5, r_c=1.0)
        rub(gamma=4.5, r_c=1, projector='transverse')
    """
    return _declared("projector", known_projector(projector))


def potential(law: Law) -> Law:
    """A decorator that says that a law is an energy, so that it is refused where a friction is
    wanted.

    Example:
        >>> @dpd.laws.potential
        ... def well(h, *, depth, r_c):
        ...     return -depth * (1.0 - h / r_c) ** 2
        >>> dpd.fluid(drag=[dpd.term(well, depth=1.0, r_c=1.0)], kT=1.0)
        Traceback (most recent call last):
            ...
        ValueError: well is a potential and was given as a friction: it goes with conservative=[...]
    """
    return _declared("kind", POTENTIAL)(law)


def friction(law: Law) -> Law:
    """A decorator that says that a law is a friction, so that it is refused where a potential is
    wanted.

    Example:
        >>> @dpd.laws.friction
        ... def rub(h, *, gamma, r_c):
        ...     return gamma * (1.0 - h / r_c)
        >>> dpd.fluid(conservative=[dpd.term(rub, gamma=4.5, r_c=1.0)], kT=1.0)
        Traceback (most recent call last):
            ...
        ValueError: rub is a friction and was given as a potential: it goes with drag=[...]
    """
    return _declared("kind", FRICTION)(law)


def bounded(**bounds: str) -> Callable[[Law], Law]:
    """A decorator that says which numbers a law takes, ``@dpd.laws.bounded(gamma="not negative",
    r_c="positive")``, or ``theta0="angle"``, from 0 to pi.

    Others are refused where they are given. Raises ValueError for another bound.

    Example:
        >>> @dpd.laws.bounded(gamma="not negative", r_c="positive")
        ... def rub(h, *, gamma, r_c):
        ...     return gamma * (1.0 - h / r_c)
        >>> dpd.term(rub, gamma=-4.5, r_c=1.0)
        Traceback (most recent call last):
            ...
        ValueError: gamma is -4.5; it must not be negative
    """
    for name, bound in bounds.items():
        if bound not in BOUNDS:
            raise ValueError(f"the bound of {name} is {bound!r}; it is one of {', '.join(BOUNDS)}")
    return _declared("bounds", bounds)


def attracts(function: Callable) -> Callable[[Law], Law]:
    """A decorator that says how far a law attracts: the gap, ``function(*, ...)`` as for
    :func:`dpdjax.laws.reaches`, where a tenth of its depth is left [length].

    Spheres closer than that are in contact, for :func:`dpdjax.measure.contact_number` and others,
    unless told otherwise.

    Example:
        >>> @dpd.laws.attracts(lambda *, r_c: r_c * (1.0 - 0.1**0.5))
        ... def well(h, *, depth, r_c):
        ...     return -depth * (1.0 - h / r_c) ** 2
        >>> sticky = dpd.colloid_fluid(attraction=dpd.term(well, depth=1.0, r_c=0.2))
        >>> round(dpd.measure.contact_number(gel).gap, 3)  # of morse: 3/kappa
        0.1
    """
    return _declared("attraction", function)


def proportional_to(coefficient: str) -> Callable[[Law], Law]:
    """A decorator that names the coefficient a potential is proportional to:
    ``fluid.set(kT=..., energies="scale")`` scales it with kT.

    Example:
        >>> @dpd.laws.proportional_to("depth")
        ... def well(h, *, depth, r_c):
        ...     return -depth * (1.0 - h / r_c) ** 2
        >>> warm = dpd.fluid([dpd.term(well, depth=5.0, r_c=1.0)], kT=1.0)
        >>> float(warm.set(kT=0.5, energies="scale").value("depth"))
        2.5
    """
    return _declared("strength", coefficient)


def of_viscosity(coefficient: str) -> Callable[[Law], Law]:
    """A decorator that names the coefficient of a friction that is the viscosity of the solvent
    [energy time / volume], which tells diffusion times.

    Example:
        >>> @dpd.laws.of_viscosity("eta")
        ... def squeeze(h, *, eta, R_i, R_j):
        ...     return 6.0 * jnp.pi * eta * (R_i * R_j / (R_i + R_j)) ** 2 / jnp.maximum(h, 0.001)
        >>> lubricated = dpd.term(squeeze, eta=0.3, reach=1.0)
        >>> spheres = dpd.fluid(drag=[lubricated], kT=0.1, radius=1.0)
        >>> round(float(dpd.theory.diffusion_time(spheres)), 2)  # 6 pi eta R^3 / kT
        56.55
    """
    return _declared("viscosity", coefficient)


def check_bounds(law: Callable, numbers: dict):
    """Raise ValueError for a number that the law declares it cannot have."""
    for name, bound in getattr(law, "bounds", {}).items():
        if name in numbers:
            BOUNDS[bound](numbers[name], name)


def names_declared(law: Callable) -> set[str]:
    """The coefficients that a law's declarations speak of."""
    named = {getattr(law, attribute, None) for attribute in ("strength", "viscosity")}
    return set(getattr(law, "bounds", {})) | named - {None}


def check_kind(law: Callable, kind: str):
    """Raise ValueError where a law declares that it is of the other kind."""
    if getattr(law, "kind", kind) != kind:
        wanted = {POTENTIAL: "conservative", FRICTION: "drag"}
        raise ValueError(
            f"{name_of(law)} is a {law.kind} and was given as a {kind}: it goes with "
            f"{wanted[law.kind]}=[...]"
        )


def name_of(law: Callable) -> str:
    """What a law is called in messages."""
    return getattr(law, "__name__", repr(law))


def known_projector(projector: str) -> str:
    """The projector; ValueError for one there is not."""
    if not isinstance(projector, str) or projector not in PROJECTORS:
        raise ValueError(f"projector is {projector!r}; it is one of {', '.join(PROJECTORS)}")
    return projector


def _declared(attribute: str, value):
    def declare(law):
        setattr(law, attribute, value)
        return law

    return declare
