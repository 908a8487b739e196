"""Messages on files of users: similar mistakes in one line, suggestions for units."""

import pytest

from errormotion.datasets.files import tomlfile
from errormotion.datasets.units import KINDS, LENGTH, SPEED, TIME


def test_similar_mistakes_are_one_line_with_their_count() -> None:
    mistakes = ["a.x: missing", "b[0].x: missing", "c: expected 1; found 2", "Not a key: text", "Not a key: text"]
    text = tomlfile.report("f.toml", mistakes)
    assert text.splitlines() == [
        "f.toml: 5 mistakes",
        "  - a.x, b[0].x: missing",
        "  - c: expected 1; found 2",
        "  - Not a key: text",
    ]
    assert tomlfile.single("a.x, b[0].x: missing") == mistakes[:2]
    assert tomlfile.single("Not a key, at all: text") == ["Not a key, at all: text"]


@pytest.mark.parametrize(
    ("quantity", "text", "meant"),
    [(LENGTH, "5 m m", "'mm'"), (LENGTH, "5 MM", "'mm'"), (TIME, "3 mins.", "'min'"), (SPEED, "15000 /mn", "'/min'")],
)
def test_an_unknown_unit_is_reported_with_a_suggestion(quantity, text, meant) -> None:
    with pytest.raises(ValueError, match="did you mean") as refused:
        quantity.parse(text)
    assert meant in str(refused.value).partition("did you mean ")[2]


def test_a_suggested_unit_is_valid() -> None:
    from errormotion.datasets.units import _USUAL

    for quantity in KINDS:
        for unit in _USUAL[quantity.unit]:
            assert isinstance(quantity.parse(f"1 {unit}"), float)
