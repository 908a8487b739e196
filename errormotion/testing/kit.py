"""Checks: functions of a subject; the docstring states the requirement, an exception the failure."""

from __future__ import annotations

import math
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

Subject = TypeVar("Subject")


class CheckFailedError(AssertionError):
    """A plugin does not meet the requirement of a check."""


class DoesNotApplyError(Exception):
    """A check does not apply to a plugin, as its result shows; the message states the reason."""


@dataclass(frozen=True)
class CheckResult:
    """Result of one check.

    Attributes
    ----------
    name : str
        Name of the check.
    ok : bool
        Whether the plugin passed; also True if the check does not apply.
    message : str
        The observation, or the expected and the found behaviour.
    seconds : float
        Its duration.
    skipped : bool
        Whether the check does not apply to this plugin, for the reason in ``message``.
    trace : str
        Traceback of an unexpected exception.
    """

    name: str
    ok: bool
    message: str
    seconds: float
    skipped: bool = False
    trace: str = ""


def applies_always(subject: object) -> str:  # noqa: ARG001 - one signature for all
    """Return an empty reason: the check applies."""
    return ""


@dataclass(frozen=True)
class Check(Generic[Subject]):
    """A named requirement for plugins, and the function that checks it.

    ``why_not(subject)`` is empty if the check applies, else the reason why it does not; it is evaluated when tests are
    collected, and must be fast. The function raises a `DoesNotApplyError` with a reason that only a result shows.
    ``limit`` is the time limit, s, or a function that returns it; infinite for a check with its own limits.
    """

    name: str
    function: Callable[[Subject], str]
    limit: float | Callable[[Subject], float]
    why_not: Callable[[Subject], str] = applies_always

    @property
    def claim(self) -> str:
        """The requirement of the check, in one line."""
        return (self.function.__doc__ or "").strip().splitlines()[0]


class Checks(list[Check[Subject]]):
    """Checks in their order."""

    def add(
        self, limit: float | Callable[[Subject], float] = 30.0, why_not: Callable[[Subject], str] = applies_always
    ) -> Callable[[Callable[[Subject], str]], Callable[[Subject], str]]:
        """Return a decorator that appends a check with the name of its function."""

        def register(function: Callable[[Subject], str]) -> Callable[[Subject], str]:
            self.append(Check(function.__name__, function, limit, why_not))
            return function

        return register


def require(condition: bool, message: str) -> None:
    """Fail the running check with a message if the condition is false."""
    if not condition:
        raise CheckFailedError(message)


def run_check(check: Check[Subject], subject: Subject) -> CheckResult:
    """Run one check in a separate thread and return its result; a check that hangs fails at its time limit."""
    box: list[CheckResult] = []
    getattr(subject, "warm_up", lambda: None)()
    start = time.perf_counter()

    def result(ok: bool, message: str, **more: Any) -> CheckResult:
        return CheckResult(check.name, ok, message, time.perf_counter() - start, **more)

    def work() -> None:
        try:
            if reason := check.why_not(subject):
                box.append(result(True, f"does not apply: {reason}", skipped=True))
            else:
                box.append(result(True, check.function(subject)))
        except DoesNotApplyError as cause:
            box.append(result(True, f"does not apply: {cause}", skipped=True))
        except CheckFailedError as failure:
            box.append(result(False, str(failure)))
        except Exception as error:  # noqa: BLE001 - a plugin under test may raise anything
            box.append(result(False, f"{type(error).__name__}: {error}", trace=traceback.format_exc()))

    worker = threading.Thread(target=work, name=f"check-{check.name}", daemon=True)
    limit = check.limit(subject) if callable(check.limit) else check.limit
    worker.start()
    worker.join(None if math.isinf(limit) else limit)
    return box[0] if box else result(False, f"still running after {limit:g} s")
