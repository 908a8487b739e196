"""The audit log: one JSON object per line; lines are only appended.

Each line has the hash of all lines before it, and a code of this hash by the key of the user (HMAC-SHA-256): a log that
was altered and computed anew has other codes. The first line states the identity of the log and the name of the key,
the last line of an orderly end is marked as such. The number of entries is kept in the user's state folder as well:
a log whose end was cut off has fewer. `anchors` holds key and number.

Logs of earlier versions have no codes; others can compute their hashes anew, and their end is not known.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import logging
import os
import re
import secrets
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Any, Self

from errormotion.compensation.online import anchors
from errormotion.compensation.online.anchors import Anchor
from errormotion.datasets.files.reading import require_regular
from errormotion.datasets.files.writing import sync
from errormotion.errors import CompensationError
from errormotion.state import open_itself

START = "0" * 64
"""Hash before the first line."""
MAX_LINE = 1 << 16
"""Maximum length of a line, bytes."""
SYNC_INTERVAL = 10.0
"""Longest time between two moments at which all entries, and their number, are on the disk, s."""
ENTRIES_PER_READ = 20_000

_LINE = re.compile(
    r'\{"hash":"([0-9a-f]{64})",(?:"code":"([0-9a-f]{64})",)?'
    r'((?:"log":"([0-9a-f]{32})","key":"([0-9a-f]{16})",)?(?:"end":(\d{1,15}),)?)"entry":(.*)\}\n',
    re.DOTALL,
)

log = logging.getLogger(__name__)


class Verdict(StrEnum):
    """Result of the check of an audit log."""

    UNBROKEN = "unbroken"
    WITHOUT_KEY = "without key"
    """The hashes are unbroken, but this user has no key of the log: others can compute them anew."""
    CUT = "cut"
    ALTERED = "altered"
    EMPTIED = "emptied"


class AuditError(CompensationError):
    """An audit log is broken; ``verdict`` states how."""

    def __init__(self, verdict: Verdict, message: str, *, code: str) -> None:
        super().__init__(message, code=code)
        self.verdict = verdict


@dataclass(frozen=True)
class Checked:
    """Result of the check of an audit log.

    Attributes
    ----------
    verdict : Verdict
    entries : int
        Number of entries that follow from each other.
    hash : str
        Hash of the last of them.
    ended : bool
        Whether the last entry is marked as the end; false while the log is written, and after a kill.
    message : str
        What is broken; empty if nothing is.
    """

    verdict: Verdict
    entries: int
    hash: str
    ended: bool
    message: str = ""


class AuditLog:
    """Appends entries to an audit log; a context manager.

    Parameters
    ----------
    path : Path
        Created if it does not exist; an existing audit log is continued.

    Raises
    ------
    CompensationError
        The existing log is broken or has no key of this user, or the key of the user cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._key = anchors.own_key()
        self._reader = AuditReader(path)
        if path.exists() and (path.stat().st_size or anchors.of_path(path)):
            verify(path, self._reader)
            if self._reader.count and self._reader.verdict is not Verdict.UNBROKEN:
                raise CompensationError(
                    f"{path}: the log was written with another key or none; start a new one", code="audit.key.other"
                )
        self._log = self._reader.log or secrets.token_hex(16)
        self._count, self._hash = self._reader.count, self._reader.hash
        self._synced, self._saved = time.monotonic(), -1
        self._file = open_itself(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        try:
            sync(path.parent)  # the name of a new file
            self._sync()
        except OSError as error:
            os.close(self._file)
            raise CompensationError(
                f"{path}: the number of its entries cannot be stored: {error}", code="audit.anchor.unwritable"
            ) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._sync()
        except OSError as error:
            log.warning("%s: cannot be synchronised: %s", self.path, error)
        finally:
            os.close(self._file)

    def write(self, entry: Mapping[str, Any], *, sync: bool = False, last: bool = False) -> None:
        """Append an entry; ``sync`` waits until it is stored on the disk, ``last`` marks it as the end of the log.

        Raises
        ------
        CompensationError
            The entry cannot be written.
        """
        content = {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), **entry}
        text = f'"entry":{json.dumps(content, ensure_ascii=False, allow_nan=False)}'
        if last:
            text = f'"end":{self._count + 1},{text}'
        if not self._count:
            text = f'"log":"{self._log}","key":"{anchors.name_of(self._key)}",{text}'
        self._hash = _next(self._hash, text)
        line = f'{{"hash":"{self._hash}","code":"{_code(self._key, self._hash)}",{text}}}\n'.encode()
        try:
            if os.write(self._file, line) != len(line):
                raise OSError("the line was written incompletely")
            self._count += 1
            if sync or last or time.monotonic() - self._synced > SYNC_INTERVAL:
                self._sync()
        except OSError as error:
            raise CompensationError(
                f"{self.path}: the audit log cannot be written: {error}", code="audit.unwritable"
            ) from None

    def _sync(self) -> None:
        """Wait until the entries are on the disk, then store their number: it never exceeds that of the file."""
        getattr(os, "fdatasync", os.fsync)(self._file)
        self._synced = time.monotonic()
        if self._saved == self._count:
            return
        try:
            anchors.save(Anchor(str(self.path.resolve()), self._log, self._count))
            self._saved = self._count
        except OSError as error:
            if self._saved < 0:
                raise
            log.warning("%s: the number of its entries cannot be stored: %s", self.path, error)


