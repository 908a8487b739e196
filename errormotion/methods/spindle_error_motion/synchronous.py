"""The synchronous part of the readings: their mean over turns, as harmonics, and how it scatters from batch to batch.

The record is divided into batches of whole turns. In each of them the readings are averaged in parts of a turn, and

    m(q) = a_0 + sum_k (a_k cos k q + b_k sin k q),    k = 1 ... K,

is fitted to these means. A mean over a part with the variance v of the angles in it has ``1 - k^2 v / 2`` of a
harmonic. The batches are independent but for slow changes, so that the covariance of their mean follows from their
scatter, with whatever correlation the motion has along the turn and between sensors:

    x = sum_b x_b / B,    cov x = sum_b (x_b - x) (x_b - x)' / (B (B - 1)).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.estimation.checks.resolution import common, step_of
from errormotion.estimation.robust import scale_about_zero
from errormotion.estimation.variance import expansion
from errormotion.methods.spindle_error_motion.averaging import add_up
from errormotion.methods.spindle_error_motion.turning import TAU, Turning, angles_of, chunks

BATCHES = 32
FEWEST_BATCHES = 4
PARTS = 1024
"""Most parts of a turn."""
LONG = 100
"""Turns of a batch from which on its mean is a slow change, not a part of the asynchronous motion."""
SAMPLE = 20_000
"""Readings of each sensor from whose differences the step of its scale is found."""
SPIKE = 8.0
"""Distance of a spike from its neighbours, in robust standard deviations."""
FEWEST_READINGS = 100
"""Of a sensor, from which the distance of a spike follows."""
SPIKES = 2e-3
"""Largest share of spikes; where there are more, they are no accidents."""
_NYQUIST = 0.9
_LINGERING = 2.0
"""Variance of the mean of the batches, relative to that of independent ones, from which on they are alike."""


@dataclass(frozen=True, eq=False)
class Synchronous:
    """The mean over turns.

    Attributes
    ----------
    coefficient : ndarray, (batch, 2 K + 1, sensor)
        a_0, a_1 ... a_K, b_1 ... b_K of each batch, m.
    level : ndarray, (sensor, batch)
        a_0 as it changes, m.
    factor : float
        For the scatter of the batches: their number is finite, and neighbours may be alike.
    count : int
        Samples.
    limit : ndarray, (sensor,)
        Of spikes, m.
    spikes, missing : int
        Excluded samples, and samples without all readings.
    step, rounded : ndarray, (sensor,)
        Of the scale of the readings, and what rounding adds to the uncertainty of the mean at an angle, m.
    notes, doubts : list of str
    """

    coefficient: Array
    level: Array
    factor: float
    count: int
    limit: Array
    spikes: int
    missing: int
    step: Array
    rounded: Array
    notes: list[str]
    doubts: list[str]

    @property
    def harmonics(self) -> int:
        """K."""
        return int(self.coefficient.shape[1] - 1) // 2

    def at(self, angle: Array) -> Array:
        """Return the mean without a_0, (sensor, n), m."""
        return np.asarray(harmonics_at(angle, self.harmonics)[:, 1:] @ self.coefficient.mean(axis=0)[1:]).T

    def scatter_at(self, angle: Array) -> Array:
        """Return the effects of the batches on the mean, (sensor, n, batch), m."""
        batches = len(self.coefficient)
        off = (self.coefficient - self.coefficient.mean(axis=0))[:, 1:]
        off *= self.factor / np.sqrt(batches * (batches - 1))
        return np.asarray(harmonics_at(angle, self.harmonics)[:, 1:] @ off).transpose(2, 1, 0)


def harmonics_at(angle: Array, count: int, variance: Array | float = 0.0) -> Array:
    """Return 1, cos k q and sin k q, (n, 2 K + 1), as means over parts with variances of the angle (n,)."""
    k = np.arange(1, count + 1)
    part = 1.0 - np.square(k) * np.asarray(variance)[..., None] / 2
    phase = np.multiply.outer(angle, k)
    return np.concatenate([np.ones((angle.size, 1)), part * np.cos(phase), part * np.sin(phase)], axis=1)


def synchronous_of(raw: xr.Dataset, turning: Turning, wanted: int) -> Synchronous:
    """Return the mean over turns of a record, with up to a number of harmonics.

    Raises
    ------
    MethodError
        The samples do not determine it.
    """
    sensors = raw.sizes["sensor"]
    batches = min(BATCHES, turning.turns)
    each = max(raw.sizes["time"] / turning.turns, 1.0)
    # Finer than the samples, so that parts do not limit the harmonics
    parts = int(np.clip(2 ** np.ceil(np.log2(2 * each * (turning.turns // batches))), 16, PARTS))
    count, total = np.zeros((batches, parts), np.int64), np.zeros((sensors, batches, parts))
    offset, square = np.zeros((batches, parts)), np.zeros((batches, parts))
    limit, step, spikes, before, seen = np.full(sensors, np.inf), np.zeros(sensors), 0, np.nan, 0
    for number, chunk in enumerate(chunks(raw)):
        angle, before = angles_of(chunk, turning, before)
        if number == 0:
            step = np.array([step_of(each[:SAMPLE]) for each in chunk.reading])
            limit = np.maximum(limits(chunk.reading[:, :SAMPLE]), 4 * step)
        turn = angle / TAU
        seen += int(np.count_nonzero((turn >= 0) & (turn < turning.turns)))
        spikes += add_up(chunk.reading, turn, turning.sense, turning.turns, limit, count, offset, square, total)
    if not count.any():
        raise MethodError(
            "displacement: expected samples with readings of all sensors; found none in the whole turns",
            code="spindle.no_samples",
        )
    variance = square / np.maximum(count, 1) - np.square(offset / np.maximum(count, 1))
    middle = (np.arange(parts) + 0.5 + offset / np.maximum(count, 1)) * TAU / parts
    means = total / np.maximum(count, 1)
    variance = np.maximum(variance, 0.0) * (TAU / parts) ** 2
    fitted = _fitted(count, middle, variance, means, turning.turns, wanted, limit, spikes, seen)
    return _with_rounding(fitted, step, float(raw["displacement_noise"]), turning.turns)


def limits(reading: Array) -> Array:
    """Return the distance of spikes from their neighbours, (sensor,), m; infinite where they are no accidents."""
    largest = np.full(len(reading), np.inf)
    for i, (before, value, after) in enumerate(zip(reading[:, :-2], reading[:, 1:-1], reading[:, 2:], strict=True)):
        d = np.abs(value - (before + after) / 2)
        known = np.isfinite(d)
        if known.sum() > FEWEST_READINGS:
            limit = SPIKE * float(scale_about_zero(d[known]))
            if limit > 0 and np.mean((d > limit) & (np.abs(after - before) < d / 2)) < SPIKES:
                largest[i] = limit
    return largest


def _fitted(
    count: NDArray[np.int64],
    middle: Array,
    variance: Array,
    means: Array,
    turns: int,
    wanted: int,
    limit: Array,
    spikes: int,
    seen: int,
) -> Synchronous:
    """Return the harmonics of all batches whose samples determine them."""
    gaps = np.array([_gap(middle[b][count[b] > 0]) for b in range(len(count))])
    usual = float(np.median(gaps))
    K = min(wanted, int(_NYQUIST * np.pi / usual + 1e-6)) if np.isfinite(usual) else 0
    if K < 1:
        raise MethodError(
            "The samples leave more than half of a turn without readings; expected some ten in each turn.",
            code="spindle.turn.incomplete",
        )
    kept = gaps <= 1.2 * np.pi / K
    notes, doubts = list[str](), list[str]()
    if wanted > K:
        notes.append(
            f"The samples determine {K} undulations in one turn instead of {wanted}; what is above is no part of the "
            "synchronous error motion, or folded into it."
        )
    if kept.sum() < FEWEST_BATCHES:
        raise MethodError(
            f"Only {kept.sum()} of {kept.size} batches of turns have samples over the whole turn; expected "
            f"{FEWEST_BATCHES} or more.",
            code="spindle.batches.too_few",
        )
    if not kept.all():
        notes.append(f"{(~kept).sum()} of {kept.size} batches of turns have gaps and are not used.")
    coefficients = np.zeros((len(count), 2 * K + 1, len(means)))
    for b in np.flatnonzero(kept):
        there = count[b] > 0
        design = harmonics_at(middle[b, there], K, variance[b, there])
        weighted = design * count[b, there, None]
        coefficients[b] = np.linalg.solve(design.T @ weighted, weighted.T @ means[:, b, there].T)
    used = coefficients[kept]
    batches = len(used)
    slow = _lingering(used)
    if slow > _LINGERING:
        doubts.append(
            "Neighbouring batches of turns are alike: the error motion changes slowly, or contains a motion whose "
            "frequency nearly is a multiple of the speed. The uncertainty of the mean over turns is increased by a "
            f"factor of {np.sqrt(slow):.1f}; a longer record separates them."
        )
    level = np.where(kept[:, None], coefficients[:, 0], np.nan)
    notes += _leftover(used, count[kept], middle[kept], variance[kept], means[:, kept])
    valid = int(count[kept].sum())
    missing = seen - int(count.sum()) - spikes
    if spikes:
        notes.append(f"{spikes} readings stand out from both neighbours; these samples are not used.")
    if missing > 0:
        notes.append(f"{missing} of {seen} samples have no reading of one or more sensors and are not used.")
    factor = float(expansion(batches - 1)) * float(np.sqrt(slow) if slow > _LINGERING else 1.0)
    levels, none = _levels(level, turns / len(count)), np.zeros(len(means))
    return Synchronous(used, levels, factor, valid, limit, spikes, max(missing, 0), none, none, notes, doubts)


def _with_rounding(synchronous: Synchronous, step: Array, noise: float, turns: int) -> Synchronous:
    """Return the mean with what rounding adds: alike in all turns, and independent from angle to angle.

    The scatter from turn to turn, which averages rounding out, is at least the noise of a sensor and the scatter of the
    batches at one angle. Neighbouring angles are rounded differently, by the eccentricity.
    """
    if not step.any():
        return synchronous
    batches = len(synchronous.coefficient)
    scatter = synchronous.coefficient[:, 1:].var(axis=0, ddof=1).sum(axis=0) / 2 * turns / batches
    before = np.hypot(noise, np.sqrt(scatter))
    alike = np.array([float(common(float(q), s)) for q, s in zip(step, before, strict=True)])
    samples_per_turn = max(synchronous.count / turns, 1.0)  # samples in a turn
    rounded = alike * np.sqrt(np.minimum((2 * synchronous.harmonics + 1) / samples_per_turn, 1.0))
    notes = list(synchronous.notes)
    if (alike > 0.1 * step).any():
        words = ", ".join(f"sensor {i + 1} by {1e9 * q:.3g} nm" for i, q in enumerate(step) if q > 0)
        notes.append(
            f"The readings are rounded ({words}), with less motion from turn to turn than that: rounding is a part of "
            "the uncertainties."
        )
    return replace(synchronous, step=step, rounded=rounded, notes=notes)


def _gap(angle: Array) -> float:
    """Return the largest gap between angles of a turn, rad."""
    if angle.size < 2:
        return np.inf
    ordered = np.sort(angle)
    return float(np.diff(np.append(ordered, ordered[0] + TAU)).max())


def _lingering(coefficient: Array) -> float:
    """Return the ratio of the variance of the mean of the batches to that of independent ones, at least 1.

    ``1 + 2 sum_k (1 - k / B) rho_k``, with the correlation rho_k of batches k apart, of all harmonics but the
    eccentricity, up to a quarter of the batches: a vibration whose phase turns from batch to batch averages out.
    """
    K, batches = (coefficient.shape[1] - 1) // 2, len(coefficient)
    rows = [k for k in range(1, 2 * K + 1) if k not in (1, K + 1)]
    off = coefficient[:, rows] - coefficient[:, rows].mean(axis=0)
    if batches < 8 or not off.any():
        return 1.0
    total = 1.0
    for k in range(1, batches // 4 + 1):
        # The removed mean makes each correlation smaller by 1 / B
        rho = float((off[k:] * off[:-k]).sum() / np.square(off).sum()) * batches / (batches - k) + 1 / batches
        total += 2 * (1 - k / batches) * rho
    return max(total, 1.0)


def _levels(level: Array, turns: float) -> Array:
    """Return the slow change of the readings, (sensor, batch), m: that of batches of many turns, or a line."""
    batch = np.arange(len(level))
    known = np.isfinite(level[:, 0])
    if turns >= LONG:
        return np.array([np.interp(batch, batch[known], each[known]) for each in level.T])
    return np.array([np.polyval(np.polyfit(batch[known], each[known], 1), batch) for each in level.T])


def _leftover(used: Array, count: NDArray[np.int64], middle: Array, variance: Array, means: Array) -> list[str]:
    """Return a note on what repeats from turn to turn and has more undulations than are evaluated."""
    K, batches = (used.shape[1] - 1) // 2, len(used)
    groups = 4 * K
    total, weight = np.zeros((len(means), batches, groups)), np.zeros((batches, groups))
    for b in range(batches):
        there = count[b] > 0
        rest = means[:, b, there] - (harmonics_at(middle[b, there], K, variance[b, there]) @ used[b]).T
        group = (middle[b, there] % TAU / TAU * groups).astype(int) % groups
        weight[b] = np.bincount(group, count[b, there], groups)
        for i, each in enumerate(rest):
            total[i, b] = np.bincount(group, each * count[b, there], groups)
    seen = weight > 0
    number = seen.sum(axis=0)
    known = number >= FEWEST_BATCHES
    if known.sum() < groups / 2:
        return []
    texts = []
    for i, each in enumerate(total / np.maximum(weight, 1)):
        mean = each.sum(axis=0) / np.maximum(number, 1)
        off = np.where(seen, each - mean, 0.0)
        scatter = np.square(off).sum(axis=0) / np.maximum(number - 1, 1) / np.maximum(number, 1)
        square, expected = float(np.square(mean[known]).mean()), float(scatter[known].mean())
        size = np.sqrt(max(square - expected, 0.0))
        if square > expected * (1 + 8 * np.sqrt(2 / known.sum())) and size > 1e-9:
            texts.append(f"{1e9 * size:.2g} nm (sensor {i + 1})")
    if not texts:
        return []
    return [
        f"Motions with more than {K} undulations in one turn repeat from turn to turn: {', '.join(texts)}, root mean "
        "square. They are no part of the synchronous error motion; increase harmonics."
    ]
