"""Fits of models known in closed form: the posterior covers what made the data, says what the data
leave open, and goes on where it was ended."""

import jax
import numpy as np
import pandas as pd
import pytest

import dpdjax as dpd

RATES = np.array([0.1, 0.4, 2.0])
TRUTH = {"gamma": 8.0, "D0": 2.0}


def random_of(key):
    return np.random.default_rng(np.asarray(jax.random.key_data(key)))


def thinning(gamma, D0, rate):
    return 0.5 * gamma**0.4 * (1 + D0 / (1 + (3 * rate) ** 0.7))


def suspended(key, *, gamma, D0, rate):
    """A viscosity with an error of 2 %."""
    eta = thinning(gamma, D0, rate)
    return {"viscosity": dpd.Estimate(eta * (1 + 0.02 * random_of(key).normal()), 0.02 * eta)}


def solvent(key, *, gamma, a):
    """A viscosity and a diffusion, with errors of 1 %."""
    random = random_of(key)
    exact = {"viscosity": 0.3 * gamma**0.5 * a**0.1, "diffusion": 2.0 * gamma**-0.6 * a**-0.2}
    return {n: dpd.Estimate(x * (1 + 0.01 * random.normal()), 0.01 * x) for n, x in exact.items()}


def curve(seed=0):
    eta = thinning(*TRUTH.values(), RATES)
    stress = eta * RATES * (1 + 0.03 * np.random.default_rng(seed).normal(size=len(RATES)))
    return pd.DataFrame({"rate": RATES, "stress": stress, "stress_error": 0.03 * eta * RATES})


PRIORS = {"gamma": (2.0, 40.0), "D0": (0.4, 8.0)}


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fit")
    return folder, dpd.fit(
        suspended, curve(), PRIORS, key=jax.random.key(0), store=folder, progress=False
    )


def test_posterior_covers_the_truth(found):
    _, fit = found
    # Both parameters pull one way, so as numbers of their own they are wide: of the data, not.
    for name, exact in TRUTH.items():
        low, high = fit.interval(name, 0.999)
        assert low < exact < high
    foretold = fit.foretold()
    exact = thinning(*TRUTH.values(), RATES) * RATES
    assert np.all(np.abs(foretold.mean(0) / exact - 1) < 4 * foretold.std(0) / exact + 0.02)
    assert fit.undetermined == () and fit.contradiction < 2.0 and fit.doubt < 0.5


def test_the_same_call_runs_nothing_anew(found):
    folder, fit = found
    said = []
    again = dpd.fit(
        suspended, curve(), PRIORS, key=jax.random.key(0), store=folder, progress=False,
        report=said.append,
    )  # fmt: skip
    assert again.estimates == fit.estimates and said[0] == "batch 1: 18 runs"
    written = sorted(path.name for path in folder.glob("*.nc"))
    assert "batch-1.nc" in written and "checks.nc" in written


def test_as_inference_data_and_pictures(found):
    import matplotlib

    matplotlib.use("Agg")
    _, fit = found
    assert fit.idata.posterior["gamma"].shape == (4, 1000)
    assert fit.idata.posterior["gamma"].attrs["units"] == "mass/time"
    assert fit.idata.observed_data["y"].size == len(RATES)
    assert len(fit.plot()) == 2 and fit.plot_corner().shape == (2, 2)
    assert "gamma" in str(fit) and "fresh runs" in fit._repr_html_()


def test_what_the_data_leave_open_is_named():
    with pytest.warns(
        UserWarning, match=r"the data leave open .*: what is told of it is the prior"
    ):
        fit = dpd.fit(
            solvent, {"viscosity": (1.0, 0.02)}, {"gamma": (1.0, 100.0), "a": (1.0, 100.0)},
            key=jax.random.key(1), checks=0, progress=False,
        )  # fmt: skip
    # Viscosity goes with gamma^.5 a^.1, so it stays along a gamma^-.2.
    (text,) = fit.undetermined
    name, power = text.split()[1].split("^") if text.startswith("a ") else ("gamma", "-0.2")
    assert name == "gamma" and float(power) == pytest.approx(-0.2, abs=0.06)


def test_numbers_in_units_that_are_not_known():
    """Of what made the data the time unit is known within its prior alone, and nothing else is
    claimed."""
    time = 2e-3
    data = {
        "viscosity": (0.3 * 8**0.5 * 10**0.1 / time, 0.02 / time),
        "diffusion": (0.4 / time, 0.01 / time),
    }
    priors = {"gamma": (1.0, 100.0), "time": dpd.Estimate(time, 0.02 * time)}
    base = lambda key, **point: solvent(key, a=10.0, **point)
    with pytest.raises(ValueError, match="units are given, and time has a prior"):
        dpd.fit(base, data, priors, key=jax.random.key(0), units=dpd.water_units())
    with pytest.raises(ValueError, match="only units have priors"):
        dpd.fit(base, data, {"time": (1e-3, 1e-2)}, key=jax.random.key(0))


@pytest.mark.parametrize(
    "priors, told",
    [
        ({}, "priors is {}"),
        ({"gamma": (3.0, 1.0)}, "the prior of gamma is"),
        ({"gamma": 3.0}, "the prior of gamma is 3.0; give two ends above zero"),
        ({"gamma": dpd.Estimate(1.0, 0.0)}, "give a value and an error above zero"),
    ],
)
def test_odd_priors(priors, told):
    with pytest.raises((ValueError, TypeError), match=told):
        dpd.fit(solvent, {"viscosity": (1.0, 0.1)}, priors, key=jax.random.key(0))


def test_a_model_that_does_not_tell_what_was_measured():
    with pytest.raises(
        ValueError, match="the model tells viscosity, diffusion, the data have press"
    ):
        dpd.fit(
            solvent, {"pressure": (1.0, 0.1)}, {"gamma": (1.0, 9.0), "a": (1.0, 9.0)},
            key=jax.random.key(0), progress=False,
        )  # fmt: skip


def test_a_model_that_fails():
    def failing(key, *, gamma):
        raise ValueError("gamma is odd")

    with pytest.raises(dpd.errors.RunError, match="8 of 8 runs failed, such as by: gamma is odd"):
        dpd.fit(
            failing,
            {"viscosity": (1.0, 0.1)},
            {"gamma": (1.0, 9.0)},
            key=jax.random.key(0),
            progress=False,
        )
