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

from dataclasses import dataclass

import numpy as np

from ballbar_test.path import circle, middles
from errormotion.estimation.extremes import FLAT, POINTED, of_noisy_values

NAMES = ("G(CCW)", "G(CW)", "G(b)", "H", "Fmax", "Fmin", "D")
MEANINGS = (
    "circular deviation, counterclockwise",
    "circular deviation, clockwise",
    "bi-directional circular deviation",
    "circular hysteresis",
    "largest radial deviation",
    "smallest radial deviation",
    "mean bi-directional radial deviation",
)
POSITIVE = ("G(CCW)", "G(CW)", "G(b)", "H")
DRAWS = 200


@dataclass(frozen=True)
class Figures:
    """The figures in the order of ``NAMES``, m; ``covariance`` is (7, 7), m^2."""

    value: np.ndarray
    covariance: np.ndarray

    @property
    def u(self):
        return np.sqrt(np.diagonal(self.covariance))


def centred(deviation):
    """Return paths without the offset of their least-squares circle.

    Parameters
    ----------
    deviation : ndarray, (..., path, place)
        Radial deviations; NaN = unknown, alike in all leading dimensions. All paths have one centre.
    """
    *lead, paths, places = deviation.shape
    flat = deviation.reshape(*lead, paths * places)
    design = np.tile(circle(middles(places)), (paths, 1))
    known = np.isfinite(flat.reshape(-1, paths * places)[0])
    fitted = flat[..., known] @ np.linalg.pinv(design[known]).T
    return (flat - fitted[..., 1:] @ design[:, 1:].T).reshape(deviation.shape)


def evaluate(deviation):
    """Return the figures (..., 7) of radial deviations (..., 2, place), CCW first, m, without correction for noise."""
    both = centred(deviation)
    single = [np.nanmax(path, axis=(-2, -1)) - np.nanmin(path, axis=(-2, -1)) for path in _single(deviation)]
    top, bottom = np.nanmax(both, axis=(-2, -1)), np.nanmin(both, axis=(-2, -1))
    hysteresis = np.nanmax(np.abs(both[..., 0, :] - both[..., 1, :]), axis=-1)
    return np.stack([*single, top - bottom, hysteresis, top, bottom, radius(deviation)], axis=-1)


def _single(deviation):
    return (centred(deviation[..., k : k + 1, :]) for k in range(2))


def radius(deviation):
    """Return the radius of the least-squares circle of both paths, minus the nominal one, (...), m."""
    paths, places = deviation.shape[-2:]
    flat = deviation.reshape(*deviation.shape[:-2], -1)
    known = np.isfinite(flat.reshape(-1, paths * places)[0])
    design = np.tile(circle(middles(places)), (paths, 1))[known]
    return flat[..., known] @ np.linalg.pinv(design)[0]


def figures(deviation, independent, shared, shape=None):
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
    """
    shape = np.zeros(deviation.shape) if shape is None else shape
    parts = shape.shape[-1] // deviation.shape[-1]

    def of_path(values):
        return evaluate(np.repeat(values, parts, axis=-1) + shape)

    found = of_noisy_values(
        of_path,
        deviation,
        independent,
        shared,
        draws=DRAWS,
        seed=0,
        bias_uncertainty=(FLAT - POINTED) / FLAT,
        skewed=True,
    )
    value = found.value - found.bias
    return Figures(np.where(np.isin(NAMES, POSITIVE), np.maximum(value, 0.0), value), found.covariance)
