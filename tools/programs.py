"""Read random NC programs by the interpreter of LinuxCNC and by the reader of this package: ``make programs``.

Both must have the same path. One run of the interpreter reads many programs, because its start takes longer than
reading one. Programs that read the state of their control are expanded, and the interpreter then reads the original
and the expanded program with the files of the control as they are. This program writes its sections of
docs/reliability.md, also if it is ended early by SIGTERM, Ctrl-C or ``--minutes``.
"""

from __future__ import annotations

import argparse
import itertools
import os
import platform
import re
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from random import Random

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests" / "support"), str(ROOT / "tools")]

from fuzz import PAGE, write_section  # noqa: E402
from nc_controls import Reading, control  # noqa: E402
from nc_paths import ORIGINS  # noqa: E402
from nc_programs import Programs  # noqa: E402

from errormotion.compensation.program import Reader  # noqa: E402
from errormotion.compensation.program.interpreter.agreement import check  # noqa: E402
from errormotion.compensation.program.interpreter.canonical import commands, interpreter  # noqa: E402
from errormotion.compensation.program.interpreter.expanding import Expansion  # noqa: E402
from errormotion.compensation.program.interpreter.paths import compare  # noqa: E402
from errormotion.compensation.program.interpreter.screening import screen  # noqa: E402
from errormotion.errors import ProgramError  # noqa: E402

TITLE = "Random NC programs"
READING_TITLE = "Random NC programs that read their control"
STEPS = (5, 20)
"""Fewest and most steps of a program; one in `LONG` has `LONG_STEPS`."""
LONG, LONG_STEPS = 50, 100
GROUP = 250
"""Programs in one run of the interpreter."""
LAST_DIGIT = {"mm": 1e-7, "inch": 3e-6}
"""Rounding of positions that the interpreter prints, in the unit of the program, m."""
CLEARED = [f"G10 L2 P{n} X{n} Y{-n} Z0 R0" for n in range(1, 10)]
KINDS = {
    "rapid moves": r"G0?0(?!\d|\.)",
    "arcs (G2, G3)": r"G0?[23](?!\d|\.)",
    "other planes (G18, G19)": r"G1[89](?!\d|\.)",
    "inches (G20)": r"G20(?!\d)",
    "incremental (G91)": r"G91(?!\d|\.)",
    "absolute centres (G90.1)": r"G90\.1",
    "inverse time or per revolution (G93, G95)": r"G9[35](?!\d|\.)",
    "work offsets (G54 to G59.3, G10, G92)": r"G(?:5[4-9]|10|92)",
    "tool lengths (G43, G43.1)": r"G43",
    "probing (G38)": r"G38",
    "machine coordinates (G53)": r"G53",
}
"""Features of a program, by name."""
READING_KINDS = {
    "a machine in inches": r"^(?:%\n)?(?:O.*\n)?G20",
    "cutter compensation (G41, G42)": r"G4[12]",
    "parameters of the control": r"# ?5",
    "computed parameter numbers": r"#[#\[]",
    "named parameters": r"#<_",
    "canned cycles": r"G(?:8[1-9]|73)",
    "loops, branches and subroutines": r"^o\d+ (?:while|do|repeat|if|sub)",
    "stored offsets (G92.3)": r"G92\.3",
    "G28, G30": r"G(?:28|30)",
    "a program number": r"^O\d",
}
"""Features of a program that reads its control, by name."""
STEPS_OF_READING = (10, 60)
_USED = {name: re.compile(pattern, re.IGNORECASE) for name, pattern in KINDS.items()}


_READING_USED = {name: re.compile(pattern, re.MULTILINE) for name, pattern in READING_KINDS.items()}


@dataclass
class Found:
    """Counts, and the seeds of programs that are read differently, with the reason."""

    programs: int = 0
    blocks: int = 0
    moves: int = 0
    using: Counter[str] = field(default_factory=Counter)
    differ: dict[int, str] = field(default_factory=dict)
    refused: int = 0

    def add(self, other: Found) -> None:
        """Add another part."""
        self.programs += other.programs
        self.blocks += other.blocks
        self.moves += other.moves
        self.using += other.using
        self.differ |= other.differ
        self.refused += other.refused


