"""The check of a new program: the interpreter reads the original with the files of the machine as they are."""

import os
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np
import pytest
from coded import raises
from nc_controls import Reading, control
from nc_paths import ORIGINS, field, rewritten
from nc_programs import Programs

from errormotion.compensation.program.compensating import ProgramSettings, compensate
from errormotion.compensation.program.interpreter import canonical, paths
from errormotion.compensation.program.interpreter.agreement import check
from errormotion.compensation.program.interpreter.expanding import Expansion
from errormotion.compensation.program.reading.offsets import Offsets, read_parameters
from errormotion.compensation.program.reading.reader import Reader
from errormotion.compensation.program.reading.tools import Cutter, read_table
from errormotion.errors import ProgramError

pytestmark = pytest.mark.skipif(
    canonical.interpreter() is None and not os.environ.get("CI"), reason="LinuxCNC (rs274) is not installed"
)
bent = field(lambda p: 20e-6 * np.sin(p[:, [1, 2, 0]] / 0.04))
LARGEST = 20e-6 * 3**0.5 + 1e-6
HEAD = ["G21 G90 G17 G54 G40 G49 G94", "T2 M6", "G43 H2", "G0 X0 Y0 Z0", "F100"]
COMPENSATED = ["G41 D2 G1 X-20 Y-20", "G1 Y20", "G40 G1 X-60 Y30"]
READING = [
    "G1 X#150",
    "G1 Y[#5410 + #5403 / 100]",
    "o1 if [#<_task>]",
    "G2 X0 R[#150]",
    "o1 endif",
    "G73 Z-3 R2 Q1",
    "G80",
]


def machine(folder: Path, unit: str) -> Offsets:
    """Return the control of files."""
    values = {150: 12.5, 5210: 0, 5220: 1} | {5221 + 20 * k + j: 0 for k in range(9) for j in range(10)} | {5223: 40}
    (folder / "a.var").write_text("".join(f"{key} {value}\n" for key, value in sorted(values.items())))
    (folder / "a.tbl").write_text("T2 P1 Z50 D4\nT2 P2 Z1 D1\n")
    return read_parameters(folder / "a.var", unit).with_tools(read_table(folder / "a.tbl", unit))


@pytest.mark.parametrize("unit", ["mm", "inch"])
@pytest.mark.parametrize("lines", [COMPENSATED, READING])
def test_the_new_program_cuts_as_the_original_on_its_machine(lines: list[str], unit: str, tmp_path: Path) -> None:
    program = tmp_path / "a.ngc"
    head = HEAD if unit == "mm" or lines is COMPENSATED else [HEAD[0].replace("G21", "G20"), *HEAD[1:]]
    program.write_text("\n".join([*head, *lines, "M2"]))
    settings = ProgramSettings(check=True, tolerance=5e-6)
    lengths = machine(tmp_path, unit)
    if unit == "inch" and lines is COMPENSATED:
        lengths = replace(lengths, cutters={2: Cutter(4e-3)}, table="")
    assert compensate(program, tmp_path / "b.ngc", bent, lengths, settings).checked > 3


@pytest.mark.parametrize("fault", ["radius", "length", "parameter", "branch"])
def test_a_wrong_state_of_the_control_in_the_expansion_is_found(
    fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    offsets = machine(tmp_path, "mm")
    wrong = {
        "radius": replace(offsets, cutters={}),
        "length": replace(offsets, tools={2: np.array([0.0, 0.0, 0.04])}),
        "parameter": replace(offsets, parameters=offsets.parameters | {150: 12.6}),
        "branch": offsets,
    }[fault]
    commands = canonical.commands

    def mistaken(source: list[str], offsets: Offsets, *, deleted: bool | None = None, own: bool = False) -> object:
        if own:
            return commands(source, offsets, deleted=deleted, own=own)
        source = [line.replace("[#<_task>]", "[0]") for line in source] if fault == "branch" else source
        return commands(source, wrong, deleted=deleted)

    monkeypatch.setattr(canonical, "commands", mistaken)
    program = tmp_path / "a.ngc"
    program.write_text("\n".join([*HEAD, *COMPENSATED, *READING, "M2"]))
    with pytest.raises(ProgramError, match=r"check of the new program: .*the original cuts to .*as LinuxCNC reads it"):
        compensate(program, tmp_path / "b.ngc", bent, offsets, ProgramSettings(check=True))
    assert not (tmp_path / "b.ngc").exists()


@pytest.mark.parametrize("unit", ["mm", "inch"])
@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_random_programs_pass_the_comparison(seed: int, unit: str) -> None:
    lines = Programs(Random(seed), inches=seed % 2 == 0).lines(30)
    new = rewritten(lines, bent)
    assert paths.compare(lines, new, replace(ORIGINS, unit=unit), LARGEST) > 0


@pytest.mark.parametrize(
    "change",
    [
        ("G1 X10", "G1 X10.2"),
        ("G1 Z5\nX20", "G1 X20"),
        ("G3 X10 Y10 J-5", "G2 X10 Y10 J-5"),
        ("G3 X10 Y10 J-5", "G1 X10 Y10"),
        ("G1 Z5", "G1 Z5\nG1 X3 Y3"),
        ("G2 X10 Y20 I3 P2", "G2 X10 Y20 J3 P2"),
        ("G2 X10 Y20 I3 P2", "G1 X12"),
    ],
)
def test_a_changed_cut_is_found(change: tuple[str, str]) -> None:
    lines = [*HEAD, "G1 X10", "G1 Y20", "G3 X10 Y10 J-5", "G1 Y20", "G2 X10 Y20 I3 P2", "G1 Z5", "X20", "M2"]
    text = "\n".join(lines)
    assert paths.compare(lines, lines, ORIGINS, 1e-6) == 7
    with raises("program.cut.differs"):
        paths.compare(lines, text.replace(*change).split("\n"), ORIGINS, 1e-6)


@pytest.mark.parametrize("other_unit", [False, True])
@pytest.mark.parametrize("seed", [1, 5, 14])
def test_random_programs_that_read_their_control_are_expanded_as_it_reads_them(
    seed: int, other_unit: bool, tmp_path: Path
) -> None:
    random = Random(seed)
    offsets = control(random, tmp_path)
    unit = ("inch" if offsets.unit == "mm" else "mm") if other_unit else offsets.unit
    lines = Reading(random, unit).lines(25)
    digit = {"mm": 1e-7, "inch": 4e-6}[unit]
    with closing(canonical.commands(lines, offsets)) as commands:
        new = [str(text) for text in Expansion(lines, offsets, 1e-5).lines(commands)]
    assert check(new, offsets, Reader(offsets)) > 20
    assert paths.compare(lines, new, offsets, digit) > 20


def test_a_flag_of_the_parameter_file_is_read_as_it_is(tmp_path: Path) -> None:
    offsets = machine(tmp_path, "mm")
    offsets = replace(offsets, parameters=offsets.parameters | {5210: 1.0}, g92=np.zeros(3), stored=np.zeros(3))
    lines = [*HEAD, "G1 X[#5210 + 4]", "M2"]
    with closing(canonical.commands(lines, offsets)) as commands:
        assert "G1 X5.0000" in list(Expansion(lines, offsets, 1e-5).lines(commands))
