"""The 21 errors of a three-axis machine from the errors of targets: `errormotion.kinematics.volumes` with a reflector.

With one position of the reflector, errors without effect on it, or with the same effect as others, are not determined:
rotations of the axis that carries it, and those of others with a constant lever.
"""

from __future__ import annotations

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.machines import Machine
from errormotion.kinematics.volumes import AxisErrors, Targets, Volume, fitted

AXES = ("X", "Y", "Z")


def volume_of(chain: str, position: Array, reflector: Array) -> Volume:
    """Return the volume of targets at axis positions (m, 3) with reflectors (m, 3), m; errors are stated at their mean.

    Raises
    ------
    MethodError
        Not a chain, or other axes than X, Y and Z.
    """
    reference = np.asarray(reflector, dtype=float).mean(axis=0)
    try:
        machine = Machine(chain, dict.fromkeys(AXES, reference))
    except ValueError as error:
        raise MethodError(f"Chain of the machine: {error}") from error
    if machine.axis_names != AXES:
        raise MethodError(
            f"Parametric errors: expected a machine with the axes X, Y and Z; found {', '.join(machine.axis_names)}"
        )
    return Volume.of(machine, position)


def reference_of(axes: AxisErrors) -> Array:
    """Return the point with all axes at zero at which the error motions are stated, (3,), m."""
    return axes.volume.machine.joints[0].reference


def fit_machine(
    chain: str,
    position: Array,
    error: Array,
    own: Array,
    influence: Array,
    *,
    reflector: Array | None = None,
    max_order: int = 12,
) -> AxisErrors:
    """Estimate the errors of the axes from displacements at targets.

    Parameters
    ----------
    chain : str
        Such as ``workpiece-X-Y-bed-Z-spindle-tool``.
    position : ndarray (m, 3)
        Commanded axis positions, m.
    error : ndarray (m, 3)
        Displacements in any datum, m; NaN if unknown.
    own : ndarray (m, 3, 3)
        Independent covariance of each target, m^2.
    influence : ndarray (source, m, 3)
        Effect of one standard uncertainty of each shared source, m.
    reflector : ndarray (m, 3), optional
        Position of the reflector of each target with all axes at zero, m; default: the origin.
    max_order : int
        Of the polynomials.

    Raises
    ------
    MethodError
        Not a chain of X, Y and Z; too few known targets.
    """
    known = np.flatnonzero(np.isfinite(error).all(axis=1) & np.isfinite(own).all(axis=(1, 2)))
    if len(known) < 10:
        raise MethodError(f"Parametric errors: expected at least ten known targets; found {len(known)}. Measure more.")
    at = np.zeros_like(position) if reflector is None else reflector
    q, tool = position[known], at[known]
    targets = Targets(q, tool, error[known], own[known], influence[:, known])
    return fitted(volume_of(chain, q, tool), targets, max_order)


def misfit_note(axes: AxisErrors, max_order: int) -> list[str]:
    """Return a note on targets whose errors the axes do not explain."""
    if axes.factor == 1.0:
        return []
    return [
        f"The residuals of the targets' errors after the errors of the axes are {axes.sigma0:.3g} times their "
        "uncertainty. Possible causes: a machine that is not rigid, hysteresis, or error motions of higher order "
        f"than {max_order}. The uncertainties of the axes are increased accordingly."
    ]
