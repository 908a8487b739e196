"""Temporary files and folders, such as a power cut leaves, are in no list and no result."""

import shutil
from pathlib import Path

import pytest
from coded import raises

from errormotion.campaign import batch
from errormotion.campaign.compensation.following import AUDIT, compensations
from errormotion.campaign.folder import RunFolder, list_runs
from errormotion.campaign.storage.raw_paths import is_runs_folder
from errormotion.cli.results import load
from errormotion.datasets.files.reading import visible
from errormotion.datasets.files.writing import is_part
from errormotion.errors import ErrormotionError
from errormotion.record.runs import listing
from errormotion.report.write import write_run_report

PART = ".run.0123456789abcdef.part"


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Return a folder with one run, and a temporary copy of it that states the same."""
    base = {"bench": {"machine": "Mill"}, "method": {"id": "spindle_drift"}, "steps": [], "campaign": {"name": "a"}}
    made = RunFolder.create(tmp_path / "runs", "drift", "00000001", {**base, "status": "running", "acquired": True})
    (made.path / AUDIT).write_text("")
    assert is_part(PART)
    shutil.copytree(made.path, tmp_path / "runs" / PART)
    return tmp_path / "runs"


def test_no_list_has_a_temporary_folder(runs: Path) -> None:
    (only,) = [path for path in runs.iterdir() if path.name != PART]
    assert [path.name for path in compensations(runs)] == [only.name]
    assert [each.path.name for each in list_runs(runs)] == [only.name]
    assert [entry.folder for _, entry in listing.list_runs([runs]).runs] == [only.name]
    assert [path.name for path, _ in batch._runs(runs, "spindle_drift")] == [only.name]
    assert visible(runs, "*/run.json") == [only / "run.json"]


def test_a_folder_with_temporary_folders_only_has_no_runs(runs: Path) -> None:
    (only,) = [path for path in runs.iterdir() if path.name != PART]
    shutil.rmtree(only)
    assert not is_runs_folder(runs)
    with pytest.raises(ErrormotionError):
        load([runs], {})


def test_a_report_contains_no_temporary_result(runs: Path) -> None:
    (only,) = [path for path in runs.iterdir() if path.name != PART]
    (only / "errors" / ".2026.0123456789abcdef.part").mkdir(parents=True)
    (only / "errors" / ".2026.0123456789abcdef.part" / "errors.nc").write_bytes(b"half")
    with raises("run.no_errors"):
        write_run_report(only)


def test_no_page_lists_a_temporary_or_hidden_file(tmp_path: Path) -> None:
    pytest.importorskip("bokeh", reason="pip install 'errormotion[dashboard]'")
    from errormotion.dashboard.campaigns import Campaigns
    from errormotion.dashboard.compensations import Compensations

    for name in ("a.toml", "._a.toml", ".a.toml.0123456789abcdef.part", ".b.toml"):
        (tmp_path / name).write_text('schema = "errormotion.campaign/1"\n')
    for name in ("a.bench.toml", ".b.bench.toml"):
        (tmp_path / name).write_text('schema = "errormotion.bench/1"\n')
    assert Campaigns(tmp_path).names() == ["a.toml"]
    assert [each.name for each in Compensations(tmp_path, tmp_path).benches()] == ["a.bench.toml"]
