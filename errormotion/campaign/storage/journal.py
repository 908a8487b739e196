"""The log of a run: one JSON object per line, including tracebacks."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from io import TextIOWrapper
from pathlib import Path

from errormotion.datasets.files.writing import open_to_append, sync
from errormotion.errors import ErrormotionError, RunError

ROOT = "errormotion"


def cause_of(error: BaseException) -> str:
    """Return an error as text for the operator; with its class if it is a defect of the software."""
    return str(error) if isinstance(error, ErrormotionError) else f"{type(error).__name__}: {error}"


class JsonLines(logging.Formatter):
    """Format a record as one line of JSON, with the fields given as ``extra={"data": {...}}``."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "source": record.name,
            "message": record.getMessage(),
        }
        if hasattr(record, "data"):
            line["data"] = record.data
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False, default=str)


class _Handler(logging.FileHandler):
    """Ignores write errors: a full disk must not end a measurement because of its log."""

    def _open(self) -> TextIOWrapper:
        return open(open_to_append(Path(self.baseFilename)), "a", encoding=self.encoding)

    def emit(self, record: logging.LogRecord) -> None:
        with suppress(OSError):  # errors of opening, which the standard handler does not catch
            super().emit(record)
            if record.levelno >= logging.ERROR:
                self.sync()

    def sync(self) -> None:
        """Flush the lines so far to the disk: the cause of an end, and the end, survive a power cut."""
        if self.stream is not None:
            os.fsync(self.stream.fileno())
            sync(Path(self.baseFilename).parent)

    def handleError(self, record: logging.LogRecord) -> None:
        pass


@contextmanager
def journal(path: Path, level: int = logging.INFO) -> Iterator[None]:
    """Append all log records of errormotion to a file until the end of the context.

    Raises
    ------
    RunError
        The file is a link.
    """
    if path.is_symlink():
        raise RunError(f"{path}: is a link, and links are not written through; remove it", code="journal.link")
    logger = logging.getLogger(ROOT)
    handler = _Handler(path, encoding="utf-8", delay=True)
    handler.setFormatter(JsonLines())
    before = logger.level
    logger.addHandler(handler)
    if logger.getEffectiveLevel() > level:
        logger.setLevel(level)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)
        with suppress(OSError):
            handler.sync()
        with suppress(OSError):
            handler.close()
