"""The XML of MTConnect agents (ANSI/MTC1.4, parts 1 and 2): devices, observations, errors.

Prefixes of names are ignored, so that all versions from 1.1 to 2.x are read alike.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime

from errormotion.errors import ProtocolError
from errormotion.instruments.controller.mtconnect.xml import Element, parse_tree

UNAVAILABLE = "UNAVAILABLE"
_OBJECT, _WORK = "OBJECT", "WORK"
_MAX_DIGITS = 20  # of a sequence number or instance id: 64 bit
_MAX_TIME = 64  # characters
_NUMBER = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]{1,4})?", re.ASCII)
LEVELS = ("Normal", "Warning", "Fault", "Unavailable")
"""Elements of a condition."""

_SI: Mapping[str, float] = {
    "MILLIMETER": 1e-3,
    "MILLIMETER_3D": 1e-3,
    "MILLIMETER/SECOND": 1e-3,
    "MILLIMETER/MINUTE": 1e-3 / 60,
    "MILLIMETER/SECOND^2": 1e-3,
    "MILLIMETER/REVOLUTION": 1e-3,
    "INCH": 25.4e-3,
    "INCH_3D": 25.4e-3,
    "INCH/SECOND": 25.4e-3,
    "INCH/MINUTE": 25.4e-3 / 60,
    "FOOT": 0.3048,
    "METER": 1.0,
    "METER/SECOND": 1.0,
    "DEGREE": math.pi / 180,
    "DEGREE_3D": math.pi / 180,
    "DEGREE/SECOND": math.pi / 180,
    "DEGREE/MINUTE": math.pi / 180 / 60,
    "RADIAN": 1.0,
    "REVOLUTION/MINUTE": 1.0,  # spindle speeds remain per minute
    "REVOLUTION/SECOND": 60.0,
    "PERCENT": 0.01,
    "CELSIUS": 1.0,
    "SECOND": 1.0,
    "HERTZ": 1.0,
    "COUNT": 1.0,
}
_UNITS_OF: Mapping[str, str] = {
    "POSITION": "MILLIMETER",
    "PATH_POSITION": "MILLIMETER_3D",
    "AXIS_FEEDRATE": "MILLIMETER/SECOND",
    "PATH_FEEDRATE": "MILLIMETER/SECOND",
    "ROTARY_VELOCITY": "REVOLUTION/MINUTE",
    "SPINDLE_SPEED": "REVOLUTION/MINUTE",
    "ANGLE": "DEGREE",
    "LOAD": "PERCENT",
    "TEMPERATURE": "CELSIUS",
}
"""Units of the standard, for an agent that omits them."""


@dataclass(frozen=True)
class Header:
    """Header of a document; ``first`` to ``last`` are the sequence numbers in the buffer of the agent."""

    instance: int
    created: float  # s since 1970
    first: int = 0
    last: int = 0
    next: int = 0
    buffer: int = 0
    version: str = ""
    sender: str = ""
    model_changed: str = ""  # deviceModelChangeTime, as stated


@dataclass(frozen=True)
class DataItem:
    """A data item of a device, with element, names and id of its component.

    ``coordinate_system`` is ``MACHINE``, ``WORK`` (from version 2.0 on a coordinate system of type OBJECT), empty if
    the device does not state it, ``UNKNOWN`` for a reference to one that does not exist, or the type of another one.
    """

    id: str
    category: str
    type: str
    sub_type: str = ""
    name: str = ""
    units: str = ""
    coordinate_system: str = ""
    component: str = ""
    component_name: str = ""
    native_name: str = ""
    component_id: str = ""
    representation: str = "VALUE"

    @property
    def scale(self) -> float:
        """Factor that converts a value to SI; to 1/min for speeds of rotation.

        Raises
        ------
        ProtocolError
            The units are unknown.
        """
        units = self.units or _UNITS_OF.get(self.type, "")
        if units not in _SI:
            known = ", ".join(sorted(_SI))
            raise ProtocolError(
                f"The data item '{self.id}' ({self.type}) is in '{units}'; expected one of {known}",
                code="protocol.mtconnect.unit",
            )
        return _SI[units]


@dataclass(frozen=True)
class Device:
    """A device of an agent, and its data items by id."""

    name: str
    uuid: str
    manufacturer: str = ""
    model: str = ""
    serial_number: str = ""
    items: Mapping[str, DataItem] = field(default_factory=dict)


@dataclass(frozen=True)
class Observation:
    """One observation.

    Attributes
    ----------
    item : str
        Id of the data item.
    sequence : int
        Number of the observation; counts up over all data items while the agent runs.
    time : float
        Time on the agent's clock, s since 1970.
    value : str
        As reported by the agent, ``UNAVAILABLE`` included; for a condition its text.
    level : str
        For a condition ``Normal``, ``Warning``, ``Fault`` or ``Unavailable``; else empty.
    type, code : str
        For a condition its type, and the code of the machine.
    """

    item: str
    sequence: int
    time: float
    value: str
    level: str = ""
    type: str = ""
    code: str = ""

    def number(self, scale: float = 1.0) -> float:
        """Return the value times ``scale``; NaN if it is unavailable.

        Raises
        ------
        ProtocolError
            The value is neither a number nor unavailable.
        """
        return self.numbers(scale)[0]

    def numbers(self, scale: float = 1.0) -> list[float]:
        """Return the values of a list such as ``1.5 2 3`` times ``scale``; one NaN if it is unavailable."""
        if self.value.upper() == UNAVAILABLE:
            return [math.nan]
        numbers = []
        for word in self.value.split():
            if not _NUMBER.fullmatch(word) or math.isinf(float(word)):
                raise ProtocolError(
                    f"The data item '{self.item}': expected a number; found '{self.value[:40]}'",
                    code="protocol.mtconnect.number",
                )
            numbers.append(float(word) * scale)
        return numbers or [math.nan]


@dataclass(frozen=True)
class Document:
    """An agent's answer: devices (/probe), observations (/current and /sample), or errors by their code."""

    header: Header
    devices: tuple[Device, ...] = ()
    observations: tuple[Observation, ...] = ()
    errors: Mapping[str, str] = field(default_factory=dict)


