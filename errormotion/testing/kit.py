"""What a check is: a plain function that takes a subject, claims something in its docstring, and fails in words."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

Subject = TypeVar("Subject")


class CheckFailedError(AssertionError):
    """A plugin does not do what the check claims."""


@dataclass(frozen=True)
class CheckResult:
    """What came out of one check.

    Attributes
    ----------
    name : str
        Name of the check.
    ok : bool
        Whether the plugin passed; True too where the check does not apply.
    message : str
        What was seen, or what was expected and what came instead.
    seconds : float
        How long it took.
    skipped : bool
        The check does not apply to this plugin; ``message`` says why.
    trace : str
        Traceback of an exception that no check expected.
    """

    name: str
    ok: bool
    message: str
    seconds: float
    skipped: bool = False
    trace: str = ""


def applies_always(subject: object) -> str:  # noqa: ARG001 - one signature for all
    """Return no reason against running a check."""
    return ""


@dataclass(frozen=True)
class Check(Generic[Subject]):
    """A named claim about a plugin, and the function that tries it.

    ``why_not(subject)`` is empty where the check applies, else the reason why it does not.
    """

    name: str
    function: Callable[[Subject], str]
    limit: float
    why_not: Callable[[Subject], str] = applies_always

    @property
    def claim(self) -> str:
        """What the check claims, in one line."""
        return (self.function.__doc__ or "").strip().splitlines()[0]


class Checks(list[Check[Subject]]):
    """Checks in the order in which they run."""

    def add(
        self, limit: float = 30.0, why_not: Callable[[Subject], str] = applies_always
    ) -> Callable[[Callable[[Subject], str]], Callable[[Subject], str]]:
        """Return a decorator that appends a check named like its function, with a time limit in s."""

        def register(function: Callable[[Subject], str]) -> Callable[[Subject], str]:
            self.append(Check(function.__name__, function, limit, why_not))
            return function

        return register


def require(condition: bool, message: str) -> None:
    """Fail the running check with a message unless the condition holds."""
    if not condition:
        raise CheckFailedError(message)


def run_check(check: Check[Subject], subject: Subject) -> CheckResult:
    """Run one check in a thread of its own and return its result; a check that hangs fails at its time limit."""
    if reason := check.why_not(subject):
        return CheckResult(check.name, True, f"does not apply: {reason}", 0.0, skipped=True)
    box: list[CheckResult] = []
    start = time.perf_counter()

    def work() -> None:
        trace = ""
        try:
            ok, message = True, check.function(subject)
        except CheckFailedError as failure:
            ok, message = False, str(failure)
        except Exception as error:  # noqa: BLE001 - a plugin under test may raise anything
            ok, message, trace = False, f"{type(error).__name__}: {error}", traceback.format_exc()
        box.append(CheckResult(check.name, ok, message, time.perf_counter() - start, trace=trace))

    worker = threading.Thread(target=work, name=f"check-{check.name}", daemon=True)
    worker.start()
    worker.join(check.limit)
    if box:
        return box[0]
    return CheckResult(check.name, False, f"still running after {check.limit:g} s", time.perf_counter() - start)
