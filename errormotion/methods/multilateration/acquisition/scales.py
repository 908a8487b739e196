"""Temperature of the machine's scales during a set-up, from a thermometer on the bench."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import InstrumentError, MethodError

if TYPE_CHECKING:
    from errormotion.plugins import Bench

log = logging.getLogger(__name__)


class Scales:
    """Sensors on the scales of X, Y and Z; without ``sensors`` nothing is recorded.

    Raises
    ------
    MethodError
        The bench has no thermometer, or the thermometer not these sensors.
    """

    def __init__(self, bench: Bench, sensors: tuple[str, str, str] | None) -> None:
        self.sensors = sensors
        self._read: list[Array] = []
        if sensors is None:
            return
        if not bench.has_kind("thermometer"):
            raise MethodError(
                f"measuring.scale_sensors: expected an instrument of kind 'thermometer' on the bench for "
                f"{', '.join(sensors)}; found none. Add it, or remove the setting.",
                code="bench.thermometer.missing",
            )
        self._thermometer: Any = bench.of_kind("thermometer")
        known = [str(name) for name in self._thermometer.channels]
        if missing := [name for name in sensors if name not in known]:
            raise MethodError(
                f"measuring.scale_sensors: expected sensors of the thermometer, {', '.join(known)}; found "
                f"{', '.join(dict.fromkeys(missing))}.",
                code="bench.thermometer.channels",
            )

    def poll(self) -> None:
        """Read the sensors once; a failure is logged, and the reading is omitted."""
        if self.sensors is None:
            return
        try:
            reading = self._thermometer.read()
        except InstrumentError as error:
            log.warning("no temperatures of the scales: %s", error)
            return
        self._read.append(np.array([reading.get(name, np.nan) for name in self.sensors], np.float64))

    def mean(self) -> dict[str, Any]:
        """Return the mean of the readings since the last call as a variable, degC; none without sensors."""
        if self.sensors is None:
            return {}
        read = np.array(self._read).reshape(-1, 3)
        self._read = []
        known = np.isfinite(read)
        count = known.sum(axis=0)
        mean = np.where(count > 0, np.where(known, read, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)
        return {"scale_temperature": (("station", "direction"), mean[None], {"units": "degC"})}
