"""Artefacts for a line profiler: pieces of a known shape on the table of the virtual machine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import spline_filter

from errormotion.arrays import Array
from errormotion.errors import BenchError
from errormotion.twin.artefacts import surfaces

Surface = Callable[[Array, Array], ArrayLike]

#: Distance of the knots of a free form, m, and their number beyond the outline; effects of the ends decrease by a
#: factor of 0.27 for each knot.
KNOTS = 0.1e-3
MARGIN = 20

_NO_TABLE = np.zeros((4, 4))


@dataclass(frozen=True)
class Artefact:
    """A piece with a known surface z(x, y): z up, the origin in the middle of its top.

    Attributes
    ----------
    name : str
        For reports.
    shape : int
        Which of the shapes in `errormotion.twin.artefacts.surfaces`.
    parameters : ndarray, (5,)
        Of the shape; half the size in x and y first, m.
    table : ndarray
        Spline coefficients of a free form.
    """

    name: str
    shape: int
    parameters: Array
    table: Array = field(default_factory=lambda: _NO_TABLE, repr=False)

    @property
    def half_size(self) -> tuple[float, float]:
        """Half of its size in x and y, m."""
        return float(self.parameters[0]), float(self.parameters[1])

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Return z at x, y (which broadcast), m; NaN off the artefact."""
        x, y = np.broadcast_arrays(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
        out = np.empty(x.size)
        surfaces.heights(self.shape, self.parameters, self.table, x.ravel(), y.ravel(), out)
        return out.reshape(x.shape)


def freeform(z: Surface, half_size: tuple[float, float] = (22e-3, 30e-3), *, name: str = "free form") -> Artefact:
    """Return an artefact with any smooth surface.

    The surface of the artefact is the bicubic spline through z at knots 0.1 mm apart. It differs from z by the fourth
    derivative times 3e-19 m^4: 10 pm for a wave of 3 mm amplitude and 20 mm length.

    Parameters
    ----------
    z : callable
        Function of arrays x and y of one shape, m, that returns heights, m; also up to 2 mm beyond the outline.
    half_size : (float, float)
        Half of the size in x and y, m.
    name : str
        For reports.

    Raises
    ------
    BenchError
        ``z`` returns another shape or values that are not finite.
    """
    x, y = (KNOTS * np.arange(-(n := round(half / KNOTS) + MARGIN), n + 1) for half in half_size)
    grid = np.meshgrid(x, y, indexing="ij")
    values = np.asarray(z(*grid), dtype=float)
    if values.shape != grid[0].shape or not np.isfinite(values).all():
        raise BenchError(
            f"expected one finite height, m, for each position of the surface; found shape {values.shape} with "
            f"{int(np.sum(~np.isfinite(values)))} values that are not finite, for positions of shape {grid[0].shape}.",
            code="virtual.surface.heights",
        )
    table = np.ascontiguousarray(spline_filter(values, order=3, mode="mirror"))
    return Artefact(name, surfaces.FREEFORM, np.array([*half_size, x[0], y[0], 1 / KNOTS]), table)


@lru_cache(maxsize=4)
def swept(half_size: tuple[float, float] = (22e-3, 30e-3)) -> Artefact:
    """Return a section curve in X-Z, swept along a guide curve in Y-Z: z = f(x) + g(y), slopes up to 0.5.

    The type of surface of Zhao et al., section 3.1, who state no equation.
    """

    def section(x: Array) -> Array:
        return 1.5e-3 * np.sin(2 * np.pi * x / 28e-3 + 0.4) + 0.5e-3 * np.cos(2 * np.pi * x / 17e-3)

    def guide(y: Array) -> Array:
        return 1.8e-3 * np.cos(2 * np.pi * y / 36e-3 - 0.7) + 0.4e-3 * np.sin(2 * np.pi * y / 21e-3)

    return freeform(lambda x, y: section(x) + guide(y), half_size, name="swept free form")


def plane(half_size: tuple[float, float] = (22e-3, 30e-3)) -> Artefact:
    """Return a flat piece."""
    return Artefact("plane", surfaces.PLANE, np.array([*half_size, 0.0, 0.0, 0.0]))


def sphere(radius: float = 25e-3, half_size: tuple[float, float] = (22e-3, 30e-3)) -> Artefact:
    """Return a sphere (radius in m) with its top at the origin."""
    return Artefact("sphere", surfaces.SPHERE, np.array([*half_size, _positive("radius", radius), 0.0, 0.0]))


def circular_pocket(
    radius: float = 12.496e-3,
    depth: float = 5e-3,
    *,
    spot: float = 12e-6,
    half_size: tuple[float, float] = (20e-3, 20e-3),
) -> Artefact:
    """Return a level plate with a circular pocket in its middle.

    Parameters
    ----------
    radius, depth : float
        m. The radius is the one of Zhao et al., section 4.2.
    spot : float
        Standard deviation of the laser's spot, m: across the rim, the reading is a mean of both levels.
    half_size : (float, float)
        Half of the size of the plate in x and y, m.
    """
    values = (_positive("radius", radius), _positive("depth", depth), _positive("spot", spot))
    return Artefact("circular pocket", surfaces.POCKET, np.array([*half_size, *values]))


def _positive(what: str, value: float) -> float:
    if not value > 0:
        raise BenchError(
            f"expected the {what} of an artefact as a positive length in m; found {value!r}.",
            code="virtual.artefact.length",
        )
    return float(value)
