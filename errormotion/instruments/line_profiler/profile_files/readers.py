"""Reading of scans as height maps in m: point clouds (PLY and PCD by Open3D, XYZ), CSV, NetCDF."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from errormotion.datasets.files.reading import require_regular
from errormotion.datasets.units import convert
from errormotion.errors import DatasetError, InstrumentError
from errormotion.instruments.line_profiler.profile_files.settings import ProfileFileSettings
from errormotion.plugins.readings import Scan

Array = np.ndarray[Any, Any]

MAX_HEIGHT = 0.5  # m; a larger one indicates a wrong unit
_FAR = 10.0
"""Distance of a number from all heights, in ranges of these, from which it is taken for no value."""
_NINES = re.compile(r"-?9{3,}(?:\.9*)?|-?9{2,}\.9{2,}|-?32768")
FULL = 0.25
"""Smallest fraction of the cells of a height map that a point cloud must fill."""


def read_scan(path: Path, settings: ProfileFileSettings) -> Scan:
    """Return the scan in a file.

    Raises
    ------
    InstrumentError
        Unknown format, file not readable or incomplete, no unit, no height map, heights of more than half a metre, or
        profiles that are not in order along the feed.
    """
    suffix = path.suffix.lower()
    if suffix not in READERS:
        raise InstrumentError(
            f"{path}: expected a file of one of {', '.join(sorted(READERS))}", code="scans.file.ending"
        )
    if not path.is_file():
        raise InstrumentError(f"{path}: file not found", code="scans.not_found")
    heights, x, y = READERS[suffix](path, settings)
    if not np.isfinite(heights).any():
        raise InstrumentError(
            f"{path}: expected heights; found none. Check that the file is complete", code="scans.no_heights"
        )
    highest = float(np.nanmax(np.abs(heights)))
    if highest > MAX_HEIGHT:
        raise InstrumentError(
            f"{path}: found a height of {highest:.4g} m; check its unit '{settings.unit or 'm'}'",
            code="scans.unit.implausible",
        )
    for name, positions in (("y", y), ("x", x)):
        steps = np.diff(positions)
        if not (np.isfinite(positions).all() and ((steps > 0).all() or (steps < 0).all())):
            raise InstrumentError(
                f"{path}: {name} is not monotonic: expected profiles and points in order; split the file where the "
                "feed reverses",
                code="scans.order",
            )
    return Scan(path, np.ascontiguousarray(heights), x, y)


def _unit(path: Path, settings: ProfileFileSettings) -> str:
    if settings.unit is None:
        raise InstrumentError(
            f"{path} has no unit of lengths: set 'unit' to m, mm, um or inch", code="scans.unit.missing"
        )
    return settings.unit


def _with_nan(values: Array, settings: ProfileFileSettings, path: Path) -> Array:
    """Return heights with NaN for no value, in the unit of the file; files of 32 bits have the nearest such number.

    Raises
    ------
    InstrumentError
        A number that instruments write for no value stands far from all heights, and the settings do not state it.
    """
    if settings.no_value is not None:
        with np.errstate(over="ignore"):
            stated = (settings.no_value, float(np.float32(settings.no_value)))
        return np.where(np.isin(values, stated), np.nan, values)
    known = np.unique(values[np.isfinite(values)])
    for extreme, rest in ((known[:1], known[1:]), (known[-1:], known[:-1])):
        # Such a number lies outside of the heights by many times their range, and repeats or has only nines.
        with np.errstate(over="ignore"):
            if rest.size < 2:
                continue
            near = np.abs(extreme - rest).min() < _FAR * np.ptp(rest)
            number = float(np.float32(extreme[0]))
        if near:
            continue
        if (values == extreme[0]).sum() > 1 or _NINES.fullmatch(f"{number:.7g}"):
            raise InstrumentError(
                f"{path}: {number:.7g} is far from all other heights; if it stands for no value, set 'no_value'",
                code="scans.no_value",
            )
    return values


def _read_csv(path: Path, settings: ProfileFileSettings) -> tuple[Array, Array, Array]:
    """Read rows of heights, one for each profile; an empty cell is a missing height. Lines with # are comments."""
    unit = _unit(path, settings)
    if settings.x_pitch is None or settings.y_pitch is None:
        raise InstrumentError(
            f"{path} only has heights: set 'x_pitch' and 'y_pitch', the distances of its columns and rows",
            code="scans.pitch.missing",
        )
    heights = _in_metres(_with_nan(_csv_rows(path, settings.delimiter), settings, path), unit)
    n, points = heights.shape
    return heights, settings.x_pitch * np.arange(points), settings.y_pitch * np.arange(n)