class AuditReader:
    """Reads an audit log while it is written, and checks it.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    count : int
        Entries so far.
    hash : str
        Hash of the last entry.
    log : str
        Identity of the log; empty for a log without codes.
    ended : bool
        Whether the last entry is marked as the end.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.count, self.hash, self.log, self.ended = path, 0, START, "", False
        self._key: bytes | None = None
        self._coded = False
        self._at = 0
        self._moved: Anchor | None = None
        self._sought = False

    @property
    def verdict(self) -> Verdict:
        """What the entries so far prove: unbroken, or without key."""
        return Verdict.UNBROKEN if self._key is not None or not self.count else Verdict.WITHOUT_KEY

    def read(self, most: int, *, whole: bool = False) -> list[dict[str, Any]]:
        """Return the next entries, at most ``most``; an incomplete last line is read by a later call.

        Parameters
        ----------
        most : int
        whole : bool
            An incomplete last line is an alteration.

        Raises
        ------
        AuditError
            The log was altered, cut or emptied; every later call raises it as well.
        CompensationError
            The log cannot be read.
        """
        found: list[dict[str, Any]] = []
        partial = 0
        known = anchors.of_path(self.path)  # before the file, which has at least as many entries
        try:
            require_regular(self.path)
            with self.path.open("rb") as file:
                if file.seek(0, os.SEEK_END) < self._at:
                    raise self._broken(
                        Verdict.CUT, "the file is shorter than it was: its end was cut off", code="audit.cut"
                    )
                file.seek(self._at)
                while len(found) < most and (line := file.readline(MAX_LINE)):
                    if not line.endswith(b"\n") and len(line) < MAX_LINE and not whole:
                        partial = 1
                        break
                    found.append(_entry(self._take(line)))
                    self._at += len(line)
        except FileNotFoundError as error:
            if known is not None:
                raise self._broken(Verdict.EMPTIED, "the log was removed", code="audit.emptied") from None
            raise CompensationError(f"{self.path}: cannot be read: {error.strerror}", code="audit.unreadable") from None
        except OSError as error:
            raise CompensationError(f"{self.path}: cannot be read: {error.strerror}", code="audit.unreadable") from None
        if len(found) < most:
            self._require_all(known or self._elsewhere(), partial)
        return found

    def _take(self, line: bytes) -> str:
        """Check the next line, and return its entry."""
        parts = _LINE.fullmatch(line.decode("utf-8", "replace"))
        if parts is None:
            raise self._altered("does not follow from the lines before it")
        stated, code, head, identity, key, end, entry = parts.groups(default="")
        after = _next(self.hash, f'{head}"entry":{entry}' if code else entry)
        first = self.count == 0
        if after != stated or (bool(code) != self._coded and not first) or bool(identity) != (first and bool(code)):
            raise self._altered("does not follow from the lines before it")
        if first:
            own = anchors.known_key()
            self._coded, self.log = bool(code), identity
            self._key = own if own is not None and anchors.name_of(own) == key else None
        if self._key is not None and not hmac.compare_digest(_code(self._key, after), code):
            raise self._altered("does not follow by the key of this user: hashes were computed anew")
        if end and int(end) != self.count + 1:
            raise self._altered("does not follow from the lines before it")
        self.hash, self.count, self.ended = after, self.count + 1, bool(end)
        return entry

    def _require_all(self, known: Anchor | None, partial: int) -> None:
        """Compare the log with what is known of it outside of its file; ``partial`` lines are being written."""
        if known is None:
            if not self.count and not partial:
                raise self._broken(
                    Verdict.EMPTIED, "expected entries; found none: the log was emptied", code="audit.emptied"
                )
            return
        own = self._key is not None or anchors.known_key() is None  # without a key nothing proves another log
        if self.count and (self.log != known.log or not own):
            raise self._broken(
                Verdict.ALTERED, "expected the log that this user began here; found another one", code="audit.altered"
            )
        if self.count + partial == 0 < known.entries:
            raise self._broken(
                Verdict.EMPTIED,
                f"expected {known.entries} entries; found none: the log was emptied",
                code="audit.emptied",
            )
        if self.count + partial < known.entries:
            raise self._broken(
                Verdict.CUT,
                f"expected at least {known.entries} entries; found {self.count}: its end was cut off",
                code="audit.cut",
            )

    def _elsewhere(self) -> Anchor | None:
        """Return what is known of the log by its identity, if it was moved."""
        if not self._sought and self.log:
            self._moved, self._sought = anchors.of_log(self.log), True
        return self._moved

    def _altered(self, what: str) -> AuditError:
        return self._broken(
            Verdict.ALTERED,
            f"line {self.count + 1} {what}: the log was altered, or its last line was cut off",
            code="audit.altered",
        )

    def _broken(self, verdict: Verdict, what: str, *, code: str) -> AuditError:
        return AuditError(verdict, f"{self.path}: {what}. Keep it, and start a new one.", code=code)


def verify(path: Path, reader: AuditReader | None = None) -> tuple[int, str]:
    """Return the number of entries of an audit log, and its last hash.

    A log without a key of this user is accepted if its hashes are unbroken; `check` distinguishes it.

    Raises
    ------
    AuditError
        The log was altered, cut or emptied; its ``verdict`` states which. The message names the line.
    CompensationError
        The log cannot be read.
    """
    reader = reader or AuditReader(path)
    while len(reader.read(ENTRIES_PER_READ, whole=True)) == ENTRIES_PER_READ:
        pass
    return reader.count, reader.hash


def check(path: Path) -> Checked:
    """Return what the check of an audit log found.

    Raises
    ------
    CompensationError
        The log cannot be read.
    """
    reader = AuditReader(path)
    try:
        verify(path, reader)
    except AuditError as error:
        return Checked(error.verdict, reader.count, reader.hash, False, str(error))
    return Checked(reader.verdict, reader.count, reader.hash, reader.ended)


def _entry(text: str) -> dict[str, Any]:
    """Return an entry; an empty one if the text is not a JSON object."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _next(before: str, text: str) -> str:
    return hashlib.sha256(f"{before}{text}".encode()).hexdigest()


def _code(key: bytes, after: str) -> str:
    return hmac.new(key, after.encode(), hashlib.sha256).hexdigest()
