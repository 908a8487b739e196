"""Every kind of fault in sequence: the offset at the machine never exceeds its limits."""

from pathlib import Path

import pytest
from compensated_hours import FAULTS, follow, limits_kept

from errormotion.compensation.online import follower

INTERVAL = 60.0


@pytest.fixture(autouse=True)
def own_lock(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


def test_no_fault_moves_the_offset_beyond_its_limits(tmp_path: Path) -> None:
    found = follow(tmp_path, (len(FAULTS) + 1) * INTERVAL / 3600, INTERVAL, seed=2)
    assert limits_kept(found) == []
    assert set(found.faults) == set(FAULTS)
    assert {"following", "holding", "ramping", "fault"} <= set(found.states)
    assert found.starts > 2
    assert found.largest > 10e-6


def test_a_jump_after_a_suspension_would_be_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(follower, "MAX_STEP", 100.0)
    monkeypatch.setattr("compensated_hours.FAULTS", ("suspended",))
    found = follow(tmp_path, 0.1, INTERVAL, seed=2)
    assert [text for text in limits_kept(found) if text.startswith("change of")]
