"""Experiments for scans: each is what is done at one point, ``experiment(key, **point)``.

Made with what all points have in common; a point gives the rest, or other values, by the same
names. Numbers that are none of these are numbers of the fluid: ``gamma``, ``a``, ``kT``, ...
"""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.calibration.goal import rough_viscosity, suggest_rate
from dpdjax.checks import not_negative, positive
from dpdjax.engine.choice import suited
from dpdjax.engine.deformation import oscillatory_shear, shear
from dpdjax.engine.integrator import Integrator
from dpdjax.engine.observables import (
    STATIC,
    positions,
    positions_of,
    pressure_tensor,
    standard,
    temperature,
)
from dpdjax.engine.record import mean
from dpdjax.engine.trajectory import Plan
from dpdjax.errors import RunError
from dpdjax.measure.clusters import clusters
from dpdjax.measure.contacts import contact_number
from dpdjax.measure.needs import HOT
from dpdjax.measure.rheology import moduli
from dpdjax.measure.statistics import Estimate, block_average
from dpdjax.measure.transport import diffusion as diffusion_of
from dpdjax.measure.transport import large_system_diffusion
from dpdjax.measure.viscosity import shear_record, shear_viscosity
from dpdjax.model.fluid import Fluid
from dpdjax.prepare.start import initial_state
from dpdjax.prepare.suspension import suspension
from dpdjax.scans.drive import Run

__all__ = [
    "Diffusion",
    "Gel",
    "OscillatoryShear",
    "Pressure",
    "Solvent",
    "SuspensionViscosity",
    "Viscosity",
]

FRAMES, SETTLE, FRAMES_OF_CYCLE = 400, 10, 32
"""Frames of a run that is averaged over, of one that settles, and of a cycle of oscillation."""


def _planned(steps: float) -> Plan:
    """So many steps, in at most twice ``FRAMES`` frames."""
    every = max(1, int(steps / FRAMES))
    return Plan(max(1, round(steps / every)), every)


def _at(experiment, point: dict, matter: str) -> tuple[Any, dict]:
    """An experiment with the values of a point that are its own, and the others, which are of the
    matter it holds under a name."""
    own = {f.name for f in dataclasses.fields(experiment)} - {matter}
    mine = {name: value for name, value in point.items() if name in own}
    others = {name: value for name, value in point.items() if name not in own}
    return dataclasses.replace(experiment, **mine), others


@dataclasses.dataclass(frozen=True, kw_only=True)
class _OfFluid:
    """A box of a fluid: settled, then measured.

    Attributes:
        fluid: what runs; a point may give any of its numbers.
        density: beads per volume.
        box: side [length].
        time: what is measured over [time].
        settle: time before [time].
        dt: time step; by default the one suggested.
        integrator: by default the one that covers most time for its cost.
        energies: what another ``kT`` does to potentials, as for :meth:`dpdjax.Fluid.set`.

    Raises ValueError for numbers that cannot be, RunError for a fluid that the flow or too long a
    step keeps far from kT.
    """

    fluid: Fluid
    density: float = 3.0
    box: float = 10.0
    time: float = 100.0
    settle: float = 10.0
    dt: float | None = None
    integrator: Integrator | None = None
    energies: str = "keep"

    def at(self, point: dict) -> tuple[Any, dict]:
        """The experiment with the values of a point, and those that are of the fluid."""
        own, numbers = _at(self, point, "fluid")
        _refuse_unknown(own, numbers)
        positive(own.time, "time")
        not_negative(own.settle, "settle")
        return own, numbers

    def settled(self, key, numbers: dict):
        """A generator that asks for the run to rest, and returns fluid, state, step and method."""
        energies = {"energies": self.energies} if "kT" in numbers else {}
        fluid = self.fluid.set(**numbers, **energies) if numbers else self.fluid
        shares = np.full(fluid.species, self.density / fluid.species)
        how, dt = suited(fluid, shares, integrator=self.integrator, dt=self.dt)
        state = initial_state(fluid, key, box=self.box, density=self.density, dt=dt)
        calm = Plan.over(self.settle, dt, SETTLE)
        rest = yield Run(fluid, state, key, dt, calm, integrator=how)
        return fluid, rest.final, dt, how

    def plan(self, dt: float) -> Plan:
        """Of the run that is measured."""
        return _planned(self.time / dt)

    def heat(self, ran, fluid) -> Estimate:
        """The temperature of a run; RunError where its numbers are of another fluid."""
        found = block_average(ran.frames["temperature"])
        if found.value > (1 + HOT) * float(fluid.kT):
            raise RunError(
                f"the beads are at a temperature of {found.value:.3g} where kT is "
                f"{float(fluid.kT):g}: give a smaller rate, or a smaller dt",
                None,
            )
        return found