def program(seed: int) -> list[str]:
    """Return a program without its end that does not change the work offsets."""
    steps = LONG_STEPS if seed % LONG == 0 else Random(~seed).randint(*STEPS)
    made = [*Programs(Random(seed)).lines(steps)[:-1], "G80"]
    return [*made, *CLEARED] if any(line.startswith("G10 ") for line in made) else made


def read(seeds: Sequence[int]) -> Found:
    """Read programs in one run of the interpreter; if the paths differ, each separately."""
    found = Found(len(seeds))
    lines: list[str] = []
    for seed in seeds:
        made = program(seed)
        own = "\n".join(made[1 : made.index("G80")])  # after the block that sets all modes
        found.using.update(name for name, pattern in _USED.items() if pattern.search(own))
        lines += made
    found.blocks = len(lines)
    try:
        found.moves = check([*lines, "M2"], ORIGINS, Reader(ORIGINS))
    except ProgramError as error:
        if len(seeds) == 1:
            found.differ[seeds[0]] = str(error)
        else:
            alone = [read([seed]) for seed in seeds]
            found.moves = sum(each.moves for each in alone)
            found.differ = {seed: why for each in alone for seed, why in each.differ.items()}
            found.differ = found.differ or {seeds[0]: f"with the {len(seeds) - 1} programs after it: {error}"}
    return found


def read_control(seeds: Sequence[int]) -> Found:
    """Expand programs that read the state of random controls, and compare the cuts."""
    found = Found(len(seeds))
    for seed in seeds:
        random = Random(seed)
        with tempfile.TemporaryDirectory() as folder:
            try:
                offsets = control(random, Path(folder))
            except ProgramError:  # a line of the tool table that LinuxCNC does not read
                found.refused += 1
                continue
        lines = Reading(random, offsets.unit).lines(random.randint(*STEPS_OF_READING))
        found.blocks += len(lines)
        try:
            screen(lines)
            with closing(commands(lines, offsets)) as printed:
                new = [str(text) for text in Expansion(lines, offsets, LAST_DIGIT[offsets.unit]).lines(printed)]
        except ProgramError:
            found.refused += 1
            continue
        found.using.update(name for name, pattern in _READING_USED.items() if pattern.search("\n".join(lines)))
        try:
            check(new, offsets, Reader(offsets))
            found.moves += compare(lines, new, offsets, LAST_DIGIT[offsets.unit])
        except ProgramError as error:
            found.differ[seed] = str(error)
    return found


def groups(programs: int, seed: int, size: int) -> Iterator[range]:
    """Yield the seeds of parts of this size."""
    for first in range(seed, seed + programs, size):
        yield range(first, min(first + size, seed + programs))


def in_processes(work: Callable[[range], Found], parts: Iterable[range], jobs: int) -> Iterator[Found]:
    """Yield results, with only a few parts in the queue."""
    ignore = partial(signal.signal, signal.SIGINT, signal.SIG_IGN)
    with ProcessPoolExecutor(jobs, mp_context=get_context("fork"), initializer=ignore) as pool:
        iterator = iter(parts)
        while taken := list(itertools.islice(iterator, 4 * jobs)):
            yield from pool.map(work, taken)


