"""Predictions for single readings equal that for the whole record."""

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion.compensation.online.prediction import Prediction, Predictor, predictor
from errormotion.compensation.thermal_model import ThermalModel, ThermalModelSettings, fit
from errormotion.datasets.schemas import DOF
from errormotion.errors import CompensationError

VARIANTS = {
    "lagged": ThermalModelSettings(variant="lagged", lags=("10 min",)),
    "dynamics": ThermalModelSettings(variant="dynamics", time_constants=("30 min",)),
}


@pytest.fixture(scope="module", params=list(VARIANTS))
def model(request: pytest.FixtureRequest, pair: list[xr.Dataset]) -> ThermalModel:
    return fit(pair, VARIANTS[request.param])


def predictions(following: Predictor, data: xr.Dataset) -> list[Prediction]:
    names = [str(name) for name in data["sensor"].values]
    return [
        following.update(
            float(time),
            dict(zip(names, map(float, row), strict=True)),
            {name: float(data[name].values[k]) for name in ("spindle_speed", "feed") if name in data.variables},
        )
        for k, (time, row) in enumerate(zip(data["time"].values, data["temperature"].values, strict=True))
    ]


def test_it_is_the_prediction_of_the_whole_record(model: ThermalModel, warm_up: Callable[..., xr.Dataset]) -> None:
    data = warm_up(3, 2)
    whole = model.predict(data)
    errors = np.column_stack([whole[name].values for name in DOF])
    u = np.sqrt(np.diagonal(whole["covariance"].values, axis1=1, axis2=2))
    found = predictions(predictor(model.dataset), data)
    np.testing.assert_allclose([p.errors for p in found], errors, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose([p.uncertainty for p in found], u, rtol=1e-9)
    assert [bool(p.outside) for p in found] == list(whole["outside"].values == 1)


def test_it_is_the_prediction_at_another_functional_point(
    model: ThermalModel, warm_up: Callable[..., xr.Dataset]
) -> None:
    data = warm_up(3, 2)
    point = np.asarray(model.dataset.attrs["functional_point"]) + np.array([0.02, -0.01, -0.1])
    whole = model.predict(data).em.at(point)
    found = predictions(predictor(model.dataset, point), data)
    errors = np.column_stack([whole[name].values for name in DOF])
    np.testing.assert_allclose([p.errors for p in found], errors, rtol=1e-9, atol=1e-15)
    u = np.sqrt(np.diagonal(whole["covariance"].values, axis1=1, axis2=2))
    np.testing.assert_allclose([p.uncertainty for p in found], u, rtol=1e-6)


def test_after_a_gap_it_equals_the_prediction_of_the_whole_record(
    model: ThermalModel, warm_up: Callable[..., xr.Dataset]
) -> None:
    data = warm_up(3, 2).copy(deep=True)
    data["temperature"][10:14, :] = np.nan
    whole = model.predict(data)
    found = predictions(predictor(model.dataset), data)
    assert all(np.isnan(p.errors).all() and p.missing for p in found[10:14])
    errors = np.column_stack([whole[name].values for name in DOF])
    np.testing.assert_allclose([p.errors for p in found], errors, rtol=1e-9, atol=1e-15)


def test_an_absent_sensor_is_named(model: ThermalModel) -> None:
    prediction = predictor(model.dataset).update(0.0, {}, {})
    following = predictor(model.dataset)
    assert set(prediction.missing) == {*following.temperatures, *following.parameters}
    assert np.isnan(prediction.errors).all()


def test_times_must_increase(model: ThermalModel) -> None:
    following = predictor(model.dataset)
    following.update(5.0, {}, {})
    with raises("model.reading.not_later"):
        following.update(5.0, {}, {})


def test_a_model_without_a_translation_is_refused(model: ThermalModel) -> None:
    ds = model.dataset.copy(deep=True)
    ds["coefficient"][2] = np.nan
    with raises("model.freedoms.missing"):
        predictor(ds)


def test_a_dataset_that_predicts_nothing_is_refused(pair: list[xr.Dataset]) -> None:
    with pytest.raises(CompensationError, match=r"found the schema 'errormotion.errors/1'"):
        predictor(pair[0])
