"""Tables that fit the width of a terminal."""

import io
import json
import os
import shutil
import sys
import time
from pathlib import Path

import pytest
from rich.table import Table
from rich.text import Text

from errormotion.cli import main, output
from errormotion.cli.output import table
from errormotion.cli.terminal import Terminal

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


CONTROLS = "\x1b]0;title\x07 \x9b31m \x7f \u202e \udcff \r"
ESCAPES = r"\x1b]0;title\x07 \x9b31m \x7f \u202e \udcff \x0d"


def test_control_characters_are_printed_as_escapes(capsys) -> None:
    output.show(f"a\tb\n{CONTROLS}")
    output.show(CONTROLS, err=True)
    shown = capsys.readouterr()
    assert shown.out == f"a\tb\n{ESCAPES}\n"
    assert shown.err == f"{ESCAPES}\n"


def test_json_contains_no_control_characters_and_the_same_values(capsys) -> None:
    output.show_json({CONTROLS: CONTROLS})
    text = capsys.readouterr().out
    assert json.loads(text) == {CONTROLS: CONTROLS}
    assert not any(code in text for code in CONTROLS if code not in " ]0;title31m")


def test_what_rich_draws_contains_no_control_characters_of_others(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    terminal = Terminal()
    grid = Table(title=CONTROLS)
    grid.add_row(Text(CONTROLS))
    terminal.print(grid, f"loud {CONTROLS}", markup=False)
    assert stream.getvalue().count(r"\x1b]0;title") == 3  # rich itself omits the bell
    assert not any(code in stream.getvalue() for code in "\x1b\x07\x9b\x7f\u202e\r")


def test_a_name_in_a_file_cannot_control_the_terminal(tmp_path: Path, capfd) -> None:
    (tmp_path / "bench.toml").write_text('schema = "errormotion.bench/1"\n"\\u001b]0;x\\u0007" = 1\n')
    with pytest.raises(SystemExit):
        main(["bench", "validate", str(tmp_path / "bench.toml")])
    shown = capfd.readouterr()
    assert r"\x1b]0;x\x07" in shown.err
    assert "\x1b" not in shown.out + shown.err
