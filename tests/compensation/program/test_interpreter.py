"""LinuxCNC's interpreter: its moves are those of the plain reader, and it expands unsupported programs."""

import os
from contextlib import closing
from pathlib import Path
from random import Random

import numpy as np
import pytest
from coded import raises
from hypothesis import given, settings
from hypothesis import strategies as st
from nc_paths import ORIGINS, field, moves_of, rewritten, zero
from nc_programs import Programs

from errormotion.compensation.program.compensating import ProgramSettings, compensate
from errormotion.compensation.program.interpreter import canonical
from errormotion.compensation.program.interpreter.agreement import check
from errormotion.compensation.program.interpreter.expanding import Expansion
from errormotion.compensation.program.reading.items import LINE
from errormotion.compensation.program.reading.offsets import Offsets
from errormotion.compensation.program.reading.reader import Reader
from errormotion.errors import ProgramError

pytestmark = pytest.mark.skipif(
    canonical.interpreter() is None and not os.environ.get("CI"), reason="LinuxCNC (rs274) is not installed"
)

HEAD = ["G21 G90 G17 G54", "G0 X0 Y0 Z0", "F100"]
bent = field(lambda p: 20e-6 * np.sin(p[:, [1, 2, 0]] / 0.04))


def expanded(lines: list[str], offsets: Offsets = ORIGINS) -> list[str]:
    """Return the plain program of lines expanded by LinuxCNC's interpreter."""
    with closing(canonical.commands(lines, offsets)) as commands:
        return list(Expansion(lines, offsets, 1e-6).lines(commands))


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**40))
def test_the_reader_and_linuxcnc_move_along_one_path(seed: int) -> None:
    lines = Programs(Random(seed)).lines(40)
    assert check(lines, ORIGINS, Reader(ORIGINS)) == len(moves_of(lines))


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**40))
def test_linuxcnc_reads_the_new_program_as_planned(seed: int) -> None:
    new = rewritten(Programs(Random(seed)).lines(25), bent)
    assert check(new, ORIGINS, Reader(ORIGINS)) == len(moves_of(new))


def test_a_difference_is_found() -> None:
    class Wrong(Reader):
        def items(self, source):
            return super().items(line.replace("X10", "X10.001") for line in source)

    with pytest.raises(ProgramError, match=r"line 4 .*LinuxCNC's interpreter: STRAIGHT_FEED"):
        check([*HEAD, "G1 X10", "M2"], ORIGINS, Wrong(ORIGINS))


def test_subroutines_loops_and_variables_are_expanded() -> None:
    sub = ["o100 sub", "N60 G1 X#1 Y[2 * #2] (of the sub)", "G91 G2 X2 Y0 I1 J0 P2", "G90", "o100 endsub"]
    lines = ["%", *HEAD, *sub, "o110 repeat [2]", "o100 call [10] [5]", "o110 endrepeat", "N99 M30", "%"]
    new = expanded(lines)
    assert new[-2:] == ["N99 M30", "%"]
    assert sum("(of the sub)" in line for line in new) == 2
    ends = [move.end for move in moves_of(new)]
    assert np.allclose(ends, [(0, 0, 0)] + [(10, 10, 0), (12, 10, 0)] * 2)


def test_canned_cycles_are_expanded() -> None:
    lines = [*HEAD, "G98 G81 X5 Y5 Z-2 R1", "X8", "G80", "M2"]
    cuts = [move.end for move in moves_of(expanded(lines)) if move.kind == LINE]
    assert np.allclose(cuts, [(5, 5, -2), (8, 5, -2)])


def test_the_plain_code_of_a_program_moves_as_the_program() -> None:
    for seed in range(6):
        lines = Programs(Random(seed), plain=True, inches=False).lines(25)
        new = expanded(lines)
        old = moves_of(lines)
        assert check(new, ORIGINS, Reader(ORIGINS)) >= len([m for m in old if m.start != m.end])
        assert np.allclose(moves_of(new)[-1].end, old[-1].end, atol=1e-4)


def test_codes_with_zeros_and_spaces_are_those_without() -> None:
    plain = ["G21 G90", "T2 M6", "G43 H2", "G55", "G0 X0 Y0 Z0", "G92 X5 Y6", "F60 G1 X[6+1]", "G92.1", "G0 X1", "M2"]
    other = ["G21 G90", "T2 M6", "G 043 H 2", "G55", "G0 X0 Y0 Z0", "G 9 2 X5 Y6", "F60 G1 X[6+1]", "G 92. 1"]
    assert expanded([*other, "G0 X1", "M 02"]) == expanded(plain)


