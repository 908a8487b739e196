"""Protocol of the bridge: JSON lines. Pure functions between bytes and values; see `bridge` for the messages."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.plugins import Identity

LINE_END = b"\n"
MAX_LINE = 1 << 16
"""Longest line of the bridge, and of a request, bytes."""
MAX_DIGITS = 300
"""Largest number of digits of a whole number."""
PROTOCOL = 2
PART = 1 << 12
"""Longest part of a program in a request, characters; each has at most twelve bytes."""
MODES = ("manual", "mdi", "automatic", "")


@dataclass(frozen=True)
class Beat:
    """A heartbeat while a command runs."""

    number: int
    time: float


@dataclass(frozen=True)
class Answer:
    """Answer to a request: a result, or the text of a refusal."""

    number: Any
    ok: bool
    result: Any = None
    error: str = ""


@dataclass(frozen=True)
class Offset:
    """Offset of a compensation in LinuxCNC.

    Attributes
    ----------
    route : str
        ``external`` or ``feedback``.
    offset : tuple of float
        Offset of X, Y, Z in effect, m.
    limit, slew, watchdog : float
        Largest offset, m, its largest rate of change, m/s, and the time without a request after which it ramps to zero,
        s.
    busy, fault : str
        Why the offset must not change, and why none is accepted; empty if it may change, or is accepted.
    by : str
        The client that has the right to set it; empty: none.
    """

    route: str
    offset: tuple[float, float, float]
    limit: float
    slew: float
    watchdog: float
    busy: str
    fault: str
    by: str


def encode_request(number: int, op: str, arguments: Mapping[str, Any]) -> bytes:
    """Return a request as bytes; InstrumentError if it is too long, or contains NaN or infinity."""
    try:
        request = json.dumps({"id": number, "op": op, **arguments}, allow_nan=False).encode() + LINE_END
    except ValueError:
        raise InstrumentError(f"Expected finite numbers; found {dict(arguments)}", code="request.not_finite") from None
    if len(request) > MAX_LINE:
        raise InstrumentError(
            f"Expected a request of at most {MAX_LINE} bytes; '{op}' has {len(request)}", code="request.too_long"
        )
    return request


def parts_of(program: str) -> list[str]:
    """Return the parts of a program, each short enough for a request; at least one."""
    return [program[k : k + PART] for k in range(0, len(program), PART)] or [""]


def decode_welcome(result: Any) -> tuple[bool, str]:
    """Return whether the bridge grants control of the machine, and the other client that has it.

    Raises
    ------
    ProtocolError
        Another protocol, or not the answer to a first request.
    """
    try:
        if result["protocol"] != PROTOCOL:
            raise ValueError(f"protocol {result['protocol']}")
        return _switch(result, "control"), str(result["controlled_by"] or "")[:64]
    except (ValueError, KeyError, TypeError) as error:
        raise ProtocolError(
            f"Expected the bridge of LinuxCNC with protocol {PROTOCOL}; found {str(result)[:200]} ({error!r}). Copy "
            "bridge.py of this version to the machine",
            code="protocol.linuxcnc.version",
        ) from None


def decode_identity(facts: Any, simulated: bool, details: Mapping[str, Any], *more: str) -> Identity:
    """Return the identity of a machine, with ``more`` facts in its details; ProtocolError if one is missing."""
    try:
        return Identity(
            manufacturer=str(facts["manufacturer"]),
            model=str(facts["model"]),
            serial_number=str(facts["serial_number"]),
            firmware=str(facts["firmware"]),
            simulated=simulated,
            details={**details, **{name: facts[name] for name in more}},
        )
    except (KeyError, TypeError):
        raise ProtocolError(
            f"Expected the identity of a LinuxCNC; found {str(facts)[:200]}", code="protocol.linuxcnc.form"
        ) from None


def decode_right(result: Any) -> tuple[bool, str]:
    """Return whether the bridge grants the right to set offsets, and the other client that has it."""
    decode_welcome(result)
    try:
        return _switch(result, "compensate"), str(result["compensated_by"] or "")[:64]
    except (ValueError, KeyError, TypeError):
        raise ProtocolError(
            "The bridge is of a version without compensation; copy bridge.py of this version to the machine",
            code="protocol.linuxcnc.version",
        ) from None


def decode_offset(result: Any) -> Offset:
    """Return the offset of a compensation; ProtocolError if a value is missing or not finite."""
    try:
        x, y, z = (_finite(each) for each in result["offset"])
        limit, slew, watchdog = (_known(result, name) for name in ("limit", "slew", "watchdog"))
        busy, fault, route = (str(result[name])[:500] for name in ("busy", "fault", "route"))
        return Offset(route, (x, y, z), limit, slew, watchdog, busy, fault, str(result["by"] or "")[:64])
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise ProtocolError(
            f"Expected the offset of LinuxCNC; found {str(result)[:200]} ({error!r})", code="protocol.linuxcnc.form"
        ) from None


def decode(line: bytes) -> Answer | Beat:
    """Parse a line.

    Raises
    ------
    ProtocolError
        The line is neither an answer nor a heartbeat.
    """
    try:
        message = json.loads(line, parse_int=_whole)
        if "beat" in message:
            return Beat(message["id"], float(message["time"]))
        if message["ok"] is True:
            return Answer(message["id"], True, message["result"])
        if message["ok"] is False:
            return Answer(message["id"], False, error=str(message["error"]))
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        pass
    raise ProtocolError(
        f"Expected an answer of the bridge in JSON; found {line[:200]!r}", code="protocol.linuxcnc.form"
    )


def decode_state(result: Any) -> dict[str, Any]:
    """Return a state whose unknown numbers are NaN.

    Raises
    ------
    ProtocolError
        A value is missing or has the wrong type.
    """
    try:
        state = dict(result)
        if state["mode"] not in MODES:
            raise ValueError(f"mode {state['mode']!r}")
        return {
            "time": _known(state, "time"),
            "position": _position(state["position"]),
            "commanded_position": _position(state["commanded_position"]),
            "spindle_speed": _number(state["spindle_speed"]),
            "spindle_load": _number(state["spindle_load"]),
            "feed": _number(state["feed"]),
            "mode": state["mode"],
            "program": str(state["program"]),
            "running": _switch(state, "running"),
            "homed": _switch(state, "homed"),
            "enabled": _switch(state, "enabled"),
            "estop": _switch(state, "estop"),
            "alarms": [str(text) for text in state["alarms"]],
        }
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise ProtocolError(
            f"Expected the state of LinuxCNC; found {str(result)[:200]} ({error!r})", code="protocol.linuxcnc.form"
        ) from None


def decode_touch(result: Any) -> dict[str, Any]:
    """Return ``tripped``, ``position`` (m, or None) and ``time`` of a touch; ProtocolError if they are missing."""
    try:
        tripped = _switch(result, "tripped")
        position = _position(result["position"]) if tripped else None
        if position is not None and not all(math.isfinite(x) for x in position):
            raise ValueError("a touch at an unknown position")
        return {"tripped": tripped, "position": position, "time": _known(result, "time")}
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise ProtocolError(
            f"Expected the result of a touch; found {str(result)[:200]} ({error!r})", code="protocol.linuxcnc.form"
        ) from None


def _whole(text: str) -> int:
    """Return a whole number; ValueError beyond the range of a float."""
    if len(text) > MAX_DIGITS:
        raise ValueError(f"a whole number of {len(text)} digits")
    return int(text)


def _number(value: Any) -> float:
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r} is not a number")
    return float(value)


def _known(values: Mapping[str, Any], name: str) -> float:
    try:
        return _finite(values[name])
    except ValueError as error:
        raise ValueError(f"{name} is {error}") from None


def _finite(value: Any) -> float:
    number = _number(value)
    if not math.isfinite(number):
        raise ValueError(str(number))
    return number


def _position(value: Any) -> list[float]:
    if not isinstance(value, list) or len(value) != 3:
        raise TypeError(f"{value!r} is not a position")
    return [_number(x) for x in value]


def _switch(values: Mapping[str, Any], name: str) -> bool:
    if not isinstance(values[name], bool):
        raise TypeError(f"{name} is {values[name]!r}")
    return bool(values[name])
