"""Outliers: readings that contradict the others.

A reading is tested by its residual over the expected one, sigma sqrt(redundancy). If a target has two redundant
readings, the outlier has the largest. With one, as with four stations, all its residuals are equal whichever is wrong:
the outlier is then the reading without which the error of the target agrees with those of the other targets. If this is
true of several readings, the target is excluded.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from errormotion.arrays import Array
from errormotion.estimation.robust import NORMAL_MAD, scale_about_zero
from errormotion.methods.multilateration.network.model import directions
from errormotion.methods.multilateration.network.network import Network

FALSE_ALARMS = 0.01
"""Probability of ignoring any good reading of a network."""
CLEAR = 2.5
"""Standard deviations by which an outlier must exceed the other residuals of its target."""
NEAR = 4.0
"""Robust standard deviations within which the error of a target agrees with those of the others."""
_MIN_REDUNDANCY = 1e-3
_GROSS = 50.0  # over the median distance from the nominal one
_SHOWN = 12


@dataclass(frozen=True)
class Outliers:
    """Outliers (station, target) and excluded targets, both from 0; ``out`` (n, m) are all readings excluded."""

    left_out: tuple[tuple[int, int], ...]
    undecided: tuple[int, ...]
    out: NDArray[np.bool_] = field(compare=False, repr=False)

    @classmethod
    def none(cls, reading: Array) -> Outliers:
        """Return no outliers, for readings (n, m)."""
        return cls((), (), np.zeros(reading.shape, dtype=bool))


def notes(left_out: tuple[tuple[int, int], ...], undecided: tuple[int, ...]) -> list[str]:
    """Return notes on outliers and excluded targets."""
    found = []
    if left_out:
        shown = ", ".join(f"station {j + 1} of target {i + 1}" for j, i in left_out[:_SHOWN])
        more = f" and {len(left_out) - _SHOWN} more" if len(left_out) > _SHOWN else ""
        found.append(f"Outliers, ignored ({len(left_out)}): {shown}{more}.")
    if undecided:
        shown = ", ".join(str(i + 1) for i in undecided[:_SHOWN])
        more = f" and {len(undecided) - _SHOWN} more" if len(undecided) > _SHOWN else ""
        found.append(
            f"Targets excluded, with contradictory readings of which the wrong one is not determined "
            f"({len(undecided)}): {shown}{more}. Readings from a further station would determine it."
        )
    return found


def normalised(network: Network) -> Array:
    """Return residuals over the expected ones, (n, m); NaN where a reading has no redundancy."""
    checked = np.where(network.redundancy > _MIN_REDUNDANCY, network.redundancy, np.nan)
    found: Array = network.residual * network.weight / np.sqrt(checked)
    return found


def gate(t: Array) -> float:
    """Return the normalised residual above which a reading is an outlier, from all (n, m)."""
    scale = max(1.0, scale_about_zero(t))
    return -scale * float(ndtri(0.5 * FALSE_ALARMS / max(int(np.count_nonzero(np.isfinite(t))), 1)))


def gross(reading: Array, nominal: Array, position: Array, dead_path: Array) -> Outliers:
    """Return the gross outliers of readings (n, m), by the distances from nominal targets (m, 3).

    These differ from the distances to the approximate stations (n, 3), with their dead paths (n,), by far more than
    other readings.
    """
    off = np.empty_like(reading)
    for j in range(len(reading)):
        off[j] = np.abs(np.linalg.norm(nominal - position[j], axis=1) - dead_path[j] - reading[j])
    out = off > _GROSS * np.nanmedian(off, axis=1, keepdims=True)
    return Outliers(tuple((int(j), int(i)) for j, i in np.argwhere(out)), (), out)


def search(network: Network, nominal: Array, before: Outliers) -> Outliers:
    """Return the known outliers and the largest of those that remain.

    Parameters
    ----------
    network : Network
        Solution without the known outliers.
    nominal : ndarray (m, 3)
        Nominal targets, m.
    before : Outliers
        Known outliers.
    """
    with np.errstate(invalid="ignore"):
        t = np.abs(normalised(network))
    if not np.isfinite(t).any():
        return before
    limit = gate(t)
    worst = np.max(np.nan_to_num(t), axis=0)
    # A gross outlier increases other residuals: first those of its size.
    targets = np.flatnonzero(worst > max(limit, 0.5 * worst.max()))
    if not len(targets):
        return before
    which = _by_residuals(t[:, targets], network, targets)
    open_ = which < 0
    if open_.any():
        which[open_] = _by_positions(network, nominal, targets[open_])
    out = before.out.copy()
    found = which >= 0
    out[which[found], targets[found]] = True
    out[:, targets[~found]] = True
    left_out = before.left_out + tuple(
        (int(j), int(i))
        for j, i in zip(which[found], targets[found], strict=True)
        if np.isfinite(network.reading[j, i])
    )
    return Outliers(left_out, tuple(sorted({*before.undecided, *(int(i) for i in targets[~found])})), out)


def _by_residuals(t: Array, network: Network, targets: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the station with the clearly largest residual of each target, -1 where there is none."""
    t = np.nan_to_num(t)
    order = np.sort(t, axis=0)
    clear = order[-1] ** 2 - order[-2] ** 2 > CLEAR**2
    spare = np.count_nonzero(network.weight[:, targets], axis=0) > 4
    return np.where(clear & spare, t.argmax(axis=0), -1)


def _by_positions(network: Network, nominal: Array, targets: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the station without which the error of each target agrees with the others, -1 where none or several."""
    deviation = network.target - nominal
    usual = np.nanmedian(deviation, axis=0)
    spread = NORMAL_MAD * np.nanmedian(np.abs(deviation - usual), axis=0)
    own = network.fit.normal.own[targets]
    e = directions(network.target[targets], network.station)
    w, r, share = network.weight[:, targets], network.residual[:, targets], network.redundancy[:, targets]
    with np.errstate(invalid="ignore", divide="ignore"):
        moved = (
            -np.einsum("tab,jtb->jta", own, e)
            * (w**2 * r / np.where(share > _MIN_REDUNDANCY, share, np.nan))[..., None]
        )
    off = np.linalg.norm((deviation[targets] + moved - usual) / np.maximum(spread, 1e-12), axis=-1) / np.sqrt(3)
    off = np.where(np.isfinite(off), off, np.inf)
    order = np.sort(off, axis=0)
    clear = (order[0] < NEAR) & (order[1] > 2 * NEAR)
    return np.where(clear, off.argmin(axis=0), -1)
