"""The state of the control that a program reads: as the inputs state it, in units of the machine, or refused."""

import os
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from coded import raises
from nc_paths import moves_of, zero

from errormotion.compensation.program.compensating import ProgramSettings, compensate
from errormotion.compensation.program.interpreter import canonical
from errormotion.compensation.program.interpreter.expanding import Expansion
from errormotion.compensation.program.reading.items import LINE
from errormotion.compensation.program.reading.offsets import Offsets, read_parameters
from errormotion.compensation.program.reading.reader import Reader
from errormotion.compensation.program.reading.tools import read_table
from errormotion.errors import ProgramError

needs_linuxcnc = pytest.mark.skipif(
    canonical.interpreter() is None and not os.environ.get("CI"), reason="LinuxCNC (rs274) is not installed"
)
HEAD = ["G21 G90 G17 G54 G40 G49 G94", "T2 M6", "G43 H2", "G0 X0 Y0 Z0", "F100"]
ZEROS = "".join(f"{5221 + 20 * k + j} 0\n" for k in range(9) for j in range(10))
STATED = f"150 12.5\n5161 3\n5162 4\n5163 5\n5210 0\n5211 7\n5212 8\n5213 9\n5220 1\n{ZEROS}".replace(
    "5223 0", "5223 100"
)


def control(
    folder: Path, unit: str = "mm", parameters: str = STATED, tools: str = "T2 P1 X1 Z100 D10 I5 J15 Q3\n"
) -> Offsets:
    """Return the control of a parameter file and a tool table."""
    (folder / "a.var").write_text(parameters)
    (folder / "a.tbl").write_text(tools)
    return read_parameters(folder / "a.var", unit).with_tools(read_table(folder / "a.tbl", unit))


def stated(folder: Path) -> Offsets:
    """Return a control of which only the origin of G54 and the tools are stated."""
    control(folder)
    return Offsets().with_system("G54", (0.0, 0.0, 0.1)).with_tools(read_table(folder / "a.tbl"))


def ends(lines: Sequence[str], offsets: Offsets) -> list[tuple[float, float, float]]:
    """Return the ends of the cuts of a program that LinuxCNC's interpreter expands."""
    with closing(canonical.commands(lines, offsets)) as commands:
        new = list(Expansion(lines, offsets, 1e-6).lines(commands))
    return [move.end for move in Reader(offsets).items(new) if getattr(move, "kind", -1) == LINE]


@needs_linuxcnc
@pytest.mark.parametrize("unit", ["mm", "inch"])
@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("#150", 12.5),
        ("#5161", 3.0),
        ("#5211 + 1", 8.0),
        ("#5223", 100.0),
        ("# 52 23", 100.0),
        ("#5403 - #5401", 99.0),
        ("#5410", 10.0),
        ("#5411 + #5412", 20.0),
        ("#5413", 3.0),
        ("#5400 + #<_current_tool>", 4.0),
        ("#<_task>", 1.0),
        ("#[100 + 50]", 12.5),
        ("#5220", 1.0),
        ("#<_metric>", 1.0),
    ],
)
def test_a_parameter_has_the_value_of_the_inputs_in_units_of_the_machine(
    expression: str, value: float, unit: str, tmp_path: Path
) -> None:
    (found,) = ends([*HEAD, f"G1 X[{expression}]", "M2"], control(tmp_path, unit))
    assert found[0] == pytest.approx(value, abs=1e-3)


@needs_linuxcnc
def test_the_branch_of_the_machine_is_expanded_not_that_of_a_preview(tmp_path: Path) -> None:
    lines = ["o1 if [#<_task> EQ 0]", "G1 X50", "o1 else", "G1 X20", "o1 endif"]
    assert ends([*HEAD, *lines, "M2"], control(tmp_path)) == [(20.0, 0.0, 0.0)]


