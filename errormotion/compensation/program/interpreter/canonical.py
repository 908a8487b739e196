"""LinuxCNC's interpreter (``rs274``), and the canonical commands that it prints.

It runs in an empty folder on a copy of the program in which every block is numbered with its line, so that each command
states its line. It prints four digits after the decimal point.
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

from errormotion.compensation.program.reading.offsets import UNITS, Offsets
from errormotion.compensation.program.reading.words import MAX_BLOCK, lines_of
from errormotion.errors import ProgramError

MAX_COMMANDS = 5_000_000
"""Maximum number of commands of one program; it ends endless loops."""

TIME_LIMIT = 300.0
"""Maximum duration of the interpreter, s."""

_NUMBERED = re.compile(r"^(\s*/?)\s*(?:[nN]\s*(\d+)\s*)?")
_COMMAND = re.compile(r"^\s*\d+ N(\d+|\.+)\s*([A-Z_0-9]+)\((.*)\)$")
_INCH = UNITS["inch"]


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


def commands(source: Iterable[str], offsets: Offsets, *, deleted: bool | None = None) -> Generator[Command]:
    """Yield the canonical commands of a program.

    Parameters
    ----------
    source : iterable of str
    offsets : Offsets
        Unknown values are 0 for the interpreter.
    deleted : bool, optional
        Whether blocks that start with ``/`` are skipped; None: they raise an error.

    Raises
    ------
    ProgramError
        The interpreter is not installed, or reports an error in a line.
    """
    program = interpreter()
    if program is None:
        raise ProgramError("LinuxCNC's interpreter (rs274) is not installed")
    with tempfile.TemporaryDirectory(prefix="errormotion-") as name:
        folder = Path(name)
        _write_program(source, folder / "program.ngc", deleted)
        _write_parameters(offsets, folder / "program.var")
        _write_tools(offsets, folder / "program.tbl")
        arguments = [program, "-g", "-v", "program.var", "-t", "program.tbl"]
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
            yield from _commands(process)
            code = process.wait()
        finally:
            late.cancel()
            with suppress(OSError):
                process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()
        if expired.is_set():
            raise ProgramError(f"LinuxCNC's interpreter did not end within {TIME_LIMIT:g} s: possibly an endless loop")
        if code != 0:
            raise _refused(folder, code)


def _commands(process: subprocess.Popen[bytes]) -> Iterator[Command]:
    assert process.stdout is not None
    for count, raw in enumerate(process.stdout):
        if count > MAX_COMMANDS:
            raise ProgramError(f"the program has more than {MAX_COMMANDS} commands: possibly an endless loop")
        line = raw.decode("latin-1").rstrip("\n")
        found = _COMMAND.match(line)
        if found is None:
            if line.strip():
                raise ProgramError(f"LinuxCNC's interpreter printed '{line.strip()[:80]}'; expected a command")
            continue
        number = found[1]
        yield Command(0 if number.startswith(".") else int(number), found[2], found[3])


def _refused(folder: Path, code: int) -> ProgramError:
    with (folder / "errors").open("rb") as file:
        messages = [
            line for line in file.read(4096).decode("latin-1").splitlines() if line.strip() and line != "executing"
        ]
    if code < 0:
        return ProgramError(f"LinuxCNC's interpreter was ended by signal {-code}")
    why, where = messages[0] if messages else f"exit code {code}", messages[1] if len(messages) > 1 else ""
    number = _NUMBERED.match(where)
    if number is not None and number[2]:
        return ProgramError(f"line {number[2]} '{where[number.end() :].strip()[:60]}': {why} (LinuxCNC's interpreter)")
    line = _line_of(folder / "program.ngc", where)
    return ProgramError(f"{line}'{where.strip()[:60]}': {why} (LinuxCNC's interpreter)")


def _line_of(path: Path, text: str) -> str:
    with path.open(encoding="latin-1") as file:
        found = [number for number, line in enumerate(file, 1) if line.strip().lower() == text.strip().lower()]
    return f"line {found[0]} " if len(found) == 1 else ""


def own_number(text: str) -> tuple[str, str]:
    """Return the number (N) of a line, or an empty string, and the rest of the line."""
    found = _NUMBERED.match(text)
    assert found is not None
    return found[2] or "", found[1].strip() + text[found.end() :]


def _write_program(source: Iterable[str], path: Path, deleted: bool | None) -> None:
    with path.open("w", encoding="latin-1", newline="\n") as file:
        for number, text in lines_of(source):
            _, rest = own_number(text)
            if rest.startswith("/") and deleted is None:
                raise ProgramError(f"line {number}: '/' (block delete): state whether these blocks are skipped")
            plain = rest.lstrip("/ \t")
            if plain and plain[0] not in "oO%":
                mark = "/" if rest.startswith("/") else ""
                text = f"{mark}N{number} {plain}"
            if len(text) > MAX_BLOCK:
                raise ProgramError(f"line {number}: LinuxCNC's interpreter reads {MAX_BLOCK} characters of a line")
            file.write(text + "\n")


def _write_parameters(offsets: Offsets, path: Path) -> None:
    """Write a parameter file; without an INI file the interpreter takes lengths in inches."""
    values = {
        first + k: 0.0 for first in (5161, 5181, 5211, *range(5221, 5382, 20)) for k in range(10) if first + k < 5400
    }
    values |= {5210: float(bool(np.any(offsets.g92))), 5220: offsets.system + 1.0}
    for k in range(3):
        values[5161 + k], values[5181 + k] = offsets.homes[:, k] / _INCH
        values[5211 + k] = offsets.g92[k] / _INCH
        for index in range(9):
            values[5221 + 20 * index + k] = offsets.systems[index, k] / _INCH
    for index in range(9):
        values[5230 + 20 * index] = offsets.rotations[index]
    lines = [f"{key}\t{0.0 if np.isnan(value) else value:.12f}\n" for key, value in sorted(values.items())]
    path.write_text("".join(lines), encoding="ascii")


def _write_tools(offsets: Offsets, path: Path) -> None:
    lines = []
    for pocket, (number, offset) in enumerate(sorted(offsets.tools.items()), 1):
        words = " ".join(f"{axis}{value / _INCH:+.9f}" for axis, value in zip("XYZ", offset, strict=True))
        lines.append(f"T{number} P{pocket} {words} D0.0\n")
    path.write_text("".join(lines), encoding="ascii")
