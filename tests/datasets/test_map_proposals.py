"""Proposed maps: what is recognised of files of laboratories, what is asked, and that the written map reads them."""

from collections.abc import Mapping
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from errormotion.datasets.importing import import_files
from errormotion.datasets.maps.known import known_map
from errormotion.datasets.maps.proposal import Proposal, propose
from errormotion.datasets.maps.writing import text_of, write_map
from errormotion.errors import DatasetError
from tests.support.coded import raises

BEAMS = {
    "values.beam_origin": '["6 0 10 mm", "6 0 50 mm", "0 6 10 mm", "0 6 50 mm", "0 0 -1 mm"]',
    "values.beam_direction": "[[-1, 0, 0], [-1, 0, 0], [0, -1, 0], [0, -1, 0], [0, 0, 1]]",
    "values.bar_radius": "5 mm",
    "values.distance_noise": "0.3 um",
    "values.level": '["10 mm", "50 mm"]',
}
SPINDLE = "Maschine: M7\n\nZeit [s];X1 [µm];X2 [µm];Y1 [µm];Y2 [µm];Z [µm];T Rahmen [°C]\n" + "".join(
    f"{30 * k};1000,{k};1000;1001;1002;1003;20,{k}\n" for k in range(9)
)
SENSORS = "t;Sensor 1;Sensor 2;Sensor 3;Sensor 4;Sensor 5\n" + "".join(
    f"{30 * k};1000,{k};1000;1001;1002;1003\n" for k in range(9)
)
BACK_AND_FORTH = [0, 100, 200, 200, 100, 0] * 2
POSITIONING = "Position [mm];Abweichung [µm]\n" + "".join(f"{p};{k % 5},5\n" for k, p in enumerate(BACK_AND_FORTH))
DIFFERENCES = "Nr;Soll [mm];Ist [mm]\n" + "".join(f"{k + 1};{p};{p},000{k % 5}\n" for k, p in enumerate(BACK_AND_FORTH))
MATRIX = "Target [mm];1+ [um];1- [um];2+ [um];2- [um]\n" + "".join(f"{p};0,1;0,2;0,3;0,4\n" for p in (0, 100, 200))
LONG = "Lauf;Richtung;Position [mm];EXX [µm];EBX [arcsec]\n" + "".join(
    f"{run};{way};{p};1,5;0,5\n" for run in (1, 2) for way in "+-" for p in (0, 100, 200)
)
PT100 = (
    "Datum;Zeit;"
    + ";".join(f"T{k}" for k in range(1, 9))
    + "\n"
    + "".join(
        f"{4 + h // 24:02d}.05.2026;{h % 24:02d}:30:00;" + ";".join(f"2{k},{h % 10}" for k in range(8)) + "\n"
        for h in range(30)
    )
)
TRACKER = "Tracker 3.1\nLength noise: 0.5 um\nStation\tPunkt\tX [mm]\tY [mm]\tZ [mm]\tDistanz [mm]\n" + "".join(
    f"S{s}\tP{p}\t{p * 10}\t{p % 7 * 5}\t{p % 5 * 9}\t{1000 + p + s * 3.1:.4f}\n" for s in range(4) for p in range(60)
)
WIDE = "Punkt;X [mm];Y [mm];Z [mm];S1 [mm];S2 [mm];S3 [mm]\n" + "".join(
    f"P{p};{p * 10};{p % 7 * 5};{p % 5 * 9};1000,1;1100,2;{900 + p}\n" for p in range(20)
)
BALLS = "cycle;time [s];ball;x [mm];y [mm];z [mm]\n" + "".join(
    f"{c};{c * 60};{b};{b * 100},001;{b * 50},1;0\n" for c in range(3) for b in range(4)
)
TABLE = "Winkel [deg];Kugel;S1 [um];S2 [um];S3 [um]\n" + "".join(
    f"{a};{b};1;2;3\n" for a in range(0, 360, 30) for b in (1, 2)
)
NESTS = {
    "attributes.axis": "C",
    "values.sphere_position": '["0 0 1 mm", "0 1 100 mm"]',
    "values.sensor_direction": "[[1, 0, 0], [0, 1, 0], [0, 0, 1]]",
    "values.axis_point": "0 0 0 mm",
    "values.sensor_direction_uncertainty": "1 mrad",
    "values.gain_uncertainty": "0.001",
}
X = {"attributes.axis": "X"}
UNITS = {"units.time": "s", "units.distance": "um"}
FILES = [
    ("spindle", SPINDLE, BEAMS, "spindle_drift", {"channel": 5, "time": 9, "sensor": 1}),
    ("sensors", SENSORS, BEAMS | UNITS, "spindle_drift", {"channel": 5, "time": 9}),
    ("as measured", POSITIONING, X, "linear_positioning", {"run": 2, "approach": 2, "target": 3, "freedom": 1}),
    ("differences", DIFFERENCES, X, "linear_positioning", {"run": 2, "approach": 2, "target": 3, "freedom": 1}),
    ("matrix", MATRIX, X, "linear_positioning", {"run": 2, "approach": 2, "target": 3, "freedom": 1}),
    ("long", LONG, {}, "linear_positioning", {"run": 2, "approach": 2, "target": 3, "freedom": 2}),
    ("thermometers", PT100, {}, "monitor", {"time": 30, "sensor": 8}),
    ("tracker", TRACKER, {"values.displacement_noise": "0.5 um"}, "multilateration", {"station": 4, "target": 60}),
    ("stations", WIDE, {"values.displacement_noise": "0.5 um"}, "multilateration", {"station": 3, "target": 20}),
    ("balls", BALLS, {}, "normal_vector", {"time": 3, "ball": 4}),
    ("rotary table", TABLE, NESTS, "r_test", {"angle": 12, "sphere": 2, "sensor": 3}),
]  # fmt: skip


