"""What a file says is to be run, built."""

import dataclasses
import inspect
from typing import Any

import jax

import dpdjax as dpd
from dpdjax.checks import whole
from dpdjax.configs.reading import Section, function_named, keywords
from dpdjax.engine.choice import suited
from dpdjax.errors import ConfigError

KINDS = ("fluid", "suspension", "marbles", "molecules")
BONDS = ("bonds", "angles", "dihedrals")
TERMS = ("conservative", "drag", "random")
MATTER = ("kT", "mass", "radius", "inertia", "species", *TERMS, "interactions")
PLACED = ("box", "density", "n", "start", "fractions", "skin", "sheared")


@dataclasses.dataclass(frozen=True)
class Made:
    """What is ready to run.

    Attributes:
        fluid, state, dt, integrator: as for :func:`dpdjax.run`.
        tau: diffusion time of its colloids, or None.
    """

    fluid: Any
    state: Any
    dt: float
    integrator: Any
    tau: float | None


def made_of(file: Section, key: jax.Array, report) -> Made:
    """Fluid, state, step and method of a file."""
    kind = file.one_of(*KINDS)
    integrator = _integrator(file.table("integrator"))
    dt = file.get("dt", float)
    section = file.table(kind)
    how = {"integrator": integrator, "dt": dt}
    if kind != "fluid":
        build = getattr(dpd, kind)
        for name in ("attraction", "contact", "lubrication", "solvent_repulsion"):
            section = _with_law(section, name)
        for name in BONDS:
            section = _with_bonds(section, name)
        made = section.called(build, key, report=report, **how)
        return Made(made.fluid, made.state, made.dt, made.integrator, getattr(made, "tau", None))
    section.only(*MATTER, *PLACED)
    fluid = fluid_of(section)
    places = {name: x for name, x in section.values.items() if name in PLACED}

    def place():
        state = dpd.initial_state(fluid, key, **places, dt=dt)
        counts = [int((state.species == k).sum()) for k in range(fluid.species)]
        density = [n / float(state.box.volume) for n in counts]
        return state, *suited(fluid, density, **how)

    state, method, step = section.guarded(place)
    return Made(fluid, state, float(step), method, None)


def fluid_of(section: Section):
    """The fluid of a section [fluid]."""
    numbers = {n: x for n, x in section.values.items() if n in MATTER}
    numbers = {n: x for n, x in numbers.items() if n not in (*TERMS, "interactions")}
    if "interactions" not in section.values:
        return section.guarded(lambda: dpd.fluid(**_terms(section), **numbers))
    between = []
    for part in section.tables("interactions"):
        part.only("between", *TERMS)
        groups, terms = part.need("between", list), _terms(part)
        laws = [t for name in ("conservative", "drag") for t in terms.get(name, [])]
        between.append(part.guarded(lambda: dpd.interaction(tuple(groups), *laws)))
    return section.guarded(lambda: dpd.fluid(interactions=between, **numbers))


def _terms(section: Section) -> dict:
    return {
        name: [_term(part) for part in section.tables(name)]
        for name in TERMS
        if name in section.values
    }


def _term(part: Section):
    law = function_named(part.need("law", str), f"{part.where} has law", (dpd.laws,))
    numbers = {name: x for name, x in part.values.items() if name != "law"}
    own = [name for name in keywords(law, only=True) if name not in ("R_i", "R_j")]
    Section(numbers, part.where).only(*own, *keywords(dpd.laws.term))
    return part.guarded(lambda: dpd.term(law, **numbers))


def _with_law(section: Section, name: str) -> Section:
    """A section with a law in place of what names it: a table for a term, a text for a function."""
    value = section.values.get(name)
    if value is None:
        return section
    made = (
        _term(section.table(name))
        if name == "attraction"
        else function_named(section.get(name, str), f"{section.where} has {name}", (dpd.laws,))
    )
    return Section(section.values | {name: made}, section.where)


