"""One value of a file that a person wrote is changed; everything else remains."""

import tomllib
from typing import Any

import pytest

from errormotion.datasets.files.tomltext import with_value
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
def test_what_cannot_be_changed_alone_is_refused(text: str, place: tuple[Any, ...]) -> None:
    with pytest.raises(DatasetError):
        with_value(text, place, 5)
