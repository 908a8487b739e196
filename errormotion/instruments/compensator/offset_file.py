"""``offset_file``: offsets in a small JSON file, for a control or another program that reads one.

Every write replaces the whole file. Its reader must ramp to zero when ``number`` has not changed for ``valid`` seconds;
the documentation has examples of a reader. If the reader writes the offset in effect to another file, `read` returns
it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field

from errormotion.datasets.files.reading import require_regular
from errormotion.datasets.files.writing import replace_text
from errormotion.datasets.units import Time
from errormotion.errors import InstrumentError
from errormotion.instruments.interlock import OffsetInterlock
from errormotion.plugins import Applied, CompensatorSubject, Identity, InstrumentInfo, PluginSettings

SCHEMA = "errormotion.offset/1"
LONGEST = 1 << 16
"""Longest file that is read, bytes."""


class OffsetFileSettings(PluginSettings):
    """Settings of the file."""

    valid: Time = Field(default=5.0, gt=0, le=60.0, description="time after which the reader must ramp to zero")
    state: str = Field(
        default="", description="file that the reader writes, with the offset in effect; default: the written offset"
    )


class OffsetFile:
    """Writes offsets to a file.

    Parameters
    ----------
    address : str
        ``file:///path/offset.json``, or a path.
    settings : OffsetFileSettings, optional
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="offset_file",
        kind="compensator",
        summary="Offsets in a file, for a control that reads one.",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.compensator.offset_reader:SimulatedReader",
    )
    Settings: ClassVar[type[PluginSettings]] = OffsetFileSettings

    @classmethod
    def conformance(cls) -> CompensatorSubject:
        """Return the subject of the conformance kit."""
        return CompensatorSubject(cls, dead_address="/nonexistent/offset.json")

    def __init__(self, address: str, settings: Any = None) -> None:
        self.address = address
        self.settings: Any = self.Settings() if settings is None else settings
        self.path = Path(address.removeprefix("file://"))
        self._interlock = OffsetInterlock(f"{self.info.id} at {address}")
        self._number = 0
        self._open = False

    def open(self) -> None:
        """Check that the folder exists.

        Raises
        ------
        InstrumentError
            The folder does not exist, or the file has another content.
        """
        if self._open:
            return
        if not self.path.parent.is_dir():
            raise InstrumentError(
                f"{self.address}: expected a folder {self.path.parent}; found none", code="offset.folder.missing"
            )
        if self.path.exists():
            content = self._content(self.path)
            number = content.get("number", 0)
            self._number = number if isinstance(number, int) and not isinstance(number, bool) else 0
        self._open = True

    def close(self) -> None:
        """Write nothing further: the file keeps the last offset, which expires after ``valid``. Idempotent."""
        self._open = False
        self._interlock.disarm()

    def identify(self) -> Identity:
        """Return the name of the file."""
        self._require_open()
        return Identity("errormotion", "offset file", self.path.name)

    def arm(self, limit: float) -> None:
        """Permit offsets up to a limit for each axis, m; nothing is written."""
        self._require_open()
        self._interlock.arm(limit)

    def read(self) -> Applied:
        """Return the offset that the reader reports, or the last one written; zero before the first."""
        self._require_open()
        source = Path(self.settings.state) if self.settings.state else self.path
        if not source.exists():
            if self.settings.state:
                raise InstrumentError(
                    f"{source}: expected a file that the reader of offsets writes; found none",
                    code="offset.file.missing",
                )
            return Applied((0.0, 0.0, 0.0))
        content = self._content(source)
        offset = [_number(content.get(axis)) for axis in "XYZ"]
        return Applied((offset[0], offset[1], offset[2]), _text(content, "busy"), _text(content, "fault"))

    def write(self, offset: Sequence[float]) -> None:
        """Replace the file.

        Raises
        ------
        InstrumentError
            The driver is not armed, an offset is beyond the limit or not finite, or the file cannot be written.
        """
        self._require_open()
        values = dict(zip("XYZ", self._interlock.offset(offset), strict=True))
        self._number += 1
        content = {"schema": SCHEMA, "number": self._number, "unit": "m", "valid": self.settings.valid, **values}
        try:
            replace_text(self.path, json.dumps(content, allow_nan=False) + "\n")
        except (OSError, ValueError) as error:
            raise InstrumentError(
                f"{self.address}: the offset cannot be written: {error}", code="offset.not_written"
            ) from None

    def _require_open(self) -> None:
        if not self._open:
            raise InstrumentError(
                f"The {self.info.id} at {self.address} is not open: call open() first", code="instrument.not_open"
            )

    def _content(self, path: Path) -> dict[str, Any]:
        try:
            require_regular(path)
            with path.open("rb") as file:
                text = file.read(LONGEST + 1)
            if len(text) > LONGEST:
                raise ValueError(f"longer than {LONGEST} bytes")
            content = json.loads(text)
            if not isinstance(content, dict) or content.get("schema") != SCHEMA:
                raise ValueError(f"expected an object with the schema {SCHEMA}")
        except (OSError, ValueError, RecursionError) as error:
            raise InstrumentError(f"{path} is not a file of offsets: {error}", code="offset.file.form") from None
        return content


def _number(value: Any) -> float:
    known = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1.0
    return float(value) if known else math.nan


def _text(content: dict[str, Any], key: str) -> str:
    value = content.get(key, "")
    return value[:200] if isinstance(value, str) else f"{key} is not a text"
