"""The runner stores data before it uses them, and continues a run where it ended."""

import errno
import fcntl
import json
import logging
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from coded import raises

from errormotion import datasets, plugins
from errormotion.campaign import runner
from errormotion.campaign.files import CampaignPlan, load_campaign
from errormotion.campaign.folder import CHECK_DURATION, RunFolder, list_runs
from errormotion.campaign.storage.journal import journal
from errormotion.campaign.storage.store import RawStore
from errormotion.errors import BenchError, RunError
from errormotion.report import write_run_report

STEP = 1e-6
Plan = Callable[..., CampaignPlan]


def whole(folder: RunFolder, count: int) -> None:
    """Sample i is i micrometres: no sample is lost, repeated or in the wrong order."""
    with datasets.load(folder.raw) as raw:
        np.testing.assert_array_equal(raw["distance"].values[0], np.arange(count) * STEP)


def test_a_run_folder_contains_all_data_of_the_result(plan: Plan) -> None:
    (folder,) = runner.run(plan('name = "a"\nsettings = {level = "25 mm"}'))
    data = json.loads((folder.path / "run.json").read_text())
    assert folder.path.name.split("-")[1:] == ["a", data["id"]]
    assert data["schema"] == "errormotion.run/1"
    assert data["status"] == "finished"
    assert data["settings"] == {"count": 1000, "level": 0.025, "asks": "", "needs_file": None}
    assert data["campaign"]["text"].startswith('schema = "errormotion.campaign/1"')
    assert data["bench"]["machine"] == "lab machine"
    assert data["instruments"][0]["identity"]["serial_number"] == "17"
    assert data["instruments"][0]["address"] == "sim://counter"
    assert data["samples"] == {"dim": "time", "count": 1000, "dropped": 10, "invalid": {"dark": 20}}
    assert [step["step"] for step in data["steps"]] == ["acquire", "acquire", "identify"]
    assert data["software"]["errormotion"]
    assert data["errors"] == f"errors/ramp-{data['settings_hash']}/errors.nc"
    whole(folder, 1000)
    errors = datasets.load(folder.path / data["errors"])
    assert float(errors["EX"][-1]) == pytest.approx(999e-6)
    provenance = json.loads(errors.attrs["provenance"])
    assert provenance["instruments"][0]["identity"]["serial_number"] == "17"
    assert all("time" in json.loads(line) for line in folder.log.read_text().splitlines())


def test_run_folder_can_be_moved(plan: Plan, tmp_path: Path) -> None:
    first, second = runner.run(plan('name = "a"', 'name = "b"\ninputs = {zero = "a"}'))
    (tmp_path / "elsewhere").mkdir()
    for folder in (first, second):
        shutil.move(folder.path, tmp_path / "elsewhere")
    moved = list_runs(tmp_path / "elsewhere")
    assert [folder.data["test"] for folder in moved] == ["a", "b"]
    assert str(tmp_path / "runs") not in json.dumps({k: v for k, v in moved[1].data.items() if k != "campaign"})
    assert moved[1].errors is not None
    assert moved[1].errors.exists()
    assert (moved[1].path / moved[1].data["inputs"]["zero"]).resolve() == moved[0].errors.resolve()  # type: ignore[union-attr]


def test_a_folder_moved_during_the_run_is_reported_and_the_run_continued_there(plan: Plan, tmp_path: Path) -> None:
    runs, elsewhere = tmp_path / "runs", tmp_path / "elsewhere"

    class Mover(runner.Quiet):
        def advance(self, done: float) -> None:
            if not elsewhere.exists():
                runs.rename(elsewhere)

    with pytest.raises(RunError, match=r"its folder .* is gone. It was moved or deleted"):
        runner.run(plan('name = "a"'), progress=Mover())
    assert list_runs(runs) == []
    (folder,) = runner.resume(runs=elsewhere)
    whole(folder, 1000)


def test_a_log_that_cannot_be_opened_is_ignored(tmp_path: Path) -> None:
    with journal(tmp_path / "full" / "log.jsonl"):
        logging.getLogger("errormotion.test").warning("no space for this")
    assert not (tmp_path / "full").exists()


def test_the_result_of_an_earlier_test_is_passed_to_a_later_one(plan: Plan) -> None:
    folders = runner.run(plan('name = "a"', 'name = "b"\ninputs = {zero = "a"}'))
    with datasets.load(folders[1].raw) as raw, datasets.load(folders[0].errors or "") as errors:
        assert raw.attrs["offset"] == float(errors["EX"][0])


