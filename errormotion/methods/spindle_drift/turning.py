"""What the spindle's turning does to means: run-out vanishes in whole turns, and only there.

While the speed changes, a mean holds parts of turns: it is unknown. While the spindle stands still, a mean shows the
bar where it happened to stop, off by up to its run-out: that is one unknown shift for the whole rest, as large as the
readings scatter while turning beyond their noise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from errormotion.methods.spindle_drift.uncertainty import CHANNELS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.methods.spindle_drift.record import Record

    Array = NDArray[np.float64]
    Mask = NDArray[np.bool_]

_SAME_SPEED = 0.02
"""Share of the highest speed within which two speeds count as the same: a spindle's speed is never quite steady."""


def turning(record: Record) -> Mask:
    """Return where the spindle turns; nowhere, where its speed is not known."""
    if record.spindle_speed is None:
        return np.zeros(record.averages.time.size, bool)
    return np.nan_to_num(record.spindle_speed) > 0


def settling(record: Record, spin_up: float) -> Mask:
    """Return the means that hold a change of speed, or follow one within ``spin_up`` seconds.

    A record that begins with a turning spindle counts as begun by its start. Readings that came as means already
    (one sample each) are taken as they are.
    """
    time, speed = record.averages.time, record.spindle_speed
    found = np.zeros(time.size, bool)
    if speed is None or time.size < 2 or record.averages.expected[0] <= 1 or spin_up == 0 or np.ptp(time) <= spin_up:
        return found
    steady = np.nan_to_num(speed)
    length = float(np.median(np.diff(time)))
    changed = np.flatnonzero(np.abs(np.diff(steady, prepend=0.0)) > _SAME_SPEED * steady.max())
    for k in changed:
        found |= (time > time[k] - 0.6 * length) & (time < time[k] + spin_up - 1e-6)
    return found


def run_out_at_rest(record: Record, reference: NDArray[np.int64], noise: float) -> list[tuple[str, str, Array]]:
    """Return, per channel and rest, what stopping anywhere in a turn may do to the readings, (5, instant), m.

    Against a reference state that turns these are the rests; against one that rests, the times of turning. Each is
    one draw for its whole length. Empty where the spindle never changes between the two, or its speed is not known.
    """
    turns = turning(record)
    other = turns != turns[reference[0]]
    if record.scatter is None or not other.any():
        return []
    spread = np.sqrt(np.maximum(record.scatter**2 - noise**2, 0.0))
    edges = np.flatnonzero(np.diff(other, prepend=False, append=False))
    found = []
    for number, (begin, end) in enumerate(edges.reshape(-1, 2), start=1):
        for i, channel in enumerate(CHANNELS):
            if spread[i] > 0:
                change = np.zeros((len(CHANNELS), other.size))
                change[i, begin:end] = spread[i]
                found.append((f"run-out {channel}, rest {number}", "run-out at rest", change))
    return found
