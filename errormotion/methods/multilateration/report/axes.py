"""Errors of the axes: error motions with their uncertainty bands, and squareness."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure as Canvas

from errormotion.kinematics.iso import DOF, iso_names
from errormotion.methods.multilateration.report.view import AXES, scalar
from errormotion.report import canvas
from errormotion.report.document import Block, Cell, Figure, Table, Text, estimate
from errormotion.report.text import ARCSEC, UM, fixed, listed

_SECOND = ("arcsec", ARCSEC)


def motions(axis: str) -> list[str]:
    """Return the names of the six error motions of an axis."""
    names = iso_names(axis)
    return [names[dof] for dof in DOF]


def _curve(errors: xr.Dataset, name: str, axis: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, str] | None:
    """Return positions, values and standard uncertainties (SI), and the reason if they are not determined."""
    dim = f"{axis}_position"
    if name not in errors or errors[name].dims != (dim,) or dim not in errors.coords:
        return None
    q, value = (np.asarray(errors[key].values, float) for key in (dim, name))
    u = f"{name}_u"
    sigma = (
        np.asarray(errors[u].values, float) if u in errors and errors[u].dims == (dim,) else np.full(q.shape, np.nan)
    )
    return q, value, sigma, str(errors[name].attrs.get("unseen", ""))


def blocks(errors: xr.Dataset, key: str) -> list[Block]:
    """Return curves and squareness, or a sentence if the result contains neither."""
    curves = {name: _curve(errors, name, axis) for axis in AXES for name in motions(axis)}
    known = {name: found for name, found in curves.items() if found is not None}
    square = _squareness(errors)
    if not known and square is None:
        return [Text("The errors of the axes were not estimated; the remarks state the reason if it is known.", "note")]
    found: list[Block] = []
    if known:
        found.append(_figure(curves, key))
    if square is not None:
        found.append(square)
    undetermined = [f"{name}: {c[3]}" for name, c in known.items() if c[3]]
    if undetermined:
        reasons = "; ".join(undetermined)
        found.append(Text(f"Not determined by these targets: {reasons}. Unknown, not zero.", "warning"))
    sigma0 = scalar(errors, "axes_sigma0")
    if np.isfinite(sigma0):
        found.append(
            Text(
                f"The residuals of the targets' errors after the errors of the axes are {fixed(sigma0, 2)} times their "
                "uncertainty; with about 1, the errors of the axes explain those of the targets.",
                "plain" if sigma0 < 1.5 else "warning",
            )
        )
    return found


def _figure(curves: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray, str] | None], key: str) -> Figure:
    drawn: list[str] = []

    def paint(figure: Canvas) -> None:
        panels = figure.subplots(6, 3, sharex="col")
        figure.subplots_adjust(left=0.085, right=0.985, top=0.965, bottom=0.06, wspace=0.27, hspace=0.42)
        for column, axis in enumerate(AXES):
            for row, name in enumerate(motions(axis)):
                axes = panels[row, column]
                unit, size = UM if row < 3 else _SECOND
                axes.set_title(name)
                if column == 0:
                    axes.set_ylabel(unit)
                curve = curves[name]
                if curve is None or not np.isfinite(curve[1]).any():
                    axes.text(
                        0.5, 0.5, "not determined", transform=axes.transAxes, ha="center", va="center", color="#555555"
                    )
                    axes.set_yticks([])
                    continue
                q, value, sigma, _ = curve
                axes.axhline(0, color="#999999", linewidth=0.5)
                canvas.curve(axes, 1e3 * q, value / size, 2 * sigma / size, colour=canvas.COLOURS[column])
            panels[-1, column].set_xlabel(f"{axis} / mm")

    for name, curve in curves.items():
        if curve is not None and np.isfinite(curve[1]).any():
            drawn.append(name)
    caption = (
        f"Error motions of the axes (top three rows in {UM[0]}, others in arcsec), with expanded uncertainty, k = 2. "
        "Each has a mean of zero, and straightness has no slope: these are rigid motions of the volume, or squareness."
    )
    return Figure(canvas.draw(paint, key, 7.6), caption, f"Error motions determined: {listed(drawn) or 'none'}.")


def _squareness(errors: xr.Dataset) -> Table | None:
    found = [str(name) for name, v in errors.data_vars.items() if str(name)[2:3] == "0" and v.ndim == 0]
    rows: list[list[Cell | str]] = []
    for name in sorted(name for name in found if len(name) == 4):
        value, sigma = scalar(errors, name), scalar(errors, f"{name}_u")
        reason = str(errors[name].attrs.get("unseen", "")) or "not determined"
        rows.append([name, estimate(value / ARCSEC, 2 * sigma / ARCSEC, reason=reason)])
    if not rows:
        return None
    return Table("Squareness of the axes' mean lines, with expanded uncertainty, k = 2.", ["error", "arcsec"], rows)
