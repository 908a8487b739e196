"""Damaged frames of every codec: ``make fuzz`` tries them, and writes a section of ``docs/reliability.md``.

``make fuzz ARGS="--frames 1e5 --only shdr"`` changes the number of frames, or selects codecs; other rows are not
changed. A row is written when its codec is complete. A row with the same number of frames and the same code, without
failures, is not computed again (except with ``--again``), so that an interrupted run can be continued. Codecs and
valid frames are those of ``tests/support/wire_codecs.py``; a failure is reproduced with the seed and the number of its
mutant.
"""

from __future__ import annotations

import argparse
import hashlib
import inspect
import multiprocessing
import os
import platform
import re
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests" / "support"))

import fuzzing  # noqa: E402
from wire_codecs import CODECS  # noqa: E402

from errormotion import plugins  # noqa: E402
from errormotion.instruments.transports.base import PIECE  # noqa: E402

PAGE = ROOT / "docs" / "reliability.md"
TITLE = "Damaged frames"
PART = 25_000
"""Frames of one task."""
HEADING = """\
# Reliability

All figures on this page are results of runs.
"""
TABLE = (
    "| codec | frames | slowest frame | slowest piece | largest memory | longest frame | errors | code |",
    "|---|---|---|---|---|---|---|---|",
)
INSTRUMENTS = "errormotion/instruments"
OF_PROGRAMME = tuple(f"tests/support/{name}.py" for name in ("fuzzing", "mutants"))
SAME_FOR_ALL = (f"{INSTRUMENTS}/transports/**/*.py", f"{INSTRUMENTS}/*.py", *OF_PROGRAMME)
"""Files on which all rows depend."""


def tasks(codecs: Sequence[int], frames: int) -> Iterator[tuple[int, int, int]]:
    """Yield codec, first and last number of the mutants."""
    for codec in codecs:
        for start in range(0, frames, PART):
            yield codec, start, min(start + PART, frames)


def work(task: tuple[int, int, int]) -> tuple[int, fuzzing.Found]:
    """Try the mutants of one task."""
    codec, start, end = task
    return codec, fuzzing.fuzz(CODECS[codec], range(start, end))


@cache
def code_of(codec: fuzzing.Codec) -> str:
    """Return a checksum of the files of a row: the code of all instruments of the kind, its reader, valid frames."""
    device = codec.device.partition(" ")[0]
    patterns = [*SAME_FOR_ALL, f"tests/data/vectors/{device}.toml"]
    for plugin in plugins.available("instruments"):
        if plugin.id == device:
            kind = plugin.entry_point.value.removeprefix(INSTRUMENTS.replace("/", ".") + ".").partition(".")[0]
            patterns.append(f"{INSTRUMENTS}/{kind}/**/*.py")
    total = hashlib.sha256(inspect.getsource(codec.read).encode())
    for path in sorted({path for pattern in patterns for path in ROOT.glob(pattern)}):
        total.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes())
    return total.hexdigest()[:10]


def row(codec: fuzzing.Codec, found: fuzzing.Found) -> str:
    """Return a row of the table."""
    errors = ", ".join(f"{name} {count}" for name, count in found.errors.most_common()) or "none"
    cells = (
        codec.name,
        f"{found.frames}",
        f"{1e3 * found.slowest:.2f} ms",
        f"{1e3 * found.slowest_piece:.2f} ms, {found.size_piece} bytes",
        f"{found.memory / 1024:.0f} KiB",
        f"{codec.longest} bytes",
        errors,
        f"`{code_of(codec)}`",
    )
    return f"| {' | '.join(cells)} |"


def _exceptions() -> str:
    named = [f"{each.name}: {each.per_byte}" for each in CODECS if each.per_byte != fuzzing.MEMORY_PER_BYTE]
    return f" ({', '.join(named)})" if named else ""


