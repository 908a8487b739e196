"""Certificates of artefacts and instruments, by which sources of uncertainty are the same draw in two measurements."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from errormotion.errors import DatasetError

ATTRIBUTE = "certificates"
"""Attribute of raw data: JSON object of certified items and their certificates."""

ITEMS = {
    "bar": "the bar in the spindle: radius, roundness",
    "check_bar": "the check bar of a beam",
    "sphere": "the sphere of a beam detection",
    "balls": "the balls on the table: positions, diameters",
    "frame": "the measuring frame: coefficient of expansion",
    "sensor": "the point sensor: gain",
    "probe": "the touch probe",
    "tracker": "the tracker or interferometer: wavelength, scale",
    "scales": "the scales of the axes: coefficient of expansion",
    "thermometer": "the thermometer of the air",
    "scale_thermometer": "the thermometer of the scales",
    "barometer": "the barometer",
    "hygrometer": "the hygrometer",
}
"""Items that can have a certificate."""
LONGEST = 200
"""Largest number of characters of the number or hash of a certificate."""


def certificates_of(attrs: Mapping[Any, Any]) -> dict[str, str]:
    """Return the certificates that the attributes of a dataset state, by item.

    Raises
    ------
    DatasetError
        The attribute is not a JSON object of known items and texts.
    """
    stated = attrs.get(ATTRIBUTE)
    if stated is None:
        return {}
    try:
        certificates = json.loads(stated)
    except (TypeError, ValueError, RecursionError):
        certificates = None
    if not isinstance(certificates, dict) or wrong(certificates):
        raise DatasetError(
            f"attribute '{ATTRIBUTE}': expected a JSON object with texts of up to {LONGEST} characters for "
            f"{', '.join(ITEMS)}; found {str(stated)[:80]!r}",
            code="certificate.form",
        )
    return certificates


def wrong(certificates: Mapping[Any, Any]) -> list[str]:
    """Return the keys of entries that are not an item with a certificate."""
    return [
        str(item)
        for item, text in certificates.items()
        if item not in ITEMS or not isinstance(text, str) or not 0 < len(text.strip()) <= LONGEST
    ]


def certified(attrs: Mapping[Any, Any], sources: Mapping[str, tuple[str, str]]) -> dict[str, str]:
    """Return the identities of sources by name, for ``source_ids`` of `errormotion.datasets.build_errors`.

    Parameters
    ----------
    attrs : mapping
        Attributes of the raw dataset.
    sources : mapping of str to tuple of str
        Item and certified quantity of each source, such as ``{"bar radius": ("bar", "radius")}``.

    Returns
    -------
    dict of str to str
        Only of sources whose item has a certificate. Measurements with the same certificate share the draw.
    """
    stated = certificates_of(attrs)
    return {
        name: f"certificate {stated[item].strip()}: {item.replace('_', ' ')}, {quantity}"
        for name, (item, quantity) in sources.items()
        if item in stated
    }
