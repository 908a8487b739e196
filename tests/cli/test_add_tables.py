"""Tables of other software become runs: a proposed map, numbered questions, and what is remembered.

The four files are those of a laboratory on its first day.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pytest
from command_line import CliRunner
from forked_commands import Commands
from terminal import Terminal

from errormotion import datasets
from errormotion.campaign.folder import RunFolder
from errormotion.cli.app import app
from errormotion.cli.commands.runs import add as command

Run = Callable[..., Any]

SLOPE = 40e-6
"""Relative error of the scale of X."""
MARCH = 1_772_438_400
"""2026-03-02 08:00 UTC, s."""
FAST = ("--set", "trials=200")
SET_UP = {
    "values.beam_origin": "['6 0 10 mm', '6 0 50 mm', '0 6 10 mm', '0 6 50 mm', '0 0 -1 mm']",
    "values.beam_direction": "[[-1, 0, 0], [-1, 0, 0], [0, -1, 0], [0, -1, 0], [0, 0, 1]]",
    "values.bar_radius": "5 mm",
    "values.distance_noise": "0.2 um",
    "values.level": "10 50 mm",
}
"""The frame with five sensors."""


def spindle_log(file: Path, seed: int = 7, machine: str = "DMU 65") -> Path:
    """Write the log of a warming spindle, German, with decimal commas, in the encoding of Windows."""
    rng = np.random.default_rng(seed)
    head = "Datum;Uhrzeit;X1 [µm];X2 [µm];Y1 [µm];Y2 [µm];Z [µm];T Spindel [°C]"
    lines = ["Prüfprotokoll Spindelverlagerung;;;;;;;", f"Maschine: {machine};;;;;;;", head]
    for seconds in range(0, 3600, 30):
        warm, now = 1 - np.exp(-seconds / 1200), datetime(2026, 3, 9, 8) + timedelta(seconds=seconds)
        values = [1000 + size * warm + rng.normal(0, 0.2) for size in (3, 5, -2, -3, -12)]
        texts = [*(f"{value:.2f}" for value in values), f"{20 + 8 * warm:.1f}"]
        lines.append(";".join([f"{now:%d.%m.%Y;%H:%M:%S}", *(text.replace(".", ",") for text in texts)]))
    file.write_bytes(("\r\n".join(lines) + "\r\n").encode("cp1252"))
    return file


def positioning(file: Path, axis: str = "X", seed: int = 1, title: str = "Positioniergenauigkeit {}-Achse") -> Path:
    """Write a test according to ISO 230-2 as a spreadsheet, its readings as measured: there and back, five times."""
    rng = np.random.default_rng(seed)
    book = openpyxl.Workbook()
    sheet = book.active
    assert sheet is not None
    for row in ([title.format(axis)], [], ["Sollposition [mm]", "Abweichung [µm]"]):
        sheet.append(row)
    targets = np.round(np.linspace(-200, 200, 11) + rng.uniform(-2, 2, 11), 3)
    for way in (targets, targets[::-1]) * 5:
        for target in way:
            sheet.append([float(target), round(1e3 * SLOPE * target + rng.normal(0, 0.3), 1)])
    book.save(file)
    return file


def tracker(file: Path) -> Path:
    """Write the lengths of a tracker from four stations to sixty targets."""
    rng = np.random.default_rng(3)
    stations = np.array([[-1.5, 0.0, 0.3], [0.0, -1.6, 1.2], [1.4, 0.2, 0.4], [0.1, 1.5, 1.3]])
    axes = np.linspace(-0.2, 0.2, 5), np.linspace(-0.15, 0.15, 4), (0.0, 0.1, 0.2)
    lines = ["Station\tPoint\tX [mm]\tY [mm]\tZ [mm]\tLength [mm]"]
    for number, station in enumerate(stations, 1):
        for k, target in enumerate(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3), 1):
            length = np.linalg.norm(target * [1 + SLOPE, 1, 1] - station) + rng.normal(0, 3e-7)
            x, y, z = 1e3 * target
            lines.append(f"S{number}\tP{k}\t{x:.3f}\t{y:.3f}\t{z:.3f}\t{1e3 * length:.4f}")
    file.write_text("\n".join(lines) + "\n")
    return file


def temperatures(file: Path) -> Path:
    """Write a day of eight thermometers."""
    lines = [";".join(["Zeit", *(f"PT100_{k} (°C)" for k in range(1, 9))])]
    for minute in range(0, 1440, 5):
        now = datetime(2026, 3, 10, 6) + timedelta(minutes=minute)
        values = [f"{20 + 0.3 * k + 2 * np.sin(minute / 229):.2f}".replace(".", ",") for k in range(8)]
        lines.append(";".join([f"{now:%d.%m.%Y %H:%M:%S}", *values]))
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


def found(runs: Path = Path("runs")) -> list[RunFolder]:
    """Return the runs, in the order in which they were added."""
    return sorted(
        (RunFolder.open(each.parent) for each in runs.glob("*/run.json")), key=lambda each: each.data["added"]
    )


@pytest.fixture
def person(run: Run, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run ``add`` on a terminal, with what a person types; return the questions that were asked."""
    monkeypatch.setattr(command, "on_terminal", lambda: True)

    def call(*arguments: Any, types: list[str]) -> str:
        result = CliRunner().invoke(app, ["add", *map(str, arguments)], input="".join(f"{each}\n" for each in types))
        assert result.exit_code == 0, result.output
        return str(result.stderr)

    return call


