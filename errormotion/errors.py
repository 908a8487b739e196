"""The exceptions of the package, with a common root.

A message states the expected and the found value, and a remedy; a code states the same meaning for programs, and
remains when the sentence is reworded. Tracebacks are written to the log.
"""

import re
from typing import Any, Self

_FORM = re.compile(r"[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*){1,3}")


def _check(code: str, where: str) -> None:
    if not _FORM.fullmatch(code):
        raise ValueError(f"{where}: expected a code of two to four dotted words, such as unit.unknown; found {code!r}")


class ErrormotionError(Exception):
    """Root of all errors with a remedy for the user.

    Parameters
    ----------
    message : str
        Description of the error, and its location.
    code : str, optional
        Stable name of its meaning, two to four dotted words from the area to the fault, such as ``unit.unknown``;
        without it, the code of the class.

    Raises
    ------
    ValueError
        The code is not of this form.
    """

    code = "error.other"

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        _check(cls.code, f"class {cls.__name__}")

    def __init__(self, message: str = "", *, code: str | None = None) -> None:
        super().__init__(message)
        if code is not None:
            _check(code, message)
            self.code = code

    def restated(self, message: str) -> Self:
        """Return the same error, with its code and its other attributes, with another message."""
        error = type(self).__new__(type(self), message)
        error.__dict__.update(self.__dict__)
        return error


class InstrumentError(ErrormotionError):
    """An instrument failed, or refused a request."""

    code = "instrument.other"


class InstrumentTimeoutError(InstrumentError):
    """An instrument did not answer within its time limit."""

    code = "instrument.no_answer"


class ProtocolError(InstrumentError):
    """Received bytes do not conform to the protocol."""

    code = "protocol.other"


class ReplayError(InstrumentError):
    """A replayed session differs from its recording."""

    code = "replay.other"


class DatasetError(ErrormotionError):
    """A dataset does not conform to its schema, or a file cannot be read.

    Parameters
    ----------
    message : str
        Description of the error, and its location.
    violations : sequence of str, optional
        All violations found, one sentence each.
    code : str, optional
        As of every error.
    """

    code = "dataset.other"

    def __init__(
        self, message: str, violations: "list[str] | tuple[str, ...]" = (), *, code: str | None = None
    ) -> None:
        self.violations = list(violations)
        super().__init__("\n  - ".join([message, *self.violations]), code=code)


class FitError(ErrormotionError):
    """The geometry does not determine the result."""

    code = "fit.other"


class MethodError(ErrormotionError):
    """A method has no result for its input."""

    code = "method.other"


class BenchError(ErrormotionError):
    """A bench or campaign file is wrong, or the bench lacks a requirement of a method."""

    code = "bench.other"


class RunError(ErrormotionError):
    """A run folder cannot be written, read or resumed."""

    code = "run.other"


class CompensationError(ErrormotionError):
    """A correction cannot be computed, or must not be written to a machine."""

    code = "compensation.other"


class PluginError(ErrormotionError):
    """A plugin is unknown or broken."""

    code = "plugin.other"


class PluginWarning(UserWarning):
    """A part of a plugin cannot be loaded and is ignored."""


class ProgramError(ErrormotionError):
    """An NC program cannot be read, or its motions are not determined."""

    code = "program.other"


def code_of(error: BaseException, other: str) -> str:
    """Return the code of an error, or ``other`` for one that is not of this package."""
    return error.code if isinstance(error, ErrormotionError) else other
