"""The kit as test classes with one test for each check; pytest collects subclasses named ``Test...``.

A check that is found not to apply while it runs is a skipped test; ``test_NAME = None`` in the subclass omits it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar
from unittest import SkipTest

from errormotion.plugins import CompensatorSubject, InstrumentSubject, MethodSubject
from errormotion.testing.kit import Check, CheckFailedError, run_check
from errormotion.testing.run import checks_for


def _as_test(check: Check[Any]) -> Callable[[Any], None]:
    def test(self: Any) -> None:
        __tracebackhide__ = True
        result = run_check(check, self.subject)
        if result.skipped:
            raise SkipTest(result.message)
        if not result.ok:
            raise CheckFailedError(f"{check.claim}\n{result.message}\n{result.trace}".rstrip())

    test.__doc__ = check.function.__doc__
    test.__name__ = f"test_{check.name}"
    return test


def _give_tests(cls: type, subject: Any) -> None:
    for check in checks_for(subject):
        if f"test_{check.name}" not in vars(cls) and not check.why_not(subject):
            setattr(cls, f"test_{check.name}", _as_test(check))


class InstrumentConformance:
    """One test for each check that applies to the instrument that a subclass states as ``subject``."""

    subject: ClassVar[InstrumentSubject]

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        _give_tests(cls, cls.subject)


class MethodConformance:
    """One test for each check that applies to the method that a subclass states as ``subject``."""

    subject: ClassVar[MethodSubject]

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        _give_tests(cls, cls.subject)


class CompensatorConformance:
    """One test for each check that applies to the compensator that a subclass states as ``subject``."""

    subject: ClassVar[CompensatorSubject]

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        _give_tests(cls, cls.subject)
