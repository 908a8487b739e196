"""Data items of a device for positions, spindle, feed, mode, program and emergency stop."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from errormotion.errors import InstrumentError
from errormotion.instruments.controller.mtconnect.codec import DataItem, Device
from errormotion.instruments.controller.mtconnect.settings import MTConnectSettings

_ACTUAL = ("ACTUAL", "")
_COMMANDED = ("COMMANDED", "PROGRAMMED", "TARGET")
_SPEEDS = ("ROTARY_VELOCITY", "SPINDLE_SPEED")
_WHOLE_POSITION = {"position": _ACTUAL, "commanded_position": _COMMANDED}


def _any(_: DataItem) -> bool:
    return True


def choose(device: Device, settings: MTConnectSettings) -> Mapping[str, DataItem]:
    """Return data items by quantity: `settings.KEYS`, and whole positions where the axes have none of their own.

    Quantities without a data item are missing. An item in ``settings.items`` comes first; then type, subtype, the
    name of the component, and machine before work coordinates decide.

    Raises
    ------
    InstrumentError
        A setting names an item or spindle that is not there, or several items fit: all are named.
    """
    chosen = {key: _named(device, key, item) for key, item in settings.items.items()}
    for axis, name in zip("XYZ", settings.axes, strict=True):
        for key, sub_types in _WHOLE_POSITION.items():
            fits = _on(name, "Linear")
            _add(chosen, device, f"{key}.{axis}", ("POSITION",), sub_types, fits)
    for key, sub_types in _WHOLE_POSITION.items():
        if not any(f"{key}.{axis}" in chosen for axis in "XYZ"):
            _add(chosen, device, key, ("PATH_POSITION",), sub_types)
    _add(chosen, device, "spindle_speed", _SPEEDS, _ACTUAL, _spindle(device, settings))
    if speed := chosen.get("spindle_speed"):
        _add(chosen, device, "spindle_load", ("LOAD",), _ACTUAL, lambda item: item.component_id == speed.component_id)
    _add(chosen, device, "feed", ("PATH_FEEDRATE",), _ACTUAL)
    _add(chosen, device, "mode", ("CONTROLLER_MODE",), ("",))
    _add(chosen, device, "program", ("PROGRAM",), ("", "ACTIVE", "MAIN"))
    _add(chosen, device, "execution", ("EXECUTION",), ("",))
    _add(chosen, device, "estop", ("EMERGENCY_STOP",), ("",))
    _add(chosen, device, "availability", ("AVAILABILITY",), ("",), lambda item: item.component == "Device")
    return chosen


def _named(device: Device, key: str, name: str) -> DataItem:
    item = device.items.get(name) or next((each for each in device.items.values() if each.name == name), None)
    if item is None:
        raise InstrumentError(
            f"'{key}': the device '{device.name}' has no data item '{name}'; it has {', '.join(sorted(device.items))}"
        )
    return item


def _on(name: str, component: str) -> Callable[[DataItem], bool]:
    return lambda item: (
        item.component == component and name.upper() in (item.component_name.upper(), item.native_name.upper())
    )


def _spindle(device: Device, settings: MTConnectSettings) -> Callable[[DataItem], bool]:
    if not settings.spindle:
        return _any
    fits = _on(settings.spindle, "Rotary")
    if not any(fits(item) for item in device.items.values()):
        names = sorted({item.component_name for item in device.items.values() if item.component == "Rotary"})
        raise InstrumentError(
            f"The device '{device.name}' has no rotary axis '{settings.spindle}'; it has {', '.join(names) or 'none'}"
        )
    return fits


def _add(
    chosen: dict[str, DataItem],
    device: Device,
    key: str,
    types: Sequence[str],
    sub_types: Sequence[str],
    fits: Callable[[DataItem], bool] = _any,
) -> None:
    """Add the data item that fits best, if any; refuse to choose among several."""
    if key in chosen:
        return
    for sub_type in sub_types:
        for kind in types:
            found = [
                item
                for item in device.items.values()
                if item.type == kind and item.sub_type == sub_type and item.category != "CONDITION" and fits(item)
            ]
            found = [item for item in found if item.coordinate_system != "WORK"] or found
            if len(found) > 1:
                names = ", ".join(f"{item.id} ({item.component} {item.component_name})" for item in found)
                raise InstrumentError(
                    f"Several data items report '{key}': {names}. State which one in the settings: "
                    f'items = {{ "{key}" = "{found[0].id}" }}'
                )
            if found:
                chosen[key] = found[0]
                return
