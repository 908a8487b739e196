"""LinuxCNC's interpreter (``rs274``), and the canonical commands that it prints.

It runs in an empty folder on a copy of the program in which every block is numbered with its line, so that each command
states its line. It prints four digits after the decimal point. It takes the lengths of parameter files and tool tables
in inches, whatever an INI file states: they are converted, or one inch of the interpreter is one unit of the machine.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Generator, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from errormotion.compensation.program.interpreter.parameters import GUARD, UNKNOWN_TOOL, UNSTATED, Parameters
from errormotion.compensation.program.reading.offsets import UNITS, Offsets
from errormotion.compensation.program.reading.tools import Cutter
from errormotion.errors import ProgramError
from errormotion.instruments.nc_words import COMMENT, MAX_BLOCK, lines_of, refusal

MAX_COMMANDS = 5_000_000
"""Maximum number of commands of one program; it ends endless loops."""

TIME_LIMIT = 300.0
"""Maximum duration of the interpreter, s."""

_NUMBERED = re.compile(r"^(\s*/?)\s*(?:[nN]\s*(\d+)\s*)?")
_COMMAND = re.compile(r"^\s*\d+ N(\d+|\.+)\s*([A-Z_0-9]+)\((.*)\)$")
_METRIC = re.compile(r"G\s*0*21(?![.\d])", re.IGNORECASE)
_OTHER_UNIT = re.compile(r"G\s*0*20(?![.\d])|G\s*[\[#]|_metric|_imperial", re.IGNORECASE)
_INCH = UNITS["inch"]
_INI = """[EMC]
VERSION = 1.1
[TRAJ]
LINEAR_UNITS = {unit}
[RS274NGC]
CENTER_ARC_RADIUS_TOLERANCE_INCH = 0.00127
"""
"""The machine; the radii of arcs may differ as much as for a program in mm."""


@dataclass(frozen=True, slots=True)
class Command:
    """One canonical command.

    Attributes
    ----------
    line : int
        Line of the program that causes it; 0: none.
    name : str
    text : str
        Arguments in its parentheses.
    """

    line: int
    name: str
    text: str

    def numbers(self) -> list[float]:
        """Return the arguments as numbers."""
        return [float(word) for word in self.text.replace(",", " ").split()]


def interpreter() -> str | None:
    """Return the path of LinuxCNC's interpreter; None if it is not installed."""
    return shutil.which("rs274")


def commands(
    source: Iterable[str], offsets: Offsets, *, deleted: bool | None = None, own: bool = False
) -> Generator[Command]:
    """Yield the canonical commands of a program.

    Parameters
    ----------
    source : iterable of str
    offsets : Offsets
        State of the control. Unknown work offsets are 0 for the interpreter.
    deleted : bool, optional
        Whether blocks that start with ``/`` are skipped; None: they raise an error.
    own : bool
        Whether one inch of the interpreter is one unit of the machine, see `in_units_of_the_machine`: it then reads
        the program, the parameters and the tool table as they are. Otherwise lengths are in inches, and references to
        parameters are checked and rewritten.

    Raises
    ------
    ProgramError
        The interpreter is not installed, or reports an error in a line, or the program reads a value that is unknown.
    """
    program = interpreter()
    if program is None:
        raise ProgramError("LinuxCNC's interpreter (rs274) is not installed", code="program.interpreter.missing")
    lines = [text for _, text in lines_of(source)]
    parameters = None if own else Parameters(lines, offsets)
    scale = UNITS[offsets.unit] if own else _INCH
    with tempfile.TemporaryDirectory(prefix="errormotion-") as name:
        folder = Path(name)
        before = f"T{UNKNOWN_TOOL} M6" if parameters is not None else "G20" if offsets.unit == "mm" else ""
        written = _write_program(lines if parameters is None else parameters.lines(), folder, deleted, before)
        _write_parameters(offsets, folder / "program.var", scale, UNSTATED if parameters is not None else 0.0)
        _write_tools(offsets, folder / "program.tbl", scale, own)
        (folder / "machine.ini").write_text(_INI.format(unit=offsets.unit), encoding="ascii")
        arguments = [program, "-g", "-T", "-v", "program.var", "-t", "program.tbl"]
        arguments += ["-i", "machine.ini"] if own else []
        if deleted:
            arguments.append("-b")
        with (folder / "errors").open("wb") as errors:
            process = subprocess.Popen(
                [*arguments, "program.ngc"],
                cwd=folder,
                env={**os.environ, "HOME": name},  # avoids the tool file that running controls share
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=errors,
            )
        expired = threading.Event()

        def end() -> None:
            expired.set()
            process.kill()

        late = threading.Timer(TIME_LIMIT, end)
        late.daemon = True
        late.start()
        try:
            for command in _commands(process, own):
                if parameters is not None and parameters.reads_tool and _leaves_tool(command):
                    where = lines[command.line - 1] if command.line else ""
                    raise refusal(
                        command.line,
                        where,
                        "T0 or M61 in a program that reads values of the tool",
                        code="program.tool.unknown",
                    )
                yield command
            code = process.wait()
        finally:
            late.cancel()
            with suppress(OSError):
                process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()
        if expired.is_set():
            raise ProgramError(
                f"LinuxCNC's interpreter did not end within {TIME_LIMIT:g} s: possibly an endless loop",
                code="program.interpreter.endless",
            )
        if code != 0:
            raise _refused(folder, code, lines, written, parameters)


