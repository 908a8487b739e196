"""Commands of a capaNCDT 6200: grammar, settings, and answers as text."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

CHANNELS = 4
FULL_SCALE = 0xFFFFFF
SAMPLE_TIMES = (256, 480, 960, 1920, 9600, 16000, 19200, 32000, 38400, 64000, 96000, 192000, 384000)
"""us."""

UNKNOWN_COMMAND = "$UNKNOWN COMMAND"
WRONG_PARAMETER = "$WRONG PARAMETER"
WRONG_PASSWORD = "$WRONG PASSWORD"
TIME_OUT = "$TIMEOUT"
OK = "OK"

ORDER_NUMBER, NAME, VERSION = 2303023, "DT6220", "V1.2a"
FIRMWARE = 8010079
SENSOR_ORDER_NUMBER = 6610051
AVERAGING_NUMBERS = range(2, 9)
LINEARISATION_POINTS = 10
MIN_PORT, MAX_PORT = 1024, 65535

_WHOLE = re.compile(r"\d{1,9}")
_CHANNEL = re.compile(r"([1-4])")
_PAIR = re.compile(r"([1-4]):(\d{1,2})")
_OFFSET = r"[+-][0-9A-F]{1,6}"
_FACTOR = r"[+-]\d\.\d"
_MATH = re.compile(rf"([1-4]):({_OFFSET}),({_FACTOR}),({_FACTOR}),({_FACTOR}),({_FACTOR})")
_BYTE = r"(?:25[0-5]|2[0-4]\d|1?\d?\d)"
_IP = rf"{_BYTE}(?:\.{_BYTE}){{3}}"
_NETWORK = re.compile(rf"1|[01],{_IP},{_IP},{_IP}")


class Refused(Exception):  # noqa: N818 - the controller's answer, not an error of the project
    """A command that the controller refuses; its only argument is the answer."""


@dataclass
class Sensor:
    """The sensor of one channel.

    ``range`` is its measuring range, um; ``beam`` the corresponding beam of the virtual machine.
    """

    beam: str
    range: float
    serial: int


@dataclass(frozen=True)
class MathFunction:
    """Sum of an offset (measuring range: 21 bits) and of the products of channels and factors."""

    offset: int
    factors: tuple[float, ...]

    def __str__(self) -> str:
        factors = ",".join(f"{factor:+.1f}" for factor in self.factors)
        return f"{self.offset:+07X},{factors}"


@dataclass
class ControllerMemory:
    """Settings of the controller as delivered."""

    sample_time: int = 256
    trigger: int = 0
    averaging: int = 0
    averaging_number: int = 2
    linearisation: list[int] = field(default_factory=lambda: [0] * CHANNELS)
    points: dict[tuple[int, int], int] = field(default_factory=dict)
    functions: dict[int, MathFunction] = field(default_factory=dict)
    network: str = "0,169.254.168.150,255.255.0.0,169.254.168.1"
    password: str = ""


class Controller(Protocol):
    """The part of the controller that the commands use; its sensors are numbered from 1 to 4."""

    settings: ControllerMemory
    sensors: Mapping[int, Sensor]
    serial: int
    port: int

    def measure_once(self) -> None:
        """Send one frame if values are not sent continuously."""

    def latest(self, channel: int) -> int:
        """Return the last value of a channel, 1 to 4."""


def answer(controller: Controller, command: str) -> str:
    """Return the answer that follows the echo of a command; the command is without ``$`` and line end."""
    handler = _HANDLERS.get(command[:3])
    if handler is None:
        return UNKNOWN_COMMAND
    try:
        return handler(controller, command[3:])
    except Refused as refused:
        return str(refused)


def statuses(controller: Controller) -> list[int]:
    """Return the status of each channel: 0 absent, 1 present, 2 with a math function."""
    functions = controller.settings.functions
    return [2 if channel in functions else int(channel in controller.sensors) for channel in range(1, CHANNELS + 1)]


def _whole(text: str, least: int, highest: int) -> int:
    if not _WHOLE.fullmatch(text) or not least <= int(text) <= highest:
        raise Refused(WRONG_PARAMETER)
    return int(text)


def _nothing(text: str) -> None:
    if text:
        raise Refused(WRONG_PARAMETER)


def _channel(controller: Controller, text: str) -> int:
    found = _CHANNEL.fullmatch(text)
    if not found or int(text) not in controller.sensors:
        raise Refused(WRONG_PARAMETER)
    return int(text)


def _sample_time(controller: Controller, text: str) -> str:
    settings = controller.settings
    if text == "?":
        return f"{settings.sample_time}{OK}"
    wanted = _whole(text, 1, 999_999_999)
    settings.sample_time = min(SAMPLE_TIMES, key=lambda each: abs(each - wanted))
    return f",{settings.sample_time}{OK}"


def _trigger(controller: Controller, text: str) -> str:
    if text == "?":
        return f"{controller.settings.trigger}{OK}"
    controller.settings.trigger = _whole(text, 0, 3)
    return OK


def _measured(controller: Controller, text: str) -> str:
    _nothing(text)
    controller.measure_once()
    return OK


def _averaging(controller: Controller, text: str) -> str:
    if text == "?":
        return f"{controller.settings.averaging}{OK}"
    controller.settings.averaging = _whole(text, 0, 4)
    return OK


def _averaging_number(controller: Controller, text: str) -> str:
    if text == "?":
        return f"{controller.settings.averaging_number}{OK}"
    controller.settings.averaging_number = _whole(text, AVERAGING_NUMBERS[0], AVERAGING_NUMBERS[-1])
    return OK


def _status_of_channels(controller: Controller, text: str) -> str:
    _nothing(text)
    return ",".join(map(str, statuses(controller))) + OK


def _linearisation(controller: Controller, text: str) -> str:
    kinds = controller.settings.linearisation
    if text == "?":
        return ",".join(map(str, kinds)) + OK
    channel, kind = _pair(controller, text)
    if not 0 <= kind <= 5:
        raise Refused(WRONG_PARAMETER)
    kinds[channel - 1] = kind
    return OK


def _pair(controller: Controller, text: str) -> tuple[int, int]:
    match = _PAIR.fullmatch(text)
    if not match or int(match[1]) not in controller.sensors:
        raise Refused(WRONG_PARAMETER)
    return int(match[1]), int(match[2])


def _point(controller: Controller, text: str) -> tuple[int, int]:
    channel, point = _pair(controller, text)
    if not 1 <= point <= LINEARISATION_POINTS:
        raise Refused(WRONG_PARAMETER)
    return channel, point


def _set_point(controller: Controller, text: str) -> str:
    channel, point = _point(controller, text)
    controller.settings.points[channel, point] = controller.latest(channel) & FULL_SCALE
    return OK


def _get_point(controller: Controller, text: str) -> str:
    channel, point = _point(controller, text)
    stored = controller.settings.points.get((channel, point), point * FULL_SCALE // LINEARISATION_POINTS)
    return f",{stored:06X}{OK}"


def _status(controller: Controller, text: str) -> str:
    _nothing(text)
    settings = controller.settings
    channels = ",".join(map(str, statuses(controller)))
    return (
        f"STI{settings.sample_time};AVT{settings.averaging};AVN{settings.averaging_number};CHS{channels};"
        f"TRG{settings.trigger}{OK}"
    )


def _version(_: Controller, text: str) -> str:
    _nothing(text)
    return f"{NAME};{VERSION};{FIRMWARE}{OK}"


def _set_function(controller: Controller, text: str) -> str:
    match = _MATH.fullmatch(text)
    if not match:
        raise Refused(WRONG_PARAMETER)
    factors = tuple(float(factor) for factor in match.groups()[2:])
    controller.settings.functions[int(match[1])] = MathFunction(int(match[2], 16), factors)
    return f",{OK}"


def _get_function(controller: Controller, text: str) -> str:
    if not _CHANNEL.fullmatch(text):
        raise Refused(WRONG_PARAMETER)
    return f":{controller.settings.functions.get(int(text), MathFunction(0, (0.0,) * CHANNELS))}{OK}"


def _clear_function(controller: Controller, text: str) -> str:
    if not _CHANNEL.fullmatch(text):
        raise Refused(WRONG_PARAMETER)
    controller.settings.functions.pop(int(text), None)
    return OK


def _network(controller: Controller, text: str) -> str:
    if text == "?":
        return f"{controller.settings.network}{OK}"
    if not _NETWORK.fullmatch(text):
        raise Refused(WRONG_PARAMETER)
    controller.settings.network = text
    return OK


def _data_port(controller: Controller, text: str) -> str:
    _nothing(text)
    return f"{controller.port}{OK}"


def _set_data_port(_: Controller, text: str) -> str:
    _whole(text, MIN_PORT, MAX_PORT)
    return OK


def _information_of_channel(controller: Controller, text: str) -> str:
    sensor = controller.sensors[_channel(controller, text)]
    return (
        f":ANO{SENSOR_ORDER_NUMBER},NAMCS{sensor.range / 1000:g},SNO{sensor.serial},OFS0,RNG{sensor.range:g},"
        f"UNT\N{MICRO SIGN}m,DTY1{OK}"
    )


def _information(controller: Controller, text: str) -> str:
    _nothing(text)
    return f"ANO{ORDER_NUMBER},NAM{NAME},SNO{controller.serial},OPT000,VER{VERSION}{OK}"


def _log_in(controller: Controller, text: str) -> str:
    if text != controller.settings.password:
        raise Refused(WRONG_PASSWORD)
    return OK


def _log_out(_: Controller, text: str) -> str:
    _nothing(text)
    return OK


_HANDLERS = {
    "STI": _sample_time,
    "TRG": _trigger,
    "GMD": _measured,
    "AVT": _averaging,
    "AVN": _averaging_number,
    "CHS": _status_of_channels,
    "LIN": _linearisation,
    "SLP": _set_point,
    "GLP": _get_point,
    "STS": _status,
    "VER": _version,
    "SMF": _set_function,
    "GMF": _get_function,
    "CMF": _clear_function,
    "IPS": _network,
    "GDP": _data_port,
    "SDP": _set_data_port,
    "CHI": _information_of_channel,
    "COI": _information,
    "LGI": _log_in,
    "LGO": _log_out,
}
