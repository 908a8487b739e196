"""Requests and replies of an IDS3010: JSON-RPC 2.0 objects, a reply ends in CR LF. Lengths are in picometres."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any, NoReturn

from errormotion.errors import ProtocolError

LINE_END = b"\r\n"
MAX_REPLY = 4096
"""Bytes, line end included; a reply with three lengths has about 100."""
PICOMETRE = 1e-12  # m
API = 2
"""Version of the interface: every result starts with the number of an error or a warning."""

FAMILIES = ("ids", "sen")
"""Names of the family of sensor functions, older first: firmware 1.9 has ``com.attocube.sen``, before ``ids``."""
_SENSOR = "com.attocube.ids."
DISPLACEMENT, SYSTEM, AXIS = f"{_SENSOR}displacement.", f"{_SENSOR}system.", f"{_SENSOR}axis."
UNIT = "com.attocube.ecu."
SERVICE = "com.attocube.system."


@dataclass(frozen=True)
class Reply:
    """One reply.

    Attributes
    ----------
    number : int or None
        Number of the request; None if the device could not read it.
    code : int
        Number of an error or a warning of the function; 0: none.
    values : tuple
        Values after the code, as received.
    refusal : str
        Why the request was not executed; empty if it was.
    """

    number: int | None
    code: int = 0
    values: tuple[Any, ...] = ()
    refusal: str = ""

    def length(self, index: int) -> float:
        """Return a value in picometres as m; ProtocolError if it is invalid."""
        return self.quantity(index) * PICOMETRE

    def quantity(self, index: int) -> float:
        """Return a finite number; ProtocolError if it is invalid."""
        value = self._value(index)
        if isinstance(value, int | float) and not isinstance(value, bool):
            try:
                number = float(value)
            except OverflowError:
                number = math.inf
            if math.isfinite(number):
                return number
        raise ProtocolError(
            f"Value {index + 1} of a reply: expected a number; found {str(value)[:40]!r}",
            code="protocol.reply.number_form",
        )

    def flag(self, index: int) -> bool:
        """Return true or false; ProtocolError if it is neither."""
        value = self._value(index)
        if not isinstance(value, bool):
            raise ProtocolError(
                f"Value {index + 1} of a reply: expected true or false; found {str(value)[:40]!r}",
                code="protocol.reply.form",
            )
        return value

    def text(self, index: int) -> str:
        """Return a text of at most 200 printable characters; ProtocolError if it is invalid."""
        value = self._value(index)
        if not isinstance(value, str) or len(value) > 200 or not value.isprintable():
            raise ProtocolError(
                f"Value {index + 1} of a reply: expected a short text; found {str(value)[:40]!r}",
                code="protocol.reply.form",
            )
        return value

    def _value(self, index: int) -> Any:
        if index >= len(self.values):
            raise ProtocolError(
                f"A reply has {len(self.values)} values; expected at least {index + 1}", code="protocol.reply.length"
            )
        return self.values[index]


def in_family(method: str, family: str) -> str:
    """Return the name of a function in a family; functions of the environmental unit and the device have one name."""
    return f"com.attocube.{family}.{method.removeprefix(_SENSOR)}" if method.startswith(_SENSOR) else method


def request(method: str, number: int, *parameters: bool | int | str) -> bytes:
    """Return a request, in the form of the manufacturer's client: without a line end."""
    message: dict[str, Any] = {"jsonrpc": "2.0", "method": method, "id": number, "api": API}
    if parameters:
        message["params"] = list(parameters)
    return json.dumps(message).encode("ascii")


def reply(line: bytes) -> Reply:
    """Return one reply, given with or without its line end.

    Raises
    ------
    ProtocolError
        Not a reply of an IDS3010, or longer than ``MAX_REPLY``.
    """
    if len(line) > MAX_REPLY:
        raise ProtocolError(
            f"A reply of {len(line)} bytes; expected at most {MAX_REPLY}", code="protocol.reply.too_long"
        )
    try:
        message = json.loads(line, parse_constant=_refuse)
    except (ValueError, RecursionError):
        message = None
    if not isinstance(message, dict) or message.get("jsonrpc") != "2.0":
        raise ProtocolError(
            f'Expected a reply such as \'{{"jsonrpc":"2.0","id":1,"result":[0]}}\'; found {line[:60]!r}. Check '
            "that the address is port 9090 of an IDS3010",
            code="protocol.reply.form",
        )
    number, result, error = message.get("id"), message.get("result"), message.get("error")
    if not (number is None or (isinstance(number, int) and not isinstance(number, bool))):
        raise ProtocolError(
            f"The number of a reply: expected an integer; found {str(number)[:40]!r}", code="protocol.reply.number_form"
        )
    if isinstance(error, dict):
        return Reply(number, refusal=f"{str(error.get('message', ''))[:120]} ({str(error.get('code', ''))[:12]})")
    if not isinstance(result, list) or not result or number is None:
        raise ProtocolError(
            f"Expected a reply with a number and a result; found {line[:60]!r}", code="protocol.reply.form"
        )
    return Reply(number, _code(result[0]), tuple(result[1:]))


def _code(value: Any) -> int:
    if value is None or value == "null":  # as the manufacturer's client reads it
        return 0
    if not isinstance(value, int) or isinstance(value, bool):
        raise ProtocolError(
            f"The first value of a reply: expected the number of an error or a warning; found {str(value)[:40]!r}. A "
            f"firmware before version {API} of the interface has none: update it",
            code="protocol.reply.number_form",
        )
    return value


def _refuse(text: str) -> NoReturn:
    raise ValueError(f"not JSON: {text}")
