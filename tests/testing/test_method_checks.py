"""A correct method passes the kit, and each broken one fails exactly the check for its fault."""

from dataclasses import replace
from functools import cache
from unittest import SkipTest

import numpy as np
import pytest
import xarray as xr
from pydantic import ConfigDict

from errormotion import datasets
from errormotion.datasets.results.merit import last_values
from errormotion.errors import MethodError
from errormotion.kinematics.twists import cross_matrix
from errormotion.plugins import Method, MethodInfo, Needs, PluginSettings, RandomSource, TrialModel
from errormotion.report.document import Part
from errormotion.testing import MethodConformance, MethodSubject, run_checks
from errormotion.testing.checks.method import METHOD_CHECKS
from errormotion.testing.kit import run_check

SCHEMA = "errormotion.raw.body/1"
NOISE = 1e-7  # m, of one reading
CALIBRATION = 2e-7  # m, of one sensor's offset, the same at all times
CHANNELS = ["a", "b", "c", "d", "e", "f", "g", "h"]
NEEDED = ("displacement", "origin", "beam")


class Settings(PluginSettings):
    noise: float = NOISE


class Sound(Method):
    """Eight sensors measure a body from known positions; its six freedoms follow by least squares."""

    info = MethodInfo("body", "A method that exists in this test only", "simulated_only", cannot_see=("its shape",))
    needs = Needs((), SCHEMA)
    Settings = Settings

    def acquire(self, bench, settings, *, inputs, done=None):
        raise NotImplementedError

    def append_dim(self, settings):
        return "time"

    def progress(self, settings):
        return 12

    def checked(self, raw):
        if raw.attrs.get("schema") != SCHEMA:
            raise MethodError(f"expected raw data of schema {SCHEMA}, found schema {raw.attrs.get('schema')}")
        missing = [name for name in NEEDED if name not in raw]
        if missing:
            raise MethodError(f"missing: {', '.join(missing)}")
        self.check_unit(raw["displacement"].attrs.get("units"))
        return raw.sel(direction=["x", "y", "z"])

    def check_unit(self, unit):
        if unit != "m":
            raise MethodError(f"displacement: expected units m, found {unit}")

    def displacement(self, raw):
        return raw["displacement"].transpose("channel", "time").values.astype(float)

    def identify(self, raw, settings):
        raw = self.checked(raw)
        origin = raw["origin"].transpose("channel", "direction").values
        beam = raw["beam"].transpose("channel", "direction").values
        readings = self.displacement(raw)
        point = origin.mean(axis=0)
        gain = np.linalg.pinv(design(origin, beam, point), rcond=1e-10)
        values = self.values((gain @ readings).T, gain)
        source = np.repeat(CALIBRATION * gain.T[:, None, :], len(values), axis=1)
        spread = np.broadcast_to((settings.noise**2 + CALIBRATION**2) * gain @ gain.T, (len(values), 6, 6))
        return self.result(raw["time"].values, values, spread, source, point, list(raw["channel"].values), settings)

    def values(self, values, gain):
        return values

    def result(self, time, values, spread, source, point, channels, settings):
        return datasets.build_errors(
            values,
            spread,
            dims=("time",),
            coords={"time": time},
            component="spindle",
            machine="none",
            frame="machine",
            functional_point=point,
            reference="time 0",
            method="body",
            method_version="1",
            provenance={"settings": settings.model_dump()},
            influence=source,
            sources=channels,
            source_groups=["calibration"] * len(channels),
        )

    def plan(self, settings):
        raw, _ = make(0)
        errors = self.identify(raw, settings)
        return errors.assign({name: (errors[name] * 0).assign_attrs(errors[name].attrs) for name in datasets.DOF})

    def expected(self, settings):
        return make(0)[0]


def design(origin, beam, point):
    """Return the derivatives of the readings by the freedoms, scaled to lengths: (channel, 6)."""
    return np.concatenate([beam, np.einsum("cij,cj->ci", cross_matrix(origin - point), beam)], axis=1)


