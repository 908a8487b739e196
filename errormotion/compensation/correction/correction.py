"""The inverse of the errors: what is added to a command so that the tool is where it was meant."""

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
"""Most evaluations of the errors for one correction."""

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
        Of the offset, m^2; None where it was not asked for. NaN where it is not valid, for a component that is left as
        it is, and where too few places were measured for an estimate of the interpolation.
    valid : (n,) of bool
        Whether place, time and temperatures lie within what was measured. Elsewhere the offset is held at its value
        at the edge.
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
        The errors, which add up.
    left : tuple of str
        Displacements that no source knows: these components stay as they are.
    partial : bool
        Whether freedoms that a source does not know are left out.
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
            A rotation that is not known acts at this point; not three finite coordinates.
        """
        point = np.array(functional_point, dtype=float)
        if point.shape != (3,) or not np.isfinite(point).all():
            raise DatasetError(f"functional point: expected three finite coordinates in m; found {functional_point!r}")
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
            s on the clock of the sources; needed where the errors depend on time.
        covariance : bool
            Whether the covariance is computed; it takes longer than the correction.

        Raises
        ------
        DatasetError
            Wrong shapes, no time where it is needed, or errors that change as fast as the commands: they have no
            inverse.
        """
        places, times = _points(positions, time)
        weights = [field.weights(places, times) for field in self.fields]
        offset = -_sum(field.displacement(places, each) for field, each in zip(self.fields, weights, strict=True))
        last = float(np.abs(offset).max(initial=0.0))
        for _ in range(ITERATIONS):
            new = -self._displacement(places + offset, times)
            change = float(np.abs(new - offset).max(initial=0.0))
            offset = new
            if change <= TOLERANCE or change**2 <= TOLERANCE * last:  # the next change would be change**2 / last
                break
            last = change
        else:
            worst = places[int(np.abs(offset).max(axis=1).argmax())]
            raise DatasetError(
                f"The errors change too fast with the place to be inverted: the correction near {worst.tolist()} m "
                f"does not settle (last change {1e6 * change:g} um). Check the errors"
            )
        valid, turn = np.ones(len(places), dtype=bool), np.zeros(places.shape)
        for field, each in zip(self.fields, weights, strict=True):
            valid &= each.inside & (each.of((~field.trained).astype(float)) == 0)
            turn += np.where(field.known[3:], each.of(field.values[:, 3:]), np.nan)
        found = self._covariance(places, times) if covariance else None
        if found is not None:
            found[~valid] = np.nan
        return CorrectionValues(offset, found, valid, turn)

    def _displacement(self, places: Array, time: Array | None) -> Array:
        return _sum(field.displacement(places, field.weights(places, time)) for field in self.fields)

    def _covariance(self, places: Array, time: Array | None) -> Array:
        """Return the covariance of the offset, which is that of the displacement to second order, (n, 3, 3)."""
        found = np.empty((len(places), 3, 3))
        for first in range(0, len(places), _CHUNK):
            part = slice(first, first + _CHUNK)
            at, when = places[part], None if time is None else time[part]
            total = np.zeros((len(at), 3, 3))
            shared: dict[str, Array] = {}
            for number, field in enumerate(self.fields):
                own, effects = field.spread(at, field.weights(at, when), when)
                total += own
                for k, effect in enumerate(effects):  # one draw in several fields: its effects add up
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
        Error datasets over position, target or time, or time and a place; thermal models. The errors of several
        sources add up: state each error once.
    functional_point : (3,), optional
        Point of the tool that is to be where it was commanded, m, in the coordinates in which the source states its
        own; default: that of each source. For an axis and for the volume: where it is with all axes at zero.
    data : Dataset, optional
        Temperatures and working parameters over time for the thermal models; see `ThermalModel.predict`.
    chain : str, optional
        Bodies from workpiece to tool, where a dataset does not state them: the travel of the axes behind an axis is a
        lever of its rotations.
    partial : bool
        Leave out the freedoms that a source does not know, instead of refusing: an axis of which the positioning alone
        was measured.

    Returns
    -------
    Correction

    Raises
    ------
    DatasetError
        No source; a source that cannot be used; a freedom that is needed and not known; no data for a model.
    """
    sources = [source] if isinstance(source, (xr.Dataset, ThermalModel)) else list(source)
    if not sources:
        raise DatasetError("Expected an error dataset or a thermal model; found none")
    fields, notes = [], []
    for number, each in enumerate(sources, start=1):
        name = _name(each, number if len(sources) > 1 else 0)
        if isinstance(each, ThermalModel):
            if data is None:
                raise DatasetError(f"{name}: a thermal model needs the temperatures over time (data, --temperatures)")
            each = each.predict(data)
        field, said = field_of(each, name, chain)
        fields.append(field)
        notes += said
    unknown = tuple(name for k, name in enumerate(DOF[:3]) if not any(field.known[k] for field in fields))
    part = [name for k, name in enumerate(DOF[:3]) if any(not field.known[k] for field in fields)]
    if part and not partial:
        raise DatasetError(
            f"{', '.join(part)}: not known by {'the source' if len(fields) == 1 else 'every source'}. Leave what is "
            "not known as it is (partial, --partial), or take a source that knows it"
        )
    if part:
        notes.append(f"Not known, and left as they are: {', '.join(part)}.")
    for field in fields:
        if missing := _unknown_rotations(field):
            notes.append(f"{field.name}: {_not_known(missing)}; the correction holds on the line of the measurement.")
    if not partial:
        _check_rotations(fields)
    made = Correction(tuple(fields), unknown, partial, tuple(notes))
    return made if functional_point is None else made.for_tool(functional_point)


def _check_rotations(fields: Sequence[Field]) -> None:
    for field in fields:
        if missing := _unknown_rotations(field):
            raise DatasetError(
                f"{field.name}: {_not_known(missing)}, and displace{'s' if len(missing) == 1 else ''} the tool at the "
                f"functional point {np.round(field.point, 6).tolist()} m or along the travel. Use the functional point "
                "of the measurement, or a source that knows the rotations"
            )


def _not_known(names: Sequence[str]) -> str:
    """Return that these are not known: 'EA is not known', 'EA and EB are not known'."""
    listed = " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
    return f"{listed} {'is' if len(names) == 1 else 'are'} not known"


def _unknown_rotations(field: Field) -> list[str]:
    """Return the rotations that displace the tool and are not known."""
    return [name for name in field.needed() if name in DOF[3:] and not field.known[DOF.index(name)]]


def _name(source: xr.Dataset | ThermalModel, number: int) -> str:
    ds = source.dataset if isinstance(source, ThermalModel) else source
    what = "thermal model" if isinstance(source, ThermalModel) else "errors"
    named = f"{what} of {ds.attrs.get('component', 'unknown')}"
    return f"{named} (source {number})" if number else named


def _sum(parts: Iterable[Array]) -> Array:
    return np.asarray(sum(parts))


def _points(positions: ArrayLike, time: ArrayLike | None) -> tuple[Array, Array | None]:
    places = np.asarray(positions, dtype=float)
    if places.ndim != 2 or places.shape[1] != 3 or not np.isfinite(places).all():
        raise DatasetError(f"positions: expected finite coordinates (n, 3) in m; found shape {places.shape}")
    if time is None:
        return places, None
    times = np.asarray(time, dtype=float)
    if times.shape not in ((), (len(places),)) or not np.isfinite(times).all():
        raise DatasetError(f"time: expected a finite number or ({len(places)},) in s; found shape {times.shape}")
    return places, np.broadcast_to(times, (len(places),))
