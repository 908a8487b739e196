"""Live display of a campaign: apparent displacement of the balls after each cycle."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.methods.normal_vector.acquisition import cycle

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.methods.normal_vector.settings import NormalVectorSettings


class LiveBalls:
    """Compares each cycle with the first one.

    For display: one displacement common to all balls, by least squares from the touches in both cycles, without
    rotations and uncertainty. The result is identified from the whole record afterwards.
    """

    def __init__(self, settings: NormalVectorSettings) -> None:
        self._settings = settings
        self._first: Array | None = None
        self._since = ""

    def update(self, chunk: xr.Dataset) -> str:
        """Return a line of text with the displacement of the balls in a cycle, and the highest temperature."""
        time = float(chunk["time"].values[-1])
        number = cycle.following(self._settings, time) - 1
        position = chunk["touch"].values[-1]
        good = np.isfinite(position).all(axis=-1) & (chunk["touch_flag"].values[-1] == 0)
        parts = [f"cycle {number} of {cycle.cycles(self._settings) - 1}, {time / 60:.1f} min"]
        if self._first is None:
            self._first, self._since = (
                np.where(good[..., None], position, np.nan),
                f"cycle {number}" if number else "cold",
            )
        else:
            parts.append(self._displacement(position, good, chunk["approach"].values))
        if good.sum() < good.size:
            parts.append(f"{good.sum()} of {good.size} touches good")
        if "temperature" in chunk and np.isfinite(chunk["temperature"].values[-1]).any():
            temperature = chunk["temperature"].values[-1]
            warmest = int(np.nanargmax(temperature))
            parts.append(f"warmest {chunk['sensor'].values[warmest]} {temperature[warmest]:.1f} degC")
        return "; ".join(parts)

    def _displacement(self, position: Array, good: NDArray[np.bool_], approach: Array) -> str:
        """Return the mean displacement of the balls since the first cycle, from touches along their approach."""
        assert self._first is not None
        common = good & np.isfinite(self._first).all(axis=-1)
        direction = approach[common]
        moved = np.einsum("ik,ik->i", position[common] - self._first[common], direction)
        displacement, _, rank, _ = np.linalg.lstsq(direction, moved, rcond=None)
        if rank < 3:
            return "too few touches"
        x, y, z = displacement * 1e6
        return f"balls X {x:+.1f} Y {y:+.1f} Z {z:+.1f} um since {self._since}"
