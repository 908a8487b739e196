"""Side of the receiver: whether readings on planes confirm the stated one.

With the receiver on the other side of the laser, every tilt q is -q and every plane has another inclination error. Two
planes close with any error. Three or more close with the right side only, if some are turned towards the receiver and
others away from it: across the triangulation plane both sides have the same error, and that of one plane alone turns
the direction until the planes close.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from errormotion.errors import MethodError
from errormotion.methods.beam_direction.identification.compensation import Converged, Planes, Sensor, converge
from errormotion.methods.beam_direction.identification.propagation import (
    FALSE_ALARM,
    Propagated,
    chi2_quantile,
    closure_chi2,
    propagate,
)

if TYPE_CHECKING:
    from errormotion.methods.beam_direction.settings import Settings

_NOTED = 2.0
"""Standard uncertainties of the direction from which on the effect of the side is noted."""


def check_receiver(
    planes: Planes, sensor: Sensor, converged: Converged, propagated: Propagated, settings: Settings, notes: list[str]
) -> None:
    """Refuse a stated side of the receiver that the planes contradict; note one that they do not confirm.

    Raises
    ------
    MethodError
        The planes contradict one another with the stated side, and agree with the opposite one.
    """
    opposite = replace(sensor, triangulation_normal=-sensor.triangulation_normal)
    try:
        other = converge(planes, converged.direction.direction, opposite, settings.tolerance, settings.max_iterations)
    except MethodError:  # no beam fits with the opposite side
        return
    freedom = len(planes.names) - 2
    chi2, chi2_other = closure_chi2(propagated), closure_chi2(propagate(other, None, 0.0))
    limit = chi2_quantile(1 - FALSE_ALARM, freedom) if freedom > 0 else np.inf
    turned = float(np.linalg.norm(other.direction.direction - converged.direction.direction))
    if chi2 > limit >= chi2_other:
        raise MethodError(
            f"The planes contradict the stated side of the receiver: chi-square of their closure is {chi2:.4g} with "
            f"it and {chi2_other:.4g} with the opposite one, with {freedom} degree{'s' if freedom > 1 else ''} of "
            f"freedom; expected less than {limit:.3g}. Check triangulation_normal and receiver on the sensor, and "
            f"receiver_rotation of the readings from which calibration '{sensor.calibration.name}' was made."
        )
    covariance = propagated.covariance[3:, 3:] + propagated.influence[:, 3:].T @ propagated.influence[:, 3:]
    u = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    if chi2_other <= limit and turned > _NOTED * u:
        notes.append(
            f"The planes do not show on which side of the laser the receiver is; the stated side is used. With the "
            f"opposite one the direction would differ by {np.degrees(turned) * 3600:.3g} arcsec, "
            f"{turned / u:.2g} standard uncertainties. Planes that are "
            "turned towards the receiver, away from it and across show it."
        )
