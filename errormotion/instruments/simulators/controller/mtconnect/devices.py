"""The devices of an agent: its document, and the data items in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from errormotion.instruments.simulators.controller.mtconnect.paths import select

_SUFFIXES = {"TIME_SERIES": "TimeSeries", "DATA_SET": "DataSet", "TABLE": "Table"}


@dataclass(frozen=True)
class DataItem:
    """A data item and its location.

    Attributes
    ----------
    element : str
        Name of its observations in a document.
    attributes : mapping
        Attributes in the device document.
    source : str
        Name of its reading.
    component, device : Element
        Component and device to which it belongs.
    key : str
        Its key in an adapter: its source, its name, or its identifier.
    """

    element: str
    attributes: Mapping[str, str]
    source: str
    component: Element
    device: Element
    key: str

    @property
    def category(self) -> str:
        """``SAMPLE``, ``EVENT`` or ``CONDITION``."""
        return self.attributes["category"]


class Devices:
    """The devices of an agent.

    Parameters
    ----------
    text : str
        The devices as XML; data items with the attribute ``src`` (`styles`).
    further : str
        A further component of the last device, as XML.
    """

    def __init__(self, text: str, further: str = "") -> None:
        self.root = ElementTree.fromstring(f"<Document><Devices>{text}</Devices></Document>")
        if further:
            components = self.root[0][-1].find("Components")
            assert components is not None
            components.append(ElementTree.fromstring(further))
        self.items: dict[str, DataItem] = {}
        for device in self.root[0]:
            self._collect(device, device)

    def _collect(self, component: Element, device: Element) -> None:
        for element in component.iterfind("DataItems/DataItem"):
            source = element.attrib.pop("src", "")
            kind, representation = element.attrib["type"], element.attrib.get("representation", "")
            attributes = element.attrib
            key = element.findtext("Source") or attributes.get("name") or attributes["id"]
            name = _element_name(kind) + _SUFFIXES.get(representation, "")
            self.items[element.attrib["id"]] = DataItem(name, element.attrib, source, component, device, key)
        for part in component.iterfind("Components/*"):
            self._collect(part, device)

    def named(self, name: str) -> Element | None:
        """Return the device with a name or a uuid."""
        return next((each for each in self.root[0] if name in (each.get("name"), each.get("uuid"))), None)

    def chosen(self, path: str | None, device: Element | None) -> set[str]:
        """Return the data items that a path selects, of all devices or of one.

        Raises
        ------
        PathError
            The path cannot be read.
        """
        elements = [self.root] if path is None else select(self.root, path)
        items = {item.get("id", "") for each in elements for item in each.iter("DataItem")}
        return {key for key in items if device is None or self.items[key].device is device}

    def text(self, device: Element | None = None) -> str:
        """Return the document of all devices, or of one."""
        shown = self.root[0] if device is None else [device]
        return "".join(ElementTree.tostring(each, encoding="unicode") for each in shown)


def _element_name(kind: str) -> str:
    """Return the name of the element of a type: ``PATH_FEEDRATE`` is ``PathFeedrate``, ``x:UNIT`` is ``x:Unit``."""
    prefix, colon, rest = kind.rpartition(":")
    return prefix + colon + "".join(word.capitalize() for word in rest.split("_"))
