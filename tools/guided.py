"""Guided search: ``make guided`` finds inputs that execute new code in every codec and reader, and checks them.

The search is that of atheris (libFuzzer), which records the branches of the package that an input executes, and mutates
inputs with new branches further. It needs ``pip install atheris``, which is not a dependency. Compiled functions are
interpreted during the search, so that their branches are recorded. If atheris fails to instrument the code, a search in
this module replaces it, which records the steps from line to line. The found inputs are then read with compiled
functions and checked: only errors of the package, limits of time and memory. The inputs that add coverage to the valid
frames are the corpus in ``tests/data/corpus``, which ``make test`` reads. ``ARGS="--seconds 60 --only shdr"`` searches
longer, or selects targets; other rows of ``docs/reliability.md`` are not changed.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import json
import os
import platform
import random
import re
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests" / "support"), str(ROOT / "tools")]

TITLE = "Guided search"
TABLE = (
    "| read | inputs tried | steps reached by good ones | by all | corpus | slowest | largest memory | errors |",
    "|---|---|---|---|---|---|---|---|",
)
MAX_SAVED = 50
"""Failures, and slow inputs, of one search."""
SHOWN = 5
MANY = (100, 1000, 5000)
"""Repetitions of a character."""
MEMORY = 2000
"""Of the process of a search, MB."""


# ---------------------------------------------------------------------- in separate processes


def good(name: str, folder: Path) -> None:
    """Write the valid inputs into a folder, because some come from sessions with simulators, which take long."""
    import corpus

    (folder / "good").mkdir(exist_ok=True)
    for number, data in enumerate(corpus.TARGETS[name].seeds()):
        (folder / "good" / f"{number:03}").write_bytes(data)


def good_ones(folder: Path) -> list[bytes]:
    """Return the valid inputs."""
    return [path.read_bytes() for path in sorted((folder / "good").iterdir())]


def search(name: str, folder: Path, seconds: float) -> None:
    """Search from the valid inputs and the corpus; write new, failing and slow inputs to a folder."""
    import atheris

    with atheris.instrument_imports(include=["errormotion"]):
        import corpus
    import mutants

    from errormotion.errors import ErrormotionError

    target = corpus.TARGETS[name]
    limit = 10 * getattr(target, "limit", corpus.fuzzing.SLOWEST)  # for interpreted code with counters
    found, places = folder / "found", Counter[str]()
    found.mkdir()
    for number, data in enumerate([*good_ones(folder), *corpus.load(target)]):
        (found / f"good{number}").write_bytes(data)

    def save(data: bytes, why: str) -> None:
        places[why] += 1
        if places[why] == 1 and len(places) <= MAX_SAVED:
            (found / f"failure{len(places)}").write_bytes(data)

    def one(data: bytes) -> None:
        start = time.thread_time()
        try:
            target.read(data)
        except ErrormotionError:
            pass
        except Exception as error:  # noqa: BLE001 - it is judged later
            last = traceback.extract_tb(error.__traceback__)[-1]
            save(data, f"{type(error).__name__} {last.filename} {last.lineno}")
        if time.thread_time() - start > limit:
            save(data, f"slow {int(10 * random.random())}")

    def change(data: bytes, longest: int, seed: int) -> bytes:
        if seed % 2:
            return atheris.Mutate(data, longest)
        if seed % 32 == 0:  # nesting, and long numbers
            chance = random.Random(seed)
            place = chance.randrange(len(data) + 1)
            return (data[:place] + chance.choice((*mutants.TOKENS, b"9", b"a.")) * chance.choice(MANY))[:longest]
        return mutants.mutant(data, seed, 1, mutants.FRAME_CHANGES)[:longest]

    words = [f"-max_total_time={seconds:.0f}", f"-max_len={corpus.LONGEST}", f"-rss_limit_mb={MEMORY}", "-timeout=60"]
    atheris.Setup(["search", *words, "-seed=1", f"-artifact_prefix={folder}/", str(found)], one, custom_mutator=change)
    atheris.Fuzz()


def walk(name: str, folder: Path, seconds: float) -> None:
    """Search without atheris: mutate known inputs, and keep those with new steps or failures."""
    import corpus
    import mutants

    from errormotion.errors import ErrormotionError

    target, chance, steps = corpus.TARGETS[name], random.Random(1), set[corpus.Arc]()
    pool, tried, until = [*good_ones(folder), *corpus.load(target)], 0, time.monotonic() + seconds
    (folder / "found").mkdir(exist_ok=True)
    for number, data in enumerate(pool):
        steps |= corpus.reached(target.read, data)
        (folder / "found" / f"good{number}").write_bytes(data)
    while time.monotonic() < until:
        tried += 1
        data = mutants.mutant(chance.choice(pool), 1, tried, mutants.FRAME_CHANGES)[: corpus.LONGEST]
        error: list[BaseException] = []

        def read(data: bytes, error: list[BaseException] = error) -> None:
            try:
                target.read(data)
            except Exception as found:  # noqa: BLE001 - judged later
                error.append(found)

        new = corpus.reached(read, data) - steps
        if new or (error and not isinstance(error[0], ErrormotionError)):
            steps |= new
            pool.append(data)
            (folder / "found" / f"walk{tried}").write_bytes(data)
    print(f"Done {tried} runs", file=sys.stderr)


def measure(name: str, folder: Path) -> None:
    """Select the corpus from the found inputs, by their steps in the package."""
    import corpus

    target = corpus.TARGETS[name]
    known = set().union(*(corpus.reached(target.read, data) for data in good_ones(folder) for _ in range(2)))
    found = [path.read_bytes() for path in sorted((folder / "found").iterdir())]
    kept, more = corpus.smallest(target.read, found, known)
    corpus.store(target, kept)
    figures = {"good": len(known), "all": len(known | more), "kept": len(kept), "bytes": sum(map(len, kept))}
    (folder / "measured.json").write_text(json.dumps(figures))


def judge(name: str, folder: Path) -> None:
    """Read the found inputs within the limits."""
    import corpus

    target = corpus.TARGETS[name]
    for data in good_ones(folder):
        corpus.judge(target, data, memory=False)  # includes compilations at first use
    errors, faults, slowest, memory = Counter[str](), list[str](), 0.0, 0
    for path in sorted((folder / "found").iterdir()):
        data = path.read_bytes()
        judged = corpus.judge(target, data)
        slowest, memory = max(slowest, judged.seconds), max(memory, judged.memory)
        if judged.fault:
            faults.append(f"{judged.fault}; {data[:200]!r}")
            (folder / "faults").mkdir(exist_ok=True)
            (folder / "faults" / path.name).write_bytes(data)
        elif judged.error is not None:
            errors[type(judged.error).__name__] += 1
    figures = {"errors": errors, "faults": faults, "slowest": slowest, "memory": memory}
    (folder / "judged.json").write_text(json.dumps(figures))


# ---------------------------------------------------------------------- the programme


def run(stage: str, name: str, folder: Path, seconds: float = 0.0) -> str:
    """Run a stage in a separate process; return its output."""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "0" if stage in ("good", "judge") else "1"}
    words = [sys.executable, __file__, "--stage", stage, "--only", name, "--folder", folder, "--seconds", str(seconds)]
    ended = subprocess.run(
        words, env=environment, cwd=ROOT, capture_output=True, text=True, errors="replace", check=False,
        timeout=10 * seconds + 1200,
    )  # fmt: skip
    if ended.returncode:
        raise RuntimeError(f"{stage} of {name} ended with {ended.returncode}: {ended.stderr[-2000:]}")
    return ended.stderr


def row(name: str, tried: int, figures: dict[str, Any]) -> str:
    """Return a row of the table."""
    errors = ", ".join(f"{error} {count}" for error, count in Counter(figures["errors"]).most_common()) or "none"
    cells = (
        *(name, f"{tried}", f"{figures['good']}", f"{figures['all']}"),
        f"{figures['kept']}, {figures['bytes']} bytes",
        *(f"{1e3 * figures['slowest']:.2f} ms", f"{figures['memory'] / 1024:.0f} KiB", errors),
    )
    return f"| {' | '.join(cells)} |"


def guided(name: str, seconds: float, keep: Path | None) -> tuple[str, list[str]]:
    """Search one target; return its row and the failures."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) if keep is None else keep / re.sub(r"\W+", "_", name)
        folder.mkdir(parents=True, exist_ok=True)
        run("good", name, folder)
        try:
            said = run("search", name, folder, seconds)
        except RuntimeError as ended:  # with Python 3.11, atheris cannot instrument a few functions
            said = run("walk", name, folder, seconds)
            print(f"{name}: without atheris, which failed: {str(ended)[-300:]}", file=sys.stderr)
        tried = re.search(r"^Done (\d+) runs", said, re.MULTILINE)
        run("judge", name, folder)
        run("measure", name, folder)
        figures = json.loads((folder / "measured.json").read_text()) | json.loads((folder / "judged.json").read_text())
        return row(name, int(tried[1]) if tried else 0, figures), figures["faults"][:SHOWN]


