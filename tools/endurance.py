"""Monitor a machine for 24 simulated hours with a fault every minute: ``make endurance``.

The trial is in ``tests/support/monitored_day.py``. This program writes its section of docs/reliability.md.
"""

from __future__ import annotations

import argparse
import platform
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests" / "support"), str(ROOT / "tools")]

import monitored_day  # noqa: E402
from fuzz import PAGE, write_section  # noqa: E402
from monitored_day import Day  # noqa: E402

TITLE = "A monitor over 24 hours"
MAX_GROWTH = 0.05
"""Of the memory after the first hour."""
NAMES = {
    "corrupt": "answers with a wrong bit",
    "disconnect": "connection broken",
    "garbage": "stray bytes ahead of answers",
    "late": "answer held back until the fault ends",
    "open": "sensors open (out of range)",
    "refuse": "connection broken, new ones refused",
    "silence": "no answers",
    "suspension": "computer suspended, 10 s to 60 s",
    "wall clock": "wall clock set by an hour, a day or 50 years",
}


def failures(day: Day) -> list[str]:
    """Return the failures of a day."""
    found = list(day.errors)
    first, last = day.resources[0], day.resources[-1]
    if day.growth() > MAX_GROWTH:
        found.append(f"the memory grew from {first.memory / 2**20:.1f} to {last.memory / 2**20:.1f} MiB")
    for name in ("descriptors", "threads"):
        numbers = sorted({getattr(each, name) for each in day.resources})
        if len(numbers) > 1:
            found.append(f"the number of {name} varies: {numbers}")
    return found


def section(day: Day, seed: int) -> str:
    """Return the section of the page."""
    first, last = day.resources[0], day.resources[-1]
    memory = [each.memory / 2**20 for each in day.resources]
    rows = [
        ("rows written", f"{day.rows}, one a second"),
        ("rows missing while the computer was suspended", f"{day.suspended}, as gaps of the times"),
        ("other rows missing, the computer being busy", f"{day.missed - day.suspended}, as gaps of the times"),
        ("rows in gaps", ", ".join(f"{name} {count}" for name, count in day.gap_rows.items())),
        ("gaps", ", ".join(f"{name} {count}" for name, count in day.gaps.items())),
        ("rows in gaps that no fault explains", str(day.unplanned)),
        ("rows that repeat the reading of the row before", str(day.repeated)),
        ("greatest age of a reading in a row", f"{day.oldest:.1f} s"),
        (
            "memory",
            f"{first.memory / 2**20:.1f} MiB after {first.time / 3600:.0f} h, {last.memory / 2**20:.1f} MiB after "
            f"{last.time / 3600:.0f} h ({100 * day.growth():+.1f} %), at most {max(memory):.1f} MiB",
        ),
        ("file descriptors", _range([each.descriptors for each in day.resources])),
        ("threads", _range([each.threads for each in day.resources])),
    ]
    lines = [
        "`errormotion monitor` watched two modules, a thermometer and a controller over TCP for "
        f"{day.duration / 3600:.1f} simulated hours, in {day.seconds / 60:.0f} minutes, with a fault every minute. "
        f"The clock of the monitor advances to the next deadline while all threads wait, and runs at {day.speed:g} "
        "times the rate of real time while an answer is awaited. The modules send the number of each reading as its "
        "temperature. The trial checks that each value in the log was sent shortly before its row and not after a "
        "later one, and that each row without a reading is marked by instrument and counted in the log, in run.json "
        "and in the report. Resources were counted every hour while all instruments answered.",
        "",
        "| fault | number |",
        "|---|---|",
        *(f"| {NAMES[kind]} | {count} |" for kind, count in sorted(day.faults.items())),
        "",
        "| result | |",
        "|---|---|",
        *(f"| {name} | {value} |" for name, value in rows),
        "",
    ]
    wrong = failures(day)
    lines += ["Failures:", "", *(f"* {text}" for text in wrong)] if wrong else ["No failure."]
    where = f"{platform.machine()}, Python {platform.python_version()}"
    return "\n".join([*lines, "", f"`make endurance`, seed {seed}, {where}."])


def _range(numbers: list[int]) -> str:
    low, high = min(numbers), max(numbers)
    return f"{low}, constant" if low == high else f"{low} to {high}"


def main() -> None:
    """Run the day and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=24.0, help="simulated")
    parser.add_argument("--speed", type=float, default=30.0, help="rate of the clock while an answer is awaited")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=PAGE)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="endurance") as folder:
        _, day = monitored_day.watch(Path(folder), options.hours, options.speed, options.seed)
    body = section(day, options.seed)
    print(body)
    write_section(options.out, TITLE, body)
    print(f"written to {options.out}")
    sys.exit(bool(failures(day)))


if __name__ == "__main__":
    main()
