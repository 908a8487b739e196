"""Parsing of XML to a tree, with limits of size, depth and numbers of elements and attributes; names without prefixes.

The parser does not resolve namespaces, so that a long namespace is not copied into each name. A document with a
document type is refused before anything in it is expanded, so that there are no entities, external or nested.
"""

from __future__ import annotations

from collections.abc import Iterator
from xml.parsers import expat

from errormotion.errors import ProtocolError

LONGEST = 16 << 20
"""Longest document, bytes."""
MAX_DEPTH = 64
MAX_ELEMENTS = 200_000
MAX_ATTRIBUTES = 64  # largest number of attributes of one element
MAX_NAME = 256  # characters of a name, and of a name in an attribute
_PIECE = 1 << 20  # bytes parsed at once


class Element:
    """An element: name and attributes without prefixes, text, and children.

    Attributes
    ----------
    name, text : str
    attributes : dict of str to str
    children : list of Element
    """

    __slots__ = ("attributes", "children", "name", "text")

    def __init__(self, name: str, attributes: dict[str, str]) -> None:
        self.name, self.attributes = name, attributes
        self.text = ""
        self.children: list[Element] = []

    def get(self, name: str, default: str = "") -> str:
        """Return an attribute."""
        return self.attributes.get(name, default)

    def child(self, name: str) -> Element | None:
        """Return the first child of a name; None without one."""
        return next((each for each in self.children if each.name == name), None)

    def walk(self) -> Iterator[Element]:
        """Yield the element and all its descendants, in the order of the document."""
        waiting = [self]
        while waiting:
            element = waiting.pop()
            yield element
            waiting.extend(reversed(element.children))


def parse_tree(data: bytes) -> Element:
    """Return the root of a document.

    Raises
    ------
    ProtocolError
        The data are not XML, have a document type, or exceed a limit of this module.
    """
    if len(data) > LONGEST:
        raise ProtocolError(
            f"Expected a document of at most {LONGEST} bytes; found {len(data)}", code="protocol.xml.too_large"
        )
    builder = _Builder()
    try:
        parser = expat.ParserCreate()
        parser.buffer_text = True
        parser.StartElementHandler = builder.start
        parser.EndElementHandler = builder.end
        parser.CharacterDataHandler = builder.text
        parser.StartDoctypeDeclHandler = builder.doctype
        for start in range(0, len(data), _PIECE):
            parser.Parse(data[start : start + _PIECE], False)
        parser.Parse(b"", True)
    except (expat.ExpatError, ValueError, LookupError) as error:  # the latter two: unknown encodings
        raise ProtocolError(
            f"Expected XML; found {data[:60]!r}, which cannot be parsed ({error})", code="protocol.xml.form"
        ) from None
    if builder.root is None:
        raise ProtocolError(f"Expected XML; found {data[:60]!r}", code="protocol.xml.form")
    return builder.root


class _Builder:
    def __init__(self) -> None:
        self.root: Element | None = None
        self._open: list[Element] = []
        self._pieces: list[list[str]] = []
        self._count = 0

    def start(self, name: str, attributes: dict[str, str]) -> None:
        self._count += 1
        if self._count > MAX_ELEMENTS:
            raise ProtocolError(
                f"Expected a document of at most {MAX_ELEMENTS} elements", code="protocol.xml.too_large"
            )
        if len(self._open) >= MAX_DEPTH:
            raise ProtocolError(
                f"Expected elements nested at most {MAX_DEPTH} deep; found <{name[:40]}> below that",
                code="protocol.xml.too_large",
            )
        if len(attributes) > MAX_ATTRIBUTES:
            raise ProtocolError(
                f"<{name[:40]}>: expected at most {MAX_ATTRIBUTES} attributes; found {len(attributes)}",
                code="protocol.xml.too_large",
            )
        if len(name) > MAX_NAME or any(len(key) > MAX_NAME for key in attributes):
            raise ProtocolError(
                f"<{name[:40]}>: expected names of at most {MAX_NAME} characters", code="protocol.xml.too_large"
            )
        plain = {
            key: value for key, value in attributes.items() if ":" not in key
        }  # attributes of MTConnect have no prefix
        element = Element(name.rpartition(":")[2], plain)
        if self._open:
            self._open[-1].children.append(element)
        elif self.root is None:
            self.root = element
        self._open.append(element)
        self._pieces.append([])

    def end(self, _: str) -> None:
        self._open.pop().text = "".join(self._pieces.pop())

    def text(self, data: str) -> None:
        if self._pieces:
            self._pieces[-1].append(data)

    def doctype(self, name: str, *_: object) -> None:
        raise ProtocolError(
            f"Expected a document of MTConnect without document type; found '{name[:40]}'",
            code="protocol.xml.document_type",
        )
