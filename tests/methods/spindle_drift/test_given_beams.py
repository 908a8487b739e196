"""A drift takes its beams from one detection of all, or from calibrations of one beam after the other."""

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion.methods.spindle_drift import SpindleDrift, SpindleDriftSettings, simulation
from errormotion.methods.spindle_drift.acquisition.given_beams import REQUIRED, given_beams
from errormotion.twin import VirtualMachine

CHANNELS = ("X1", "X2", "Y1", "Y2", "Z")


@pytest.fixture(scope="module")
def detected():
    return SpindleDrift().identify(
        simulation.raw_beam_detection(VirtualMachine("cframe", seed=2), seed=5), SpindleDriftSettings()
    )


def alone(beams, channel, name="beam"):
    """Return one beam as the result of a separate calibration: ``beam`` of size 1, with another name."""
    return beams.sel(beam=[channel]).assign_coords(beam=[name])


def test_beams_found_one_by_one_are_those_found_together(detected):
    together = given_beams({"beams": detected})
    single = given_beams({name: alone(detected, name) for name in CHANNELS})
    xr.testing.assert_identical(together, single)
    assert list(together["beam"].values) == list(CHANNELS)
    for name in REQUIRED:
        np.testing.assert_array_equal(together[name].values, detected[name].values)


def test_single_beam_has_priority_over_that_of_the_whole_frame(detected):
    better = alone(detected, "Y2").assign(beam_origin=detected["beam_origin"].sel(beam=["Y1"]).drop_vars("beam") + 1e-3)
    beams = given_beams({"beams": detected, "Y2": better})
    np.testing.assert_array_equal(beams["beam_origin"].sel(beam="Y2"), better["beam_origin"][0])
    np.testing.assert_array_equal(beams["beam_origin"].sel(beam="X1"), detected["beam_origin"].sel(beam="X1"))


def test_nominal_beams_are_used_without_inputs():
    assert given_beams({}) is None


def test_inputs_that_are_no_beams_of_the_frame_are_refused(detected):
    one = alone(detected, "X1")
    with raises("beams.input.names"):
        given_beams({"X3": one})
    with raises("beams.input.missing"):
        given_beams({"X1": one})
    with raises("beams.input.several"):
        given_beams({"beams": detected, "X1": detected})
    with raises("beams.input.other"):
        given_beams({"beams": detected, "X1": one.drop_vars("beam_covariance")})
    with raises("beams.input.no_zero"):
        given_beams({"beams": detected, "X1": one.assign(beam_origin=one["beam_origin"] * np.nan)})
    with raises("beams.input.frames"):
        given_beams({"beams": detected, "X1": one.assign_attrs(frame="table")})
    with raises("beams.input.missing"):
        given_beams({"beams": detected.sel(beam=["X1", "Z"])})