def parse(data: bytes) -> Document:
    """Parse an agent's answer.

    Raises
    ------
    ProtocolError
        The data are not XML or not of MTConnect, have a document type, or an incomplete header or observation.
    """
    root = parse_tree(data)
    kind = root.name
    header = _header(root)
    match kind:
        case "MTConnectDevices":
            return Document(header, devices=tuple(_devices(root)))
        case "MTConnectStreams":
            found = sorted(_observations(root), key=lambda each: each.sequence)
            return Document(header, observations=tuple(found))
        case "MTConnectError":
            return Document(header, errors=_errors(root))
        case _:
            raise ProtocolError(
                f"Expected a document of MTConnect (devices, streams or an error); found <{kind[:40]}>",
                code="protocol.mtconnect.form",
            )


def _whole(element: Element, name: str, default: int | None = None) -> int:
    text = element.get(name)
    if not text and default is not None:
        return default
    if not (text.isascii() and text.isdigit() and len(text) <= _MAX_DIGITS):
        raise ProtocolError(
            f"<{element.name}>: expected a number '{name}'; found '{text[:40]}'", code="protocol.mtconnect.number"
        )
    return int(text)


def parse_time(text: str) -> float:
    """Return a time such as ``2025-03-01T12:00:00.25Z`` as s since 1970; without a zone it is UTC.

    Raises
    ------
    ProtocolError
        The text is not such a time.
    """
    if len(text) > _MAX_TIME:
        raise ProtocolError(
            f"Expected a time such as 2025-03-01T12:00:00Z; found '{text[:40]}'", code="protocol.time.form"
        )
    try:
        time = datetime.fromisoformat(text.partition("@")[0].strip())
        return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        raise ProtocolError(
            f"Expected a time such as 2025-03-01T12:00:00Z; found '{text[:40]}'", code="protocol.time.form"
        ) from None


