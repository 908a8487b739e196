"""The exceptions of the package, with a common root.

A message states the expected and the found value, and a remedy. Tracebacks are written to the log.
"""


class ErrormotionError(Exception):
    """Root of all errors with a remedy for the user."""


class InstrumentError(ErrormotionError):
    """An instrument failed, or refused a request."""


class InstrumentTimeoutError(InstrumentError):
    """An instrument did not answer within its time limit."""


class ProtocolError(InstrumentError):
    """Received bytes do not conform to the protocol."""


class ReplayError(InstrumentError):
    """A replayed session differs from its recording."""


class DatasetError(ErrormotionError):
    """A dataset does not conform to its schema, or a file cannot be read.

    Parameters
    ----------
    message : str
        Description of the error, and its location.
    violations : sequence of str, optional
        All violations found, one sentence each.
    """

    def __init__(self, message: str, violations: "list[str] | tuple[str, ...]" = ()) -> None:
        self.violations = list(violations)
        super().__init__("\n  - ".join([message, *self.violations]))


class FitError(ErrormotionError):
    """The geometry does not determine the result."""


class MethodError(ErrormotionError):
    """A method has no result for its input."""


class BenchError(ErrormotionError):
    """A bench or campaign file is wrong, or the bench lacks a requirement of a method."""


class RunError(ErrormotionError):
    """A run folder cannot be written, read or resumed."""


class CompensationError(ErrormotionError):
    """A correction cannot be computed, or must not be written to a machine."""


class PluginError(ErrormotionError):
    """A plugin is unknown or broken."""


class PluginWarning(UserWarning):
    """A part of a plugin cannot be loaded and is ignored."""


class ProgramError(ErrormotionError):
    """An NC program cannot be read, or its motions are not determined."""
