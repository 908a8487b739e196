"""The step of a switched compensation, from means of any length at any phase."""

import json

import numpy as np
import pytest
import xarray as xr

from errormotion.datasets import build_errors
from errormotion.report.drawings.series import end_of_running, step_of, step_weights
from errormotion.twin import VirtualMachine
from errormotion.twin.schedule import Event

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
    assert found.step @ value == pytest.approx(STEP, abs=10e-9)
    assert found.before @ value == pytest.approx(RISE * -np.expm1(-3660.0 / TAU), abs=6e-9)


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
    assert found.step @ errors["EZ"].values == pytest.approx(STEP, abs=20e-9)


def test_a_side_with_a_single_mean_leaves_the_step_unknown():
    # A switched compensation changes the slope, which a single mean does not show.
    assert step_weights(warm_up(4.0, 0.0, end=3668.0), "EZ", 3660.0) is None
    assert step_weights(warm_up(4.0, 0.0, end=3672.0), "EZ", 3660.0) is not None


NOISE = 4e-9
"""Standard deviation of the mean of a second, m."""


@pytest.mark.parametrize("at", [600.0, 3660.0])
@pytest.mark.parametrize("length", [0.5, 4.0, 30.0])
def test_the_true_correction_is_within_the_uncertainty_of_the_step(length, at):
    rng = np.random.default_rng(2)
    held = []
    for seed in range(40):
        machine = VirtualMachine("cframe", seed % 8)
        machine.start([Event(0.0, spindle_speed=15000.0), Event(at, compensation={"Z": False})])
        first = at - 5.5 * length - 15 + rng.uniform(0, length)
        fine = first + (np.arange(round((at + 20 + 4 * length - first) / length) * 20) + 0.5) * length / 20
        value = machine.spindle_twist(fine)[:, 2].reshape(-1, 20).mean(axis=1)
        sigma = NOISE / np.sqrt(length)
        value += sigma * rng.standard_normal(value.size)
        errors = measured(fine.reshape(-1, 20).mean(axis=1), value, sigma, length)
        step = step_of(errors, "EZ", at, [0.0])
        held.append(abs(step.step - machine.state.correction_at([at])[0, 2]) <= 2 * step.u_step)
    assert sum(held) >= 35  # with 95 %, fewer have a probability of 1 %


def measured(time, value, sigma, length):
    """An error dataset of one displacement with independent noise."""
    errors = np.full((time.size, 6), np.nan)
    errors[:, 2] = value
    covariance = np.full((time.size, 6, 6), np.nan)
    covariance[:, 2, 2] = sigma**2
    return build_errors(
        errors,
        covariance,
        dims=("time",),
        coords={"time": ("time", time, {"units": "s"})},
        component="spindle",
        machine="virtual",
        frame="machine",
        functional_point=(0.0, 0.0, 0.0),
        reference="the cold state",
        method="test",
        method_version="1",
        measured={},
        provenance={"settings": {"average": length}},
    )


def test_a_step_at_the_end_of_a_record_is_unknown():
    assert step_weights(warm_up(4.0, 0.0, end=3666.0), "EZ", 3660.0) is None
    assert step_weights(warm_up(60.0, 30.0, end=3660.0 + 50.0), "EZ", 3660.0) is None


def test_the_end_of_running_is_within_no_mean():
    errors = warm_up(4.0, 1.0)
    errors.attrs["provenance"] = json.dumps({"settings": {"average": 4.0, "running_end": 3660.0}})
    place = end_of_running(errors)
    assert errors["time"].values[place] + 2.0 <= 3660.0 < errors["time"].values[place + 1] + 2.0