def _header(root: Element) -> Header:
    header = root.child("Header")
    if header is None:
        raise ProtocolError(
            f"Expected a document of MTConnect; found <{root.name[:40]}> without a header",
            code="protocol.mtconnect.form",
        )
    return Header(
        instance=_whole(header, "instanceId"),
        created=parse_time(header.get("creationTime")),
        first=_whole(header, "firstSequence", 0),
        last=_whole(header, "lastSequence", 0),
        next=_whole(header, "nextSequence", 0),
        buffer=_whole(header, "bufferSize", 0),
        version=header.get("version"),
        sender=header.get("sender"),
        model_changed=header.get("deviceModelChangeTime"),
    )


def _devices(root: Element) -> Iterator[Device]:
    for devices in root.children:
        if devices.name != "Devices":
            continue
        for device in devices.children:
            if device.name != "Device":  # agents also describe themselves
                continue
            about = device.child("Description") or Element("Description", {})
            yield Device(
                name=device.get("name"),
                uuid=device.get("uuid"),
                manufacturer=about.get("manufacturer"),
                model=about.get("model"),
                serial_number=about.get("serialNumber"),
                items={item.id: item for item in _items(device)},
            )


def _items(device: Element) -> Iterator[DataItem]:
    """Yield the data items of a device and its components."""
    systems = {each.get("id"): each.get("type") for each in device.walk() if each.name == "CoordinateSystem"}
    waiting = [device]
    while waiting:
        component = waiting.pop()
        for part in component.children:
            match part.name:
                case "DataItems":
                    yield from (_item(item, component, systems) for item in part.children if item.name == "DataItem")
                case "Components":
                    waiting.extend(part.children)


def _item(item: Element, component: Element, systems: Mapping[str, str]) -> DataItem:
    if not item.get("id") or not item.get("type"):
        raise ProtocolError(
            f"Expected data items with id and type; found {str(item.attributes)[:200]}", code="protocol.mtconnect.form"
        )
    coordinates = item.get("coordinateSystem")
    if reference := item.get("coordinateSystemIdRef"):  # from version 2.0 on
        kind = systems.get(reference, "UNKNOWN")
        coordinates = _WORK if kind == _OBJECT else kind
    return DataItem(
        id=item.get("id"),
        category=item.get("category"),
        type=item.get("type"),
        sub_type=item.get("subType"),
        name=item.get("name"),
        units=item.get("units") or item.get("nativeUnits"),
        coordinate_system=coordinates,
        component=component.name,
        component_name=component.get("name"),
        native_name=component.get("nativeName"),
        component_id=component.get("id"),
        representation=item.get("representation") or "VALUE",
    )


def _observations(root: Element) -> Iterator[Observation]:
    for element in root.walk():
        item = element.get("dataItemId")
        if not item:
            continue
        level = element.name if element.name in LEVELS else ""
        yield Observation(
            item=item,
            sequence=_whole(element, "sequence"),
            time=parse_time(element.get("timestamp")),
            value=_value(element),
            level=level,
            type=element.get("type") if level else "",
            code=element.get("nativeCode") if level else "",
        )


def _value(element: Element) -> str:
    """Return the text of an observation; for a set or table ``key=text`` of each entry."""
    entries = [each for each in element.children if each.name == "Entry"]
    if not entries:
        return element.text.strip()
    return " ".join(f"{each.get('key')}={_row(each)}" for each in entries)


def _row(entry: Element) -> str:
    cells = [f"{each.get('key')}={each.text.strip()}" for each in entry.children if each.name == "Cell"]
    return f"{{{' '.join(cells)}}}" if cells else entry.text.strip()


def _errors(root: Element) -> dict[str, str]:
    errors = {each.get("errorCode"): _words(each) for each in root.walk()}
    errors.pop("", None)
    return errors or {"UNKNOWN": "error without a code"}


def _words(element: Element) -> str:
    return " ".join(" ".join((element.text, *(each.text for each in element.children))).split())
