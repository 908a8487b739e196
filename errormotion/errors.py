"""Every exception that a user may meet, from one root.

A message states what was expected, what was found, and what to do. A traceback belongs in the log.
"""


class ErrormotionError(Exception):
    """Root of all errors that a person can act on."""


class InstrumentError(ErrormotionError):
    """An instrument failed, or refused a request."""


class InstrumentTimeoutError(InstrumentError):
    """An instrument stayed silent for longer than its time limit."""


class ProtocolError(InstrumentError):
    """Bytes came that the protocol does not allow."""


class ReplayError(InstrumentError):
    """A replayed session and its recording part ways."""


class DatasetError(ErrormotionError):
    """A dataset does not follow its schema, or a file cannot be read.

    Parameters
    ----------
    message : str
        What is wrong, and where.
    violations : sequence of str, optional
        All violations found, one sentence each.
    """

    def __init__(self, message: str, violations: "list[str] | tuple[str, ...]" = ()) -> None:
        self.violations = list(violations)
        super().__init__("\n  - ".join([message, *self.violations]))


class FitError(ErrormotionError):
    """Geometry that does not determine the result."""


class MethodError(ErrormotionError):
    """A method cannot answer from what it was given."""


class BenchError(ErrormotionError):
    """A bench or campaign file is wrong, or the bench does not offer what a method needs."""


class RunError(ErrormotionError):
    """A run folder cannot be written, read or resumed."""


class CompensationError(ErrormotionError):
    """A correction cannot be made, or must not be written to a machine."""


class PluginError(ErrormotionError):
    """A plugin is unknown or broken."""


class PluginWarning(UserWarning):
    """A part of a plugin does not load and is ignored."""


class ProgramError(ErrormotionError):
    """An NC program cannot be read, or what it does is not determined."""
