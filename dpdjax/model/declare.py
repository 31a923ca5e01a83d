"""What a law declares of itself, by decorators: where it ends, which numbers suit it, and what they
stand for.

No layer knows a law or a coefficient by name; it reads what is declared here.
"""

from collections.abc import Callable

from dpdjax.checks import angle, not_negative, positive

CENTRAL, TRANSVERSE, FULL = "central", "transverse", "full"
PROJECTORS = (CENTRAL, TRANSVERSE, FULL)
"""What part of the relative velocity of two surfaces a friction acts on: along the line of centres,
across it, all of it."""
POTENTIAL, FRICTION = "potential", "friction"
BOUNDS = {"positive": positive, "not negative": not_negative, "angle": angle}
"""What :func:`bounded` may say of a coefficient."""


def reaches(function: Callable) -> Callable:
    """A decorator that says where a law ends: ``function(*, ...)`` of its coefficients, R_i, R_j
    and kT [length]."""
    return _declared("reach", function)


def projected(projector: str) -> Callable:
    """A decorator that says which part of the relative velocity a friction acts on, one of
    ``PROJECTORS``."""
    return _declared("projector", known_projector(projector))


def potential(law: Callable) -> Callable:
    """A decorator that says that a law is an energy, so that it is refused where a friction is
    wanted."""
    return _declared("kind", POTENTIAL)(law)


def friction(law: Callable) -> Callable:
    """A decorator that says that a law is a friction, so that it is refused where a potential is
    wanted."""
    return _declared("kind", FRICTION)(law)


def bounded(**bounds: str) -> Callable:
    """A decorator that says which numbers a law takes, ``@dpd.laws.bounded(gamma="not negative",
    r_c="positive")``, or ``theta0="angle"``, from 0 to pi.

    Others are refused where they are given. Raises ValueError for another bound.
    """
    for name, bound in bounds.items():
        if bound not in BOUNDS:
            raise ValueError(f"the bound of {name} is {bound!r}; it is one of {', '.join(BOUNDS)}")
    return _declared("bounds", bounds)


def attracts(function: Callable) -> Callable:
    """A decorator that says how far a law attracts: the gap, ``function(*, ...)`` as for
    ``reaches``, where a tenth of its depth is left [length]. Spheres closer than that are in
    contact unless told otherwise."""
    return _declared("attraction", function)


def proportional_to(coefficient: str) -> Callable:
    """A decorator that names the coefficient a potential is proportional to:
    ``fluid.set(kT=..., energies="scale")`` scales it."""
    return _declared("strength", coefficient)


def of_viscosity(coefficient: str) -> Callable:
    """A decorator that names the coefficient of a friction that is the viscosity of the solvent,
    which tells diffusion times."""
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
