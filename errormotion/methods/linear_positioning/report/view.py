"""One freedom of a result in the units of the page."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.report.text import SECOND_OF_ARC, UM


@dataclass(frozen=True)
class View:
    """Readings and statistics of one freedom, in µm or arcsec over positions in mm; approach is forward, backward.

    Attributes
    ----------
    name, unit : str
    size : float
        Of the unit, SI.
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
    found = [_view(errors, str(name)) for name in errors["freedom"].values]
    return sorted(found, key=lambda view: not view.along)


def coordinate(errors: xr.Dataset) -> str:
    """Return the name of the coordinate that holds the positions."""
    return next(name for name in "xyz" if name in errors.coords and errors[name].dims == ("position",))


def _view(errors: xr.Dataset, name: str) -> View:
    unit, size = UM if name[1] in "XYZ" else SECOND_OF_ARC
    of = errors.sel(freedom=name)
    figures = [str(figure) for figure in errors["figure"].values]

    def named(part: str) -> dict[str, float]:
        return dict(zip(figures, (of[part].values / size).tolist(), strict=True))

    position = errors[coordinate(errors)].values
    mean = of["unidirectional_mean"].transpose("approach", "position").values
    readings = of["deviations"].transpose("approach", "run", "position").values
    if name[1] in "XYZ" and name[1] != name[2]:
        line = _line(position, mean)
        mean, readings = mean - line, readings - line
    return View(
        name=name,
        unit=unit,
        size=size,
        position=np.asarray(position * 1e3),
        readings=readings / size,
        mean=mean / size,
        s=of["unidirectional_s"].transpose("approach", "position").values / size,
        value=named("figure_value"),
        bias=named("figure_bias"),
        u=named("figure_u"),
    )


def _line(position: Array, mean: Array) -> Array:
    """Return the least-squares line of the mean of the measured approaches, from which a straightness counts."""
    measured = np.isfinite(mean).any(axis=1)
    middle = mean[measured].mean(axis=0)
    known = np.isfinite(middle)
    return np.asarray(np.polyval(np.polyfit(position[known], middle[known], 1), position))