def _refuse_unknown(experiment, numbers: dict):
    """Raise TypeError for a name that is none of the experiment's or of its fluid's."""
    fluid = experiment.fluid
    own = [f.name for f in dataclasses.fields(experiment) if f.name != "fluid"]
    for name in numbers:
        try:
            fluid.value(name)
        except TypeError as error:
            raise TypeError(f"{error}; and the experiment has {', '.join(own)}") from None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Viscosity(_OfFluid):
    """A fluid under steady shear: ``viscosity`` [energy time/length^3], ``temperature`` [energy].

    Attributes:
        rate: shear rate [1/time].
        strain: what is measured over, in place of ``time``: a constant one gives all points of a
            flow curve errors of one order.
        fluid: what runs; a point may give any of its numbers.
        density: beads per volume [1/length^3].
        box: side [length].
        time: what is measured over [time]; in its place ``strain`` where that is given.
        settle: time before [time].
        dt: time step [time]; by default the one suggested.
        integrator: by default the one that covers most time for its cost.
        energies: what another ``kT`` does to potentials, as for :meth:`dpdjax.Fluid.set`.

    At a point it raises ValueError for numbers that cannot be, TypeError for a name that is neither
    its own nor of the fluid, RunError for a fluid that the flow or too long a step keeps far from
    kT.

    Example:
        >>> flow_curve = dpd.experiments.Viscosity(fluid=water, box=4.0, strain=2.0)
        >>> flow_curve.rate, flow_curve.strain, flow_curve.density
        (0.2, 2.0, 3.0)
        >>> first = next(flow_curve(key, rate=0.5, gamma=9.0))  # the run to rest that it asks for
        >>> float(first.fluid.value("gamma"))
        9.0
    """

    rate: float = 0.2
    strain: float | None = None

    def __call__(self, key: jax.Array, **point):
        """Ask for the runs at a point."""
        own, numbers = self.at(point)
        positive(abs(own.rate), "rate", "at rest there is no viscosity to be read")
        if own.strain is not None:
            positive(own.strain, "strain")
            own = dataclasses.replace(own, time=float(own.strain) / abs(float(own.rate)))
        fluid, state, dt, how = yield from own.settled(key, numbers)
        flow = shear(own.rate)
        # Until the flow has come about.
        late = yield Run(fluid, state, key, dt, Plan.over(3.0, dt, SETTLE), flow, integrator=how)
        ran = yield Run(
            fluid, late.final, key, dt, own.plan(dt), flow, observe=shear_record, integrator=how
        )
        heat = own.heat(ran, fluid)
        return {"viscosity": shear_viscosity(ran, skip=0.0), "temperature": heat}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Diffusion(_OfFluid):
    """A fluid at rest: ``diffusion`` of its beads [length^2/time] and ``temperature`` [energy].

    Attributes:
        fit: lags of the mean squared displacement that are fitted [time]; by default the
            eighth of ``time`` that is last of those that tell, as :func:`dpdjax.diffusion` has it.

    Attributes from ``fluid`` on and the errors are those of :class:`dpdjax.experiments.Viscosity`.

    Example:
        >>> experiment = dpd.experiments.Diffusion(fluid=water, box=4.0, time=50.0, fit=(2.0, 4.0))
        >>> first = next(experiment(key, gamma=9.0))  # the run to rest that it asks for
        >>> round(first.plan.steps * float(first.dt), 1)  # over the time to settle
        10.0
    """

    fit: tuple[float, float] | None = None

    def __call__(self, key: jax.Array, **point):
        """Ask for the runs at a point."""
        own, numbers = self.at(point)
        fluid, state, dt, how = yield from own.settled(key, numbers)
        ran = yield Run(
            fluid, state, key, dt, own.plan(dt), observe=[standard, positions], integrator=how
        )
        lags = {} if own.fit is None else {"fit": own.fit}
        heat = own.heat(ran, fluid)
        return {"diffusion": diffusion_of(ran, **lags), "temperature": heat}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pressure(_OfFluid):
    """The equation of state: ``pressure`` [energy/length^3], ``temperature`` [energy] at rest.

    Attributes from ``fluid`` on and the errors are those of :class:`dpdjax.experiments.Viscosity`.

    Example:
        >>> state_of = dpd.experiments.Pressure(fluid=water, box=4.0, time=2.0, settle=1.0)
        >>> table = dpd.scan(state_of, {"a": [25.0]}, key=key, **quiet)
        >>> bool(abs(table.pressure[0] - 24) < 3)
        True
    """

    def __call__(self, key: jax.Array, **point):
        """Ask for the runs at a point."""
        own, numbers = self.at(point)
        fluid, state, dt, how = yield from own.settled(key, numbers)
        ran = yield Run(fluid, state, key, dt, own.plan(dt), integrator=how)
        tensor = np.asarray(ran.frames["pressure_tensor"])
        mean = np.trace(tensor, axis1=-2, axis2=-1) / 3
        heat = own.heat(ran, fluid)
        return {"pressure": block_average(mean), "temperature": heat}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solvent(_OfFluid):
    """What the atlas has of a fluid, by runs at rest and under shear.

    They are ``viscosity`` [energy time/length^3], ``diffusion`` [length^2/time], ``schmidt``, and
    ``pressure`` [energy/length^3], with ``temperature`` [energy].

    Attributes:
        rate: shear rate [1/time]; by default the largest whose bias stays below one per cent.
        sheared: time under shear [time]; by default as long as at rest.

    Diffusion is that of a large system, :func:`dpdjax.measure.large_system_diffusion`.

    Attributes from ``fluid`` on and the errors are those of :class:`dpdjax.experiments.Viscosity`.

    Example:
        >>> experiment = dpd.experiments.Solvent(fluid=water, time=500.0)
        >>> experiment.time, experiment.box, experiment.settle
        (500.0, 10.0, 10.0)
        >>> first = next(dpd.experiments.Solvent(fluid=water, box=4.0)(key, a=20.0))
        >>> float(first.fluid.value("a"))
        20.0
    """

    time: float = 200.0
    rate: float | None = None
    sheared: float | None = None

    def __call__(self, key: jax.Array, **point):
        """Ask for the runs at a point."""
        own, numbers = self.at(point)
        fluid, state, dt, how = yield from own.settled(key, numbers)
        rest = yield Run(
            fluid, state, key, dt, own.plan(dt), observe=[mean(_static), positions], integrator=how
        )
        rough = rough_viscosity(fluid, own.density)
        rate = suggest_rate(fluid, own.density, rough) if own.rate is None else own.rate
        flow = shear(positive(rate, "rate"))
        late = yield Run(
            fluid, rest.final, key, dt, Plan.over(3.0, dt, SETTLE), flow, integrator=how
        )
        plan = own.plan(dt) if own.sheared is None else _planned(own.sheared / dt)
        ran = yield Run(
            fluid, late.final, key, dt, plan, flow, observe=shear_record, integrator=how
        )
        own.heat(ran, fluid)
        return own.properties(fluid, rest, shear_viscosity(ran, skip=0.0))

    def properties(self, fluid, rest, viscosity: Estimate) -> dict:
        """What a run at rest says, and a viscosity."""
        mass, kT = float(np.asarray(fluid.mass).ravel()[0]), float(fluid.kT)
        diffusion = large_system_diffusion(
            diffusion_of(rest), viscosity=viscosity.value, density=self.density, kT=kT,
            side=self.box, mass=mass,
        )  # fmt: skip
        heavy = viscosity.scaled(1.0 / (self.density * mass))
        return {
            "viscosity": viscosity,
            "diffusion": diffusion,
            "schmidt": heavy.over(diffusion),
            "pressure": block_average(rest.frames["pressure"]),
            "temperature": self.heat(rest, fluid),
        }