def section(rows: dict[str, str], failures: list[str], seconds: float, version: str) -> str:
    """Return the section of the page from the rows by name."""
    from corpus import LONGEST
    from file_readers import LIMIT
    from file_readers import MEMORY as OF_FILES
    from fuzzing import SLOWEST

    tried = sum(int(text.split("|")[2]) for text in rows.values())
    lines = [
        f"{tried} inputs of {len(rows)} codecs and readers of files, chosen by a search that records the branches of "
        f"the package that each of them executes (atheris {version}, up to {LONGEST} bytes). Each input that executed "
        "a new branch, failed, or was slow was then read again and measured: only errors of the package, "
        f"{1e3 * SLOWEST:.0f} ms of processor time and the memory stated above for a frame, {1e3 * LIMIT:.0f} ms (a "
        f"log: 200 ms) and {OF_FILES >> 20} MiB for a file. A step is a pair of successively executed lines of the "
        "package; the corpus in `tests/data/corpus` contains the inputs with steps of no valid input, and `make "
        "test` reads it.",
        "",
        *TABLE,
        *rows.values(),
        "",
        *(["Failures:", "", *failures] if failures else ["No failure."]),
        "",
        f"`make guided`, {seconds:.0f} s for each, {platform.machine()}, Python {platform.python_version()}.",
    ]
    return "\n".join(lines)


