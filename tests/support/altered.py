"""Files that are altered: their bytes, their place, text, JSON, TOML; each alteration follows from its number.

An alteration takes a path and a source of chance, and changes what is there; it returns what it did. One that is
impossible on this file raises `UnsuitableError`, and another one is tried.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import damaged
import mutants

Alteration = Callable[[Path, random.Random], str]
DEEP = 20_000
"""Levels of nesting."""
LONG = 1 << 20
"""Characters of a long line."""


class UnsuitableError(Exception):
    """An alteration that does not apply to a file."""


def alter(path: Path, alterations: Sequence[Alteration], chance: random.Random) -> str:
    """Apply one alteration, one in six times two, and return what was done."""
    done = []
    for _ in range(1 + (chance.random() < 1 / 6)):
        if done and not all(map(is_plain, (path, *path.rglob("*")))):
            break  # reading a pipe or a device would not end; writing to a link would change what it leads to
        for _ in range(30):
            try:
                done.append(chance.choice(alterations)(path, chance))
            except (UnsuitableError, OSError, ValueError, RuntimeError, LookupError, TypeError, AttributeError):
                continue  # impossible on this file, or on what the alteration before has left of it
            break
    return ", ".join(done)


def is_plain(path: Path) -> bool:
    """Whether a path is a regular file or a folder, and no link."""
    return not path.is_symlink() and (path.is_file() or path.is_dir())


def inside(path: Path, chance: random.Random, ending: str = "") -> Path:
    """Return a file: the path itself, or one of those below it; never a link."""
    if not path.is_symlink() and path.is_file():
        return path
    files = sorted(each for each in path.rglob(f"*{ending}") if not each.is_symlink() and each.is_file())
    if not files:
        raise UnsuitableError
    return chance.choice(files)


def remove(path: Path) -> None:
    """Remove a file or a folder."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()


# Of any file.


def bytes_of(path: Path, chance: random.Random) -> str:
    """Change bits and bytes, stretches, lines and numbers."""
    file = inside(path, chance)
    file.write_bytes(mutants.mutant(file.read_bytes(), 1, chance.randrange(10**9)))
    return f"bytes of {file.name}"


def cut(path: Path, chance: random.Random) -> str:
    """Cut a file off, often to nothing."""
    file = inside(path, chance)
    data = file.read_bytes()
    file.write_bytes(data[: chance.choice((0, 1, 7, 8, chance.randrange(len(data) + 1)))])
    return f"{file.name} cut off"


def place(path: Path, chance: random.Random) -> str:
    """Put something else in the place of a file."""
    file = path if chance.random() < 0.6 else inside(path, chance)
    what = chance.choice(("nothing", "folder", "link to nothing", "link to itself", "link outside", "device", "pipe"))
    remove(file)
    if what == "folder":
        file.mkdir()
    elif what == "pipe":
        os.mkfifo(file)
    elif what != "nothing":
        target = {"link to nothing": "absent", "link to itself": file.name, "link outside": "/etc/passwd"}
        file.symlink_to(target.get(what, "/dev/zero"))
    return f"{what} in place of {file.name}"


ANY: tuple[Alteration, ...] = (bytes_of, bytes_of, bytes_of, cut, place)


# Text.


