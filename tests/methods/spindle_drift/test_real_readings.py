"""Drifts with rounded readings, or with a wrong one: the intervals hold the truth, and a note says why."""

import numpy as np
import pytest
import xarray as xr

from errormotion.kinematics.iso import DOF
from errormotion.methods.spindle_drift import SpindleDrift, SpindleDriftSettings
from errormotion.methods.spindle_drift.simulation import raw_drift, simulate
from errormotion.twin import Event, VirtualMachine

SETTINGS = SpindleDriftSettings(functional_point=(0.0, 0.0, 0.0))
MEASURED = SpindleDriftSettings(duration=6000.0)
NOISE = 3e-9


def held(raw: xr.Dataset, truth: xr.Dataset) -> tuple[float, xr.Dataset]:
    """Return the share of intervals that hold the truth, and the result."""
    errors = SpindleDrift().identify(raw, SETTINGS)
    true = truth.interp(time=errors["time"].values)
    inside = []
    for k, name in enumerate(DOF[:5]):
        off = (errors[name].values - true[name].values)[1:]
        u = np.sqrt(errors["covariance"].values[1:, k, k])
        known = np.isfinite(off)
        inside.append(np.abs(off[known]) <= 1.96 * u[known])
    return float(np.mean(np.concatenate(inside))), errors


@pytest.mark.parametrize("step", [0.0, 0.1e-6])
def test_rounded_readings(step: float) -> None:
    found = []
    for seed in range(4):
        raw, truth = simulate(MEASURED, seed)
        if step:
            raw["distance"] = (raw["distance"] / step).round() * step
        share, errors = held(raw, truth)
        found.append(share)
        assert any("readings of X1 are multiples of 0.1 um" in note for note in errors.em.notes) == (step > 0)
    assert np.mean(found) > 0.9


def test_a_wrong_mean_is_left_out_and_named() -> None:
    raw, truth = simulate(MEASURED, 1)
    raw = raw.transpose("channel", "time", ...)
    raw["distance"][2, raw.sizes["time"] // 2] += 300 * NOISE
    _, errors = held(raw, truth)
    channel = str(raw["channel"].values[2])
    assert any(f"{channel}: 1 means stand out" in note for note in errors.em.notes)
    known = np.isfinite(errors["EX"].values)
    assert (~known).sum() == 1
    plain = SpindleDrift().identify(simulate(MEASURED, 1)[0], SETTINGS)
    assert errors["EX"].values[known] == pytest.approx(plain["EX"].values[known], abs=1e-9)


def test_noise_that_is_alike_at_neighbouring_instants_is_in_the_uncertainty_and_doubted() -> None:
    found, plain, doubted = [], [], 0
    for seed in range(12):
        raw, truth = simulate(MEASURED, seed)
        rng = np.random.default_rng([seed, 1])
        e = rng.standard_normal((raw.sizes["time"], raw.sizes["channel"]))
        for k in range(1, len(e)):
            e[k] = 0.8 * e[k - 1] + 0.6 * e[k]
        plain.append(held(raw, truth)[0])
        raw["distance"] = raw["distance"] + xr.DataArray(2 * NOISE * e, dims=("time", "channel"))
        share, errors = held(raw, truth)
        found.append(share)
        doubted += any("vary about smooth curves by more than their noise" in each for each in errors.em.doubts)
    # shares of 95 % with a standard deviation of about 10 % of one data set
    assert np.mean(found) > 0.85
    assert np.mean(plain) > 0.85
    assert doubted >= 9


def sampled(speed: float, rate: float, seed: int = 1) -> tuple[xr.Dataset, xr.Dataset]:
    """Return three minutes of single readings of a turning spindle with a run-out of 5 um, and the true errors."""
    machine = VirtualMachine("cframe", seed=seed)
    machine.start([Event(0.0, speed)])
    time = np.arange(0.0, 180.0, 1 / rate)
    raw = raw_drift(machine, time, seed=seed, averaged=1, warm_up=False, radius_error=False)
    angle = 2 * np.pi * speed / 60 * time
    phase = {"X1": 0.0, "X2": 0.3, "Y1": np.pi / 2, "Y2": np.pi / 2 + 0.3, "Z": 1.0}
    for k, name in enumerate(raw["channel"].values):
        raw["distance"][k] += 5e-6 * np.cos(angle - phase[str(name)])
    return raw, machine.truth_spindle(time[:: round(rate / 2)], (0.0, 0.0, 0.0))


@pytest.mark.parametrize(("speed", "hidden"), [(3001.0, True), (3000.0, True), (1500.0, True), (3240.0, False)])
def test_run_out_that_sampling_makes_slow_is_doubted(speed: float, hidden: bool) -> None:
    raw, _ = sampled(speed, 50.0)
    doubts = SpindleDrift().identify(raw, SETTINGS).em.doubts
    assert any("samples per second, a mean over 0.5 s contains" in each for each in doubts) == hidden


def test_run_out_of_parts_of_turns_is_in_the_uncertainty() -> None:
    raw, truth = sampled(180.0, 200.0)  # one and a half turns in a mean
    share, errors = held(raw, truth)
    assert any("a mean over 0.5 s contains 21 % of the run-out" in each for each in errors.em.notes)
    assert share > 0.9