def test_the_four_files_of_a_first_day_need_four_commands(run: Run, answer: Run, person: Run, tmp_path: Path) -> None:
    person(spindle_log(tmp_path / "Spindel.csv"), types=["1", *SET_UP.values()])
    person(positioning(tmp_path / "X_Achse.xlsx"), *FAST, types=["1", "1", "1", "", ""])
    chain = ("--set", "chain=workpiece-X-Y-bed-Z-spindle-tool")
    person(tracker(tmp_path / "tracker.txt"), *chain, types=["1", "1", "0.3 um"])
    person(temperatures(tmp_path / "Temperaturen.csv"), types=["1"])
    added = found()
    assert [each.data["method"]["id"] for each in added] == [
        "spindle_drift", "linear_positioning", "multilateration", ""
    ]  # fmt: skip
    assert {each.data["bench"]["machine"] for each in added} == {"DMU 65"}
    assert all(each.finished and (each.path / str(each.data["report"])).exists() for each in added)
    assert [each.data["created"][:10] for each in (added[0], added[3])] == ["2026-03-09", "2026-03-10"]
    drift = datasets.load(str(added[0].errors))
    # The end of the bar has moved by -12 um * (1 - exp(-59.5 / 20)); noise of 0.2 um, and U holds it.
    end = drift.isel(time=-1)
    u = float(np.sqrt(end["covariance"].values[2, 2]))
    assert abs(float(end["EZ"]) + 12e-6 * (1 - np.exp(-59.5 / 20))) < 3 * u
    with datasets.load(added[3].raw) as log:
        assert log.sizes == {"time": 288, "sensor": 8} | {dim: n for dim, n in log.sizes.items() if dim == "source"}
    # Two further repeats are read without a question, and have a history; two methods are compared.
    for k, seed in ((1, 2), (2, 3)):
        file = positioning(tmp_path / f"X_Achse_{k}.xlsx", seed=seed)
        os.utime(file, (MARCH + 86400 * 30 * k, MARCH + 86400 * 30 * k))
        assert person(file, *FAST, types=[]) == ""
    values = answer("history", "--machine", "DMU 65", "--figure", "A of EXX (ISO 230-2)")["values"]
    assert len(values) == 3
    compared = answer("compare", added[1].path, added[2].path, "--freedoms", "EX")
    assert compared["ok"]


