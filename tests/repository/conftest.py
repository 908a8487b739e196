"""Every example in the README and the docs is executed as written, in the order of its page, in an empty folder.

``python`` blocks are executed; with ``>>>`` their output is compared. ``console`` blocks: each line that starts with
``$`` is run and must succeed, and its output is compared with the following lines (``...`` matches any text). A
``code-block`` with a ``:caption:`` is a file and is written. Other languages (``text``, ``sh``) are only shown.
``% skip: next`` skips one block. A page with ``% continues: OTHER.md`` runs after that page, with its files and names.

``make demo``, the first command of two pages, runs once: both use its output and a copy of its files. A call of
``errormotion`` runs in this process, which has already loaded its libraries, to save seconds for each command. Other
commands run in a shell, as do all commands of the README. The reports of how-to guides, which these do not show, have
empty figures: they are filled, but not printed. Plans of how-to guides, whose numbers these do not state, are searched
with a fifth of the evaluations. The pages are distributed to workers by files of tests.
"""

import doctest
import glob
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from command_line import CliRunner
from matplotlib.figure import Figure
from sybil import Document, Example
from sybil.parsers.myst import CodeBlockParser, PythonCodeBlockParser, SkipParser
from sybil.parsers.myst.lexers import DirectiveLexer
from sybil.region import Region

from errormotion.cli.app import app
from errormotion.instruments import simulators
from errormotion.methods.beam_direction.planning import design
from errormotion.methods.multilateration.planning import layout

ROOT = Path(__file__).parents[2]
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
SLOW = ("README.md", "docs/tutorial/", "docs/how-to/")
"""Pages that measure on virtual machines, one to twenty seconds each."""
SEARCHES = ((design, "_MAX_EVALUATIONS"), (layout, "_TRIED"), (layout, "_GLOBAL"), (layout, "_LOCAL"))
"""Numbers of evaluations of the searches for the best plan."""


def _line_of_make(command: str) -> str:
    """Return the command of ``make TARGET`` in the Makefile, to be run here instead of in the repository."""
    outside = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS", "ARGS"))}
    recipe = subprocess.run(
        ["make", "-n", "-s", *command.split()[1:]], cwd=ROOT, env=outside, capture_output=True, text=True, check=True
    ).stdout
    return recipe.splitlines()[-1].replace(".venv/bin/", "")


def _in_a_shell(command: str) -> tuple[int, str]:
    done = subprocess.run(
        command,
        shell=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        stdin=subprocess.DEVNULL,
        text=True,
    )
    return done.returncode, done.stdout


def _here(command: str) -> tuple[int, str]:
    """Run a call of errormotion in this process, and remove its simulated world as at the end of a process."""
    words = [name for word in shlex.split(command)[1:] for name in sorted(glob.glob(word)) or [word]]
    try:
        result = CliRunner().invoke(app, words)
    finally:
        simulators.reset()
    output = result.output
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        output += "".join(traceback.format_exception(result.exception))
    return result.exit_code, output


@cache
def _made(command: str) -> tuple[int, str, Path]:
    """Run a command in the current folder; return its exit code, its output and a folder with a copy of its files."""
    code, output = _in_a_shell(command)
    kept = Path(tempfile.mkdtemp(prefix="made-", dir=Path.cwd().parent))
    shutil.copytree(Path.cwd(), kept, dirs_exist_ok=True)
    return code, output, kept


def _run(command: str, page: Path) -> tuple[int, str]:
    if command.startswith("make "):
        command = _line_of_make(command)
        if any(Path.cwd().iterdir()):
            return _in_a_shell(command)
        code, output, kept = _made(command)
        shutil.copytree(kept, Path.cwd(), dirs_exist_ok=True)
        return code, output
    plain = re.match(r"errormotion [^|&;<>$`]*$", command)
    return _here(command) if plain and page.name != "README.md" else _in_a_shell(command)


def run_console(example: Example) -> str | None:
    """Run every ``$`` line of a console block; return the failures."""
    first, *parts = re.split(r"^\$ ", example.parsed, flags=re.MULTILINE)
    if first.strip() or not parts:
        return "A console block starts with '$ ' and a command."
    for part in parts:
        command, _, want = part.replace("\\\n", "").partition("\n")
        code, output = _run(command, Path(example.path))
        if code:
            return f"$ {command}\nended with exit code {code}:\n{output}"
        if want.strip() and not doctest.OutputChecker().check_output(want.strip(), output.strip(), FLAGS):
            return f"$ {command}\nshould print\n{want}\nbut printed\n{output}"
    return None


def captioned_files(document: Document) -> list[Region]:
    """Find the ``code-block`` directives with a caption: files of an example."""
    regions = []
    for region in DirectiveLexer("code-block")(document):
        if name := region.lexemes["options"].get("caption"):
            region.parsed = name, region.lexemes["source"]
            region.evaluator = write_file
            regions.append(region)
    return regions


def write_file(example: Example) -> None:
    """Write a captioned block into the current folder."""
    name, source = example.parsed
    Path(name).parent.mkdir(parents=True, exist_ok=True)
    Path(name).write_text(source)


def parse(page: Path) -> Document:
    """Return the page with its examples in order."""
    parsers = [PythonCodeBlockParser(doctest_optionflags=FLAGS), CodeBlockParser("console", run_console)]
    return Document.parse(str(page), *parsers, captioned_files, SkipParser())


def continues(page: Path) -> Path | None:
    """Return the page with the files and names that the examples of a page use."""
    found = re.search(r"^% continues: (\S+)$", page.read_text(), re.MULTILINE)
    return (page.parent / found[1]).resolve(strict=True) if found else None


def continuations(page: Path) -> list[Path]:
    """Return the pages that continue a page, directly or not."""
    others = [other for other in sorted(page.parent.glob("*.md")) if continues(other) == page]
    return [found for other in others for found in (other, *continuations(other))]


def home(page: Path) -> str:
    """Return the file of tests that runs a page; the files have similar durations."""
    if page.parent.name != "how-to":
        return "test_docs"
    return "test_docs_measuring" if page.stem.startswith(("measure-", "calibrate-")) else "test_docs_how_to"


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "documented" not in metafunc.fixturenames:
        return
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    file = Path(metafunc.module.__file__).stem
    mine = [page for page in pages if page.exists() and home(page) == file and list(parse(page))]
    names = {str(page.relative_to(ROOT)): page for page in mine if continues(page) is None}
    marks = {name: [pytest.mark.slow] if name.startswith(SLOW) else [] for name in names}
    metafunc.parametrize("documented", [pytest.param(names[name], id=name, marks=marks[name]) for name in names])


_PRINT = Figure.savefig


def _only_into_files(figure: Figure, target: Any, **how: Any) -> None:
    """Print a figure of an example; those of a report are printed into a text in memory."""
    if isinstance(target, io.StringIO):
        target.write("<svg></svg>")
    else:
        _PRINT(figure, target, **how)


@pytest.fixture
def examples() -> Callable[[Path], Document]:
    """Return the parser of pages."""
    return parse


@pytest.fixture
def run_examples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], None]:
    """Return a function that runs the examples of a page, and of those that continue it, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setenv("COLUMNS", "120")

    def run(page: Path) -> None:
        names: dict[str, Any] = {}
        if page.parent.name == "how-to":
            monkeypatch.setattr(Figure, "savefig", _only_into_files)
            for module, name in SEARCHES:
                monkeypatch.setattr(module, name, getattr(module, name) // 5)
        for one in (page, *continuations(page)):
            document = parse(one)
            document.namespace = names
            for example in document:
                example.evaluate()

    return run
