"""Correction: the translation by which a command must be changed so that the tool is where it was meant.

``correction(source, functional_point)`` makes a `Correction` of an error dataset (over position, volume or time), of a
thermal model with its temperatures, or of several of them whose errors add up.

``Correction.at(positions, time=None) -> CorrectionValues``, for many points at once:

* ``positions`` (n, 3): commanded positions of X, Y, Z in machine coordinates, m; where the work is meant to be.
* ``time``: a number or (n,), s on the clock of the source; needed where the errors depend on time.
* ``offset`` (n, 3): what is added to the commands, m.
* ``covariance`` (n, 3, 3): of the offset, m^2; None unless asked for (``covariance=True``).
* ``valid`` (n,): False outside of what was measured, where the offset is held at its value at the edge.
* ``residual_rotation`` (n, 3): rotation of the tool that three linear axes cannot take off, rad; NaN = unknown.

``Correction.for_tool(functional_point)`` is the same correction for another tool. Derivation:
docs/explanation/correction.md.
"""

from errormotion.compensation.correction.correction import Correction, CorrectionValues, correction

__all__ = ["Correction", "CorrectionValues", "correction"]
