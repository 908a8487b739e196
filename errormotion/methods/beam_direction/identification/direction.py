"""The one of two possible directions that the planes and the nominal direction select.

Two planes, or several whose normals are in one plane, have two directions that fit: mirror images in the plane of the
normals. Each is found by a fit from its own start; where both merge, the covariance of the fit is not valid any more.
A step by the angle w across the beam u changes each condition ``gamma . u = -1`` by ``gamma . w + w^2 / 2`` to second
order. The ratio of the second part to one standard deviation is the ``curvature``: with two planes it is the standard
uncertainty divided by twice the distance to the mirror plane of the two roots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import FitError, MethodError
from errormotion.estimation.fit import Fit, fit
from errormotion.methods.beam_direction.identification.model import Beam, State

if TYPE_CHECKING:
    from errormotion.methods.beam_direction.identification.planes import Planes

MAX_GRADIENT = 10.0
"""At larger gradients the beam grazes the plane, at less than 6 degrees: 1 um across it is 10 um along the beam."""
MIN_GRADIENT = 0.8
"""-N / (N . u) is 1 or more for any plane; a sensor's inclination error is a few per cent."""
SAME_ANGLE = 0.8
"""Ratio of the angles of two roots to the nominal direction, from which on it does not distinguish them."""
EXCLUDED = 25.0
"""Difference of chi2 from which on a root is excluded by the data (5 standard deviations)."""
_MAX_CURVATURE = 1 / 6
_PARALLEL = 5.0
"""Standard deviations below which an angle between normals is not significant."""
_SAME = 1e-7
"""Angle below which two roots are one, rad."""


@dataclass(frozen=True, eq=False)
class Direction:
    """The direction of a beam with exact constants.

    Attributes
    ----------
    beam : Beam
        About the found direction.
    fit : Fit
    state : State
    other_root : ndarray (3,) or None
        Another direction that fits equally well.
    curvature : float
        Nonlinearity over one standard uncertainty; above 0.05 intervals are approximate.
    """

    beam: Beam
    fit: Fit
    state: State
    other_root: Array | None
    curvature: float

    @property
    def roots(self) -> tuple[Array, ...]:
        """All directions that fit."""
        return (self.state.direction, *([] if self.other_root is None else [self.other_root]))

    def adjusted(self) -> Beam:
        """Return the beam with constants that the readings may improve; the calibration at the tilts found here."""
        sensor, q = self.beam.sensor, self.state.tilt
        if sensor is None or q is None:
            return replace(self.beam, components=np.zeros((1, 0)))
        components, identities = sensor.components(q)
        return replace(self.beam, components=components, component_identities=identities)


def solve(beam: Beam, nominal: Array, starts: Sequence[Array] = ()) -> Direction:
    """Return the direction of a beam on planes of unknown orientation, two or more.

    Parameters
    ----------
    beam : Beam
        With exact constants; `about` is not used.
    nominal : ndarray (3,)
        Approximate direction, from sensor to target, which selects one of two roots.
    starts : sequence of ndarray (3,)
        Where the roots are searched; by default they follow from the gradients.

    Raises
    ------
    MethodError
        One plane, parallel planes, a plane at grazing incidence, readings and positions in different units, a direction
        opposite to the nominal one, or two roots that cannot be distinguished.
    """
    nominal = nominal / np.linalg.norm(nominal)
    _check_gradients(beam.planes)
    roots = list[Direction]()
    starts = starts or _starts(beam.planes, nominal)
    for start in starts:
        first = near(beam, start)
        if first is not None and all(_angle(first.state.direction, o.state.direction) > _SAME for o in roots):
            roots.append(first)
    if not roots:
        raise _merged(starts[0])
    roots.sort(key=lambda root: -float(root.state.direction @ nominal))
    best, u = roots[0], roots[0].state.direction
    others = [root for root in roots[1:] if root.fit.chi2 < best.fit.chi2 + EXCLUDED]
    if u @ nominal < 0:
        raise MethodError(
            f"The direction of the beam {_vector(u)} differs by {_degrees(_angle(u, nominal))} from the nominal "
            f"direction {_vector(nominal)} and has the opposite sign. Check that the nominal direction points from the "
            "sensor to the target, that readings increase with the distance, and whether the stage carries the sensor "
            "or the target (setting moves).",
            code="beam.direction.opposite",
        )
    other = others[0].state.direction if others else None
    if other is not None and _angle(u, nominal) > SAME_ANGLE * _angle(other, nominal):
        better = others[0].fit.chi2 < best.fit.chi2 - EXCLUDED
        if not better and _angle(u, other) > 1e-6:
            raise MethodError(
                f"Two directions fit the planes: {_vector(u)} and {_vector(other)}, {_degrees(_angle(u, nominal))} and "
                f"{_degrees(_angle(other, nominal))} from the nominal direction, which does not distinguish them. "
                "State a more accurate nominal direction, or measure a third plane that is tilted about another axis.",
                code="beam.direction.ambiguous",
            )
        if better:
            best, other = others[0], None
    if not best.curvature < _MAX_CURVATURE:
        raise _merged(best.state.direction)
    return replace(best, other_root=other)