def make(seed):
    """Return raw data of a body with a drift of some um and urad, and its true errors."""
    raw, errors = made(seed)
    return raw.copy(deep=True), errors


@cache
def made(seed):
    """Return the same, not to be changed: all methods measure the same bodies."""
    rng = np.random.default_rng(seed)
    place = np.random.default_rng(7)  # the same set-up each time
    origin = place.uniform(-0.5, 0.5, (8, 3))
    beam = place.normal(size=(8, 3))
    beam /= np.linalg.norm(beam, axis=1, keepdims=True)
    time = np.arange(12) * 60.0
    point = np.array([0.1, 0.0, -0.2])
    truth = 1e-5 * np.outer(time / time[-1], rng.normal(size=6))
    readings = design(origin, beam, point) @ truth.T
    readings += rng.normal(0, CALIBRATION, (8, 1)) + rng.normal(0, NOISE, (8, 12))
    raw = xr.Dataset(
        {
            "displacement": (("channel", "time"), readings, {"units": "m"}),
            "origin": (("channel", "direction"), origin, {"units": "m"}),
            "beam": (("channel", "direction"), beam, {"units": "1"}),
        },
        coords={"channel": CHANNELS, "time": ("time", time, {"units": "s"}), "direction": ["x", "y", "z"]},
        attrs={"schema": SCHEMA},
    )
    errors = datasets.build_errors(
        truth,
        np.zeros((12, 6, 6)),
        dims=("time",),
        coords={"time": time},
        component="spindle",
        machine="none",
        frame="machine",
        functional_point=point,
        reference="time 0",
        method="truth",
        method_version="1",
        provenance={"seed": seed},
    )
    return raw, errors


SOUND = MethodSubject(Sound, make, raw_vectors={"origin": "point", "beam": "direction"})


class TestSound(MethodConformance):
    subject = SOUND


class CannotSayWhatItCannotSee(Sound):
    info = replace(Sound.info, cannot_see="its shape")


class NeedsAnUnknownKind(Sound):
    needs = Needs(("point_lsd",), SCHEMA)


class SwallowsUnknownSettings(Sound):
    class Settings(Settings):
        model_config = ConfigDict(extra="ignore")


class WritesProgramsOfUnknownMoves(Sound):
    def programs(self, settings, instruments):
        return {"a.nc": "G1 X100 F100"}


class ForgetsItsVersion(Sound):
    def result(self, *args):
        return super().result(*args).assign_attrs(method_version="0")


class JoinsAlongNothing(Sound):
    def append_dim(self, settings):
        return "instant"


class Rolls(Sound):
    def values(self, values, gain):
        return values + 1e-13 * np.random.normal(size=values.shape)  # noqa: NPY002


class ExaggeratesOneInstant(Sound):
    def values(self, values, gain):
        values[1] *= 10
        return values


class HidesABias(Sound):
    """Has a constant error of up to a fifth of a micrometre in each sensor."""

    def values(self, values, gain):
        return values + gain @ np.full(8, 2.5e-7)


class ForgetsWhatTimesShare(Sound):
    def result(self, *args):
        return super().result(*args).drop_vars(["influence", "source", "source_group"])


class KnowsOnlyItsOwnFrame(Sound):
    def values(self, values, gain):
        return values + np.array([1e-9, 0, 0, 0, 0, 0])


class TakesSinglePrecisionForMicrometres(Sound):
    def displacement(self, raw):
        return super().displacement(raw) * (1.0 if raw["displacement"].dtype == np.float64 else 1e-6)


class TakesMillimetresForMetres(Sound):
    def check_unit(self, unit):
        pass


class CountsOnTheOrderOfDimensions(Sound):
    def displacement(self, raw):
        return raw["displacement"].values.astype(float)


class RaisesKeyErrors(Sound):
    def checked(self, raw):
        return super().checked(raw[[*NEEDED]])


