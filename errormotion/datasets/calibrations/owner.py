"""Assignment of a calibration to its sensor, by serial number and mid-range."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from errormotion.errors import DatasetError

ATTRIBUTE = "serial_number"
"""Attribute of a dataset with the serial number of the sensor that was calibrated, or that measured."""
UNKNOWN = "unknown"
"""Serial number of a sensor that reports none."""
MID_RANGE_TOLERANCE = 1e-6
"""Largest difference of two mid-ranges that count as equal, m."""


def serial_number(attrs: Mapping[str, Any], kind: str) -> str:
    """Return the serial number of the instrument of a kind that made a dataset, from its attributes; empty if unknown.

    It is the attribute ``serial_number``, or else that of the only instrument of this kind in the attribute
    ``instruments`` or in the provenance.
    """
    if stated := known(str(attrs.get(ATTRIBUTE, ""))):
        return stated
    records = json.loads(attrs["instruments"]) if "instruments" in attrs else []
    records = records or json.loads(attrs.get("provenance", "{}")).get("instruments", [])
    numbers = {
        known(str((record.get("identity") or {}).get("serial_number", "")))
        for record in records
        if isinstance(record, dict) and record.get("kind") == kind
    }
    return numbers.pop() if len(numbers) == 1 else ""


def known(serial: str) -> str:
    """Return a serial number; empty if the text states that there is none."""
    text = serial.strip()
    return "" if text.lower() == UNKNOWN or text.lower().startswith("not ") else text


def compare(
    calibration: str,
    calibrated: str,
    used: str,
    *,
    mid_ranges: tuple[float, float] | None = None,
    allow_other_sensor: bool = False,
) -> list[str]:
    """Return notes on the use of a calibration with a sensor; refuse sensors other than the calibrated one.

    Parameters
    ----------
    calibration : str
        Its name, for messages.
    calibrated, used : str
        Serial numbers of the calibrated sensor and of the one that measures; empty if unknown.
    mid_ranges : (float, float), optional
        Mid-range of the calibrated sensor and of the one that measures, m.
    allow_other_sensor : bool
        State another sensor in a note instead of refusing it.

    Raises
    ------
    DatasetError
        The serial numbers or the mid-ranges differ.
    """
    differences = []
    if calibrated and used and calibrated != used:
        differences.append(f"it belongs to the sensor with serial number {calibrated}; the sensor in use has {used}")
    if mid_ranges is not None and abs(mid_ranges[0] - mid_ranges[1]) > MID_RANGE_TOLERANCE:
        low, high = (f"{1e3 * value:g} mm" for value in mid_ranges)
        differences.append(
            f"its mid-range is {low}; that of the sensor in use (serial number {used or UNKNOWN}, calibrated: "
            f"{calibrated or UNKNOWN}) is {high}"
        )
    if differences and not allow_other_sensor:
        raise DatasetError(
            f"Calibration '{calibration}': {'; '.join(differences)}. Use the calibration of this sensor, or set "
            "allow_other_sensor = true.",
            code="calibration.sensor.other",
        )
    notes = [
        f"Calibration '{calibration}' of another sensor is used (allow_other_sensor): {each}." for each in differences
    ]
    if not calibrated:
        notes.append(
            f"Calibration '{calibration}' states no serial number: it was not checked that it belongs to this sensor."
        )
    elif not used:
        notes.append(
            f"The sensor reports no serial number: it was not checked that calibration '{calibration}' of the sensor "
            f"{calibrated} belongs to it."
        )
    return notes
