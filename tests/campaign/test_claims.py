"""Instruments that serve one program are released for a measurement, and a run in a terminal is visible."""

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from errormotion.campaign import claims, runner
from errormotion.campaign.background.other_processes import runs_of_other_processes
from errormotion.campaign.background.recorded import recorded
from errormotion.campaign.claims import Claim, claimed, holder, watching
from errormotion.campaign.files import CampaignPlan
from errormotion.errors import RunError

pytestmark = pytest.mark.usefixtures("lab")


def test_a_run_claims_its_machine_and_is_visible_to_other_processes(
    plan: Callable[..., CampaignPlan], tmp_path: Path
) -> None:
    campaign, seen = plan('name = "a"\n[test.settings]\ncount = 3000'), []

    class Looking(runner.Quiet):
        def advance(self, done: float) -> None:
            seen.append((holder(campaign.bench.machine), runs_of_other_processes(tmp_path / "runs", ())))

    (folder,) = runner.run(campaign, progress=Looking())
    claim, (found,) = seen[-1]
    assert claim == Claim("a run", folder.path)
    assert (found.campaign, found.test, found.stage, found.tests) == (
        "Ramps",
        "a",
        "measuring",
        {"a": folder.path.name},
    )
    assert found.expected > 0
    assert (holder(campaign.bench.machine), runs_of_other_processes(tmp_path / "runs", ())) == (None, [])
    record = recorded(folder.path)
    assert (record.title, record.samples) == ("a of Ramps", folder.data["samples"]["count"])
    assert record.values
    with folder.locked():  # a finished run whose report is made again is not measuring
        assert runs_of_other_processes(tmp_path / "runs", ()) == []


def test_a_claim_waits_until_monitors_have_released_the_instruments_and_expires() -> None:
    left, end = [], threading.Event()

    def watch() -> None:
        with watching("Mill") as free:
            assert free
            begun.set()
            while holder("Mill") is None and not end.is_set():
                time.sleep(0.01)
            left.append(True)

    begun = threading.Event()
    thread = threading.Thread(target=watch)
    thread.start()
    assert begun.wait(30)
    try:
        with claimed("Mill", "a run"):
            assert left == [True]
            with watching("Mill") as free:
                assert not free
            assert holder("another mill") is None
    finally:
        end.set()
        thread.join()
    assert holder("Mill") is None
    assert not list(claims._folder().glob("*.claim"))


def test_a_monitor_that_does_not_release_its_instruments_does_not_prevent_a_measurement(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(claims, "RELEASE_TIMEOUT", 0.1)
    with watching("Mill"), claimed("Mill", "a run"):
        assert holder("Mill") == Claim("a run")


def test_a_read_only_state_folder_does_not_prevent_a_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    with claimed("Mill", "a run") as records:
        records(tmp_path)
        with watching("Mill") as free:
            assert free


def test_a_folder_that_is_no_record_is_reported(tmp_path: Path) -> None:
    with pytest.raises(RunError):
        recorded(tmp_path)
