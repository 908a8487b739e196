"""Features are the responses of physical systems."""

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion.compensation.thermal_model.features import Feature, dynamics, first_order, lagged, matrix
from errormotion.compensation.thermal_model.record import Inputs, read_inputs


def test_the_response_to_a_step_is_exponential() -> None:
    time = np.array([0.0, 10.0, 25.0, 100.0, 1000.0])
    answer = first_order(time, np.array([0.0, 1.0, 1.0, 1.0, 1.0]), 50.0, held=True)
    np.testing.assert_allclose(answer, 1 - np.exp(-time / 50.0), rtol=1e-12)


def test_the_response_to_a_ramp_has_its_delay_for_any_time_steps() -> None:
    time = np.array([0.0, 3.0, 40.0, 41.0, 900.0])
    answer = first_order(time, 0.2 * time, 60.0, held=False)
    np.testing.assert_allclose(answer, 0.2 * (time - 60.0 * (1 - np.exp(-time / 60.0))), rtol=1e-12)


def test_a_lag_before_the_start_refers_to_the_reference_state() -> None:
    inputs = Inputs(np.array([0.0, 100.0, 200.0]), {"head": np.array([0.0, 1.0, 4.0])}, {})
    found = matrix(inputs, lagged(["head"], (50.0,)))
    np.testing.assert_allclose(found, [[0.0, 0.0], [1.0, 0.5], [4.0, 2.5]])


def test_an_unknown_value_is_unknown_at_present_and_interpolated_in_the_past() -> None:
    inputs = Inputs(np.array([0.0, 100.0, 200.0]), {"head": np.array([0.0, np.nan, 4.0])}, {})
    found = matrix(inputs, [Feature("head"), Feature("head", lag=100.0)])
    assert np.isnan(found[1]).all()
    np.testing.assert_allclose(found[2], [4.0, 2.0])


def test_friction_grows_with_the_speed_and_its_square() -> None:
    features = dynamics((), (600.0,), ("spindle_speed",))
    assert [f.power for f in features] == [1, 2]
    inputs = Inputs(np.array([0.0, 600.0]), {}, {"spindle_speed": np.array([0.0, 3.0])})
    np.testing.assert_allclose(matrix(inputs, features)[1], np.array([3.0, 9.0]) * (1 - np.exp(-1)))


def test_a_missing_input_is_named() -> None:
    inputs = Inputs(np.zeros(1), {"bed": np.zeros(1)}, {})
    with raises("model.reading.missing"):
        matrix(inputs, [Feature("head")])
    with raises("model.reading.missing"):
        matrix(inputs, [Feature("spindle_speed", True)])


def data(**changes: object) -> xr.Dataset:
    ds = xr.Dataset(
        {"temperature": (("time", "sensor"), [[20.0, np.nan], [21.0, 30.0], [23.0, 31.0]])},
        {"time": [0.0, 1.0, 2.0], "sensor": ["a", "b"]},
    )
    return ds.assign_coords(changes)


def test_temperatures_are_relative_to_the_first_known_value() -> None:
    inputs = read_inputs(data(spindle_speed=("time", [0.0, 3000.0, np.nan]), feed=("time", [0.0, 0.05, 0.1])))
    np.testing.assert_allclose(inputs.temperature["a"], [0.0, 1.0, 3.0])
    np.testing.assert_allclose(inputs.temperature["b"], [np.nan, 0.0, 1.0])
    np.testing.assert_allclose(inputs.parameter["spindle_speed"], [0.0, 3.0, np.nan])
    np.testing.assert_allclose(inputs.parameter["feed"], [0.0, 3.0, 6.0])


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        (data().drop_vars("temperature"), "model.temperatures.missing"),
        (data(time=[0.0, 2.0, 1.0]), "model.times.not_increasing"),
        (data(sensor=["a", "a"]), "model.sensors.names"),
        (data().isel(time=0), "model.temperatures.dims"),
    ],
)
def test_unreadable_data_are_reported_with_the_reason(wrong: xr.Dataset, code: str) -> None:
    with raises(code):
        read_inputs(wrong)
