"""A data acquisition unit with SCPI commands (Agilent/Keysight 34970A) on the virtual machine.

The grammar is that of SCPI-1999: long and short forms in upper or lower case, several commands in one line separated by
``;``, where a command without a leading ``:`` continues the path of the previous one. The commands are those of a scan
of temperatures in the 34970A User's Guide, chapter 5 (Remote Interface Reference); the errors those of its chapter 6.
From memory are the numbers 111, 112, 113 and 305, the length of the error queue (10), and the answer of
``SYSTem:CTYPe?``.

Slot 1 has a multiplexer 34901A: channels 101 to 120; a measurement with four wires uses channels n (101 to 110) and n +
10. Its inputs are the sensors of the address, from channel 101 on; the other channels are open.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable
from datetime import timedelta
from functools import partial

from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.thermometer.temperatures import Inputs, Unplugging
from errormotion.instruments.simulators.virtual_world.clock import EPOCH
from errormotion.instruments.transports import Address

IDENTITY = "HEWLETT-PACKARD,34970A,0,13-2-2"
CARD = "HEWLETT-PACKARD,34901A,0,2.3"
CHANNELS = range(101, 121)
QUEUE = 10
LONGEST = 4096
"""Largest number of bytes of a line that are used."""
OVERLOAD = 9.9e37
PROBES: dict[str, tuple[str, ...]] = {
    "TC": tuple("BEJKNRST"),
    "RTD": ("85", "91"),
    "FRTD": ("85", "91"),
    "THER": ("2252", "5000", "10000"),
}
ERRORS = {
    -102: "Syntax error",
    -108: "Parameter not allowed",
    -109: "Missing parameter",
    -113: "Undefined header",
    -178: "Expression data not allowed",
    -222: "Data out of range",
    -224: "Illegal parameter value",
    -230: "Data stale",
    -350: "Error queue overflow",
    111: "Channel list: slot number out of range",
    112: "Channel list: channel number out of range",
    113: "Channel list: empty scan list",
    305: "Not able to perform requested operation",
}
WORDS: dict[str, tuple[str, ...]] = {
    "TEMPerature:TRANsducer:TYPE": ("TC", "RTD", "FRTD", "THER"),
    "TEMPerature:TRANsducer:RTD:TYPE": PROBES["RTD"],
    "TEMPerature:TRANsducer:FRTD:TYPE": PROBES["FRTD"],
    "TEMPerature:TRANsducer:THERmistor:TYPE": PROBES["THER"],
    "TEMPerature:TRANsducer:TCouple:TYPE": PROBES["TC"],
    "TEMPerature:TRANsducer:TCouple:RJUNction:TYPE": ("INT", "EXT", "FIX"),
    "TEMPerature:TRANsducer:TCouple:CHECk": ("OFF", "ON", "0", "1"),
}
"""Settings of channels with a word as value; the first one is the value after a reset."""
NUMBERS: dict[str, tuple[float, float, float]] = {
    "TEMPerature:NPLCycles": (0.02, 200.0, 1.0),
    "TEMPerature:TRANsducer:RTD:RESistance": (49.0, 2100.0, 100.0),
    "TEMPerature:TRANsducer:RTD:RESistance:REFerence": (49.0, 2100.0, 100.0),
    "TEMPerature:TRANsducer:FRTD:RESistance": (49.0, 2100.0, 100.0),
    "TEMPerature:TRANsducer:FRTD:RESistance:REFerence": (49.0, 2100.0, 100.0),
    "ROUTe:CHANnel:DELay": (0.0, 60.0, 0.0),
}
"""Settings of channels with a number as value: lowest, highest, and value after a reset."""
Command = tuple[Callable[[list[str]], str | None], int, int]
"""Function of the parameters, and their smallest and largest number."""
CLOSING = 0.017
"""Time from the start of a scan to a reading, s."""
_FIELDS = ("ALARm", "CHANnel", "TIME", "UNIT")


class _RefusedError(Exception):
    """An error for the error queue, with its number."""


class SimulatedScpiUnit(SimulatedDevice):
    """A unit whose inputs are temperature sensors of the machine.

    Further parameters of the address: ``sensors``, ``open``, ``noise`` and ``unplugged_for`` (see
    `simulators.thermometer.temperatures`).
    """

    faults: tuple[str, ...] = ("silence", "split", "garbage", "out_of_range", "drop", "disconnect", "late", "unplugged")

    def __init__(self, address: Address) -> None:
        self._unplugging = Unplugging(address)
        self._errors: deque[int] = deque()
        self._reset()
        super().__init__(address, line_end=b"\n", default_name="thermometer")
        try:
            self._inputs = Inputs(self.world.machine, address)
        except BaseException:
            self.close()
            raise

    def answer(self, request: bytes) -> bytes:
        """Return the answers to one line, separated by ``;``; empty without a query."""
        answers: list[str] = []
        path = ""
        for unit in _units(request[:LONGEST].decode("ascii", errors="replace").strip()):
            try:
                header, parameters = _split(unit)
                if not header.startswith(("*", ":")):
                    header = f"{path}:{header}" if path else header
                full = header.lstrip(":")
                if not header.startswith("*"):
                    path = full.rpartition(":")[0]
                result = self._execute(full, parameters)
            except _RefusedError as refusal:
                self._queue(int(str(refusal)))
                break
            if result is not None:
                answers.append(result)
        return (";".join(answers) + "\r\n").encode() if answers else b""

    def reply(self, data: bytes) -> None:
        """Send an answer, if there is one."""
        if data:
            super().reply(data)

    def _on_data(self, data: bytes) -> None:
        if self._unplugging.keeps_from(self._answers, self._server):
            return
        super()._on_data(data)

    # ------------------------------------------------------------------ state

    def _reset(self) -> None:
        self._probe: dict[int, tuple[str, str]] = {}
        self._unit: dict[int, str] = {}
        self._scan: list[int] = []
        self._set_to: dict[tuple[str, int], str] = {}
        self._fields = dict.fromkeys(_FIELDS, False)
        self._absolute = False
        self._scanned_at = 0.0
        self._readings: list[tuple[int, float]] = []
        self._values = {"TRIGger:SOURce": "IMM", "TRIGger:COUNt": "+1.00000000E+00", "TRIGger:TIMer": "+1.0E+01"}

    def _queue(self, number: int) -> None:
        if len(self._errors) == QUEUE:
            self._errors[-1] = -350
        else:
            self._errors.append(number)

    # ------------------------------------------------------------------ commands

    def _execute(self, header: str, parameters: list[str]) -> str | None:
        for form, (function, least, most) in self._commands().items():
            if _fits(header, form):
                if len(parameters) < least:
                    raise _RefusedError(-109)
                if len(parameters) > most:
                    raise _RefusedError(-108)
                return function(parameters)
        raise _RefusedError(-113)

    def _commands(self) -> dict[str, Command]:
        """Return the commands: header, with the short form in capitals, to function and numbers of parameters."""
        commands: dict[str, Command] = {
            "*IDN?": (lambda _: IDENTITY, 0, 0),
            "*RST": (self._restart, 0, 0),
            "*CLS": (self._clear, 0, 0),
            "*OPC?": (lambda _: "1", 0, 0),
            "*OPC": (_nothing, 0, 0),
            "*WAI": (_nothing, 0, 0),
            "*TST?": (lambda _: "+0", 0, 0),
            "*ESR?": (lambda _: "+0", 0, 0),
            "*STB?": (lambda _: "+0", 0, 0),
            "SYSTem:ERRor?": (lambda _: self._error(), 0, 0),
            "SYSTem:ERRor:NEXT?": (lambda _: self._error(), 0, 0),
            "SYSTem:VERSion?": (lambda _: "1994.0", 0, 0),
            "SYSTem:CTYPe?": (self._card, 1, 1),
            **{f"SYSTem:{name}": (_nothing, 0, 0) for name in ("REMote", "LOCal", "RWLock")},
            "CONFigure:TEMPerature": (self._configure, 3, 5),
            "CONFigure?": (self._configured, 0, 1),
            "MEASure:TEMPerature?": (self._measure, 3, 5),
            "ROUTe:SCAN": (self._set_scan, 1, 1),
            "ROUTe:SCAN?": (lambda _: _block(f"(@{','.join(map(str, self._scan))})"), 0, 0),
            "ROUTe:SCAN:SIZE?": (lambda _: f"+{len(self._scan)}", 0, 0),
            "UNIT:TEMPerature": (self._set_unit, 1, 2),
            "UNIT:TEMPerature?": (self._get_unit, 0, 1),
            "INITiate": (self._initiate, 0, 0),
            "FETCh?": (lambda _: self._fetch(), 0, 0),
            "READ?": (self._read, 0, 0),
            "ABORt": (_nothing, 0, 0),
            "DATA:POINts?": (lambda _: f"+{len(self._readings)}", 0, 0),
        }
        for name in (*WORDS, *NUMBERS):
            commands[name] = (partial(self._set, name), 1, 2)
            commands[f"{name}?"] = (partial(self._get, name), 0, 1)
        for name in _FIELDS:
            commands[f"FORMat:READing:{name}"] = (partial(self._set_field, name), 1, 1)
            commands[f"FORMat:READing:{name}?"] = (partial(self._get_field, name), 0, 0)
        commands["FORMat:READing:TIME:TYPE"] = (self._set_time_type, 1, 1)
        commands["FORMat:READing:TIME:TYPE?"] = (lambda _: "ABS" if self._absolute else "REL", 0, 0)
        for name in self._values:
            commands[name] = (partial(self._set_trigger, name), 1, 1)
            commands[f"{name}?"] = (partial(self._get_trigger, name), 0, 0)
        return commands

    def _restart(self, _: list[str]) -> None:
        self._reset()

    def _clear(self, _: list[str]) -> None:
        self._errors.clear()

    def _error(self) -> str:
        if not self._errors:
            return '+0,"No error"'
        number = self._errors.popleft()
        return f'{number:+d},"{ERRORS[number]}"'

    def _card(self, parameters: list[str]) -> str:
        if parameters[0] not in ("100", "200", "300"):
            raise _RefusedError(-222)
        return CARD if parameters[0] == "100" else "HEWLETT-PACKARD,0,0,0"

    def _configure(self, parameters: list[str]) -> None:
        """Set probe and type of channels, which become the scan list."""
        channels = _channels(parameters[-1])
        probe = next((name for name in ("TCouple", "RTD", "FRTD", "THERmistor") if _fits(parameters[0], name)), "")
        short = {"TCouple": "TC", "THERmistor": "THER"}.get(probe, probe)
        kinds = PROBES.get(short)
        if kinds is None or not (parameters[1].upper() in kinds or _fits(parameters[1], "DEFault")):
            raise _RefusedError(-224)
        if short == "FRTD" and any(channel % 100 > 10 for channel in channels):
            raise _RefusedError(305)
        self._probe |= dict.fromkeys(channels, (short, parameters[1].upper()))
        self._unit |= dict.fromkeys(channels, "C")
        self._scan, self._readings = channels, []

    def _configured(self, parameters: list[str]) -> str:
        channels = _channels(parameters[0]) if parameters else self._scan
        return ",".join(f'"TEMP {",".join(self._probe.get(channel, ("TC", "J")))}"' for channel in channels)

    def _measure(self, parameters: list[str]) -> str:
        self._configure(parameters)
        return self._read([])

    def _set_scan(self, parameters: list[str]) -> None:
        self._scan, self._readings = _channels(parameters[0], empty=True), []

    def _set_unit(self, parameters: list[str]) -> None:
        unit = parameters[0].upper()
        if unit not in ("C", "F", "K"):
            raise _RefusedError(-224)
        channels = _channels(parameters[1]) if len(parameters) > 1 else list(CHANNELS)
        self._unit |= dict.fromkeys(channels, unit)

    def _get_unit(self, parameters: list[str]) -> str:
        channels = _channels(parameters[0]) if parameters else self._scan or [CHANNELS[0]]
        return ",".join(self._unit.get(channel, "C") for channel in channels)

    def _set(self, name: str, parameters: list[str]) -> None:
        channels = _channels(parameters[1]) if len(parameters) > 1 else list(CHANNELS)
        value = parameters[0].upper()
        if name in WORDS and value not in WORDS[name]:
            raise _RefusedError(-224)
        if name in NUMBERS:
            low, high, usual = NUMBERS[name]
            number = {"MIN": low, "MAX": high, "DEF": usual}.get(value)
            number = _number(value) if number is None else number
            if not low <= number <= high:
                raise _RefusedError(-222)
            value = f"{number:+.8E}"
        self._set_to |= {(name, channel): value for channel in channels}

    def _get(self, name: str, parameters: list[str]) -> str:
        channels = _channels(parameters[0]) if parameters else self._scan or [CHANNELS[0]]
        usual = WORDS[name][0] if name in WORDS else f"{NUMBERS[name][2]:+.8E}"
        return ",".join(self._set_to.get((name, channel), usual) for channel in channels)

    def _set_field(self, name: str, parameters: list[str]) -> None:
        value = parameters[0].upper()
        if value not in ("ON", "OFF", "0", "1"):
            raise _RefusedError(-224)
        self._fields[name] = value in ("ON", "1")

    def _set_time_type(self, parameters: list[str]) -> None:
        kind = next((kind for kind in ("ABSolute", "RELative") if _fits(parameters[0], kind)), "")
        if not kind:
            raise _RefusedError(-224)
        self._absolute = kind == "ABSolute"

    def _get_field(self, name: str, _: list[str]) -> str:
        return str(int(self._fields[name]))

    def _set_trigger(self, name: str, parameters: list[str]) -> None:
        self._values[name] = parameters[0].upper()

    def _get_trigger(self, name: str, _: list[str]) -> str:
        return self._values[name]

    def _initiate(self, _: list[str]) -> None:
        if not self._scan:
            raise _RefusedError(113)
        self._readings = self._scan_inputs()

    def _fetch(self) -> str:
        if not self._readings:
            raise _RefusedError(-230)
        return ",".join(self._format(channel, value) for channel, value in self._readings)

    def _read(self, _: list[str]) -> str:
        self._initiate([])
        return self._fetch()

    # ------------------------------------------------------------------ readings

    def _scan_inputs(self) -> list[tuple[int, float]]:
        self._scanned_at = self.world.time
        temperatures = self._inputs.temperatures(self.world.time, self._rng)
        far = self.fault.hits("out_of_range", self._answers)
        found = []
        for channel in self._scan:
            i = channel - CHANNELS[0]
            broken = far or i >= len(temperatures) or i in self._inputs.open
            found.append((channel, OVERLOAD if broken else _in_unit(temperatures[i], self._unit.get(channel, "C"))))
        return found

    def _format(self, channel: int, value: float) -> str:
        parts = [f"{value:+.8E}"]
        if self._fields["UNIT"]:
            parts[0] += f" {self._unit.get(channel, 'C')}"
        if self._fields["TIME"]:
            parts.append(_absolute_time(self._scanned_at + CLOSING) if self._absolute else f"{CLOSING:012.3f}")
        if self._fields["CHANnel"]:
            parts.append(str(channel))
        if self._fields["ALARm"]:
            parts.append("0")
        return ",".join(parts)


def _absolute_time(seconds: float) -> str:
    """Return a time of the world, s, as date and time of day: ``1997,11,21,15,30,23.000``."""
    when = EPOCH + timedelta(milliseconds=round(1e3 * seconds))
    return f"{when:%Y,%m,%d,%H,%M,%S}.{when.microsecond // 1000:03d}"


def _nothing(_: list[str]) -> None:
    """Execute a command without effect here."""


def _units(line: str) -> list[str]:
    """Return the commands of a line, which ``;`` separates outside quotes and brackets."""
    return [unit.strip() for unit in re.findall(r"(?:\"[^\"]*\"|\([^)]*\)|[^;])+", line) if unit.strip()]


def _split(unit: str) -> tuple[str, list[str]]:
    header, _, rest = unit.partition(" ")
    parameters = re.findall(r"\([^)]*\)|[^,\s][^,]*", rest.strip())
    if rest.count("(") != rest.count(")"):
        raise _RefusedError(-102)
    return header, [parameter.strip() for parameter in parameters]


def _fits(header: str, form: str) -> bool:
    """Whether a header is the long or the short form of a command, part by part; ``SENSe`` may be omitted."""
    given, parts = header.upper().split(":"), form.split(":")
    if given[0] in ("SENS", "SENSE"):
        given = given[1:]
    if len(given) != len(parts):
        return False
    return all(
        word in (part.upper(), "".join(letter for letter in part if not letter.islower()))
        for word, part in zip(given, parts, strict=True)
    )


def _channels(text: str, *, empty: bool = False) -> list[int]:
    """Return the channels of a list such as ``(@101,103:105)``."""
    match = re.fullmatch(r"\(@([0-9:,\s]*)\)", text)
    if match is None:
        raise _RefusedError(-102)
    channels: list[int] = []
    for part in filter(None, (piece.strip() for piece in match[1].split(","))):
        first, colon, last = part.partition(":")
        if not first.isdigit() or (colon and not last.isdigit()) or len(part) > 7:
            raise _RefusedError(-102)
        channels += range(int(first), int(last if colon else first) + 1)
    if not channels and not empty:
        raise _RefusedError(113)
    if any(channel // 100 != 1 for channel in channels):
        raise _RefusedError(111)
    if any(channel not in CHANNELS for channel in channels):
        raise _RefusedError(112)
    return sorted(set(channels))


def _block(text: str) -> str:
    """Return a text as a definite-length block, as in the answer to the query of the scan list."""
    return f"#2{len(text):02d}{text}" if len(text) < 100 else f"#3{len(text):03d}{text}"


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise _RefusedError(-102) from None


def _in_unit(celsius: float, unit: str) -> float:
    return {"C": celsius, "F": celsius * 1.8 + 32, "K": celsius + 273.15}[unit]
