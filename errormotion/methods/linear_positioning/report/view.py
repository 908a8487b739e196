"""One freedom or diagonal of a result in the units of the report."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.report.text import SECOND_OF_ARC, UM


@dataclass(frozen=True)
class View:
    """Readings and statistics of one freedom or diagonal, in µm or arcsec over positions in mm.

    Approaches are forward, backward.

    Attributes
    ----------
    name, unit : str
    size : float
        The unit in SI.
    position : ndarray, (target,)
    readings : ndarray, (approach, run, target)
    mean, s : ndarray, (approach, target)
    value, bias, u : mapping of str to float
        Figures.
    """

    name: str
    unit: str
    size: float
    position: Array
    readings: Array
    mean: Array
    s: Array
    value: dict[str, float]
    bias: dict[str, float]
    u: dict[str, float]

    @property
    def along(self) -> bool:
        """Whether this is the positioning."""
        return self.name[1] == self.name[2]

    @property
    def straight(self) -> bool:
        """Whether this is a straightness."""
        return self.name[1] in "XYZ" and not self.along

    def expanded(self, figure: str) -> float:
        """Return the expanded uncertainty of a figure as the standard defines it."""
        return 2.0 * self.u[figure] + abs(self.bias[figure])


def views(errors: xr.Dataset) -> list[View]:
    """Return every measured freedom, the positioning first."""
    return sorted((_view(errors, str(name)) for name in errors["freedom"].values), key=lambda view: not view.along)


def coordinate(errors: xr.Dataset) -> str:
    """Return the name of the coordinate of the positions."""
    return next(name for name in "xyz" if name in errors.coords and errors[name].dims == ("position",))


def _view(errors: xr.Dataset, name: str) -> View:
    position = errors[coordinate(errors)].values
    straight = name[1] in "XYZ" and name[1] != name[2]
    unit = UM if name[1] in "XYZ" else SECOND_OF_ARC
    return _build(name, errors.sel(freedom=name), "position", position, unit, straight=straight)


def diagonal_view(errors: xr.Dataset, name: str) -> View:
    """Return one diagonal."""
    selected = errors.sel(diagonal=name)
    return _build(name, selected, "target", selected["distance"].values, UM, straight=False)


def _build(
    name: str, selected: xr.Dataset, dim: str, position: Array, unit: tuple[str, float], *, straight: bool
) -> View:
    symbol, size = unit
    figures = [str(figure) for figure in selected["figure"].values]

    def named(variable: str) -> dict[str, float]:
        return dict(zip(figures, (selected[variable].values / size).tolist(), strict=True))

    mean = selected["unidirectional_mean"].transpose("approach", dim).values
    readings = selected["deviations"].transpose("approach", "run", dim).values
    if straight:
        line = _line(position, mean)
        mean, readings = mean - line, readings - line
    return View(
        name=name,
        unit=symbol,
        size=size,
        position=np.asarray(position * 1e3),
        readings=readings / size,
        mean=mean / size,
        s=selected["unidirectional_s"].transpose("approach", dim).values / size,
        value=named("figure_value"),
        bias=named("figure_bias"),
        u=named("figure_u"),
    )


def _line(position: Array, mean: Array) -> Array:
    """Return the least-squares line of the mean of the measured approaches, the reference of a straightness."""
    measured = np.isfinite(mean).any(axis=1)
    middle = mean[measured].mean(axis=0)
    known = np.isfinite(middle)
    return np.asarray(np.polyval(np.polyfit(position[known], middle[known], 1), position))
