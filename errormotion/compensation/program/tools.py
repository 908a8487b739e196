"""The correction for the tool of each move: its length is a lever of the rotations."""

from __future__ import annotations

import numpy as np

from errormotion.arrays import Array
from errormotion.compensation.correction import Correction, CorrectionValues


class ByTool:
    """Corrections of positions with tools.

    Parameters
    ----------
    correction : Correction
    gauge : array (3,), optional
        Functional point of a tool of length 0, in the coordinates of the errors, m: a tool with the offset (0, 0, L)
        has its tip at ``gauge - (0, 0, L)``. Without it, all tools have the functional point of the correction.
    time : float, optional
        s, on the clock of the errors; required if they depend on time.
    """

    def __init__(self, correction: Correction, gauge: Array | None = None, time: float | None = None) -> None:
        self._correction, self._gauge, self._time = correction, gauge, time
        self._known: dict[bytes, Correction] = {}

    def __call__(self, positions: Array, tools: Array) -> CorrectionValues:
        """Return the corrections of positions (n, 3) of the axes with tool offsets (n, 3), m."""
        return self.values(positions, tools)

    def values(self, positions: Array, tools: Array, *, covariance: bool = False) -> CorrectionValues:
        """Return the corrections, optionally with their covariance."""
        if self._gauge is None:
            return self._correction.at(positions, self._time, covariance=covariance)
        changes = np.flatnonzero((tools[1:] != tools[:-1]).any(axis=1)) + 1
        parts = np.split(np.arange(len(positions)), changes)
        found = [
            self._of(tools[part[0]]).at(positions[part], self._time, covariance=covariance)
            for part in parts
            if part.size
        ]
        if len(found) == 1:
            return found[0]
        return CorrectionValues(
            np.concatenate([each.offset for each in found]),
            np.concatenate([each.covariance for each in found if each.covariance is not None]) if covariance else None,
            np.concatenate([each.valid for each in found]),
            np.concatenate([each.residual_rotation for each in found]),
        )

    def _of(self, tool: Array) -> Correction:
        assert self._gauge is not None
        key = tool.tobytes()
        if key not in self._known:
            self._known[key] = self._correction.for_tool(self._gauge - tool)
        return self._known[key]
