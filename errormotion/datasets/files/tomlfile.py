"""TOML files that users write, checked by a pydantic model; all mistakes are reported together.

The report of a mistake states the file, the dotted key, what was expected, what was found, and for an unknown key the
nearest known one.
"""

from __future__ import annotations

import re
import tomllib
import types
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from errormotion.datasets.files.reading import read_bytes
from errormotion.datasets.units import EDGE, Quantity
from errormotion.errors import DatasetError, ErrormotionError

MAX_FILE = 4 << 20
"""Largest size of a file, bytes."""
DEEPEST = 32
"""Largest number of levels of arrays and tables."""

Model = TypeVar("Model", bound=BaseModel)
Key = str | int

_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_DOTTED = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{DEEPEST},}}")

_KEY = re.compile(r"[\w.\[\]-]+")
"""A dotted key in the form of `dotted`."""

_EXPECTED = {
    "model_type": "a table",
    "model_attributes_type": "a table",
    "dict_type": "a table",
    "mapping_type": "a table",
    "list_type": "an array",
    "tuple_type": "an array",
    "string_type": "a string in quotes",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "int_parsing": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "path_type": "a path in quotes",
}


def load_model(path: str | Path, model: type[Model], *, error: type[ErrormotionError] = DatasetError) -> Model:
    """Read a TOML file into a pydantic model; units are compulsory.

    Parameters
    ----------
    path : str or Path
        The file, UTF-8.
    model : type of BaseModel
        Model of the content; models with ``extra="forbid"`` refuse unknown keys.
    error : type of ErrormotionError
        Class of the error.

    Raises
    ------
    ErrormotionError
        Of the type ``error``: the file cannot be read, is not TOML (with line and column), or contains mistakes (all
        of them in one message).
    """
    loaded, mistakes = check(read_toml(path, error=error), model)
    if loaded is None:
        raise error(report(path, mistakes), code="toml.mistakes")
    return loaded


def read_toml(path: str | Path, *, error: type[ErrormotionError] = DatasetError) -> dict[str, Any]:
    """Return the tables of a TOML file; a byte order mark is allowed.

    Raises
    ------
    ErrormotionError
        Of the type ``error``: missing, unreadable, too large, not UTF-8, not TOML, nested too deep.
    """
    try:
        raw = read_bytes(path, MAX_FILE)
    except OSError as reason:
        raise error(
            f"{path}: cannot be read: {reason.strerror}. Expected a TOML file there.", code="toml.unreadable"
        ) from reason
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as reason:
        line = raw.count(b"\n", 0, reason.start) + 1
        raise error(
            f"{path}, line {line}: byte 0x{raw[reason.start]:02x} is not UTF-8. Save the file as UTF-8.",
            code="toml.encoding",
        ) from reason
    return parse_toml(text, path, error=error)


def parse_toml(text: str, path: str | Path, *, error: type[ErrormotionError] = DatasetError) -> dict[str, Any]:
    """Return the tables of a text; ``path`` is for the messages.

    Raises
    ------
    ErrormotionError
        Of the type ``error``: not TOML, nested too deeply, or with a number of too many digits.
    """
    if _DOTTED.search(text):  # time and memory of tomllib increase with the square of the number of parts
        raise error(f"{path}: expected keys of at most {DEEPEST} parts; found more", code="toml.too_deep")
    deep = f"{path}: expected at most {DEEPEST} levels of arrays and tables; found more"
    try:
        content = tomllib.loads(text)
    except RecursionError:
        raise error(deep, code="toml.too_deep") from None
    except tomllib.TOMLDecodeError as reason:
        place = re.search(r"(.*) \(at line (\d+), column (\d+)\)$", str(reason), re.DOTALL)
        if place:
            raise error(
                f"{path}, line {place[2]}, column {place[3]}: not TOML: {place[1]}", code="toml.syntax"
            ) from reason
        lines = text.splitlines() or [""]
        complaint = str(reason).removesuffix(" (at end of document)")
        raise error(
            f"{path}, line {len(lines)}, column {len(lines[-1]) + 1}: not TOML: {complaint}", code="toml.syntax"
        ) from reason
    except ValueError as reason:  # a number of too many digits, an invalid date
        raise error(f"{path}: not TOML: {reason}", code="toml.syntax") from reason
    if _is_deep(content):
        raise error(deep, code="toml.too_deep")
    return content