def in_units_of_the_machine(source: Iterable[str], unit: str) -> list[str] | None:
    """Return a program for an interpreter whose inch is the unit of the machine; None if it states another unit.

    Parameters
    ----------
    source : iterable of str
    unit : str
        ``mm`` or ``inch``.
    """
    lines = list(source)
    if unit == "inch":
        return lines
    new = []
    for text in lines:
        plain = COMMENT.sub("", text)
        if _OTHER_UNIT.search(plain):
            return None
        pieces = COMMENT.split(text)
        comments = COMMENT.findall(text)
        pieces = [_METRIC.sub("G20", piece) for piece in pieces]
        new.append("".join(a + b for a, b in zip(pieces, [*comments, ""], strict=True)))
    return new


def _leaves_tool(command: Command) -> bool:
    """Return whether the interpreter keeps the values of the tool before a command, which the control does not."""
    return command.name == "CHANGE_TOOL_NUMBER" or (command.name == "CHANGE_TOOL" and command.text.strip() == "0")


def _commands(process: subprocess.Popen[bytes], own: bool) -> Iterator[Command]:
    assert process.stdout is not None
    for count, raw in enumerate(process.stdout):
        if count > MAX_COMMANDS:
            raise ProgramError(
                f"the program has more than {MAX_COMMANDS} commands: possibly an endless loop",
                code="program.interpreter.endless",
            )
        line = raw.decode("latin-1").rstrip("\n")
        found = _COMMAND.match(line)
        if found is None:
            if line.strip():
                raise ProgramError(
                    f"LinuxCNC's interpreter printed '{line.strip()[:80]}'; expected a command",
                    code="program.interpreter.output",
                )
            continue
        number = found[1]
        if number == "0" and not own:  # the change to the tool that is unknown
            continue
        if found[2] == "SELECT_TOOL" and found[3] == str(UNKNOWN_TOOL):
            found = _COMMAND.match(line.replace(str(UNKNOWN_TOOL), "0"))
            assert found is not None
        yield Command(0 if number.startswith(".") else int(number), found[2], found[3])


def _refused(
    folder: Path, code: int, source: list[str], written: list[str], parameters: Parameters | None
) -> ProgramError:
    with (folder / "errors").open("rb") as file:
        messages = [
            line for line in file.read(4096).decode("latin-1").splitlines() if line.strip() and line != "executing"
        ]
    if code < 0:
        return ProgramError(f"LinuxCNC's interpreter was ended by signal {-code}", code="program.interpreter.ended")
    why, where = messages[0] if messages else f"exit code {code}", messages[1] if len(messages) > 1 else ""
    lines = [k for k, text in enumerate(written, 1) if text.strip().lower() == where.strip().lower() and text.strip()]
    if why.startswith(GUARD) and parameters is not None:
        for line in lines:
            if (error := parameters.refused(line)) is not None:
                return error
    why += " (LinuxCNC's interpreter)"
    if lines:
        return refusal(lines[0], source[lines[0] - 1], why, code="program.interpreter.refused")
    return ProgramError(why, code="program.interpreter.refused")


