"""Heads, ends and encodings of programs of industrial controls."""

import os
import re
from pathlib import Path

import pytest
from nc_paths import ORIGINS, field, moves_of, zero

from errormotion.compensation.program.compensating import Outcome, ProgramSettings, compensate
from errormotion.compensation.program.interpreter import canonical
from errormotion.compensation.program.interpreter.agreement import check
from errormotion.compensation.program.reading.reader import Reader
from errormotion.errors import ProgramError

needs_linuxcnc = pytest.mark.skipif(
    canonical.interpreter() is None and not os.environ.get("CI"), reason="LinuxCNC (rs274) is not installed"
)
shift = field(lambda p: p * 0 + 10e-6)
HEAD = ["G21 G90 G17 G54", "G0 X0 Y0 Z0"]


def written(folder: Path, text: str | bytes, **settings: object) -> tuple[Outcome, list[str]]:
    """Return the outcome and the new lines of a program."""
    program, out = folder / "a.ngc", folder / "b.ngc"
    program.write_bytes(text if isinstance(text, bytes) else text.encode())
    outcome = compensate(program, out, shift, ORIGINS, ProgramSettings(**settings), head=["head"])
    return outcome, out.read_text(encoding="utf-8").splitlines()


@pytest.mark.parametrize("title", ["O0001", "O1234 (PART A)", "N1 o7 ; part"])
def test_the_number_of_a_program_is_its_first_block(title: str, tmp_path: Path) -> None:
    _, new = written(tmp_path, "\n".join(["%", title, *HEAD, "G1 X5 F100", "M30", "%"]), route="plain")
    assert new[:3] == ["%", title, "(head)"]
    assert moves_of(new)[-1].end == pytest.approx((5.01, 0.01, 0.01))
    with pytest.raises(ProgramError, match=r"line 4 .*the word O"):
        written(tmp_path, "\n".join(["%", *HEAD, title, "M30"]), route="plain")


def test_g28_by_an_increment_may_be_the_first_block(tmp_path: Path) -> None:
    head = ["O0001", "N1 G21", "N2 G91 G28 X0 Y0 Z0", "N3 G90 G54 G0 X0 Y0", "N4 G0 Z5", "N5 G1 X5 F100", "M30"]
    outcome, new = written(tmp_path, "\n".join(head), route="plain")
    assert outcome.summary.cuts == 1
    assert new[3] == head[2]


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be-mark"])
def test_a_byte_order_mark_is_no_part_of_the_program(encoding: str, end: str, tmp_path: Path) -> None:
    text = end.join(["%", "(Maß: 5 mm)", *HEAD, "G1 X5 F100", "M30", "%", ""])
    data = b"\xfe\xff" + text.encode("utf-16-be") if "mark" in encoding else text.encode(encoding)
    _, new = written(tmp_path, data)
    assert new[0] == "%"
    assert "(Maß: 5 mm)" in new
    assert any(line.startswith("G1 X5.0100") for line in new)
    data = (tmp_path / "b.ngc").read_bytes()
    assert end.encode() in data
    assert data.startswith(b"%")


@pytest.mark.parametrize(
    ("tail", "after"),
    [
        (["M2", "G1 X20", "", "(note)", "%"], (2, 5)),
        (["M30", "%", ""], (0, 0)),
        (["%", "G1 X60", "M30", "%"], (2, 5)),
    ],
)
@pytest.mark.parametrize("route", ["plain", pytest.param("interpreter", marks=needs_linuxcnc)])
def test_lines_after_the_end_are_counted_as_not_corrected(
    tail: list[str], after: tuple[int, int], route: str, tmp_path: Path
) -> None:
    outcome, _ = written(tmp_path, "\n".join(["%", *HEAD, *tail]), route=route)
    assert outcome.summary.after_end == after


@needs_linuxcnc
def test_subroutines_of_one_file_are_expanded(tmp_path: Path) -> None:
    lines = ["%", "O0001", *HEAD, "F100", "M98 P1000 L2", "M30", "O1000", "G91 G1 X5.", "G1 Y5.", "G90", "M99", "%"]
    outcome, new = written(tmp_path, "\n".join(lines), check=True)
    assert outcome.route == "interpreter"
    assert outcome.summary.after_end == (0, 0)
    assert moves_of(new)[-1].end == pytest.approx((10.01, 10.01, 0.01), abs=1e-4)


@needs_linuxcnc
def test_a_motion_without_a_position_is_no_difference() -> None:
    lines = ["G21 G90 G54", "G0", "X10. Y0. Z0.", "G1 F100", "X20.", "G0", "Y5", "M2"]
    assert check(lines, ORIGINS, Reader(ORIGINS)) == 3


@pytest.mark.parametrize("line", ["G1 X 5 0. Y 1 0", "BEGIN PGM A MM", "L X+5 R0 FMAX", "G1 X5 ? Y3", "G1 X=5"])
def test_a_message_quotes_text_of_the_program(line: str, tmp_path: Path) -> None:
    with pytest.raises(ProgramError) as error:
        list(Reader(ORIGINS).items([*HEAD, line]))
    quoted = re.findall(r"'([^']*)'", str(error.value))
    assert len(quoted) == 2
    assert all(text in line for text in quoted)


@needs_linuxcnc
@pytest.mark.parametrize(
    ("lines", "number"),
    [
        (["#1=2 F100", "g1 x[#1] (ok)", "g53 g0 z0 (up)", "o1 if [1]", "g1 x[#2]", "o1 endif"], 7),
        (["#1=2 F100", "G38.2 Z-1", "g1 z[#1]"], 5),
    ],
)
def test_a_message_on_an_expanded_program_has_the_line_of_the_program(
    lines: list[str], number: int, tmp_path: Path
) -> None:
    program = tmp_path / "a.ngc"
    program.write_text("\n".join([*HEAD, *lines, "M2"]))
    with pytest.raises(ProgramError) as error:
        compensate(program, tmp_path / "b.ngc", zero, ORIGINS, ProgramSettings(route="interpreter"))
    assert str(error.value).startswith(f"line {number} '{[*HEAD, *lines][number - 1]}': ")


@needs_linuxcnc
def test_the_lines_of_an_expanded_program_are_those_of_the_program(tmp_path: Path) -> None:
    bent = field(lambda p: p * 1e-3)
    program = tmp_path / "a.ngc"
    program.write_text("\n".join([*HEAD, "F100", "#1=2", "G1 X[#1]", "", "G1 X[50*#1] (longest)", "G1 X0", "M2"]))
    found = compensate(program, tmp_path / "b.ngc", bent, ORIGINS, ProgramSettings(route="interpreter"))
    assert found.summary.largest_line == 7
