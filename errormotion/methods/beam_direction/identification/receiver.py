"""Side of the receiver: whether readings on planes confirm the stated one.

With the receiver on the other side of the laser, every tilt q is -q and every plane has another inclination error. Two
planes close with any error. Three or more close with the right side only, if some are turned towards the receiver and
others away from it: across the triangulation plane both sides have the same error, and that of one plane alone turns
the direction until the planes close.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from errormotion.errors import MethodError
from errormotion.estimation.fit import Fit
from errormotion.estimation.linear.system import linearised
from errormotion.methods.beam_direction.identification.direction import Direction, near

FALSE_ALARM = 1e-3
"""Probability that the planes contradict the right side."""
_NOTED = 2.0
"""Standard uncertainties of the direction from which on the effect of the side is noted."""


def check_receiver(detected: Direction, closed: Fit, notes: list[str]) -> None:
    """Refuse a stated side of the receiver that the planes contradict; note one that they do not confirm.

    Parameters
    ----------
    detected : Direction
        With exact constants.
    closed : Fit
        With adjusted constants and without known points.
    notes : list of str

    Raises
    ------
    MethodError
        The planes contradict one another with the stated side, and agree with the opposite one.
    """
    sensor, u = detected.beam.sensor, detected.state.direction
    if sensor is None:
        return
    opposite = replace(sensor, triangulation_normal=-sensor.triangulation_normal)
    other = near(replace(detected.beam, sensor=opposite), u)
    if other is None:  # no beam fits with the opposite side
        return
    mirrored = _adjusted_chi2(other)
    freedom = len(detected.beam.planes.names) - 2
    limit = float(chdtri(freedom, FALSE_ALARM)) if freedom > 0 else np.inf
    if closed.chi2 > limit >= mirrored:
        raise MethodError(
            f"The planes contradict the stated side of the receiver: chi-square of their closure is {closed.chi2:.4g} "
            f"with it and {mirrored:.4g} with the opposite one, with {freedom} degree{'s' if freedom > 1 else ''} "
            f"of freedom; expected less than {limit:.3g}. Check triangulation_normal and receiver on the sensor, and "
            f"receiver_rotation of the readings from which calibration '{sensor.calibration.name}' was made.",
            code="beam.receiver.contradicted",
        )
    turned = float(np.linalg.norm(other.state.direction - u))
    deviation = float(np.sqrt(np.linalg.eigvalsh(detected.beam.direction_covariance(closed))[-1]))
    if mirrored <= limit and turned > _NOTED * deviation:
        notes.append(
            f"The planes do not show on which side of the laser the receiver is; the stated side is used. With the "
            f"opposite one the direction would differ by {np.degrees(turned) * 3600:.3g} arcsec, "
            f"{turned / deviation:.2g} standard uncertainties. Planes that are "
            "turned towards the receiver, away from it and across show it."
        )


def _adjusted_chi2(detected: Direction) -> float:
    """Return chi-square with constants that the readings improve, to first order about exact ones.

    With the wrong side they are improved by many standard uncertainties, where the equations bend.
    """
    problem = detected.adjusted().started(detected.fit.unknowns._replace(beam=np.zeros((1, 2)))).problem()
    linear = linearised(problem, problem.start)
    normal, a, b = linear.normal()
    x, z = normal.solve(a[..., None], b[..., None])
    return linear.chi2 - float(np.vdot(a, x[..., 0]) + b @ z[:, 0])
