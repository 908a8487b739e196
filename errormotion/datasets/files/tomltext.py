"""TOML as text: conversion of values to text, and changes of single values in a file, with its comments kept."""

from __future__ import annotations

import copy
import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from errormotion.datasets.files.tomlfile import Key, dotted, parse_toml
from errormotion.errors import DatasetError

MAX_TEXT = 1 << 16
"""Largest number of characters of a text in which values are changed."""

_BARE = re.compile(r"[A-Za-z0-9_-]+")
_HEADER = re.compile(r"[ \t]*(\[\[?)([^\n]*?)\]\]?[ \t]*(?:#[^\n]*)?")
_KEYS = re.compile(
    r"""[ \t]*((?:[\w-]+|"[^"\n]*"|'[^'\n]*')(?:[ \t]*\.[ \t]*(?:[\w-]+|"[^"\n]*"|'[^'\n]*'))*)[ \t]*="""
)


def key(name: str) -> str:
    """Return a key of TOML, in quotes if necessary."""
    return name if _BARE.fullmatch(name) else value(name)


def value(content: Any) -> str:
    """Return a value of TOML on one line."""
    if isinstance(content, str):
        return json.dumps(content, ensure_ascii=False).replace("\x7f", "\\u007F")
    if isinstance(content, bool):
        return str(content).lower()
    if isinstance(content, Mapping):
        return "{ " + ", ".join(f"{key(str(name))} = {value(each)}" for name, each in content.items()) + " }"
    if isinstance(content, (list, tuple)):
        return "[" + ", ".join(value(each) for each in content) + "]"
    return repr(content) if isinstance(content, float) else str(content)


