"""Lines that the plain reader supports, and errors with the number of the line."""

import math
from pathlib import Path

import numpy as np
import pytest
from nc_paths import ORIGINS, moves_of

from errormotion.compensation.program.reading.items import Text, Unchanged
from errormotion.compensation.program.reading.offsets import Offsets, read_parameters, read_tools
from errormotion.compensation.program.reading.reader import Reader
from errormotion.errors import ProgramError
from errormotion.instruments.nc_words import MAX_LINE

HEAD = ["G21 G90 G17", "G0 X0 Y0 Z0"]


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("G1 X#1", "expression, a variable"),
        ("G1 X[1+2]", "expression, a variable"),
        ("o100 call", "control word"),
        ("G81 X1 Y1 Z-1 R1", "canned cycle"),
        ("G41 D1", "cutter compensation"),
        ("G33 Z-1 K1", "G33 is not supported"),
        ("G1 A10", "the word A"),
        ("M101", "M101 is not supported"),
        ("G1 X1 (never closed", "expected words"),
        ("G1 X1 X2", "is repeated"),
        ("G0 G1 X1", "two motions"),
        ("G1.5 X1", "not supported"),
        ("G2 X10 Y0 I4", "radii at start and end differ"),
        ("G2 X10 R4", "too small"),
        ("G2 X10", "without a centre"),
        ("G43 H9", "length of tool 9 is unknown"),
        ("/G1 X1", "block delete"),
        ("G53 G1 X1", "G53"),
        ("G93 G1 X1", "G93 without F"),
        ("T1 M6 Q3.5.5", "expected words"),
        ("G1 X1 G92 Y1", "two|uses its axis words"),
        ("X1", "without a motion"),
        ("G28.1", "stores a position"),
        ("G2 I5 P2 M62 P1", "is repeated"),
        ("G2 I5 M62 P1", "share a word"),
        ("G2 X10 R5 M19", "share a word"),
        ("G1 X1" + " " * MAX_LINE, "at most"),
        ("G1 X1\x00", "control characters"),
    ],
)
def test_an_unsupported_line_is_reported_with_its_number(line: str, why: str) -> None:
    head = HEAD if line != "X1" else [*HEAD, "G80"]
    with pytest.raises(ProgramError, match=f"(?s)line {len(head) + 1}.*({why})"):
        list(Reader(ORIGINS).items([*head, line]))


@pytest.mark.parametrize(
    "lines",
    [
        ["G1 X1 F100"],
        ["G0 X0 Y0", "G1 X1 F100"],
        ["G91", "G0 X1 Y1 Z1", "G1 X1 F100"],
        [*HEAD, "G38.2 Z-5 F10", "G1 X1"],
        [*HEAD, "G38.2 Z-5 F10", "G92 Z0", "G0 Z1", "G1 X1"],
    ],
)
def test_a_cut_with_an_unknown_position_is_an_error(lines: list[str]) -> None:
    with pytest.raises(ProgramError, match=f"line {len(lines)} .*unknown position"):
        list(Reader(ORIGINS).items(lines))


def test_a_cut_with_an_unknown_work_offset_is_an_error() -> None:
    with pytest.raises(ProgramError, match=r"line 3 .*origin of G55.*--offset G55=X,Y,Z"):
        list(
            Reader(Offsets().with_system("G54", (0, 0, 0))).items(
                [*[*HEAD, "G55", "G0 X0", "G1 X1 F1"][:2], "G55 G1 X1 F1"]
            )
        )


def test_positions_of_the_machine_follow_from_all_offsets() -> None:
    lines = ["G20 G55", "G10 L2 P2 X1 R90", "G43 H2", "G0 X0 Y0 Z0", "G92 X1", "G1 X2 Y0.5 F10"]
    (_, move) = moves_of(lines)
    # G92: 0 becomes 1; X2 is one inch from there, turned to +Y; Y0.5 to -X. Origin (1 in, 4 mm, 5 mm);
    # tool (0, 2, 100) mm.
    expected = np.array([25.4 - 12.7, 4 + 25.4 + 2, 5 + 100]) * 1e-3
    assert np.allclose(move.frame.machine(move.end), expected, atol=1e-12)


def test_arcs_of_all_planes_have_the_correct_sense() -> None:
    lines = [*HEAD, "F1", "G17 G3 X10 Y10 J10", "G18 G2 X20 Z10 K10", "G19 G3 Y20 Z20 K10 P2"]
    sweeps = [move.sweep for move in moves_of(lines)[1:]]
    assert np.allclose(sweeps, [math.pi / 2, -math.pi / 2, math.pi / 2 + 2 * math.pi])


def test_text_after_the_end_is_kept_and_not_read() -> None:
    items = list(Reader(ORIGINS).items(["%", *HEAD, "M2", "G1 X[nonsense", "%", "anything"]))
    assert [type(item) for item in items[-3:]] == [Text, Text, Text]


def test_skipped_blocks_do_nothing() -> None:
    lines = [*HEAD, "/G0 X5", "G1 Y1 F1"]
    assert moves_of(lines[:2] + lines[3:])[-1].end == (0, 1, 0)
    skipped = list(Reader(ORIGINS, deleted=True).items(lines))
    run = list(Reader(ORIGINS, deleted=False).items(lines))
    assert isinstance(skipped[2], Text)
    assert skipped[-1].end == (0, 1, 0)
    assert run[-1].end == (5, 1, 0)


def test_moves_in_machine_coordinates_are_unchanged() -> None:
    items = list(Reader(ORIGINS).items([*HEAD, "G53 G0 Z0", "G28 X0", "G1 X1 F1"]))
    assert [item.kind for item in items if isinstance(item, Unchanged)] == ["machine", "machine"]
    end = items[-1].frame.machine(items[-1].start)
    assert np.allclose(end, [0.0, 0.001, 0.0])  # home of G28 in X; Y of the program's start; Z of G53


def test_parameters_and_tools_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.var").write_text(
        "5161\t1.0\n5220\t2\n5241\t10.5\n5242\t-1\n5243\t0\n5250\t30\n5210\t1\n5211\t2\n5212\t0\n5213\t0\n"
    )
    found = read_parameters(tmp_path / "a.var")
    assert found.system == 1
    assert found.rotations[1] == 30
    assert np.allclose(found.systems[1], [0.0105, -0.001, 0])
    assert np.isnan(found.systems[0]).all()
    assert np.allclose(found.g92, [0.002, 0, 0])
    assert found.homes[0, 0] == 0.001
    (tmp_path / "a.tbl").write_text("T1 P1 D0.125 Z+3.0 ;mill\n\nT7 P2 X1 Y-1 Z2.5\n")
    assert np.allclose(read_tools(tmp_path / "a.tbl", "inch")[7], np.array([1, -1, 2.5]) * 25.4e-3)


@pytest.mark.parametrize("text", ["5221 nan\n", "5221\n", "abc 1\n", "5220 12\n", "\xff\n"])
def test_an_invalid_parameter_file_is_an_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.var").write_text(text, encoding="latin-1")
    with pytest.raises(ProgramError, match=r"a\.var"):
        read_parameters(tmp_path / "a.var")


@pytest.mark.parametrize("text", ["P1 Z3\n", "T1 Zabc\n", "T1 Z1e999\n", "%PDF\n"])
def test_an_invalid_tool_table_is_an_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.tbl").write_text(text)
    with pytest.raises(ProgramError, match=r"a\.tbl, line 1"):
        read_tools(tmp_path / "a.tbl")