def test_settings_are_on_disk_without_any_sample(plan: Plan, tmp_path: Path) -> None:
    (tmp_path / "broken").touch()
    with raises("instrument.other"):
        runner.run(plan('name = "a"\nsettings = {count = 5000}', bench=f'breaks = "{tmp_path / "broken"}"'))
    (folder,) = list_runs(tmp_path / "runs")
    assert folder.data["status"] == "failed"
    assert folder.data["settings"]["count"] == 5000


def test_a_failure_keeps_the_measured_data_and_resume_continues_after_it(plan: Plan, tmp_path: Path) -> None:
    (tmp_path / "broken").touch()
    broken = plan('name = "a"\nsettings = {count = 5000}', bench=f'breaks = "{tmp_path / "broken"}"')
    with raises("instrument.other") as caught:
        runner.run(broken)
    (folder,) = list_runs(tmp_path / "runs")
    assert f"the log is {folder.log}" in str(caught.value)
    last = json.loads(folder.log.read_text().splitlines()[-1])
    assert "InstrumentError: the counter fell off the table" in last["traceback"]
    assert plugins.get("instruments", "counter").opened == []
    whole(folder, 1000)
    with raises("instrument.other"):
        runner.resume(broken)
    (tmp_path / "broken").unlink()
    (folder,) = runner.resume(broken)
    assert folder.data["status"] == "finished"
    assert folder.data["reason"] == ""
    whole(folder, 5000)