def value_of(text: str) -> Any:
    """Return the value of a text in TOML, or the text if it is not TOML."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text


def with_value(text: str, place: Sequence[Key], content: Any) -> str:
    """Return a text with one value changed; comments, order and all other values are kept.

    Parameters
    ----------
    text : str
        TOML.
    place : sequence of str or int
        Keys from the top, numbers in arrays of tables: ``("test", 0, "settings", "duration")``.
    content : object
        The new value; None removes the key.

    Raises
    ------
    DatasetError
        The text is not TOML, is too long, or the value is in a form that cannot be changed alone.
    """
    before = _read(text)
    expected = copy.deepcopy(before)
    _put(expected, place, content)
    return text if expected == before else _same(_changed(text, tuple(place), content, expected), expected, place)


def with_table(text: str, name: str, content: Mapping[str, Any]) -> str:
    """Return a text with a further table at the end of an array of tables, which may not exist yet.

    Raises
    ------
    DatasetError
        The text is not TOML, is too long, or states the array in another form than by headers ``[[name]]``.
    """
    before = _read(text)
    expected = copy.deepcopy(before)
    expected[name] = [*before.get(name, []), dict(content)] if isinstance(before.get(name, []), list) else None
    lead = "" if not text else "\n" if text.endswith("\n") else "\n\n"
    lines = "".join(f"{key(each)} = {value(found)}\n" for each, found in content.items())
    return _same(f"{text}{lead}[[{key(name)}]]\n{lines}", expected, (name,))


def without_table(text: str, name: str, number: int) -> str:
    """Return a text without one table of an array of tables and without the tables in it; comments around it are kept.

    Raises
    ------
    DatasetError
        The text is not TOML, is too long, has no such table, or states it in another form than by headers ``[[name]]``.
    """
    expected = _read(text)
    if not isinstance(expected.get(name), list):
        raise DatasetError(f"{name}: the text contains no such tables", code="toml.edit.no_tables")
    _put(expected, (name, number), None)
    if not expected[name]:
        del expected[name]
    own: list[_Statement] = []
    for each in [*reversed(list(_statements(text))), None]:
        if each is not None and each.table[:2] == (name, number):
            own.append(each)
        elif own:  # consecutive statements in reverse order
            head, rest = text[: own[-1].start], text[own[0].end :]
            text = head + (rest.removeprefix("\n") if head.endswith("\n\n") or not head else rest)
            own = []
    return _same(text, expected, (name, number))


def _read(text: str) -> dict[str, Any]:
    if len(text) > MAX_TEXT:
        raise DatasetError(f"expected at most {MAX_TEXT} characters; found {len(text)}", code="toml.too_long")
    return parse_toml(text, "text")


def _same(changed: str, expected: Any, place: Sequence[Key]) -> str:
    with suppress(DatasetError):
        if parse_toml(changed, "text") == expected:
            return changed
    raise DatasetError(
        f"{dotted(place)}: is written in a form that cannot be changed alone; change it in the text",
        code="toml.edit.form",
    )


@dataclass(frozen=True)
class _Statement:
    """A header or a key with its value: ranges of its lines and its value, its table, and its dotted key."""

    start: int
    end: int
    table: tuple[Key, ...]
    place: tuple[Key, ...]
    value: tuple[int, int] | None = None


def _changed(text: str, place: tuple[Key, ...], content: Any, expected: Any) -> str:
    statements = list(_statements(text))
    for each in statements:
        if each.value is None or each.place != place[: len(each.place)]:
            continue
        if content is None and each.place == place:
            return text[: each.start] + text[each.end :]
        return text[: each.value[0]] + value(_at(expected, each.place)) + text[each.value[1] :]
    if content is None:
        return text
    beside = [each for each in statements if each.value is not None and each.place[:-1] == place[:-1]]
    table = beside[-1].table if beside else place[:-1]  # another one if the keys beside it are dotted
    line = f"{'.'.join(key(str(name)) for name in place[len(table) :])} = {value(content)}\n"
    own = beside or [each for each in statements if each.table == table]
    first = 0
    if not own and table:
        own = [each for each in statements if each.table[: len(table) - 1] == table[:-1]]
        line = f"[{'.'.join(key(name) for name in table if isinstance(name, str))}]\n{line}"
        first = len(text)  # keys above would belong to the table
    at = own[-1].end if own else first
    lead = "" if at == 0 or text[at - 1 : at] == "\n" else "\n"
    return text[:at] + lead + line + text[at:]


def _statements(text: str) -> Iterator[_Statement]:
    table: tuple[Key, ...] = ()
    counts: dict[tuple[Key, ...], int] = {}
    at = 0
    while at < len(text):
        end = _line_end(text, at)
        line = text[at:end]
        if not line.strip() or line.lstrip().startswith("#"):
            at = end
            continue
        header, keys = _HEADER.fullmatch(line.rstrip("\r\n")), _KEYS.match(line)
        if header is not None and keys is None:
            names, table = _names(header[2]), ()
            for name in names:
                table = (*table, name)
                if header[1] == "[[" and len(table) - len([k for k in table if isinstance(k, int)]) == len(names):
                    counts[table] = counts.get(table, -1) + 1
                if table in counts:
                    table = (*table, counts[table])
            yield _Statement(at, end, table, table)
        elif keys is not None:
            start = at + keys.end()
            while (parsed := _parsed(text[start:end])) is None and end < len(text):
                end = _line_end(text, end)
            yield _Statement(
                at, end, table, (*table, *_names(keys[1])), (start + 1, start + parsed) if parsed else None
            )
        at = end


def _line_end(text: str, at: int) -> int:
    end = text.find("\n", at)
    return len(text) if end < 0 else end + 1


def _names(keys: str) -> list[str]:
    """Return the parts of a dotted key."""
    table, names = tomllib.loads(f"{keys} = 0"), []
    while isinstance(table, dict):
        name, table = next(iter(table.items()))
        names.append(name)
    return names


def _parsed(rest: str) -> int | None:
    """Return the length of the value at the start of a text, without a comment after it; None if it is incomplete."""
    if not rest.rstrip().endswith(("]", "}", '"', "'")) and "\n" in rest.rstrip() and "#" not in rest:
        return None  # within an array: the next line is needed
    try:
        whole = tomllib.loads(f"value = {rest}")["value"]
    except ValueError:
        return None
    for mark in re.finditer("#", rest):
        try:
            if tomllib.loads(f"value = {rest[: mark.start()]}")["value"] == whole:
                return len(rest[: mark.start()].rstrip())
        except ValueError:
            continue
    return len(rest.rstrip())


def _at(content: Any, place: Sequence[Key]) -> Any:
    for each in place:
        content = content[each]
    return content


def _put(content: Any, place: Sequence[Key], new: Any) -> None:
    """Set or remove a value; missing tables are created."""
    try:
        for each in place[:-1]:
            if new is None and isinstance(content, dict) and each not in content:
                return
            content = content.setdefault(each, {}) if isinstance(content, dict) else content[each]
        last: Any = place[-1]
        if new is None and isinstance(content, list):
            del content[last]
        elif new is None:
            content.pop(last, None)
        else:
            content[last] = new
    except (KeyError, IndexError, TypeError, AttributeError):
        raise DatasetError(f"{dotted(place)}: the text contains no such key", code="toml.edit.no_key") from None
