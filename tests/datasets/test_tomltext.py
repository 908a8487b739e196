"""One value of a file is changed; the remaining text is unchanged."""

import tomllib
from typing import Any

import pytest

from errormotion.datasets.files.tomltext import with_table, with_value, without_table
from errormotion.errors import DatasetError

TEXT = """\
# head
name = "x" # c
[[test]]
name = "a"   # first
settings = { duration = "1 min", average = "4 s" } # inline
[[test]]
name = "b"

[test.settings]
duration = "61 min"   # ISO # 230
schedule = [  # s
    { at = "0 s", spindle_speed = "15000 /min" },
    { at = "61 min" }, # x
]
layout.noise = "1 um"
# tail
[[test]]
name = "c"
"""


@pytest.mark.parametrize(
    ("place", "content", "old", "new"),
    [
        (("name",), "y", 'name = "x" # c', 'name = "y" # c'),
        (("operator",), 'a "b"', '[[test]]\nname = "a"', 'operator = "a \\"b\\""\n[[test]]\nname = "a"'),
        (("test", 0, "settings", "duration"), "2 min", '"1 min"', '"2 min"'),
        (("test", 0, "settings", "duration"), None, 'duration = "1 min", ', ""),
        (("test", 1, "settings", "duration"), "2 min", '"61 min"   #', '"2 min"   #'),
        (("test", 1, "settings", "duration"), None, 'duration = "61 min"   # ISO # 230\n', ""),
        (("test", 1, "settings", "layout", "rate"), "2 kHz", "# tail", 'layout.rate = "2 kHz"\n# tail'),
        (("test", 2, "settings", "steps"), 3, 'name = "c"\n', 'name = "c"\n[test.settings]\nsteps = 3\n'),
        (("test", 2, "settings", "steps"), None, "", ""),
        (("tables", "a b", "c"), 1, 'name = "c"\n', 'name = "c"\n[tables."a b"]\nc = 1\n'),
    ],
)
def test_one_value_is_changed_and_nothing_else(place: tuple[Any, ...], content: Any, old: str, new: str) -> None:
    assert with_value(TEXT, place, content) == TEXT.replace(old, new, 1)


def test_an_array_over_several_lines_is_one_value() -> None:
    changed = with_value(TEXT, ("test", 1, "settings", "schedule"), [{"at": "1 s"}])
    assert 'schedule = [{ at = "1 s" }]\nlayout.noise' in changed
    assert tomllib.loads(changed)["test"][1]["settings"]["duration"] == "61 min"


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("a = ", ("a",)),
        ("[[a]]\nb = 1\n[[a]]\nb = 2\n", ("a",)),
        ("a = 1", ("a", "b")),
        ("a = [1]", ("a", 3)),
        ("a = 1" + " " * 70_000, ("a",)),
    ],
)
def test_a_value_that_cannot_be_changed_separately_is_refused(text: str, place: tuple[Any, ...]) -> None:
    with pytest.raises(DatasetError):
        with_value(text, place, 5)


def test_a_table_is_added_at_the_end() -> None:
    assert with_table(TEXT, "test", {"name": "d"}) == TEXT + '\n[[test]]\nname = "d"\n'
    assert with_table("a = 1", "test", {"name": "d"}) == 'a = 1\n\n[[test]]\nname = "d"\n'
    assert with_table("", "test", {"name": "d"}) == '[[test]]\nname = "d"\n'


@pytest.mark.parametrize("number", [0, 1, 2])
def test_a_table_is_removed_with_those_in_it_and_nothing_else(number: int) -> None:
    changed = without_table(TEXT + "[report]\nlanguage = 'de' # r\n", "test", number)
    kept = tomllib.loads(TEXT)
    del kept["test"][number]
    assert tomllib.loads(changed) == kept | {"report": {"language": "de"}}
    assert [mark in changed for mark in ("# head", "# first", "# ISO # 230", "# tail", "# r")] == [
        True, number != 0, number != 1, True, True,
    ]  # fmt: skip


def test_the_last_table_can_be_removed() -> None:
    assert without_table('a = 1\n\n[[test]]\nname = "d"\n', "test", 0) == "a = 1\n\n"


@pytest.mark.parametrize("text", ["test = [{ a = 1 }]", "test = 1", "a = 1", "[[test]]\n", "a = "])
def test_tables_in_another_form_are_refused(text: str) -> None:
    with pytest.raises(DatasetError):
        without_table(text, "test", 1)
    if "[[" not in text and text != "a = 1":
        with pytest.raises(DatasetError):
            with_table(text, "test", {"a": 2})
