"""What is assumed because neither data nor settings state it: a note for each assumption.

Assumed uncertainties contribute to those of the result; nothing that is assumed changes a value.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from errormotion.methods.multilateration.settings import ASSUMED_SCALE

if TYPE_CHECKING:
    import xarray as xr

    from errormotion.methods.multilateration.settings import Air, Expansion, Settings


def assumptions(raw: xr.Dataset, settings: Settings) -> list[str]:
    """Return a note on each quantity that is assumed."""
    notes = []
    if settings.scale_uncertainty is None:
        notes.append(
            "Assumed, because it is not stated: an uncertainty of the tracker's lengths of "
            f"{1e6 * ASSUMED_SCALE:g} um/m (scale_uncertainty). It contributes to the uncertainties only."
        )
    notes += _of_air(settings.air)
    if settings.expansion is None:
        notes.append(
            "The errors are those at the temperature of the measurement: the expansion of the scales is not stated "
            "(expansion)."
        )
    else:
        notes += _of_scales(settings.expansion)
    if "reflector" not in raw:
        notes.append(
            "Assumed, because it is not stated: with all axes at zero the reflector is at zero (reflector). The errors "
            "of the axes depend on it; those of the targets do not."
        )
    of_data = raw.attrs.get("chain")
    if settings.parametric and settings.chain and of_data and settings.chain != of_data:
        notes.append(f"The data state the chain {of_data}; the setting {settings.chain} is used.")
    return notes


def _of_air(air: Air) -> list[str]:
    sizes = {
        "temperature_uncertainty": f"{air.temperature_uncertainty:g} K of its temperature",
        "pressure_uncertainty": f"{air.pressure_uncertainty:g} Pa of its pressure",
        "humidity_uncertainty": f"{air.humidity_uncertainty:g} % of its humidity",
    }
    unstated = [name for name in sizes if name not in air.model_fields_set]
    if not unstated:
        return []
    what, where = ", ".join(sizes[name] for name in unstated), ", ".join(f"air.{name}" for name in unstated)
    return [
        f"Assumed, because it is not stated: an uncertainty of the air of {what} ({where}). "
        "It contributes to the uncertainties only."
    ]


def _of_scales(expansion: Expansion) -> list[str]:
    notes = []
    if "coefficient_uncertainty" not in expansion.model_fields_set:
        notes.append(
            "Assumed, because it is not stated: an uncertainty of the coefficient of expansion of the scales of "
            f"{1e6 * expansion.coefficient_uncertainty:g} um/m/K (expansion.coefficient_uncertainty)."
        )
    if "temperature_uncertainty" not in expansion.model_fields_set:
        notes.append(
            "Assumed, because it is not stated: an uncertainty of the temperature of the scales of "
            f"{expansion.temperature_uncertainty:g} K (expansion.temperature_uncertainty)."
        )
    return notes
