"""From readings to radial deviations, parameters of the path and the figures of the standard.

The bar reads ``L = |R u + o + e| `` with the set-up offset o of the path from the ball on the table, so that
``L - R = u . (o + e) + second(o)``; the second order of the offset is removed with the fitted offset. The remainder is
averaged by sectors, and the offset of the common least-squares circle is subtracted: the estimate is ``P g`` of the
means g, with the projection P that removes cosine and sine. The radius is not removed: it compares the scales of the
machine with the calibrated bar.

The mean over a sector reduces a spike at a reversal, on the unsafe side. The figures are therefore those of a finer
path: means over as many sectors as have about `READINGS_EACH` readings, plus the model of the path within each of them,
with the decay of its spikes among `DECAYS` that fits the readings best. Where the model does not describe the path, a
part of the spike is still lost. It is estimated by the change from sectors of twice the width, and contained in the
uncertainty.

Covariance: the means have independent noise S, so that ``P S P'`` is that of the deviations. Its diagonal is stated
exactly. Between different sectors it differs from zero by at most 1/places of the variance, and it is zero orthogonal
to cosine and sine; the sectors are therefore stated as independent, in addition to their shared sources.
"""

from dataclasses import dataclass

import numpy as np

from ballbar_test import sectors
from ballbar_test.extremes import Figures, figures

DECAYS = (1 / 12, 1 / 6, 1 / 3, 2 / 3, 1.0, 2.0)
"""Decays of spikes relative to the setting."""
READINGS_EACH = 3
"""Mean number of readings in a sector of the path of the figures."""
WITHIN = 2
"""Parts of such a sector at which the model is evaluated."""


@dataclass(frozen=True)
class Evaluation:
    """Radial deviations over (2, place), CCW first, and further results; SI, NaN = unknown.

    ``independent`` is the standard uncertainty of a deviation by noise, ``shared`` the effect of one standard
    uncertainty of each named source. ``model`` is the fitted path, ``offset`` (2,) that of the path from the ball on
    the table. ``misfit`` is chi-square of the model by degree of freedom.
    """

    deviation: np.ndarray
    independent: np.ndarray
    shared: dict[str, np.ndarray]
    model: np.ndarray
    parameters: np.ndarray
    parameter_covariance: np.ndarray
    offset: np.ndarray
    offset_u: np.ndarray
    misfit: float
    figures: Figures
    averaged: sectors.Sectors


def evaluate(circles, settings, notes):
    """Return the evaluation of readings; remarks are appended to ``notes``."""
    length = circles.length + circles.expansion[:, :, None]
    offset = np.zeros(2)
    for _ in range(3):  # each pass reduces the error by the offset over the radius
        deviation = length - circles.radius - second_order(offset, circles)
        at_readings, found = sectors.first_model(circles, deviation, settings.spike_decay)
        offset = found[1:3]
    design = sectors.sector_design(circles, settings)
    averaged = sectors.average(circles, deviation - at_readings, design @ found, settings, notes)
    return _fit(averaged, design, notes, _fine_figures(circles, deviation, settings))


def _fine_figures(circles, deviation, settings):
    """Return the figures of the finest path that the readings determine."""
    fits = []
    for factor in DECAYS:
        decay = factor * settings.spike_decay
        at_readings, found = sectors.first_model(circles, deviation, decay)
        residual = deviation - at_readings
        fits.append((float(np.nansum(residual**2)), decay, residual, found))
    _, decay, residual, found = min(fits, key=lambda fit: fit[0])
    settings = settings.model_copy(update={"spike_decay": decay})
    readings = int(np.isfinite(residual).sum()) / 2
    widths = [max(1, int(readings / (READINGS_EACH * settings.places)) // part) for part in (1, 2)]
    fine, coarse = (_path_figures(circles, residual, found, settings, settings.places * each) for each in widths)
    if widths[0] == widths[1]:
        return fine
    return Figures(fine.value, fine.covariance + np.diag((fine.value - coarse.value) ** 2))


def _path_figures(circles, residual, found, settings, places):
    """Return the figures of means over a number of sectors plus the model of the path within them."""
    finer = settings.model_copy(update={"places": places})
    each, inside = (
        sectors.sector_design(circles, finer) @ found,
        settings.model_copy(update={"places": places * WITHIN}),
    )
    averaged = sectors.average(circles, residual, each, finer, [])
    shape = sectors.sector_design(circles, inside) @ found - np.repeat(each, WITHIN, axis=1)
    shared = np.array(list(averaged.shared.values())).reshape(-1, 2, places)
    return figures(averaged.value, averaged.u, shared, shape)


def second_order(offset, circles):
    """Return the part of the length that is not linear in the set-up offset, m."""
    x, y = np.cos(circles.angle), np.sin(circles.angle)
    along = offset[0] * x + offset[1] * y
    across = offset[1] * x - offset[0] * y
    return np.hypot(circles.radius + along, across) - circles.radius - along


def _fit(averaged, design, notes, of_path):
    known = np.isfinite(averaged.value)
    M, g, u = design[known], averaged.value[known], averaged.u[known]
    names, shared = list(averaged.shared), np.array([effect[known] for effect in averaged.shared.values()])

    to_circle = np.linalg.pinv(M[:, :3])
    P = np.eye(len(g)) - M[:, 1:3] @ to_circle[1:]
    sources = shared @ P.T
    to_path = _weighted_inverse(M, u)
    path = to_path @ g
    misfit = float(np.sum(((g - M @ path) / u) ** 2) / (len(g) - M.shape[1]))
    covariance = max(1.0, misfit) * (to_path * u**2) @ to_path.T + _outer(shared @ to_path.T)

    def over_places(values):
        full = np.full((*values.shape[:-1], *known.shape), np.nan)
        full[..., known] = values
        return full

    deviation, independent = over_places(P @ g), over_places(np.sqrt(P**2 @ u**2))
    every = over_places(sources)
    model = M @ path
    circle_covariance = (to_circle * u**2) @ to_circle.T + _outer(shared @ to_circle.T)
    if (missing := int((~known).sum())) > 0:
        notes.append(f"{missing} of {known.size} sectors of the circles have no reading; their deviation is unknown.")
    return Evaluation(
        deviation=deviation,
        independent=independent,
        shared=dict(zip(names, every, strict=True)),
        model=over_places(P @ model),
        parameters=path[3:],
        parameter_covariance=covariance[3:, 3:],
        offset=to_circle[1:] @ g,
        offset_u=np.sqrt(np.diagonal(circle_covariance))[1:],
        misfit=misfit,
        figures=of_path,
        averaged=averaged,
    )


def _weighted_inverse(M, u):
    """Return the matrix from values with uncertainties u to the least-squares parameters of M, (p, n)."""
    scale = np.linalg.norm(M / u[:, None], axis=0)
    return np.linalg.pinv(M / u[:, None] / scale) / u / scale[:, None]


def _outer(effects):
    return effects.T @ effects
