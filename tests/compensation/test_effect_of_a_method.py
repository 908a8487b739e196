"""Figures of ISO 230-2 and ISO 230-3, without and with a compensation."""

import pytest

from errormotion.compensation.effect import effect
from errormotion.datasets.results.merit import figures_of
from errormotion.methods.linear_positioning import LinearPositioning, LinearPositioningSettings
from errormotion.methods.linear_positioning.simulation import Behaviour, raw_and_truth
from errormotion.methods.spindle_drift import SpindleDrift, SpindleDriftSettings
from errormotion.methods.spindle_drift.simulation import simulate


def test_figures_of_iso_230_2_are_compared() -> None:
    settings = LinearPositioningSettings(axis="Y", freedoms=("EY",), trials=200)
    raw, _ = raw_and_truth(settings, 3, Behaviour())
    raw = raw.drop_vars(
        [name for name in raw.variables if "temperature" in name or "expansion" in name]
    )  # at 20 degC: all figures scale with the deviations
    before = LinearPositioning().identify(raw, settings)
    less = raw.assign(deviation=(raw["deviation"].dims, 0.2 * raw["deviation"].values, raw["deviation"].attrs))
    after = LinearPositioning().identify(less, settings)
    pairs = {pair.name: pair for pair in effect(before, after).figures}
    for first, second in zip(figures_of(before), figures_of(after), strict=True):
        assert pairs[first.name].before == (first.value, first.expanded_uncertainty)
        assert pairs[first.name].after == (second.value, second.expanded_uncertainty)
    for name in ("A", "E", "M"):
        (pair,) = [pair for key, pair in pairs.items() if key.split()[0] == name and "corrected" not in key]
        assert pair.reduction.value == pytest.approx(0.8, abs=0.02)
        assert pair.reduction.low < pair.reduction.value < pair.reduction.high


def test_ranges_of_iso_230_3_stand_side_by_side() -> None:
    settings = SpindleDriftSettings(compensate_frame=False)
    raw, _ = simulate(SpindleDriftSettings(duration=6000.0), 3)
    first = raw["distance"].isel(time=0)
    less = raw.assign(distance=(first + 0.2 * (raw["distance"] - first)).transpose(*raw["distance"].dims))
    less["distance"].attrs = raw["distance"].attrs
    before, after = (SpindleDrift().identify(each, settings) for each in (raw, less))
    ranges = [figure for figure in figures_of(before) if "ISO 230-3" in figure.name]
    pairs = {pair.name: pair for pair in effect(before, after).figures}
    assert {figure.name.split()[0] for figure in ranges} >= {"d(X1)", "d(X2)", "d(Y1)", "d(Y2)", "d(Z)", "d(A)", "d(B)"}
    for figure in ranges:
        pair = pairs[figure.name]
        assert pair.before == (figure.value, figure.expanded_uncertainty)
        assert pair.reduction.low < 0.8 < pair.reduction.high
        assert pair.reduction.value == pytest.approx(0.8, abs=0.1)
