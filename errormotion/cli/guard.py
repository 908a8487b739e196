"""Errors of commands: a message for the user, the traceback in a log file, an exit code."""

from __future__ import annotations

import functools
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from logging.handlers import RotatingFileHandler
from pathlib import Path
from traceback import format_exc
from typing import Any, ParamSpec

import typer

from errormotion.cli import output
from errormotion.errors import ErrormotionError, code_of
from errormotion.state import close_to_others, open_itself, own_folder, state_folder

OK, ERROR, USAGE, INVALID, INTERNAL, INTERRUPTED = 0, 1, 2, 3, 70, 130
NONCONFORMING, UNDECIDED = 4, 5
"""Exit codes of decisions on tolerances; see ``errormotion.cli.tolerances``."""

P = ParamSpec("P")


class UsageError(ErrormotionError):
    """The options and arguments of a command do not fit together; exit code `USAGE`."""

    code = "option.form"


def guarded(function: Callable[P, None]) -> Callable[P, None]:
    """Turn an exception of a command into a message and an exit code, as text or JSON."""

    @functools.wraps(function)
    def command(*args: P.args, **kwargs: P.kwargs) -> None:
        with _log(), _terminable():
            _run(function, args, kwargs)

    return command


def _run(function: Callable[..., None], args: Any, kwargs: Any) -> None:
    as_json = bool(kwargs.get("json_", False))
    try:
        function(*args, **kwargs)
        sys.stdout.flush()
    except (typer.Exit, typer.Abort):
        raise
    except KeyboardInterrupt as error:
        fail(f"Interrupted. {error}".strip(), error, INTERRUPTED, as_json, code="command.interrupted")
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the reader has closed the pipe
        raise typer.Exit(ERROR) from None
    except ErrormotionError as error:
        fail(str(error), error, USAGE if isinstance(error, UsageError) else ERROR, as_json)
    except OSError as error:
        name = f"{error.filename}: " if error.filename else ""
        fail(f"{name}{error.strerror or error}", error, ERROR, as_json, code="system.refused")
    except Exception as error:  # noqa: BLE001 - the last handler
        text = f"Internal error: {type(error).__name__}: {error}\n"
        text += f"The traceback is in {log_file()}." if os.access(log_file().parent, os.W_OK) else format_exc()
        fail(text, error, INTERNAL, as_json, code="error.internal")


def fail(message: str, error: BaseException, status: int, as_json: bool, *, code: str = "error.internal") -> None:
    """Print the message on stderr (and as JSON on stdout), log the traceback, and exit."""
    logging.getLogger("errormotion.cli").error("%s", message, exc_info=error)
    if as_json:
        about = {"type": type(error).__name__, "exit_code": status}
        output.show_json({"ok": False, **output.failure(message, code=code_of(error, code), **about)})
    output.show(message, err=True)
    raise typer.Exit(status)


def log_file() -> Path:
    """Return the log of the commands, ``errormotion.log`` in the user's state folder."""
    return state_folder() / "errormotion.log"


class _LogHandler(RotatingFileHandler):
    """Ignores write errors: a full disk must not end a command because of its log."""

    def _open(self) -> Any:
        """Open the log for its user only; a link is not followed."""
        descriptor = open_itself(self.baseFilename, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        return os.fdopen(descriptor, "a", encoding=self.encoding)

    def handleError(self, record: logging.LogRecord) -> None:
        pass


class _Formatter(logging.Formatter):
    """Writes control characters as escapes: a log is read on a terminal."""

    def format(self, record: logging.LogRecord) -> str:
        return output.printable(super().format(record))


@contextmanager
def _log() -> Iterator[None]:
    """Write warnings and errors to the log file, not to the terminal; 1 MB at most, and one older file."""
    path = log_file()
    handler: logging.Handler
    try:
        own_folder()
        close_to_others(path)
        handler = _LogHandler(path, maxBytes=2**20, backupCount=1, encoding="utf-8", delay=True)
    except OSError:
        # Not in the folder for temporary files: anyone could have placed a link under the name there.
        handler = logging.NullHandler()
    handler.setFormatter(_Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    handler.setLevel(logging.WARNING)
    logger = logging.getLogger("errormotion")
    before = logger.propagate
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.propagate = before
        with suppress(OSError):
            handler.close()


@contextmanager
def _terminable() -> Iterator[None]:
    """Handle SIGTERM like Ctrl-C."""
    before = signal.signal(signal.SIGTERM, _stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _stop(*_: Any) -> None:
    raise KeyboardInterrupt
