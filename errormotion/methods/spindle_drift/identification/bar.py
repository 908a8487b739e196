"""Position of the bar from five distances: the axis of a cylinder of known radius, and its end face.

The axis is the line through A = (x1, y1, L1) and B = (x2, y2, L2); q = (x1, y1, x2, y2) are the four unknowns of the
four side readings. A beam with origin P, direction u and reading d touches the bar at S = P + u d, and

    g_i(q) = |S_i - line(q)| - r = 0,   i = X1, X2, Y1, Y2

is solved by Newton's method for every instant. With n the unit vector from the axis to S and tau the position of its
foot on AB, its derivative is -n . ((1 - tau) dA + tau dB).

The end face is the plane through S_Z at right angles to the axis; E, where the axis meets it, carries the Z motion.
Source: Geiselhart et al. (euspen 2024), section 2.4; derivatives by the authors of this package.
"""

from __future__ import annotations

import numpy as np

from errormotion.arrays import Array

SIDE = 4
"""Number of side channels: X1, X2, Y1, Y2 come first, Z last."""
MAX_STEPS = 30
_LAST_STEP = 1e-10
"""Step at which Newton's method ends, m: the remaining error is about its square by the radius, below 1e-17 m."""
_SINGULAR = 1e-12
"""Determinant of the derivatives below which the beams do not determine the axis."""


def fit_axis(distance: Array, origin: Array, direction: Array, radius: float, levels: Array) -> Array:
    """Fit the axis of a cylinder of known radius to the four side readings of every instant.

    Parameters
    ----------
    distance : ndarray (>= 4, instant)
        Readings of X1, X2, Y1, Y2 in this order, m; further rows are ignored.
    origin : ndarray (>= 4, 3) or (instant, >= 4, 3)
        Zero points of the beams, m.
    direction : ndarray (>= 4, 3)
        Their unit vectors.
    radius : float
        Bar radius, m.
    levels : ndarray (2,)
        Heights L1, L2 at which the axis is given, m.

    Returns
    -------
    ndarray (instant, 4)
        x and y of the axis at L1, then at L2, m; NaN where a reading is NaN or no cylinder fits.
    """
    u = direction[:SIDE]
    surface = origin[..., :SIDE, :] + u * distance[:SIDE].T[:, :, None]  # (instant, beam, 3)
    axes = np.full((len(surface), 4), np.nan)
    instant = np.flatnonzero(np.isfinite(surface).all(axis=(1, 2)))
    start = _start(surface[instant[0]], u, radius, levels) if instant.size else axes[:0]
    if np.isfinite(start).all() and instant.size:
        axes[instant] = _newton(surface[instant], radius, float(levels[0]), float(levels[1]), start)
    return axes


def _start(point: Array, direction: Array, radius: float, levels: Array) -> Array:
    """Return a starting axis (4,) from points (4, 3), as if every side beam pointed to the middle of the bar.

    Each side beam i gives one equation for the axis at its height: in its horizontal direction the axis is one radius
    behind the surface point. The four equations are linear in q. Singular (parallel) beams give NaN.
    """
    flat = direction * [1.0, 1.0, 0.0]
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    tau = (point[:, 2:] - levels[0]) / (levels[1] - levels[0])
    rows = np.concatenate([(1 - tau) * flat[:, :2], tau * flat[:, :2]], axis=1)
    if not np.linalg.cond(rows) < 1e8:
        return np.full(4, np.nan)
    return np.linalg.solve(rows, np.sum(flat * point, axis=1) + radius)


def _newton(surface: Array, radius: float, z1: float, z2: float, start: Array) -> Array:
    """Return the axes (instant, 4) of points (instant, 4, 3) by Newton's method, all instants at the same time."""
    height = z2 - z1
    axes = np.full((len(surface), 4), np.nan)
    instant, q = np.arange(len(surface)), np.tile(start, (len(surface), 1))
    for _ in range(MAX_STEPS):
        slope = (q[:, 2:] - q[:, :2]) / height
        w = surface - np.concatenate([q[:, :2], np.full((len(q), 1), z1)], axis=1)[:, None]
        s = ((w[..., :2] * slope[:, None]).sum(axis=2) + w[..., 2]) / (1.0 + (slope**2).sum(axis=1))[:, None]
        flat = w[..., :2] - s[..., None] * slope[:, None]
        length = np.sqrt((flat**2).sum(axis=2) + (w[..., 2] - s) ** 2)
        n, tau = flat / length[..., None], (s / height)[..., None]
        m = np.concatenate([(1.0 - tau) * n, tau * n], axis=2)
        regular = np.abs(np.linalg.det(m)) > _SINGULAR
        step = np.full_like(q, np.nan)
        step[regular] = np.linalg.solve(m[regular], (length - radius)[regular, :, None])[..., 0]
        q = q + step
        size = np.abs(step).max(axis=1)
        done = size <= _LAST_STEP
        axes[instant[done]] = q[done]
        going = size > _LAST_STEP  # False for NaN: no cylinder there
        instant, q, surface = instant[going], q[going], surface[going]
        if not instant.size:
            break
    return axes


def states(distance: Array, origin: Array, direction: Array, radius: float, levels: Array) -> Array:
    """Return the states of the bar, (instant, 5): E, m, and the slopes a_x / a_z, a_y / a_z; arguments of `fit_axis`.

    NaN where one of the five readings is NaN, or where no cylinder fits.
    """
    q = fit_axis(distance, origin, direction, radius, levels)
    A = np.column_stack([q[:, :2], np.full(len(q), levels[0])])
    slope = (q[:, 2:] - q[:, :2]) / (levels[1] - levels[0])
    a = np.column_stack([slope, np.ones(len(q))]) / np.sqrt(1.0 + np.sum(slope**2, axis=1, keepdims=True))
    S = origin[..., 4, :] + direction[4] * distance[4, :, None]
    return np.column_stack([A + a * np.sum(a * (S - A), axis=1, keepdims=True), slope])


def axis_direction(state: Array) -> list[Array]:
    """Return the directions of the axis of states (n, 5) by coordinate, (n,)."""
    slope = state[:, 3:].T
    up = 1.0 / np.sqrt(1.0 + slope[0] ** 2 + slope[1] ** 2)
    return [slope[0] * up, slope[1] * up, up]


def errors_of(state: Array, reference: Array, point: Array, rotation: Array | float = 0.0) -> Array:
    """Return EX EY EZ EA EB, (n, 5), m and rad, of states relative to a reference state.

    Parameters
    ----------
    state, reference : ndarray (n, 5), or one of them (1, 5)
    point : ndarray (3,)
        Functional point, m.
    rotation : float or ndarray (n,)
        About the axis of the reference state, rad.
    """
    a, a0, E, E0 = axis_direction(state), axis_direction(reference), state[:, :3].T, reference[:, :3].T
    w = _cross(a0, a)
    lever = _cross([w[k] + rotation * a0[k] for k in range(3)], [point[k] - E0[k] for k in range(3)])
    return np.column_stack([*(E[k] - E0[k] + lever[k] for k in range(3)), w[0], w[1]])


def _cross(v: list[Array], w: list[Array]) -> list[Array]:
    """Return the vector product by coordinate."""
    return [v[1] * w[2] - v[2] * w[1], v[2] * w[0] - v[0] * w[2], v[0] * w[1] - v[1] * w[0]]