@needs_linuxcnc
@pytest.mark.parametrize(
    ("lines", "name"),
    [
        (["G1 X#150"], "#150"),
        (["o1 if [#150 GT 1]", "G1 X5", "o1 endif"], "#150"),
        (["#31=#150", "G1 X#31"], "#150"),
        (["o1 if [1 EQ 2]", "#32=5", "o1 endif", "G1 X#32"], "#32"),
        (["G1 X#1"], "#1"),
        (["G1 X#[100+50]"], "computed number"),
        (["G1 X##33"], "#33"),
        (["G1 X[#5241 + 5]"], "#5241"),
        (["G1 X[#5161 + 5]"], "#5161"),
        (["G1 X#5211"], "#5211"),
        (["G1 X#5210"], "#5210"),
        (["G1 X#5220"], "#5220"),
        (["G1 X#5230"], "#5230"),
        (["G1 X#5600"], "#5600"),
        (["G1 X#[5000+221]"], "computed number"),
        (["#[5000+221]=3", "G1 X5"], "computed number"),
        (["G1 X#<_ini[traj]max>"], "_ini"),
        (["G1 X#<_line>"], "#<_line>"),
        (["G1 X#<_vmajor>"], "#<_vmajor>"),
        (["G1 X#<_current_pocket>"], "#<_current_pocket>"),
        (["G1 X#<_set_elsewhere>"], "#<_set_elsewhere>"),
        (["G1 X#<_rpm>"], "#<_rpm>"),
        (["o1 if [EXISTS[#<_done>]]", "G1 X5", "o1 endif"], "#<_done>"),
        (["(debug, at #5221)", "G1 X[1+1]"], "#5221"),
        (["G92 X5", "G1 X#5211"], "#5211"),
        (["T0 M6", "G1 X#5400"], "#5400"),
        (["M61 Q2", "G1 X#5400"], "M61"),
        (["T0 M6", "G41 G1 X10", "G1 X20"], "tool in the spindle"),
    ],
)
def test_a_value_that_nothing_states_is_refused_by_name(lines: list[str], name: str, tmp_path: Path) -> None:
    program, out = tmp_path / "a.ngc", tmp_path / "b.ngc"
    program.write_text("\n".join([*HEAD, *lines, "M2", ""]))
    with pytest.raises(ProgramError) as error:
        compensate(program, out, zero, stated(tmp_path), ProgramSettings(route="interpreter"))
    message = str(error.value).split(":", 1)[1]
    assert name.lower() in message.lower()
    assert not out.exists()


@needs_linuxcnc
@pytest.mark.parametrize("line", ["G1 X#5400", "G1 X#5410", "G1 X#<_current_tool>", "G41 G1 X10"])
def test_the_tool_in_the_spindle_is_unknown_before_it_is_changed(line: str, tmp_path: Path) -> None:
    with raises("program.parameter.unknown"):
        ends(["G21 G90 G54 G40 F100", "G0 X0 Y0 Z0", line, "G1 X20", "M2"], stated(tmp_path))


@needs_linuxcnc
def test_what_the_program_sets_before_is_known(tmp_path: Path) -> None:
    lines = [
        *("o<init> sub", "#40=3", "#<_depth>=2", "o<init> endsub"),
        *("o<go> sub", "G1 X[#1+#2] Y#40 Z-#<_depth>", "o<go> endsub"),
        *(*HEAD, "o<init> call", "#50=1", "o1 while [#50 LE 3]", "#[60+#50]=[#50*2]", "#50=[#50+1]", "o1 endwhile"),
        *("o<go> call [4]", "G1 X#[63] Y[#61+#<_absolute>]", "M2"),
    ]
    assert ends(lines, stated(tmp_path)) == [(4.0, 3.0, -2.0), (6.0, 3.0, -2.0)]


@needs_linuxcnc
@pytest.mark.parametrize("unit", ["mm", "inch"])
@pytest.mark.parametrize(
    ("code", "side"), [("G41 D2", -1), ("G42 D2", 1), ("G41", -1), ("G42.1 D10", 1), ("G41 D#7", -1)]
)
def test_cutter_compensation_has_the_radius_of_the_tool_table(code: str, side: int, unit: str, tmp_path: Path) -> None:
    size = 10 if unit == "mm" else 10 / 25.4
    offsets = control(tmp_path, unit, tools=f"T2 P1 Z100 D{size}\nT3 P2 D1\n")
    lines = [*HEAD, "#7=2", "G0 X-40 Y-40 Z0", f"{code} G1 X-20 Y-20", "G1 Y20", "G40 G1 X-60 Y30", "M2"]
    found = ends(lines, offsets)
    assert any(
        end[0] == pytest.approx(-20 + 5 * side, abs=1e-3) and end[1] == pytest.approx(20, abs=1e-3) for end in found
    )