def _is_deep(content: Any) -> bool:
    """Return whether tables and arrays are nested beyond the limit; without recursion."""
    level = [content]
    for _ in range(DEEPEST):
        level = [each for one in level for each in (one.values() if isinstance(one, dict) else one)
                 if isinstance(each, (dict, list))]  # fmt: skip
        if not level:
            return False
    return True


def check(
    data: Mapping[str, Any], model: type[Model], *, prefix: Sequence[Key] = (), edge: bool = True
) -> tuple[Model | None, list[str]]:
    """Return the model of some tables, or None and every mistake in them.

    Parameters
    ----------
    data : mapping
        Tables of TOML.
    model : type of BaseModel
        Model of the content.
    prefix : sequence of str or int
        Keys of ``data`` in its file, for the dotted keys of the messages.
    edge : bool
        Whether a user wrote the file: numbers without unit are then refused for quantities.
    """
    try:
        return model.model_validate(data, context=EDGE if edge else None), []
    except ValidationError as failure:
        return None, [_mistake(details, model, prefix) for details in failure.errors(include_url=False)]


def report(source: str | Path, mistakes: Sequence[str]) -> str:
    """Return the one message for all mistakes of one file."""
    count = "1 mistake" if len(mistakes) == 1 else f"{len(mistakes)} mistakes"
    return "\n  - ".join([f"{source}: {count}", *grouped(mistakes)])


def grouped(mistakes: Sequence[str]) -> list[str]:
    """Return mistakes as lines; equal mistakes are in one line with all their keys."""
    keys: dict[str, list[str]] = {}
    for mistake in mistakes:
        key, sign, text = mistake.partition(": ")
        keys.setdefault(text if sign and _KEY.fullmatch(key) else mistake, []).append(key)
    return [f"{', '.join(where)}: {text}" if text != where[0] and _KEY.fullmatch(where[0]) else text
            for text, where in keys.items()]  # fmt: skip


def single(line: str) -> list[str]:
    """Return the single mistakes of a line of `grouped`."""
    keys, sign, text = line.partition(": ")
    names = keys.split(", ")
    return [f"{key}: {text}" for key in names] if sign and all(map(_KEY.fullmatch, names)) else [line]