def test_another_axis_in_a_table_of_the_same_kind_is_not_read_by_the_earlier_map(
    run: Run, person: Run, tmp_path: Path
) -> None:
    run("add", positioning(tmp_path / "X.xlsx"), "--yes", "--machine", "VMC", *FAST)
    person(positioning(tmp_path / "b.xlsx", axis="Y"), *FAST, types=["1", "", "", "", ""])
    asked = person(positioning(tmp_path / "c.xlsx", seed=4, title="Messung"), *FAST, types=["3", "1", "", "", "", ""])
    assert "Which axis was measured?" in asked
    assert [each.data["test"][-1] for each in found()] == ["X", "Y", "Z"]


def test_a_script_does_not_take_the_axis_of_an_earlier_file(run: Run, tmp_path: Path) -> None:
    printed = run(
        "add", positioning(tmp_path / "a.xlsx", title="Messung"), "--yes", *FAST, "--axis", "X", "--machine", "M"
    )
    assert "columns.deviation = EXX" in printed.stdout  # what was proposed and taken is listed
    other = positioning(tmp_path / "b.xlsx", title="Messung", seed=4)
    message = run("add", other, "--yes", *FAST, code=1).stderr
    assert "--axis AXIS" in message
    assert "X in an earlier file" in message
    run("add", other, "--yes", *FAST, "--axis", "Y")
    assert [each.data["test"][-1] for each in found()] == ["X", "Y"]


def test_answers_to_a_known_file_are_compared_with_those_before(run: Run, tmp_path: Path) -> None:
    stated = ("--yes", *FAST, "--axis", "X", "--machine", "M")
    file = positioning(tmp_path / "a.xlsx", title="Messung")
    run("add", file, *stated, "--set", "values.length_uncertainty=1e-6")
    run("add", file, *stated, "--set", "values.length_uncertainty=1e-6", "--set", "columns.deviation=EXX")
    for other in ("values.length_uncertainty=2e-6", "columns.deviation=EYX", "values.functional_point=0 0 1 mm"):
        assert f"--set {other}" in run("add", file, *stated, "--set", other, code=1).stderr


def test_a_script_does_not_take_the_machine_of_an_earlier_file_where_the_record_has_several(
    run: Run, tmp_path: Path
) -> None:
    for seed, machine in enumerate(("A", "B"), 1):
        run("add", positioning(tmp_path / f"{machine}.xlsx", seed=seed), "--yes", *FAST, "--machine", machine)
    message = run("add", positioning(tmp_path / "c.xlsx", seed=3), "--yes", *FAST, code=1).stderr
    assert "--machine NAME" in message


def test_files_of_another_machine_are_asked_where_the_record_has_several(run: Run, tmp_path: Path) -> None:
    stated = [part for key, text in SET_UP.items() for part in ("--set", f"{key}={text}")]
    run("add", spindle_log(tmp_path / "a.csv"), "--yes", *stated)
    run("add", spindle_log(tmp_path / "b.csv", seed=8), code=0)
    message = run("add", spindle_log(tmp_path / "c.csv", seed=9, machine="DMU 80"), "--yes", code=1).stderr
    assert "values.beam_origin" in message  # the set-up of the other machine is not taken
    assert [each.data["bench"]["machine"] for each in found()] == ["DMU 65", "DMU 65"]


def test_answers_are_remembered_for_the_machine(run: Run, person: Run, tmp_path: Path) -> None:
    person(spindle_log(tmp_path / "a.csv"), types=["1", *SET_UP.values()])
    for folder in found():
        (folder.path / "map.toml").unlink()  # so that the second file is proposed again
    asked = person(spindle_log(tmp_path / "b.csv", seed=8), types=["1"])
    assert "beam_origin" not in asked
    first, second = (datasets.load(each.raw) for each in found())
    np.testing.assert_array_equal(first["beam_origin"], second["beam_origin"])


