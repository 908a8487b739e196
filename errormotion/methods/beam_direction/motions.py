"""Steps of the stage in a calibration, as far as they are known before the faces are found.

The search extends from ``search`` before the start position to the same distance after it. The strokes on a face lie
about the position that is found by the search: the steps contain them at both ends of the search.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.beam_direction.planning import design
from errormotion.plugins import Step

if TYPE_CHECKING:
    from errormotion.methods.beam_direction.settings import BeamDirectionSettings

SEARCH_MARGIN = 0.6
"""Distance of a face beyond the search, as a share of the range: half of the range, and the move for the sign."""


def steps(settings: BeamDirectionSettings, instruments: Mapping[str, Any] | None = None) -> list[Step]:
    """Return the steps of the stage, rapid moves; positions that depend on readings are replaced by their limits.

    Raises
    ------
    MethodError
        The settings do not state the start of the search.
    """
    low, high = settings.layout.reading_range
    stated = getattr((instruments or {}).get("point_lds"), "measuring_range", None)
    length = float(stated) if isinstance(stated, float) else high - low
    beam = np.array(settings.layout.nominal_direction, np.float64)
    forward = (beam / np.linalg.norm(beam)) * (1.0 if settings.moves == "sensor" else -1.0)
    unknown = 0.0 if settings.layout.start is not None else length / 2  # of the mid-range
    start = search_start(settings, sum(settings.layout.reading_range) / 2)
    normals = design.plane_normals(np.array([(face.inclination, face.rotation) for face in settings.planes]))
    reach = settings.layout.search + unknown
    result: list[Step] = []
    for normal in normals:
        path = stage_path(settings, normal, length)
        for position in _face(start, forward, reach, reach + SEARCH_MARGIN * length, path):
            x, y, z = (float(each) for each in position)
            result.append(Step("move", (x, y, z), math.nan, math.nan))
    return result


def search_start(settings: BeamDirectionSettings, middle: float) -> Array:
    """Return the start position of the search for a face, m; ``middle`` (m) is the reading at mid-range.

    Raises
    ------
    MethodError
        The settings state none.
    """
    p = settings.layout
    if p.start is not None:
        return np.array(p.start, np.float64)
    if p.pivot is None or p.nominal_origin is None:
        raise MethodError(
            "The start position of the search is unknown: expected layout.start (a position of the stage), or both "
            "layout.pivot and layout.nominal_origin; found neither.",
            code="beam.search.start_unknown",
        )
    u = np.array(p.nominal_direction, np.float64)
    sign = 1.0 if settings.moves == "sensor" else -1.0
    return np.asarray(sign * (np.array(p.pivot) - np.array(p.nominal_origin) - middle * u / np.linalg.norm(u)))


def stage_path(settings: BeamDirectionSettings, normal: Array, length: float) -> Array:
    """Return the stage positions (n, 3) on a face about its middle, m; ``length`` (m) is that of the sensor's range."""
    p = settings.layout
    if p.path:
        return np.array(p.path, np.float64)
    if p.strokes == "longest":
        lengths = design.longest_strokes(normal[None], design.limits_of(settings, length))[0]
    else:
        lengths = np.array(p.strokes, np.float64)
    counts = np.full(3, p.readings // 3)
    counts[: p.readings % 3] += 1
    return design.stroke_points(lengths, counts)


def _face(start: Array, forward: Array, search: float, middle: float, path: Array) -> Iterator[Array]:
    yield start - search * forward
    yield start + search * forward
    for end in (-middle, middle):
        yield from start + end * forward + path
