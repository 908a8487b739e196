"""Plausible readings and errors: what a wrong unit, a wrong column or an instrument that hangs looks like.

Readings without a stated unit are taken as SI. In millimetres they are 1000 times too large, and errors of some
micrometres become some millimetres, with all uncertainties in proportion: nothing contradicts them but the knowledge
of what machine tools do. `ERRORS` states it once, for the errors of every method, and `NOISE` for the scatter of
readings. Both are wider than anything that is known of machine tools; what is outside is a note that doubts the
uncertainty, and no refusal, since a machine may be in such a state.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence

import numpy as np
import xarray as xr

from errormotion.datasets.schemas import DOF, ERROR_UNITS, RawSchema, Row
from errormotion.estimation.checks.frozen import frozen

__all__ = ["ERRORS", "NOISE", "of_noise", "of_raw", "of_result", "readings_of", "with_doubts"]

ERRORS = {"m": (10e-9, 0.5e-3), "rad": (10e-9, 2e-3)}
"""By unit: the largest error of a result is plausible between these sizes; see also `OF_TRAVEL`."""
OF_TRAVEL = (1e-7, 0.5e-3)
"""Errors over positions: plausible sizes of the largest one over the range of the positions."""
NOISE = {"m": 50e-6, "rad": 50e-6}
"""Largest plausible standard deviation of a reading."""
USUAL = (0.3e-6, 100e-6)
"""Largest error of most machine tools, m or rad; a unit that leads there is the probable one."""
UNITS = {
    "m": (("mm", 1e-3), ("um", 1e-6), ("inch", 0.0254)),
    "rad": (("mrad", 1e-3), ("deg", np.pi / 180), ("arcsec", np.pi / 648000), ("urad", 1e-6)),
}
FEWEST = 5
"""Errors that are not all small by accident."""
PREFIXES = ((1e3, "m"), (1e6, "u"), (1e9, "n"))
LARGEST = 1_000_000
"""Number of readings above which a variable is not examined: surfaces, whose points are not readings in time."""


def of_result(errors: xr.Dataset) -> list[str]:
    """Return why the size of the errors of a dataset is implausible; no sentence if it is not, or of beams.

    Where lengths are implausible, angles that follow from the same readings are not mentioned.
    """
    if "beam" in errors.dims:  # their position relative to a nominal one
        return []
    if "deviation" in errors:
        value, variance = errors["deviation"], errors["deviation_variance"].values
        size, u = np.abs(value.values).reshape(-1, 1), np.sqrt(variance).reshape(-1, 1)
        names, units, dims = ["deviation"], ["m"], value.dims
    else:
        names, units, dims = list(DOF), list(ERROR_UNITS), errors[DOF[0]].dims
        size = np.abs(np.stack([errors[name].values for name in names], axis=-1)).reshape(-1, 6)
        u = np.sqrt(np.diagonal(errors["covariance"].values, axis1=-2, axis2=-1)).reshape(-1, 6)
    notes, extent = list[str](), _extent(errors, dims)
    for unit, (low, high) in ERRORS.items():
        columns = [k for k, each in enumerate(units) if each == unit and np.isfinite(size[:, k]).any()]
        if not columns or notes:
            continue
        its, place = size[:, columns], int(np.nanargmax(size[:, columns]))
        largest, name = float(its.flat[place]), names[columns[place % len(columns)]]
        if unit == "m":
            low, high = (max(pair) for pair in zip((low, high), np.multiply(OF_TRAVEL, extent), strict=True))
        what = f"The largest error, {name} = {_shown(largest, unit)}, is"
        if largest > high:
            notes.append(
                f"{what} more than machine tools have (up to {_shown(high, unit)} here){_probably(largest, unit)}. "
                "Check the unit of the readings."
            )
        # errors at rest may be as small as they like, but not smaller than it is known how small they are
        still = set(dims) <= {"time"} or np.isfinite(its).sum() < FEWEST
        if largest > 0 and (np.nanmax(its + 2.0 * u[:, columns]) if still else largest) < low:
            notes.append(
                f"{what} less than machine tools have ({_shown(low, unit)} or more). Check the unit of the readings."
            )
    return notes


def _extent(errors: xr.Dataset, dims: Sequence[Hashable]) -> float:
    """Return the distance over which errors are stated, m, by the coordinates of their places; 0 for none."""
    ranges = [
        float(np.ptp(variable.values))
        for name, variable in errors.variables.items()
        if (name in errors.coords or name == "distance")
        and variable.attrs.get("units") == "m"
        and variable.ndim > 0
        and set(variable.dims) <= set(dims)
    ]
    return float(np.linalg.norm(ranges))


def of_noise(sd: float, unit: str, what: str) -> str:
    """Return why the standard deviation of readings is implausible; "" if it is not."""
    limit = NOISE.get(unit)
    if limit is None or not sd > limit:
        return ""
    return (
        f"{what[:1].upper()}{what[1:]} scatter by {_shown(sd, unit)}, more than instruments on machine tools do (up to "
        f"{_shown(limit, unit)}){_probably(sd, unit)}. Check their unit."
    )


def with_doubts(errors: xr.Dataset, doubts: Sequence[str]) -> xr.Dataset:
    """Return an error dataset with further notes that doubt its uncertainties; those that it has are not repeated."""
    stated = [note for note in np.atleast_1d(errors.attrs.get("doubts_uncertainty", [])).tolist() if note]
    notes = [note for note in np.atleast_1d(errors.attrs.get("notes", [])).tolist() if note]
    more = [note for note in doubts if note and note not in stated]
    if not more:
        return errors
    return errors.assign_attrs(notes=[*notes, *more], doubts_uncertainty=[*stated, *more])


def readings_of(table: RawSchema) -> Row | None:
    """Return the row of the readings of a raw schema: the first one that is required, and may have missing values."""
    rows = (row for row in table.rows if row.required and row.missing and row.dims and row.unit in ("m", "rad", ""))
    return next(rows, None)


def of_raw(raw: xr.Dataset, table: RawSchema) -> list[str]:
    """Return a sentence on readings that do not change, along any of their dims."""
    row = readings_of(table)
    if row is None or row.name not in raw.variables or raw.variables[row.name].size > LARGEST:
        return []
    variable = raw.variables[row.name]
    return [next(_frozen(raw, variable, row.name), "")] if variable.dtype.kind in "fiu" else []


def _frozen(raw: xr.Dataset, variable: xr.Variable, name: str) -> Iterator[str]:
    vector = ("direction",) if "direction" in variable.dims else ()
    others = [dim for dim in variable.dims if dim not in vector]
    for dim in sorted(others, key=lambda each: -variable.sizes[each]):
        rest = [each for each in others if each != dim]
        y = variable.transpose(*rest, dim, *vector).values.astype(float)
        shape = [variable.sizes[each] for each in rest]
        run = frozen(y.reshape(-1, variable.sizes[dim], *y.shape[len(rest) + 1 :]))
        if run is None:
            continue
        if run.every:
            yield f"{name}: all readings are equal. An instrument that hangs, or a wrong column?"
            return
        at = np.unravel_index(run.series, shape) if shape else ()
        where = [f"{each} {_label(raw, each, int(i))}" for each, i in zip(rest, at, strict=True)]
        first, last = (_label(raw, dim, run.first + k) for k in (0, run.count - 1))
        where.append(f"{dim} {first} to {last}")
        yield (
            f"{name}: {run.count} successive readings are equal ({', '.join(where)}), which their scatter excludes. "
            "An instrument that hangs, or a gap that was filled? Remove them, or measure again."
        )
        return


def _label(raw: xr.Dataset, dim: Hashable, i: int) -> str:
    """Return a text label, or the number of an index from 1 on."""
    if dim in raw.coords and raw[dim].dtype.kind in "UO":
        return str(raw[dim].values[i])
    return str(i + 1)


def _shown(value: float, unit: str) -> str:
    factor, prefix = next((each for each in PREFIXES if value * each[0] >= 0.1), PREFIXES[-1])
    return f"{value * factor:.3g} {prefix}{unit}"


def _probably(value: float, unit: str) -> str:
    """Return the unit in which readings would lead to usual errors."""
    likely = [name for name, factor in UNITS[unit] if USUAL[0] <= value * factor <= USUAL[1]]
    return f": the readings are probably in {likely[0]}, and were taken as {unit}" if likely else ""
