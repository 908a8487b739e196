"""Positioning with readings that drift over the test, or of which one is wrong."""

import numpy as np
import pytest
import xarray as xr

from errormotion.errors import DatasetError
from errormotion.methods.linear_positioning import LinearPositioning
from errormotion.methods.linear_positioning.settings import LinearPositioningSettings
from errormotion.tolerances.conformity import judge
from errormotion.tolerances.decision import OPEN
from errormotion.tolerances.table import Tolerances

METHOD = LinearPositioning()
SETTINGS = LinearPositioningSettings(freedoms=("EX",), runs=5, count=11, trials=200)
DRIFT = 5e-6
"""From the first to the last run, m."""


def drifting(seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Return readings in linear cycles that drift from the beginning of the test on, and the truth at its beginning."""
    raw, truth = METHOD.simulate(SETTINGS, seed)
    x = raw["deviation"].transpose("run", "approach", "target", "freedom")
    run, way, stop = np.indices(x.shape[:3])
    m = x.sizes["target"]
    backward = raw["approach"].transpose("approach").values[way] == "backward"
    within = np.where(backward, 1.0 - stop / (2.0 * m), stop / (2.0 * m))
    shift = DRIFT * (run + within) / (x.sizes["run"] - 1)
    return raw.assign(deviation=(x.dims, x.values + shift[..., None], raw["deviation"].attrs)), truth


def test_a_drift_over_the_test_is_noted_and_part_of_the_uncertainty() -> None:
    inside, reversal = [], []
    for seed in range(20):
        raw, truth = drifting(seed)
        errors = METHOD.identify(raw, SETTINGS)
        assert any("drift from the first to the last run (EXX: +" in note for note in errors.em.notes)
        off = (errors["EX"] - truth["EX"]).values
        inside.append(np.abs(off) <= 1.96 * np.sqrt(errors["covariance"].values[:, 0, 0]))
        plain = METHOD.identify(METHOD.simulate(SETTINGS, seed)[0], SETTINGS)
        reversal.append(abs(float(errors["B_mean"] - plain["B_mean"])) <= 2 * float(errors["B_mean_u"]))
    assert np.mean(inside) > 0.9
    assert np.mean(reversal) > 0.9


def test_readings_without_a_drift_are_rarely_noted() -> None:
    noted = [
        any("drift from the first" in note for note in METHOD.identify(raw, SETTINGS).em.notes)
        for raw in (METHOD.simulate(SETTINGS, seed)[0] for seed in range(40))
    ]
    assert sum(noted) <= 4


def test_a_wrong_reading_is_named_and_decides_nothing() -> None:
    raw, _ = METHOD.simulate(SETTINGS, 3)
    assert METHOD.identify(raw, SETTINGS).em.doubts == []
    raw = raw.transpose("run", "approach", "target", "freedom", ...)
    raw["deviation"][2, 1, 4, 0] += 790e-6
    errors = METHOD.identify(raw, SETTINGS)
    (doubt,) = errors.em.doubts
    way, place = raw["approach"].values[1], 1e3 * float(raw["target_position"][4])
    assert f"EXX at {place:.6g} mm, {way}, run 3" in doubt
    found = judge(errors, Tolerances.model_validate({"freedoms": {"EX": "1 um"}}))
    assert found.decision == OPEN


@pytest.mark.parametrize("step", [1e-6])
def test_coarse_readings_do_not_agree_to_nothing(step: float) -> None:
    inside = []
    for seed in range(20):
        raw, truth = METHOD.simulate(SETTINGS.model_copy(update={"repeatability": 0.05e-6}), seed)
        raw["deviation"] = (raw["deviation"] / step).round() * step
        errors = METHOD.identify(raw, SETTINGS)
        u = np.sqrt(errors["covariance"].values[:, 0, 0])
        assert (u > 0.1e-6).all()
        inside.append(np.abs((errors["EX"] - truth["EX"]).values) <= 1.96 * u)
    assert np.mean(inside) > 0.9


def test_a_unit_that_is_not_si_is_refused_although_lengths_and_angles_share_a_variable() -> None:
    raw, _ = METHOD.simulate(SETTINGS, 1)
    for accepted in ("m", "m, rad"):
        raw["deviation"].attrs["units"] = accepted
        METHOD.identify(raw, SETTINGS)
    raw["deviation"].attrs["units"] = "mm"
    with pytest.raises(DatasetError, match="deviation: expected units 'm' or 'rad'; found 'mm'"):
        METHOD.identify(raw, SETTINGS)


def test_an_approach_that_scatters_more_has_its_own_repeatability() -> None:
    """With one variance for both approaches, the interval of the smaller repeatability held its true value in 44 %."""
    sd, runs, targets = np.array([0.9e-6, 0.5e-6]), 5, 11
    held = []
    for seed in range(20):
        raw, _ = METHOD.simulate(SETTINGS, seed)
        raw = raw.transpose("run", "approach", "target", "freedom", ...)
        order = [list(raw["approach"].values).index(name) for name in ("forward", "backward")]
        x = np.empty((runs, 2, targets, 1))
        for k, at in enumerate(order):
            x[:, at] = sd[k] * np.random.default_rng([seed, k]).standard_normal((runs, targets, 1))
        errors = METHOD.identify(raw.assign(deviation=(raw["deviation"].dims, x, {})), SETTINGS)
        for k, name in enumerate(("R_forward", "R_backward")):
            value, bias, u = (float(errors[name + part]) for part in ("", "_bias", "_u"))
            held.append(abs(value - bias - 4 * sd[k]) <= 2 * u)
    assert np.mean(held) > 0.85