def section(found: Found, seed: int, seconds: float, cpu: float) -> str:
    """Return the section of the page."""
    lines = [
        f"{found.programs} random programs of {STEPS[0]} to {STEPS[1]} steps, one in {LONG} of {LONG_STEPS}, were "
        "read by the interpreter of LinuxCNC (`rs274`) and by the reader of `errormotion compensate program`. A step "
        "is a move, a mode, an offset, a probing, or a word without motion. Each move must have the same line, "
        "kind, end, centre and number of turns, within the four digits that the interpreter prints. One run of the "
        f"interpreter reads {GROUP} programs, and no program changes the work offsets.",
        "",
        "| | number |",
        "|---|---|",
        f"| programs | {found.programs} |",
        f"| blocks | {found.blocks} |",
        f"| moves compared | {found.moves} |",
        f"| programs read differently | {len(found.differ)} |",
        *(f"| programs with {name} | {found.using[name]} |" for name in KINDS),
        f"| processor time of a program | {1e3 * cpu / max(found.programs, 1):.2g} ms |",
        "",
    ]
    if found.differ:
        lines += ["Read differently:", "", *(f"* seed {key}: `{why[:300]}`" for key, why in found.differ.items())]
    else:
        lines += ["No difference."]
    where = f"{platform.machine()}, Python {platform.python_version()}"
    return "\n".join([*lines, "", f"`make programs`, seed {seed}, {where}, {seconds / 60:.0f} minutes."])


def section_of_reading(found: Found, seed: int, seconds: float, cpu: float) -> str:
    """Return the section of the page on programs that read their control."""
    low, high = STEPS_OF_READING
    lines = [
        f"{found.programs} random programs of {low} to {high} steps were expanded by `errormotion compensate program`, "
        "each with a random parameter file, tool table and unit of the machine. The interpreter then read the original "
        "program with these files as they are, and the expanded one: the cuts must be the same within the printed "
        "digits. Programs that read values which may be unknown, and tool tables with a line that LinuxCNC does not "
        "read, are refused.",
        "",
        "| | number |",
        "|---|---|",
        f"| programs | {found.programs} |",
        f"| refused | {found.refused} |",
        f"| blocks | {found.blocks} |",
        f"| cuts compared | {found.moves} |",
        f"| programs expanded differently | {len(found.differ)} |",
        *(f"| expanded programs with {name} | {found.using[name]} |" for name in READING_KINDS),
        f"| processor time of a program | {1e3 * cpu / max(found.programs, 1):.2g} ms |",
        "",
    ]
    lines += [f"* seed {key}: `{why[:300]}`" for key, why in found.differ.items()] or ["No difference."]
    where = f"{platform.machine()}, Python {platform.python_version()}"
    return "\n".join([*lines, "", f"`make programs`, seed {seed}, {where}, {seconds / 60:.0f} minutes."])


def main() -> None:
    """Read programs, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--programs", type=lambda text: int(float(text)), default=1_000_000)
    parser.add_argument("--reading", type=lambda text: int(float(text)), default=2000, help="programs that read")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="end earlier")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, default=PAGE)
    options = parser.parse_args()
    if interpreter() is None:
        sys.exit("LinuxCNC's interpreter (rs274) is not installed")
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGINT))
    good = True
    for title, work, count, size, body in (
        (TITLE, read, options.programs, GROUP, section),
        (READING_TITLE, read_control, options.reading, 10, section_of_reading),
    ):
        if not count:
            continue
        found, start, cpu, ended = _run(work, count, size, options)
        text = body(found, options.seed, time.monotonic() - start, cpu)
        print(f"\n{text}")
        write_section(options.out, title, text)
        print(f"written to {options.out}")
        good = good and found.programs > 0 and not found.differ
        if ended:
            break
    sys.exit(not good)


def _run(
    work: Callable[[range], Found], count: int, size: int, options: argparse.Namespace
) -> tuple[Found, float, float, bool]:
    """Return what was found, the time of the start, the processor time, and whether the run was interrupted."""
    found, start, before = Found(), time.monotonic(), _processor_time()

    def until_the_end() -> Iterator[range]:
        for part in groups(count, options.seed, size):
            if time.monotonic() > start + 60 * options.minutes:
                return
            yield part

    try:
        for part in in_processes(work, until_the_end(), options.jobs):
            found.add(part)
            print(f"{found.programs} programs, {found.moves} moves, {len(found.differ)} differ", end="\r", flush=True)
    except KeyboardInterrupt:
        return found, start, _processor_time() - before, True
    return found, start, _processor_time() - before, False


def _processor_time() -> float:
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


if __name__ == "__main__":
    main()
