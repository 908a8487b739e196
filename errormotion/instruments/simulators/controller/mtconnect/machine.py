"""Readings of the virtual machine by a controller, by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

from errormotion.instruments.simulators.virtual_world.clock import EPOCH

UNAVAILABLE = "UNAVAILABLE"
SERIES_RATE = 100.0
"""Rate of the values of one observation with several values, Hz."""
SERIES_LENGTH = 10
_MM, _PERCENT = 1e3, 1e2
_MODES = {"automatic": "AUTOMATIC", "mdi": "MANUAL_DATA_INPUT", "manual": "MANUAL", "": UNAVAILABLE}


@dataclass(frozen=True)
class Condition:
    """A condition.

    Attributes
    ----------
    level : str
        ``Normal``, ``Warning``, ``Fault`` or ``Unavailable``.
    code, severity, qualifier, text : str
        Details from the controller; empty: not given.
    """

    level: str
    code: str = ""
    severity: str = ""
    qualifier: str = ""
    text: str = ""


@dataclass(frozen=True)
class Series:
    """Several values of one observation, evenly spaced; the last one belongs to the time of the observation."""

    values: tuple[str, ...]
    rate: float = SERIES_RATE


Row = Mapping[str, str]
Value = str | Condition | Series | Mapping[str, str] | Mapping[str, Row]


def clock_text(seconds: float) -> str:
    """Return a time of the world, s, in the format of agents and adapters."""
    return (EPOCH + timedelta(seconds=seconds)).isoformat(timespec="microseconds").replace("+00:00", "Z")


def readings(state: Mapping[str, Any], offset: tuple[float, float, float], alarm: str = "") -> dict[str, Value]:
    """Return the readings of a controller.

    Parameters
    ----------
    state : mapping
        State that the controller of the world displays.
    offset : tuple of float
        Work offset, m: position in work coordinates = position in machine coordinates - offset.
    alarm : str
        A further alarm; empty: none.

    Returns
    -------
    dict
        Values in the units of MTConnect: mm, mm/s, 1/min, %.
    """
    alarms = [*state["alarms"], *([alarm] if alarm else [])]
    mm = {name: [position * _MM for position in state[f"{name}position"]] for name in ("", "commanded_")}
    work = [actual - shift * _MM for actual, shift in zip(mm[""], offset, strict=True)]
    values: dict[str, Value] = {
        "avail": "AVAILABLE",
        "estop": "TRIGGERED" if state["estop"] else "ARMED",
        "system": Condition("Fault", "1104", text="; ".join(alarms)) if alarms else Condition("Normal"),
        "normal": Condition("Normal"),
        "mode": _MODES[state["mode"]],
        "execution": "ACTIVE" if state["running"] or state["stepping"] else "READY",
        "program": state["program"] or UNAVAILABLE,
        "feed": f"{state['feed'] * _MM:.4f}",
        "rpm": f"{state['spindle_speed']:.1f}",
        "rpm.commanded": f"{state['commanded_spindle_speed']:.1f}",
        "spindle.load": f"{state['spindle_load'] * _PERCENT:.2f}",
        "path.work": _vector(work),
        "path.machine": _vector(mm[""]),
        "offset": _vector([shift * _MM for shift in offset]),
        "offsets": {"G54": {name: f"{shift * _MM:.4f}" for name, shift in zip("XYZ", offset, strict=True)}},
        "variables": {"v100": f"{state['spindle_speed']:.1f}", "v101": f"{state['feed'] * _MM:.4f}"},
    }
    for i, name in enumerate("XYZ"):
        values[f"{name}.machine"] = f"{mm[''][i]:.4f}"
        values[f"{name}.work"] = f"{work[i]:.4f}"
        values[f"{name}.commanded"] = f"{mm['commanded_'][i]:.4f}"
        values[f"{name}.series"] = Series((f"{mm[''][i]:.4f}",) * SERIES_LENGTH)
    return values


def reading(values: Mapping[str, Value], source: str) -> Value:
    """Return the value of one data item: a reading, a constant (``=text``), or unavailable (empty source)."""
    if source.startswith("="):
        return source[1:]
    return values[source] if source else UNAVAILABLE


def _vector(parts: list[float]) -> str:
    return " ".join(f"{part:.4f}" for part in parts)
