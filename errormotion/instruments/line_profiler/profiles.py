"""What line profilers hand over: samples whose channels are the points of a line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from errormotion.plugins import Samples

Array = np.ndarray[Any, Any]


@dataclass(frozen=True, kw_only=True)
class Profiles(Samples):
    """A block of profiles. ``values`` (point, n) are heights in m, ``rate`` is profiles per second.

    ``dropped`` counts profiles, ``invalid`` counts points by reason.

    Attributes
    ----------
    x : ndarray, float64, (point,)
        Where on the line the points are, m.
    trigger : ndarray, int64, (n,)
        The device's count of triggers, of lost profiles too.
    encoder : ndarray, float64, (n,)
        The device's count of encoder pulses, its overflow undone; NaN where the profile was lost.
    intensity : ndarray, uint16, (n, point), or None
        Brightness of the points, 0 to 1023, where the device sends it; 0 where the profile was lost.
    y : ndarray, float64, (n,), or None
        Where along the feed the profiles lie, m, where that is known.
    """

    x: Array
    trigger: Array
    encoder: Array
    intensity: Array | None = None
    y: Array | None = None

    @property
    def heights(self) -> Array:
        """The same heights as rows, (n, point), contiguous."""
        return self.values.T
