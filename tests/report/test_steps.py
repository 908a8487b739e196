"""The step of a switched compensation, from means of any length at any phase."""

import json

import numpy as np
import pytest
import xarray as xr

from errormotion.report.drawings.series import end_of_running, step_weights

STEP, RISE, TAU = 27.38e-6, 20e-6, 1500.0
"""Step of the truth, and the warm-up beneath it: m, s."""


def warm_up(length, phase, *, at=3660.0, end=3700.0, sharp=0.9):
    """Means of `length` that start at `phase`, of a warm-up with a step that takes `sharp` seconds."""
    fine = 0.05
    t = np.arange(phase, end, fine)
    truth = RISE * -np.expm1(-t / TAU) + STEP * np.clip((t - at) / sharp, 0.0, 1.0)
    size = round(length / fine)
    count = t.size // size
    time, value = (each[: count * size].reshape(count, size).mean(axis=1) for each in (t, truth))
    provenance = json.dumps({"settings": {"average": length}})
    return xr.Dataset({"EZ": ("time", value)}, {"time": time}, {"provenance": provenance})


@pytest.mark.parametrize("length", [0.5, 2.0, 4.0, 5.0, 13.0, 60.0])
@pytest.mark.parametrize("phase", [0.0, 0.1, 0.3, 0.5, 0.7, 0.95])
def test_a_mean_across_the_step_is_on_neither_side(length, phase):
    errors = warm_up(length, phase * length, end=3660.0 + max(60.0, 6 * length))
    found = step_weights(errors, "EZ", 3660.0)
    value = errors["EZ"].values
    # The curvature of the warm-up within two means of a minute is 20e-6 exp(-2.44) (90 / 1500)^2 = 6 nm on each side.
    assert found.step @ value - found.drift @ value == pytest.approx(STEP, abs=10e-9)
    rise = RISE / TAU * np.exp(-3660.0 / TAU)
    assert found.drift @ value == pytest.approx(rise * float(found.step @ errors["time"].values), rel=0.1)
    assert found.before @ errors["time"].values < 3660.0 - length / 2 + 1e-6


def test_values_beyond_another_change_are_not_used():
    errors = warm_up(0.5, 0.0, at=3656.0, end=3680.0)
    time = errors["time"].values
    errors["EZ"] = errors["EZ"] + 5e-6 * (time > 3660.0) + 7e-6 * (time > 3664.0)
    found = step_weights(errors, "EZ", 3660.0, [3656.0, 3664.0])
    assert found.step @ errors["EZ"].values == pytest.approx(5e-6, abs=20e-9)


@pytest.mark.parametrize("stamp", [-2.0, 2.0])
def test_time_stamps_may_be_those_of_the_start_or_the_end_of_a_mean(stamp):
    errors = warm_up(4.0, 1.0, end=3720.0)
    errors = errors.assign_coords(time=errors["time"].values + stamp)
    errors.attrs["provenance"] = json.dumps({"settings": {"average": 0.5}})
    found = step_weights(errors, "EZ", 3660.0)
    assert (found.step - found.drift) @ errors["EZ"].values == pytest.approx(STEP, abs=20e-9)


def test_the_drift_of_one_side_is_used_where_the_other_has_a_single_mean():
    errors = warm_up(4.0, 0.0, end=3668.0)
    found = step_weights(errors, "EZ", 3660.0)
    assert (found.step - found.drift) @ errors["EZ"].values == pytest.approx(STEP, abs=10e-9)


def test_a_step_at_the_end_of_a_record_is_unknown():
    assert step_weights(warm_up(4.0, 0.0, end=3666.0), "EZ", 3660.0) is None
    assert step_weights(warm_up(60.0, 30.0, end=3660.0 + 50.0), "EZ", 3660.0) is None


def test_the_end_of_running_is_within_no_mean():
    errors = warm_up(4.0, 1.0)
    errors.attrs["provenance"] = json.dumps({"settings": {"average": 4.0, "running_end": 3660.0}})
    place = end_of_running(errors)
    assert errors["time"].values[place] + 2.0 <= 3660.0 < errors["time"].values[place + 1] + 2.0
