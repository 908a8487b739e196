from pathlib import Path
from typing import Annotated, Literal

import pytest
from coded import raises
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from errormotion.datasets.files import tomlfile
from errormotion.datasets.units import Length, Time
from errormotion.errors import BenchError


class Table(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Measurement(Table):
    name: str
    procedure: Literal["drift", "beam_detection"] = "drift"
    average: Annotated[Time, Field(gt=0)] = 0.5
    repeats: int = 1

    @model_validator(mode="after")
    def _not_both(self) -> "Measurement":
        if self.procedure == "drift" and self.repeats > 1:
            raise ValueError("a drift is measured once; set repeats = 1")
        return self


class Serial(Table):
    kind: Literal["serial"]
    port: str


class Tcp(Table):
    kind: Literal["tcp"]
    host: str


class File(Table):
    schema_: Literal["errormotion.example/1"] = Field(alias="schema")
    bar_radius: Length = Field(gt=0)
    test: list[Measurement] = []
    origin: tuple[Length, Length, Length] | None = None
    sensors: dict[str, Measurement] = {}
    link: Annotated[Serial | Tcp, Field(discriminator="kind")] | None = None
    note: str = ""

    @field_validator("note")
    @classmethod
    def _short(cls, note: str) -> str:
        if len(note) > 5:
            raise ValueError("expected at most 5 letters")
        return note


@pytest.fixture
def write(tmp_path: Path):
    def write(text: str | bytes) -> Path:
        path = tmp_path / "bench.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def complaints(path: Path) -> list[str]:
    with pytest.raises(BenchError) as caught:
        tomlfile.load_model(path, File, error=BenchError)
    return str(caught.value).split("\n  - ")


def test_a_valid_file_is_read_as_a_model_in_si(write) -> None:
    text = 'schema = "errormotion.example/1"\nbar_radius = "5 mm"\n[[test]]\nname = "a"\naverage = "2 min"\n'
    found = tomlfile.load_model(write("\ufeff" + text), File)
    assert (found.bar_radius, found.test[0].average) == (0.005, 120.0)


def test_every_mistake_is_reported_with_file_key_expected_and_found(write) -> None:
    path = write("""
        schema = "errormotion.example/1"
        bar_radius = 5
        origin = ["1 mm", 2, "3 s"]
        note = "far too long"
        [[test]]
        name = 7
        procedure = "drfit"
        averge = "1 s"
        [[test]]
        name = "b"
        average = "-1 s"
        repeats = 1.5
        [sensors.left]
        average = "1 s"
        [link]
        kind = "tcp"
        hosts = "h"
    """)
    head, *found = complaints(path)
    assert head == f"{path}: 12 mistakes"
    assert found == [
        "bar_radius: expected a length with its unit, such as '5 mm'; found 5",
        "test[0].name: expected a string in quotes; found 7",
        "test[0].procedure: expected 'drift' or 'beam_detection'; found \"drfit\"; did you mean 'drift'?",
        "test[0].averge: unknown key; did you mean 'average'? Known here: average, name, procedure, repeats",
        'test[1].average: expected a value greater than 0; found "-1 s"',
        "test[1].repeats: expected a whole number; found 1.5",
        "origin[1]: expected a length with its unit, such as '5 mm'; found 2",
        "origin[2]: expected a length with its unit, such as '5 mm'; found '3 s': 's' is not convertible to 'm'",
        "sensors.left.name, link.host: missing; expected a string",
        "link.hosts: unknown key; did you mean 'host'? Known here: host, kind",
        'note: expected at most 5 letters; found "far too long"',
    ]


def test_a_rule_for_a_table_is_reported_with_its_own_text(write) -> None:
    path = write('schema = "errormotion.example/1"\nbar_radius = "5 mm"\n[[test]]\nname = "a"\nrepeats = 2\n')
    assert complaints(path)[1:] == ["test[0]: a drift is measured once; set repeats = 1"]


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("a = 1\nb = = 2\n", "line 2, column 5"),
        ("a = [1,\n", "line 1, column 8"),
        (b"a = 1\nb = '\xb0'\n", "line 2"),
        ("a = 1\na = 2\n", "line 2, column 6"),
    ],
)
def test_invalid_toml_is_reported_with_its_position(write, text: str | bytes, place: str) -> None:
    path = write(text)
    assert complaints(path)[0].startswith(f"{path}, {place}: ")


def test_a_missing_file_is_an_error_of_the_chosen_class(tmp_path: Path) -> None:
    with raises("toml.unreadable"):
        tomlfile.load_model(tmp_path / "none.toml", File)


def test_keys_of_an_embedded_table_are_reported_with_their_path() -> None:
    found, mistakes = tomlfile.check({"name": "a", "x": 1}, Measurement, prefix=("test", 2, "settings"))
    assert found is None
    assert mistakes[0].startswith("test[2].settings.x: unknown key")


def test_the_nearest_name_ignores_upper_and_lower_case() -> None:
    assert tomlfile.nearest("ERRORMOTION", ["errormotion", "other"]).startswith("did you mean 'errormotion'?")


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("a = " + "[" * 5000, "toml.too_deep"),
        ("a = " + "{b=" * 3000, "toml.too_deep"),
        ("a = " + "9" * 5000, "toml.syntax"),
        ("a." * 3000 + "a = 1", "toml.too_deep"),
        ('a = {"b" . ' + "'b'." * 3000 + "b = 1}", "toml.too_deep"),
        ("#" * (4 << 20) + "#", "toml.unreadable"),
    ],
    ids=["arrays", "tables", "digits", "dotted", "quoted", "size"],
)
def test_a_file_that_needs_too_many_resources_is_an_error(write, text: str, code: str) -> None:
    with raises(code):
        tomlfile.read_toml(write(text))


def test_a_long_word_and_a_sentence_with_dots_are_not_long_keys(write) -> None:
    text = f'a = "{"x" * 1_000_000}"\nb = "{". . " * 100}{"1.5 " * 100}"\n'
    assert set(tomlfile.read_toml(write(text))) == {"a", "b"}
