"""What may be given as data, and what is told of what may not."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import dpdjax as dpd
from dpdjax.inference.data import observations

RATES = [0.1, 1.0, 10.0]


def test_numbers_by_name():
    found = observations({"viscosity": (1.1, 0.01), "D": dpd.Estimate(0.3, 0.02)})
    assert found.names == ("viscosity", "diffusion") and found.controlled is None
    assert found.value.tolist() == [1.1, 0.3] and found.error.tolist() == [0.01, 0.02]


def test_a_relative_error_for_those_without():
    found = observations({"viscosity": 2.0, "pressure": (20.0, 0.5)}, error=0.03)
    assert found.error == pytest.approx([0.06, 0.5])


@pytest.mark.parametrize("errors", ["stress_error", "error"])
def test_a_flow_curve(errors, tmp_path):
    table = pd.DataFrame({"shear_rate": RATES, "stress": [1.0, 5.0, 20.0], errors: [0.1, 0.2, 0.3]})
    file = tmp_path / "curve.csv"
    file.write_text("# of Tuesday\n" + table.to_csv(index=False))
    for data in (table, str(file)):
        found = observations(data)
        assert found.names == ("stress",) * 3 and found.controlled == "rate"
        assert found.control.tolist() == RATES and found.error.tolist() == [0.1, 0.2, 0.3]


def test_moduli():
    table = pd.DataFrame({"frequency": RATES, "G'": [1.0, 2.0, 3.0], "G''": [4.0, 5.0, 6.0]})
    found = observations(table, error=0.1)
    assert found.names == ("storage_modulus",) * 3 + ("loss_modulus",) * 3
    assert found.value.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]


def test_datasets_of_x_and_y():
    x = np.array(RATES)
    moduli = observations(SimpleNamespace(x=x, y=np.array([1 + 4j, 2 + 5j, 3 + 6j])), error=0.1)
    assert moduli.quantities == ("storage_modulus", "loss_modulus")
    assert moduli.controlled == "frequency" and moduli.value[3] == 4.0
    flow = SimpleNamespace(x=x, y=x**0.5, y_units="Pa·s")
    assert observations(flow, error=0.1).quantities == ("viscosity",)
    assert observations(SimpleNamespace(x=x, y=x), error=0.1).quantities == ("stress",)


def test_several():
    curve = pd.DataFrame({"rate": RATES, "stress": RATES})
    found = observations([{"diffusion": (0.3, 0.01)}, curve], error=0.1)
    assert len(found) == 4 and found.controlled == "rate" and np.isnan(found.control[0])


@pytest.mark.parametrize(
    "data, told",
    [
        ({"thickness": (1.0, 0.1)}, "data has 'thickness'; it knows viscosity"),
        ({"viscosity": 1.0}, "viscosity states no error; give error="),
        ({"viscosity": (-1.0, 0.1)}, "viscosity is -1; it must be above zero"),
        ({"viscosity": (1.0, 0.0)}, "error of viscosity is 0"),
        (3.0, "data is a float; give numbers by name"),
        ([], "data is a list"),
        (pd.DataFrame({"rate": RATES, "height": RATES}), "the table has the columns rate, height"),
        (pd.DataFrame({"rate": [0.0, 1.0], "stress": [1.0, 2.0], "error": [1, 1]}), "rate is 0"),
        (
            pd.DataFrame({"frequency": RATES, "G'": RATES, "G''": RATES, "error": RATES}),
            "one column of errors for several numbers",
        ),
        (
            [
                pd.DataFrame({"rate": RATES, "stress": RATES, "error": RATES}),
                pd.DataFrame({"frequency": RATES, "G'": RATES, "error": RATES}),
            ],
            "both frequency and rate",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_no_data(data, told):
    with pytest.raises((ValueError, TypeError), match=told):
        observations(data)
