"""What a command does when something goes wrong: one message for a person, the traceback into a log, an exit code."""

from __future__ import annotations

import functools
import logging
import os
import signal
import sys
import tempfile
from collections.abc import Callable
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any, ParamSpec

import typer

from errormotion.cli import output
from errormotion.errors import ErrormotionError

OK, ERROR, USAGE, INVALID, INTERNAL, INTERRUPTED = 0, 1, 2, 3, 70, 130

P = ParamSpec("P")


def guarded(function: Callable[P, None]) -> Callable[P, None]:
    """Turn what a command raises into a message and an exit code; its option ``json_`` decides how it is said."""

    @functools.wraps(function)
    def command(*args: P.args, **kwargs: P.kwargs) -> None:
        as_json = bool(kwargs.get("json_", False))
        signal.signal(signal.SIGTERM, _stop)
        log_to_file()
        try:
            function(*args, **kwargs)
            sys.stdout.flush()
        except (typer.Exit, typer.Abort):
            raise
        except KeyboardInterrupt as error:
            fail("Interrupted.", error, INTERRUPTED, as_json)
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the reader has gone: nothing to tell it
            raise typer.Exit(ERROR) from None
        except ErrormotionError as error:
            fail(str(error), error, ERROR, as_json)
        except OSError as error:
            name = f"{error.filename}: " if error.filename else ""
            fail(f"{name}{error.strerror or error}", error, ERROR, as_json)
        except Exception as error:  # noqa: BLE001 - the last place where it can be told to a person
            text = f"Something went wrong that should not have: {type(error).__name__}: {error}\n"
            text += f"The traceback is in {log_file()}."
            fail(text, error, INTERNAL, as_json)

    return command


def fail(message: str, error: BaseException, code: int, as_json: bool) -> None:
    """Say what went wrong on stderr (and as JSON on stdout), log the traceback, and exit."""
    logging.getLogger("errormotion.cli").error("%s", message, exc_info=error)
    if as_json:
        output.show_json({"ok": False, "error": {"type": type(error).__name__, "message": message, "exit_code": code}})
    typer.echo(message, err=True)
    raise typer.Exit(code)


def log_file() -> Path:
    """Return the log of the commands, ``errormotion.log`` in the user's state folder."""
    state = os.environ.get("XDG_STATE_HOME")
    base = Path(state) if state else Path.home() / ".local" / "state"
    return base / "errormotion" / "errormotion.log"


def log_to_file() -> None:
    """Send what errormotion logs to its file, 1 MB and one older file at most; and keep it off the terminal."""
    logger = logging.getLogger("errormotion")
    if any(isinstance(handler, RotatingFileHandler) for handler in logger.handlers):
        return
    path = log_file()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handler = RotatingFileHandler(path, maxBytes=2**20, backupCount=1, encoding="utf-8", delay=True)
    except OSError:
        handler = RotatingFileHandler(Path(tempfile.gettempdir()) / "errormotion.log", delay=True)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    handler.setLevel(logging.WARNING)
    logger.addHandler(handler)
    logger.propagate = False


def _stop(*_: Any) -> None:
    """Obey a request to end (SIGTERM) as Ctrl-C is obeyed: in order."""
    raise KeyboardInterrupt


__all__ = ["ERROR", "INTERNAL", "INTERRUPTED", "INVALID", "OK", "USAGE", "fail", "guarded", "log_file", "log_to_file"]
