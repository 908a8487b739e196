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


def _fit(distance: Array, origin: Array, direction: Array, radius: float, z1: float, z2: float, start: Array) -> Array:
    """Return the axes (instant, 4) by Newton's method from ``start``, all instants at the same time."""
    height = z2 - z1
    found = np.full((distance.shape[1], 4), np.nan)
    instant = np.flatnonzero(np.isfinite(distance[:SIDE]).all(axis=0))
    q = np.tile(start, (instant.size, 1))
    at = np.broadcast_to(origin, (distance.shape[1], *origin.shape[-2:]))[instant, :SIDE]
    surface = at + direction[:SIDE] * distance[:SIDE, instant].T[:, :, None]  # (instant, beam, 3)
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
        found[instant[done]] = q[done]
        going = size > _LAST_STEP  # False for NaN: no cylinder there
        instant, q, surface = instant[going], q[going], surface[going]
        if not instant.size:
            break
    return found


def start_axis(origin: Array, direction: Array, distance: Array, radius: float, levels: Array) -> Array:
    """Return a starting axis (4,) from one set of readings, as if every side beam pointed to the middle of the bar.

    Each side beam i gives one equation for the axis at its height: in its horizontal direction the axis is one radius
    behind the surface point. The four equations are linear in q. Singular (parallel) beams give NaN.
    """
    point = origin[:SIDE] + direction[:SIDE] * distance[:SIDE, None]
    flat = direction[:SIDE].copy()
    flat[:, 2] = 0.0
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    tau = (point[:, 2] - levels[0]) / (levels[1] - levels[0])
    rows = np.column_stack([(1 - tau) * flat[:, 0], (1 - tau) * flat[:, 1], tau * flat[:, 0], tau * flat[:, 1]])
    if not np.linalg.cond(rows) < 1e8:
        return np.full(4, np.nan)
    return np.linalg.solve(rows, np.sum(flat * point, axis=1) + radius)


def fit_axis(
    distance: Array, origin: Array, direction: Array, radius: float, levels: Array, start: Array | None = None
) -> Array:
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
    start : ndarray (4,), optional
        Start of Newton's method; default from the first instant without NaN.

    Returns
    -------
    ndarray (instant, 4)
        x and y of the axis at L1, then at L2, m; NaN where a reading is NaN or no cylinder fits.
    """
    unknown = np.full((distance.shape[1], 4), np.nan)
    if start is None:
        known = np.flatnonzero(np.isfinite(distance[:SIDE]).all(axis=0))
        if known.size == 0:
            return unknown
        first = origin if origin.ndim == 2 else origin[known[0]]
        start = start_axis(first, direction, distance[:, known[0]], radius, levels)
    if not np.isfinite(start).all():
        return unknown
    return _fit(distance, origin, direction, radius, float(levels[0]), float(levels[1]), start)


def end_point(q: Array, distance_z: Array, origin: Array, direction: Array, levels: Array) -> tuple[Array, Array]:
    """Return axis directions (instant, 3) and the points E where the axis meets the end face (instant, 3), m.

    ``origin`` (3,) or (instant, 3) and ``direction`` (3,) are those of the Z beam, ``distance_z`` (instant,) its
    readings.
    """
    A = np.column_stack([q[:, 0], q[:, 1], np.full(len(q), levels[0])])
    B = np.column_stack([q[:, 2], q[:, 3], np.full(len(q), levels[1])])
    a = (B - A) * np.sign(levels[1] - levels[0])
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    S = origin + direction * distance_z[:, None]
    along = np.einsum("ti,ti->t", a, S - A)
    return a, A + a * along[:, None]


def states(distance: Array, origin: Array, direction: Array, radius: float, levels: Array) -> Array:
    """Return the states of the bar, (instant, 5): E, m, and the slopes a_x / a_z, a_y / a_z; arguments of `fit_axis`.

    NaN where one of the five readings is NaN, or where no cylinder fits.
    """
    q = fit_axis(np.where(np.isfinite(distance).all(axis=0), distance, np.nan), origin, direction, radius, levels)
    a, E = end_point(q, distance[4], origin[..., 4, :], direction[4], levels)
    return np.column_stack([E, a[:, :2] / a[:, 2:]])


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
