"""Examples of the README, the tutorial, the explanations and the reference; wrong examples are detected.

How examples are written and run: see conftest.py.
"""

from collections.abc import Callable
from pathlib import Path

import pytest
from sybil import Document

Run = Callable[[Path], None]


@pytest.mark.timeout(400)
def test_examples_run_as_written(documented: Path, run_examples: Run) -> None:
    run_examples(documented)


@pytest.fixture
def page(tmp_path: Path) -> Path:
    return tmp_path / "page.md"


@pytest.mark.parametrize(
    "text",
    [
        "```console\n$ false\n```\n",
        "```console\n$ echo one\ntwo\n```\n",
        "```console\n$ errormotion validate nothing.toml\n```\n",
        "```console\n$ errormotion plugins list\nnone\n```\n",
        "```python\nraise ValueError\n```\n",
        "```python\n>>> 1 + 1\n3\n```\n",
        "```{code-block} toml\n:caption: a/b.toml\nx = 1\n```\n\n```console\n$ cat a/b.toml\nx = 2\n```\n",
    ],
)
def test_a_wrong_example_is_detected(page: Path, run_examples: Run, text: str) -> None:
    page.write_text(text)
    with pytest.raises((AssertionError, ValueError)):
        run_examples(page)


def test_examples_of_a_page_share_names_and_files(
    page: Path, run_examples: Run, examples: Callable[[Path], Document]
) -> None:
    page.write_text(
        "```{code-block} toml\n:caption: b.toml\nx = 1\n```\n\n```console\n$ cat b.toml\nx ... 1\n```\n\n"
        "```python\nnumber = 2\n```\n\n```python\n>>> number\n2\n```\n\n% skip: next\n\n```console\n$ false\n```\n"
    )
    assert len(list(examples(page))) == 6
    run_examples(page)


def test_a_page_that_continues_another_has_its_files_and_names(
    page: Path, run_examples: Run, examples: Callable[[Path], Document]
) -> None:
    page.write_text("```{code-block} toml\n:caption: b.toml\nx = 1\n```\n\n```python\nnumber = 2\n```\n")
    second, third = page.with_name("second.md"), page.with_name("third.md")
    second.write_text("% continues: page.md\n\n```console\n$ cat b.toml\nx = 1\n```\n\n```python\nnumber += 1\n```\n")
    third.write_text("% continues: second.md\n\n```python\n>>> number\n3\n```\n")
    run_examples(page)
    third.write_text("% continues: second.md\n\n```python\n>>> number\n2\n```\n")
    with pytest.raises(AssertionError):
        run_examples(page)