def text(path: Path, chance: random.Random) -> str:
    """Change the encoding, the ends of lines, or the length of lines of a text."""
    file = inside(path, chance)
    data = file.read_bytes()
    where = chance.randrange(len(data) + 1)
    changes: dict[str, Callable[[], bytes]] = {
        "byte order mark": lambda: b"\xef\xbb\xbf" + data,
        "two byte order marks": lambda: b"\xef\xbb\xbf\xef\xbb\xbf" + data,
        "UTF-16": lambda: data.decode(errors="replace").encode("utf-16"),
        "Latin-1": lambda: data[:where] + "Größe µ".encode("latin-1") + data[where:],
        "NUL": lambda: data[:where] + b"\0" * chance.choice((1, 4096)) + data[where:],
        "long line": lambda: data[:where] + chance.choice((b"x", b" ", b"1", b",", b"\t", b'"', b"#")) * LONG,
        "ends of lines": lambda: data.replace(b"\n", chance.choice((b"\r\n", b"\r", b"\n\n", b"\x0b", b"\x85"))),
        "repeated": lambda: data * chance.choice((2, 3, 50)),
        "markup": lambda: data.replace(chance.choice(_words(data)), b"<script>alert(1)</script>"),
        "deep": lambda: data + b"\nx = " + chance.choice((b"[", b"{a=", b"[[", b"(", b'{"a":')) * DEEP,
        "surrogate": lambda: data[:where] + b"\xed\xa0\x80" + data[where:],
    }
    name = chance.choice(sorted(changes))
    file.write_bytes(changes[name]())
    return f"{name} in {file.name}"


def _words(data: bytes) -> list[bytes]:
    return [word for word in data.split() if word.isalpha()] or [b"\n"]


TEXT: tuple[Alteration, ...] = (*ANY, text, text)


def toml(path: Path, chance: random.Random) -> str:
    """Change a value or a key of a TOML file."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        raise UnsuitableError from None
    for _ in range(chance.choice((1, 1, 2))):
        content = damaged.json_of(content, chance.randrange(10**9))
        if not isinstance(content, dict):
            raise UnsuitableError
    path.write_text(_toml(content), encoding="utf-8", errors="replace")
    return "value of TOML"


def _toml(content: dict[str, Any]) -> str:
    return "".join(f"{json.dumps(str(key))} = {_value(each)}\n" for key, each in content.items())


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(str(key))} = {_value(each)}" for key, each in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    if value is None:
        return "{}"
    return json.dumps(value).replace("NaN", "nan").replace("Infinity", "inf")


def toml_deep(path: Path, chance: random.Random) -> str:
    """Nest keys, tables or arrays deeply, or state a number of many digits."""
    extra = chance.choice(
        (
            "x = " + "[" * DEEP + "]" * DEEP,
            "x = " + "{a = " * DEEP + "1" + "}" * DEEP,
            ".".join(["x"] * DEEP) + " = 1",
            "[" + ".".join(["x"] * DEEP) + "]",
            "x = " + "9" * 10_000,
            "x = 0x" + "f" * 400,
            "x = 1979-05-27T07:32:00.999999999999999999Z",
            "x = " + '"' * 3 + "x" * LONG + '"' * 3,
        )
    )
    content = path.read_text(encoding="utf-8", errors="replace")
    path.write_text(content + "\n" + extra + "\n" if chance.random() < 0.5 else extra + "\n" + content)
    return f"TOML with {extra[:8]}"


TOML: tuple[Alteration, ...] = (*TEXT, toml, toml, toml, toml, toml, toml, toml_deep)


def json_value(path: Path, chance: random.Random) -> str:
    """Change a value or a key of a JSON file."""
    file = inside(path, chance, ".json")
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        raise UnsuitableError from None
    for _ in range(chance.choice((1, 1, 1, 2))):
        content = damaged.json_of(content, chance.randrange(10**9))
    file.write_text(json.dumps(content), encoding="utf-8")
    return f"value in {file.name}"


def json_deep(path: Path, chance: random.Random) -> str:
    """Nest JSON deeply, or state a number of many digits."""
    file = inside(path, chance, ".json")
    content = file.read_text(encoding="utf-8", errors="replace")
    extra = chance.choice(("[" * DEEP, "[" * DEEP + "]" * DEEP, '{"a":' * DEEP + "1" + "}" * DEEP, "9" * 10_000))
    if content.lstrip().startswith("{") and chance.random() < 0.6:
        extra = '{"x": ' + extra + ", " + content.lstrip()[1:]
    file.write_text(extra)
    return f"deep JSON in {file.name}"


JSON: tuple[Alteration, ...] = (*TEXT, *[json_value] * 8, json_deep)
