"""Numbers in text files."""

import time

import pytest

from errormotion.datasets.tables.numbers import NUMBER


@pytest.mark.parametrize("end", ["", ".", "x", ".5x", "e", "e+", ".5e5x"])
def test_a_long_text_is_checked_in_time_proportional_to_its_length(end: str) -> None:
    text = "9" * 50_000 + end
    start = time.process_time()
    assert bool(NUMBER.fullmatch(text)) == (end in ("", "."))
    assert time.process_time() - start < 0.5  # a square law takes 10 s