def section(rows: Mapping[str, str], failures: Sequence[str]) -> str:
    """Return the section of the page from the rows of the table by codec."""
    frames = sum(int(text.split("|")[2]) for text in rows.values())
    lines = [
        f"{frames} damaged frames of {len(rows)} codecs: bits and bytes changed, stretches cut, repeated, exchanged "
        "and inserted, numbers replaced by unusual ones, wrong lengths and counts. Each frame must be read, or "
        f"refused with an error of the package, within {1e3 * fuzzing.SLOWEST:.0f} ms of processor time and within "
        f"{fuzzing.OWN_MEMORY >> 10} KiB of memory and {fuzzing.MEMORY_PER_BYTE} bytes for each byte of the longest "
        f"tried frame{_exceptions()}. One in {fuzzing.LENGTHENED} was lengthened to the longest frame, or to 64 KiB "
        f"with up to several thousand frames; it is received in pieces of up to {PIECE >> 10} KiB, as from a "
        f"connection, and the same limit applies to each piece. Memory was measured with one in {fuzzing.SAMPLED}. "
        "Good frames are the golden vectors, frames of the codecs themselves and of the simulators.",
        "",
        *TABLE,
        *rows.values(),
        "",
        "A document or file may be longer than a piece, up to the length in the table. It is read when it is "
        "complete, so that the time increases with its length; it was tried up to "
        f"{', '.join(f'{each.tried >> 10} KiB ({each.name})' for each in CODECS if each.tried < each.longest)}. "
        "`InstrumentTimeoutError`: the frame was incomplete. The code is a checksum of the files on which the row "
        "depends.",
        "",
        *(["Failures:", "", *failures] if failures else ["No failure."]),
        "",
        f"`make fuzz`, seed 1, {platform.machine()}, Python {platform.python_version()}.",
        "",
        "The conformance kit tries complete drivers: it records a session with the simulated device and replays it "
        "with damaged frames ([Check a plugin](how-to/check-a-plugin.md)). Imported files have similar tests.",
    ]
    return "\n".join(lines)


def sections(page: Path) -> tuple[str, dict[str, str]]:
    """Return the introduction of the page and its sections by title."""
    text = page.read_text(encoding="utf-8") if page.exists() else HEADING
    head, *parts = re.split(r"^## (.+)\n", text, flags=re.MULTILINE)
    return head, {name: part.strip("\n") for name, part in zip(parts[::2], parts[1::2], strict=True)}


def write_section(page: Path, title: str, body: str) -> None:
    """Replace one section of the page."""
    head, found = sections(page)
    found[title] = body
    text = "".join(f"\n## {name}\n\n{part}\n" for name, part in found.items())
    page.write_text(head.rstrip("\n") + "\n" + text, encoding="utf-8")


def updated(body: str, results: Sequence[tuple[fuzzing.Codec, fuzzing.Found]]) -> str:
    """Return the section with the rows and failures of these codecs; others are not changed."""
    names = [codec.name for codec in CODECS]
    before = {line[2:].partition(" |")[0]: line for line in body.splitlines() if line.startswith("| ")}
    rows = before | {codec.name: row(codec, found) for codec, found in results}
    tried = {codec.name for codec, _ in results}
    kept = [
        line for line in body.splitlines() for name in names if line.startswith(f"* {name}: ") and name not in tried
    ]
    failures = [f"* {codec.name}: `{text}`" for codec, found in results for text in found.failures]
    return section({name: rows[name] for name in names if name in rows}, [*kept, *failures])


def is_done(body: str, codec: fuzzing.Codec, frames: int) -> bool:
    """Whether the section has a row with this number of frames of the present code, without failures."""
    for line in body.splitlines():
        cells = [each.strip() for each in line.strip("| ").split("|")]
        if cells[0] == codec.name and len(cells) == TABLE[1].count("---"):
            same = cells[-1] == f"`{code_of(codec)}`"
            return same and int(cells[1]) >= frames and f"* {codec.name}: " not in body
    return False


def write(page: Path, title: str, results: Sequence[tuple[fuzzing.Codec, fuzzing.Found]]) -> None:
    """Replace the rows of a section of the page."""
    write_section(page, title, updated(sections(page)[1].get(title, ""), results))


def main() -> None:
    """Try the codecs, print the table, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=lambda text: int(float(text)), default=1_000_000, help="of each codec")
    parser.add_argument("--only", default="", help="codecs whose name this regular expression finds; other rows stay")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--again", action="store_true", help="also codecs whose row is up to date")
    parser.add_argument("--out", type=Path, default=PAGE)
    options = parser.parse_args()
    chosen = [number for number, codec in enumerate(CODECS) if re.search(options.only, codec.name)]
    if not chosen:
        parser.error(f"expected a part of a name: {', '.join(codec.name for codec in CODECS)}")
    body = sections(options.out)[1].get(TITLE, "")
    if not options.again:
        chosen = [number for number in chosen if not is_done(body, CODECS[number], options.frames)]
    found = {number: fuzzing.Found() for number in chosen}
    start, failed = time.monotonic(), False
    with multiprocessing.get_context("spawn").Pool(options.processes) as pool:
        for number, part in pool.imap_unordered(work, tasks(chosen, options.frames)):
            found[number] += part
            if found[number].frames < options.frames:
                continue
            write(options.out, TITLE, [(CODECS[number], found[number])])  # so that an interrupted run has this row
            failed = failed or bool(found[number].failures)
            print(row(CODECS[number], found[number]), f"{time.monotonic() - start:.0f} s", flush=True)
            for text in found[number].failures:
                print(f"    {text}", flush=True)
    print(f"written to {options.out}")
    sys.exit(failed)


if __name__ == "__main__":
    main()
