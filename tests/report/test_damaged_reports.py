"""Reports of altered error datasets: a page, or a message that names the file."""

from contextlib import suppress
from pathlib import Path

import damaged
import mutants
import pytest
from coded import raises

from errormotion import datasets
from errormotion.errors import ErrormotionError
from errormotion.report import write_report

GOOD = sorted((Path(__file__).parents[1] / "data" / "datasets").glob("*.nc"))


@pytest.mark.parametrize("file", GOOD, ids=lambda file: file.stem)
def test_altered_error_datasets(tmp_path: Path, file: Path) -> None:
    good = datasets.load(file).load()
    for k in range(mutants.count(3)):
        try:
            with suppress(ErrormotionError):
                write_report(damaged.dataset(good, k), tmp_path / "report.html")
        except Exception as error:
            error.add_note(f"change {k} of {file.name}")
            raise


def test_change_that_the_schema_allows_but_the_chapter_does_not(tmp_path: Path) -> None:
    good = datasets.load(next(file for file in GOOD if file.stem == "beam_direction")).load()
    other = damaged.dataset(good, 2)
    datasets.validate(other)
    with raises("report.chapter.failed"):
        write_report(other, tmp_path / "report.html")
    assert not (tmp_path / "report.html").exists()