class TakesAnySchema(Sound):
    def checked(self, raw):
        return super().checked(raw.assign_attrs(schema=SCHEMA))


class TakesNothingForZero(Sound):
    def displacement(self, raw):
        return np.nan_to_num(super().displacement(raw))


class LeavesItsMark(Sound):
    def checked(self, raw):
        checked = super().checked(raw)
        raw["displacement"].attrs["identified"] = "yes"
        return checked


class ReadsMemoryOnly(Sound):
    def checked(self, raw):
        checked = super().checked(raw)
        if not isinstance(raw["displacement"].variable._data, np.ndarray):
            raise MethodError("expected arrays in memory")
        return checked


class PlansOneFreedom(Sound):
    def plan(self, settings):
        planned = super().plan(settings)
        values = np.stack([planned[name].values for name in datasets.DOF], axis=-1)
        values[:, 1:] = np.nan
        spread, source = planned["covariance"].values, planned["influence"].values
        point = planned.attrs["functional_point"]
        return self.result(planned["time"].values, values, spread, source, point, CHANNELS, settings)


class DrawnSources(Sound):
    """Draws the noise of its readings and the calibration of its sensors."""

    calibration = CALIBRATION
    groups = ("calibration",)

    def trial_model(self, raw, settings, errors):
        def shifted(size, shape):
            def draw(raw, settings, generator):
                shift = self.generator(generator).normal(0, size, shape)
                return raw.assign(displacement=(raw["displacement"] + shift).assign_attrs(units="m")), settings

            return draw

        order = raw["displacement"].transpose("channel", "time")
        each, one = order.shape, (order.shape[0], 1)
        sources = {"noise": RandomSource(shifted(settings.noise, each), own=True)}
        sources["calibration"] = RandomSource(shifted(self.calibration, one), groups=self.groups)
        return TrialModel(raw.assign(displacement=order), settings, sources)

    def generator(self, given):
        return given


class LeavesATextInEnglish(Sound):
    def chapters(self, source):
        return [Part("Drift of a body", [], ["It drifts."], [])]

    def texts(self, language):
        return {"Drift of a body": "Drift eines Körpers"} if language == "de" else {}


class StatesFigures(Sound):
    @staticmethod
    def figures(errors):
        return last_values(errors)


class StatesFiguresOfOtherVariables(Sound):
    @staticmethod
    def figures(errors):
        return [replace(each, value=each.expanded_uncertainty) for each in last_values(errors)]


class IsTooSureOfItsFigures(Sound):
    @staticmethod
    def figures(errors):
        return [replace(each, expanded_uncertainty=each.expanded_uncertainty / 3) for each in last_values(errors)]


class RollsItsOwnDice(DrawnSources):
    def generator(self, given):
        return np.random.default_rng()


class DrawsHalfOfItsCalibration(DrawnSources):
    calibration = CALIBRATION / 2


class ForgetsItsCalibration(DrawnSources):
    groups = ()


class PlansOtherSources(Sound):
    def plan(self, settings):
        planned = super().plan(settings)
        return planned.assign_coords(source_group=("source", ["sensors"] * planned.sizes["source"]))


class PlansHalfOfTheNoise(Sound):
    def plan(self, settings):
        return super().plan(Settings(noise=NOISE / 2))


