"""``errormotion compare``: files, run folders, folders of runs, names, and what it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from errormotion import datasets
from errormotion.campaign.folder import RunFolder
from errormotion.cli.app import app

FEW = ("--freedoms", "EX,EY,EZ")


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))

    def call(*arguments, code=0):
        result = CliRunner().invoke(app, [str(argument) for argument in arguments])
        assert result.exit_code == code, result.output
        return result

    return call


@pytest.fixture
def files(tmp_path, results):
    for name, ds in results.items():
        datasets.save(ds, tmp_path / f"{name}.nc")


def stored(folder: Path, ds, test, created=""):
    """Store a result in a run folder as a campaign leaves it."""
    made = RunFolder.create(folder.parent, "test", "1", {"test": test})
    made.path.rename(folder)
    run = RunFolder.open(folder)
    (folder / "errors" / "example-1").mkdir(parents=True)
    datasets.save(ds, folder / "errors" / "example-1" / "errors.nc")
    run.save(errors="errors/example-1/errors.nc", **({"created": created} if created else {}))


def test_files_are_compared_and_the_result_is_written(run, files):
    shown = run("compare", "drift.nc", "probing.nc", *FEW, "--out", "c.nc", "--report", "c.html").stdout
    assert "agree within their uncertainties" in shown
    assert "drift - probing" in shown
    datasets.validate(datasets.load("c.nc"))
    assert "drift - probing" in Path("c.html").read_text()
    run("report", "c.nc", "--out", "again.html")
    assert "drift - probing" in Path("again.html").read_text()


def test_a_result_is_never_overwritten(run, files):
    for option, name in (("--out", "c.nc"), ("--report", "c.html")):
        Path(name).write_text("mine")
        assert "exists already" in run("compare", "drift.nc", "probing.nc", *FEW, option, name, code=1).stderr
        assert Path(name).read_text() == "mine"


def test_a_run_folder_is_named_after_its_test(run, results, tmp_path):
    stored(tmp_path / "r1", results["drift"], "five sensors")
    stored(tmp_path / "r2", results["probing"], "balls")
    said = json.loads(run("compare", "r1", "r2", *FEW, "--json").stdout)
    assert [pair["pair"] for pair in said["pairs"]] == ["five sensors - balls"]
    assert said["agree"] is True
    assert said["pairs"][0]["p"] > 0.05
    assert set(said["pairs"][0]["p_of_freedoms"]) == {"EX", "EY", "EZ"}


def test_a_folder_of_runs_stands_for_the_newest_of_each_test(run, results, tmp_path):
    wrong = results["drift"].assign(EX=results["drift"]["EX"] + 1e-4)
    stored(tmp_path / "runs" / "b", wrong, "drift", "2026-03-01T07:00:00+00:00")
    stored(tmp_path / "runs" / "a", results["drift"], "drift", "2026-03-02T07:00:00+00:00")
    stored(tmp_path / "runs" / "c", results["probing"], "probing", "2026-03-02T07:00:00+00:00")
    (tmp_path / "runs" / "damaged").mkdir()
    (tmp_path / "runs" / "damaged" / "run.json").write_text("{")
    assert "damaged/run.json: is not valid JSON" in run("compare", "runs", *FEW, "--out", "c.nc").stdout
    found = datasets.load("c.nc")
    assert found["dataset"].values.tolist() == ["drift", "probing"]
    assert np.nanmax(np.abs(found["value"].sel(dataset="drift", dof="EX").values)) < 5e-5


def test_names_and_the_functional_point_can_be_given(run, files):
    run("compare", "drift.nc", "--name", "balls=probing.nc", *FEW, "--at", "0,0,-20", "--out", "c.nc")
    found = datasets.load("c.nc")
    assert found["pair"].values.tolist() == ["drift - balls"]
    np.testing.assert_allclose(found.attrs["functional_point"], [0, 0, -0.02])


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("drift.nc",), 1, "at least two datasets"),
        (("drift.nc", "missing.nc"), 1, "no such file"),
        (("drift.nc", "drift.nc"), 1, "same dataset"),
        (("drift.nc", "probing.nc", "--at", "1,2"), 2, "three numbers in mm"),
        (("drift.nc", "--name", "probing.nc"), 1, "NAME=PATH"),
        (("drift.nc", "probing.nc", "--freedoms", "EC"), 1, "does not state EC"),
        (("drift.nc", "unknown.nc"), 1, "no attribute 'start'"),
        (("drift.nc", "later.nc"), 1, "do not overlap"),
        (("drift.nc", "other.nc"), 1, "machine"),
        (("drift.nc", "empty"), 1, "expected a run folder"),
    ],
)
def test_refusals_say_what_was_expected(run, files, results, arguments, code, message):
    Path("empty").mkdir()
    probing = results["probing"]
    datasets.save(probing.drop_attrs(deep=False).assign_attrs({k: v for k, v in probing.attrs.items() if k != "start"}),
                  "unknown.nc")  # fmt: skip
    datasets.save(probing.assign_attrs(start="2027-03-02T07:00:00+00:00"), "later.nc")
    datasets.save(probing.assign_attrs(machine="another"), "other.nc")
    result = run("compare", *arguments, code=code)
    assert message in result.stderr
    assert "Traceback" not in result.output


def test_a_failure_is_json_too(run, files):
    said = json.loads(run("compare", "drift.nc", "--json", code=1).stdout)
    assert said["ok"] is False
    assert said["error"]["exit_code"] == 1
