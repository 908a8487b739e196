"""The drift during the measurement: the last mean relative to the reference state."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.methods.spindle_drift.identification.averaging import Averager, slices
from errormotion.methods.spindle_drift.identification.bar import errors_of, states
from errormotion.methods.spindle_drift.identification.times import first_and_last
from errormotion.methods.spindle_drift.schema import CHANNELS

if TYPE_CHECKING:
    from errormotion.methods.spindle_drift.settings import SpindleDriftSettings


_ARCSEC = np.degrees(1.0) * 3600.0


class LiveDrift:
    """Errors of a drift record while it is acquired, in constant memory.

    For display: without uncertainty, and not corrected for the expansion of the frame. The result is identified from
    the whole record afterwards.
    """

    def __init__(self, settings: SpindleDriftSettings) -> None:
        self._settings = settings
        self._averager = Averager(len(CHANNELS), settings.average, settings.min_valid)
        self._start: float | None = None
        self._reference: Array | None = None
        self.errors = np.full(5, np.nan)

    def update(self, chunk: xr.Dataset) -> str:
        """Add a chunk of the raw dataset; return the errors of its last known mean as a line of text."""
        for time, part in slices(chunk):
            if self._start is None:
                self._start, _ = first_and_last(time)
            averages = self._averager.update(time, part["distance"].transpose("channel", "time").values)
            known = np.isfinite(averages.mean).all(axis=0)
            reference_time = self._settings.reference_time
            known &= averages.time >= self._start + (
                self._settings.spin_up if reference_time is None else reference_time
            )
            if known.any():
                self._evaluate(averages.mean[:, known], chunk)
        return self.text()

    def _evaluate(self, mean: Array, chunk: xr.Dataset) -> None:
        origin, direction = (
            chunk[name].transpose("channel", "direction").values for name in ("beam_origin", "beam_direction")
        )
        levels, radius = chunk["level"].values, float(chunk["bar_radius"])
        first, last = (states(each, origin, direction, radius, levels) for each in (mean[:, :1], mean[:, -1:]))
        if self._reference is None:
            self._reference = first
        self.errors = errors_of(last, self._reference, self._reference[0, :3])[0]

    def text(self) -> str:
        """Return the last errors in um and arcsec; an empty text before the first errors."""
        if not np.isfinite(self.errors).all():
            return ""
        x, y, z = self.errors[:3] * 1e6
        a, b = self.errors[3:] * _ARCSEC
        return f"EX {x:+.2f} EY {y:+.2f} EZ {z:+.2f} um, EA {a:+.1f} EB {b:+.1f} arcsec"
