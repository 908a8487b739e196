"""Figures of ISO 230-2 side by side, of one axis without and with a compensation."""

import pytest

from errormotion.compensation.effect import effect
from errormotion.datasets.results.merit import figures_of
from errormotion.methods.linear_positioning import LinearPositioning, Settings
from errormotion.methods.linear_positioning.simulation import Behaviour, raw_and_truth


def test_figures_of_iso_230_2_stand_side_by_side() -> None:
    settings = Settings(axis="Y", freedoms=("EY",), trials=200)
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
        (pair,) = [pair for key, pair in pairs.items() if key.split()[0] == name]
        assert pair.reduction.value == pytest.approx(0.8, abs=0.02)
        assert pair.reduction.low < pair.reduction.value < pair.reduction.high
