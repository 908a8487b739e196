"""The state of a machine from the last observation of each data item."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from errormotion.errors import ProtocolError
from errormotion.instruments.controller.mtconnect.choice import TIME_SERIES
from errormotion.instruments.controller.mtconnect.codec import UNAVAILABLE, DataItem, Document, Observation

_MODES = {"AUTOMATIC": "automatic", "SEMI_AUTOMATIC": "automatic", "MANUAL": "manual", "MANUAL_DATA_INPUT": "mdi"}
_NUMBERS = ("spindle_speed", "spindle_load", "feed")
_POSITIONS = ("position", "commanded_position")
_TEXTS = ("mode", "program", "execution", "estop", "availability")


def machine_state(document: Document, items: Mapping[str, DataItem], start: float) -> dict[str, Any]:
    """Return the state of a machine; see `MTConnect.state`.

    Parameters
    ----------
    document : Document
        Answer to /current.
    items : mapping of str to DataItem
        Data items by quantity.
    start : float
        Time of the zero of the state's clock, s since 1970.

    A value that is not a number, such as ``1,5`` or ``NaN``, is unknown, and ``reasons`` states it.
    """
    last = {each.item: each for each in document.observations if not each.level}
    values = {key: last.get(item.id) for key, item in items.items()}
    reasons: dict[str, str] = {}
    position, moved = _position("position", values, items, reasons)
    text = {key: _text(values.get(key)) for key in _TEXTS}
    state: dict[str, Any] = {
        "time": document.header.created - start,
        "position": position,
        "commanded_position": _position("commanded_position", values, items, reasons)[0],
        "position_time": moved - start,
        **{key: _number(key, values, items, reasons) for key in _NUMBERS},
        "mode": _MODES.get(text["mode"], ""),
        "program": text["program"],
        "running": text["execution"] == "ACTIVE",
        "homed": None,
        "enabled": text["availability"] == "AVAILABLE" and text["estop"] != "TRIGGERED",
        "estop": text["estop"] == "TRIGGERED",
        "alarms": _conditions(document, "Fault"),
        "warnings": _conditions(document, "Warning"),
    }
    state["unavailable"] = [
        *(key for key in _POSITIONS if any(math.isnan(x) for x in state[key])),
        *(key for key in _NUMBERS if math.isnan(state[key])),
        *(key for key, value in text.items() if not value),
    ]
    state["reasons"] = reasons
    return state


def _number(
    key: str, values: Mapping[str, Observation | None], items: Mapping[str, DataItem], reasons: dict[str, str]
) -> float:
    """Return a quantity in SI; for a time series its last value. What is no number is NaN, with the reason."""
    observation, item = values.get(key), items.get(key)
    if observation is None or item is None:
        return math.nan
    if item.representation == TIME_SERIES:
        return _words(key, observation, item, reasons)[-1]
    found = _words(key, observation, item, reasons)
    if len(found) > 1:
        reasons[key] = f"expected one number; found '{observation.value[:40]}'"
        return math.nan
    return found[0]


def _words(key: str, observation: Observation, item: DataItem, reasons: dict[str, str]) -> list[float]:
    """Return the numbers of an observation in SI, each NaN where it is none; at least one."""
    words = []
    for word in observation.value.split() or [UNAVAILABLE]:
        try:
            words.append(replace(observation, value=word).number(item.scale))
        except ProtocolError as error:
            reasons[key] = str(error)
            words.append(math.nan)
    return words


def _position(
    key: str, values: Mapping[str, Observation | None], items: Mapping[str, DataItem], reasons: dict[str, str]
) -> tuple[list[float], float]:
    """Return X, Y, Z in m, and the time of their last change, s since 1970."""
    keys = [f"{key}.{axis}" for axis in "XYZ"]
    if key in items and (whole := values.get(key)) is not None:
        found = _words(key, whole, items[key], reasons)
        return (found[:3] if len(found) >= 3 else [math.nan] * 3), whole.time
    times = [each.time for each in (values.get(name) for name in keys) if each is not None]
    return [_number(name, values, items, reasons) for name in keys], max(times, default=math.nan)


def _text(observation: Observation | None) -> str:
    if observation is None or observation.value.upper() == UNAVAILABLE:
        return ""
    return observation.value


def _conditions(document: Document, level: str) -> list[str]:
    """Return the texts of the conditions of a level, such as ``SYSTEM 1104: overtravel``."""
    return [
        f"{' '.join(filter(None, (each.type, each.code)))}: {each.value}".rstrip(": ")
        for each in document.observations
        if each.level == level
    ]
