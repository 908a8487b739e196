"""Means of windows with missing samples are those at the times of the windows."""

import numpy as np
import pytest

from errormotion.kinematics.twists import move
from errormotion.methods.spindle_drift import simulation
from errormotion.methods.spindle_drift.identification.averaging import Averager, join
from errormotion.methods.spindle_drift.method import SpindleDrift
from errormotion.methods.spindle_drift.settings import SpindleDriftSettings
from errormotion.twin import VirtualMachine
from errormotion.twin.schedule import Event

INTERVAL, AVERAGE = 0.5, 30.0


def lost(which):
    """Change readings (channel, sample): samples at the start or end of windows are missing."""
    window, place = np.divmod(np.arange(1200), round(AVERAGE / INTERVAL))

    def change(values):
        if which == "all channels":
            values[:, (window % 3 == 1) & (place < 27)] = np.nan
        if which == "Z in the reference":
            values[4, (window % 3 == 0) & (place > 33)] = np.nan
        if which == "consecutive windows":
            values[:2, (window > 3) & (place < 20)] = np.nan
        return values

    return change


def largest_deviation(change, seed):
    """Return the largest deviations of EX, EY and EZ from the truth in a fast warm-up, m."""
    machine = VirtualMachine("cframe", seed)
    machine.start([Event(0.0, spindle_speed=15000.0)])
    t = 60.0 + INTERVAL * np.arange(1200)
    raw = simulation.raw_drift(machine, t, seed=seed, warm_up=False, radius_error=False)
    values = change(raw["distance"].transpose("channel", "time").values.copy())
    raw["distance"] = (("channel", "time"), values, raw["distance"].attrs)
    errors = SpindleDrift().identify(raw, SpindleDriftSettings(average=AVERAGE, spin_up=0.0))
    zero = float(errors.attrs["reference_time"])
    shift = np.asarray(errors.attrs["functional_point"]) - machine.spindle_functional_point
    truth = machine.spindle_twist(errors["time"].values + zero) - machine.spindle_twist(np.array([zero]))
    return np.abs(errors.em.twist().values - move(truth, shift))[:, :3].max(axis=0)


@pytest.mark.parametrize("which", ["all channels", "Z in the reference", "consecutive windows"])
def test_missing_samples_do_not_shift_the_time_of_a_mean(which):
    complete, partly = (largest_deviation(change, 1) for change in (lambda values: values, lost(which)))
    # Noise of a mean: 0.4 nm, which carrying it to the middle of its window may double. Uncarried: 30 nm and more.
    assert (partly < complete + 4 * 0.8e-9).all()


def test_the_lag_is_the_mean_time_of_the_valid_samples_in_any_pieces():
    rng = np.random.default_rng(3)
    time, values = 5.0 + 0.01 * np.arange(1000), rng.normal(size=(2, 1000))
    values[:, rng.random(1000) < 0.3] = np.nan
    values[1, 200:230] = np.nan
    for cuts in ((), (130, 131, 555)):
        averager = Averager(2, 1.0)
        parts = zip(np.split(time, cuts), np.split(values, cuts, axis=1), strict=True)
        found = join([*(averager.update(*part) for part in parts), averager.finish()])
        for k in range(10):
            inside = slice(100 * k, 100 * k + 100)
            for channel in range(2):
                valid = np.isfinite(values[channel, inside])
                lag = time[inside][valid].mean() - time[inside].mean()
                assert found.lag[channel, k] == pytest.approx(lag, abs=1e-9)
