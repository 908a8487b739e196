"""Reference circles of a polar plot besides that of least squares: minimum zone, inscribed and circumscribed.

On a polar plot that is enlarged about a large circle, a centre (a, b) changes a value v(q) by ``-a cos q - b sin q``:

* the minimum zone circles (MZC) have the smallest range;
* the minimum circumscribed circle (MCC) has the smallest largest value, and the value is the range about its centre;
* the maximum inscribed circle (MIC) has the largest smallest value, likewise.

Each is a linear programme in the centre and one or two radii. Its dual, the maximum of ``v . w`` over weights w >= 0 of
the points that touch the circles, with ``sum w = 1`` and ``sum w (cos q, sin q) = 0``, has a basis of three or four
points, and is solved by exchange of one point at a time, for many plots together.
"""

from __future__ import annotations

import numpy as np

from errormotion.arrays import Array

CIRCLES = ("MZC", "MIC", "MCC")
_EXCHANGES = 200
_LEVEL = 1e-9
"""Part of the range of a plot by which a point outside of its circle is rounding."""


def range_about(values: Array, angle: Array, circle: str) -> Array:
    """Return the ranges of plots (..., place) about the centre of one of `CIRCLES`."""
    flat = values.reshape(-1, angle.size)
    centre = centre_of(flat, angle, circle)
    rest = flat - centre @ np.stack([np.cos(angle), np.sin(angle)])
    return np.asarray(np.ptp(rest, axis=1).reshape(values.shape[:-1]))


def centre_of(values: Array, angle: Array, circle: str) -> Array:
    """Return the centres of plots (plot, place), (plot, 2)."""
    n = angle.size
    one, round_ = np.ones(n), np.stack([np.cos(angle), np.sin(angle)])
    if circle == "MZC":
        outer, inner = np.concatenate([[one, 0 * one], round_]), np.concatenate([[0 * one, one], -round_])
        columns, cost = np.concatenate([outer, inner], axis=1), np.concatenate([values, -values], axis=1)
        start, right = np.array([0, n // 2, n + n // 4, n + 3 * n // 4]), np.array([1.0, 1.0, 0.0, 0.0])
    else:
        columns, start, right = np.concatenate([[one], round_]), np.array([0, n // 3, 2 * n // 3]), np.eye(3)[0]
        cost = values if circle == "MCC" else -values
    centre = _exchanged(columns, right, cost, start)[:, -2:]
    return -centre if circle == "MIC" else centre


def _exchanged(columns: Array, right: Array, cost: Array, start: Array) -> Array:
    """Return y (plot, m) that solves min right . y with columns' y >= cost, for each cost (plot, n).

    By the simplex method on the dual: max cost . w with columns w = right and w >= 0.
    """
    plots = np.arange(len(cost))
    basis = np.tile(start, (len(cost), 1)).astype(np.intp)
    level = _LEVEL * np.maximum(np.ptp(cost, axis=1), 1e-300)
    y = np.zeros((len(cost), len(right)))
    for _ in range(_EXCHANGES):
        B = columns[:, basis[plots]].transpose(1, 0, 2)  # (plot, m, m)
        of = np.take_along_axis(cost[plots], basis[plots], axis=1)
        y[plots] = np.linalg.solve(B.transpose(0, 2, 1), of[..., None])[..., 0]
        outside = cost[plots] - y[plots] @ columns
        entering = outside.argmax(axis=1)
        going = outside[np.arange(len(plots)), entering] > level[plots]
        if not going.any():
            break
        plots, B, entering = plots[going], B[going], entering[going]
        weight = np.linalg.solve(B, np.broadcast_to(right[:, None], (len(plots), len(right), 1)))[..., 0]
        change = np.linalg.solve(B, columns[:, entering].T[..., None])[..., 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(change > 1e-12, np.maximum(weight, 0.0) / change, np.inf)
        basis[plots, ratio.argmin(axis=1)] = entering
    return y
