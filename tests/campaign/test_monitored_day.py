"""A monitor for some simulated minutes with one fault per minute; ``make endurance`` runs 24 hours."""

from pathlib import Path

import monitored_day
import numpy as np
import pytest
from monitored_day import FAULT_INTERVAL, INTERVAL, watch

from errormotion import datasets
from errormotion.campaign.monitor import sources

MINUTES = 8


@pytest.mark.slow
def test_every_gap_is_marked_and_no_sample_is_repeated(tmp_path: Path) -> None:
    folder, day = watch(tmp_path, MINUTES / 60, 30.0, seed=2)
    assert not day.errors
    assert sum(day.faults.values()) >= MINUTES - 2  # a suspension may take the rest
    assert folder.finished
    assert len(day.resources) > 3
    descriptors = [each.descriptors for each in day.resources]
    half = len(descriptors) // 2  # connections that are made anew come and go; what is lost stays
    assert min(descriptors[half:]) <= max(descriptors[:half])
    assert day.end >= MINUTES * FAULT_INTERVAL - INTERVAL
    with datasets.load(folder.raw) as log:  # a busy computer is late by seconds, which are thirty times as long here
        assert np.diff([*log.time.values, MINUTES * FAULT_INTERVAL]).max() < 100 * INTERVAL


def test_the_examination_detects_readings_that_are_too_old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sources.Source, "fresh", lambda source, oldest: source._reading)
    for kinds in ("ON_A_LINE", "ON_A_MODULE"):
        monkeypatch.setattr(monitored_day, kinds, ("silence",))
    monkeypatch.setattr(monitored_day, "OF_THE_COMPUTER", ())
    _, day = watch(tmp_path, 0.5 * MINUTES / 60, 30.0, 3)
    assert any("is not marked" in text for text in day.errors)
