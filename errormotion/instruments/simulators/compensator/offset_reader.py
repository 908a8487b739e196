"""The reader of an offset file: a program on a control that applies offsets and reports the one in effect."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from errormotion.datasets.files.writing import replace_text
from errormotion.instruments.compensator.offset_file import SCHEMA
from errormotion.instruments.simulators.compensator.machine import MachinePart
from errormotion.instruments.simulators.faults import parse_fault
from errormotion.instruments.transports import Address

INTERVAL = 0.005
"""Interval between two checks of the file, s."""


class SimulatedReader:
    """Reads an offset file periodically, and writes the offset in effect to another file.

    Parameters of the address: ``folder`` (default: a new folder, which `close` removes), and those of `MachinePart`.

    Faults: ``garbage`` (the written file is damaged), ``missing`` (no file is written).

    Attributes
    ----------
    url : str
        Path of the offset file.
    driver_settings : mapping
        Settings of the compensator for this reader.
    machine : MachinePart
    """

    faults = ("garbage", "missing")

    def __init__(self, address: Address) -> None:
        self.machine = MachinePart(address)
        self._fault = parse_fault(address, self.faults).kind
        self._temporary = None if "folder" in address.params else TemporaryDirectory()
        folder = Path(address.params.get("folder") or (self._temporary.name if self._temporary else "."))
        self._offsets, self._state = folder / "offset.json", folder / "state.json"
        self.url = str(self._offsets)
        self.driver_settings = {"state": str(self._state)}
        self._number: Any = self._content().get("number")
        self._ended = threading.Event()
        self._write()
        self._thread = threading.Thread(target=self._run, name="sim-offset-reader", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the reader; idempotent."""
        self._ended.set()
        self._thread.join()
        if self._temporary is not None:
            self._temporary.cleanup()

    def _run(self) -> None:
        while not self._ended.wait(INTERVAL):
            content = self._content()
            if content.get("schema") == SCHEMA and content["number"] != self._number:
                self._number = content["number"]
                self.machine.order([content[axis] for axis in "XYZ"])
            self._write()

    def _content(self) -> dict[str, Any]:
        try:
            found: dict[str, Any] = json.loads(self._offsets.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return found

    def _write(self) -> None:
        """Write the offset in effect."""
        if self._fault == "missing":
            return
        offset = dict(zip("XYZ", self.machine.offset, strict=True))
        content = {"schema": SCHEMA, "busy": self.machine.busy, "fault": self.machine.fault, **offset}
        replace_text(self._state, "damaged" if self._fault == "garbage" else json.dumps(content), flush=False)