def _csv_rows(path: Path, delimiter: str) -> Array:
    """Return the cells of a CSV file, (row, column); NaN where empty. A trailing delimiter adds no column."""
    rows: list[list[float]] = []
    lines: list[tuple[int, bool]] = []  # number of the line, and whether it ends with a delimiter
    number = 0
    try:
        require_regular(path)
        with path.open(encoding="utf-8-sig") as file:
            for number, line in enumerate(file, 1):
                if not line.strip() or line.startswith("#"):
                    continue
                cells = [cell.strip() for cell in line.strip("\r\n").split(delimiter)]
                rows.append([float(cell) if cell else np.nan for cell in cells])
                lines.append((number, len(cells) > 1 and not cells[-1]))
    except UnicodeDecodeError as error:
        raise InstrumentError(
            f"{path}, after line {number}: byte {error.object[error.start]:#x} is not UTF-8", code="scans.encoding"
        ) from None
    except ValueError as error:
        raise InstrumentError(f"{path}, line {number}: {error}", code="scans.line.form") from None
    except OSError as error:
        raise InstrumentError(f"{path} cannot be read: {error.strerror}", code="scans.file.unreadable") from None
    if not rows:
        raise InstrumentError(f"{path}: expected heights; found none", code="scans.no_heights")
    longest = max(map(len, rows))
    if all(ended for row, (_, ended) in zip(rows, lines, strict=True) if len(row) == longest):
        rows = [row[: longest - 1] for row in rows]
    for row, (number, _) in zip(rows, lines, strict=True):
        if len(row) != len(rows[0]):
            raise InstrumentError(
                f"{path}, line {number}: expected {len(rows[0])} cells as in the lines before; found {len(row)}",
                code="scans.line.cells",
            )
    return np.array(rows)


def _read_netcdf(path: Path, settings: ProfileFileSettings) -> tuple[Array, Array, Array]:
    """Read ``height(profile, point)``, ``x(point)`` and ``y(profile)``, each with its attribute ``units``."""
    import xarray as xr

    from errormotion.datasets.files.containers import check_netcdf
    from errormotion.datasets.storage.disk import reading

    try:
        with reading(path):
            check_netcdf(path)
            dataset = xr.load_dataset(path, engine="h5netcdf", decode_times=False, decode_timedelta=False)
    except DatasetError as error:
        raise InstrumentError(
            f"{path} cannot be read as NetCDF: {error.__cause__ or error}", code="scans.file.unreadable"
        ) from None
    found = []
    for name, dims in (("height", ("profile", "point")), ("x", ("point",)), ("y", ("profile",))):
        if name not in dataset.variables or set(dataset[name].dims) != set(dims):
            raise InstrumentError(
                f"{path}: expected a variable {name}({', '.join(dims)})", code="scans.variable.missing"
            )
        variable = dataset[name].transpose(*dims)
        unit = str(variable.attrs.get("units", ""))
        if not unit:
            raise InstrumentError(f"{path}: the variable {name} has no attribute 'units'", code="scans.unit.missing")
        if variable.dtype.kind not in "iuf":
            raise InstrumentError(f"{path}: the variable {name} is not numeric", code="scans.variable.type")
        values = np.asarray(variable.values, dtype=np.float64)
        found.append(_in_metres(_with_nan(values, settings, path) if name == "height" else values, unit))
    heights, x, y = found
    return heights, x, y


