"""Settings as text: default, unit, quantity."""

from __future__ import annotations

import textwrap
from typing import get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from errormotion.datasets.units import Quantity, format_quantity

_USUAL_UNITS = {
    "m": ("mm", "um", "m"),
    "rad": ("arcsec", "mrad", "deg"),
    "s": ("s", "min", "h", "ms"),
    "Hz": ("Hz", "kHz"),
}
"""Usual units by SI unit; of equally short texts the first one is used."""


def has_default(field: FieldInfo) -> bool:
    """Return whether a setting that is not stated has a value."""
    return not field.is_required() and field.get_default(call_default_factory=True) not in (None, (), [], {})


def default_of(field: FieldInfo) -> str:
    """Return the default of a setting as written in a campaign, with its unit; of a required setting, its kind."""
    quantity = quantity_of(field)
    kind = f" ({quantity.kind})" if quantity is not None else ""
    if field.is_required():
        return f"required{kind}"
    if not has_default(field):
        return f"-{kind}"
    default = field.get_default(call_default_factory=True)
    if isinstance(default, BaseModel):
        default = default.model_dump()
    if quantity is not None and isinstance(default, (int, float)) and not isinstance(default, bool):
        return _written(float(default), quantity)
    if (
        quantity is not None
        and isinstance(default, (tuple, list))
        and all(isinstance(x, (int, float)) for x in default)
    ):
        return textwrap.shorten(", ".join(_written(float(x), quantity) for x in default), 30, placeholder=" ...")
    shown = str(default).lower() if isinstance(default, bool) else str(default)
    return textwrap.shorten(shown, 30, placeholder=" ...")


def _written(value: float, quantity: Quantity) -> str:
    """Return a value in the unit in which its number is shortest."""
    units = _USUAL_UNITS.get(quantity.unit, ())
    texts = [format_quantity(value, unit, 6) for unit in units] if value and units else []
    short = min(texts, key=lambda text: (len(text.split()[0].strip("-")), texts.index(text)), default="")
    unit = {"1/min": "/min"}.get(quantity.unit, quantity.unit)
    return short or f"{value:g} {unit}"


def quantity_of(field: FieldInfo) -> Quantity | None:
    """Return the quantity of a setting, or that of its elements."""
    quantities = [note for note in field.metadata if isinstance(note, Quantity)]
    pending = [field.annotation]
    while pending and not quantities:
        each = pending.pop()
        if isinstance(each, type) and issubclass(each, BaseModel):
            continue
        quantities += [note for note in getattr(each, "__metadata__", ()) if isinstance(note, Quantity)]
        pending += [argument for argument in get_args(each) if argument is not Ellipsis]
    return quantities[0] if quantities else None
