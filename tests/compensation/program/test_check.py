"""The check of a new program: the interpreter reads the original with the files of the machine as they are."""

import os
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np
import pytest
from nc_paths import ORIGINS, field, rewritten
from nc_programs import Programs

from errormotion.compensation.program.compensating import Settings, compensate
from errormotion.compensation.program.interpreter import canonical, paths
from errormotion.compensation.program.reading.offsets import Offsets, read_parameters
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
    settings = Settings(check=True, tolerance=5e-6)
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
        compensate(program, tmp_path / "b.ngc", bent, offsets, Settings(check=True))
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
    with pytest.raises(ProgramError, match="the new program"):
        paths.compare(lines, text.replace(*change).split("\n"), ORIGINS, 1e-6)
