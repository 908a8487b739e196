"""Quantities of a dataset in field units: variables, freedoms and figures of merit, with their uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import xarray as xr

from errormotion.datasets.schemas import DOF
from errormotion.report.text import ARCSEC, SECOND_OF_ARC, UM

UNITS: dict[str, tuple[str, float]] = {
    "m": ("m", 1.0),
    "mm": ("mm", 1e-3),
    "um": UM,
    "nm": ("nm", 1e-9),
    "rad": ("rad", 1.0),
    "deg": ("°", 3600 * ARCSEC),
    "arcsec": SECOND_OF_ARC,
    "mrad": ("mrad", 1e-3),
    "urad": ("µrad", 1e-6),
    "s": ("s", 1.0),
    "min": ("min", 60.0),
    "%": ("%", 1e-2),
    "um/m": ("µm/m", 1e-6),
    "degC": ("°C", 1.0),
    "K": ("K", 1.0),
    "1": ("", 1.0),
}
"""Units of a part by their name: text on the page, and size in SI."""

FIELD = {"m": "um", "rad": "arcsec"}
"""Unit of a quantity on the page by its SI unit, if the part states none."""

Own = Callable[[xr.Dataset], xr.DataArray | None]
"""A quantity that is computed from the dataset; None if it is not part of it."""


@dataclass(frozen=True)
class Quantity:
    """Values and standard uncertainties over the same dims, SI, with their unit on the page.

    Attributes
    ----------
    values : DataArray
    u : DataArray or None
        None if no uncertainty is stated.
    of : str
        Name of the variable or freedom.
    name : str
        On the page: that of ISO 230-1 for a freedom.
    unit : str
        As on the page; empty for numbers.
    size : float
        Of this unit, SI.
    """

    values: xr.DataArray
    u: xr.DataArray | None
    of: str
    name: str
    unit: str
    size: float

    @property
    def known(self) -> np.ndarray:
        """Which values are known."""
        known: np.ndarray = np.isfinite(self.values.values.astype(float))
        return known


def unit_of(si: str, wanted: str = "") -> tuple[str, float]:
    """Return text and size of the unit on the page of a quantity in this SI unit; ``wanted`` is a key of `UNITS`.

    Raises
    ------
    ValueError
        ``wanted`` is unknown.
    """
    name = wanted or FIELD.get(si, si)
    if name in UNITS:
        return UNITS[name]
    if wanted:
        raise ValueError(f"unit: expected one of {', '.join(UNITS)}; found '{wanted}'")
    return name, 1.0


@dataclass(frozen=True)
class Of:
    """A quantity of a dataset, as a part states it.

    Attributes
    ----------
    variable : str or callable
        A freedom (``EX``, ``deviation``), a variable, or a function of the dataset that returns a `DataArray`, or None.
    uncertainty : str or callable
        Variable of the standard uncertainties, or of a covariance whose last dim has the suffix ``_``. By default that
        of the errors for a freedom, else the variable of the same name with ``_u``, ``_uncertainty`` or
        ``_covariance``. ``none`` for none.
    unit : str
        A key of `UNITS`; by default the field unit: um, arcsec.
    select : mapping
        Labels along dims that are selected, such as ``{"dof": "EX"}``; then the quantity has name and unit of this
        freedom.
    """

    variable: str | Own
    uncertainty: str | Own = ""
    unit: str = ""
    select: Mapping[str, object] = field(default_factory=dict)

    def read(self, ds: xr.Dataset) -> Quantity | None:
        """Return the quantity; None if the dataset does not contain it."""
        freedom = isinstance(self.variable, str) and self.variable in (*DOF, "deviation")
        values = self._found(ds, self.variable)
        if values is None:
            return None
        own = str(self.select.get("dof", ""))
        names = ds.em.iso_names() if freedom or own else {}
        name = self.variable if isinstance(self.variable, str) else str(values.name)
        u = None
        if self.uncertainty != "none":
            u = self._spread(ds, values, name, freedom=freedom and not self.uncertainty)
        si = str(values.attrs.get("units", "1")) if not own else "m" if own in DOF[:3] else "rad"
        shown = names.get(own or name, name.replace("_", " "))
        return Quantity(
            self.picked(values), None if u is None else self.picked(u), name, shown, *unit_of(si, self.unit)
        )

    def picked(self, values: xr.DataArray) -> xr.DataArray:
        """Return the selected part of values."""
        mine = {dim: label for dim, label in self.select.items() if dim in values.dims}
        return values.sel(mine) if mine else values

    @staticmethod
    def _found(ds: xr.Dataset, of: str | Own) -> xr.DataArray | None:
        if callable(of):
            return of(ds)
        return ds[of] if of in ds.variables else None

    def _spread(self, ds: xr.Dataset, values: xr.DataArray, name: str, *, freedom: bool) -> xr.DataArray | None:
        """Return the standard uncertainties over the dims of the values; None if none is stated."""
        if freedom:
            u: xr.DataArray = ds.em.expanded(1.0).sel(dof=name, drop=True)
            return u
        tried: Sequence[str | Own] = [self.uncertainty] if self.uncertainty else [
            f"{name}{end}" for end in ("_u", "_uncertainty", "_covariance")
        ]  # fmt: skip
        for each in tried:
            found = self._found(ds, each)
            if found is None:
                continue
            twins = [dim for dim in found.dims if str(dim).endswith("_") and str(dim)[:-1] in found.dims]
            for twin in twins:
                own = str(twin)[:-1]
                others = [dim for dim in found.dims if dim not in (own, twin)]
                variance = np.diagonal(found.transpose(*others, own, twin).values, axis1=-2, axis2=-1)
                found = xr.DataArray(np.sqrt(np.where(variance >= 0, variance, np.nan)), dims=(*others, own))
            if set(found.dims) == set(values.dims):
                spread = found.transpose(*values.dims)
                return spread.assign_coords({dim: values[dim] for dim in values.dims if dim in values.coords})
        return None


def spans(quantity: Quantity) -> tuple[float, float]:
    """Return the lowest and the highest known value on the page; NaN if none is known."""
    values = np.asarray(quantity.values.values, dtype=float) / quantity.size
    known = values[np.isfinite(values)]
    return (float(known.min()), float(known.max())) if known.size else (np.nan, np.nan)
