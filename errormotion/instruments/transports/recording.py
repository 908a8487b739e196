"""Recording of a session and strict replay.

A recording is a text file: a header line with the address, then one line per frame::

    errormotion-session/1 2025-03-01T12:00:00+00:00 tcp://192.168.0.2:23
    W 0.000213 5f3a11c0 4f5554505554204e4f4e450d0a
    R 0.001877 91b2d377 2d3e
    END 2 91b2d377

``W`` is written by the driver, ``R`` received from the device; then follow seconds since the start, a checksum, and the
bytes in hexadecimal. The checksum is the CRC-32 of direction and bytes, chained over all frames: changed bytes and
missing or moved frames are detected.

After the header there may be a line ``NOTE`` with a JSON object, which states the instrument and the session; the
format is then ``errormotion-session/2``.

In a replay each write must equal the next recorded one, byte for byte; a frame that followed a write is returned only
after that write; and at the end no frame may remain. Otherwise a `ReplayError` is raised.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar
from zlib import crc32

from errormotion.datasets.files.reading import require_regular
from errormotion.datasets.files.writing import replace_text
from errormotion.errors import InstrumentError, InstrumentTimeoutError, ReplayError
from errormotion.instruments.transports.base import Transport

FORMAT = "errormotion-session/1"
INDEX_FORMAT = "errormotion-sessions/1"
WITH_NOTE = {FORMAT: "errormotion-session/2", INDEX_FORMAT: "errormotion-sessions/2"}
NOTE = "NOTE "
MAX_NOTE_BYTES = 1 << 20
MAX_PARTS = 64
"""Largest number of recordings in a list."""
MAX_INDEX = MAX_NOTE_BYTES + (1 << 16)
"""Largest size of a list of recordings, bytes."""


MAX_RECORDING = 1 << 30
"""Largest size of a recording that is replayed, bytes; a replay keeps its frames in memory."""


class EndOfRecordingError(ReplayError):
    """The driver reads after the end of the recording."""

    code = "replay.ended"


class Recorder:
    """Writes the frames of one session to a new file; InstrumentError if the file exists or cannot be created."""

    def __init__(self, path: Path | str, address: str) -> None:
        self._start = time.monotonic()
        self._crc = 0
        self._frames = 0
        self._lock = threading.Lock()
        try:
            self._file = Path(path).open(  # noqa: SIM115 - kept open
                "x", buffering=1, encoding="ascii", errors="backslashreplace"
            )
        except FileExistsError:
            raise InstrumentError(
                f"The recording {path} already exists; choose another file or remove it", code="recording.exists"
            ) from None
        except OSError as error:
            raise InstrumentError(
                f"The recording {path} cannot be created: {error.strerror}", code="recording.not_created"
            ) from None
        self._file.write(f"{FORMAT} {datetime.now(UTC).isoformat(timespec='seconds')} {address}\n")

    def frame(self, direction: str, data: bytes) -> None:
        """Append one frame; ``direction`` is W or R."""
        with self._lock:
            if self._file.closed:
                return
            self._crc = crc32(direction.encode() + data, self._crc)
            self._frames += 1
            self._file.write(f"{direction} {time.monotonic() - self._start:.6f} {self._crc:08x} {data.hex()}\n")

    def close(self) -> None:
        """Write the last line; idempotent."""
        with self._lock:
            if not self._file.closed:
                self._file.write(f"END {self._frames} {self._crc:08x}\n")
                self._file.close()


class RecordingTransport(Transport):
    """Forwards all calls to another transport, and every frame to a recorder."""

    def __init__(self, inner: Transport, recorder: Recorder) -> None:
        super().__init__(inner.url, inner.timeout)
        self._inner = inner
        self._recorder = recorder
        self.flow_control = inner.flow_control
        self.simulated = inner.simulated

    @property
    def unrecorded(self) -> Transport:
        """The transport within, for frames that no recording may contain, such as a token."""
        return self._inner

    def _send(self, data: bytes) -> None:
        self._recorder.frame("W", data)  # before sending, so that the answer is recorded after it
        self._inner.write(data)

    def _receive(self, max_bytes: int, timeout: float) -> bytes:
        data = self._inner.read(max_bytes, timeout)
        self._recorder.frame("R", data)
        return data

    def reopen(self) -> bool:
        """Open another connection to the same device."""
        self._rest = b""
        return self._inner.reopen()

    def report_delivered(self, samples: int) -> None:
        """Report the number of samples that the caller has received."""
        self._inner.report_delivered(samples)

    def close(self) -> None:
        """Close the connection, then the recording; idempotent."""
        self._inner.close()
        self._recorder.close()


def read_recording(path: Path) -> tuple[str, list[tuple[str, bytes]]]:
    """Return the address of a recorded session and its frames as (direction, bytes).

    Raises
    ------
    ReplayError
        The file does not exist, is not a recording, was changed or has no end; the message states the line.
    """
    try:
        if (size := require_regular(path).st_size) > MAX_RECORDING:
            raise ReplayError(
                f"{path}: expected a recording of at most {MAX_RECORDING} bytes; found {size}",
                code="recording.too_large",
            )
        lines = path.read_text(encoding="ascii").splitlines()
    except OSError as error:
        raise ReplayError(
            f"The recording {path} cannot be read: {error.strerror}", code="recording.unreadable"
        ) from None
    except UnicodeDecodeError as error:
        raise ReplayError(
            f"{path} is not a recording, or is damaged: byte {error.start} is not ASCII", code="recording.damaged"
        ) from None
    head = lines[0].split(" ", 2) if lines else []
    if len(head) != 3 or head[0] != (WITH_NOTE[FORMAT] if _has_note(lines) else FORMAT):
        raise ReplayError(
            f"{path} is not a recording: expected a first line '{FORMAT} TIME ADDRESS'", code="recording.form"
        )
    first = 1 + _has_note(lines)
    if len(lines) < 2 or not lines[-1].startswith("END "):
        raise ReplayError(
            f"The recording {path} is incomplete: expected a last line that starts with 'END'; record it again",
            code="recording.incomplete",
        )
    frames: list[tuple[str, bytes]] = []
    crc = 0
    for number, line in enumerate(lines[first:-1], start=first + 1):
        try:
            direction, _, check, text = line.split(" ")
            data = bytes.fromhex(text)
            crc = crc32(direction.encode() + data, crc)
            valid = direction in ("W", "R") and check == f"{crc:08x}"
        except ValueError:
            valid = False
        if not valid:
            raise ReplayError(
                f"{path}, line {number}: this frame was changed after the recording (wrong checksum)",
                code="recording.damaged",
            )
        frames.append((direction, data))
    if lines[-1] != f"END {len(frames)} {crc:08x}":
        raise ReplayError(
            f"{path}: its last line does not match its {len(frames)} frames; record it again", code="recording.damaged"
        )
    return head[2], frames


class ReplayTransport(Transport):
    """Replays a recorded session; see the module for the conditions.

    Attributes
    ----------
    longest_wait : float
        Longest time for which a read waits for a write, s; short in tests that change bytes, where an answer may be
        missing.
    """

    longest_wait: ClassVar[float] = math.inf

    def __init__(self, path: Path, *, timeout: float = 1.0) -> None:
        super().__init__(f"replay://{path}", timeout)
        self.recorded_address, frames = read_recording(path)
        self.simulated = self.recorded_address.startswith("sim://")
        self._writes = deque(data for direction, data in frames if direction == "W")
        self._reads: deque[tuple[int, bytes]] = deque()  # (number of writes before, bytes)
        before = 0
        for direction, data in frames:
            if direction == "W":
                before += 1
            else:
                self._reads.append((before, data))
        self._written = 0
        self._partial = b""
        self._closed = False
        self._change = threading.Condition()

    def _send(self, data: bytes) -> None:
        with self._change:
            self._partial += data
            while self._partial:
                if not self._writes:
                    raise ReplayError(
                        f"{self.url}: expected no further write; found {self._partial!r}",
                        code="replay.write.unexpected",
                    )
                expected = self._writes[0]
                if not expected.startswith(self._partial[: len(expected)]):
                    raise ReplayError(
                        f"{self.url}: expected the driver to write {expected!r}; found {data!r}",
                        code="replay.write.differs",
                    )
                if len(self._partial) < len(expected):
                    break
                self._partial = self._partial[len(expected) :]
                self._writes.popleft()
                self._written += 1
            self._change.notify_all()

    def _receive(self, max_bytes: int, timeout: float) -> bytes:
        with self._change:
            if self._closed:
                raise InstrumentError(f"The recording {self.url} is closed", code="connection.closed")
            if not self._reads:
                raise EndOfRecordingError(f"{self.url}: the driver reads after the end of the recording")
            if not self._change.wait_for(self._readable, min(timeout, self.longest_wait)):
                raise InstrumentTimeoutError(
                    f"{self.url}: no data before the driver has written {self._writes[0]!r}",
                    code="instrument.no_answer",
                )
            if self._closed:
                raise InstrumentError(f"The recording {self.url} is closed", code="connection.closed")
            before, data = self._reads.popleft()
            if len(data) > max_bytes:
                self._reads.appendleft((before, data[max_bytes:]))
            return data[:max_bytes]

    def _readable(self) -> bool:
        return self._closed or self._reads[0][0] <= self._written

    def close(self) -> None:
        """Close; idempotent.

        Raises
        ------
        ReplayError
            The driver stops before the end of the recorded session.
        """
        with self._change:
            if self._closed:
                return
            self._closed = True
            self._change.notify_all()
            left_bytes = sum(len(data) for _, data in self._reads) + len(self._rest)
            left_writes = len(self._writes)
        if left_bytes or left_writes or self._partial:
            raise ReplayError(
                f"{self.url}: the driver stops before the end of the recording: {left_writes} writes "
                f"and {left_bytes} bytes from the device remain",
                code="replay.incomplete",
            )


def write_index(path: Path, parts: Sequence[str]) -> dict[str, Path]:
    """Write the recording of an instrument with several transports: a list of their files in the same folder.

    Return the path for each part. InstrumentError if the file exists or cannot be created.
    """
    files = {part: path.with_name(f"{path.stem}.{part}{path.suffix}") for part in parts}
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(f"{INDEX_FORMAT}\n" + "".join(f"{part} {each.name}\n" for part, each in files.items()))
    except OSError as error:
        raise InstrumentError(
            f"The recording {path} cannot be created: {error.strerror}", code="recording.not_created"
        ) from None
    return files


def read_index(path: Path) -> dict[str, Path]:
    """Return the recordings in a list, by part; ReplayError if it is not such a list."""
    try:
        if (size := require_regular(path).st_size) > MAX_INDEX:
            raise ReplayError(
                f"{path}: expected a list of recordings of at most {MAX_INDEX} bytes; found {size}",
                code="recording.too_large",
            )
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ReplayError(f"The recording {path} cannot be read: {error}", code="recording.unreadable") from None
    expected = WITH_NOTE[INDEX_FORMAT] if _has_note(lines) else INDEX_FORMAT
    if (count := len(lines) - 1 - _has_note(lines)) > MAX_PARTS:
        raise ReplayError(
            f"{path}: expected a list of at most {MAX_PARTS} recordings; found {count}", code="recording.too_many"
        )
    pairs = [line.partition(" ") for line in lines[-count:]] if count > 0 else []
    if not lines or lines[0] != expected or not all(_is_name(name) for _, _, name in pairs):
        raise ReplayError(
            f"{path} is not a list of recordings: expected a first line '{INDEX_FORMAT}'", code="recording.form"
        )
    try:
        return {part: path.with_name(name) for part, _, name in pairs}
    except ValueError:
        raise ReplayError(
            f"{path}: expected names of files in the folder of the list; found a path", code="recording.outside"
        ) from None


def _is_name(text: str) -> bool:
    return bool(text) and "\0" not in text and Path(text).name == text


def parts_of(path: Path, levels: int = 2) -> list[Path]:
    """Return the files of a recording that have frames: the file, or those that it lists, directly or indirectly."""
    try:
        require_regular(path)
        with path.open(encoding="utf-8", errors="replace") as file:
            word = file.readline(MAX_NOTE_BYTES).split(" ")[0].strip()
    except OSError as error:
        raise ReplayError(
            f"The recording {path} cannot be read: {error.strerror}", code="recording.unreadable"
        ) from None
    if word not in (INDEX_FORMAT, WITH_NOTE[INDEX_FORMAT]) or not levels:
        return [path]
    return [found for part in read_index(path).values() for found in parts_of(part, levels - 1)]


def add_note(path: Path, note: Mapping[str, Any]) -> None:
    """Write a note to a recording, or a list of recordings; it replaces an earlier one."""
    lines = path.read_text(encoding="utf-8").splitlines()
    word, _, rest = lines[0].partition(" ")
    word = WITH_NOTE.get(word, word)
    text = NOTE + json.dumps(note, allow_nan=False)
    if len(text) > MAX_NOTE_BYTES:
        raise InstrumentError(
            f"The note of the recording {path} has {len(text)} bytes; expected at most {MAX_NOTE_BYTES}",
            code="recording.note.too_long",
        )
    head = f"{word} {rest}".rstrip()
    replace_text(path, "\n".join([head, text, *lines[1 + _has_note(lines) :]]) + "\n")


def read_note(path: Path) -> dict[str, Any] | None:
    """Return the note of a recording; None without one. ReplayError if it cannot be read."""
    try:
        require_regular(path)
        with path.open(encoding="utf-8") as file:
            file.readline(MAX_NOTE_BYTES)
            line = file.readline(MAX_NOTE_BYTES)
        note = json.loads(line.removeprefix(NOTE)) if line.startswith(NOTE) else None
    except UnicodeDecodeError:
        raise ReplayError(f"{path} is not a recording: its first lines are not text", code="recording.form") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ReplayError(
            f"The note of the recording {path} cannot be read: {error}", code="recording.note.unreadable"
        ) from None
    if note is not None and not isinstance(note, dict):
        raise ReplayError(f"The note of the recording {path} is not a JSON object", code="recording.note.form")
    return note


def _has_note(lines: Sequence[str]) -> bool:
    return len(lines) > 1 and lines[1].startswith(NOTE)


def rewrite(path: Path, frames: Sequence[tuple[str, bytes]]) -> None:
    """Replace the frames of a recording by as many others; address, times and note are unchanged."""
    lines = path.read_text(encoding="ascii").splitlines()
    first = 1 + _has_note(lines)
    crc, changed = 0, lines[:first]
    for line, (direction, data) in zip(lines[first:-1], frames, strict=True):
        crc = crc32(direction.encode() + data, crc)
        changed.append(f"{direction} {line.split(' ')[1]} {crc:08x} {data.hex()}")
    replace_text(path, "\n".join([*changed, f"END {len(frames)} {crc:08x}"]) + "\n")
