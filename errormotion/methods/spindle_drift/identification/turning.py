"""What the spindle's turning does to means: run-out vanishes in whole turns, and only there.

While the speed changes, a mean holds parts of turns: it is unknown. While the spindle stands still, a mean shows the
bar where it happened to stop, off by up to its run-out: that is one unknown shift for the whole rest, as large as the
readings scatter while turning beyond their noise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.methods.spindle_drift.schema import CHANNELS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.methods.spindle_drift.identification.record import Record

    Mask = NDArray[np.bool_]

_SAME_SPEED = 0.02
"""Share of the highest speed within which two speeds count as the same: a measured speed is never quite steady."""


def turns(speed: Array) -> Mask:
    """Return where a spindle turns, either way round; a speed that is not known (NaN) is the one before it."""
    known = np.isfinite(speed)
    if not known.any():
        return np.zeros(speed.shape, bool)
    size = np.abs(held(speed))
    return np.asarray((size > _SAME_SPEED * size.max()) & (size > 0))


def held(speed: Array) -> Array:
    """Return speeds with unknown ones replaced by the last known one, at the beginning by the first."""
    known = np.isfinite(speed)
    if not known.any():
        return np.zeros(speed.shape)
    place = np.maximum.accumulate(np.where(known, np.arange(speed.size), -1))
    return np.asarray(speed[np.where(place < 0, int(np.argmax(known)), place)])


def settling(record: Record, spin_up: float) -> Mask:
    """Return the means that hold a change of speed, or follow one within ``spin_up`` seconds.

    A record that begins with a turning spindle counts as begun by its start. Readings that came as means already
    (one sample each) are taken as they are.
    """
    time, speed = record.averages.time, record.spindle_speed
    found = np.zeros(time.size, bool)
    if speed is None or time.size < 2 or record.averages.expected[0] <= 1 or spin_up == 0 or np.ptp(time) <= spin_up:
        return found
    steady = held(speed)
    length = float(np.median(np.diff(time)))
    for k in np.flatnonzero(np.abs(np.diff(steady, prepend=0.0)) > _SAME_SPEED * np.abs(steady).max()):
        found |= (time > time[k] - 0.6 * length) & (time < time[k] + spin_up - 1e-6)
    return found


def run_out_at_rest(record: Record, reference: NDArray[np.int64], noise: float) -> list[tuple[str, str, Array]]:
    """Return, per channel and rest, what stopping anywhere in a turn may do to the errors, as readings (5, instant), m.

    Each rest is one draw. Where the reference state rests, its own draw is in everything outside of that rest. Empty
    where the spindle always turns, always rests, or its speed is not known.
    """
    if record.scatter is None or record.spindle_speed is None:
        return []
    rests = ~turns(record.spindle_speed)
    if rests.all() or not rests.any():
        return []
    spread = np.sqrt(np.maximum(record.scatter**2 - noise**2, 0.0))
    found = []
    edges = np.flatnonzero(np.diff(rests, prepend=False, append=False)).reshape(-1, 2)
    for number, (begin, end) in enumerate(edges, start=1):
        if begin <= reference[0] < end:
            effect = -np.ones(rests.size)
            effect[begin:end] = 0.0
        else:
            effect = np.zeros(rests.size)
            effect[begin:end] = 1.0
        for i in np.flatnonzero(spread > 0):
            change = np.zeros((len(CHANNELS), rests.size))
            change[i] = effect * spread[i]
            found.append((f"run-out {CHANNELS[i]}, rest {number}", "run-out at rest", change))
    return found