def file_of(tmp_path: Path, text: str, name: str = "file.csv") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def accepted(proposal: Proposal, answers: Mapping[str, str]) -> Proposal:
    """Return a proposal with these answers, and what is proposed for all other questions."""
    while proposal.questions:
        question = proposal.questions[0]
        answer = answers.get(question.key, question.proposed)
        assert answer or not question.needed, question
        proposal = proposal.answered({question.key: answer})
    return proposal


@pytest.mark.parametrize(
    ("text", "answers", "method", "sizes"), [case[1:] for case in FILES], ids=[case[0] for case in FILES]
)
def test_the_proposed_map_reads_the_file(tmp_path, text: str, answers: Mapping[str, str], method: str, sizes) -> None:
    file = file_of(tmp_path, text)
    proposal = accepted(propose([file]), answers)
    assert proposal.schema == f"errormotion.raw.{method}/1"
    write_map(proposal, tmp_path / "map.toml")
    raw = import_files([file], tmp_path / "map.toml")
    assert {dim: raw.sizes[dim] for dim in sizes} == sizes
    assert known_map([file], [tmp_path / "map.toml"]) == tmp_path / "map.toml"
    lines = [
        line for line in (tmp_path / "map.toml").read_text("utf-8").splitlines() if line and not line.startswith("#")
    ]
    assert len(lines) <= 22


def test_a_second_file_of_the_same_kind_has_the_same_map(tmp_path) -> None:
    proposal = accepted(propose([file_of(tmp_path, SPINDLE)]), BEAMS)
    write_map(proposal, tmp_path / "map.toml")
    second = file_of(tmp_path, SPINDLE.replace("1000,1", "1000,7"), "second.csv")
    other = file_of(tmp_path, SPINDLE.replace("X1 [µm]", "X1 [mm]"), "other.csv")
    assert known_map([second], [tmp_path / "map.toml"]) == tmp_path / "map.toml"
    assert known_map([other], [tmp_path / "map.toml"]) is None
    raw = import_files([second], tmp_path / "map.toml")
    assert float(raw["distance"].sel(channel="X1")[1]) == pytest.approx(1000.7e-6)