def dotted(keys: Iterable[Key]) -> str:
    """Return ``test[0].settings.average`` for ``("test", 0, "settings", "average")``."""
    text = ""
    for key in keys:
        text += f"[{key}]" if isinstance(key, int) else f".{key}" if text else key
    return text


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a sentence for an unknown name: the nearest known name, if there is one, and all known names."""
    names = sorted(set(known))
    by_lower = {known_name.lower(): known_name for known_name in names}
    near = get_close_matches(name.lower(), by_lower, n=1)
    hint = f"did you mean '{by_lower[near[0]]}'? " if near else ""
    return f"{hint}Known here: {', '.join(names) or 'none'}"


def _mistake(details: ErrorDetails, model: type[BaseModel], prefix: Sequence[Key]) -> str:
    path = tuple(details["loc"])
    kind, message, found = details["type"], details["msg"], details["input"]
    place = dotted((*prefix, *_walk(model, path)[1])) or "(whole file)"
    if kind == "extra_forbidden":
        known = {name for owner in _models(_walk(model, path[:-1])[0]) for name in _names(owner)}
        return f"{place}: unknown key; {nearest(str(path[-1]), known)}"
    if kind == "missing":
        return f"{place}: missing; expected {_wanted(model, path)}"
    if kind == "quantity":
        return f"{place}: {message}"
    if kind in ("value_error", "assertion_error"):
        text = message.partition(", ")[2]
        complete = isinstance(found, Mapping) or "; found" in text  # of a whole table, or the value is in the text
        return f"{place}: {text}" if complete else f"{place}: {text}; found {_short(found)}"
    expected = _EXPECTED.get(kind) or message.removeprefix("Input should be ")
    if expected.startswith(("greater", "less")):
        expected = f"a value {expected}"
    hint = ""
    if kind in ("literal_error", "enum") and isinstance(found, str):
        near = get_close_matches(found, re.findall(r"'([^']*)'", expected), n=1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
    return f"{place}: expected {expected}; found {_short(found)}{hint}"


def _short(value: Any) -> str:
    text = f'"{value}"' if isinstance(value, str) else str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def _wanted(model: type[BaseModel], path: Sequence[Key]) -> str:
    """Return a description of the value at a path."""
    for owner in _models(_walk(model, path[:-1])[0]):
        for name, field in owner.model_fields.items():
            if path[-1] not in (name, field.alias):
                continue
            for note in field.metadata:
                if isinstance(note, Quantity):
                    return f"{note.kind}, such as '{note.example}'"
            if field.description:
                return field.description
            if _models([field.annotation]) == [field.annotation]:
                return "a table"
            kinds = {str: "a string", float: "a number", int: "a whole number", bool: "true or false", Path: "a path"}
            return kinds.get(field.annotation, "a value") if isinstance(field.annotation, type) else "a value"
    return "a value"


def _names(model: type[BaseModel]) -> list[str]:
    return [field.alias or name for name, field in model.model_fields.items()]


def options_of(annotation: Any) -> list[Any]:
    """Return the members of unions and annotated types, flattened."""
    origin = get_origin(annotation)
    if origin is Annotated:
        return options_of(get_args(annotation)[0])
    if origin is Union or origin is types.UnionType:
        return [option for member in get_args(annotation) for option in options_of(member)]
    return [annotation]


def _models(annotations: Iterable[Any]) -> list[type[BaseModel]]:
    options = [option for annotation in annotations for option in options_of(annotation)]
    return [option for option in options if isinstance(option, type) and issubclass(option, BaseModel)]


def _step(annotations: Sequence[Any], key: Key) -> list[Any]:
    """Return the annotations below a key; empty if there is no such key."""
    below: list[Any] = []
    for option in (option for annotation in annotations for option in options_of(annotation)):
        if isinstance(option, type) and issubclass(option, BaseModel):
            below += [field.annotation for name, field in option.model_fields.items() if key in (name, field.alias)]
        elif get_origin(option) in (dict, Mapping):
            below.append(get_args(option)[1])
        elif get_origin(option) in (list, tuple, Sequence) and isinstance(key, int):
            arguments = [argument for argument in get_args(option) if argument is not Ellipsis]
            below.append(arguments[min(key, len(arguments) - 1)])
    return below


def _has_tag(model: type[BaseModel], key: Key) -> bool:
    """Return whether ``key`` is the tag of pydantic for this member of a union: its name or its discriminator."""
    tags = [tag for field in model.model_fields.values() for tag in get_args(field.annotation)]
    return key == model.__name__ or key in tags


def _walk(model: type[BaseModel], path: Sequence[Key]) -> tuple[list[Any], list[Key]]:
    """Return the annotations at a path, and the path without pydantic's tags for members of unions."""
    here: list[Any] = [model]
    kept: list[Key] = []
    for key in path:
        below = _step(here, key)
        options = _models(here)
        tagged = [option for option in options if _has_tag(option, key)] if len(options) > 1 else []
        if below or not tagged:
            kept.append(key)
        here = below or tagged or here
    return here, kept