def write(page: Path, names: list[str], new: dict[str, str], faults: dict[str, list[str]], seconds: float) -> None:
    """Replace the rows of the searched targets; others are not changed."""
    from fuzz import sections, write_section

    body = sections(page)[1].get(TITLE, "").splitlines()
    rows = {line[2:].partition(" |")[0]: line for line in body if line.startswith("| ")} | new
    kept = [line for line in body if line.startswith("* ") and not any(line.startswith(f"* {name}: `") for name in new)]
    failures = [f"* {name}: `{text}`" for name, texts in faults.items() for text in texts]
    version = importlib.metadata.version("atheris") if importlib.util.find_spec("atheris") else "not installed"
    stated = {name: rows[name] for name in names if name in rows}
    write_section(page, TITLE, section(stated, [*kept, *failures], seconds, version))


def main() -> None:
    """Search, print each row, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=15.0, help="of the search in each target")
    parser.add_argument("--only", default="", help="targets whose name this regular expression finds")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--keep", type=Path, default=None, help="folder for all that is found")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "reliability.md")
    parser.add_argument(
        "--stage", default="", choices=["", "good", "search", "walk", "measure", "judge"], help=argparse.SUPPRESS
    )
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.stage in ("search", "walk"):
        {"search": search, "walk": walk}[options.stage](options.only, options.folder, options.seconds)
    elif options.stage:
        {"good": good, "measure": measure, "judge": judge}[options.stage](options.only, options.folder)
    if options.stage:
        return
    if importlib.util.find_spec("atheris") is None:
        parser.exit(1, "expected atheris: pip install atheris (Linux and macOS, Python 3.11 to 3.13)\n")
    from corpus import TARGETS

    chosen = [name for name in TARGETS if re.search(options.only, name)]
    if not chosen:
        parser.error(f"expected a part of a name: {', '.join(TARGETS)}")
    failed = False
    with ThreadPoolExecutor(options.processes) as pool:
        waiting = [pool.submit(guided, name, options.seconds, options.keep) for name in chosen]
        for name, each in zip(chosen, waiting, strict=True):
            try:
                text, faults = each.result()
            except RuntimeError as error:
                failed = True
                print(f"{name}: {error}", flush=True)
                continue
            failed = failed or bool(faults)
            write(options.out, list(TARGETS), {name: text}, {name: faults}, options.seconds)
            print(text, flush=True)
            for fault in faults:
                print(f"    {fault}", flush=True)
    print(f"written to {options.out}")
    sys.exit(failed)


if __name__ == "__main__":
    main()