def _read_cloud(path: Path, settings: ProfileFileSettings) -> tuple[Array, Array, Array]:
    """Read a point cloud whose points lie on lines of equal y, with the same x on each."""
    unit = _unit(path, settings)
    open3d = _open3d(path)
    check_complete(path)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        cloud = open3d.t.io.read_point_cloud(path, remove_nan_points=False, remove_infinite_points=False)
    if "positions" not in cloud.point or not len(cloud.point.positions):
        raise InstrumentError(
            f"{path} cannot be read: Open3D found no points. Check that the file is complete", code="scans.file.damaged"
        )
    points = cloud.point.positions.numpy().astype(np.float64)
    points[:, 2] = _with_nan(points[:, 2], settings, path)
    return height_map(_in_metres(points, unit), path)


def _read_xyz(path: Path, settings: ProfileFileSettings) -> tuple[Array, Array, Array]:
    """Read a point cloud as `_read_cloud`, from a text with a point on each line.

    Open3D cuts a number at a decimal comma, loses the last line if it has no end, or ends the process.
    """
    unit = _unit(path, settings)
    lines = _text(path).splitlines()
    if not any(line.strip() and not line.lstrip().startswith(_COMMENTS) for line in lines):
        raise InstrumentError(f"{path}: expected points; found none", code="scans.no_points")
    try:
        points = np.loadtxt(lines, comments=_COMMENTS, ndmin=2, dtype=np.float64)
    except ValueError:
        points = np.empty((0, 0))
    if points.shape[1:] != (3,):
        raise InstrumentError(f"{path}, {_first_mistake(lines)}", code="scans.line.form")
    points[:, 2] = _with_nan(points[:, 2], settings, path)
    return height_map(_in_metres(points, unit), path)


_COMMENTS = ("#", "//")


def _text(path: Path) -> str:
    """Return a text in UTF-8, or in UTF-16 with a byte order mark."""
    try:
        require_regular(path)
        data = path.read_bytes()
        return data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise InstrumentError(
            f"{path}: expected a text in UTF-8 or UTF-16; {error.reason}", code="scans.encoding"
        ) from None
    except OSError as error:
        raise InstrumentError(f"{path} cannot be read: {error.strerror}", code="scans.file.unreadable") from None


def _first_mistake(lines: Sequence[str]) -> str:
    """Return the place of the first line that is no point, and what was expected."""
    for number, line in enumerate(lines, 1):
        cells = line.partition(_COMMENTS[0])[0].partition(_COMMENTS[1])[0].split()
        if cells and not (len(cells) == 3 and all(map(_is_number, cells))):
            hint = "; a decimal comma is not read: write a point" if "," in line else ""
            return f"line {number}: expected three numbers separated by spaces; found '{line.strip()[:60]}'{hint}"
    return "expected three numbers on each line"


def _is_number(cell: str) -> bool:
    try:
        return "_" not in cell and float(cell) is not None
    except ValueError:
        return False


def _open3d(path: Path) -> Any:
    """Return the package. Its TBB is too old for numba, which is therefore set to prefer other layers."""
    import numba

    numba.config.THREADING_LAYER_PRIORITY = ["omp", "workqueue", "tbb"]  # type: ignore[attr-defined, unused-ignore]
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise InstrumentError(
            f"Reading {path} requires Open3D, which cannot be loaded: {error}", code="scans.reader.missing"
        ) from None
    return open3d


_PLY_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}


