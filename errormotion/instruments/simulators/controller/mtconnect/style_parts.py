"""Parts of device documents.

A data item has the attribute ``src``, the name of its reading (`machine.readings`): ``=text`` for a constant, none if
the controller never reports a value. The attribute is removed before the document is sent.
"""

from __future__ import annotations

AXES = "XYZ"


def data_item(category: str, kind: str, item_id: str, src: str = "", content: str = "", **more: str) -> str:
    """Return a data item: category, type, identifier, reading, content, further attributes."""
    attributes = "".join(f' {name}="{value}"' for name, value in more.items())
    source = f' src="{src}"' if src else ""
    return f'<DataItem category="{category}" id="{item_id}" type="{kind}"{attributes}{source}>{content}</DataItem>'


def data_items(*items: str) -> str:
    """Return the data items of a component."""
    return f"<DataItems>{''.join(items)}</DataItems>"


def inside(*components: str) -> str:
    """Return the components of a component."""
    return f"<Components>{''.join(components)}</Components>"


def coordinate_systems(*systems: tuple[str, str, str]) -> str:
    """Return the configuration with coordinate systems: identifier, type, parent."""
    origin = "<Origin>0 0 0</Origin>"
    shifted = "<Transformation><Translation>0 0 0</Translation><Rotation>0 0 0</Rotation></Transformation>"
    each = (
        f'<CoordinateSystem id="{name}" type="{kind}"'
        + (f' parentIdRef="{parent}">{shifted}' if parent else f">{origin}")
        for name, kind, parent in systems
    )
    listed = "</CoordinateSystem>".join(each)
    return f"<Configuration><CoordinateSystems>{listed}</CoordinateSystem></CoordinateSystems></Configuration>"