def test_failed_identification_keeps_the_raw_data_and_is_redone_without_the_bench(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = plan(f'name = "a"\nsettings = {{needs_file = "{tmp_path / "needed"}"}}')
    with pytest.raises(RunError, match="The raw data are complete and stored"):
        runner.run(made)
    (tmp_path / "needed").touch()
    monkeypatch.setattr(plugins.get("instruments", "counter"), "open", lambda self: pytest.fail("the bench was opened"))
    (folder,) = runner.resume(made)
    assert folder.finished
    whole(folder, 1000)


def test_resume_skips_finished_tests(plan: Plan, tmp_path: Path) -> None:
    made = plan('name = "a"', f'name = "b"\nsettings = {{needs_file = "{tmp_path / "needed"}"}}', 'name = "c"')
    with pytest.raises(RunError, match="Test 'b' failed"):
        runner.run(made)
    before = {folder.data["test"]: folder for folder in list_runs(tmp_path / "runs")}
    (tmp_path / "needed").touch()
    folders = runner.resume(runs=tmp_path / "runs")
    assert [folder.data["test"] for folder in folders] == ["a", "b", "c"]
    assert folders[0].data["updated"] == before["a"].data["updated"]
    assert {folder.data["id"] for folder in folders} == {before["a"].data["id"]}


def test_a_full_disk_is_reported_with_the_stored_amount_and_the_run_can_be_resumed(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = plan('name = "a"\nsettings = {count = 4000}', bench='rate = "1 kHz"')
    append, room = RawStore.append, 10

    def append_until_full(self: RawStore, chunk: object) -> None:
        if self.count >= room * 100:
            raise OSError(errno.ENOSPC, "No space left on device")
        append(self, chunk)  # type: ignore[arg-type]
        self.commit()

    monkeypatch.setattr(RawStore, "append", append_until_full)
    with pytest.raises(RunError, match=r"The disk is full: 1000 samples \(1\.0 s\) are stored in .*raw\.zarr"):
        runner.run(made)
    (folder,) = list_runs(tmp_path / "runs")
    assert folder.data["status"] == "failed"
    assert folder.data["reason"].startswith("disk full: ")
    assert not (folder.path / ".reserve").exists()
    whole(folder, 1000)
    monkeypatch.setattr(RawStore, "append", append)
    (folder,) = runner.resume(made)
    whole(folder, 4000)


def test_a_read_only_disk_is_reported_with_the_stored_amount(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    append = RawStore.append

    def append_some(self: RawStore, chunk: object) -> None:
        if self.count >= 1000:
            raise OSError(errno.EROFS, "Read-only file system")
        append(self, chunk)  # type: ignore[arg-type]
        self.commit()

    def refuse(self: RunFolder) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(RawStore, "append", append_some)
    monkeypatch.setattr(RunFolder, "give_reserve", refuse)
    with pytest.raises(RunError, match=r"cannot be written: Read-only file system; 1000 samples") as caught:
        runner.run(plan('name = "a"\nsettings = {count = 4000}', bench='rate = "1 kHz"'))
    assert "1000 samples are stored in" in str(caught.value)


def test_changed_files_are_not_resumed(plan: Plan, tmp_path: Path) -> None:
    setting = f'settings = {{needs_file = "{tmp_path / "needed"}"}}'
    with pytest.raises(RunError, match="failed"):
        runner.run(plan(f'name = "a"\n{setting}'))
    changed = plan(f'name = "a"\n# another text\n{setting}')
    with raises("campaign.changed"):
        runner.resume(changed)
    (tmp_path / "needed").touch()
    (folder,) = runner.resume(runs=tmp_path / "runs")
    assert folder.finished


def test_a_finished_campaign_is_reported_by_resume(plan: Plan) -> None:
    made = plan('name = "a"')
    with pytest.raises(RunError, match=r"Nothing to resume in .*runs: found 0 campaigns"):
        runner.resume(made)
    runner.run(made)
    with pytest.raises(RunError, match="found 1 campaigns, none of them unfinished"):
        runner.resume(made)


def test_two_processes_cannot_work_on_one_run(plan: Plan, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="failed"):
        runner.run(plan(f'name = "a"\nsettings = {{needs_file = "{tmp_path / "needed"}"}}'))
    (folder,) = list_runs(tmp_path / "runs")
    with folder.locked(), raises("run.folder.used"):
        runner.resume(runs=tmp_path / "runs")


def test_inspecting_a_lock_does_not_block_a_run(plan: Plan, tmp_path: Path) -> None:
    (folder,) = runner.run(plan('name = "a"'))
    looking = os.open(folder.path, os.O_RDONLY)
    fcntl.flock(looking, fcntl.LOCK_SH)
    timer = threading.Timer(CHECK_DURATION / 2, os.close, [looking])
    timer.start()
    with RunFolder.open(folder.path).locked():
        timer.join()


class Impatient(runner.Quiet):
    """An operator who stops the run at its first samples."""

    def advance(self, done: float) -> None:
        os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("second", [signal.SIGINT, signal.SIGTERM])
def test_a_second_request_to_end_does_not_lose_the_last_samples(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, second: signal.Signals
) -> None:
    commit = RawStore.commit

    def slowly(self: RawStore) -> None:
        time.sleep(0.2)
        if self.count:
            os.kill(os.getpid(), second)
            time.sleep(0.2)
        commit(self)

    def end(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, end)  # as the command line does
    monkeypatch.setattr(RawStore, "commit", slowly)
    try:
        with pytest.raises(KeyboardInterrupt) as caught:
            runner.run(plan('name = "a"\nsettings = {count = 4000}', bench='rate = "1 kHz"'), progress=Impatient())
    finally:
        signal.signal(signal.SIGTERM, before)
    (folder,) = list_runs(tmp_path / "runs")
    count = folder.data["samples"]["count"]
    assert count > 0
    assert f"{count} samples are stored in" in str(caught.value)
    whole(folder, count)


class Nobody(runner.Quiet):
    """Another process, which tries to continue the campaign at the start of each test; and what was announced."""

    def __init__(self, runs: Path) -> None:
        self.runs = runs
        self.refused: list[str] = []
        self.announced: list[str] = []

    def test(self, name: str, folder: Path, number: int, total: int) -> None:
        with raises("run.folder.used"):
            runner.resume(runs=self.runs)
        self.refused.append(name)

    def announce(self, text: str) -> None:
        self.announced.append(text)


def test_no_other_process_continues_a_campaign_between_two_tests(plan: Plan, tmp_path: Path) -> None:
    made = plan('name = "a"', f'name = "b"\nsettings = {{needs_file = "{tmp_path / "needed"}"}}', 'name = "c"')
    other = Nobody(tmp_path / "runs")
    with pytest.raises(RunError, match="Test 'b' failed"):
        runner.run(made)
    (tmp_path / "needed").touch()
    runner.resume(runs=tmp_path / "runs", progress=other)
    assert other.refused == ["a", "b", "c"]
    assert [folder.data["test"] for folder in list_runs(tmp_path / "runs")] == ["a", "b", "c"]


def test_a_campaign_finished_by_another_process_is_not_changed(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(RunError, match="Test 'a' failed"):
        runner.run(plan(f'name = "a"\nsettings = {{needs_file = "{tmp_path / "needed"}"}}', 'name = "b"'))
    (tmp_path / "needed").touch()
    stored = runner.stored_plan

    def after_another_process(folder: RunFolder) -> CampaignPlan:
        monkeypatch.setattr(runner, "stored_plan", stored)
        runner.resume(runs=tmp_path / "runs")
        return stored(folder)

    monkeypatch.setattr(runner, "stored_plan", after_another_process)
    folders = runner.resume(runs=tmp_path / "runs")
    assert [folder.data["test"] for folder in folders] == ["a", "b"]
    assert len(list_runs(tmp_path / "runs")) == 2
    for folder in folders:
        assert [step["outcome"] for step in folder.data["steps"] if step["step"] == "acquire"].count("done") == 1


def _unlink(file: Path) -> None:
    file.unlink()


def _empty(file: Path) -> None:
    file.write_text("")


def _rename_test(file: Path) -> None:
    file.write_text(file.read_text().replace('"test": "a"', '"test": "x"'))


def _copy(file: Path) -> None:
    shutil.copytree(file.parent, file.parent.with_name(f"copy-{file.parent.name}"))


@pytest.mark.parametrize("damage", [_unlink, _empty, _rename_test, _copy])
def test_a_test_is_not_measured_again_because_its_record_is_damaged(
    plan: Plan, tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    with pytest.raises(RunError, match="Test 'b' failed"):
        runner.run(plan('name = "a"', f'name = "b"\nsettings = {{needs_file = "{tmp_path / "needed"}"}}'))
    (tmp_path / "needed").touch()
    first = list_runs(tmp_path / "runs")[0].path
    stated = (first / "run.json").read_text()
    damage(first / "run.json")
    with pytest.raises(RunError, match=rf"unclear which tests were measured(.|\n)*{first.name}"):
        runner.resume(runs=tmp_path / "runs")
    assert len(list(tmp_path.glob("runs/2*"))) == 2
    shutil.rmtree(tmp_path / "runs" / f"copy-{first.name}", ignore_errors=True)
    (first / "run.json").write_text(stated)
    assert first.name in [folder.path.name for folder in runner.resume(runs=tmp_path / "runs")]


def test_an_unreadable_record_is_named_before_an_older_campaign_is_continued(plan: Plan, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="Test 'a' failed"):
        runner.run(plan(f'name = "a"\nsettings = {{needs_file = "{tmp_path / "needed"}"}}'))
    (tmp_path / "needed").touch()
    newest = tmp_path / "runs" / "99990101T000000Z-b-0123abcd"
    newest.mkdir()
    (newest / "run.json").write_text("{")
    other = Nobody(tmp_path / "runs")
    runner.resume(runs=tmp_path / "runs", progress=other)
    assert any(newest.name in text for text in other.announced)


def test_a_bench_that_cannot_be_opened_leaves_no_run_folder(plan: Plan, tmp_path: Path) -> None:
    with pytest.raises(BenchError, match="could not be opened"):
        runner.run(plan('name = "a"', bench="refuses = true"))
    assert list_runs(tmp_path / "runs") == []


def test_a_failed_report_does_not_affect_the_measurement(plan: Plan) -> None:
    def report(folder: Path) -> Path:
        raise OSError("no ink")

    folders = runner.run(plan('name = "a"', 'name = "b"'), report=report)
    assert all(folder.finished for folder in folders)
    assert folders[0].data["steps"][-1]["reason"] == "OSError: no ink"


def test_a_test_may_evaluate_its_result_by_trials(plan: Plan) -> None:
    (folder,) = runner.run(plan('name = "a"\nmonte_carlo = 60'), report=write_run_report)
    assert folder.errors is not None
    (file,) = folder.errors.parent.glob("*.monte_carlo.nc")
    assert sorted(path.name for path in folder.errors.parent.iterdir()) == [file.name, "errors.nc"]
    assert datasets.load(file).attrs["trials"] == 60
    assert [step["step"] for step in folder.data["steps"]][-2:] == ["monte_carlo", "report"]
    assert "Monte Carlo evaluation" in (folder.path / "report.html").read_text(encoding="utf-8")


def test_a_failed_evaluation_does_not_affect_the_measurement(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    campaign = plan('name = "a"\nmonte_carlo = 60')
    monkeypatch.delattr(plugins.get("methods", "ramp"), "trial_model")
    (folder,) = runner.run(campaign)
    assert folder.finished
    assert folder.data["steps"][-1]["outcome"] == "failed"
    assert "trial_model" in folder.data["steps"][-1]["reason"]


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("3", "at least 40 trials; found 3"),
        ("'often'", "monte_carlo"),
        ("60", "does not support the Monte Carlo evaluation"),
    ],
)
def test_an_impossible_evaluation_is_an_error(
    plan: Plan, monkeypatch: pytest.MonkeyPatch, key: str, message: str
) -> None:
    if key == "60":
        monkeypatch.delattr(plugins.get("methods", "ramp"), "trial_model")
    with pytest.raises(BenchError, match=message):
        plan(f'name = "a"\nmonte_carlo = {key}')


def test_method_without_data_is_a_failure(plan: Plan) -> None:
    with raises("method.no_data"):
        runner.run(plan('name = "a"\nsettings = {count = 0}'))


def test_broken_run_json_is_reported_and_affects_no_other_run(
    plan: Plan, tmp_path: Path, write: Callable[..., Path]
) -> None:
    first, _ = runner.run(plan('name = "a"', 'name = "b"'))
    (first.path / "run.json").write_text("{")
    with pytest.raises(RunError, match=r"run\.json: is not valid JSON"):
        RunFolder.open(first.path)
    assert [folder.data["test"] for folder in list_runs(tmp_path / "runs")] == ["b"]
    assert load_campaign(write('name = "a"')).name == "Ramps"


def test_each_test_measures_with_its_chosen_instrument_and_records_only_this_one(plan: Plan) -> None:
    second = '[instruments.other]\ndriver = "counter"\naddress = "sim://other"\nrate = "2 kHz"\n'
    folders = runner.run(
        plan(
            'name = "a"\ninstruments = {counter = "other"}',
            'name = "b"\ninstruments = {counter = "counter"}',
            bench=second,
        )
    )
    for folder, name, rate in zip(folders, ("other", "counter"), (2000.0, 1000.0), strict=True):
        assert [entry["name"] for entry in folder.data["instruments"]] == [name]
        with datasets.load(folder.raw) as raw:
            assert raw.attrs["sample_rate"] == rate
            assert [entry["name"] for entry in json.loads(raw.attrs["instruments"])] == [name]


def test_operator_and_certificates_reach_the_raw_data(plan: Plan) -> None:
    bench = '[certificates]\nbar = "K-1"\nthermometer = "T-1"\n'
    first, second = runner.run(plan('name = "a"', 'name = "b"\ncertificates = {bar = "K-2"}', bench=bench))
    with datasets.load(first.raw) as a, datasets.load(second.raw) as b:
        assert json.loads(a.attrs["certificates"]) == {"bar": "K-1", "thermometer": "T-1"}
        assert json.loads(b.attrs["certificates"]) == {"bar": "K-2", "thermometer": "T-1"}


def test_the_operator_of_a_campaign_is_in_the_raw_data(lab: None, write: Callable[..., Path]) -> None:
    file = write('name = "a"')
    text = file.read_text().replace('name = "Ramps"', 'name = "Ramps"\noperator = "M. Muster"')
    file.write_text(text)
    (folder,) = runner.run(load_campaign(file))
    assert folder.data["operator"] == "M. Muster"
    with datasets.load(folder.raw) as raw:
        assert raw.attrs["operator"] == "M. Muster"
        assert "certificates" not in raw.attrs


def test_a_certificate_of_an_unknown_item_is_an_error(lab: None, write: Callable[..., Path]) -> None:
    file = write('name = "a"', bench='[certificates]\nbear = "K-1"\n')
    with pytest.raises(BenchError, match=r"certificates.*bear: expected the number or hash of a certificate"):
        load_campaign(file)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[" * 100_000,
        '{"schema": "errormotion.run/1"}',
        '{"schema": "errormotion.run/1", "id": "x", "created": "9", "campaign": {"tests": 5}}',
        '{"schema": "errormotion.run/1", "id": "x", "created": "9", "campaign": "x"}',
        '{"schema": "errormotion.run/1", "id": "x", "created": "9", "campaign": {"tests": []}, "status": "running"}',
    ],
)
def test_a_damaged_run_does_not_prevent_the_resumption_of_another(plan: Plan, tmp_path: Path, text: str) -> None:
    (tmp_path / "missing.txt").unlink(missing_ok=True)
    with pytest.raises(RunError, match=r"missing\.txt"):
        runner.run(plan(f'name = "a"\nsettings = {{needs_file = "{tmp_path / "missing.txt"}"}}'))
    damaged = tmp_path / "runs" / "99990101T000000Z-b-damaged"
    damaged.mkdir()
    (damaged / "run.json").write_text(text)
    (tmp_path / "missing.txt").touch()
    (folder,) = runner.resume(runs=tmp_path / "runs")
    assert folder.finished
    with pytest.raises(RunError, match="Nothing to resume"):
        runner.resume(runs=tmp_path / "runs")
