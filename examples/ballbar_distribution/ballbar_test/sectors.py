"""Readings averaged over the sectors of the circle.

The estimate of a sector is the mean of its readings minus the model of the path there, plus the mean of this model over
the sector: an uneven distribution of the readings in a sector then causes no error to first order. A linear drift of
the bar is determined from repeated circles within a sector, where the path is the same; the means of the sectors are
uncorrelated with it.
"""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from ballbar_test.path import TAU, basis, circle, sector_angles
from errormotion.errors import MethodError

SCATTER_DEGREES = 30
"""Smallest number of degrees of freedom for an estimate of the noise of a reading."""
FALSE_ALARM = 1e-3
"""Probability that readings with the stated noise are reported as noisier."""


@dataclass(frozen=True)
class Sectors:
    """Means over sectors, (2, place), NaN without a reading.

    Attributes
    ----------
    value, u : ndarray
        Radial deviation and its standard uncertainty by noise, m.
    count : ndarray of int
        Readings.
    shared : mapping
        Source to the effect of one standard uncertainty, m.
    noise : float
        Standard deviation of one reading, m.
    drift, drift_u : float
        Of the bar, m/s; NaN where not determined.
    """

    value: np.ndarray
    u: np.ndarray
    count: np.ndarray
    shared: dict[str, np.ndarray]
    noise: float
    drift: float
    drift_u: float


def average(circles, residual, model, settings, notes):
    """Return the means over sectors.

    Parameters
    ----------
    circles : Circles
    residual : ndarray, (2, run, sample)
        Radial deviation minus the model of the path at each reading, m; NaN = missing.
    model : ndarray, (2, place)
        Mean of the model over each sector, m.
    """
    places = settings.places
    shape = residual.shape
    known = np.isfinite(residual)
    sector = np.floor(np.where(known, circles.angle, 0.0) / TAU * places).astype(int) % places
    index = (sector + places * np.arange(2)[:, None, None])[known]
    r = residual[known]
    count = np.bincount(index, minlength=2 * places)

    def mean(values):
        with np.errstate(invalid="ignore"):
            return np.bincount(index, values, minlength=2 * places) / count

    def within(values):
        return values - mean(values)[index]

    time = None if circles.time is None or settings.drift == "none" else circles.time[known]
    slope = spread = 0.0
    degrees = count.sum() - np.count_nonzero(count)
    if time is not None:
        since = within(time)
        spread = float(since @ since)
        if _determined(since, circles.time, spread):
            slope = float(since @ r / spread)
            r = r - slope * time
            degrees -= 1
        else:
            notes.append("A drift of the bar is not determined: each direction of travel has only one circle.")
            spread = 0.0
    noise = _noise(circles.noise, within(r), index, count, degrees, settings, notes)
    shared = {
        name: mean(np.broadcast_to(effect[:, :, None], shape)[known]).reshape(2, places)
        for name, effect in circles.shared.items()
    }
    drift_u = noise / np.sqrt(spread) if spread else np.nan
    if spread:
        shared["drift of the bar"] = -drift_u * mean(time).reshape(2, places)
    with np.errstate(divide="ignore"):
        u = np.where(count > 0, noise / np.sqrt(count), np.nan).reshape(2, places)
    value = mean(r).reshape(2, places) + model
    check_gaps(count.reshape(2, places), settings)
    return Sectors(value, u, count.reshape(2, places), shared, noise, slope if spread else np.nan, drift_u)


def _determined(since, time, spread):
    """Whether readings of one sector differ in time by more than a fifth of the test, as with repeated circles."""
    return spread > 0 and np.sqrt(spread / len(since)) > 0.1 * np.ptp(time[np.isfinite(time)])


def _noise(stated, residual, index, count, degrees, settings, notes):
    """Return the standard deviation of a reading: as stated, or from the scatter within sectors."""
    many = count > 1
    estimated, tested = np.nan, 0
    if degrees >= SCATTER_DEGREES:
        # The median over sectors, so that spikes and steps in a few of them are not counted as noise.
        squares = np.bincount(index, residual**2, minlength=len(count))[many]
        estimated = np.sqrt(np.median(squares / stats.chi2.ppf(0.5, count[many] - 1)))
        tested = degrees
    if not np.isfinite(stated):
        if not np.isfinite(estimated):
            raise MethodError("length_noise: expected the standard deviation of a reading; too few readings to find it")
        return float(estimated)
    # A median of variances scatters like the mean of a fraction 4 / pi^2 of them.
    if settings.noise == "auto" and tested:
        limit = np.sqrt(stats.chi2.ppf(1 - FALSE_ALARM, 0.4 * tested) / (0.4 * tested))
        if estimated > limit * stated:
            notes.append(
                f"Readings scatter by {1e6 * estimated:.3g} um, more than the stated {1e6 * stated:.3g} um; the "
                "larger value is used."
            )
            return float(estimated)
    return float(stated)


def check_gaps(count, settings):
    """Refuse arcs: only full circles determine the centre (ISO 230-4).

    Raises
    ------
    MethodError
        A gap is wider than the settings allow.
    """
    for name, row in zip(("CCW", "CW"), count, strict=True):
        empty = np.flatnonzero(np.tile(row == 0, 2))
        runs = np.split(empty, np.flatnonzero(np.diff(empty) > 1) + 1)
        gap = min(max(map(len, runs)), settings.places) * 360 / settings.places
        if gap > np.degrees(settings.largest_gap):
            raise MethodError(
                f"{name}: expected a full circle with no gap above {np.degrees(settings.largest_gap):.3g} degrees; "
                f"found one of {gap:.3g} degrees. Arcs are not evaluated."
            )


def first_model(circles, deviation, decay):
    """Return the model of the path by a fit to single readings: its values there, and circle with parameters, (12,)."""
    known = np.isfinite(deviation)
    angle, sense = circles.angle[known], circles.sense[known]
    design = np.hstack([circle(angle), basis(angle, sense, circles.radius, circles.feed, decay)])
    normal = design.T @ design
    scale = np.sqrt(np.diagonal(normal))
    found = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-12) @ (design.T @ deviation[known] / scale) / scale
    at_readings = np.full(deviation.shape, np.nan)
    at_readings[known] = design @ found
    return at_readings, found


def sector_design(circles, settings):
    """Return the means over sectors of circle and parameters, (2, place, 3 + 9)."""
    angle = np.broadcast_to(
        sector_angles(settings.places), (2, settings.places, sector_angles(settings.places).shape[1])
    )
    sense = np.array([1.0, -1.0])[:, None, None]
    path = basis(angle, np.broadcast_to(sense, angle.shape), circles.radius, circles.feed, settings.spike_decay)
    return np.concatenate([circle(angle), path], axis=-1).mean(axis=2)