def check_complete(path: Path) -> None:
    """Refuse a PLY or PCD file with fewer points than its header states: Open3D would invent the others.

    Raises
    ------
    InstrumentError
        The file is incomplete, or has no header.
    """
    stated, width, text = -1, 0, False
    with path.open("rb") as file:
        for line in file:
            match line.decode("ascii", errors="replace").split():
                case ["format", kind, *_]:
                    text = kind == "ascii"
                case ["element", "vertex", number] | ["POINTS", number] if number.isdigit():
                    stated, width = int(number), 0
                case ["element", *_]:
                    break  # the points come first
                case ["property", kind, _]:
                    width += _PLY_SIZES.get(kind, 0)
                case ["SIZE", *sizes]:
                    width = sum(int(size) for size in sizes if size.isdigit())
                case ["end_header"]:
                    break
                case ["DATA", kind]:
                    text, width = kind == "ascii", width if kind == "binary" else 0
                    break
        else:
            raise InstrumentError(
                f"{path} cannot be read: its header has no end. Check that the file is complete",
                code="scans.file.damaged",
            )
        lines = stated
        if text:
            lines = _whole_lines(file)
        elif width:
            lines = (path.stat().st_size - file.tell()) // width
    if lines < stated:
        raise InstrumentError(
            f"{path} cannot be read: its header states {stated} points; found {lines}", code="scans.file.damaged"
        )


def _whole_lines(file: Iterable[bytes]) -> int:
    """Count lines with text; the last one only if it has as many cells as the one before it."""
    count, cells, before = 0, 0, 0
    for line in file:
        if found := len(line.split()):
            count, before, cells = count + 1, cells, found
    return count - (count > 1 and cells < before)


def height_map(points: Array, path: Path) -> tuple[Array, Array, Array]:
    """Return points (n, 3) on a grid as heights (n, point), x and y.

    Raises
    ------
    InstrumentError
        The points are not on lines of equal x and equal y, or two have the same position.
    """
    points = points[np.isfinite(points[:, :2]).all(axis=1)]
    if not len(points):
        raise InstrumentError(f"{path} is not a height map: no point has an x and a y", code="scans.no_height_map")
    (x, column), (y, row) = (_lines(points[:, axis]) for axis in (0, 1))
    if x.size * y.size * FULL > len(points):
        raise InstrumentError(
            f"{path} is not a height map: {len(points)} points have {x.size} different x and {y.size} different y; "
            "expected profiles of equal y, with the same x on each",
            code="scans.no_height_map",
        )
    cells = row * x.size + column
    if np.unique(cells).size < cells.size:
        raise InstrumentError(
            f"{path} is not a height map: several points have the same x and y", code="scans.no_height_map"
        )
    heights = np.full(x.size * y.size, np.nan)
    heights[cells] = points[:, 2]
    return heights.reshape(y.size, x.size), x, y


def _lines(positions: Array) -> tuple[Array, Array]:
    """Return the distinct positions, apart from the rounding of the file, and the index of each."""
    order = np.argsort(positions, kind="stable")
    ordered = positions[order]
    tolerance = 0.01 * np.ptp(ordered) / np.sqrt(ordered.size)  # 1 % of the pitch of a square grid
    starts = np.concatenate([[True], np.diff(ordered) > tolerance])
    line = np.empty(positions.size, dtype=np.int64)
    line[order] = np.cumsum(starts) - 1
    first = np.flatnonzero(starts)
    return np.add.reduceat(ordered, first) / np.diff(np.append(first, ordered.size)), line


def _in_metres(values: Array, unit: str) -> Array:
    try:
        return np.asarray(convert(values, unit, "m"))
    except DatasetError as error:
        raise InstrumentError(f"Expected lengths: {error}", code="scans.unit.form") from None


Reader = Callable[[Path, ProfileFileSettings], tuple[Array, Array, Array]]
READERS: Mapping[str, Reader] = {
    ".ply": _read_cloud,
    ".pcd": _read_cloud,
    ".xyz": _read_xyz,
    ".csv": _read_csv,
    ".nc": _read_netcdf,
}
