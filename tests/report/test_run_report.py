"""The report of a run folder is written into it."""

import json

import pytest
from coded import raises

from errormotion.datasets import save
from errormotion.errors import RunError
from errormotion.report import write_run_report

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture
def run_folder(tmp_path, make_drift):
    folder = tmp_path / "20260302T081500Z-drift-ab12"
    (folder / "errors" / "spindle_drift-0123").mkdir(parents=True)
    save(make_drift(300), folder / "errors" / "spindle_drift-0123" / "errors.nc")
    run = {
        "schema": "errormotion.run/1",
        "id": "ab12",
        "test": "drift",
        "created": "2026-03-02T08:14:00+00:00",
        "bench": {"name": "Lab 2"},
    }
    (folder / "run.json").write_text(json.dumps(run))
    return folder


def test_a_report_is_written_into_a_run_folder(run_folder):
    path = write_run_report(run_folder)
    assert path == run_folder / "report.html"
    text = path.read_text(encoding="utf-8")
    assert "Thermal drift of the spindle" in text
    assert "ab12" in text
    assert sorted(entry.name for entry in run_folder.iterdir()) == ["errors", "report.html", "run.json"]


def test_simulation_stated_only_in_the_run_is_detected(run_folder):
    run = json.loads((run_folder / "run.json").read_text())
    run["instruments"] = [{"name": "frame", "address": "sim://cframe/frame?seed=3"}]
    (run_folder / "run.json").write_text(json.dumps(run))
    assert "SIMULATED DATA" in write_run_report(run_folder).read_text(encoding="utf-8")


def test_a_folder_without_results_is_reported_with_a_remedy(tmp_path):
    with raises("run.no_errors"):
        write_run_report(tmp_path)


def test_a_missing_folder_is_reported(tmp_path):
    with pytest.raises(RunError, match="nowhere"):
        write_run_report(tmp_path / "nowhere")


def test_a_damaged_run_file_is_reported(run_folder):
    (run_folder / "run.json").write_text("{")
    with pytest.raises(RunError, match=r"run\.json: is not valid JSON"):
        write_run_report(run_folder)
