"""The errors of a volume in space: an arrow at each target, as in the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from markupsafe import Markup

from errormotion.errors import DatasetError
from errormotion.report.drawings.turntable import Dots, Lines, Scene, draw, enlargement

LINEAR = ("EX", "EY", "EZ")
PLACES = ("x", "y", "z")
MAX_TARGETS = 2000
"""Number of targets that are drawn."""
ARROW = 0.16
"""Length of the longest arrow, as a fraction of the diagonal of the targets."""
SHADES = ("#7fb0dc", "#2a5599", "#D55E00")
"""Colours by thirds of the longest vector, shortest first."""
FAINT = "#9aa5ad"


@dataclass(frozen=True)
class Drawing:
    """A drawing in space as HTML, its accessible name, and its caption."""

    markup: Markup
    label: str
    caption: str


def has_volume(ds: xr.Dataset) -> bool:
    """Return whether a dataset has displacements at targets with positions."""
    return "target" in ds.em.dims and all(name in ds for name in LINEAR) and all(axis in ds.coords for axis in PLACES)


def drawing(ds: xr.Dataset, point: Sequence[float] | None = None, select: Mapping[str, int] | None = None) -> Drawing:
    """Return the error vectors of a volume at a functional point.

    Parameters
    ----------
    ds : Dataset
        Error dataset over ``target``.
    point : sequence of float, optional
        Another functional point, m.
    select : mapping of str to int, optional
        Index along each further dimension; default 0.

    Raises
    ------
    DatasetError
        The dataset is no volume, an index is beyond its dimension, or no target can be drawn.
    """
    if not has_volume(ds):
        raise DatasetError("a drawing in space needs EX, EY and EZ at targets with x, y and z", code="space.no_targets")
    moved = ds if point is None else ds.em.at(point)
    for dim in moved.em.dims:
        index = 0 if dim == "target" else (select or {}).get(dim, 0)
        if not 0 <= index < moved.sizes[dim]:
            raise DatasetError(
                f"{dim}: expected an index from 0 to {moved.sizes[dim] - 1}; found {index}",
                code="request.index.outside",
            )
        moved = moved if dim == "target" else moved.isel({dim: index})
    places = np.stack([np.asarray(moved[axis].values, dtype=float) for axis in PLACES], axis=-1)
    vectors = np.stack([np.asarray(moved[name].values, dtype=float) for name in LINEAR], axis=-1)
    expanded = moved.em.expanded(k=2).sel(dof=list(LINEAR)).transpose("target", "dof").values
    known = np.flatnonzero(np.isfinite(places).all(axis=-1) & np.isfinite(vectors).all(axis=-1))
    if not known.size:
        raise DatasetError("no target has a known position and known errors", code="space.no_errors")
    picked = known[np.unique(np.linspace(0, known.size - 1, min(known.size, MAX_TARGETS)).astype(int))]
    lengths = np.linalg.norm(vectors[picked], axis=-1)
    longest = float(lengths.max())
    diagonal = float(np.linalg.norm(np.ptp(places[picked], axis=0)))
    factor = enlargement(longest, ARROW * diagonal)
    names = [str(each) for each in moved["target"].values] if "target" in moved.coords else []
    notes = []
    for i in picked:
        rows = [
            f"{name} {1e6 * v:.2f} µm, U {1e6 * u:.2f}"
            for name, v, u in zip(LINEAR, vectors[i], expanded[i], strict=True)
        ]
        notes.append("\n".join([names[i][:40] if names else f"target {i + 1}", *rows]))
    ends = np.stack([places[picked], places[picked] + factor * vectors[picked]], axis=1)
    third = np.minimum(3 * lengths / longest, 2.999).astype(int) if longest else np.zeros(picked.size, dtype=int)
    parts: list[Lines | Dots] = [_box(places[picked]), Dots(places[picked], FAINT, 1.2, notes=notes)]
    parts += [Lines(ends[third == k], colour, 1.0, 3.2) for k, colour in enumerate(SHADES) if (third == k).any()]
    fewer = f" {picked.size} of {known.size} targets are drawn." if picked.size < known.size else ""
    unknown = f" {len(places) - known.size} targets are unknown." if known.size < len(places) else ""
    caption = (
        f"Error vectors, enlarged {factor} times; the longest is {1e6 * longest:.2f} µm. Pale: up to a third of it, "
        f"dark: up to two thirds, red: above.{fewer}{unknown} Drag or use the arrow keys to rotate, Ctrl and the wheel "
        "to zoom; move the pointer to a target for its errors with U (k = 2)."
    )
    label = f"Error vectors of {picked.size} targets in space; the longest is {1e6 * longest:.2f} µm"
    return Drawing(Markup(draw(Scene(list(parts)), "space")), label, caption)


def _box(places: np.ndarray) -> Lines:
    """Return the edges of the box around positions."""
    ends = places.min(axis=0), places.max(axis=0)
    corners = np.array([[ends[i >> k & 1][k] for k in range(3)] for i in range(8)])
    edges = [(corners[i], corners[i | 1 << k]) for i in range(8) for k in range(3) if not i >> k & 1]
    return Lines(np.array(edges), FAINT, 0.6)
