"""Tool tables are read as LinuxCNC reads them."""

import os
import re
import subprocess
from pathlib import Path

import pytest
from nc_paths import ORIGINS

from errormotion.compensation.program.interpreter import canonical
from errormotion.compensation.program.reading.tools import read_table
from errormotion.errors import ProgramError

LENGTH = "N1 G21 G90 F100\nN2 T1 M6\nN3 G1 X#5401 Y#5410 Z#5403\nM2\n"

TABLES = [
    ("T1 P1 Z1 D2\nT1 P2 Z3 D4\n", (0, 2, 1), "not used"),
    ("T1P1Z100\n", (0, 0, 0), "'T1P1Z100' as T1"),
    ("T1\tP1\tZ100 D3\n", (0, 3, 0), "as T1"),
    ("T1 P1\tZ100 D3\n", (0, 3, 0), "as P1"),
    ("T1 P1 Z\t5\n", (0, 0, 5), ""),
    ("T1 P1 Z100mm X-2\n", (-2, 0, 100), "as Z100"),
    ("T1 P1 Z5 Z6\n", (0, 0, 6), ""),
    ("T1 Z5\n", (0, 0, 5), "loses this tool"),
    ("T1 Z5\nT1 P1 Z7\n", (0, 0, 7), "not used"),
    ("T2 Z5\nT1 Z4\n", (0, 0, 4), "replaces line 1"),
    ("; head\n\nt1 p1 z.5;x Z9\n", (0, 0, 0.5), ""),
    ("T1.7 P1 Z5\r\n", (0, 0, 5), "as T1"),
    ("T1 P1 D.5 Z-1e1 X+2.5 I10 J20 Q3", (2.5, 0.5, -10), ""),
]


@pytest.mark.parametrize(("text", "expected", "note"), TABLES)
def test_a_line_has_the_values_that_linuxcnc_reads(
    text: str, expected: tuple[float, float, float], note: str, tmp_path: Path
) -> None:
    (tmp_path / "t.tbl").write_bytes(text.encode())
    table = read_table(tmp_path / "t.tbl")
    offset, cutter = table.offsets[1], table.cutters[1]
    assert [1e3 * offset[0], 1e3 * cutter.diameter, 1e3 * offset[2]] == pytest.approx(list(expected))
    assert (note in " ".join(table.notes)) if note else not table.notes


@pytest.mark.skipif(canonical.interpreter() is None and not os.environ.get("CI"), reason="LinuxCNC is not installed")
@pytest.mark.parametrize(("text", "expected", "note"), TABLES)
def test_linuxcnc_itself_reads_these_values(
    text: str, expected: tuple[float, float, float], note: str, tmp_path: Path
) -> None:
    (tmp_path / "t.tbl").write_bytes(text.encode())
    (tmp_path / "p.ngc").write_text(LENGTH)
    canonical._write_parameters(ORIGINS, tmp_path / "p.var", 1e-3, 0.0)
    done = subprocess.run(
        ["rs274", "-g", "-v", "p.var", "-t", "t.tbl", "p.ngc"],
        cwd=tmp_path,
        env={**os.environ, "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    (found,) = re.findall(r"STRAIGHT_FEED\(([-\d.]+), ([-\d.]+), ([-\d.]+)", done.stdout)
    assert [float(value) for value in found] == pytest.approx(list(expected))


@pytest.mark.parametrize(
    "text", ["T1 P1 Z 5\n", "T1 P1 Z5 %\n", "T1 P1 Z5 \r\n", "1 1 5 3\n", "T1 P1 Z0x10\n", "T1 P1 M3\n", "\tT1 P1\n"]
)
def test_a_line_that_linuxcnc_does_not_read_is_an_error(text: str, tmp_path: Path) -> None:
    (tmp_path / "t.tbl").write_bytes(text.encode())
    with pytest.raises(ProgramError, match=r"t\.tbl, line 1: expected a tool.*spaces between the words"):
        read_table(tmp_path / "t.tbl")
