"""Every example in the README and the docs runs as written, from top to bottom of its page, in an empty folder.

``python`` blocks are executed; with ``>>>`` their output is compared. ``console`` blocks: each line that starts with
``$`` is run, must succeed, and what follows it is compared with what it prints (``...`` stands for anything). A
``code-block`` with a ``:caption:`` is a file and is written. Other languages (``text``, ``sh``) are only shown.
``% skip: next`` leaves out one block.
"""

import doctest
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from sybil import Document, Example
from sybil.parsers.myst import CodeBlockParser, PythonCodeBlockParser, SkipParser
from sybil.parsers.myst.lexers import DirectiveLexer
from sybil.region import Region

ROOT = Path(__file__).parents[2]
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def _shell(command: str) -> str:
    """Return the command to run: ``make TARGET`` becomes what the Makefile does, here instead of in the repository."""
    if not command.startswith("make "):
        return command
    outside = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))}
    recipe = subprocess.run(
        ["make", "-n", "-s", *command.split()[1:]], cwd=ROOT, env=outside, capture_output=True, text=True, check=True
    ).stdout
    return recipe.splitlines()[-1].replace(".venv/bin/", "")


def run_console(example: Example) -> str | None:
    """Run every ``$`` line of a console block; return what went wrong."""
    first, *parts = re.split(r"^\$ ", example.parsed, flags=re.MULTILINE)
    if first.strip() or not parts:
        return "A console block starts with '$ ' and a command."
    for part in parts:
        command, _, want = part.replace("\\\n", "").partition("\n")
        done = subprocess.run(
            _shell(command),
            shell=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            text=True,
        )
        if done.returncode:
            return f"$ {command}\nended with exit code {done.returncode}:\n{done.stdout}"
        if want.strip() and not doctest.OutputChecker().check_output(want.strip(), done.stdout.strip(), FLAGS):
            return f"$ {command}\nshould print\n{want}\nbut printed\n{done.stdout}"
    return None


def captioned_files(document: Document) -> list[Region]:
    """Find the ``code-block`` directives with a caption: files that the reader is asked to write."""
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


def run(page: Path) -> None:
    """Run the examples of a page in order, in the current folder."""
    for example in parse(page):
        example.evaluate()


PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
WITH_EXAMPLES = [page for page in PAGES if page.exists() and list(parse(page))]


@pytest.mark.timeout(400)
@pytest.mark.parametrize("page", [pytest.param(page, id=str(page.relative_to(ROOT))) for page in WITH_EXAMPLES])
def test_examples_run_as_written(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setenv("COLUMNS", "120")
    run(page)


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path / "page.md"


@pytest.mark.parametrize(
    "text",
    [
        "```console\n$ false\n```\n",
        "```console\n$ echo one\ntwo\n```\n",
        "```python\nraise ValueError\n```\n",
        "```python\n>>> 1 + 1\n3\n```\n",
        "```{code-block} toml\n:caption: a/b.toml\nx = 1\n```\n\n```console\n$ cat a/b.toml\nx = 2\n```\n",
    ],
)
def test_an_example_that_is_wrong_is_noticed(page: Path, text: str) -> None:
    page.write_text(text)
    with pytest.raises((AssertionError, ValueError)):
        run(page)


def test_examples_of_a_page_build_on_one_another(page: Path) -> None:
    page.write_text(
        "```{code-block} toml\n:caption: b.toml\nx = 1\n```\n\n```console\n$ cat b.toml\nx ... 1\n```\n\n"
        "```python\nnumber = 2\n```\n\n```python\n>>> number\n2\n```\n\n% skip: next\n\n```console\n$ false\n```\n"
    )
    assert len(list(parse(page))) == 6
    run(page)
