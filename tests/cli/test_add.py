"""``errormotion add``: files of other software become runs of the record."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from errormotion import datasets
from errormotion.campaign.folder import RunFolder
from errormotion.record.adding.originals import sha256_of

Run = Callable[..., Any]

FAST = ("--set", "trials=200")
MARCH = 1_772_438_400
"""2026-03-02 08:00 UTC, s."""


def readings(seed: int, machine: str = "VMC 850", runs: int = 5) -> str:
    """Return a test according to ISO 230-2 as text with its schema: errors of some um, and a noise of 0.3 um."""
    rng = np.random.default_rng(seed)
    targets = [10.0, 120.0, 235.0, 340.0, 455.0]
    lines = ["# schema = errormotion.raw.linear_positioning/1", "# length_uncertainty = 0.4e-6"]
    lines += [f"# machine = {machine}"] if machine else []
    lines.append("freedom,run,approach,target,deviation [um]")
    for run in range(1, runs + 1):
        for k, approach in enumerate(("forward", "backward")):
            for number, target in enumerate(targets, 1):
                error = 0.01 * target - 1.5 * k + rng.normal(0, 0.3)
                lines.append(f"EXX,{run},{approach},{number},{error:.2f}")
    lines += ["", "target,target_position [mm]", *(f"{k},{each}" for k, each in enumerate(targets, 1))]
    return "\n".join(lines) + "\n"


MAP = """schema = "errormotion.raw.linear_positioning/1"
machine = "VMC 850"
attributes = {axis = "X"}
labels = {run = "Run", approach = "Direction", target = "Point"}
[columns]
deviation.EXX = {column = "Error", unit = "um"}
target_position = {column = "Target", unit = "mm"}
[values]
length_uncertainty = 0.4e-6
"""


def export(runs: int) -> str:
    """Return a test as the export of other software."""
    rng = np.random.default_rng(2)
    lines = ["Run;Direction;Point;Target;Error"]
    for run in range(1, runs + 1):
        for approach in ("forward", "backward"):
            for k, target in enumerate((10.0, 120.0, 235.0), 1):
                lines.append(
                    f"{run};{approach};{k};{target};{0.01 * target + rng.normal(0, 0.3):.2f}".replace(".", ",")
                )
    return "\n".join(lines) + "\n"


def single(folder: Path) -> RunFolder:
    """Return the only run."""
    [path] = [each.parent for each in folder.glob("*/run.json")]
    return RunFolder.open(path)


def test_a_file_becomes_a_finished_run_with_its_original(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "x axis (1).csv"
    file.write_text(readings(1))
    printed = run("add", file, *FAST).stdout
    folder = single(tmp_path / "runs")
    assert "A of EXX" in printed
    assert folder.finished
    assert folder.data["bench"] == {"machine": "VMC 850"}
    assert folder.data["test"] == "linear_positioning-X"
    [kept] = folder.data["imported"]["files"]
    assert kept == {"name": file.name, "sha256": sha256_of(file), "size": file.stat().st_size}
    assert (folder.path / "imported" / file.name).read_bytes() == file.read_bytes()
    assert folder.errors is not None
    assert (folder.path / str(folder.data["report"])).exists()
    run("validate", folder.path)


def test_the_result_is_that_of_identify(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(readings(1))
    run("add", "a.csv", *FAST)
    run("identify", "a.csv", "--out", "b.nc", *FAST)
    errors = single(tmp_path / "runs").errors
    assert errors is not None
    xr.testing.assert_equal(datasets.load(errors), datasets.load(tmp_path / "b.nc"))


def test_neither_run_nor_report_states_a_setting_of_an_acquisition(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(readings(1))
    run("add", "a.csv", *FAST, "--set", "dwell=5 s")
    folder = single(tmp_path / "runs")
    assert not {"feed", "travel", "overrun", "average"} & set(folder.data["settings"])
    assert folder.data["settings"]["dwell"] == 5.0
    page = (folder.path / "report.html").read_text()
    assert "overrun" not in page
    assert "mm/min" not in page
    assert "a.csv" in page


def test_the_same_file_is_recognised_by_its_content(run: Run, answer: Run, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(readings(1))
    (tmp_path / "copy of a.csv").write_text(readings(1))
    first = answer("add", "a.csv", *FAST)
    second = answer("add", "copy of a.csv", *FAST)
    assert not first["known"]
    assert second["known"]
    assert second["folder"] == str((tmp_path / first["folder"]).resolve())
    assert answer("add", "copy of a.csv", "--again", *FAST)["known"] is False
    assert len(list((tmp_path / "runs").glob("*/run.json"))) == 2


def test_a_known_file_with_other_statements_is_refused_with_the_differences(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(readings(1))
    (tmp_path / "head.toml").write_text(HEAD)
    stated = ("--machine", "VMC 850", "--axis", "X", *FAST, "--head", "head.toml", "--set", "dwell=5 s")
    run("add", "a.csv", *stated)
    for same in (stated, (), FAST):
        assert "in the record already" in run("add", "a.csv", *same).stdout
    for other, expected in (
        (("--machine", "Other"), "--machine Other (there VMC 850)"),
        (("--axis", "Y"), "--axis Y (there X)"),
        (("--method", "circular_test"), "--method circular_test (there linear_positioning)"),
        (("--set", "dwell=6 s"), "--set dwell=..."),
        (("--set", "units.deviation=nm"), "--set units.deviation=nm"),
        (("--test", "acceptance"), "--test acceptance"),
        (("--measured", "2026-02-01T10:00+01:00"), "--measured 2026-02-01T10:00:00+01:00"),
    ):
        message = run("add", "a.csv", *other, code=1).stderr
        assert expected in message
        assert "--again" in message
    (tmp_path / "head.toml").write_text(HEAD.replace("R-17", "R-18"))
    assert "--head head.toml" in run("add", "a.csv", "--head", "head.toml", code=1).stderr
    assert len(list((tmp_path / "runs").glob("*/run.json"))) == 1


def test_a_map_is_kept_and_a_failed_run_is_continued_by_the_same_command(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(export(1))
    (tmp_path / "map.toml").write_text(MAP)
    failed = run("add", "a.txt", "--map", "map.toml", *FAST, code=1).stderr
    folder = single(tmp_path / "runs")
    assert folder.data["status"] == "failed"
    assert str(folder.path.name) in failed
    assert "to continue this run" in failed
    assert (folder.path / "map.toml").read_text() == MAP
    stated = ("--set", "uncertainty.scatter=0.3 um", "--set", "uncertainty.drift=0.3 um")
    run("add", "a.txt", *FAST, *stated)
    assert single(tmp_path / "runs").finished  # the kept map is used, and there is one run
    run("add", "a.txt", "--map", "map.toml", *FAST, *stated)
    (tmp_path / "map.toml").write_text(MAP.replace("0.4e-6", "0.5e-6"))
    assert "--map map.toml" in run("add", "a.txt", "--map", "map.toml", code=1).stderr


def test_nothing_is_left_of_files_that_cannot_be_read(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(readings(1).replace("EXX,1,forward,2,", "EXX,1,forward,2,?"))
    message = run("add", "a.csv", code=1).stderr
    assert "line " in message
    assert list((tmp_path / "runs").iterdir()) == []


def test_without_a_terminal_missing_answers_are_listed_with_their_options(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(readings(1, machine=""))
    for option in ((), ("--yes",)):  # nothing can be proposed for a machine that is not in the record
        message = run("add", "a.csv", *option, code=1).stderr
        assert "--machine NAME" in message
    assert list((tmp_path / "runs").iterdir()) == []
    run("add", "a.csv", "--machine", "VMC 850", *FAST)
    (tmp_path / "b.csv").write_text(readings(2, machine=""))
    assert "proposed: VMC 850" in run("add", "b.csv", code=1).stderr
    run("add", "b.csv", "--yes", *FAST)
    assert {each.parent.name[17:18] for each in (tmp_path / "runs").glob("*/run.json")} == {"a", "b"}


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--machine", "Other"), "--machine Other: the data are of the machine 'VMC 850'"),
        (("--method", "circular_test"), "--method circular_test: the data are of the method 'linear_positioning'"),
        (("--map", "missing.toml"), "missing.toml"),
        (("--set", "units.deviation=nm"), "--set units.deviation: a file with a schema states all of this"),
        (("--measured", "yesterday"), "--measured yesterday: expected a date"),
    ],
)
def test_statements_that_contradict_the_data_are_refused(
    run: Run, tmp_path: Path, options: tuple[str, str], expected: str
) -> None:
    (tmp_path / "a.csv").write_text(readings(1))
    result = run("add", "a.csv", *options, code=2 if options[0] == "--measured" else 1)
    assert expected in result.stderr
    assert not list(tmp_path.glob("runs/*/run.json"))


def test_answers_beside_a_map_and_another_start_are_refused(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(export(5))
    (tmp_path / "map.toml").write_text(MAP)
    message = run("add", "a.txt", "--map", "map.toml", "--set", "columns.deviation=EYX", *FAST, code=1).stderr
    assert "--set columns.deviation: a map states all of this" in message
    (tmp_path / "b.csv").write_text("# start = 2026-02-01T10:00:00+01:00\n" + readings(1))
    message = run("add", "b.csv", "--measured", "2026-02-02T10:00+01:00", *FAST, code=1).stderr
    assert "the data start at 2026-02-01T10:00:00+01:00" in message
    assert not list(tmp_path.glob("runs/*/run.json"))
    run("add", "b.csv", "--measured", "2026-02-01T09:00+00:00", *FAST)


def test_three_repeats_have_a_history_in_the_order_of_their_measurement(run: Run, answer: Run, tmp_path: Path) -> None:
    for k, day in enumerate((40, 0, 20)):
        file = tmp_path / f"{k}.csv"
        file.write_text(readings(k))
        os.utime(file, (MARCH + 86400 * day, MARCH + 86400 * day))
        run("add", file, *FAST)
    listed = answer("runs")["runs"]
    assert [each["created"][:10] for each in listed] == ["2026-04-11", "2026-03-22", "2026-03-02"]
    assert all(each["imported"] for each in listed)
    assert "finished, imported" in run("runs").stdout
    found = answer("history", "--machine", "VMC 850", "--figure", "A of EXX (ISO 230-2)")
    assert len(found["values"]) == 3


def test_the_stated_time_of_the_measurement_is_that_of_the_run(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(readings(1))
    os.utime(tmp_path / "a.csv", (MARCH, MARCH))
    run("add", "a.csv", "--measured", "2026-02-01T10:00+01:00", *FAST)
    data = single(tmp_path / "runs").data
    assert (data["created"], data["created_from"]) == ("2026-02-01T10:00:00+01:00", "")
    run("add", "a.csv", "--again", "--runs", "others", *FAST)
    folder = single(tmp_path / "others")
    assert (folder.data["created"], folder.data["created_from"]) == (
        "2026-03-02T08:00:00+00:00",
        "last change of the file",
    )
    assert "2026-03-02 08:00 UTC (last change of the file)" in (folder.path / "report.html").read_text()


HEAD = """schema = "errormotion.head/1"
operator = "A. Meier"
[laboratory]
name = "Test laboratory"
[report]
customer = "Smith Ltd"
number = "R-17"
[[instruments]]
name = "interferometer"
manufacturer = "Renishaw"
model = "XL-80"
serial_number = "8F22"
certificate = "C-4711"
calibrated_until = 2027-01-31
[environment]
"air temperature" = "20.3 degC"
[conditions]
warm-up = "30 min"
"""


def test_the_head_of_the_report_is_stated_in_a_file(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(readings(1))
    (tmp_path / "head.toml").write_text(HEAD)
    run("add", "a.csv", "--head", "head.toml", *FAST)
    folder = single(tmp_path / "runs")
    page = (folder.path / "report.html").read_text()
    for text in ("A. Meier", "Test laboratory", "Smith Ltd", "R-17", "serial number 8F22", "C-4711", "20.3 degC"):
        assert text in page, text
    assert "warm-up: 30 min" in page
    assert "linear_positioning-X" in page
    (tmp_path / "de.toml").write_text(HEAD.replace('number = "R-17"', 'language = "de"'))
    os.utime(tmp_path / "a.csv", (MARCH, MARCH))
    run("add", "a.csv", "--head", "de.toml", "--runs", "de", *FAST)
    page = (single(tmp_path / "de").path / "report.html").read_text()
    for text in ("(letzte Änderung der Datei)", "Importiert aus", "Prüfbedingungen", "Umgebung"):
        assert text in page, text
    errors = datasets.load(str(folder.errors))
    assert json.loads(errors.attrs["provenance"])["instruments"][0]["identity"]["serial_number"] == "8F22"
    (tmp_path / "head.toml").write_text(HEAD.replace("customer", "costumer"))
    assert "did you mean 'customer'" in run("add", "a.csv", "--head", "head.toml", "--again", code=1).stderr


def test_a_changed_original_is_a_violation_of_the_run(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(readings(1))
    run("add", "a.csv", *FAST)
    folder = single(tmp_path / "runs")
    (folder.path / "imported" / "a.csv").write_text(readings(2))
    assert "imported/a.csv" in run("validate", folder.path, code=3).stdout


def test_tolerances_decide_on_an_imported_run(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(readings(2))
    limits = 'schema = "errormotion.tolerances/1"\n[tolerances.figures]\n"A of EXX (ISO 230-2)" = "1 um"\n'
    (tmp_path / "limits.toml").write_text(limits)
    run("add", "a.csv", "--tolerances", "limits.toml", *FAST, code=4)
    assert single(tmp_path / "runs").data["conformity"]["verdict"] in run("runs").stdout


def test_a_file_with_a_map_of_its_own_is_asked_for_what_it_does_not_state(run: Run, tmp_path: Path) -> None:
    targets = [0.0, 10.5, 20.25, 30.0, 41.0, 50.0]
    head = f"HEADER::\nOwner : Linear\n\nTARGET DATA::\nTarget-count: 6\nTargets :\n{' '.join(map(str, targets))}\n\n"
    lines = [head + "USER-TEXT::\nMachine: Mill 7\n\nRUNS::\nRun-count:8\n\nDEVIATIONS::\nRun Target Data:"]
    rng = np.random.default_rng(1)
    for number in range(8):
        order = range(6) if number % 2 == 0 else range(5, -1, -1)
        lines += [f"{number + 1} {k + 1} {0.1 * targets[k] + rng.normal(0, 0.3):.2f}" for k in order]
    (tmp_path / "Y.rtl").write_text("\n".join([*lines, "EOF::"]) + "\n")
    assert "--axis AXIS" in run("add", "Y.rtl", "--yes", code=1).stderr
    assert "map.axes: no such question" in run("add", "Y.rtl", "--axis", "Y", "--set", "map.axes=X", code=1).stderr
    assert list((tmp_path / "runs").iterdir()) == []
    run("add", "Y.rtl", "--axis", "Y", "--set", "map.length_uncertainty=0.4 um/m", *FAST)
    folder = single(tmp_path / "runs")
    assert (folder.data["test"], folder.data["bench"]["machine"]) == ("linear_positioning-Y", "Mill 7")
    with datasets.load(folder.raw) as raw:
        assert float(raw["length_uncertainty"]) == pytest.approx(0.4e-6)


def test_errors_name_the_added_file_and_not_its_copy(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.nc").write_bytes(b"no dataset")
    message = run("add", "a.nc", code=1).stderr
    assert message.startswith("a.nc: ")
    assert "runs" not in message
