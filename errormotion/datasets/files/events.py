"""Notes of users on a run or a machine: ``events.jsonl`` with one JSON object on each line, which is only extended."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime, timedelta
from io import BufferedRandom
from pathlib import Path
from typing import Any

from errormotion.datasets.files.reading import require_regular
from errormotion.datasets.files.writing import open_to_append, sync
from errormotion.errors import RunError

FILE = "events.jsonl"
MAX_FILE = 1 << 20
"""Largest size of a file of notes, bytes."""
MAX_TEXT = 1000
"""Largest number of characters of a note."""
MAX_NAME = 100
"""Largest number of characters of the name of an author or a machine."""
CLOCK_ERROR = timedelta(days=1)
"""Largest accepted time of an event in the future."""


@dataclass(frozen=True)
class Event:
    """One note.

    Attributes
    ----------
    text : str
        Printable, one line.
    noted : str
        Time of the note, ISO 8601 in UTC.
    at : str
        Time of the event, ISO 8601 in UTC; empty: the time of the run.
    by : str
        Author of the note; empty if unknown.
    machine : str
        The machine; empty for the machine of the run.
    """

    text: str
    noted: str
    at: str = ""
    by: str = ""
    machine: str = ""


def event(text: str, *, by: str = "", at: datetime | None = None, machine: str = "") -> Event:
    """Return a note with the present time.

    Parameters
    ----------
    text, by, machine : str
        See `Event`.
    at : datetime, optional
        Time of the event; UTC without a time zone.

    Raises
    ------
    RunError
        The text is empty, too long, or not one printable line; the time is in the future.
    """
    now = datetime.now(UTC)
    made = Event(text.strip(), _iso(now), "", by.strip(), machine.strip())
    if at is not None:
        at = at.replace(tzinfo=UTC) if at.tzinfo is None else at.astimezone(UTC)
        if at > now + CLOCK_ERROR:
            raise RunError(
                f"time of the event: expected a time in the past; found {_iso(at)}", code="event.time.future"
            )
        made = Event(made.text, made.noted, _iso(at), made.by, made.machine)
    if wrong := _mistake(asdict(made)):
        raise RunError(wrong, code="event.text.form")
    return made


def append(folder: Path, made: Event) -> Path:
    """Append a note to the file of a folder, and return the file.

    Raises
    ------
    RunError
        The file cannot be written, or is full.
    """
    file = folder / FILE
    line = json.dumps({key: value for key, value in asdict(made).items() if value}, ensure_ascii=False) + "\n"
    data = line.encode()
    try:
        with open(open_to_append(file), "ab+") as stream, _locked(stream):
            size = stream.seek(0, os.SEEK_END)
            if size + len(data) + 1 > MAX_FILE:
                raise RunError(
                    f"{file}: the note does not fit: {size} of at most {MAX_FILE} bytes are used",
                    code="event.file.full",
                )
            if size:
                stream.seek(-1, os.SEEK_END)
                if stream.read(1) != b"\n":  # an incomplete line
                    data = b"\n" + data
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        if not size:
            sync(folder)  # the name of a new file
    except OSError as error:
        raise RunError(f"{file}: the note cannot be written: {error.strerror}", code="event.file.unwritable") from error
    return file


def read(folder: Path) -> tuple[tuple[Event, ...], tuple[str, ...]]:
    """Return the notes of a folder in their order, and a sentence for each invalid line."""
    file = folder / FILE
    try:
        require_regular(file)
        with file.open("rb") as stream:
            data = stream.read(MAX_FILE + 1)
    except FileNotFoundError:
        return (), ()
    except OSError as error:
        return (), (f"{file}: cannot be read: {error.strerror}",)
    if len(data) > MAX_FILE:
        return (), (f"{file}: expected at most {MAX_FILE} bytes; it is larger",)
    events, wrong = list[Event](), list[str]()
    for number, line in enumerate(data.decode(errors="replace").split("\n"), 1):
        if not line.strip():
            continue
        made = from_plain(line)
        if isinstance(made, Event):
            events.append(made)
        else:
            wrong.append(f"{file}, line {number}: {made}")
    return tuple(events), tuple(wrong)


def from_plain(line: Any) -> Event | str:
    """Return the note of a line or of a JSON object, or its mistake."""
    if isinstance(line, str):
        try:
            line = json.loads(line)
        except (ValueError, RecursionError) as error:
            return f"is not valid JSON ({error})"
    if not isinstance(line, dict):
        return f"expected an object; found {type(line).__name__}"
    known = {each.name: line.get(each.name, "") for each in fields(Event)}
    return _mistake(known) or Event(**known)


def _mistake(values: dict[str, Any]) -> str:
    """Return the first mistake in the fields of a note; empty if there is none."""
    for name, value in values.items():
        longest = MAX_TEXT if name == "text" else MAX_NAME
        if not isinstance(value, str) or len(value) > longest or not value.isprintable():
            return f"{name}: expected one line of at most {longest} printable characters"
    if not values["text"]:
        return "text: expected at least one character; found none"
    for name in ("noted", "at"):
        if (values[name] or name == "noted") and instant(values[name]) is None:
            return f"{name}: expected a time such as 2026-03-31T08:00:00+00:00; found '{values[name]}'"
    return ""


def instant(text: str) -> datetime | None:
    """Return a time in UTC; None for an invalid text. Without a time zone it is UTC."""
    try:
        time = datetime.fromisoformat(text)
        return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)
    except (ValueError, OverflowError):
        return None


def _iso(time: datetime) -> str:
    return time.isoformat(timespec="seconds")


@contextmanager
def _locked(stream: BufferedRandom) -> Iterator[None]:
    """Lock a file against other processes until it is closed."""
    try:
        import fcntl
    except ImportError:  # Windows: no lock
        yield
        return
    fcntl.flock(stream, fcntl.LOCK_EX)
    yield
