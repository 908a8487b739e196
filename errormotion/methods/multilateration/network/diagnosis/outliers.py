"""Readings that contradict the others: which they are, and which of them can be identified.

A reading is judged by its residual over what it should be, sigma sqrt(redundancy). Where a target has two readings too
many, the wrong one has the largest. With one too many, as with four stations, all of its residuals are equally
large whichever is wrong: then the one counts as wrong without which the target comes to lie where the machine puts its
other targets. Where several would do, the target is given up and named.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from errormotion.arrays import NORMAL_MAD, Array
from errormotion.methods.multilateration.network.loops import COMPILED_FROM, loops
from errormotion.methods.multilateration.network.model import directions
from errormotion.methods.multilateration.network.network import Network

FALSE_ALARMS = 0.01
"""Probability of leaving out any good reading of a network."""
CLEAR = 2.5
"""By so many standard deviations the wrong reading must stand out among those of its target."""
NEAR = 4.0
"""Within so many usual deviations a target lies where the machine puts its targets."""
_WEAK = 1e-3
_GROSS = 50.0
_SHOWN = 12


@dataclass(frozen=True)
class Found:
    """Readings left out (station, target) and targets given up, both from 0."""

    left_out: tuple[tuple[int, int], ...]
    undecided: tuple[int, ...]
    out: NDArray[np.bool_] = field(compare=False, repr=False)

    @classmethod
    def none(cls, weight: Array) -> Found:
        """Return that nothing was found."""
        return cls((), (), np.zeros(weight.shape, dtype=bool))

    def applied(self, weight: Array) -> Array:
        """Return the weights (n, m) with what was found at 0."""
        return np.where(self.out, 0.0, weight)


def notes(left_out: tuple[tuple[int, int], ...], undecided: tuple[int, ...]) -> list[str]:
    """Return notes on readings that were excluded and targets that were given up."""
    found = []
    if left_out:
        shown = ", ".join(f"station {j + 1} of target {i + 1}" for j, i in left_out[:_SHOWN])
        more = f" and {len(left_out) - _SHOWN} more" if len(left_out) > _SHOWN else ""
        found.append(f"wrong readings left out ({len(left_out)}): {shown}{more}")
    if undecided:
        shown = ", ".join(str(i + 1) for i in undecided[:_SHOWN])
        more = f" and {len(undecided) - _SHOWN} more" if len(undecided) > _SHOWN else ""
        found.append(
            f"targets given up ({len(undecided)}), since one of their readings is wrong and it is not determined "
            f"which: {shown}{more}; readings from a further station would determine it"
        )
    return found


def normalised(network: Network) -> Array:
    """Return residuals over what they should be, (n, m); NaN where a reading is not checked by others."""
    checked = np.where(network.redundancy > _WEAK, network.redundancy, np.nan)
    found: Array = network.residual * network.weight / np.sqrt(checked)
    return found


def gate(t: Array) -> float:
    """Return above which normalised residual (n, m) a reading is wrong."""
    scale = max(1.0, NORMAL_MAD * float(np.nanmedian(np.abs(t))))
    return scale * _least_gate(int(np.count_nonzero(np.isfinite(t))))


def _least_gate(checks: int) -> float:
    return -float(ndtri(0.5 * FALSE_ALARMS / max(checks, 1)))


def _clean(network: Network) -> bool:
    """Whether no reading is above the lowest gate there is, with noise as it was stated: a quick look at large ones."""
    if len(network.target) < COMPILED_FROM or len(network.station) != 4 or len(network.extra):
        return False
    checks, worst = loops(len(network.target)).screen_targets(
        network.reading, network.weight, network.station, network.dead_path, np.ascontiguousarray(network.target.T),
        network.factor, _WEAK,
    )  # fmt: skip
    return bool(worst <= _least_gate(checks))


def gross(reading: Array, weight: Array, nominal: Array, place: Array, dead_path: Array) -> Found:
    """Return the readings (n, m) so far off the nominal targets (m, 3) that no network can bear them.

    Off by more than the stations' rough places (n, 3) and dead paths (n,) make any other reading, by far.
    """
    off = np.empty_like(reading)
    for j in range(len(reading)):
        off[j] = np.abs(np.linalg.norm(nominal - place[j], axis=1) - dead_path[j] - reading[j])
    off[weight == 0] = np.nan
    out = off > _GROSS * np.nanmedian(off, axis=1, keepdims=True)
    return Found(tuple((int(j), int(i)) for j, i in np.argwhere(out)), (), out)


def search(network: Network, weight: Array, nominal: Array, before: Found) -> Found:
    """Return what was found before, and the grossest of the wrong readings that are still in use.

    Parameters
    ----------
    network : Network
        Solved without what was found before.
    weight : ndarray (n, m)
        Of the readings as if none was wrong.
    nominal : ndarray (m, 3)
        Nominal targets, m.
    before : Found
        What was found before.
    """
    if _clean(network):
        return before
    with np.errstate(invalid="ignore"):
        t = np.abs(normalised(network))
    if not np.isfinite(t).any():
        return before
    limit = gate(t)
    worst = np.max(np.nan_to_num(t), axis=0)
    # A gross one makes others look wrong: first those of its size.
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
        (int(j), int(i)) for j, i in zip(which[found], targets[found], strict=True) if weight[j, i] > 0
    )
    return Found(left_out, tuple(sorted({*before.undecided, *(int(i) for i in targets[~found])})), out)


def _by_residuals(t: Array, network: Network, targets: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the station whose reading is clearly the worst of each target, -1 where there is none."""
    t = np.nan_to_num(t)
    order = np.sort(t, axis=0)
    clear = order[-1] ** 2 - order[-2] ** 2 > CLEAR**2
    spare = np.count_nonzero(network.weight[:, targets], axis=0) > 4
    return np.where(clear & spare, t.argmax(axis=0), -1)


def _by_positions(network: Network, nominal: Array, targets: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the station without which each target lies where others do, -1 where none or several would do."""
    deviation = network.target - nominal
    usual = np.nanmedian(deviation, axis=0)
    spread = NORMAL_MAD * np.nanmedian(np.abs(deviation - usual), axis=0)
    own, _, _ = network.blocks(targets)
    e = directions(network.target[targets], network.stations)
    w, r, share = network.weight[:, targets], network.residual[:, targets], network.redundancy[:, targets]
    with np.errstate(invalid="ignore", divide="ignore"):
        moved = -np.einsum("tab,jtb->jta", own, e) * (w**2 * r / np.where(share > _WEAK, share, np.nan))[..., None]
    off = np.linalg.norm((deviation[targets] + moved - usual) / np.maximum(spread, 1e-12), axis=-1) / np.sqrt(3)
    off = np.where(np.isfinite(off), off, np.inf)
    order = np.sort(off, axis=0)
    clear = (order[0] < NEAR) & (order[1] > 2 * NEAR)
    return np.where(clear, off.argmin(axis=0), -1)
