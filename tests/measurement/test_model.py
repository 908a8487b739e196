"""A small method on the measurement model: identification, plan, Monte Carlo and simulation from one statement."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
import pytest
import xarray as xr
from coded import raises
from numpy.random import SeedSequence
from pydantic import Field

from errormotion import datasets
from errormotion.arrays import Array
from errormotion.datasets.provenance import of
from errormotion.datasets.schemas import NO_LIMIT, NOISE, READING, RawSchema, Row
from errormotion.estimation.blocks import Block, Constant, Noise
from errormotion.estimation.datum import Datum
from errormotion.estimation.problem import Problem
from errormotion.estimation.sources import Places
from errormotion.measurement import ModelMethod, Observed
from errormotion.measurement.drawing import READINGS
from errormotion.measurement.identification import Solved
from errormotion.montecarlo.trials import trial, trial_model_of, values_of
from errormotion.plugins import MethodInfo, Needs, PluginSettings
from errormotion.report.provenance import simulated

T = TypeVar("T")
SCHEMA = "errormotion.raw.drift_of_scale/1"


class Unknowns(NamedTuple, Generic[T]):
    drift: T


class Known(NamedTuple, Generic[T]):
    gain: T


class DriftSettings(PluginSettings):
    interval: float = Field(60.0, gt=0)
    times: int = Field(8, ge=2)
    repeats: int = Field(5, ge=1)
    noise: float = Field(0.5e-6, gt=0)
    gain: float = Field(0.02, ge=0, description="relative standard uncertainty of the gain")


class Drift(ModelMethod):
    """Drift along Z from repeated readings of a sensor whose gain is uncertain."""

    info: ClassVar[MethodInfo] = MethodInfo(id="drift_of_scale", summary="Test method", status="simulated_only")
    needs: ClassVar[Needs] = Needs(instruments=("point_lds",), raw_schema=SCHEMA)
    Settings: ClassVar[type[PluginSettings]] = DriftSettings
    raw_schemas = (
        RawSchema(
            SCHEMA,
            variant="",
            marker="reading",
            rows=(
                Row("time", ("time",), "s", -NO_LIMIT, NO_LIMIT, "increasing"),
                Row("reading", ("time", "repeat"), "m", *READING, "position of the surface", missing=True),
                Row("reading_noise", (), "m", *NOISE, "standard deviation of one reading", required=False),
            ),
        ),
    )

    def observe(self, raw: xr.Dataset, settings: DriftSettings) -> Observed:
        y = raw["reading"].transpose("time", "repeat").values.astype(float)
        n, m = y.shape
        index = np.repeat(np.arange(n), m)
        noise = float(raw["reading_noise"]) if "reading_noise" in raw else None
        heard = np.isfinite(y).any(axis=1)

        def equation(y: Array, x: Unknowns[Array], c: Known[Array]) -> Array:
            return np.asarray(y - c.gain[:, 0] * x.drift[:, 0])

        gain = Constant(
            value=np.ones((1, 1)), factor=np.full((1, 1, 1), settings.gain), index=np.zeros(n * m, dtype=int),
            scale=1.0, group="gain", identity=["certificate 3: sensor, gain"],
        )  # fmt: skip
        first = np.zeros((n, 1))
        first[0] = 1.0
        start = np.where(heard, 0.0, np.nan)[:, None]
        return Observed(
            problem=Problem(
                equation=equation,
                readings=y.ravel(),
                unknowns=Unknowns(Block(start=np.nan_to_num(start), index=index, scale=1e-3, free=heard)),
                constants=Known(gain),
                noise=Noise(sd=np.full(n * m, noise or 1.0), stated=noise is not None),
            ),
            places=Places(lambda x, c: x.drift + start, n),
            freedoms=("EZ",),
            dims=("time",),
            coords={"time": raw["time"].values},
            component="tool",
            functional_point=(0, 0, 0),
            reference="first time",
            datum=Datum(np.ones((n, 1, 1)), first, "reference state"),
            recorded=("reading", ("time", "repeat")),
        )

    def expected(self, settings: DriftSettings) -> xr.Dataset:
        time = settings.interval * np.arange(settings.times)
        drift = np.tile(20e-6 * (1 - np.exp(-time / 900))[:, None], settings.repeats)
        return xr.Dataset(
            {"reading": (("time", "repeat"), drift, {"units": "m"}),
             "reading_noise": ((), settings.noise, {"units": "m"})},
            {"time": ("time", time, {"units": "s"})},
            {"schema": SCHEMA},
        )  # fmt: skip


METHOD = Drift()
SETTINGS = DriftSettings.model_validate({})


def test_the_result_is_a_valid_error_dataset() -> None:
    raw, truth = METHOD.simulate(SETTINGS, 1)
    errors = METHOD.identify(raw, SETTINGS)
    datasets.validate(errors)
    datasets.validate(truth)
    mean = raw["reading"].mean("repeat").values
    assert errors["EZ"].values == pytest.approx(mean - mean[0], abs=1e-15)
    v = SETTINGS.noise**2 / SETTINGS.repeats
    gain = SETTINGS.gain * errors["EZ"].values[1:]
    assert errors["covariance"].values[1:, 2, 2] == pytest.approx(2 * v + gain**2, rel=1e-7)
    assert errors["covariance"].values[0, 2, 2] == 0.0
    assert np.isnan(errors["EX"]).all()
    assert set(errors["source_group"].values.tolist()) == {"gain", "reference state"}
    assert "certificate 3: sensor, gain" in errors["source_id"].values


def test_unknown_noise_follows_from_the_repeats() -> None:
    raw, _ = METHOD.simulate(SETTINGS, 1)
    errors = METHOD.identify(raw.drop_vars("reading_noise"), SETTINGS)
    assert "is not stated" in errors.attrs["notes"][0]
    s2 = raw["reading"].var("repeat", ddof=1).mean().item()
    student = np.square(errors["covariance"].values[1, 2, 2] - (0.02 * errors["EZ"].values[1]) ** 2) ** 0.5
    assert student == pytest.approx(2 * s2 / SETTINGS.repeats, rel=0.15)
    with raises("estimation.noise.unknown"):
        METHOD.identify(raw.drop_vars("reading_noise").isel(repeat=[0]), SETTINGS)


def test_a_time_without_reading_is_unknown() -> None:
    raw, _ = METHOD.simulate(SETTINGS, 1)
    raw["reading"][3] = np.nan
    errors = METHOD.identify(raw, SETTINGS)
    assert np.flatnonzero(np.isnan(errors["EZ"].values)).tolist() == [3]
    raw["reading"][0] = np.nan
    with raises("estimation.datum.undetermined"):
        METHOD.identify(raw, SETTINGS)


def test_an_outlier_is_excluded_and_named() -> None:
    raw, _ = METHOD.simulate(SETTINGS, 1)
    raw["reading"][4, 2] += 20e-6
    errors = METHOD.identify(raw, SETTINGS)
    assert np.argwhere(errors["left_out"].values).tolist() == [[4, 2]]
    assert "1 of them is not used" in errors.attrs["notes"][0]
    first = raw["reading"].values[0].mean()
    mean = raw["reading"].values[4, [0, 1, 3, 4]].mean() - first
    assert errors["EZ"].values[4] == pytest.approx(mean, abs=1e-12)
    # four of five readings remain at this time: one of them has 3/4 of its error in its residual
    assert errors["redundancy"].values[4, 0] == pytest.approx(3 / 4)
    assert errors["redundancy"].values[3, 0] == pytest.approx(4 / 5)
    assert errors["residual"].values[4, 2] == pytest.approx(raw["reading"].values[4, 2] - mean - first)


def test_valid_readings_are_rarely_excluded() -> None:
    seeds = [METHOD.identify(METHOD.simulate(SETTINGS, seed)[0], SETTINGS) for seed in range(60)]
    assert sum(int(errors["left_out"].sum()) for errors in seeds) <= 1  # one in a thousand data sets is expected


def test_plan_and_identification_have_the_same_sources() -> None:
    planned = METHOD.plan(SETTINGS)
    errors = METHOD.identify(METHOD.expected(SETTINGS), SETTINGS)
    assert planned["source"].values.tolist() == errors["source"].values.tolist()
    assert planned["covariance"].values == pytest.approx(errors["covariance"].values, nan_ok=True)
    assert (planned["EZ"].values == 0).all()
    assert planned.attrs["reference"] == "first time (planned, not measured)"


def test_monte_carlo_agrees_with_the_linear_uncertainty() -> None:
    raw, _ = METHOD.simulate(SETTINGS, 2)
    errors = METHOD.identify(raw, SETTINGS)
    trial_model = trial_model_of(METHOD, raw, SETTINGS, errors)
    assert list(trial_model.sources) == [READINGS, "gain"]
    values = np.array([values_of(trial(METHOD, trial_model, np.random.SeedSequence(7, spawn_key=(k,))))[:, 2]
                       for k in range(300)])  # fmt: skip
    u = np.sqrt(errors["covariance"].values[1:, 2, 2])
    assert values[:, 1:].std(axis=0) == pytest.approx(u, rel=0.15)
    only = [values_of(trial(METHOD, trial_model, np.random.SeedSequence(7, spawn_key=(k,)), only=["gain"]))[-1, 2]
            for k in range(100)]  # fmt: skip
    assert np.std(only) == pytest.approx(SETTINGS.gain * errors["EZ"].values[-1], rel=0.25)


def test_simulated_data_are_covered() -> None:
    inside, seeds = 0, 150
    for seed in range(seeds):
        raw, truth = METHOD.simulate(SETTINGS, seed)
        errors = METHOD.identify(raw, SETTINGS)
        off = (errors["EZ"] - truth["EZ"]).values[-1]
        inside += abs(off) <= 1.96 * np.sqrt(errors["covariance"].values[-1, 2, 2])
    assert abs(inside / seeds - 0.95) < 3.3 * np.sqrt(0.95 * 0.05 / seeds)


def test_truth_of_simulated_data_contains_constants_on_which_the_errors_depend() -> None:
    """The gain is a factor of the errors only, not of the readings."""

    class OfErrors(Drift):
        def observe(self, raw: xr.Dataset, settings: DriftSettings) -> Observed:
            observed = super().observe(raw, settings)
            problem = replace(observed.problem, equation=lambda y, x, c: y - x.drift[:, 0])
            return replace(observed, problem=problem, places=Places(lambda x, c: x.drift * c.gain, settings.times))

    method, ratios, settings = OfErrors(), [], DriftSettings(noise=0.05e-6)
    for seed in range(60):
        raw, truth = method.simulate(settings, seed)
        off = (method.identify(raw, settings)["EZ"] - truth["EZ"]).values[-1]
        ratios.append(off / (settings.gain * 20e-6 * (1 - np.exp(-420 / 900))))
    # 60 draws: 1 +- 0.09; the noise of two times of five repeats adds 2 %
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.02, abs=0.35)


def test_a_method_without_instruments_refuses_to_measure() -> None:
    with raises("method.imported_only"):
        METHOD.acquire(None, SETTINGS, inputs={})  # type: ignore[arg-type]
    assert METHOD.append_dim(SETTINGS) == "time"
    assert METHOD.progress(replace_times(SETTINGS, 5)) == 5


def replace_times(settings: DriftSettings, times: int) -> Any:
    return settings.model_copy(update={"times": times})


def test_simulation_needs_the_variable_of_the_readings() -> None:
    class Silent(Drift):
        def observe(self, raw: xr.Dataset, settings: DriftSettings) -> Observed:
            return replace(super().observe(raw, settings), recorded=None)

    with pytest.raises(ValueError, match="recorded"):
        Silent().simulate(SETTINGS, 0)


def test_an_unknown_noise_has_its_size_in_words() -> None:
    class Worded(Drift):
        def observe(self, raw: xr.Dataset, settings: DriftSettings) -> Observed:
            return replace(super().observe(raw, settings), noise_size=lambda size: f"{size * 1e6:.2g} um")

    raw, _ = METHOD.simulate(SETTINGS, 1)
    note = Worded().identify(raw.drop_vars("reading_noise"), SETTINGS).attrs["notes"][0]
    assert " um from the residuals" in note


def test_what_follows_from_a_solution_is_part_of_result_plan_and_trials() -> None:
    class Further(Drift):
        def observe(self, raw: xr.Dataset, settings: DriftSettings) -> Observed:
            def finish(solved: Solved) -> Solved:
                errors = solved.relative.errors
                assert solved.propagated == bool(errors.sources)
                shifted = replace(errors, value=errors.value + 1e-3)
                largest = xr.DataArray(float(np.nanmax(shifted.value)), attrs={"units": "m"})
                observed = replace(solved.observed, extras={"largest": largest})
                return replace(solved, observed=observed, relative=replace(solved.relative, errors=shifted))

            return replace(super().observe(raw, settings), finish=finish)

    method = Further()
    raw, _ = METHOD.simulate(SETTINGS, 1)
    errors = method.identify(raw, SETTINGS)
    assert float(errors["largest"]) == float(errors["EZ"].max())
    assert "largest" in method.plan(SETTINGS)
    trial_model = trial_model_of(method, raw, SETTINGS, errors)
    plain = trial(METHOD, trial_model_of(METHOD, raw, SETTINGS, METHOD.identify(raw, SETTINGS)), SeedSequence(7))
    found = trial(method, trial_model, SeedSequence(7))
    assert found["EZ"].values == pytest.approx(plain["EZ"].values + 1e-3, abs=1e-12)


def test_a_trial_has_the_values_of_the_identification_of_its_readings() -> None:
    """Of values only, from the solution of the measured readings: the same ones as by all of the identification."""
    raw, _ = METHOD.simulate(SETTINGS, 1)
    errors = METHOD.identify(raw, SETTINGS)
    drawn = trial_model_of(METHOD, raw, SETTINGS, errors)
    draw = drawn.sources[READINGS].draw
    assert draw is not None
    assert drawn.identify is not None
    changed, _ = draw(drawn.raw, SETTINGS, np.random.default_rng(3))
    found = drawn.identify(changed, SETTINGS)
    y = changed[READINGS].values.reshape(raw["reading"].shape)
    assert np.abs(y - raw["reading"].values).max() > SETTINGS.noise
    again = METHOD.identify(raw.assign(reading=raw["reading"].copy(data=y)), SETTINGS)
    u = np.sqrt(errors["covariance"].values[:, 2, 2])
    assert np.abs(found["EZ"].values - again["EZ"].values).max() < 1e-6 * u.max()


def test_an_error_along_one_direction_is_a_deviation() -> None:
    class Along(Drift):
        def observe(self, raw: xr.Dataset, settings: DriftSettings) -> Observed:
            along = np.tile([0.6, 0.0, 0.8, 0.0, 0.0, 0.0], (raw.sizes["time"], 1))
            return replace(super().observe(raw, settings), sensitivity=along)

        def results(self, observed: Observed, fit: Any, relative: Any) -> dict[str, xr.DataArray]:
            return {"last": xr.DataArray(relative.errors.value[-1, 0], attrs={"units": "m"})}

    method = Along()
    raw, truth = method.simulate(SETTINGS, 1)
    errors, of_freedom = method.identify(raw, SETTINGS), METHOD.identify(raw, SETTINGS)
    np.testing.assert_array_equal(errors["deviation"], of_freedom["EZ"])
    np.testing.assert_array_equal(errors["deviation_variance"], of_freedom["covariance"].values[:, 2, 2])
    np.testing.assert_array_equal(errors["deviation_influence"], of_freedom["influence"].values[..., 2])
    assert errors["sensitivity"].values[3].tolist() == [0.6, 0.0, 0.8, 0.0, 0.0, 0.0]
    assert np.isnan(errors["EZ"]).all()
    assert float(np.abs(truth["deviation_variance"]).max()) == 0.0
    plan = method.plan(SETTINGS)
    assert float(np.abs(plan["deviation"]).max()) == float(plan["last"]) == 0.0
    assert float(errors["last"]) == float(errors["deviation"][-1])


def test_one_dim_of_the_result_needs_no_coordinate() -> None:
    class Twice(Drift):
        def observe(self, raw: xr.Dataset, settings: DriftSettings) -> Observed:
            observed = super().observe(raw, settings)
            side = {"side": ("side", ["a", "b"], {"long_name": "side of the table"})}
            return replace(observed, dims=("side", "target"), coords=side, recorded=None)

    errors = Twice().identify(METHOD.simulate(SETTINGS, 1)[0], SETTINGS)
    assert dict(errors["EZ"].sizes) == {"side": 2, "target": SETTINGS.times // 2}


def test_simulated_data_state_that_no_instrument_measured() -> None:
    raw, _ = METHOD.simulate(SETTINGS, 1)
    errors = METHOD.identify(raw, SETTINGS)
    assert simulated(of(errors)) == "the provenance marks them as simulated"


def test_attributes_hash_and_start_of_the_result_are_those_that_the_model_states() -> None:
    class Stating(Drift):
        def observe(self, raw: xr.Dataset, settings: DriftSettings) -> Observed:
            return replace(super().observe(raw, settings), attrs={"mode": "slow"}, zero=90.0, raw_hash="abc")

    raw, _ = METHOD.simulate(SETTINGS, 1)
    errors = Stating().identify(raw.assign_attrs(start="2026-03-02T07:00:00+00:00"), SETTINGS)
    assert errors.attrs["mode"] == "slow"
    assert errors.attrs["start"].startswith("2026-03-02T07:01:30")
    assert json.loads(errors.attrs["provenance"])["raw"]["hash"] == "abc"


def test_a_model_may_omit_the_reliability_of_its_readings() -> None:
    class Plain(Drift):
        def observe(self, raw: xr.Dataset, settings: DriftSettings) -> Observed:
            return replace(super().observe(raw, settings), reliability=False)

    raw, _ = METHOD.simulate(SETTINGS, 1)
    errors = Plain().identify(raw, SETTINGS)
    assert not {"residual", "redundancy", "smallest_error", "left_out"} & set(errors)
    np.testing.assert_array_equal(errors["covariance"], METHOD.identify(raw, SETTINGS)["covariance"])