def _static(fluid, state) -> dict:
    """Pressure of motion and potentials, which drag adds nothing to, and temperature."""
    tensor = pressure_tensor(fluid, state, STATIC)
    return {"pressure": jnp.trace(tensor) / 3.0, "temperature": temperature(fluid, state)}


@dataclasses.dataclass(frozen=True, kw_only=True)
class OscillatoryShear(_OfFluid):
    """A fluid under oscillatory shear: ``storage_modulus`` and ``loss_modulus`` [energy/length^3].

    Attributes:
        frequency: angular [1/time].
        amplitude: of the strain.
        cycles: that are measured over, after one that is left out, in place of ``time``.

    Attributes from ``fluid`` on and the errors are those of :class:`dpdjax.experiments.Viscosity`.

    Example:
        >>> experiment = dpd.experiments.OscillatoryShear(fluid=water, box=4.0, cycles=4)
        >>> experiment.amplitude, experiment.cycles
        (0.5, 4)
        >>> first = next(experiment(key, frequency=2.0))  # the run to rest that it asks for
        >>> first.state.n
        192
    """

    frequency: float = 1.0
    amplitude: float = 0.5
    cycles: int = 20

    def __call__(self, key: jax.Array, **point):
        """Ask for the runs at a point."""
        own, numbers = self.at(point)
        positive(own.frequency, "frequency")
        positive(own.amplitude, "amplitude")
        fluid, state, dt, how = yield from own.settled(key, numbers)
        period = 2 * math.pi / float(own.frequency)
        total = Plan.over((own.cycles + 1) * period, dt, (own.cycles + 1) * FRAMES_OF_CYCLE)
        flow = oscillatory_shear(own.amplitude, own.frequency)
        ran = yield Run(
            fluid, state.restarted(), key, dt, total, flow, observe=shear_record, integrator=how
        )
        found = moduli(ran)
        heat = own.heat(ran, fluid)
        return {"storage_modulus": found.storage, "loss_modulus": found.loss, "temperature": heat}