def test_g92_3_restores_the_stored_offset_or_the_cut_is_refused(tmp_path: Path) -> None:
    lines = ["G21 G90 G54", "G92.3", "G0 X0 Y0 Z0", "G1 X1 F100"]
    *_, move = Reader(control(tmp_path)).items(lines)
    assert np.allclose(move.frame.machine(move.end), [8e-3, 8e-3, 109e-3])
    with pytest.raises(ProgramError, match=r"line 4 .*line 2 restores an offset of G92"):
        list(Reader(stated(tmp_path)).items(lines))


@needs_linuxcnc
def test_the_interpreter_restores_the_stored_offset_as_well(tmp_path: Path) -> None:
    lines = [*HEAD[:1], "F100", "G92.3", "G0 X0 Y0 Z0", "#1=1", "G1 X#1", "M2"]
    offsets = control(tmp_path)
    with closing(canonical.commands(lines, offsets)) as commands:
        new = list(Expansion(lines, offsets, 1e-6).lines(commands))
    (move,) = (item for item in Reader(offsets).items(new) if getattr(item, "kind", -1) == LINE)
    assert np.allclose(move.frame.machine(move.end), [8e-3, 8e-3, 109e-3])
    program, out = tmp_path / "a.ngc", tmp_path / "b.ngc"
    program.write_text("\n".join([*lines, ""]))
    with pytest.raises(ProgramError, match=r"restores an offset of G92"):
        compensate(program, out, zero, stated(tmp_path), ProgramSettings(route="interpreter"))
    assert not out.exists()


def test_an_active_offset_of_which_an_axis_is_not_stated_is_unknown(tmp_path: Path) -> None:
    offsets = control(tmp_path, parameters=STATED.replace("5210 0", "5210 1").replace("5212 8\n", ""))
    with raises("program.position.unknown"):
        list(Reader(offsets).items(["G21 G90 G54", "G0 X0 Y0 Z0", "G1 X1 F100"]))


@needs_linuxcnc
@pytest.mark.parametrize("words", ["X0 Y0 Z0", "Z0", ""])
def test_g28_before_any_position_is_expanded(words: str, tmp_path: Path) -> None:
    lines = ["#1=2", f"G91 G28 {words}", "G90 G54 G0 X0 Y0 Z5", "G1 X[#1] F100", "G91 G28 Z0", "M2"]
    with closing(canonical.commands(lines, stated(tmp_path))) as commands:
        new = list(Expansion(lines, stated(tmp_path), 1e-6).lines(commands))
    assert not any("G53" in line for line in new)
    assert "G28" + "".join(f" {word[0]}0.0000" for word in words.split()) in new
    assert moves_of(new)[-1].end == (2.0, 0.0, 5.0)


@needs_linuxcnc
def test_parameters_that_the_control_keeps_and_the_new_program_does_not_set_are_noted(tmp_path: Path) -> None:
    program = tmp_path / "a.ngc"
    program.write_text("\n".join([*HEAD, "#150=3 #32=4", "G1 X[#150+#32]", "M2"]))
    found = compensate(program, tmp_path / "b.ngc", zero, control(tmp_path), ProgramSettings())
    assert found.notes == ("the new program does not set #150, which the parameter file keeps for other programs",)


@needs_linuxcnc
def test_a_long_line_whose_parameters_are_known_is_read(tmp_path: Path) -> None:
    line = f"G1 X#150 ({'x' * 225})"
    assert ends([*HEAD, line, "M2"], control(tmp_path))[0][0] == pytest.approx(12.5)
    with raises("program.parameters.too_many"):
        ends([*HEAD, "G1 X[" + "+".join(f"#{k}" for k in range(40, 60)) + "]", "M2"], control(tmp_path))
