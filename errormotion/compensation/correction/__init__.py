"""Correction: the translation added to a command so that the tool reaches the commanded position.

``correction(source, functional_point)`` makes a `Correction` of an error dataset (over position, volume or time), of a
thermal model with its temperatures, or of several of them; their errors are added.

``Correction.at(positions, time=None) -> CorrectionValues``, for many points at once:

* ``positions`` (n, 3): commanded positions of X, Y, Z in machine coordinates, m.
* ``time``: a number or (n,), s on the clock of the source; required if the errors depend on time.
* ``offset`` (n, 3): translation added to the commands, m.
* ``covariance`` (n, 3, 3): of the offset, m^2; computed with ``covariance=True``, else None.
* ``valid`` (n,): False outside the measured range, where the offset is that at the limit of the range.
* ``residual_rotation`` (n, 3): rotation of the tool that three linear axes cannot compensate, rad; NaN = unknown.

``Correction.for_tool(functional_point)`` is the same correction for another tool. Derivation:
docs/explanation/correction.md.
"""

from errormotion.compensation.correction.correction import Correction, CorrectionValues, correction

__all__ = ["Correction", "CorrectionValues", "correction"]