BROKEN = [
    ("info_complete", CannotSayWhatItCannotSee),
    ("info_complete", NeedsAnUnknownKind),
    ("settings_strict", SwallowsUnknownSettings),
    ("motions_stated", WritesProgramsOfUnknownMoves),
    ("schema", ForgetsItsVersion),
    ("joins_along_a_dimension", JoinsAlongNothing),
    ("deterministic", Rolls),
    ("recovers_truth", ExaggeratesOneInstant),
    ("coverage", HidesABias),
    ("differences", ForgetsWhatTimesShare),
    ("figures", IsTooSureOfItsFigures),
    ("sources_drawn", RollsItsOwnDice),
    ("sources_drawn", ForgetsItsCalibration),
    ("sources_as_stated", DrawsHalfOfItsCalibration),
    ("chapters_translated", LeavesATextInEnglish),
    ("frame_invariance", KnowsOnlyItsOwnFrame),
    ("number_format", TakesSinglePrecisionForMicrometres),
    ("units", TakesMillimetresForMetres),
    ("layout", CountsOnTheOrderOfDimensions),
    ("refuses_missing_inputs", RaisesKeyErrors),
    ("refuses_missing_inputs", TakesAnySchema),
    ("nothing_measured", TakesNothingForZero),
    ("leaves_inputs_alone", LeavesItsMark),
    ("round_trip", ReadsMemoryOnly),
    ("plan", PlansOneFreedom),
    ("plan_agrees", PlansOtherSources),
    ("plan_agrees", PlansHalfOfTheNoise),
]
STATISTICAL = ("recovers_truth", "coverage", "figures", "differences", "sources_as_stated")


@pytest.mark.parametrize(("check", "plugin"), BROKEN, ids=lambda value: getattr(value, "__name__", value))
def test_a_broken_method_fails_exactly_its_check(check, plugin):
    results = run_checks(replace(SOUND, plugin=plugin, seeds=20 if check in STATISTICAL else 8))
    failed = {result.name: result.message for result in results if not result.ok}
    assert failed.keys() == {check}


def test_a_method_that_draws_its_sources_as_stated_passes():
    results = {result.name: result for result in run_checks(replace(SOUND, plugin=DrawnSources, seeds=20))}
    assert [name for name, result in results.items() if not result.ok] == []
    assert not results["sources_as_stated"].skipped


def test_figures_that_do_not_follow_from_the_errors_are_not_checked_which_only_a_run_shows():
    made = []

    def counted(seed):
        made.append(seed)
        return make(seed)

    class Tests(MethodConformance):
        subject = replace(SOUND, plugin=StatesFiguresOfOtherVariables, make=counted)
        test_schema = None

    assert made == []
    assert Tests.test_schema is None
    with pytest.raises(SkipTest, match="no figures that follow from its errors alone"):
        Tests().test_figures()


def test_a_method_with_honest_figures_passes():
    check = next(check for check in METHOD_CHECKS if check.name == "figures")
    result = run_check(check, replace(SOUND, plugin=StatesFigures, seeds=20))
    assert (result.ok, result.skipped) == (True, False)
    assert "20 seeds; 6 figures" in result.message
    assert run_check(check, SOUND).skipped


def test_a_procedure_of_which_nothing_is_expected_has_no_plan_to_compare():
    class ExpectsNothing(Sound):
        def expected(self, settings):
            raise NotImplementedError("this procedure has no expected raw data")

    check = next(check for check in METHOD_CHECKS if check.name == "plan_agrees")
    result = run_check(check, replace(SOUND, plugin=ExpectsNothing))
    assert result.skipped
    assert "this procedure has no expected raw data" in result.message


def test_for_every_check_a_plugin_fails():
    assert {check for check, _ in BROKEN} == {check.name for check in METHOD_CHECKS}


def test_every_check_states_its_requirement():
    assert all(len(check.claim) > 30 for check in METHOD_CHECKS)


@pytest.mark.parametrize(("factor", "verdict"), [(1 / 1.3, "too small"), (1.3, "too large")])
def test_a_covariance_with_an_error_of_thirty_per_cent_is_detected(factor, verdict):
    class States(Sound):
        def result(self, time, values, spread, source, *rest):
            return super().result(time, values, factor * spread, np.sqrt(factor) * source, *rest)

    check = next(check for check in METHOD_CHECKS if check.name == "coverage")
    result = run_check(check, replace(SOUND, plugin=States))
    assert not result.ok
    assert f"the stated covariance is {verdict}" in result.message