def test_the_set_up_of_the_machine_in_the_file_is_not_taken_for_another_one(
    run: Run, person: Run, tmp_path: Path
) -> None:
    person(spindle_log(tmp_path / "a.csv"), types=["1", *SET_UP.values()])
    (found()[0].path / "map.toml").unlink()
    other = dict(SET_UP, **{"values.bar_radius": "6 mm"})
    person(spindle_log(tmp_path / "b.csv", seed=8), types=["DMU 80", *other.values()])
    first, second = (datasets.load(each.raw) for each in found())
    assert [float(each["bar_radius"]) for each in (first, second)] == [0.005, 0.006]
    kept = tmp_path / "runs" / "machines.toml"
    kept.write_text(kept.read_text().replace('"5 mm"', '"5 kg"'))
    (found()[1].path / "map.toml").unlink()
    message = run("add", spindle_log(tmp_path / "c.csv", seed=9), "--yes", "--machine", "DMU 65", code=1).stderr
    assert "machines.toml" in message
    assert "bar_radius" in message


def test_a_wrong_answer_is_asked_again(person: Run, tmp_path: Path) -> None:
    wrong = ["1", *SET_UP.values()]
    wrong[3:3] = ["5 kg"]
    asked = person(spindle_log(tmp_path / "a.csv"), types=wrong)
    assert asked.count("radius of the bar") >= 2
    assert found()[0].finished


def test_a_script_gets_all_questions_with_their_options_at_once(run: Run, tmp_path: Path) -> None:
    message = run("add", positioning(tmp_path / "X.xlsx"), code=1).stderr
    for text in ("--machine NAME", "--axis AXIS", "columns.deviation", "proposed: EXX", "--yes"):
        assert text in message
    run("add", "X.xlsx", "--yes", "--machine", "VMC", "--set", "values.length_uncertainty=1e-6", *FAST)
    [folder] = found()
    assert (
        'length_uncertainty = "1e-6"' in (folder.path / "map.toml").read_text()
        or "1e-06" in (folder.path / "map.toml").read_text()
    )
    assert "values.length" not in json.dumps(folder.data["settings"])
    message = run("add", "X.xlsx", "--again", "--yes", "--set", "values.lenght_uncertainty=1e-6", code=1).stderr
    assert "length_uncertainty" in message


def test_a_file_without_a_table_leaves_nothing(run: Run, tmp_path: Path) -> None:
    (tmp_path / "photo.jpg").write_bytes(b"\xff\xd8\xff\xe0 a picture")
    (tmp_path / "letter.txt").write_text("Dear customer,\nthank you for your order.\n")
    for name in ("photo.jpg", "letter.txt"):
        assert name in run("add", name, "--yes", code=1).stderr
    assert list((tmp_path / "runs").iterdir()) == []


@pytest.fixture(scope="module")
def commands() -> Iterator[Commands]:
    with Commands() as started:
        yield started


@pytest.mark.slow
def test_the_bars_are_hidden_while_a_person_types(commands: Commands, tmp_path: Path) -> None:
    positioning(tmp_path / "X.xlsx")
    terminal = Terminal(commands, tmp_path, "add", "X.xlsx", *FAST, TERM="xterm", COLUMNS="120")
    try:
        terminal.wait_for("Answer:")
        asked = len(terminal.shown)
        time.sleep(1.0)  # ten refreshes of the bars
        terminal.wait_for("Answer:")
        assert "reading the files" not in terminal.shown[asked:]
        for prompt, text in (("Which axis", "VMC"), ("Which error", ""), ("functional_point", ""), ("length_unc", "")):
            terminal.type(f"{text}\r")
            terminal.wait_for(prompt)
        terminal.type("\r")
        assert terminal.end() == 0
    finally:
        terminal.close()
    assert "linear_positioning-X of VMC" in terminal.shown
