"""Exported tables of trackers without a documented interface, read like a live tracker."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import xarray as xr
from pydantic import Field

from errormotion.datasets.files.reading import read_bytes
from errormotion.datasets.units import Length
from errormotion.errors import DatasetError, InstrumentError, ReplayError
from errormotion.instruments.driver import Openable
from errormotion.instruments.laser_tracker.table_reader import AIR, MAX_TABLE, Readings, Repeats, read_table
from errormotion.plugins import Identity, InstrumentInfo, InstrumentSubject, PluginSettings
from errormotion.plugins.readings import Environment

UNITS = {"displacement": "m", "temperature": "degC", "pressure": "Pa", "humidity": "%"}


class TrackerTableSettings(PluginSettings):
    """Settings of ``tracker_table``."""

    stations: tuple[str, ...] | None = Field(
        default=None, description="names of the stations in the order of the result; default: those of the table"
    )
    repeats: Repeats = Field(
        default="refuse", description="treatment of a second line for a station and target: refuse, last, or mean"
    )
    least_length: Length = Field(
        default=0.01,
        description="lower limit of the longest length, to detect wrong units; 0: no check",
        ge=0,
    )
    noise: Length = Field(default=0.5e-6, description="standard deviation of a length", ge=0)


class TrackerTable(Openable):
    """Lengths by station and target from a table that the software of a tracker has exported.

    Parameters
    ----------
    address : str
        The table: a path, or ``file://path``; ``replay://path`` reads a recording, which is a copy of the table.
    settings : TrackerTableSettings, optional
    record : Path, optional
        Copy of the table that is written.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="tracker_table",
        kind="laser_tracker",
        summary="Exported tables of trackers (LaserTRACER and others): station, target, length, air",
        status="simulated_only",
    )
    Settings: ClassVar[type[TrackerTableSettings]] = TrackerTableSettings

    @classmethod
    def conformance(cls) -> InstrumentSubject:
        """Return the subject of the conformance kit."""
        from errormotion.instruments.laser_tracker.table_conformance import length_table

        return InstrumentSubject(cls, str(length_table()))

    def __init__(
        self, address: str, settings: TrackerTableSettings | None = None, *, record: Path | None = None
    ) -> None:
        self.address = address
        self.settings = TrackerTableSettings() if settings is None else settings
        self._record = record
        self._digest = ""
        self._readings: Readings | None = None

    def open(self) -> None:
        """Read the table; idempotent.

        Raises
        ------
        InstrumentError
            The file does not exist, or has mistakes; the message lists them with their lines, see `table_reader`.
        """
        if self._readings is not None:
            return
        scheme, mark, rest = self.address.rpartition("://")
        if mark and scheme not in ("file", "replay"):
            raise InstrumentError(
                f"Expected the path of a table, such as lengths.csv; found '{self.address}'", code="address.form"
            )
        wrong = ReplayError if scheme == "replay" else InstrumentError
        path = Path(rest)
        try:
            data = read_bytes(path, MAX_TABLE)
            readings = read_table(
                path,
                stations=self.settings.stations,
                repeats=self.settings.repeats,
                least_length=self.settings.least_length,
            )
        except OSError as error:
            raise wrong(f"The table {path} cannot be read: {error.strerror}", code="table.lengths.unreadable") from None
        except DatasetError as error:
            raise wrong(str(error), code=error.code) from error
        if self._record is not None:
            try:
                with self._record.open("xb") as copy:
                    copy.write(data)
            except OSError as error:
                raise InstrumentError(
                    f"The recording {self._record} cannot be created: {error.strerror}", code="recording.not_created"
                ) from None
        self._digest, self._readings = hashlib.sha256(data).hexdigest(), readings

    def close(self) -> None:
        """Discard the table; idempotent."""
        self._readings = None

    @property
    def distance_is_displacement(self) -> bool:
        """True: lengths may have any zero, since the dead path of each station is unknown."""
        return True

    @property
    def readings(self) -> Readings:
        """Contents of the table; InstrumentError before ``open``."""
        if self._readings is None:
            raise InstrumentError(
                f"The tracker_table at {self.address} is not open: use it in a 'with' block, or call open() first",
                code="instrument.not_open",
            )
        return self._readings

    def identify(self) -> Identity:
        """Return the identity of the table: its hash, its stations and targets, and missing lengths."""
        readings = self.readings
        return Identity(
            manufacturer="table",
            model="exported lengths",
            serial_number=self._digest[:16],
            details={
                "address": self.address,
                "stations": list(readings.stations),
                "targets": len(readings.targets),
                "missing": dict(readings.missing),
                "repeated": readings.repeated,
            },
        )

    def read(self) -> np.ndarray[Any, Any]:
        """Return all lengths, m, (station, target); NaN where missing."""
        return self.readings.length.copy()

    def environment(self) -> Environment:
        """Return the mean conditions of the air of all measurements; NaN if the table has none."""
        means = []
        for name in AIR:
            values = getattr(self.readings, name)
            known = values[np.isfinite(values)]
            means.append(float(known.mean()) if known.size else float("nan"))
        return Environment(*means)

    def table(self) -> xr.Dataset:
        """Return ``displacement(station, target)`` in m, and the air: ``temperature``, ``pressure``, ``humidity``.

        Air is in degC, Pa and %. Quantities that the table does not contain are omitted.
        """
        readings, dims = self.readings, ("station", "target")
        found = {"displacement": readings.length, **{name: getattr(readings, name) for name in AIR}}
        return xr.Dataset(
            {
                name: (dims, values, {"units": UNITS[name]})
                for name, values in found.items()
                if name == "displacement" or np.isfinite(values).any()
            },
            {"station": list(readings.stations), "target": list(readings.targets)},
        )