def _merged(u: Array) -> MethodError:
    return MethodError(
        f"Within its uncertainty, the beam lies in the plane of the normals of the planes, near {_vector(u)}, "
        "where the two possible directions coincide and are not distinguished. Measure a plane that is tilted "
        "about another axis.",
        code="beam.direction.ambiguous",
    )


def near(beam: Beam, start: Array) -> Direction | None:
    """Return the direction near a start (3,); None if the planes do not determine it there."""
    beam = replace(beam, about=start)
    try:
        solution = fit(beam.problem(), what="the planes")
    except FitError:
        return None
    state = beam.state(solution.unknowns, solution.constants)
    u, S = state.direction, beam.planes.covariance[:, :3, :3]
    conditions = float(np.sum(1 / np.einsum("i,kij,j->k", u, S, u)))
    curvature = 0.5 * float(np.linalg.eigvalsh(beam.direction_covariance(solution))[-1]) * float(np.sqrt(conditions))
    return Direction(replace(beam, about=u), solution, state, None, curvature)


def _starts(planes: Planes, nominal: Array) -> tuple[Array, Array]:
    """Return two directions that meet the conditions of the measured gradients best, on both sides of their plane."""
    weight = 1 / np.sqrt(np.einsum("i,kij,j->k", nominal, planes.covariance[:, :3, :3], nominal))
    U, s, V = np.linalg.svd(planes.gradients * weight[:, None], full_matrices=True)
    foot = V[:2].T @ (U.T[:2] @ -weight / s[:2])
    height = np.sqrt(max(1 - float(foot @ foot), 0.0))
    ahead, behind = (foot + sign * height * V[2] for sign in (1.0, -1.0))
    return ahead / np.linalg.norm(ahead), behind / np.linalg.norm(behind)


def _check_gradients(planes: Planes) -> None:
    gradients = planes.gradients
    if len(gradients) < 2:
        raise MethodError(
            f"Expected two or more planes that are not parallel; found {len(gradients)}. One plane determines only the "
            "angle between the beam and its normal.",
            code="beam.planes.too_few",
        )
    size = np.linalg.norm(gradients, axis=1)
    for name, g in zip(planes.names, size, strict=True):
        if g > 50 * MAX_GRADIENT or g < MIN_GRADIENT:
            raise MethodError(
                f"{name}: the gradient of the reading with the stage position is {g:.3g} m/m; expected 1 to 10. Check "
                "that readings and stage positions have the same unit, and that the plane is at rest.",
                code="beam.gradient.implausible",
            )
        if g > MAX_GRADIENT:
            raise MethodError(
                f"{name}: grazing incidence at {_degrees(np.arcsin(1 / g))} to the surface; expected at least "
                f"{_degrees(np.arcsin(1 / MAX_GRADIENT))}. Tilt the plane towards the sensor.",
                code="beam.plane.grazing",
            )
    normals = gradients / size[:, None]
    noise = float(np.sqrt(np.max(np.linalg.eigvalsh(planes.covariance[:, :3, :3])[:, -1] / size**2)))
    spread = np.linalg.svd(normals, compute_uv=False)[1] / np.sqrt(len(normals))
    if spread < max(_PARALLEL * noise, 1e-7):
        axis = normals.mean(axis=0)
        axis /= np.linalg.norm(axis)
        raise MethodError(
            f"The planes are parallel to within {_degrees(spread)}, with a noise of {_degrees(noise)}: they "
            f"determine the angle between the beam and their common normal {_vector(axis)}, but not the rotation of "
            "the beam about it. Expected planes with different normals, such as a sine gauge turned by 90 deg.",
            code="beam.planes.parallel",
        )


def _angle(one: Array, other: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other))


def _degrees(angle: float) -> str:
    return f"{np.degrees(angle):.3g} deg"


def _vector(v: Array) -> str:
    return "({:.4f}, {:.4f}, {:.4f})".format(*(v + 0.0))
