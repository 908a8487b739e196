"""Compensations for other processes: present state, and the request to ramp to zero and end.

A compensation writes its present state into its run folder, and checks there for the request. Other programs need
access to the folder only.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from errormotion.campaign.folder import is_locked
from errormotion.compensation.online.settings import Limits
from errormotion.datasets.files.reading import read_bytes, visible
from errormotion.datasets.files.writing import open_to_append, replace_text
from errormotion.errors import CompensationError

AUDIT = "audit.jsonl"
"""Audit log in the run folder."""
STATUS = "status.json"
"""Present state in the run folder, replaced at each period."""
STOP = "stop"
"""File in the run folder that requests the compensation to ramp to zero and end."""
MAX_STATUS = 1 << 18
"""Largest size of a status, bytes."""
MAX_COMPENSATIONS = 1000
"""Number of compensations of a folder that are listed, from the newest on."""

Number = Annotated[float, Field(allow_inf_nan=False)] | None
Vector = tuple[Number, Number, Number]
Twist = tuple[Number, Number, Number, Number, Number, Number]
Text = Annotated[str, Field(max_length=2000)]


class Status(BaseModel):
    """Present state of a compensation; SI, unknown numbers are None.

    Attributes
    ----------
    time : datetime
        Time of the state.
    machine, bench, compensator : str
    armed : bool
        Whether offsets are written.
    limits : Limits
    state, cause : str
        State, and the reason why the offset does not follow the prediction.
    stopping, ended : bool
        Whether a ramp to zero was requested; whether the compensation has ended.
    elapsed : float
        Time since the start, s.
    offset : (3,)
        Decided offset, m.
    applied : (3,), optional
        Offset in effect as the machine reports it, m; None if it is not read.
    predicted, uncertainty : (6,)
        Predicted errors, m and rad, and their standard uncertainty.
    inputs : mapping of str to float
        Inputs of the model as used: degC, 1/min, m/s.
    missing, doubtful, outside, limited : tuple of str
        Unknown inputs, inputs whose sensors no longer measure, inputs outside the range of the training data, axes
        whose target exceeds the limit.
    estop : bool, optional
        Emergency stop as the controller reports it; None if unknown.
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
    doubtful: tuple[Text, ...] = ()
    outside: tuple[Text, ...]
    limited: tuple[Text, ...]
    estop: bool | None
    program: Text

    @property
    def at_zero(self) -> bool | None:
        """Whether the offset in effect is zero as the machine reports it; None if unknown."""
        if self.applied is None or any(each is None for each in self.applied):
            return None
        return is_zero(self.applied)


ZERO = 5e-9
"""Largest offset in effect that counts as zero, m: half of the coarsest usual resolution of a register."""


def is_zero(applied: Vector) -> bool:
    """Return whether an offset in effect is zero within the resolution of its report."""
    return all(each is not None and abs(each) <= ZERO for each in applied)


def write_status(folder: Path, status: Status) -> None:
    """Replace the present state of a compensation by a rename; on a full disk the previous one remains.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    replace_text(folder / STATUS, status.model_dump_json(), flush=False)


def read_status(folder: Path) -> Status:
    """Return the present or the last state of a compensation.

    Raises
    ------
    CompensationError
        The folder has no state, or it is damaged.
    """
    path = folder / STATUS
    try:
        return Status.model_validate_json(read_bytes(path, MAX_STATUS))
    except OSError as error:
        raise CompensationError(
            f"{path}: the state of the compensation cannot be read: {error.strerror}",
            code="compensation.state.unreadable",
        ) from None
    except ValidationError as error:
        raise CompensationError(
            f"{path}: expected the state of a compensation: {error.errors()[0]['msg']}", code="compensation.state.form"
        ) from None


def is_working(folder: Path) -> bool:
    """Return whether a compensation is running: its process holds the lock of its run folder."""
    if not (folder / AUDIT).is_file():  # created under the lock; before that, the lock is not tested
        return False
    try:
        return is_locked(folder)
    except ImportError:  # Windows: no lock; a compensation with a recent state is running
        try:
            status = read_status(folder)
        except CompensationError:
            return False
        return not status.ended and (datetime.now(UTC) - status.time).total_seconds() < 10 * status.limits.period


def compensations(runs: Path) -> Iterator[Path]:
    """Yield the run folders of compensations in a folder of runs, the newest first."""
    if runs.is_dir():
        folders = sorted(
            (path.parent for path in visible(runs, f"*/{AUDIT}")), key=lambda path: path.name, reverse=True
        )
        yield from folders[:MAX_COMPENSATIONS]


def request_stop(folder: Path) -> None:
    """Request a compensation to ramp to zero and end, as Ctrl-C does; a repeated request has no effect.

    Raises
    ------
    CompensationError
        The compensation is not running, or the request cannot be written.
    """
    if not is_working(folder):
        raise CompensationError(
            f"{folder}: no compensation is running in this folder; there is nothing to stop.",
            code="compensation.not_running",
        )
    try:
        os.close(open_to_append(folder / STOP))
    except OSError as error:
        raise CompensationError(
            f"{folder / STOP}: cannot be written: {error.strerror}. Stop the command by Ctrl-C in its terminal.",
            code="compensation.stop.unwritable",
        ) from None


def numbers(values: Iterable[float]) -> tuple[Any, ...]:
    """Return numbers for a status or a log; None if unknown."""
    return tuple(float(each) if math.isfinite(each) else None for each in values)
