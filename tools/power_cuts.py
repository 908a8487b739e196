"""A thousand simulated power cuts: ``make power`` tries them, and writes a section of ``docs/reliability.md``.

A program writes each kind of file, while all that it does to its folder is recorded: new contents, changes of names,
flushes of files and of folders. A trial takes a random instant, makes a folder that the disk may then contain, and
reads it; see ``tests/support/power_cuts.py``. ``ARGS="--cuts 5000 --seed 2"`` tries others.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests" / "support"), str(ROOT / "tools")]

from fuzz import PAGE, write_section  # noqa: E402
from power_trials import KINDS, Trials, try_cuts  # noqa: E402

TITLE = "Power cuts"
TEXT = """\
{cuts} simulated power cuts. A program wrote each kind of file, and all that it did to its folder was recorded. A cut
follows a random operation. What was flushed to the disk before (`fsync` of the file, and of its folder for its name) is
there. Of the rest nothing is there, or all, or a part that POSIX allows: a file has its old or its new content, one
between, or a mixture of sectors of 512 bytes; each change of a name has happened or not, in any order. A trial is
passed if all that the program had stated to be committed is read with its values, if no incomplete file is read, and
if a raw store, notes and a Monte Carlo evaluation are continued."""


def section(found: dict[str, Trials], seed: int, seconds: float) -> str:
    """Return the section of the page."""
    lines = [
        TEXT.format(cuts=sum(trials.cuts for trials in found.values())),
        "",
        "| kind of file | operations | cuts | after a commit | with something unflushed lost | committed data lost |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {KINDS[kind].title} | {trials.operations} | {trials.cuts} | {trials.committed} | {trials.lossy} | "
        f"{len(trials.faults)} |"
        for kind, trials in found.items()
    ]
    faults = [f"* {text[:400]}" for trials in found.values() for text in trials.faults]
    lines += ["", *(["Failures:", "", *faults] if faults else ["No failure."])]
    return "\n".join([*lines, "", f"`make power`, seed {seed}, {seconds:.0f} s."])


def main() -> None:
    """Try the cuts, print the counts of each kind, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cuts", type=int, default=1000, help="number of power cuts")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=PAGE)
    options = parser.parse_args()
    start, whole = time.monotonic(), sum(kind.share for kind in KINDS.values())
    found = {}
    with tempfile.TemporaryDirectory(prefix="power") as folder:
        for name, kind in KINDS.items():
            count = -(-options.cuts * kind.share // whole)
            found[name] = trials = try_cuts(name, Path(folder) / name, int(count), options.seed)
            print(f"{name}: {trials.cuts} cuts, {len(trials.faults)} faults {trials.faults[:3]}", flush=True)
    write_section(options.out, TITLE, section(found, options.seed, time.monotonic() - start))
    sys.exit(any(trials.faults for trials in found.values()))


if __name__ == "__main__":
    main()
