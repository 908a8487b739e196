"""Disturbed connections: ``make wire`` tries all drivers, and writes a section of ``docs/reliability.md``.

A proxy between a driver and its simulated device disturbs one piece of each session (``tests/support/wire_proxy.py``).
``ARGS="--number 10 --seed 5 --only keyence"`` changes the number of sessions and the disturbances, or selects
instruments; other rows are not changed.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import re
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests" / "support"), str(ROOT / "tools")]

import wire_trials as trials  # noqa: E402
from fuzz import PAGE, sections, write_section  # noqa: E402
from wire_proxy import LATE  # noqa: E402

from errormotion.errors import InstrumentError  # noqa: E402

TITLE = "Disturbed wires"
TABLE = (
    "| instrument, wire | sessions | right | values lost, NaN | refused | errors | wrong by changed bytes |",
    "|---|---|---|---|---|---|---|",
)
SHOWN = 5


@dataclass
class Row:
    """The sessions of one instrument."""

    ends: Counter[str] = field(default_factory=Counter)
    errors: Counter[str] = field(default_factory=Counter)
    damaged: int = 0
    undetected: int = 0
    faults: list[str] = field(default_factory=list)


def work(task: tuple[int, str, int, int]) -> tuple[int, Row]:
    """Try the sessions of one instrument with one kind of fault."""
    number, kind, count, seed = task
    case, row = trials.cases()[number], Row()
    try:
        faults = trials.faults(case, kind, count, seed)
    except InstrumentError as error:
        row.faults.append(f"without a disturbance: {type(error).__name__}: {error}")
        return number, row
    for fault in faults:
        outcome = trials.trial(case, fault)
        row.ends[outcome.end] += 1
        if outcome.error:
            row.errors[outcome.error] += 1
        row.damaged += kind in trials.DAMAGE
        row.undetected += bool(outcome.undetected)
        if outcome.fault:
            row.faults.append(f"{outcome.fault} ({outcome.what}; {fault})")
    return number, row


def text_of(name: str, row: Row) -> str:
    """Return a row of the table."""
    reached = sum(row.ends.values()) - row.ends["not reached"]
    lost = row.ends["counted"] + row.ends["unknown"]
    errors = ", ".join(f"{error} {count}" for error, count in row.errors.most_common()) or "none"
    wrong = f"{row.undetected} of {row.damaged}"
    return f"| {name} | {reached} | {row.ends['right']} | {lost} | {row.ends['refused']} | {errors} | {wrong} |"


def section(rows: Mapping[str, str], failures: Sequence[str], seed: int) -> str:
    """Return the section of the page from the rows by name."""
    total = sum(int(text.split("|")[2]) for text in rows.values())
    without = "; ".join(f"{name}: {why}" for name, why in trials.WITHOUT_WIRE.items())
    lines = [
        f"{total} sessions of drivers with their simulated devices, on TCP and on pseudo terminals, each disturbed "
        f"once in one direction: a piece was received 0.1 s later, or {LATE:g} s later, in two parts, byte by byte, "
        "twice, after the next one, with its halves exchanged, with one byte changed, or not at all; or the transfer "
        "stopped, or the connection was closed. A session must end with correct readings and samples, with counted "
        "NaN, or with one typed error; then the driver must close, open again and read correct values. A piece that "
        "is late within the time limit, or divided, must have no effect. The readings are compared with those of the "
        "same session without a disturbance; if a device measures ahead of its reader, within twice their range.",
        "",
        *TABLE,
        *rows.values(),
        "",
        "Wrong by changed bytes: sessions in which a changed byte, or exchanged halves, resulted in another value "
        "that cannot be detected, because the protocol has no checksum; see the pages of the "
        "[devices](reference/devices/index.md). No other disturbance resulted in a wrong value. Not tried here: "
        f"{without}.",
        "",
        *(["Failures:", "", *failures] if failures else ["No failure."]),
        "",
        f"`make wire`, seed {seed}.",
    ]
    return "\n".join(lines)


def write(page: Path, names: Sequence[str], new: Mapping[str, Row], seed: int) -> None:
    """Replace rows and failures of the tried instruments; others are not changed."""
    body = sections(page)[1].get(TITLE, "").splitlines()
    rows = {line[2:].partition(" |")[0]: line for line in body if line.startswith("| ")}
    rows |= {name: text_of(name, row) for name, row in new.items()}
    kept = [line for line in body if line.startswith("* ") and line[2:].partition(":")[0] not in new]
    failures = [f"* {name}: `{text}`" for name, row in new.items() for text in row.faults[:SHOWN]]
    write_section(page, TITLE, section({name: rows[name] for name in names if name in rows}, [*kept, *failures], seed))


def main() -> None:
    """Try the instruments, print each kind of fault, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--number", type=int, default=3, help="sessions of each instrument and kind of fault")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="instruments whose name this regular expression finds")
    parser.add_argument("--processes", type=int, default=2 * (os.cpu_count() or 1))
    parser.add_argument("--out", type=Path, default=PAGE)
    options = parser.parse_args()
    names = [case.name for case in trials.cases()]
    chosen = [number for number, name in enumerate(names) if re.search(options.only, name)]
    if not chosen:
        parser.error(f"expected a part of a name: {', '.join(names)}")
    start, found, left = time.monotonic(), {number: Row() for number in chosen}, Counter[int]()
    tasks = [(number, kind, options.number, options.seed) for number in chosen for kind in trials.KINDS]
    failed = False
    with multiprocessing.get_context("spawn").Pool(options.processes) as pool:
        for number, part in pool.imap_unordered(work, tasks):
            row = found[number]
            row.ends, row.errors = row.ends + part.ends, row.errors + part.errors
            row.damaged, row.undetected = row.damaged + part.damaged, row.undetected + part.undetected
            row.faults += part.faults
            left[number] += 1
            for text in part.faults:
                print(f"    {text}", flush=True)
            if left[number] == len(trials.KINDS):
                failed = failed or bool(row.faults)
                write(options.out, names, {names[number]: row}, options.seed)
                print(text_of(names[number], row), f"{time.monotonic() - start:.0f} s", flush=True)
    print(f"written to {options.out}")
    sys.exit(failed)


if __name__ == "__main__":
    main()
