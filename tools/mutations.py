"""Altered files: ``make mutations`` alters files, reads them by commands, and writes a part of ``docs/reliability.md``.

Every command must read the file or refuse it with one message that names it: no internal error (exit code 70), no
crash, no warning of Python, no markup of the file in a page, within limits of time and memory.
``ARGS="--mutations 500 --seed 5 --only bench"`` changes the number and the mutations, or selects kinds of files. A
failure is reproduced with ``--only KIND --number NUMBER``.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[variable] = "1"
ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests" / "support"), str(ROOT / "tools")]

import file_kinds  # noqa: E402
import file_trials  # noqa: E402
from file_kinds import Kind, Library, Outcome  # noqa: E402
from file_trials import INTERNAL_ERROR  # noqa: E402
from fuzz import PAGE, write_section  # noqa: E402

TITLE = "Altered files"
PART = 10
"""Mutations of one task."""


@dataclass
class Row:
    """The mutations of one kind of file."""

    mutations: int = 0
    refused: int = 0
    read: int = 0
    internal: int = 0
    slowest: float = 0.0
    memory: int = 0
    failures: list[str] = field(default_factory=list)

    def add(self, outcome: Outcome) -> None:
        """Add the outcome of a mutation."""
        ended = outcome.ended
        self.mutations += 1
        self.read += ended.code in file_trials.READ
        self.refused += ended.code in file_trials.REFUSED
        self.internal += ended.code == INTERNAL_ERROR
        self.slowest, self.memory = max(self.slowest, ended.seconds), max(self.memory, ended.memory)
        words = " ".join(outcome.words)
        self.failures += [
            f"{outcome.kind}, {outcome.number} ({outcome.what}), `{words}`: {text}" for text in outcome.faults
        ]


def libraries(folder: Path) -> dict[str, Kind]:
    """Make the valid files, and return the kinds by name."""
    library = Library(folder)
    return {kind.name: kind for make in file_kinds.MAKERS for kind in make(library)}


def tasks(kinds: dict[str, Kind], mutations: int) -> Iterator[tuple[Kind, range]]:
    """Yield parts of the mutations, alternating between the kinds."""
    each = -(-mutations // len(kinds))
    for start in range(0, each, PART):
        for kind in kinds.values():
            yield kind, range(start, min(start + PART, each))


_place: list[Path] = []


def prepare(kinds: list[Kind], folder: str) -> None:
    """Import the modules of the commands in a process of the pool."""
    _place.append(Path(tempfile.mkdtemp(dir=folder)))
    for kind in kinds:
        source, _, commands = kind.cases[0]
        for k, words in enumerate(commands[:2]):
            made = _place[0] / f"first {kind.name} {k}"
            file_kinds.copied(source, made)
            file_trials.preload(words, made, _place[0] / "log")


def work(task: tuple[Kind, range, int]) -> list[Outcome]:
    """Try the mutations of one task."""
    kind, numbers, seed = task
    return [file_kinds.trial(kind, number, seed, _place[0]) for number in numbers]


def section(rows: dict[str, Row], seed: int) -> str:
    """Return the section of the page."""
    total = Row()
    for row in rows.values():
        total.mutations += row.mutations
        total.internal += row.internal
    lines = [
        f"{total.mutations} altered files, each read by one command: values, keys, dims, units, types and attributes "
        "changed, huge sizes stated, codecs and links exchanged, bytes changed, files cut off or replaced by folders, "
        "links, devices and pipes. The command must read the file, or refuse it with a message that names it, within "
        f"{file_trials.LONGEST:.0f} s of processor time and {file_trials.MEMORY >> 20} MiB of memory, "
        f"{file_trials.MEMORY_PER_BYTE} bytes for each byte of the files, and {file_trials.COPIES} bytes for each byte "
        "of values that a NetCDF file states. A crash, a warning of Python, or markup of the file in a page is a "
        "failure, too.",
        "",
        "| kind of file | mutations | refused | read | exit code 70 | slowest | largest memory |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, row in rows.items():
        lines.append(
            f"| {name} | {row.mutations} | {row.refused} | {row.read} | {row.internal} | {row.slowest:.1f} s | "
            f"{row.memory >> 20} MiB |"
        )
    failures = [f"* {text}" for row in rows.values() for text in row.failures]
    lines += ["", *(["Failures:", "", *failures] if failures else ["No failure."])]
    return "\n".join([*lines, "", f"`make mutations`, seed {seed}."])


def main() -> None:
    """Try the mutations up to their number or the time limit, print failures, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutations", type=int, default=2000)
    parser.add_argument("--minutes", type=float, default=20.0, help="no mutation starts later")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="kinds whose name this regular expression finds; nothing is written")
    parser.add_argument("--number", type=int, help="one mutation of each kind; nothing is written")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=PAGE)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="mutations") as folder:
        kinds = libraries(Path(folder) / "good")
        kinds = {name: kind for name, kind in kinds.items() if re.search(options.only, name)}
        if not kinds:
            parser.error("expected a part of the name of a kind of file")
        work_list = [(kind, numbers, options.seed) for kind, numbers in tasks(kinds, options.mutations)]
        if options.number is not None:
            work_list = [(kind, range(options.number, options.number + 1), options.seed) for kind in kinds.values()]
        rows = {name: Row() for name in kinds}
        until = time.monotonic() + 60 * options.minutes
        context = multiprocessing.get_context("spawn")
        with context.Pool(options.processes, prepare, (list(kinds.values()), folder)) as pool:
            for outcomes in pool.imap_unordered(work, work_list):
                for outcome in outcomes:
                    rows[outcome.kind].add(outcome)
                    for text in outcome.faults:
                        print(f"{outcome.kind}, {outcome.number} ({outcome.what}), {' '.join(outcome.words)}: {text}",
                              flush=True)  # fmt: skip
                    if options.number is not None:
                        print(outcome.ended.code, outcome.ended.answer, outcome.ended.log)
                if time.monotonic() > until:
                    break
    body = section(rows, options.seed)
    print(body)
    if not options.only and options.number is None:
        write_section(options.out, TITLE, body)
        print(f"written to {options.out}")
    sys.exit(any(row.failures for row in rows.values()))


if __name__ == "__main__":
    main()
