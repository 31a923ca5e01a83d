"""Draws from the posterior of parameters, by NUTS on the surrogate."""

import dataclasses
import warnings
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.inference.data import DIMENSION, OF_MODELS, Observations
from dpdjax.inference.priors import UNITS, Prior
from dpdjax.inference.surrogates import Surrogate
from dpdjax.surrogate.process import namespace

NEEDS = 'fits need numpyro and arviz: pip install "dpdjax[fit]"'
WARMUP, CHAINS = 500, 4
TARGET = 0.9
"""How often steps of NUTS are to be accepted: posteriors of few good numbers are narrow."""


@dataclasses.dataclass(frozen=True)
class Question:
    """Parameters, and what was measured of what they make.

    Attributes:
        priors: by name; those of ``UNITS`` are units of the fluid in those of the data.
        data: what was measured.
        units: length, mass and time of the fluid in units of the data, where they are known.
    """

    priors: dict[str, Prior]
    data: Observations
    units: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.priors)

    @property
    def of_model(self) -> tuple[str, ...]:
        """Parameters that the model is given."""
        return tuple(name for name in self.priors if name not in UNITS)

    @property
    def quantities(self) -> tuple[str, ...]:
        """What the model is asked for."""
        return tuple(dict.fromkeys(OF_MODELS.get(n, n) for n in self.data.quantities))

    def scale(self, name: str, z):
        """Logarithm of the unit of a quantity, of logarithms of the parameters (n, names)."""
        powers = DIMENSION[name]
        known = float(np.dot(powers, np.log(self.units)))
        free = [(k, UNITS.index(n)) for k, n in enumerate(self.names) if n in UNITS]
        return known + sum((powers[j] * z[:, k] for k, j in free), 0.0 * z[:, 0])

    def places(self, z, control):
        """Where the model is to be asked: logarithms of its parameters and of the control (n, d),
        of those of all parameters (n, names) and controls (n,)."""
        xp = namespace(z)
        columns = [z[:, k] for k, name in enumerate(self.names) if name not in UNITS]
        if self.data.controlled is not None:
            columns.append(np.log(control) - self.scale(self.data.controlled, z))
        return xp.stack(columns, axis=1)

    def places_of_all(self, z, controls):
        """Those of every draw with every control (draws * controls, d)."""
        xp = namespace(z)
        return self.places(xp.repeat(z, len(controls), axis=0), np.tile(controls, len(z)))

    def foretold(self, surrogate: Surrogate, z):
        """What is expected of each datum and the error of that (n, data), of logarithms of
        parameters (n, names): logarithms."""
        xp, data = namespace(z), self.data
        values, errors = [None] * len(data), [None] * len(data)
        for name in data.quantities:
            which = [k for k, each in enumerate(data.names) if each == name]
            at = self.places_of_all(z, data.control[which])
            value, error = surrogate.at(OF_MODELS.get(name, name), at)
            value, error = (x.reshape(len(z), len(which)) for x in (value, error))
            value = value + self.scale(name, z)[:, None]
            if name in OF_MODELS:
                # A stress is a viscosity times the rate, both in units of the model.
                unit = self.scale(data.controlled, z)[:, None]
                value = value + np.log(data.control[which])[None] - unit
            for j, k in enumerate(which):
                values[k], errors[k] = value[:, j], error[:, j]
        return xp.stack(values, axis=1), xp.stack(errors, axis=1)


def likelihood(question: Question, surrogate: Surrogate) -> Callable:
    """Logarithm of how likely the data are, a function of logarithms of the parameters (names,)."""
    value, relative = question.data.value, question.data.error / question.data.value

    def of(z):
        mean, error = (x[0] for x in question.foretold(surrogate, z[None]))
        variance = relative**2 + error**2
        # Errors of data are of the data, as numbers; those of the surrogate of its logarithm.
        off = 1.0 - jnp.exp(mean) / value
        return jnp.sum(-0.5 * off**2 / variance - 0.5 * jnp.log(variance))

    return of


def drawn(question: Question, surrogate: Surrogate, key, draws: int) -> dict[str, np.ndarray]:
    """Draws of the logarithms of the parameters by name (chains, draws), in double precision."""
    try:
        with warnings.catch_warnings():
            # Of bars in notebooks, which are not shown here.
            warnings.filterwarnings("ignore", message="IProgress not found")
            import numpyro
            import numpyro.distributions as of
            from numpyro.infer import MCMC, NUTS
    except ImportError as error:
        raise ImportError(NEEDS) from error
    log_likelihood = likelihood(question, surrogate)

    def model():
        z = []
        for name, prior in question.priors.items():
            even = prior.is_even
            how = (
                of.Uniform(prior.low, prior.high) if even else of.Normal(prior.centre, prior.spread)
            )
            z.append(numpyro.sample(name, how))
        numpyro.factor("data", log_likelihood(jnp.stack(z)))

    # Libraries need not mind ranks as tests of ours do.
    with jax.enable_x64(True), jax.numpy_rank_promotion("allow"):
        kernel = NUTS(model, target_accept_prob=TARGET, dense_mass=True)
        mcmc = MCMC(
            kernel, num_warmup=WARMUP, num_samples=draws, num_chains=CHAINS,
            chain_method="vectorized", progress_bar=False,
        )  # fmt: skip
        mcmc.run(jax.random.wrap_key_data(jax.random.key_data(key)))
        found = mcmc.get_samples(group_by_chain=True)
        return {name: np.asarray(found[name]) for name in question.names}
