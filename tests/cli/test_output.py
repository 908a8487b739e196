"""Tables that fit the width of a terminal."""

import os
import shutil
import sys
import time

import pytest

from errormotion.cli import output
from errormotion.cli.output import table

HEAD = ("name", "value", "what it is")
ROWS = [("first", "12.5", "a sentence of many words that goes on"), ("second", "3", "short")]


@pytest.fixture
def width(monkeypatch: pytest.MonkeyPatch):
    def use(columns: int) -> None:
        monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
        monkeypatch.setattr(shutil, "get_terminal_size", lambda: os.terminal_size((columns, 24)))

    return use


def test_a_table_fits_the_width_and_is_complete(width) -> None:
    width(35)
    text = table(HEAD, ROWS)
    assert max(map(len, text.splitlines())) <= 35
    assert text.splitlines()[2] == "first    12.5  a sentence of many"
    assert " ".join(text.split()).count("that goes on") == 1


def test_a_wide_table_becomes_blocks_on_a_narrow_terminal(width) -> None:
    width(24)
    blocks = table(HEAD, ROWS).split("\n\n")
    assert blocks[1].splitlines() == ["name        second", "value       3", "what it is  short"]
    assert " ".join(blocks[0].split()).endswith("value 12.5 what it is a sentence of many words that goes on")


def test_numbers_and_a_pipe_are_not_wrapped(width) -> None:
    assert max(map(len, table(HEAD, ROWS).splitlines())) == len("second  12.5   " + ROWS[0][2]) - 1 + 1
    width(80)
    assert table(HEAD, ROWS).splitlines()[3] == "second      3  short"


def test_long_operations_are_announced_on_a_terminal_only(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def work(seconds: float) -> str:
        with output.working("Writing the report"):
            time.sleep(seconds)
        return capsys.readouterr().err

    monkeypatch.setattr(output, "NOTICE_DELAY", 0.02)
    assert work(0.2) == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert work(0.2) == "Writing the report ...\n"
    monkeypatch.setattr(output, "NOTICE_DELAY", 60.0)
    assert work(0.0) == ""