@dataclasses.dataclass(frozen=True, kw_only=True)
class _OfSuspension:
    """Colloids in a solvent, placed at random and settled without attraction.

    Attributes:
        phi: volume fraction.
        box: side [length].
        times: what is measured, in diffusion times.
        settle: time before [time].
        numbers: others that :func:`dpdjax.suspension` takes; a point may give any.
    """

    phi: float = 0.2
    box: float = 12.0
    times: float = 1.0
    settle: float = 10.0
    numbers: dict = dataclasses.field(default_factory=dict)

    def settled(self, key, point: dict, sheared: bool):
        """A generator that asks for the run to rest; returns what was made, its state, and the
        experiment with the values of the point."""
        this, given = _at(self, point, "numbers")
        others = {"kT": 0.1} | self.numbers | given
        how = {"phi": this.phi, "box": this.box, "sheared": sheared, "report": None}
        made = suspension(key, **how, **others)
        plan = Plan.over(this.settle, made.dt, SETTLE)
        calm = made.fluid.set(D0=0.0) if "D0" in others else made.fluid
        rest = yield Run(calm, made.state, key, made.dt, plan, integrator=made.integrator)
        return made, rest.final.restarted(), this


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gel(_OfSuspension):
    """A quench of colloids from rest into the attraction, over ``times`` diffusion times.

    ``contact_number`` and ``largest_cluster``, the colloids in it, are those at its end.

    Attributes:
        phi: volume fraction of the colloids.
        box: side [length].
        times: what is measured, in diffusion times.
        settle: time before, without attraction [time].
        numbers: others that :func:`dpdjax.suspension` takes; a point may give any.

    Example:
        >>> quench = dpd.experiments.Gel(box=7.0, times=0.5, numbers={"kappa": 30.0})
        >>> first = next(quench(key, phi=0.2, D0=1.2))  # the run to rest, without attraction
        >>> float(first.fluid.value("D0"))
        0.0
    """

    def __call__(self, key: jax.Array, **point):
        """Ask for the runs at a point."""
        made, state, own = yield from self.settled(key, point, sheared=False)
        plan = Plan(20, max(1, round(own.times * made.steps_per_tau / 20)))
        ran = yield Run(
            made.fluid, state, key, made.dt, plan,
            observe=positions_of(1), integrator=made.integrator,
        )  # fmt: skip
        return {
            "contact_number": Estimate(float(contact_number(ran).series[0, -1]), float("nan")),
            "largest_cluster": float(clusters(ran).largest[0, -1]),
        }


@dataclasses.dataclass(frozen=True, kw_only=True)
class SuspensionViscosity(_OfSuspension):
    """A sheared suspension: ``viscosity`` [energy time/length^3].

    It is that of the second half of ``times`` diffusion times.

    Attributes:
        rate: shear rate [1/time].
        phi: volume fraction of the colloids.
        box: side [length].
        times: what is measured, in diffusion times.
        settle: time before, without attraction [time].
        numbers: others that :func:`dpdjax.suspension` takes; a point may give any.

    Example:
        >>> experiment = dpd.experiments.SuspensionViscosity(box=7.0, rate=0.05, times=2.0)
        >>> experiment.rate, experiment.phi, experiment.times
        (0.05, 0.2, 2.0)
    """

    rate: float = 0.1

    def __call__(self, key: jax.Array, **point):
        """Ask for the runs at a point."""
        made, state, own = yield from self.settled(key, point, sheared=True)
        plan = _planned(own.times * made.steps_per_tau)
        ran = yield Run(
            made.fluid, state, key, made.dt, plan, shear(own.rate),
            observe=shear_record, integrator=made.integrator,
        )  # fmt: skip
        return {"viscosity": shear_viscosity(ran, skip=0.5)}
