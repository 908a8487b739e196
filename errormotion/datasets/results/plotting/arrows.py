"""Arrows of displacements and rotations at the targets of a volume."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.colors import LinearSegmentedColormap, Normalize

from errormotion.datasets.results.places import scale_of, short
from errormotion.datasets.results.plotting.scales import UNITS
from errormotion.datasets.units import convert, format_quantity

TRIPLES = (("EX", "EY", "EZ"), ("EA", "EB", "EC"))
"""Freedoms of an arrow."""

LONGEST = 0.18
"""Length of the longest arrow as a fraction of the diagonal of the targets."""

MAX_NAMED = 30
"""Largest number of targets whose names are written."""

_LENGTHS = LinearSegmentedColormap.from_list("lengths", ["#6BAED6", "#0072B2", "#7A3E9D", "#D55E00", "#6B2A00"])


def draw(axes: Any, ds: xr.Dataset, freedoms: tuple[str, ...], unit: str, band: xr.DataArray, k: float) -> None:
    """Draw one arrow for each target in three-dimensional axes; unknown ones are crosses."""
    inside = UNITS[freedoms[0]][0]
    places = np.stack([np.asarray(convert(ds[axis].values, "m", "mm")) for axis in "xyz"], axis=-1)
    vectors = np.stack([np.asarray(convert(ds[name].values, inside, unit)) for name in freedoms], axis=-1)
    known = np.isfinite(vectors).all(axis=-1)
    lengths = np.linalg.norm(vectors[known], axis=-1)
    longest = float(lengths.max()) if lengths.size else 0.0
    diagonal = float(np.linalg.norm(np.ptp(places, axis=0))) or 1.0
    norm = Normalize(0.0, longest or 1.0)
    if longest:
        scaled = vectors[known] * (LONGEST * diagonal / longest)
        colours = _LENGTHS(norm(np.tile(lengths, 3)))  # all shafts, then both halves of all heads
        arrow = axes.quiver(*places[known].T, *scaled.T, colors=colours, linewidth=1.3, arrow_length_ratio=0.25)
        arrow.set_cmap(_LENGTHS)
        arrow.set_norm(norm)
        axes.figure.colorbar(arrow, ax=axes, label=unit, shrink=0.6, pad=0.12)
        tips = places[known] + scaled
        axes.auto_scale_xyz(*np.concatenate([places, tips]).T)
    axes.scatter(*places[known].T, s=6, color="#444444", depthshade=False)
    if not known.all():
        axes.scatter(*places[~known].T, s=24, color="#888888", marker="x", depthshade=False)
    texts = scale_of(ds, ds.em.dims[0]).texts or [str(number) for number in range(1, len(places) + 1)]
    if len(texts) <= MAX_NAMED:
        for place, text in zip(places, texts, strict=True):
            axes.text(*place, f" {short(text)}", fontsize=7, color="#555555", parse_math=False)
    axes.set_xlabel("x / mm")
    axes.set_ylabel("y / mm")
    axes.set_zlabel("z / mm")
    axes.set_box_aspect(None, zoom=0.95)
    axes.set_aspect("equal")
    names = ds.em.iso_names()
    title = f"{', '.join(names[name] for name in freedoms)}: longest arrow {format_quantity_of(longest, unit)}"
    spread = band.sel(dof=list(freedoms)).values[known]
    if k and spread.size and np.isfinite(spread).any():
        title += f", U up to {format_quantity(float(np.nanmax(spread)), unit, 2)} (k = {k:g})"
    if missing := int((~known).sum()):
        title += f", {missing} unknown (crosses)"
    axes.set_title(title, fontsize=9, parse_math=False)


def format_quantity_of(value: float, unit: str) -> str:
    """Return a value in a field unit as text."""
    return f"{value:.3g} {unit}"