def own_number(text: str) -> tuple[str, str]:
    """Return the number (N) of a line, or an empty string, and the rest of the line."""
    found = _NUMBERED.match(text)
    assert found is not None
    return found[2] or "", found[1].strip() + text[found.end() :]


def _write_program(source: Iterable[str], folder: Path, deleted: bool | None, before: str) -> list[str]:
    """Write the program, with a line before it, and return its lines."""
    written: list[str] = []
    for number, text in enumerate(source, 1):
        _, rest = own_number(text)
        if rest.startswith("/") and deleted is None:
            raise ProgramError(
                f"line {number}: '/' (block delete): state whether these blocks are skipped",
                code="program.block_delete.not_stated",
            )
        plain = rest.lstrip("/ \t")
        if plain and plain[0] not in "oO%":
            mark = "/" if rest.startswith("/") else ""
            text = f"{mark}N{number} {plain}"
        if len(text) > MAX_BLOCK:
            raise ProgramError(
                f"line {number}: LinuxCNC's interpreter reads {MAX_BLOCK} characters of a line",
                code="program.line.too_long",
            )
        written.append(text)
    first = next((k for k, text in enumerate(written) if text.strip()), 0)
    start = first + 1 if written and written[first].strip() == "%" else 0
    with (folder / "program.ngc").open("w", encoding="latin-1", errors="replace", newline="\n") as file:
        file.writelines(text + "\n" for text in (*written[:start], f"N0 {before}", *written[start:]))
    return written


def _write_parameters(offsets: Offsets, path: Path, scale: float, unstated: float) -> None:
    """Write a parameter file with lengths in a unit, m; parameters of programs that are not stated have a value."""
    values = dict.fromkeys(range(1, 5001), unstated) if unstated else {}
    values |= {
        first + k: 0.0 for first in (5161, 5181, 5211, *range(5221, 5382, 20)) for k in range(10) if first + k < 5400
    }
    own = scale == UNITS[offsets.unit]
    values |= {key: value for key, value in offsets.parameters.items() if key <= 5000 or (own and key < 5400)}
    values |= {5210: offsets.parameters.get(5210, float(bool(np.any(offsets.g92)))), 5220: offsets.system + 1.0}
    for k in range(3):
        values[5161 + k], values[5181 + k] = offsets.homes[:, k] / scale
        values[5211 + k] = offsets.stored[k] / scale
        for index in range(9):
            values[5221 + 20 * index + k] = offsets.systems[index, k] / scale
    for index in range(9):
        values[5230 + 20 * index] = offsets.rotations[index]
    lines = [f"{key}\t{0.0 if np.isnan(value) else value:.12f}\n" for key, value in sorted(values.items())]
    path.write_text("".join(lines), encoding="ascii")


def _write_tools(offsets: Offsets, path: Path, scale: float, own: bool) -> None:
    """Write a tool table with lengths in a unit, m; with a tool of unknown size, unless it is that of the machine."""
    if own and offsets.table:
        path.write_bytes(offsets.table.encode())
        return
    lines = [] if own else [f"T{UNKNOWN_TOOL} P1 Z1 D1000000\n"]
    for pocket, (number, offset) in enumerate(sorted(offsets.tools.items()), 2):
        cutter = offsets.cutters.get(number, Cutter())
        words = dict(zip("XYZ", (value / scale for value in offset), strict=True))
        words |= dict(zip("ABC", cutter.others[:3], strict=True))
        words |= dict(zip("UVW", (value / scale for value in cutter.others[3:]), strict=True))
        words |= {"D": cutter.diameter / scale, "I": cutter.front, "J": cutter.back}
        stated = " ".join(f"{letter}{value:+.9f}" for letter, value in words.items())
        lines.append(f"T{number} P{pocket} {stated} Q{cutter.orientation}\n")
    path.write_text("".join(lines), encoding="ascii")
