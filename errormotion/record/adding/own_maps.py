"""Files of a format that a plugin reads by a map of its own, such as those of one manufacturer: questions and map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from errormotion import plugins
from errormotion.datasets.files import tomlfile, tomltext
from errormotion.datasets.files.tomlfile import options_of
from errormotion.datasets.files.writing import replace_text
from errormotion.datasets.maps.questions import Choice, Question
from errormotion.errors import DatasetError

PREFIX = "map."
"""Start of the keys of answers that are keys of such a map."""
_KEYS = {"machine": "machine", "axis": "attributes.axis"}
"""Keys of the map whose answers have options of their own."""


def own_map(paths: Sequence[Path]) -> type[BaseModel] | None:
    """Return the model of the map of a file, by its ending; None if no plugin has one."""
    known: dict[str, type[BaseModel]] = {}
    for _, models in plugins.brought("log_maps", "methods", "datasets"):
        known |= models
    return known.get(paths[0].suffix.lower()) if len(paths) == 1 else None


def questions_of(model: type[BaseModel], answers: Mapping[str, str]) -> list[Question]:
    """Return the questions for the required keys of a map that have no answer."""
    required = [(name, field) for name, field in _fields(model) if field.is_required()]
    return [
        Question(_key(name), f"{name}: {field.description or 'required'}", _choices(field), "", needed=True)
        for name, field in required
        if _key(name) not in answers
    ]


def write_own_map(model: type[BaseModel], answers: Mapping[str, str], path: Path) -> None:
    """Write a map with the answers.

    Raises
    ------
    DatasetError
        An answer is wrong, or belongs to no key (``map.answer``).
    """
    names = {_key(name): name for name, _ in _fields(model)}
    content: dict[str, Any] = {"schema": _schema(model)}
    for key, text in answers.items():
        if key not in names:
            raise DatasetError(f"{key}: no such question; {tomlfile.nearest(key, names)}", code="map.answer")
        if text:
            content[names[key]] = text if _is_text(model, names[key]) else tomltext.value_of(text)
    if mistakes := tomlfile.check(content, model)[1]:
        raise DatasetError("; ".join(mistakes), code="map.answer")
    lines = [f"{tomltext.key(name)} = {tomltext.value(each)}" for name, each in content.items()]
    replace_text(path, "\n".join(lines) + "\n")


def _fields(model: type[BaseModel]) -> list[tuple[str, FieldInfo]]:
    return [(name, field) for name, field in model.model_fields.items() if field.alias != "schema"]


def _schema(model: type[BaseModel]) -> str:
    return str(next(get_args(field.annotation)[0] for field in model.model_fields.values() if field.alias == "schema"))


def _key(name: str) -> str:
    return _KEYS.get(name, PREFIX + name)


def _choices(field: FieldInfo) -> tuple[Choice, ...]:
    literals = [option for option in options_of(field.annotation) if get_origin(option) is Literal]
    return tuple(Choice(str(each), str(each)) for option in literals for each in get_args(option))


def _is_text(model: type[BaseModel], name: str) -> bool:
    """Return whether a key has a text, so that '7' is not a number."""
    return str in options_of(model.model_fields[name].annotation)
