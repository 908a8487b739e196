"""Text of a plan: the map of the predicted uncertainty, and the best layout as settings of a campaign."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array

if TYPE_CHECKING:
    from errormotion.methods.multilateration.settings import Layout

_ACROSS, _LEVELS = 7, 3


def map_text(position: Array, own: Array, best: Array) -> str:
    """Return tables of the uncertainty over the volume, um, as set and best, one table for each of some heights.

    Parameters
    ----------
    position : ndarray (k, 3)
        Axis positions, m; the text is empty if they are not a grid.
    own, best : ndarray (k,)
        m; NaN where unknown.
    """
    x, y, z = (np.unique(np.round(column, 9)) for column in position.T)
    if len(x) * len(y) * len(z) != len(position):
        return ""
    x, y, z = _some(x, _ACROSS), _some(y, _ACROSS), _some(z, _LEVELS)
    at = {tuple(np.round(row, 9)): k for k, row in enumerate(position)}
    lines = ["Uncertainty over the volume, um, as set | best; columns X, rows Y, mm:"]
    for level in z:
        lines.append(f"Z {1e3 * level:.0f}")
        head = " ".join(f"{1e3 * column:6.0f}" for column in x)
        lines.append(f"{'':7}{head} | {head}")
        for row in y[::-1]:
            numbers = [at[(column, row, level)] for column in x]
            cells = [" ".join(_cell(values[k]) for k in numbers) for values in (own, best)]
            lines.append(f"{1e3 * row:6.0f} {cells[0]} | {cells[1]}")
    return "\n".join(lines)


def layout_text(layout: Layout, station: Array, targets: Array | None) -> str:
    """Return the table ``[test.settings.layout]`` of a campaign file; without targets (m), with the grid."""
    lines = ["[test.settings.layout]"]
    if targets is None:
        lines += [f"{name} = {_quoted(getattr(layout, name))}" for name in ("low", "high")]
        lines.append(f"count = {list(layout.count)}")
    lines += [
        f"reflector = {_quoted(layout.reflector)}",
        f'displacement_noise = "{layout.displacement_noise * 1e6:g} um"',
        "stations = [",
        *(f"    {_quoted(np.round(point, 3))}," for point in station),
        "]",
    ]
    if targets is not None:
        lines += ["targets = [", *(f"    {_quoted(np.round(point, 6))}," for point in targets), "]"]
    return "\n".join(lines) + "\n"


def _quoted(point: Array | tuple[float, float, float]) -> str:
    return "[{}]".format(", ".join(f'"{1e3 * float(v):.7g} mm"' for v in point))


def _cell(value: float) -> str:
    return f"{1e6 * value:6.2f}" if np.isfinite(value) else "     -"


def _some(values: Array, most: int) -> Array:
    kept = np.linspace(0, len(values) - 1, min(len(values), most)).round().astype(int)
    return np.asarray(values[np.unique(kept)], dtype=np.float64)
