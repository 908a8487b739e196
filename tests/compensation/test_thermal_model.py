"""A thermal model predicts another warm-up, and states its uncertainty."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion import datasets
from errormotion.compensation.online.settings import Limits
from errormotion.compensation.thermal_model import ThermalModel, ThermalModelSettings, check, fit
from errormotion.compensation.thermal_model.fitting import MIN_SAMPLES
from errormotion.compensation.thermal_model.model import ROWS
from errormotion.compensation.thermal_model.plugin import ThermalModelDataset
from errormotion.datasets.schemas import DOF
from errormotion.errors import DatasetError

LAGGED = ThermalModelSettings(variant="lagged", lags=("10 min",))
DYNAMICS = ThermalModelSettings(variant="dynamics", time_constants=("30 min",))


@pytest.fixture(scope="module")
def model(pair: list[xr.Dataset]) -> ThermalModel:
    return fit(pair, LAGGED)


@pytest.mark.parametrize("settings", [LAGGED, DYNAMICS], ids=["lagged", "dynamics"])
def test_a_warm_up_with_another_speed_profile_is_predicted(
    settings: ThermalModelSettings, pair: list[xr.Dataset], warm_up: Callable[..., xr.Dataset]
) -> None:
    """The largest errors by at least 80 %; the rest of the small ones is measurement noise, 0.3 um."""
    third = warm_up(3, 2)
    found = check(fit(pair, settings), third)
    assert (found.removed[[1, 2, 3, 4]] > 0.8).all()
    size = np.sqrt((found.rms[:3] ** 2).sum()), np.sqrt((found.remaining[:3] ** 2).sum())
    assert size[1] < 0.2 * size[0]
    assert (found.held >= 0.9).all()
    assert found.outside == 0


def test_intervals_cover_the_truth_over_machines(warm_up: Callable[..., xr.Dataset]) -> None:
    """Eight machines, six errors, thirty times each; the misfit is common to a machine, so one may deviate."""
    settings = ThermalModelSettings(variant="lagged", sensors=("head", "motor", "column_front"), lags=("10 min",))
    held = [check(fit([warm_up(s, 0), warm_up(s, 1)], settings), warm_up(s, 2)).held for s in range(10, 18)]
    assert np.mean(held) > 0.93
    assert np.min(np.mean(held, axis=1)) > 0.85


def test_the_prediction_is_an_error_dataset_with_sources(model: ThermalModel, pair: list[xr.Dataset]) -> None:
    predicted = model.predict(pair[0])
    datasets.validate(predicted)
    assert predicted.attrs["method"] == "thermal_model"
    assert set(predicted["source_group"].values) == {"coefficients", "misfit"}
    total = np.einsum("stj,stk->tjk", predicted["influence"].values, predicted["influence"].values)
    np.testing.assert_allclose(predicted["covariance"].values, total)
    for name in DOF:
        assert float(predicted[name][0]) == 0.0


@pytest.mark.parametrize(("times", "sensors"), [(2_000_000, 1), (1_100, 1_000), (300_000, 4)])
def test_a_small_file_that_states_many_values_is_refused_before_the_fit(
    times: int, sensors: int, pair: list[xr.Dataset]
) -> None:
    """Constant values are compressed by a factor of a thousand; here they require no memory."""
    small = pair[0].isel(time=0, drop=True).drop_dims("sensor")
    packed = small.expand_dims(time=np.arange(float(times)))
    packed["temperature"] = (("time", "sensor"), np.broadcast_to(20.0, (times, sensors)))
    with pytest.raises(DatasetError, match=r"Expected at most \d+ temperature"):
        fit([packed])


def test_a_prediction_of_too_many_times_is_refused(model: ThermalModel) -> None:
    """The covariance of a prediction takes far more memory than its inputs."""
    log = xr.Dataset(
        {"temperature": (("time", "sensor"), np.broadcast_to(20.0, (1_000_001, len(model.sensors))))},
        {"time": np.arange(1_000_001.0), "sensor": list(model.sensors)},
    )
    with raises("model.times.too_many"):
        model.predict(log)


def test_simulated_data_are_marked_as_such(model: ThermalModel, pair: list[xr.Dataset]) -> None:
    behind = json.loads(pair[0].attrs["provenance"])["instruments"]
    assert behind
    for ds in (model.dataset, model.predict(pair[0])):
        assert json.loads(ds.attrs["provenance"])["instruments"] == behind
    log = pair[0].drop_vars(["EX"]).assign_attrs(provenance="{}", instruments=json.dumps([{"address": "sim://x"}]))
    reported = json.loads(model.predict(log).attrs["provenance"])["instruments"]
    assert reported == [{"address": "sim://x"}, *behind]


def test_times_beyond_the_training_are_flagged(model: ThermalModel, pair: list[xr.Dataset]) -> None:
    hot = pair[0].copy(deep=True)
    hot["temperature"] = hot["temperature"] + 5.0 * (hot["time"] > 7200.0)
    predicted = model.predict(hot)
    assert not predicted["outside"].sel(time=slice(0, 7200)).any()
    assert predicted["outside"].sel(time=slice(7300, None)).all()
    assert "outside the training range" in predicted.attrs["notes"][0]


def test_an_unknown_temperature_causes_an_unknown_error_and_is_counted(
    model: ThermalModel, pair: list[xr.Dataset]
) -> None:
    torn = pair[0].copy(deep=True)
    torn["temperature"].loc[{"time": torn["time"][4], "sensor": model.sensors[0]}] = np.nan
    predicted = model.predict(torn)
    assert np.isnan(predicted["EZ"][4])
    assert int(np.isnan(predicted["EZ"]).sum()) == 1
    assert "1 of 31 times have no prediction" in predicted.attrs["notes"][0]


def test_figures_are_those_of_the_datasets(model: ThermalModel, pair: list[xr.Dataset]) -> None:
    found = {figure.name: figure for figure in ThermalModelDataset.figures(model.dataset)}
    assert found["misfit of EZ"].value == float(model.dataset["misfit"][2])
    assert found["removed fraction of EZ"].value == float(model.dataset["removed"][2])
    predicted = model.predict(pair[0])
    found = {figure.name: figure for figure in ThermalModelDataset.figures(predicted)}
    last = found["EZ after 180.0 min"]
    assert (last.value, last.unit) == (float(predicted["EZ"][-1]), "m")
    assert last.expanded_uncertainty == pytest.approx(2 * float(np.sqrt(predicted["covariance"][-1, 2, 2])))
    assert found["fraction of times outside the training range"].value == float(predicted["outside"].mean())


def test_a_saved_model_predicts_the_same(model: ThermalModel, pair: list[xr.Dataset], tmp_path: Path) -> None:
    model.save(tmp_path / "m.nc")
    again = ThermalModel.load(tmp_path / "m.nc")
    assert again.features == model.features
    xr.testing.assert_identical(again.predict(pair[1]), model.predict(pair[1]))
    with raises("file.exists"):
        model.save(tmp_path / "m.nc")


def test_an_unmeasured_error_remains_unknown(pair: list[xr.Dataset]) -> None:
    blind = [ds.copy(deep=True) for ds in pair]
    for ds in blind:
        ds["EC"] = ds["EC"] * np.nan
        covariance = ds["covariance"].values.copy()
        covariance[:, 5, :] = covariance[:, :, 5] = np.nan
        ds["covariance"] = (ds["covariance"].dims, covariance)
    predicted = fit(blind, LAGGED).predict(blind[0])
    assert np.isnan(predicted["EC"]).all()
    assert np.isfinite(predicted["EZ"]).all()


def test_sensors_near_the_heat_are_selected(pair: list[xr.Dataset]) -> None:
    """A sensor with noise only is not selected."""
    noisy = []
    for number, ds in enumerate(pair):
        noise = 20 + np.random.default_rng(number).normal(size=(ds.sizes["time"], 1))
        fake = xr.DataArray(noise, dims=("time", "sensor"), coords={"sensor": ["dice"]})
        whole = xr.concat([ds["temperature"].drop_vars("temperature", errors="ignore"), fake], dim="sensor")
        plain = ds.drop_vars(["temperature", "sensor"])
        noisy.append(plain.assign_coords(sensor=whole["sensor"], temperature=whole))
    assert "dice" not in fit(noisy, LAGGED).sensors


def test_one_campaign_alone_is_reported(pair: list[xr.Dataset]) -> None:
    assert fit(pair[:1], LAGGED).dataset.attrs["validated"] == "blocks in time of one campaign"


def test_a_model_of_one_warm_up_is_usable_at_other_speeds(warm_up: Callable[..., xr.Dataset]) -> None:
    """A validation by blocks alone would select a model with 10 features and U = 17 um."""
    model = fit([warm_up(29, 0).isel(time=slice(None, None, 2))], ThermalModelSettings(variant="dynamics"))
    covariance = model.predict(warm_up(29, 2))["covariance"].values[:, :3, :3]
    assert 2 * np.sqrt(np.einsum("tii->ti", covariance).max()) < Limits().uncertainty / 2


def of_noise(ds: xr.Dataset, keep: int) -> xr.Dataset:
    """Return errors of which most temperatures are noise."""
    noise = 20 + 0.02 * np.random.default_rng(5).normal(size=ds["temperature"].shape)
    noise[:, :keep] = ds["temperature"].values[:, :keep]
    return ds.assign(temperature=(ds["temperature"].dims, noise))


@pytest.mark.parametrize("keep", [0, 1])
def test_a_model_of_one_warm_up_uses_a_sensor_that_shows_the_heat(
    warm_up: Callable[..., xr.Dataset], keep: int
) -> None:
    """A validation by blocks would select only the speed on this machine, whatever the first sensor shows."""
    settings = ThermalModelSettings(variant="dynamics", time_constants=("30 min",))
    one = of_noise(warm_up(3, 0), keep)
    assert fit([one], settings).sensors == tuple(map(str, one["sensor"].values[:keep]))


def changed(ds: xr.Dataset, **attrs: object) -> xr.Dataset:
    return ds.assign_attrs(attrs)


def test_incompatible_campaigns_are_an_error(pair: list[xr.Dataset]) -> None:
    first, second = pair
    with raises("model.no_campaigns"):
        fit([])
    with raises("model.attribute.differs"):
        fit([first, changed(second, machine="Another")])
    with raises("model.point.differs"):
        fit([first, changed(second, functional_point=np.array([0.0, 0.0, 0.3]))])
    with pytest.raises(DatasetError, match=f"at least {MIN_SAMPLES} known values"):
        fit([first.isel(time=slice(0, 4))])
    with raises("model.sensors.unknown"):
        fit(pair, ThermalModelSettings(sensors=("nose",)))


def test_a_repeated_campaign_is_an_error(pair: list[xr.Dataset]) -> None:
    with raises("model.campaign.same"):
        fit([pair[0], pair[0].copy()])


def test_a_sensor_unknown_in_one_campaign_is_not_used(pair: list[xr.Dataset]) -> None:
    """A broken sensor is NaN throughout. If all are, the campaign is an error."""
    deaf = pair[1].copy(deep=True)
    deaf["temperature"].loc[{"sensor": "head"}] = np.nan
    model = fit([pair[0], deaf], ThermalModelSettings(variant="lagged", most_sensors=2))
    assert len(model.sensors) == 2
    assert "head" not in model.sensors
    deaf["temperature"][:] = np.nan
    with raises("model.sensors.none"):
        fit([pair[0], deaf], ThermalModelSettings(variant="lagged"))


def test_a_check_requires_the_same_component(model: ThermalModel, pair: list[xr.Dataset]) -> None:
    with raises("model.attribute.differs"):
        check(model, changed(pair[0], component="tool"))


def test_a_file_that_is_no_model_is_refused(tmp_path: Path, pair: list[xr.Dataset], model: ThermalModel) -> None:
    datasets.save(pair[0], tmp_path / "errors.nc")
    with pytest.raises(
        DatasetError, match=r"expected schema errormotion\.model\.thermal/1; found errormotion\.errors/1"
    ):
        ThermalModel.load(tmp_path / "errors.nc")
    with pytest.raises(DatasetError, match="coefficient"):
        ThermalModel(model.dataset.drop_vars("coefficient"))


def test_the_page_of_schemas_has_the_table_of_the_model() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "schemas.md").read_text()
    section = page.partition("\n## Thermal model")[2].partition("\n## ")[0]
    reported = [line for line in section.splitlines() if line.startswith("| `")]
    assert [line.split("|")[1].strip(" `") for line in reported] == [row.name for row in ROWS]
    for line, row in zip(reported, ROWS, strict=True):
        assert row.meaning in line
        assert ", ".join(row.dims) in line


def test_an_error_that_only_one_campaign_contains_is_not_modelled(pair: list[xr.Dataset]) -> None:
    without = pair[1].assign(EY=pair[1]["EY"] * np.nan)
    model = fit([pair[0], without], LAGGED)
    coefficient = model.dataset["coefficient"].values
    assert np.isnan(coefficient[1]).all()
    assert np.isfinite(np.delete(coefficient, 1, axis=0)).all()
    assert model.predict(pair[1])["EY"].isnull().all()
    empty = [ds.assign({name: ds[name] * np.nan for name in DOF}) for ds in pair]
    with raises("model.values.too_few"):
        fit([pair[0], empty[1]], LAGGED)
