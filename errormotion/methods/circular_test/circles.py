"""A circular test as arrays, and its readings averaged over sectors as a problem of least squares.

The bar reads ``L = |R u + o + e|`` with the set-up offset o of the path from the ball on the table, so that
``L - R = u . (o + e) + second(o)``; the second order of the offset is removed with a fitted offset. The unknown of a
sector is the mean of its readings minus the model of the path there, plus the mean of this model over the sector: an
uneven distribution of the readings in a sector then causes no error to first order. A linear drift of the bar is
determined from repeated circles within a sector, where the path is the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import stats
from scipy.signal import lfilter

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.estimation.checks.correlated import LARGEST
from errormotion.estimation.robust import scale_about_zero
from errormotion.measurement import Block, Constant, Noise, Places, Problem
from errormotion.methods.circular_test.path import DIRECTIONS, SENSE, TAU, basis, circle, over_sectors
from errormotion.methods.circular_test.schema import READINGS
from errormotion.methods.circular_test.settings import CircularTestSettings

T = TypeVar("T")
DRIFT = "drift of the bar"
"""Group in the budget."""
PLANES = ("XY", "YZ", "ZX")
REFERENCE_TEMPERATURE = 20.0  # degC
SCATTER_DEGREES = 30
"""Smallest number of degrees of freedom for an estimate of the noise of a reading."""
FALSE_ALARM = 1e-3
"""Probability that readings with the stated noise are reported as noisier."""
NEGLIGIBLE = 1e-3
"""Correlation."""
CORRELATED = 5.0
"""Significant correlation of neighbours, times the root of the number of readings: three standard deviations."""


class Unknowns(NamedTuple, Generic[T]):
    """Tables of what is estimated: the radial deviation of each sector, and the drift of the bar, m/s."""

    deviation: T
    drift: T


class Known(NamedTuple, Generic[T]):
    """Tables of what is known with an uncertainty; of length and temperature, the errors."""

    length: T
    expansion: T
    temperature: T


@dataclass(frozen=True, eq=False)
class Circles:
    """Readings in the order of ``DIRECTIONS``, (2, run, sample), SI.

    ``length`` is NaN for a missing reading. ``time`` is relative to the calibration of the bar; None if it is not
    stated. ``excess`` is the temperature of the bar above that of its calibration, (2, run), 0 without a correction;
    ``expansion`` and ``known`` are the expansion coefficient and the standard uncertainties of length, expansion
    and temperature, None for what is not corrected.
    """

    length: Array
    angle: Array
    time: Array | None
    excess: Array
    expansion: float
    known: tuple[float, float | None, float | None]
    radius: float
    feed: float
    noise: float
    centre: Array
    plane: str
    axes: Array
    decay: float

    @cached_property
    def deviation(self) -> Array:
        """Length minus radius, without the second order of the set-up offset, (2, run, sample), m."""
        first = self.length + self.radius * self.expansion * self.excess[:, :, None] - self.radius
        deviation, x, y = first, np.cos(self.angle), np.sin(self.angle)
        for _ in range(2):  # each pass reduces the error by the offset over the radius
            offset = self._fitted(deviation, self.decay)[1][1:3]
            along, across = offset[0] * x + offset[1] * y, offset[1] * x - offset[0] * y
            deviation = first - (np.hypot(self.radius + along, across) - self.radius - along)
        return np.asarray(deviation)

    def model(self, decay: float) -> tuple[Array, Array]:
        """Return the model of the path by a fit to readings: its values there, and circle and parameters, (12,)."""
        return self._fitted(self.deviation, decay)

    def over_sectors(self, places: int, decay: float) -> Array:
        """Return the means over sectors of circle and parameters, (2, place, 3 + 9)."""
        return over_sectors(places, self.radius, self.feed, decay)

    def _fitted(self, deviation: Array, decay: float) -> tuple[Array, Array]:
        known = np.isfinite(deviation)
        angle, sense = self.angle[known], np.broadcast_to(SENSE[:, None, None], known.shape)[known]
        design = np.hstack([circle(angle), basis(angle, sense, self.radius, self.feed, decay)])
        normal = design.T @ design
        scale = np.sqrt(np.diagonal(normal))
        coefficients = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-12) @ (
            design.T @ deviation[known] / scale
        )
        at_readings = np.full(deviation.shape, np.nan)
        at_readings[known] = design @ (coefficients / scale)
        return at_readings, coefficients / scale


def read(raw: xr.Dataset, settings: CircularTestSettings, notes: list[str]) -> Circles:
    """Return the readings of a raw dataset that conforms to its schema.

    Raises
    ------
    MethodError
        Directions of travel, axes or constants are inconsistent.
    """
    labels = sorted(map(str, raw["direction_of_travel"].values)) if "direction_of_travel" in raw.coords else []
    if labels != sorted(DIRECTIONS):
        raise MethodError(
            f"direction_of_travel: expected the labels CCW and CW; found {', '.join(labels) or 'none'}",
            code="circle.direction.labels",
        )
    ordered = raw.sel(direction_of_travel=list(DIRECTIONS))
    plane, axes = _plane(raw)

    def over_readings(name: str) -> Array:
        return np.array(ordered[name].transpose(*READINGS).values, float)

    def scalar(name: str, default: float) -> float:
        return float(raw[name]) if name in raw else default

    length, angle = over_readings("length"), over_readings("angle")
    length[~np.isfinite(angle)] = np.nan
    time = None
    if "reading_time" in raw:
        time = over_readings("reading_time")
        length[~np.isfinite(time)] = np.nan
    if not np.isfinite(length).any(axis=(1, 2)).all():
        raise MethodError(
            "length: expected readings in both directions of travel; found none in one or both",
            code="circle.readings.one_direction",
        )
    for name in ("nominal_radius", "feed"):
        if not float(raw[name]) > 0:
            raise MethodError(
                f"{name}: expected a value above 0; found {float(raw[name]):g}", code="raw.value.not_positive"
            )
    corrected = "temperature" in raw and "expansion" in raw
    if "temperature" in raw and not corrected:
        notes.append("The temperature of the bar is not corrected: its expansion coefficient is not stated.")
    excess = np.zeros(length.shape[:2])
    if corrected:
        at = scalar("calibration_temperature", REFERENCE_TEMPERATURE)
        excess = ordered["temperature"].transpose(*READINGS[:2]).values - at
        if not np.isfinite(excess).all():
            raise MethodError(
                "temperature: expected one of the bar for each circle; found NaN. Omit the variable",
                code="circle.temperature.missing",
            )
    return Circles(
        length=length,
        angle=np.mod(np.where(np.isfinite(angle), angle, 0.0), TAU),
        time=time,
        excess=excess,
        expansion=scalar("expansion", 0.0) if corrected else 0.0,
        known=(
            scalar("length_uncertainty", 0.0),
            scalar("expansion_uncertainty", 0.0) if corrected else None,
            scalar("temperature_uncertainty", 0.0) if corrected else None,
        ),
        radius=float(raw["nominal_radius"]),
        feed=float(raw["feed"]),
        noise=scalar("length_noise", np.nan),
        centre=np.array(_xyz(raw["centre"]), float),
        plane=plane,
        axes=axes,
        decay=settings.spike_decay,
    )


def _plane(raw: xr.Dataset) -> tuple[str, Array]:
    axes = np.array(_xyz(raw["axis_direction"].transpose("axis", "direction")), float)
    labels = raw["axis"].values if "axis" in raw.coords else np.array(list("XYZ"))[np.abs(axes).argmax(axis=1)]
    names = [str(name) for name in labels]
    plane = "".join(names)
    if plane not in PLANES:
        raise MethodError(
            f"axis: expected the two axes of the circle in the order X Y, Y Z or Z X; found {' '.join(names)}",
            code="circle.axes.order",
        )
    if not np.allclose(axes @ axes.T, np.eye(2), atol=1e-3):
        raise MethodError(
            "axis_direction: expected two unit vectors at right angles to one another",
            code="circle.axes.not_orthogonal",
        )
    return plane, axes


def _xyz(array: xr.DataArray) -> Any:
    return (array.sel(direction=["x", "y", "z"]) if "direction" in array.coords else array).values


@dataclass(frozen=True, eq=False)
class Sectors:
    """The problem of the sectors; number of readings (2, place), noise of a reading, m, and whether it has a drift.

    ``order`` and ``series`` of the readings are their numbers in a circle, and the circle; ``sector`` and ``known``,
    (2, run, sample), their sector, and whether there is a reading.
    """

    problem: Problem
    count: NDArray[np.intp]
    noise: float
    drifts: bool
    order: Array
    series: NDArray[np.intp]
    sector: NDArray[np.intp]
    known: NDArray[np.bool_]

    def sd(self, phi: float) -> Array:
        """Return the standard deviations of the means over sectors, (2 place,), with a correlation of neighbours."""
        n = self.count.ravel()
        with np.errstate(divide="ignore"):
            return np.asarray(self.noise * np.sqrt((1 + (n - 1) * _shared(self.sector, self.known, phi, n.size)) / n))

    def covariance(self, weights: Array, phi: float) -> Array:
        """Return the covariance by noise of linear functions (k, 2 place) of the means over sectors, (k, k)."""
        n = np.maximum(self.count.ravel(), 1)
        a = np.where(self.known, (weights / n)[:, self.sector], 0.0)  # by the readings
        # R a with R_ij = phi^|i - j| along each circle: a sum forwards and one backwards
        forward, backward = (lfilter([1.0], [1.0, -phi], each, axis=-1) for each in (a, a[..., ::-1]))
        return np.asarray(self.noise**2 * np.einsum("iabc,jabc->ij", a, forward + backward[..., ::-1] - a))


def problem_of(
    circles: Circles, settings: CircularTestSettings, places: int, decay: float, notes: list[str]
) -> Sectors:
    """Return the means over sectors as a problem: a reading sees one sector; drift and constants are common.

    Raises
    ------
    MethodError
        A gap is wider than the settings allow, or the noise is neither stated nor found.
    """
    at_readings, at_sectors = circles.model(decay)
    sector = np.floor(circles.angle / TAU * places).astype(int) % places + places * np.arange(2)[:, None, None]
    within = at_readings.ravel() - (circles.over_sectors(places, decay) @ at_sectors).ravel()[sector.ravel()]
    known = np.isfinite(circles.length).ravel()
    index, r = sector.ravel()[known], (circles.deviation.ravel() - within)[known]
    count = np.bincount(index, minlength=2 * places)
    _check_gaps(count.reshape(2, places), places, settings)

    def rest(values: Array) -> Array:
        with np.errstate(invalid="ignore"):
            return np.asarray(values - (np.bincount(index, values, minlength=2 * places) / count)[index])

    time, drifts, degrees = np.zeros(known.size), False, count.sum() - np.count_nonzero(count)
    if circles.time is not None and settings.drift != "none":
        time = np.where(known, circles.time.ravel(), 0.0)
        since = rest(time[known])
        spread = float(since @ since)
        # Readings of one sector differ in time by more than a fifth of the test, as with repeated circles
        drifts = bool(spread > 0 and np.sqrt(spread / len(since)) > 0.1 * np.ptp(time[known]))
        if drifts:
            r, degrees = r - float(since @ r / spread) * time[known], degrees - 1
        else:
            notes.append("A drift of the bar is not determined: each direction of travel has only one circle.")
    circle_of, order = (i.ravel() for i in np.indices((circles.length[..., 0].size, circles.length.shape[-1])))
    phi = _correlation(circles.deviation - at_readings)
    shared = _shared(sector, known.reshape(sector.shape), phi, count.size)
    noise = _noise(circles.noise, rest(r), index, count, degrees, settings, notes, shared)

    one = np.zeros(known.size, dtype=np.intp)
    excess = circles.radius * np.broadcast_to(circles.excess[:, :, None], circles.length.shape).ravel()
    # Radius, second order of the offset, and path within the sector
    nominal = np.where(known, (circles.length - circles.deviation).ravel() + circles.expansion * excess + within, 0.0)

    def equation(y: Array, x: Unknowns[Array], c: Known[Array]) -> Array:
        length = y + c.length[:, 0] + c.expansion[:, 0] * (excess + circles.radius * c.temperature[:, 0])
        return np.asarray(length - nominal - x.deviation[:, 0] - x.drift[:, 0] * time)

    def constant(group: str, value: float, u: float | None) -> Constant:
        factor = np.zeros((1, 1, 0)) if u is None else np.full((1, 1, 1), u)
        return Constant(value=np.full((1, 1), value), factor=factor, index=one, scale=1.0, group=group)

    problem = Problem(
        equation=equation,
        readings=circles.length.ravel(),
        unknowns=Unknowns(
            deviation=Block(start=np.zeros((2 * places, 1)), index=sector.ravel(), scale=1.0, free=count > 0),
            drift=Block(start=np.zeros((1, 1)), index=one, scale=1.0, free=np.array([drifts]), group=DRIFT),
        ),
        constants=Known(
            length=constant("calibration of the bar", 0.0, circles.known[0]),
            expansion=constant("expansion coefficient of the bar", circles.expansion, circles.known[1]),
            temperature=constant("temperature of the bar", 0.0, circles.known[2]),
        ),
        noise=Noise(sd=np.full(known.size, noise)),
        linear=True,
    )
    return Sectors(
        problem,
        count.reshape(2, places),
        noise,
        drifts,
        order.astype(float),
        circle_of,
        sector,
        known.reshape(sector.shape),
    )


def places_of(sectors: Sectors) -> Places:
    """Return the errors of a problem: the deviation of each sector; NaN without a reading."""
    unknown = np.where(sectors.count.ravel() > 0, 0.0, np.nan)[:, None]
    return Places(lambda x, _: x.deviation + unknown, len(unknown))


def _noise(
    stated: float,
    residual: Array,
    index: NDArray[np.intp],
    count: NDArray[np.intp],
    degrees: int,
    settings: CircularTestSettings,
    notes: list[str],
    shared: Array,
) -> float:
    """Return the standard deviation of a reading: as stated, or from the scatter within sectors.

    The scatter is the median over sectors, so that spikes and steps in a few of them are not counted as noise. A median
    of variances scatters like the mean of a fraction 4 / pi^2 of them. Readings of a sector with the mean correlation c
    agree better than independent ones: the expectation of their variance is (1 - c) times that of a reading, with the
    freedom of n / (1 + (n - 1) c) readings.
    """
    estimated = np.nan
    if degrees >= SCATTER_DEGREES:
        many = count > 1
        n, c = count[many], shared[many]
        squares = np.bincount(index, residual**2, minlength=len(count))[many]
        freedom = np.maximum(n / (1 + (n - 1) * c) - 1, 1) if c.any() else n - 1
        usual = stats.chi2.ppf(0.5, freedom) / freedom * (n - 1) * (1 - c)
        estimated = float(np.sqrt(np.median(squares / usual)))
    if not np.isfinite(stated):
        if not np.isfinite(estimated):
            raise MethodError(
                "length_noise: expected the standard deviation of a reading; too few readings to find it",
                code="raw.noise.unknown",
            )
        return estimated
    if settings.noise == "auto" and np.isfinite(estimated):
        least, limit = np.sqrt(stats.chi2.ppf([FALSE_ALARM, 1 - FALSE_ALARM], 0.4 * degrees) / (0.4 * degrees))
        if estimated > limit * stated:
            notes.append(
                f"Readings scatter by {1e6 * estimated:.3g} um, more than the stated {1e6 * stated:.3g} um; the "
                "larger value is used."
            )
            return estimated
        if estimated < least * stated:
            notes.append(
                f"Readings scatter by {1e6 * estimated:.3g} um, less than the stated {1e6 * stated:.3g} um, which is "
                "used. State the noise of this bar, or check the unit of both."
            )
    return stated


def _correlation(residual: Array) -> float:
    """Return the correlation of neighbouring residuals (2, run, sample) of the path; 0 if it is not significant.

    With the variances ``D_k = 2 s^2 (1 - phi^k)`` of differences of readings k apart, which no slow error of the path
    changes, ``D_2 / D_1 = 1 + phi``.
    """
    one, two = (scale_about_zero(residual[..., k:] - residual[..., :-k]) ** 2 for k in (1, 2))
    phi = min(two / one - 1.0, LARGEST) if one > 0 else 0.0
    return phi if phi > CORRELATED / np.sqrt(max(int(np.isfinite(residual).sum()), 1)) else 0.0


def _shared(sector: NDArray[np.intp], known: NDArray[np.bool_], phi: float, size: int) -> Array:
    """Return the mean correlation of two readings of each sector, (2 place,)."""
    count, pairs = np.bincount(sector[known], minlength=size), np.zeros(size)
    for k in range(1, known.shape[-1]):
        same = (sector[..., k:] == sector[..., :-k]) & known[..., k:] & known[..., :-k]
        if phi**k < NEGLIGIBLE or not same.any():
            break
        pairs += np.bincount(sector[..., k:][same], minlength=size) * phi**k
    return np.asarray(2 * pairs / np.maximum(count * (count - 1), 1))


def _check_gaps(count: NDArray[np.intp], places: int, settings: CircularTestSettings) -> None:
    """Refuse arcs: only full circles determine the centre (ISO 230-4)."""
    for name, row in zip(DIRECTIONS, count, strict=True):
        empty = np.flatnonzero(np.tile(row == 0, 2))
        runs = np.split(empty, np.flatnonzero(np.diff(empty) > 1) + 1)
        gap = min(max(map(len, runs)), places) * 360 / places
        if gap > np.degrees(settings.largest_gap):
            raise MethodError(
                f"{name}: expected a full circle with no gap above {np.degrees(settings.largest_gap):.3g} degrees; "
                f"found one of {gap:.3g} degrees. Arcs are not evaluated.",
                code="circle.gap.too_large",
            )
