"""Checks of a method that measures one direction only: a correct one passes, a faulty one fails its check."""

import numpy as np
import pytest
import xarray as xr

from errormotion import datasets
from errormotion.errors import MethodError
from errormotion.plugins import Method, MethodInfo, MethodSubject, Needs, PluginSettings
from errormotion.testing import run_checks

SCHEMA = "errormotion.raw.one_sensor/1"
NOISE, CALIBRATION = 1e-7, 2e-7
TIME = 60.0 * np.arange(12)
FEATURES = {"component": "tool", "machine": "none", "frame": "machine", "reference": "time 0"}


class Sound(Method):
    """One sensor measures a body along its beam."""

    info = MethodInfo("one_sensor", "A method that exists in this test only", "simulated_only", cannot_see=("most",))
    needs = Needs((), SCHEMA)
    Settings = PluginSettings
    factor = 1.0

    def acquire(self, bench, settings, *, inputs, done=None):
        raise NotImplementedError

    def append_dim(self, settings):
        return "time"

    def progress(self, settings):
        return 12

    def direction(self, beam):
        return beam

    def identify(self, raw, settings):
        missing = [name for name in ("displacement", "origin", "beam") if name not in raw]
        if raw.attrs.get("schema") != SCHEMA or missing:
            raise MethodError(
                f"expected raw data of schema {SCHEMA}, found {raw.attrs.get('schema')} without {missing}"
            )
        if raw["displacement"].attrs.get("units") != "m":
            raise MethodError("displacement: expected units m")
        raw = raw.sel(direction=["x", "y", "z"])
        return self.result(raw["displacement"].values.astype(float), raw)

    def result(self, deviation, raw):
        shared = np.full((1, 12), CALIBRATION)
        return datasets.build_deviations(
            deviation,
            self.factor * (NOISE**2 + CALIBRATION**2) * np.ones(12),
            np.concatenate([self.direction(raw["beam"].values), np.zeros(3)]),
            dims=("time",),
            coords={"time": TIME},
            influence=shared * min(1.0, np.sqrt(self.factor)),
            sources=["sensor"],
            source_groups=["calibration"],
            functional_point=raw["origin"].values,
            method="one_sensor",
            method_version="1",
            provenance={"settings": {}, "seed": None},
            **FEATURES,
        )

    def plan(self, settings):
        return self.result(np.zeros(12), make(0)[0])


def make(seed):
    """Return readings of a body that drifts, and its six true errors at a point far from the beam."""
    rng = np.random.default_rng(seed)
    origin, point = np.array([0.2, 0.1, -0.3]), np.array([0.1, 0.0, -0.2])
    beam = np.array([2.0, -1.0, 2.0]) / 3
    truth = 1e-5 * np.outer(TIME / TIME[-1], rng.normal(size=6))
    seen = (truth[:, :3] + np.cross(truth[:, 3:], origin - point)) @ beam
    raw = xr.Dataset(
        {
            "displacement": (
                "time",
                seen + rng.normal(0, CALIBRATION) + rng.normal(0, NOISE, 12),
                {"units": "m"},
            ),
            "origin": ("direction", origin, {"units": "m"}),
            "beam": ("direction", beam, {"units": "1"}),
        },
        coords={"time": ("time", TIME, {"units": "s"}), "direction": ["x", "y", "z"]},
        attrs={"schema": SCHEMA},
    )
    errors = datasets.build_errors(
        truth,
        np.zeros((12, 6, 6)),
        dims=("time",),
        coords={"time": TIME},
        functional_point=point,
        method="truth",
        method_version="1",
        provenance={"seed": seed},
        **FEATURES,
    )
    return raw, errors


def failures(method):
    vectors = {"origin": "point", "beam": "direction"}
    results = run_checks(MethodSubject(method, make, raw_vectors=vectors, measured=("displacement",), seeds=60))
    return {result.name: result.message for result in results if not result.ok}


class Confident(Sound):
    """States half of its standard uncertainty."""

    factor = 0.25


class Timid(Sound):
    """States twice its standard uncertainty."""

    factor = 4.0


class Stiff(Sound):
    """The direction is not rotated with the frame."""

    def direction(self, beam):
        return np.array([2.0, -1.0, 2.0]) / 3


def test_a_correct_method_passes_and_its_truth_may_be_six_freedoms():
    assert failures(Sound) == {}


@pytest.mark.parametrize(
    ("method", "failing"),
    [(Confident, {"coverage", "differences"}), (Timid, {"coverage", "differences"}), (Stiff, {"frame_invariance"})],
)
def test_a_fault_is_detected_by_its_check(method, failing):
    found = failures(method)
    assert set(found) & {"coverage", "differences", "frame_invariance"} == failing, found
    assert set(found) <= {*failing, "recovers_truth"}


def test_the_report_of_any_method_shows_a_deviation(tmp_path):
    from errormotion.report import write_report

    errors = Sound().identify(make(0)[0], None)
    page = write_report(errors, tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Observed: deviation, at 12 times." in page
    assert "measured along one known direction only" in page
    assert "standard uncertainty (k = 1) of the deviation, by group of sources" in page
    assert page.count("<svg") == 1
    alone = write_report(errors.isel(time=3), tmp_path / "one.html").read_text(encoding="utf-8")
    assert "The deviation (actual minus commanded" in alone
