"""Figures of merit of a drift and of a beam detection: SI values with U (k = 2)."""

import numpy as np
import pytest

from errormotion.methods.spindle_drift import SpindleDrift, SpindleDriftSettings
from errormotion.methods.spindle_drift.simulation import simulate

DRIFT = SpindleDriftSettings(duration=6000.0)


@pytest.fixture(scope="module")
def drift():
    return SpindleDrift().identify(simulate(DRIFT, 3)[0], SpindleDriftSettings(compensate_frame=False))


def test_a_drift_states_its_last_errors_and_its_iso_ranges(drift):
    figures = {figure.name: figure for figure in SpindleDrift.figures(drift)}
    last = figures["EZ after 95.8 min"]
    assert last.value == float(drift["EZ"][-1])
    assert last.expanded_uncertainty == pytest.approx(2 * np.sqrt(float(drift["covariance"][-1, 2, 2])), rel=1e-12)
    assert not any(name.startswith("EC") for name in figures)
    tilt = figures["d(A) within the first 60 min, range (ISO 230-3)"]
    assert tilt.unit == "rad"
    assert tilt.value == float(drift["iso_value"].sel(quantity="A", measure="range_60min"))


def test_an_iso_range_states_the_effect_of_each_source(drift):
    """The beams are one draw in all records with one calibration; a history counts them once."""
    figures = {figure.name: figure for figure in SpindleDrift.figures(drift)}
    tilt = figures["d(A) within the first 60 min, range (ISO 230-3)"]
    effects = np.array([tilt.influence[str(name)] for name in drift["source"].values])
    assert len(tilt.influence) == drift.sizes["source"]
    F = drift["influence"].values[:, :, 3]
    assert np.all(np.abs(effects) <= np.ptp(F, axis=1) + 1e-15)
    u = tilt.expanded_uncertainty / 2
    assert 0.1 * u < np.sqrt(effects @ effects) < u
    assert np.abs(effects[np.char.startswith(drift["source"].values.astype(str), "beam")]).max() > 0


def test_a_short_record_states_the_range_to_the_end_of_running():
    short = SpindleDrift().identify(
        simulate(SpindleDriftSettings(duration=600.0), 3)[0], SpindleDriftSettings(compensate_frame=False)
    )
    names = [figure.name for figure in SpindleDrift.figures(short)]
    assert "d(Z) to the end of running, range (ISO 230-3)" in names
    assert not any("60 min" in name for name in names)


def test_detected_beams_state_their_errors_and_a_plan_states_none():
    settings = SpindleDriftSettings(procedure="beam_detection")
    beams = SpindleDrift().identify(simulate(settings, 3)[0], settings)
    figures = SpindleDrift.figures(beams)
    known = int(np.isfinite([beams[str(name)].values for name in beams["dof"].values]).sum())
    assert len(figures) == known > 0
    assert figures[0].name == "EX of X1 against nominal"
    assert SpindleDrift.figures(SpindleDrift().plan(settings)) == []