def _with_bonds(section: Section, name: str) -> Section:
    """A section with terms in place of a table that is one, or of tables of them by name."""
    if name not in section.values:
        return section
    part = section.table(name)
    made = _term(part) if "law" in part.values else {n: _term(part.table(n)) for n in part.values}
    return Section(section.values | {name: made}, section.where)


def _integrator(section: Section):
    """The one that is named, with its numbers; None for that which suits."""
    if not section.values:
        return None
    known = {
        "velocity-verlet": dpd.integrators.VelocityVerlet,
        "implicit-drag": dpd.integrators.ImplicitDrag,
        "multiple-time-step": dpd.integrators.MultipleTimeStep,
        "cell-rescaling": dpd.integrators.CellRescaling,
    }
    name = section.need("name", str)
    if name not in known:
        raise ConfigError(
            f"{section.where} has name {name!r}, which is not known; there are {', '.join(known)}"
        )
    numbers = {n: x for n, x in section.values.items() if n != "name"}
    return Section(numbers, section.where).called(known[name])


def flow_of(section: Section) -> list:
    """What drives the run."""
    known = {
        "shear": lambda part: part.called(dpd.shear),
        "oscillatory_shear": lambda part: part.called(dpd.oscillatory_shear),
        "drive": lambda part: part.called(dpd.drive),
        "sinusoidal_force": lambda part: part.called(dpd.flows.sinusoidal_force),
    }
    section.only(*known)
    parts = []
    for name in section.values:
        value = section.values[name]
        plain = name == "shear" and not isinstance(value, dict)
        inside = Section({"rate": value}, section.where) if plain else section.table(name)
        parts.append(known[name](inside))
    return parts


def plan_of(section: Section, made: Made):
    """Frames of a run whose length is given in steps, time, or diffusion times."""
    section.only("steps", "time", "times", "frames", "every", "spacing", "first", "per_decade")
    unit = section.one_of("steps", "time", "times")
    if unit == "times" and made.tau is None:
        raise ConfigError(f"{section.where} gives times, in diffusion times of colloids; give time")
    length = section.need(unit, float)
    per = {"steps": 1.0, "time": 1 / made.dt, "times": (made.tau or 0.0) / made.dt}[unit]
    steps = round(length * per)
    if steps < 1:
        raise ConfigError(f"{section.where} gives {unit} = {length}, less than a step")
    if section.get("spacing", str, "linear") == "logarithmic":
        section.only(unit, "spacing", "first", "per_decade")
        numbers = {n: x for n, x in section.values.items() if n in ("first", "per_decade")}
        return section.guarded(lambda: dpd.Plan.logarithmic(steps, **numbers))
    if section.values.get("spacing", "linear") != "linear":
        raise ConfigError(f'{section.where}: spacing is "linear" or "logarithmic"')
    section.only(unit, "spacing", "frames", "every")
    if "every" in section.values:
        section.one_of("frames", "every")
        every = section.need("every", int)
        if every > steps:
            raise ConfigError(f"{section.where} has every = {every}, more than its {steps} steps")
    else:
        frames = section.guarded(lambda: whole(section.get("frames", int, 100), "frames"))
        every = max(1, round(steps / frames))
    # As many frames as make the length that was asked for.
    return section.guarded(lambda: dpd.Plan(max(1, round(steps / whole(every, "every"))), every))


def observe_of(section: Section) -> list:
    """What is recorded: by name of ``dpd.observe`` values, the standard record by default, and
    means."""
    of = lambda name: getattr(dpd.observe, name)
    plain = [name for name in dpd.observe.__all__ if _observes(of(name))]
    records = [name for name in dpd.observe.__all__ if isinstance(of(name), dpd.observe.Recorder)]
    names = (
        section.names("observe", plain + records) if "observe" in section.values else ["standard"]
    )
    return [*map(of, names), *(dpd.mean(of(name)) for name in section.names("mean", plain))]


def _observes(value) -> bool:
    """Whether it is an observable, a function of a fluid and a state."""
    return inspect.isfunction(value) and [*inspect.signature(value).parameters][:2] == [
        "fluid",
        "state",
    ]
