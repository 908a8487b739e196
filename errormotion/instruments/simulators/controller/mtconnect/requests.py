"""The grammar of requests: paths and parameters of an agent, and their ranges.

Source: part 1 of the standard (fundamentals), and the requests and answers in the tests of mtconnect/cppagent.
Assumption: an agent of a schema before 2.0 answers errors with status 200, and with other texts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from errormotion.instruments.simulators.controller.mtconnect.documents import RefusedError

Kind = Literal["probe", "current", "sample", "asset"]
_KINDS: Mapping[str, Kind] = {
    "probe": "probe",
    "current": "current",
    "sample": "sample",
    "asset": "asset",
    "assets": "asset",
}
_NUMBERS = {"from": 0, "at": 0, "to": 0, "count": None, "interval": None, "heartbeat": None}
_LARGEST = (1 << 31) - 1
HEARTBEAT = 10.0
"""Default interval of documents without observations in a stream, s."""
COUNT = 100


@dataclass(frozen=True)
class Request:
    """A valid request.

    Attributes
    ----------
    kind : str
    device : str
        Name of the device; empty: all.
    path : str or None
        Path that selects data items.
    begin, end, at : int or None
        Sequence numbers.
    count : int or None
        Number of observations; default: 100, or the size of a smaller buffer.
    interval, heartbeat : float
        Intervals of a stream, s; no stream if ``interval`` is negative.
    asset : str
        Id of the asset; empty: all.
    """

    kind: Kind
    device: str = ""
    path: str | None = None
    begin: int | None = None
    end: int | None = None
    at: int | None = None
    count: int | None = None
    interval: float = -1.0
    heartbeat: float = HEARTBEAT
    asset: str = ""


def read_request(path: str, query: Mapping[str, str], schema: tuple[int, int], devices: set[str]) -> Request:
    """Return a parsed request.

    Raises
    ------
    RefusedError
        The path is unknown, or a parameter is not a number.
    """
    kind, device, asset = _route(path, schema, devices)
    numbers = {name: _number(name, query[name], schema) for name in _NUMBERS if name in query}
    interval, heartbeat = numbers.get("interval"), numbers.get("heartbeat")
    if interval is not None:
        check_range("interval", interval, -1, _LARGEST)
    if heartbeat is not None:
        check_range("heartbeat", heartbeat, 1, _LARGEST)
    return Request(
        kind=kind,
        device=device,
        path=query.get("path"),
        begin=numbers.get("from"),
        end=numbers.get("to"),
        at=numbers.get("at"),
        count=numbers.get("count"),
        interval=-1.0 if interval is None else interval / 1e3,
        heartbeat=HEARTBEAT if heartbeat is None else heartbeat / 1e3,
        asset=asset,
    )


def check_range(name: str, value: int, above: int, below: int, *, zero: bool = True) -> None:
    """Raise RefusedError unless ``above < value < below``, and not 0 unless ``zero``."""
    text = ""
    if value <= above:
        text = f"'{name}' must be greater than {above}"
    elif value >= below:
        text = f"'{name}' must be less than {below}"
    elif value == 0 and not zero:
        text = f"'{name}' must not be zero(0)"
    if text:
        raise RefusedError("OUT_OF_RANGE", text, parameter=name)


def _route(path: str, schema: tuple[int, int], devices: set[str]) -> tuple[Kind, str, str]:
    words = path.strip("/").split("/") if path.strip("/") else []
    match words:
        case []:
            return "probe", "", ""
        case [word] if word in _KINDS:
            return _KINDS[word], "", ""
        case ["asset" | "assets", ids]:
            return "asset", "", ids
        case [device] if device in devices:
            return "probe", device, ""
        case [device, word] if word in _KINDS:
            if device not in devices:
                raise RefusedError("NO_DEVICE", f"Could not find the device '{device}'", 404)
            return _KINDS[word], device, ""
    if schema < (2, 0):
        raise RefusedError("UNSUPPORTED", f"The following path is invalid: {path}", 404)
    raise RefusedError("INVALID_REQUEST", f"127.0.0.1: Cannot find handler for: GET {path}", 404)


def _number(name: str, text: str, schema: tuple[int, int]) -> int:
    digits = text[1:] if text[:1] in "+-" else text
    signed = _NUMBERS[name] is None
    if digits.isascii() and digits.isdigit() and len(digits) < 20 and (signed or text[:1] != "-"):
        return int(text)
    if schema < (2, 0):
        raise RefusedError("OUT_OF_RANGE", f"'{name}' must be a positive integer.", parameter=name)
    kind = "integer" if signed else "unsigned_integer"
    words = f"query parameter '{name}': cannot convert string '{text}' to {kind}"
    if schema < (2, 6):
        raise RefusedError("INVALID_REQUEST", f"127.0.0.1: Parameter Error: for {words}", 404)
    raise RefusedError("INVALID_PARAMETER_VALUE", words, parameter=name)
