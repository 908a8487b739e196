"""Compensations of a folder of runs, seen from outside: what each does now, and the request to ramp to zero and end.

A compensation writes its present state into its run folder, and looks there for the request. Another program needs
neither its process nor its terminal.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from errormotion.campaign.folder import is_locked
from errormotion.compensation.online.settings import Limits
from errormotion.datasets.files.reading import read_bytes
from errormotion.errors import CompensationError

AUDIT = "audit.jsonl"
"""Audit log in the run folder."""
STATUS = "status.json"
"""Present state in the run folder, replaced at each period."""
STOP = "stop"
"""File in the run folder that asks for a ramp to zero and the end."""
LARGEST_STATUS = 1 << 18
"""Bytes of a status that are read."""
MOST = 1000
"""Compensations of a folder that are listed, the newest."""

Number = Annotated[float, Field(allow_inf_nan=False)] | None
Vector = tuple[Number, Number, Number]
Twist = tuple[Number, Number, Number, Number, Number, Number]
Text = Annotated[str, Field(max_length=2000)]


class Status(BaseModel):
    """What a compensation does now; SI, unknown numbers are None.

    Attributes
    ----------
    time : datetime
        When it was written.
    machine, bench, compensator : str
    armed : bool
        Whether offsets are written.
    limits : Limits
    state, cause : str
        State, and why the offset does not follow the prediction.
    stopping, ended : bool
        Whether it was asked to ramp to zero; whether it has ended.
    elapsed : float
        s since its start.
    offset : (3,)
        Offset that was decided, m.
    applied : (3,), optional
        Offset in effect as the machine reports it, m; None where it is not read.
    predicted, uncertainty : (6,)
        Predicted errors, m and rad, and their standard uncertainty.
    inputs : mapping of str to float
        Inputs of the model as used: degC, 1/min, m/s.
    missing, outside, limited : tuple of str
        Inputs that are unknown, inputs outside the range of the training, axes whose target is beyond the limit.
    estop : bool, optional
        Emergency stop as the controller reports it; None where it is not known.
    program : str
        Program of the controller.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")
    time: datetime
    machine: Text
    bench: Text
    compensator: Text
    armed: bool
    limits: Limits
    state: Text
    cause: Text
    stopping: bool
    ended: bool = False
    elapsed: float
    offset: Vector
    applied: Vector | None
    predicted: Twist
    uncertainty: Twist
    inputs: dict[Text, Number] = Field(max_length=2000)
    missing: tuple[Text, ...]
    outside: tuple[Text, ...]
    limited: tuple[Text, ...]
    estop: bool | None
    program: Text

    @property
    def at_zero(self) -> bool | None:
        """Whether the offset in effect is zero as the machine reports it; None where it is not known."""
        if self.applied is None or any(each is None for each in self.applied):
            return None
        return is_zero(self.applied)


ZERO = 5e-9
"""Offset in effect that counts as zero, m: half of the coarsest resolution of a register that is usual."""


def is_zero(applied: Vector) -> bool:
    """Return whether an offset in effect is zero, by the resolution of the machine's report."""
    return all(each is not None and abs(each) <= ZERO for each in applied)


def write_status(folder: Path, status: Status) -> None:
    """Replace the present state of a compensation by a rename; a full disk leaves the older one.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    part = folder / f".{STATUS}.part"
    part.write_text(status.model_dump_json(), encoding="utf-8")
    part.replace(folder / STATUS)


def read_status(folder: Path) -> Status:
    """Return the present state of a compensation, or its last one.

    Raises
    ------
    CompensationError
        The folder has none, or it is damaged.
    """
    path = folder / STATUS
    try:
        return Status.model_validate_json(read_bytes(path, LARGEST_STATUS))
    except OSError as error:
        raise CompensationError(f"{path}: the state of the compensation cannot be read: {error.strerror}") from None
    except ValidationError as error:
        raise CompensationError(f"{path}: expected the state of a compensation: {error.errors()[0]['msg']}") from None


def is_working(folder: Path) -> bool:
    """Return whether a process works on a compensation: it holds the lock of its run folder."""
    if not (folder / AUDIT).is_file():  # it is made under the lock, so that the lock is never asked for before
        return False
    try:
        return is_locked(folder)
    except ImportError:  # Windows: no lock; what was written lately is at work
        try:
            status = read_status(folder)
        except CompensationError:
            return False
        return not status.ended and (datetime.now(UTC) - status.time).total_seconds() < 10 * status.limits.period


def compensations(runs: Path) -> Iterator[Path]:
    """Yield the run folders of compensations in a folder of runs, the newest first."""
    if runs.is_dir():
        found = sorted((path.parent for path in runs.glob(f"*/{AUDIT}")), key=lambda path: path.name, reverse=True)
        yield from found[:MOST]


def request_stop(folder: Path) -> None:
    """Ask a compensation to ramp to zero and end, as Ctrl-C does; asking again changes nothing.

    Raises
    ------
    CompensationError
        No process works on it, or the request cannot be written.
    """
    if not is_working(folder):
        raise CompensationError(f"{folder}: no compensation is at work here; there is nothing to stop.")
    try:
        (folder / STOP).touch()
    except OSError as error:
        raise CompensationError(
            f"{folder / STOP}: cannot be written: {error.strerror}. End the command itself by Ctrl-C."
        ) from None


def numbers(values: Iterable[float]) -> tuple[Any, ...]:
    """Return numbers for a status or a log; None where unknown."""
    return tuple(float(each) if math.isfinite(each) else None for each in values)
