"""Data items of a device for positions, spindle, feed, mode, program and emergency stop."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from errormotion.errors import InstrumentError
from errormotion.instruments.controller.mtconnect.codec import DataItem, Device
from errormotion.instruments.controller.mtconnect.settings import MTConnectSettings

TIME_SERIES = "TIME_SERIES"
_SINGLE_VALUES = ("VALUE", "DISCRETE")
"""Representations of one value at a time; sets, tables and time series are only used if the settings state them."""
_ACTUAL = ("ACTUAL", "")
_COMMANDED = ("COMMANDED", "PROGRAMMED", "TARGET")
_SPEEDS = ("ROTARY_VELOCITY", "SPINDLE_SPEED")
_WHOLE_POSITION = {"position": _ACTUAL, "commanded_position": _COMMANDED}
_FEED_UNITS = ("", "MILLIMETER/SECOND", "MILLIMETER/MINUTE", "METER/SECOND", "INCH/SECOND", "INCH/MINUTE")
_SPEED_UNITS = ("", "REVOLUTION/MINUTE", "REVOLUTION/SECOND")
"""Units of a feed and of a spindle speed. In percent they are overrides; per revolution or in degrees, other
quantities."""
_MAX_NAMED = 8  # largest number of data items in a message
_RANKS: Mapping[str, int] = {"MACHINE": 0, "": 1, "WORK": 3}
"""Ranks of coordinate systems; those of other types, such as BASE, precede WORK."""


@dataclass
class Choice:
    """The data item that reports each quantity.

    Attributes
    ----------
    items : dict of str to DataItem
        Data items by quantity: `settings.KEYS`, and whole positions if the axes have no items.
    unclear : dict of str to str
        Quantities that several items report equally well, with a message on what to state in the settings.
    """

    items: dict[str, DataItem]
    unclear: dict[str, str] = field(default_factory=dict)


def choose(device: Device, settings: MTConnectSettings) -> Choice:
    """Return the data items by quantity.

    Quantities without a data item are missing. Items in ``settings.items`` have priority; then type, subtype, name of
    the component, and machine before work coordinates decide. Feeds and spindle speeds in percent, which are overrides,
    or in other units than those of a speed, and items of several values at once are not considered.

    Raises
    ------
    InstrumentError
        A setting states an item or spindle that does not exist, or an item of keys and values.
    """
    choice = Choice({key: _named(device, key, item) for key, item in settings.items.items()})
    for axis, name in zip("XYZ", settings.axes, strict=True):
        for key, sub_types in _WHOLE_POSITION.items():
            _add(choice, device, f"{key}.{axis}", ("POSITION",), sub_types, _linear_axis(device, name))
    for key, sub_types in _WHOLE_POSITION.items():
        if not any(f"{key}.{axis}" in choice.items or f"{key}.{axis}" in choice.unclear for axis in "XYZ"):
            _add(choice, device, key, ("PATH_POSITION",), sub_types)
    rotates = _spindle(device, settings)
    _add(choice, device, "spindle_speed", _SPEEDS, _ACTUAL, lambda item: item.units in _SPEED_UNITS and rotates(item))
    if speed := choice.items.get("spindle_speed"):
        of_spindle = _of_component(speed.component_id)
        _add(choice, device, "spindle_load", ("LOAD",), _ACTUAL, of_spindle)
    _add(choice, device, "feed", ("PATH_FEEDRATE",), _ACTUAL, lambda item: item.units in _FEED_UNITS)
    _add(choice, device, "mode", ("CONTROLLER_MODE",), ("",))
    _add(choice, device, "program", ("PROGRAM",), ("", "ACTIVE", "MAIN"))
    _add(choice, device, "execution", ("EXECUTION",), ("",))
    _add(choice, device, "estop", ("EMERGENCY_STOP",), ("",))
    _add(choice, device, "availability", ("AVAILABILITY",), ("",), lambda item: item.component == "Device")
    return choice


def _named(device: Device, key: str, name: str) -> DataItem:
    item = device.items.get(name) or next((each for each in device.items.values() if each.name == name), None)
    if item is None:
        raise InstrumentError(
            f"'{key}': the device '{device.name}' has no data item '{name}'; it has {', '.join(sorted(device.items))}",
            code="mtconnect.item.unknown",
        )
    if item.representation not in (*_SINGLE_VALUES, TIME_SERIES):
        raise InstrumentError(
            f"'{key}': the data item '{name}' is a {item.representation} of keys and values; state one with one value",
            code="mtconnect.item.several_values",
        )
    return item


def _any(_: DataItem) -> bool:
    return True


def _on(name: str, component: str) -> Callable[[DataItem], bool]:
    return lambda item: (
        item.component == component and name.upper() in (item.component_name.upper(), item.native_name.upper())
    )


def _linear_axis(device: Device, name: str) -> Callable[[DataItem], bool]:
    """Return a check whether an item belongs to an axis with this name, or with a number, such as Z1 for Z."""
    fits = _on(name, "Linear")
    return fits if any(fits(item) for item in device.items.values()) else _on(f"{name}1", "Linear")


def _of_component(component_id: str) -> Callable[[DataItem], bool]:
    return lambda item: item.component_id == component_id


def _spindle(device: Device, settings: MTConnectSettings) -> Callable[[DataItem], bool]:
    if not settings.spindle:
        return _any
    fits = _on(settings.spindle, "Rotary")
    if not any(fits(item) for item in device.items.values()):
        names = sorted({item.component_name for item in device.items.values() if item.component == "Rotary"})
        raise InstrumentError(
            f"The device '{device.name}' has no rotary axis '{settings.spindle}'; it has {', '.join(names) or 'none'}",
            code="mtconnect.axis.unknown",
        )
    return fits


def _add(
    choice: Choice,
    device: Device,
    key: str,
    types: Sequence[str],
    sub_types: Sequence[str],
    fits: Callable[[DataItem], bool] = _any,
) -> None:
    """Add the data item that fits best, if any; none if several fit equally well."""
    if key in choice.items:
        return
    for sub_type in sub_types:
        for kind in types:
            items = [
                item
                for item in device.items.values()
                if item.type == kind
                and item.sub_type == sub_type
                and item.category != "CONDITION"
                and item.representation in _SINGLE_VALUES
                and fits(item)
            ]
            best = min((_rank(item) for item in items), default=0)
            items = [item for item in items if _rank(item) == best]
            if len(items) > 1:
                names = ", ".join(f"{item.id} ({item.component} {item.component_name})" for item in items[:_MAX_NAMED])
                choice.unclear[key] = (
                    f"Several data items report '{key}': {names}. It is unknown until the settings state which one: "
                    f'items = {{ "{key}" = "{items[0].id}" }}'
                )
                return
            if items:
                choice.items[key] = items[0]
                return


def _rank(item: DataItem) -> int:
    return _RANKS.get(item.coordinate_system, 2)
