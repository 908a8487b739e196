"""The figures of ISO 230-4, with an uncertainty that allows for the noise in extreme values.

The actual path is stated by its radial deviation F(direction of travel, angle), positive outward. The set-up error, the
offset of the centre, is removed by the least-squares circle. The figures conform to clause 3 of ISO 230-4:2005:

``G(CCW)``, ``G(CW)``
    Circular deviation: radial separation of the two circles that enclose the path of one direction of travel,
    concentric with its least-squares circle.
``G(b)``
    Bi-directional circular deviation: the same for both paths together, around their common least-squares circle.
``H``
    Circular hysteresis: the largest radial difference between the paths of both directions at one angle.
``Fmax``, ``Fmin``
    Radial deviation: the largest and the smallest deviation of the actual paths from the nominal path, whose centre
    is that of the least-squares circle and whose radius is nominal.
``D``
    Mean bi-directional radial deviation: radius of the least-squares circle of both paths, minus the nominal radius.

A maximum of noisy values is too large on average, by an amount that depends on the shape of the path;
`errormotion.estimation.extremes` estimates it from the path, by noise that is added once more. The value is corrected
for the bias of a path that is flat about its extremes. The standard uncertainty combines the standard deviation of the
figure under noise with the difference from the bias of a pointed path: intervals of two standard uncertainties then
contain the true figure in about 95 % of tests, on flat and on pointed paths.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.stats import norm

from errormotion.arrays import Array
from errormotion.estimation.checks.correlated import autoregressive
from errormotion.estimation.extremes import FLAT, POINTED, of_noisy_values
from errormotion.estimation.fit import fit
from errormotion.estimation.sources import errors_of
from errormotion.methods.circular_test.circles import DRIFT, Circles, places_of, problem_of
from errormotion.methods.circular_test.path import TAU, circle, middles
from errormotion.methods.circular_test.settings import CircularTestSettings

MEANINGS = {
    "G(CCW)": "circular deviation, counterclockwise",
    "G(CW)": "circular deviation, clockwise",
    "G(b)": "bi-directional circular deviation",
    "H": "circular hysteresis",
    "Fmax": "largest radial deviation",
    "Fmin": "smallest radial deviation",
    "D": "mean bi-directional radial deviation",
}
NAMES = tuple(MEANINGS)
POSITIVE = ("G(CCW)", "G(CW)", "G(b)", "H")
DRAWS = 200
DECAYS = (1 / 12, 1 / 6, 1 / 3, 2 / 3, 1.0, 2.0)
"""Decays of spikes relative to the setting."""
FALSE_ALARM = 1e-3
"""Probability that noise makes the model of a path seem wrong."""
READINGS_EACH = 3
"""Mean number of readings in a sector of the path of the figures."""
OF_DECAY, PARTS = 24, (1, 8)
"""Parts of such a sector over which the model is averaged: in a decay of a spike, which loses 1 / 48 then; limits of
their pairs."""


@dataclass(frozen=True)
class Figures:
    """The figures in the order of ``NAMES``, m; covariance (7, 7), m^2; effect of each source by its name, (7,), m."""

    value: Array
    covariance: Array
    influence: dict[str, Array]


def of_circles(circles: Circles, settings: CircularTestSettings, phi: float = 0.0) -> Figures:
    """Return the figures of the finest path that the readings determine, with a noise of this correlation.

    The mean over a sector reduces a spike at a reversal, on the unsafe side. The path has therefore as many sectors as
    have about `READINGS_EACH` readings, plus the model of the path within each of them, with the decay of its spikes
    among `DECAYS` that fits the readings best. Where neighbouring sectors differ from the model by more than their
    noise, a part of a spike is still lost. It is estimated by the change from sectors of twice the width, and contained
    in the uncertainty.
    """
    decays = [factor * settings.spike_decay for factor in DECAYS]
    decay = min(decays, key=lambda each: float(np.nansum((circles.deviation - circles.model(each)[0]) ** 2)))
    each = int(np.isfinite(circles.length).sum()) / 2 / (READINGS_EACH * settings.places)
    widths = [max(1, int(each) // part) for part in (1, 2)]
    fine, described = _of_sectors(circles, settings, settings.places * widths[0], decay, phi)
    if described or widths[0] == widths[1]:
        return fine
    coarse, _ = _of_sectors(circles, settings, settings.places * widths[1], decay, phi)
    return replace(fine, covariance=fine.covariance + np.diag((fine.value - coarse.value) ** 2))


def _of_sectors(
    circles: Circles, settings: CircularTestSettings, places: int, decay: float, phi: float
) -> tuple[Figures, bool]:
    """Return the figures of means over sectors plus the model of the path within them, and whether it describes them.

    It does if no step between neighbouring sectors that it leaves is larger than their noise explains.
    """
    sectors = problem_of(circles, settings, places, decay, [])
    problem = sectors.problem
    if phi > 0:
        problem = autoregressive(problem, sectors.order, phi, sectors.series)
    errors = errors_of(fit(problem), places_of(sectors), shared=DRIFT)
    sources = sorted(errors.sources, key=lambda source: source.group == DRIFT)
    at_sectors = circles.model(decay)[1]
    parts = 2 * int(np.clip(np.ceil(OF_DECAY / 2 * TAU / places / decay), *PARTS))
    within = circles.over_sectors(places * parts, decay) @ at_sectors
    modelled = circles.over_sectors(places, decay) @ at_sectors
    shape = within - np.repeat(modelled, parts, axis=1)
    value, u = errors.value.reshape(2, -1), np.sqrt(errors.own).reshape(2, -1)
    step = np.diff(value - modelled, axis=1) / np.hypot(u[:, 1:], u[:, :-1])
    described = bool(np.nanmax(np.abs(step)) <= norm.isf(FALSE_ALARM / (2 * step.size)))
    shared = np.array([source.effect for source in sources]).reshape(-1, 2, places)
    its = of_path(value, np.where(np.isfinite(value), u, np.nan), shared, shape, [each.name for each in sources])
    # The mean over a part reduces a spike as well, in proportion to its width: by as much as parts of twice the width
    # reduce it further
    wide = np.repeat(shape.reshape(2, -1, 2).mean(axis=2), 2, axis=1)
    fine, less = (evaluate(np.repeat(value, parts, axis=1) + each) for each in (shape, wide))
    lost = fine - less
    return replace(its, value=its.value + lost, covariance=its.covariance + np.diag(lost**2)), described


def of_path(
    deviation: Array, independent: Array, shared: Array, shape: Array | None = None, names: list[str] | None = None
) -> Figures:
    """Return the figures, corrected for the bias by noise, with their covariance.

    Parameters
    ----------
    deviation : ndarray, (2, place)
        Radial deviation, CCW first, m; NaN = unknown.
    independent : ndarray, (2, place)
        Standard uncertainty by independent noise, m.
    shared : ndarray, (source, 2, place)
        Effect of one standard uncertainty of each shared source, m.
    shape : ndarray, (2, place * k), optional
        Known deviation from the means within k parts of each place, m.
    names : list of str, optional
        Of the sources.
    """
    shape = np.zeros(deviation.shape) if shape is None else shape
    parts = shape.shape[-1] // deviation.shape[-1]

    def figures(values: Array) -> Array:
        return evaluate(np.repeat(values, parts, axis=-1) + shape)

    extremes = of_noisy_values(
        figures,
        deviation,
        independent,
        shared,
        draws=DRAWS,
        seed=0,
        bias_uncertainty=(FLAT - POINTED) / FLAT,
        skewed=True,
        corrected=True,
    )
    value = extremes.value - extremes.bias
    value = np.where(np.isin(NAMES, POSITIVE), np.maximum(value, 0.0), value)
    effect = [figures(deviation + each) - extremes.value for each in shared]
    return Figures(value, np.asarray(extremes.covariance), dict(zip(names or [], effect, strict=False)))


def evaluate(deviation: Array) -> Array:
    """Return the figures (..., 7) of radial deviations (..., 2, place), CCW first, m, without correction for noise."""
    both = _centred(deviation)
    single = [_centred(deviation[..., k : k + 1, :]) for k in range(2)]
    ranges = [np.nanmax(path, axis=(-2, -1)) - np.nanmin(path, axis=(-2, -1)) for path in single]
    top, bottom = np.nanmax(both, axis=(-2, -1)), np.nanmin(both, axis=(-2, -1))
    hysteresis = np.nanmax(np.abs(both[..., 0, :] - both[..., 1, :]), axis=-1)
    flat, to_circle, known, _ = _circle_of(deviation)
    return np.stack([*ranges, top - bottom, hysteresis, top, bottom, flat[..., known] @ to_circle[0]], axis=-1)


def _centred(deviation: Array) -> Array:
    """Return paths (..., path, place), which have one centre, without the offset of their least-squares circle."""
    flat, to_circle, known, design = _circle_of(deviation)
    fitted = flat[..., known] @ to_circle.T
    return np.asarray((flat - fitted[..., 1:] @ design[:, 1:].T).reshape(deviation.shape))


def _circle_of(deviation: Array) -> tuple[Array, Array, Array, Array]:
    """Return paths (..., n), the matrix from known values to their circle, which are known, and the circle (n, 3)."""
    *lead, paths, places = deviation.shape
    flat = deviation.reshape(*lead, paths * places)
    known = np.isfinite(flat.reshape(-1, paths * places)[0])
    return flat, *_projection(paths, places, known.tobytes())


@lru_cache(maxsize=32)
def _projection(paths: int, places: int, known: bytes) -> tuple[Array, Array, Array]:
    """Return the matrix, what is known, and the circle, of `_circle_of`; read-only."""
    design = np.tile(circle(middles(places)), (paths, 1))
    which = np.frombuffer(known, dtype=bool)
    return np.linalg.pinv(design[which]), which, design
