"""Read random NC programs by the interpreter of LinuxCNC and by the reader of this package: ``make programs``.

Both must have the same path. One run of the interpreter reads many programs, because its start takes longer than
reading one. This program writes its section of docs/reliability.md, also if it is ended early by SIGTERM, Ctrl-C or
``--minutes``.
"""

from __future__ import annotations

import argparse
import itertools
import os
import platform
import re
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from random import Random

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests" / "support"), str(ROOT / "tools")]

from fuzz import PAGE, write_section  # noqa: E402
from nc_paths import ORIGINS  # noqa: E402
from nc_programs import Programs  # noqa: E402

from errormotion.compensation.program import Reader  # noqa: E402
from errormotion.compensation.program.interpreter.agreement import check  # noqa: E402
from errormotion.compensation.program.interpreter.canonical import interpreter  # noqa: E402
from errormotion.errors import ProgramError  # noqa: E402

TITLE = "Random NC programs"
STEPS = (5, 20)
"""Fewest and most steps of a program; one in `LONG` has `LONG_STEPS`."""
LONG, LONG_STEPS = 50, 100
GROUP = 250
"""Programs in one run of the interpreter."""
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
_USED = {name: re.compile(pattern, re.IGNORECASE) for name, pattern in KINDS.items()}


@dataclass
class Found:
    """Counts, and the seeds of programs that are read differently, with the reason."""

    programs: int = 0
    blocks: int = 0
    moves: int = 0
    using: Counter[str] = field(default_factory=Counter)
    differ: dict[int, str] = field(default_factory=dict)

    def add(self, other: Found) -> None:
        """Add another part."""
        self.programs += other.programs
        self.blocks += other.blocks
        self.moves += other.moves
        self.using += other.using
        self.differ |= other.differ


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


def groups(programs: int, seed: int) -> Iterator[range]:
    """Yield the seeds of each run of the interpreter."""
    for first in range(seed, seed + programs, GROUP):
        yield range(first, min(first + GROUP, seed + programs))


def in_processes(parts: Iterable[range], jobs: int) -> Iterator[Found]:
    """Yield results, with only a few parts in the queue."""
    ignore = partial(signal.signal, signal.SIGINT, signal.SIG_IGN)
    with ProcessPoolExecutor(jobs, mp_context=get_context("fork"), initializer=ignore) as pool:
        iterator = iter(parts)
        while taken := list(itertools.islice(iterator, 4 * jobs)):
            yield from pool.map(read, taken)


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


def main() -> None:
    """Read programs, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--programs", type=lambda text: int(float(text)), default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="end earlier")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, default=PAGE)
    options = parser.parse_args()
    if interpreter() is None:
        sys.exit("LinuxCNC's interpreter (rs274) is not installed")
    found = Found()
    start = time.monotonic()
    end = start + 60 * options.minutes

    def until_the_end() -> Iterator[range]:
        for part in groups(options.programs, options.seed):
            if time.monotonic() > end:
                return
            yield part

    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGINT))
    try:
        for part in in_processes(until_the_end(), options.jobs):
            found.add(part)
            print(f"{found.programs} programs, {found.moves} moves, {len(found.differ)} differ", end="\r", flush=True)
    except KeyboardInterrupt:
        pass
    used = os.times()
    cpu = used.user + used.system + used.children_user + used.children_system
    body = section(found, options.seed, time.monotonic() - start, cpu)
    print(f"\n{body}")
    write_section(options.out, TITLE, body)
    print(f"written to {options.out}")
    sys.exit(bool(found.differ) or found.programs == 0)


if __name__ == "__main__":
    main()
