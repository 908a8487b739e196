"""The documents of an agent: devices, streams, errors, in the schema of a version."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from xml.sax.saxutils import escape, quoteattr

from errormotion.instruments.simulators.controller.mtconnect.devices import DataItem
from errormotion.instruments.simulators.controller.mtconnect.machine import UNAVAILABLE, Condition, Series
from errormotion.instruments.simulators.controller.mtconnect.observations import Observation

SENDER = "virtual"
_GROUPS = {"SAMPLE": "Samples", "EVENT": "Events", "CONDITION": "Condition"}
_NAMED_ERRORS = (2, 6)  # from this schema on, the element of an error has the name of the error


class RefusedError(Exception):
    """The agent answers a request with an error document.

    Attributes
    ----------
    code : str
        Code such as ``OUT_OF_RANGE``.
    status : int
        HTTP status.
    parameter : str
        Name of the wrong parameter; empty: none.
    """

    def __init__(self, code: str, text: str, status: int = 400, parameter: str = "") -> None:
        super().__init__(text)
        self.code, self.status, self.parameter = code, status, parameter


@dataclass(frozen=True)
class Frame:
    """Common parts of all documents of an agent.

    Attributes
    ----------
    version : str
        Schema version.
    buffer_size : int
    instance : int
    """

    version: str
    buffer_size: int
    instance: int

    @property
    def schema(self) -> tuple[int, int]:
        """Schema version as numbers."""
        major, _, minor = self.version.partition(".")
        return int(major), int(minor)

    def document(self, kind: str, content: str, time: str, header: Mapping[str, object]) -> bytes:
        """Return a document ``MTConnect<kind>`` with its header."""
        name = f"MTConnect{kind}"
        space = f"urn:mtconnect.org:{name}:{self.version}"
        attributes: dict[str, object] = {
            "creationTime": time,
            "sender": SENDER,
            "instanceId": self.instance,
            "version": f"{self.version}.0.0",
        }
        if kind != "Assets":  # its header states the number of assets only
            attributes["bufferSize"] = self.buffer_size
        if self.schema >= (1, 7):
            attributes["deviceModelChangeTime"] = "2025-01-01T00:00:00.000000Z"
        return (
            f'<?xml version="1.0" encoding="UTF-8"?>\n'
            f'<{name} xmlns:m="{space}" xmlns="{space}" xmlns:x="urn:example.org:Example{kind}:{self.version}" '
            'xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" '
            f'xsi:schemaLocation="{space} http://schemas.mtconnect.org/schemas/{name}_{self.version}.xsd">\n'
            f"  <Header{_attributes(attributes | dict(header))}/>\n  {content}\n</{name}>\n"
        ).encode()

    def devices(self, text: str, time: str) -> bytes:
        """Return the answer to a probe."""
        return self.document("Devices", f"<Devices>{text}</Devices>", time, {"assetBufferSize": 1024, "assetCount": 0})

    def assets(self, time: str) -> bytes:
        """Return the answer to a request for assets, without any asset."""
        return self.document("Assets", "<Assets/>", time, {"assetBufferSize": 1024, "assetCount": 0})

    def streams(
        self, seen: Iterable[Observation], items: Mapping[str, DataItem], time: str, sequences: Mapping[str, object]
    ) -> bytes:
        """Return observations by device, component and category."""
        devices: dict[int, tuple[DataItem, dict[int, tuple[DataItem, dict[str, list[str]]]]]] = {}
        for each in seen:
            item = items[each.item]
            _, components = devices.setdefault(id(item.device), (item, {}))
            _, groups = components.setdefault(id(item.component), (item, {}))
            groups.setdefault(item.category, []).append(_element(each, item))
        content = "".join(
            f"<DeviceStream{_attributes(_of(item.device.attrib, 'name', 'uuid'))}>"
            + "".join(_component(example, groups) for example, groups in components.values())
            + "</DeviceStream>"
            for item, components in devices.values()
        )
        return self.document("Streams", f"<Streams>{content}</Streams>", time, sequences)

    def error(self, refused: RefusedError, time: str, request: str) -> bytes:
        """Return the document of an error."""
        if self.schema < _NAMED_ERRORS:
            content = f'<Error errorCode="{refused.code}">{escape(str(refused))}</Error>'
        else:
            name = "".join(word.capitalize() for word in refused.code.split("_"))
            parameter = f'<QueryParameter name="{refused.parameter}"/>' if refused.parameter else ""
            content = (
                f'<{name} errorCode="{refused.code}"><URI>{escape(request)}</URI>'
                f"<ErrorMessage>{escape(str(refused))}</ErrorMessage>{parameter}</{name}>"
            )
        return self.document("Error", f"<Errors>{content}</Errors>", time, {})


def _attributes(values: Mapping[str, object]) -> str:
    return "".join(f" {name}={quoteattr(str(value))}" for name, value in values.items())


def _of(attributes: Mapping[str, str], *names: str) -> dict[str, object]:
    return {name: attributes[name] for name in names if name in attributes}


def _component(item: DataItem, groups: Mapping[str, list[str]]) -> str:
    component = item.component
    attributes = {
        "component": component.tag,
        **_of(component.attrib, "name", "nativeName"),
        "componentId": component.get("id"),
    }
    content = "".join(
        f"<{wrapped}>{''.join(groups[category])}</{wrapped}>"
        for category, wrapped in _GROUPS.items()
        if category in groups
    )
    return f"<ComponentStream{_attributes(attributes)}>{content}</ComponentStream>"


def _element(seen: Observation, item: DataItem) -> str:
    """Return one observation."""
    attributes: dict[str, object] = {"dataItemId": seen.item, "timestamp": seen.time}
    attributes |= _of(item.attributes, "name", "subType") | {"sequence": seen.sequence}
    value = seen.value
    if isinstance(value, Condition):
        more = {"nativeCode": value.code, "nativeSeverity": value.severity, "qualifier": value.qualifier}
        attributes |= {name: text for name, text in more.items() if text} | {"type": item.attributes["type"]}
        return f"<{value.level}{_attributes(attributes)}>{escape(value.text)}</{value.level}>"
    if isinstance(value, Series):
        attributes |= {"sampleCount": len(value.values), "sampleRate": f"{value.rate:g}"}
        content = " ".join(value.values)
    elif isinstance(value, str):
        if item.element.endswith("TimeSeries"):
            attributes |= {"sampleCount": 0}
        elif value == UNAVAILABLE and item.element.endswith(("DataSet", "Table")):
            attributes |= {"count": 0}
        content = escape(value)
    else:
        attributes |= {"count": len(value)}
        content = "".join(f"<Entry key={quoteattr(key)}>{_entry(cells)}</Entry>" for key, cells in value.items())
    return f"<{item.element}{_attributes(attributes)}>{content}</{item.element}>"


def _entry(value: str | Mapping[str, str]) -> str:
    if isinstance(value, str):
        return escape(value)
    return "".join(f"<Cell key={quoteattr(key)}>{escape(cell)}</Cell>" for key, cell in value.items())