def test_offsets_tools_and_switches_are_kept() -> None:
    lines = [
        *("G21 G90", "T2 M6", "G43 H2", "G55", "S900 M3", "G0 X0 Y0 Z0", "G92 X5 Y6", "F60 G1 X[6+1]", "M62 P1"),
        *("G92.1", "G10 L2 P3 X1 Y2 Z3 R30", "G56", "G0 X0 Y0 Z0", "G1 X1", "M5", "G64 P0.01 Q0.02", "G4 P1.5", "M2"),
    ]
    new = expanded(lines)
    text = "\n".join(new)
    for word in ("T2\nM6", "G43 H2", "G55", "S900\nM3", "G92 X5.0000 Y6.0000", "M62 P1", "G92.1", "R30", "M5"):
        assert word in text
    for word in ("G64 P0.01 Q0.02", "G4 P1.5"):
        assert word in text
    plain = [line.replace("[6+1]", "7") for line in lines]
    ends = [[m.frame.machine(m.end) for m in moves_of(each)] for each in (plain, new)]
    assert np.allclose(ends[0], ends[1], atol=2e-7)


@pytest.mark.parametrize(
    ("lines", "why"),
    [
        (["G1 X[1/0]"], r"line 4.*divide by zero"),
        (["o1 while [1]", "G1 X1", "o1 endwhile"], "endless loop"),
        (["#1=1", "G33 Z-1 K1"], r"line 5.*G33"),
        (["#1=1", "G20", "G1 X1"], r"line 5.*inches"),
        (["#1=1", "G1 A5"], r"line 5.*another axis"),
        (["#1=1", "M66 P0 L0"], r"line 5.*M66"),
        (["#1=1", "M73"], r"line 5.*M73"),
        (["#1=1 G28.1"], r"line 4.*G28.1"),
        (["#1=1 M[3 + 1]"], r"line 4.*computed code"),
        (["G10 L1 P1 Z3"], r"line 4.*expected G10 L2"),
        (["#5221=3"], r"line 4.*parameter of the control"),
        (["G38.2 Z-1", "#1=#5063"], r"line 5.*running machine"),
        (["#1=[#<_hal[pin]>]"], r"line 4.*running machine"),
        (["#1=#[60 * 3]", "G38.2 Z-1"], r"line 4.*computed number"),
        (["(print, #1)"], r"line 4.*prints"),
        (["G52 X1"], r"line 4.*G52"),
        (["M199"], r"(?s)line 4.*M199"),
        (["o1 call"], "seeking o-word"),
        (["G1 X1 ; " + "x" * 300], r"line 4.*250 characters"),
    ],
)
def test_a_program_that_neither_reader_supports_is_an_error(
    lines: list[str], why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(canonical, "MAX_COMMANDS", 2000)
    program, out = tmp_path / "a.ngc", tmp_path / "b.ngc"
    program.write_text("\n".join([*HEAD, *lines, "M2"]) + "\n")
    with pytest.raises(ProgramError, match=why):
        compensate(program, out, zero, ORIGINS, ProgramSettings(route="interpreter"))
    assert [path.name for path in tmp_path.iterdir()] == ["a.ngc"]


def test_the_tools_of_a_running_control_are_not_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))  # LinuxCNC keeps the tools of a running machine in a file there
    expanded([*HEAD, "T1 M6", "G43", "M2"])
    assert list(tmp_path.iterdir()) == []


def test_a_loop_that_prints_nothing_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(canonical, "TIME_LIMIT", 0.5)
    with raises("program.interpreter.endless"):
        expanded([*HEAD, "o1 while [1]", "#1=2", "o1 endwhile", "M2"])


@pytest.mark.parametrize(
    "lines",
    [
        ["G91", "G1 X#2"],
        ["G38.2 Z-5", "G91 G1 Z#1"],
        ["G38.2 Z-5", "G10 L20 P1 Z0", "G1 Z#1"],
        ["G0 X0 Y0", "G98 G81 X5 Y5 Z-2 R1", "G80"],
        ["G38.2 Z-5", "G81 X5 Y5 Z-2 R1", "G80"],
        ["G0 Z5", "G41.1 D4 G0 X30 Y30", "X60", "G40 G0 X80 Y30"],
        ["G38.2 X5", "G41.1 D4 G0 X30 Y30", "X60", "G40 G0 X80 Y30"],
    ],
)
def test_an_expansion_invents_no_position(lines: list[str], tmp_path: Path) -> None:
    head = HEAD if "G38" in lines[0] else ["G21 G54 F100"]
    with pytest.raises(ProgramError, match="unknown"):
        expanded([*head, "#1=1 #2=2", *lines, "M2"])


def test_the_first_moves_name_only_the_axes_of_the_program() -> None:
    assert [line for line in expanded(["G21 G54", "#1=7", "G0 Z#1", "G0 X0 Y0", "M2"]) if "G0" in line] == [
        "G0 Z7.0000",
        "G0 X0.0000 Y0.0000",
    ]


def test_the_route_is_selected_and_reported(tmp_path: Path) -> None:
    program, out = tmp_path / "a.ngc", tmp_path / "b.ngc"
    program.write_bytes("\r\n".join(["%", *HEAD, "#1=50", "G1 X#1 Y30", "M2", "%", ""]).encode())
    found = compensate(program, out, bent, ORIGINS, ProgramSettings(check=True), head=["machine (test) ü"])
    assert found.route == "interpreter"
    assert "line 5" in found.why
    assert found.checked == found.summary.written - len([x for x in out.read_text().splitlines() if "X" not in x]) + 1
    text = out.read_bytes()
    assert text.startswith(b"%\r\n(machine [test] ?)\r\nG21")