def test_the_order_of_dates_that_cannot_be_known_is_asked(tmp_path) -> None:
    log = "Date,T1 [C],T2 [C]\n" + "".join(f"03/04/2026 10:0{k}:00,20.{k},21\n" for k in range(9))
    proposal = propose([file_of(tmp_path, log)])
    (question,) = proposal.open
    assert question.key == "units.time"
    assert {choice.value for choice in question.choices} == {"mm/dd/yyyy", "dd/mm/yyyy"}
    shown = {choice.value: choice.text for choice in question.choices}
    assert shown["dd/mm/yyyy"] == "dd/mm/yyyy: 03 April 2026"
    assert propose([file_of(tmp_path, log)]).answered({"units.time": "dd/mm/yyyy"}).map["units"]["time"] == "dd/mm/yyyy"


@pytest.mark.parametrize(("later", "order"), [("04/04/2026", "dd/mm/yyyy"), ("03/05/2026", "mm/dd/yyyy")])
def test_the_order_of_dates_is_proposed_where_one_makes_the_times_dense(tmp_path, later: str, order: str) -> None:
    log = "Date,T1 [C]\n03/04/2026 22:00:00,20\n" + f"{later} 06:00:00,21\n{later} 07:00:00,21\n"
    (question, _) = propose([file_of(tmp_path, log)]).questions
    assert question.proposed == order


def test_an_unknown_unit_is_asked_and_not_guessed(tmp_path) -> None:
    proposal = propose([file_of(tmp_path, SENSORS)], answers=BEAMS)
    assert {question.key for question in proposal.open} == {"units.time", "units.distance"}
    with pytest.raises(DatasetError, match=r"units.distance: expected one of mm, um, nm, m, inch; found 'V'"):
        proposal.answered({"units.distance": "V"})


