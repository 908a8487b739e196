"""The inverse of the errors: the translation added to a command so that the tool reaches the commanded position."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.compensation.correction.field import Field, field_of
from errormotion.compensation.thermal_model import ThermalModel
from errormotion.datasets.schemas import DOF
from errormotion.errors import DatasetError

TOLERANCE = 1e-10
"""Change of the offset at which the iteration ends, m."""

ITERATIONS = 60
"""Maximum number of evaluations of the errors for one correction."""

_CHUNK = 2000
"""Points whose covariance is computed at a time."""


@dataclass(frozen=True)
class CorrectionValues:
    """The correction at n points.

    Attributes
    ----------
    offset : (n, 3)
        Translation that is added to the commands of X, Y, Z, m.
    covariance : (n, 3, 3) or None
        Of the offset, m^2; None if it was not requested. NaN where the offset is not valid, for a component without
        correction, and where too few positions were measured to estimate the uncertainty of the interpolation.
    valid : (n,) of bool
        Whether position, time and temperatures lie within the measured range. Elsewhere the offset is that at the
        limit of the range.
    residual_rotation : (n, 3)
        Rotation of the tool that remains, EA, EB, EC, rad; NaN = unknown.
    """

    offset: Array
    covariance: Array | None
    valid: NDArray[np.bool_]
    residual_rotation: Array


@dataclass(frozen=True)
class Correction:
    """Corrections of commands; made by `correction`.

    Attributes
    ----------
    fields : tuple of Field
        The errors, which are added.
    left : tuple of str
        Displacements without known errors: these components are not corrected.
    partial : bool
        Whether unknown freedoms of a source are omitted.
    notes : tuple of str
        Sentences for the reader.
    """

    fields: tuple[Field, ...]
    left: tuple[str, ...] = ()
    partial: bool = False
    notes: tuple[str, ...] = ()

    @property
    def timed(self) -> bool:
        """Whether the errors depend on time."""
        return any(field.instants is not None for field in self.fields)

    def for_tool(self, functional_point: ArrayLike) -> Correction:
        """Return the correction for another functional point, (3,), m.

        Raises
        ------
        DatasetError
            An unknown rotation displaces this point; not three finite coordinates.
        """
        point = np.array(functional_point, dtype=float)
        if point.shape != (3,) or not np.isfinite(point).all():
            raise DatasetError(
                f"functional point: expected three finite coordinates in m; found {functional_point!r}",
                code="errors.point.form",
            )
        fields = tuple(field.for_tool(point) for field in self.fields)
        if not self.partial:
            _check_rotations(fields)
        return replace(self, fields=fields)

    def at(self, positions: ArrayLike, time: ArrayLike | None = None, *, covariance: bool = False) -> CorrectionValues:
        """Return the corrections of commands.

        Parameters
        ----------
        positions : (n, 3)
            Commanded X, Y, Z in machine coordinates, m.
        time : float or (n,), optional
            s on the clock of the sources; required if the errors depend on time.
        covariance : bool
            Whether the covariance is computed; it takes longer than the correction.

        Raises
        ------
        DatasetError
            Wrong shapes, a missing time, or errors that change as fast as the commands: they have no inverse.
        """
        positions, times = _points(positions, time)
        weights = [field.weights(positions, times) for field in self.fields]
        offset = -_sum(field.displacement(positions, each) for field, each in zip(self.fields, weights, strict=True))
        last = float(np.abs(offset).max(initial=0.0))
        for _ in range(ITERATIONS):
            new = -self._displacement(positions + offset, times)
            change = float(np.abs(new - offset).max(initial=0.0))
            offset = new
            if change <= TOLERANCE or change**2 <= TOLERANCE * last:  # the next change would be change**2 / last
                break
            last = change
        else:
            worst = positions[int(np.abs(offset).max(axis=1).argmax())]
            raise DatasetError(
                f"The errors change too fast with the position to be inverted: the correction near {worst.tolist()} "
                f"m does not converge (last change {1e6 * change:g} um). Check the errors",
                code="correction.not_invertible",
            )
        valid, turn = np.ones(len(positions), dtype=bool), np.zeros(positions.shape)
        for field, each in zip(self.fields, weights, strict=True):
            valid &= each.inside & (each.of((~field.trained).astype(float)) == 0)
            turn += np.where(field.known[3:], each.of(field.values[:, 3:]), np.nan)
        found = self._covariance(positions, times) if covariance else None
        if found is not None:
            found[~valid] = np.nan
        return CorrectionValues(offset, found, valid, turn)

    def _displacement(self, positions: Array, time: Array | None) -> Array:
        return _sum(field.displacement(positions, field.weights(positions, time)) for field in self.fields)

    def _covariance(self, positions: Array, time: Array | None) -> Array:
        """Return the covariance of the offset, which is that of the displacement to second order, (n, 3, 3)."""
        found = np.empty((len(positions), 3, 3))
        for first in range(0, len(positions), _CHUNK):
            part = slice(first, first + _CHUNK)
            at, when = positions[part], None if time is None else time[part]
            total = np.zeros((len(at), 3, 3))
            shared: dict[str, Array] = {}
            for number, field in enumerate(self.fields):
                own, effects = field.spread(at, field.weights(at, when), when)
                total += own
                for k, effect in enumerate(effects):  # fully correlated between fields: its effects add up
                    key = field.identity[k] or f"{number} {k}"
                    shared[key] = shared[key] + effect if key in shared else effect
            if shared:
                F = np.array(list(shared.values()))
                total += np.einsum("sni,snj->nij", F, F, optimize=True)
            found[part] = total
        for name in self.left:
            found[:, DOF.index(name)] = found[:, :, DOF.index(name)] = np.nan
        return found


def correction(
    source: xr.Dataset | ThermalModel | Sequence[xr.Dataset | ThermalModel],
    functional_point: ArrayLike | None = None,
    *,
    data: xr.Dataset | None = None,
    chain: str = "",
    partial: bool = False,
) -> Correction:
    """Return the correction of the errors of one source, or of the sum of several.

    Parameters
    ----------
    source : Dataset, ThermalModel or sequence of these
        Error datasets over position, target or time, or time and one of these; thermal models. The errors of several
        sources are added: state each error once.
    functional_point : (3,), optional
        Point of the tool that is corrected, m, in the coordinates in which the source states its own; default: that of
        each source. For an axis and for the volume: its position with all axes at zero.
    data : Dataset, optional
        Temperatures and working parameters over time for the thermal models; see `ThermalModel.predict`.
    chain : str, optional
        Bodies from workpiece to tool if a dataset does not state them: the travel of the axes behind an axis is a
        lever of its rotations.
    partial : bool
        Omit unknown freedoms of a source instead of raising an error, for example if only the positioning of an axis
        was measured.

    Returns
    -------
    Correction

    Raises
    ------
    DatasetError
        No source; a source that cannot be used; an unknown freedom that is required; no data for a model.
    """
    sources = [source] if isinstance(source, (xr.Dataset, ThermalModel)) else list(source)
    if not sources:
        raise DatasetError("Expected an error dataset or a thermal model; found none", code="correction.no_source")
    fields: list[Field] = []
    notes: list[str] = []
    for number, each in enumerate(sources, start=1):
        name = _name(each, number if len(sources) > 1 else 0)
        if isinstance(each, ThermalModel):
            if data is None:
                raise DatasetError(
                    f"{name}: a thermal model needs the temperatures over time (data, --temperatures)",
                    code="correction.temperatures.missing",
                )
            each = each.predict(data)
        field, remarks = field_of(each, name, chain)
        fields.append(field)
        notes += remarks
    unknown = tuple(name for k, name in enumerate(DOF[:3]) if not any(field.known[k] for field in fields))
    part = [name for k, name in enumerate(DOF[:3]) if any(not field.known[k] for field in fields)]
    if part and not partial:
        raise DatasetError(
            f"{', '.join(part)}: unknown in {'the source' if len(fields) == 1 else 'at least one source'}. Use a "
            "source that states them, or omit unknown freedoms (partial, --partial)",
            code="correction.freedoms.unknown",
        )
    if part:
        notes.append(f"Unknown, and not corrected: {', '.join(part)}.")
    for field in fields:
        if missing := _unknown_rotations(field):
            notes.append(f"{field.name}: {_unknown(missing)}; the correction is valid on the line of the measurement.")
    if not partial:
        _check_rotations(fields)
    made = Correction(tuple(fields), unknown, partial, tuple(notes))
    return made if functional_point is None else made.for_tool(functional_point)


def _check_rotations(fields: Sequence[Field]) -> None:
    for field in fields:
        if missing := _unknown_rotations(field):
            raise DatasetError(
                f"{field.name}: {_unknown(missing)} and displace{'s' if len(missing) == 1 else ''} the tool at the "
                f"functional point {np.round(field.point, 6).tolist()} m or along the travel. Use the functional point "
                "of the measurement, or a source that states the rotations",
                code="correction.rotations.unknown",
            )


def _unknown(names: Sequence[str]) -> str:
    """Return 'EA is unknown', 'EA and EB are unknown'."""
    listed = " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
    return f"{listed} {'is' if len(names) == 1 else 'are'} unknown"


def _unknown_rotations(field: Field) -> list[str]:
    """Return the unknown rotations that displace the tool."""
    return [name for name in field.needed() if name in DOF[3:] and not field.known[DOF.index(name)]]


def _name(source: xr.Dataset | ThermalModel, number: int) -> str:
    ds = source.dataset if isinstance(source, ThermalModel) else source
    what = "thermal model" if isinstance(source, ThermalModel) else "errors"
    named = f"{what} of {ds.attrs.get('component', 'unknown')}"
    return f"{named} (source {number})" if number else named


def _sum(parts: Iterable[Array]) -> Array:
    return np.asarray(sum(parts))


def _points(positions: ArrayLike, time: ArrayLike | None) -> tuple[Array, Array | None]:
    positions = np.asarray(positions, dtype=float)
    if positions.ndim != 2 or positions.shape[1] != 3 or not np.isfinite(positions).all():
        raise DatasetError(
            f"positions: expected finite coordinates (n, 3) in m; found shape {positions.shape}",
            code="correction.positions.shape",
        )
    if time is None:
        return positions, None
    times = np.asarray(time, dtype=float)
    if times.shape not in ((), (len(positions),)) or not np.isfinite(times).all():
        raise DatasetError(
            f"time: expected a finite number or ({len(positions)},) in s; found shape {times.shape}",
            code="correction.time.shape",
        )
    return positions, np.broadcast_to(times, (len(positions),))