def test_columns_in_their_order_are_asked_and_can_be_exchanged(tmp_path) -> None:
    proposal = propose([file_of(tmp_path, SENSORS)], answers=BEAMS)
    asked = {question.key: question.proposed for question in proposal.questions if question.key.startswith("columns")}
    assert asked["columns.distance.X1"] == "Sensor 1"
    found = proposal.answered({"columns.distance.X1": "Sensor 3"}).map["columns"]["distance"]
    assert found == {"X1": "Sensor 3", "X2": "Sensor 2", "Y1": "Sensor 1", "Y2": "Sensor 4", "Z": "Sensor 5"}


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        ({"values.bar_radius": "5"}, "values.bar_radius: expected a unit"),
        ({"values.bar_radius": "5 s"}, "values.bar_radius: expected a unit of the kind of m"),
        ({"values.bar_radius": "5 m"}, "values.bar_radius: makes bar_radius = 5 m; expected 0.0005..0.1 m"),
        ({"values.bar": "5 mm"}, "values.bar: no such question; did you mean 'values.bar_radius'"),
        ({"raw": "errormotion.raw.r_test/1"}, "raw: expected a schema that fits the file"),
    ],
)
def test_a_wrong_answer_is_refused_with_its_key(tmp_path, answers, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        propose([file_of(tmp_path, SPINDLE)]).answered(answers)


def test_values_at_the_top_of_a_file_are_proposed(tmp_path) -> None:
    proposed = {question.key: question.proposed for question in propose([file_of(tmp_path, TRACKER)]).questions}
    assert proposed["values.displacement_noise"] == "0.5 um"
    assert {q.key: q.proposed for q in propose([file_of(tmp_path, SPINDLE)]).questions}["machine"] == "M7"


def test_temperatures_of_a_second_file_belong_to_the_readings(tmp_path) -> None:
    warm = file_of(tmp_path, "Zeit [s];T Rahmen [°C];T Bett [°C]\n0;20,5;21\n600;20,9;21\n", "warm.csv")
    log = file_of(
        tmp_path, "\n".join(line.rpartition(";")[0] or line for line in SPINDLE.splitlines()) + "\n", "log.csv"
    )
    proposal = accepted(propose([log, warm]), BEAMS)
    write_map(proposal, tmp_path / "map.toml")
    raw = import_files([log, warm], tmp_path / "map.toml")
    np.testing.assert_allclose(raw["temperature"].sel(sensor="T Rahmen"), 20.5 + 0.4 * np.arange(9) * 30 / 600)


def test_open_questions_stand_in_the_written_map(tmp_path) -> None:
    text = text_of(propose([file_of(tmp_path, SENSORS)]))
    asked = "Which unit has each of the columns 'Sensor 1', 'Sensor 2', 'Sensor 3', 'Sensor 4', 'Sensor 5'?"
    assert f"# TO STATE units.distance: {asked} One of mm, um, nm, m, inch" in text
    assert "# bar_radius =   # needed: radius of the bar at the side beams, m" in text


def test_a_file_of_no_schema_says_which_columns_it_has(tmp_path) -> None:
    proposal = propose([file_of(tmp_path, "a;b\n1;2\n2;5\n3;3\n")])
    assert not proposal.schema
    assert "'a', 'b'" in proposal.notes[0]


def test_negative_readings_are_no_direction_of_approach(tmp_path) -> None:
    text = MATRIX.replace("0,2", "-0,2").replace("0,4", "-0,4")
    proposal = accepted(propose([file_of(tmp_path, text)]), X)
    assert proposal.map["labels"] == {"target": "Target [mm]"}
    assert proposal.map["columns"]["deviation"]["EXX"]["labels"]["run"] == [1, 1, 2, 2]


def test_directions_may_be_signs_of_one(tmp_path) -> None:
    text = LONG.replace(";+;", ";1;").replace(";-;", ";-1;")
    names = accepted(propose([file_of(tmp_path, text)]), {}).map["labels"]["approach"]["names"]
    assert names == {"1": "forward", "-1": "backward"}


@pytest.mark.parametrize(
    ("text", "axis"),
    [
        (POSITIONING.replace("Position", "Pos. Y"), "Y"),
        ("Messung der Z-Achse\n" + POSITIONING, "Z"),
        (POSITIONING.replace("Abweichung", "EXX"), "X"),
        (POSITIONING, ""),
        ("Pruefung Z\nStellung Y-Achse: 200 mm\n" + POSITIONING, ""),
        ("Stellung Y-Achse: 200 mm\n" + POSITIONING, ""),
        ("Pruefung Z\nY-Achse geklemmt\n" + POSITIONING, ""),
        ("Temperatur 20 °C, Achse Y\n" + POSITIONING, "Y"),
    ],
)
def test_the_axis_is_that_of_a_title_or_a_line_above(tmp_path, text: str, axis: str) -> None:
    proposed = {question.key: question.proposed for question in propose([file_of(tmp_path, text)]).questions}
    assert proposed["attributes.axis"] == axis


def test_two_sheets_are_one_dataset(tmp_path) -> None:
    """Temperatures of one sheet, with dates of their own, at the times of the readings of the other."""
    from openpyxl import Workbook

    book, start = Workbook(), datetime(2026, 5, 4, 8)
    readings, warm = book.active, book.create_sheet("Temp")
    readings.title = "Weg"
    readings.append(["Zeit", *(f"{name} [µm]" for name in ("X1", "X2", "Y1", "Y2", "Z"))])
    warm.append(["Zeit", "T Rahmen [°C]"])
    for k in range(10):
        readings.append([start + timedelta(seconds=30 * k), 1000.5, 1001.0, 1002.0, 1003.0, 1004.0 + k])
    for k in range(4):
        warm.append([start + timedelta(seconds=100 * k), 20 + k])
    file = tmp_path / "book.xlsx"
    book.save(file)
    write_map(accepted(propose([file]), BEAMS), tmp_path / "map.toml")
    raw = import_files([file], tmp_path / "map.toml")
    np.testing.assert_allclose(raw["temperature"].squeeze(), 20 + 0.3 * np.arange(10), rtol=1e-12)
    assert known_map([file], [tmp_path / "map.toml"])


def test_a_comma_of_two_meanings_is_asked(tmp_path) -> None:
    log = file_of(tmp_path, "Zeit [s];T1 [C]\n" + "".join(f"{k},000;20,12{k}\n" for k in range(1, 6)))
    proposal = propose([log])
    (question,) = proposal.questions
    assert (question.key, question.proposed, question.needed) == ("format.decimal", "", True)
    proposal = accepted(proposal.answered({"format.decimal": ","}), {})
    write_map(proposal, tmp_path / "map.toml")
    raw = import_files([log], tmp_path / "map.toml")
    np.testing.assert_allclose(raw["temperature"].squeeze(), 20.12 + 1e-3 * np.arange(1, 6))
    with pytest.raises(DatasetError, match="no map can be proposed: The decimal sign cannot be seen"):
        write_map(propose([log]), tmp_path / "other.toml")


@pytest.mark.parametrize(
    ("title", "error"),
    [
        ("Abweichung", "EXX"),
        ("Positionsabweichung X", "EXX"),
        ("Istabweichung Run 1", "EXX"),
        ("Abweichung Y", ""),
        ("Geradheitsabweichung", ""),
        ("Straightness deviation", ""),
        ("Mean deviation", ""),
        ("Deviation pitch", ""),
    ],
)
def test_the_error_is_proposed_only_where_the_title_states_no_other(tmp_path, title: str, error: str) -> None:
    text = "Achse X\n\n" + POSITIONING.replace("Abweichung", title)
    proposed = {question.key: question.proposed for question in propose([file_of(tmp_path, text)]).questions}
    assert proposed["columns.deviation"] == error


def test_a_line_above_that_states_other_errors_leaves_the_error_open(tmp_path) -> None:
    text = "Geradheit, Achse X\n\n" + POSITIONING
    proposed = {question.key: question.proposed for question in propose([file_of(tmp_path, text)]).questions}
    assert proposed["columns.deviation"] == ""


@pytest.mark.parametrize(
    "title",
    [
        "Standardabweichung",
        "Standard deviation",
        "Fehlerkompensation",
        "Error correction",
        "Messunsicherheit Abweichung",
    ],
)
def test_what_belongs_to_a_deviation_is_not_the_deviation(tmp_path, title: str) -> None:
    rows = [line.split(";") for line in POSITIONING.splitlines()]
    alone = POSITIONING.replace("Abweichung", title)
    assert propose([file_of(tmp_path, alone)]).tables[0].meanings[1] == ""
    beside = "\n".join(f"{a};{title + ' [µm]' if k == 0 else '0,7'};{b}" for k, (a, b) in enumerate(rows))
    proposal = propose([file_of(tmp_path, beside)])
    assert proposal.map["columns"]["deviation"] == {"?": "Abweichung [µm]"}


def matrix_of(titles: list[str], positions: list[int]) -> str:
    head = ["Sollposition [mm]", *(f"{title} [µm]" for title in titles)]
    rows = [[str(p), *(f"{k + 1},{row}" for k in range(len(titles)))] for row, p in enumerate(positions)]
    return "Achse X\n\n" + "\n".join(map(";".join, [head, *rows])) + "\n"


@pytest.mark.parametrize(
    "titles",
    [
        [f"R{k}" for k in range(1, 7)],
        [f"Run {k} - Deviation" for k in range(1, 7)],
        [f"Messung {k}" for k in range(1, 7)],
        [f"Messung {k} vor" for k in range(1, 7)],
    ],
)
def test_directions_that_no_title_states_are_asked(tmp_path, titles: list[str]) -> None:
    file = file_of(tmp_path, matrix_of(titles, [0, 100, 200]))
    proposal = propose([file])
    (question,) = [each for each in proposal.open if each.key == "labels.approach"]
    assert [each.value for each in question.choices] == ["forward", "backward", "alternating"]
    with pytest.raises(DatasetError, match=r"labels.approach: expected one of forward, backward, alternating"):
        proposal.answered({"labels.approach": "up"})
    write_map(accepted(proposal, {"labels.approach": "alternating", "columns.deviation": "EXX"}), tmp_path / "map.toml")
    raw = import_files([file], tmp_path / "map.toml")
    assert dict(raw.sizes) == {"run": 3, "approach": 2, "target": 3, "freedom": 1}
    values = raw["deviation"].sel(approach="backward").squeeze().transpose("run", "target")
    np.testing.assert_allclose(values[:, 0], [2e-6, 4e-6, 6e-6])
    assert known_map([file], [tmp_path / "map.toml"]) is None
    backward = accepted(proposal, {"labels.approach": "backward", "columns.deviation": "EXX"})
    labels = backward.map["columns"]["deviation"]["EXX"]["labels"]
    assert labels == {"run": [1, 2, 3, 4, 5, 6], "approach": ["backward"] * 6}


@pytest.mark.parametrize(
    ("titles", "ways"),
    [
        (["R1", "F1", "R2", "F2"], ["backward", "forward"] * 2),
        (["Run 1 fwd", "Run 2 fwd"], ["forward"] * 2),
        (["Run 1 - bwd", "Run 2 - bwd"], ["backward"] * 2),
    ],
)
def test_directions_are_words_or_pairs_of_titles(tmp_path, titles: list[str], ways: list[str]) -> None:
    proposal = accepted(propose([file_of(tmp_path, matrix_of(titles, [0, 100]))]), {"columns.deviation": "EXX"})
    assert proposal.map["columns"]["deviation"]["EXX"]["labels"]["approach"] == ways


def test_the_axis_in_a_column_is_no_direction(tmp_path) -> None:
    rows = POSITIONING.splitlines()
    text = "\n".join([f"Achse;{rows[0]}", *(f"Z;{row}" for row in rows[1:])])
    proposal = propose([file_of(tmp_path, text)])
    assert "labels" not in proposal.map
    assert proposal.map["sequence"] == "Position [mm]"


def test_one_pass_has_the_direction_of_its_own_positions(tmp_path) -> None:
    """The map of a file with increasing positions reads one with decreasing ones."""
    up = file_of(tmp_path, matrix_of(["Abweichung"], [0, 100, 200]), "up.csv")
    down = file_of(tmp_path, matrix_of(["Abweichung"], [200, 100, 0]), "down.csv")
    write_map(accepted(propose([up]), {}), tmp_path / "map.toml")
    assert known_map([down], [tmp_path / "map.toml"]) == tmp_path / "map.toml"
    for file, way in ((up, "forward"), (down, "backward")):
        raw = import_files([file], tmp_path / "map.toml")
        assert list(raw["approach"].values[raw["deviation"].notnull().any(("run", "target", "freedom"))]) == [way]


def test_the_direction_of_positions_in_no_order_is_asked(tmp_path) -> None:
    proposal = propose([file_of(tmp_path, matrix_of(["Abweichung"], [0, 200, 100]))])
    assert [each.key for each in proposal.open] == ["labels.approach"]


def test_an_answered_unit_is_that_of_the_columns_without_one(tmp_path) -> None:
    text = matrix_of(["Run 1 fwd", "Run 1 bwd"], [0, 100]).replace("Run 1 fwd [µm]", "Run 1 fwd")
    file = file_of(tmp_path, text.replace("Run 1 bwd [µm]", "Run 1 bwd [mm]"))
    proposal = propose([file])
    assert {each.key: each.proposed for each in proposal.questions}["units.deviation"] == ""
    write_map(accepted(proposal, {"units.deviation": "um", "columns.deviation": "EXX"}), tmp_path / "map.toml")
    values = import_files([file], tmp_path / "map.toml")["deviation"].isel(target=0).squeeze()
    np.testing.assert_allclose(values.sel(approach=["forward", "backward"]), [1e-6, 2e-3])


def test_a_unit_beside_others_is_asked_and_kept(tmp_path) -> None:
    file = file_of(tmp_path, "Zeit [s];T1;T2 [°F]\n" + "".join(f"{60 * k};20;68\n" for k in range(5)))
    (question,) = (each for each in propose([file]).questions if each.key == "units.temperature")
    assert (question.text, question.proposed) == ("Which unit has column 'T1'?", "")
    write_map(accepted(propose([file]), {"units.temperature": "degC"}), tmp_path / "map.toml")
    values = import_files([file], tmp_path / "map.toml")["temperature"].isel(time=0)
    np.testing.assert_allclose(values, 20.0)


def test_a_unit_of_the_map_beside_another_one_of_the_file_is_refused(tmp_path) -> None:
    file = file_of(tmp_path, POSITIONING)
    write_map(accepted(propose([file]), X), tmp_path / "map.toml")
    text = (tmp_path / "map.toml").read_text("utf-8")
    (tmp_path / "map.toml").write_text(text + '\n[units]\ndeviation = "nm"\n', encoding="utf-8")
    with pytest.raises(DatasetError, match=r"units.deviation: file.csv states the unit .*expected no other one; found"):
        import_files([file], tmp_path / "map.toml")


def test_columns_of_one_variable_in_other_units(tmp_path) -> None:
    text = matrix_of(["Run 1 fwd", "Run 1 bwd"], [0, 100]).replace("Run 1 bwd [µm]", "Run 1 bwd [nm]")
    file = file_of(tmp_path, text)
    write_map(accepted(propose([file]), {"columns.deviation": "EXX"}), tmp_path / "map.toml")
    values = import_files([file], tmp_path / "map.toml")["deviation"].isel(target=0).squeeze()
    np.testing.assert_allclose(values.sel(approach=["forward", "backward"]), [1e-6, 2e-9])


@pytest.mark.parametrize(
    ("text", "key", "answer"),
    [
        (POSITIONING, "columns.target_position", "Typo"),
        (POSITIONING, "columns.temperature", "Position"),
        (POSITIONING, "columns.deviation", "Abweichung"),
        (LONG, "columns.deviation", "EYX"),
        (POSITIONING, "units.deviation", "nm"),
        (POSITIONING, "units.target_position", "nonsense"),
        (POSITIONING, "attributes.axis", "Q"),
        (POSITIONING, "attributes.spindle", "1"),
        (POSITIONING, "foo.axis", "X"),
        (POSITIONING, "values.foo", "1 mm"),
        (POSITIONING, "columns.foo", "Position"),
    ],
)
def test_an_answer_without_effect_is_refused(tmp_path, text: str, key: str, answer: str) -> None:
    file = file_of(tmp_path, text)
    with pytest.raises(DatasetError, match=key) as first:
        propose([file], answers={key: answer})
    with pytest.raises(DatasetError, match=key) as later:
        propose([file]).answered({key: answer})
    assert first.value.code == later.value.code == "map.answer"


def test_answers_that_only_other_schemas_have_are_ignored(tmp_path) -> None:
    found = propose([file_of(tmp_path, POSITIONING)], answers={"values.bar_radius": "5 mm"})
    assert "values" not in found.map


@pytest.mark.parametrize(
    ("line", "sign", "value"),
    [
        ("Bar radius: 1,250 mm", ".", ""),
        ("Bar radius: 1.250 mm", ".", "1.250 mm"),
        ("Bar radius: 0,25 mm", ".", "0.25 mm"),
        ("Bar radius: 1,250 mm", ",", "1.250 mm"),
        ("Bar radius: 1.250 mm", ",", ""),
        ("Bar radius: 0.25 mm", ",", "0.25 mm"),
        ("Bar radius: 1.250,5 mm", ",", ""),
    ],
)
def test_a_value_above_has_the_decimal_sign_of_its_table(tmp_path, line: str, sign: str, value: str) -> None:
    text = SPINDLE.replace("Maschine: M7", line)
    text = (
        text if sign == "," else text.replace(f"{line}\n", "").replace(",", ".").replace("\nZeit", f"{line}\nZeit", 1)
    )
    proposed = {question.key: question.proposed for question in propose([file_of(tmp_path, text)]).questions}
    assert proposed["values.bar_radius"] == value


def test_temperatures_that_may_be_of_either_unit_are_asked(tmp_path) -> None:
    log = "Zeit [s];T1\n" + "".join(f"{60 * k};7{k}\n" for k in range(5))
    assert [question.key for question in propose([file_of(tmp_path, log)]).open] == ["units.temperature"]


@pytest.mark.parametrize(
    ("key", "answer"),
    [
        ("format.foo", "x"),
        ("format.skip", "abc"),
        ("format.decimal", "x"),
        ("format.missing", "a"),
        ("format.encoding", "zip"),
        ("format.encoding", "nothing"),
        ("values.bar_radius", "{a=1}"),
    ],
)
def test_answers_of_another_kind_are_refused_as_answers(tmp_path, key: str, answer: str) -> None:
    with raises("map.answer") as caught:
        propose([file_of(tmp_path, SPINDLE)]).answered({key: answer})
    assert str(caught.value).startswith(key)


def test_lists_of_answers_about_the_format_are_read(tmp_path) -> None:
    file = file_of(tmp_path, SPINDLE.replace("1002", "-9999", 1))
    proposal = propose([file]).answered({"format.missing": '["-9999"]', "format.skip": "1"})
    write_map(accepted(proposal, BEAMS), tmp_path / "map.toml")
    assert import_files([file], tmp_path / "map.toml")["distance"].isnull().any("time").sum() == 1


def test_answers_do_not_recognise_the_columns_again(tmp_path, monkeypatch) -> None:
    proposal = propose([file_of(tmp_path, SENSORS)])
    monkeypatch.setattr("errormotion.datasets.maps.proposal.fit", None)
    first = proposal.answered({"columns.distance.X1": "Sensor 3"})
    second = proposal.answered({"machine": "M7"})
    assert first.map["columns"]["distance"]["X1"] == "Sensor 3"
    assert second.map["columns"]["distance"]["X1"] == "Sensor 1"


def test_the_words_of_a_method_are_those_of_its_schema() -> None:
    from errormotion.datasets.maps.words import likeness

    assert likeness("Tracker", "station") == likeness("Kugel", "ball") == 0.0
    assert likeness("n", "spindle_speed") == 1.0  # a speed
    assert likeness("Tracker", "station", ("tracker",)) == 3.0
    assert likeness("Drehzahl Spindel", "spindle_speed", ("drehzahl",)) == 2.5


def test_a_table_of_too_many_columns_is_refused(tmp_path) -> None:
    wide = "\n".join(";".join(f"{text}{k}" for k in range(1001)) for text in ("T", "", "1"))
    with raises("file.too_large"):
        propose([file_of(tmp_path, wide)])


@pytest.mark.parametrize("ways", [(1, 1), (1, -1), (-1, -1)])
def test_the_direction_of_numbered_runs_is_that_of_their_positions(tmp_path, ways: tuple[int, ...]) -> None:
    """A column with the axis in each row, whose Z is no direction, is beside that of the runs."""
    head = "Lauf;Achse;Sollposition [mm];Abweichung [µm]\n"
    rows = "".join(f"{run};Z;{p};{run},5\n" for run, way in enumerate(ways) for p in (0, 100, 200)[::way])
    file = file_of(tmp_path, head + rows)
    write_map(accepted(propose([file]), {"attributes.axis": "Z", "columns.deviation": "EZZ"}), tmp_path / "map.toml")
    raw = import_files([file], tmp_path / "map.toml")
    there = raw["deviation"].notnull().any(("target", "freedom"))
    counts = {str(way): int(there.sel(approach=way).sum()) for way in raw["approach"].values}
    assert counts.get("forward", 0) == ways.count(1)
    assert counts.get("backward", 0) == ways.count(-1)


def test_runs_that_are_sorted_by_target_state_no_direction(tmp_path) -> None:
    head = "Lauf;Sollposition [mm];Abweichung [µm]\n"
    rows = "".join(f"{run};{p};{run},5\n" for p in (0, 100, 200) for run in (1, 2))
    assert "sequence" not in propose([file_of(tmp_path, head + rows)]).map
