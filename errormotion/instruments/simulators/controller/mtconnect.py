"""An MTConnect agent on the virtual machine: a ring buffer of observations behind HTTP.

Beyond the menu of `faults` it offers ``overrun`` (the buffer is overwritten before a request for observations: the
agent refuses), ``jump`` (the same, but the agent goes on at its first observation without a word), ``restart`` (a
new instance, its numbers from 1), ``alarm`` (a fault condition) and ``unavailable`` (the machine is off). ``fault_at``
counts requests; ``overrun``, ``jump`` and ``restart`` happen once.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from errormotion.instruments.simulators.device import DEFAULT_MACHINE
from errormotion.instruments.simulators.faults import parse_fault, stray_bytes
from errormotion.instruments.simulators.virtual_world.world import world
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.http.serving import HttpServer

EPOCH = datetime(2025, 1, 1, tzinfo=UTC)
"""What the agent's clock shows at the world's time 0."""
BUFFER = 1024
FIRST_INSTANCE = 1735689600
BOUNDARY = "errormotionPart"
_MM, _PERCENT = 1e3, 1e2
_MODES = {"automatic": "AUTOMATIC", "mdi": "MANUAL_DATA_INPUT", "manual": "MANUAL", "": "UNAVAILABLE"}

#: id: (element, type, subtype, category, units) of the data items, by component
ITEMS: Mapping[tuple[str, str, str], Mapping[str, tuple[str, str, str, str, str]]] = {
    ("Device", "vm", "VM"): {"avail": ("Availability", "AVAILABILITY", "", "EVENT", "")},
    **{
        ("Linear", f"axis{name}", name): {
            f"{name}act": ("Position", "POSITION", "ACTUAL", "SAMPLE", "MILLIMETER"),
            f"{name}com": ("Position", "POSITION", "COMMANDED", "SAMPLE", "MILLIMETER"),
        }
        for name in "XYZ"
    },
    ("Rotary", "axisS", "S"): {
        "Srpm": ("RotaryVelocity", "ROTARY_VELOCITY", "ACTUAL", "SAMPLE", "REVOLUTION/MINUTE"),
        "Sload": ("Load", "LOAD", "", "SAMPLE", "PERCENT"),
    },
    ("Controller", "cont", "controller"): {
        "estop": ("EmergencyStop", "EMERGENCY_STOP", "", "EVENT", ""),
        "system": ("", "SYSTEM", "", "CONDITION", ""),
    },
    ("Path", "path", "path"): {
        "mode": ("ControllerMode", "CONTROLLER_MODE", "", "EVENT", ""),
        "exec": ("Execution", "EXECUTION", "", "EVENT", ""),
        "pgm": ("Program", "PROGRAM", "", "EVENT", ""),
        "feed": ("PathFeedrate", "PATH_FEEDRATE", "ACTUAL", "SAMPLE", "MILLIMETER/SECOND"),
    },
}
_ELEMENTS = {key: (item, component) for component, items in ITEMS.items() for key, item in items.items()}
Seen = tuple[int, str, str, str]  # sequence, id, time, value


class SimulatedAgent:
    """An agent whose only device is the machine.

    Further parameters of the address: ``buffer`` (observations that are kept, 1024), ``version`` (1.3).
    """

    faults = (
        *("silence", "split", "garbage", "drop", "disconnect"),
        *("overrun", "jump", "restart", "alarm", "unavailable"),
    )

    def __init__(self, address: Address) -> None:
        self.fault = parse_fault(address, self.faults)
        seed = int(address.number("seed", 0))
        self._rng = np.random.default_rng([abs(seed), *b"mtconnect"])
        self._version = address.params.get("version", "1.3")
        self._buffer: deque[Seen] = deque(maxlen=max(1, int(address.number("buffer", BUFFER))))
        self._instance, self._next = FIRST_INSTANCE, 1
        self._latest: dict[str, Seen] = {}
        self._requests = 0
        self._lock = threading.Lock()
        self.world = world(address.host or DEFAULT_MACHINE, seed, warm=bool(address.number("warm", 1)))
        self.world.attach(self, address.number("pace", 0.0) or None)
        try:
            self._server = HttpServer(address.path or "mtconnect", self._respond)
        except BaseException:
            self.world.detach(self)
            raise
        self.url = self._server.url

    def close(self) -> None:
        """End the agent; with the last device of its world the world ends."""
        self._server.close()
        self.world.detach(self)

    def report_delivered(self, samples: int) -> None:
        """Take no note: an agent follows the world's clock and never drives it."""

    # ------------------------------------------------------------------ what is observed

    def _observe(self) -> None:
        """Note every data item that has changed."""
        time = (EPOCH + timedelta(seconds=self.world.time)).isoformat(timespec="microseconds").replace("+00:00", "Z")
        for key, value in self._values().items():
            if key not in self._latest or self._latest[key][3] != value:
                self._note(key, time, value)

    def _note(self, key: str, time: str, value: str) -> None:
        seen = (self._next, key, time, value)
        self._buffer.append(seen)
        self._latest[key] = seen
        self._next += 1

    def _values(self) -> dict[str, str]:
        if self.fault.kind == "unavailable" and self._requests > self.fault.at:
            return dict.fromkeys(_ELEMENTS, "UNAVAILABLE")
        shown = self.world.commanded()
        alarms = list(shown["alarms"])
        if self.fault.kind == "alarm" and self._requests > self.fault.at:
            alarms.append("the machine is in alarm")
        values = {"avail": "AVAILABLE", "estop": "TRIGGERED" if shown["estop"] else "ARMED"}
        for i, name in enumerate("XYZ"):
            values[f"{name}act"] = f"{shown['position'][i] * _MM:.4f}"
            values[f"{name}com"] = f"{shown['commanded_position'][i] * _MM:.4f}"
        return values | {
            "Srpm": f"{shown['spindle_speed']:.1f}",
            "Sload": f"{shown['spindle_load'] * _PERCENT:.2f}",
            "system": f"Fault,1104,{'; '.join(alarms)}" if alarms else "Normal,,",
            "mode": _MODES[shown["mode"]],
            "exec": "ACTIVE" if shown["running"] or shown["stepping"] else "READY",
            "pgm": shown["program"] or "UNAVAILABLE",
            "feed": f"{shown['feed'] * _MM:.4f}",
        }

    # ------------------------------------------------------------------ HTTP

    def _respond(self, path: str, query: Mapping[str, str]) -> Iterator[bytes] | None:
        with self._lock:
            number, fault = self._requests, self.fault
            self._requests += 1
            if fault.kind == "disconnect" and number >= fault.at:
                return None
            if (fault.kind == "silence" and number >= fault.at) or fault.hits("drop", number):
                return iter(())
            self._befall(path, number)
            self._observe()
            if path.endswith("/sample") and "interval" in query:
                return self._stream(dict(query))
            body = self._document(path, query)
        head = f"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-Length: {len(body)}\r\n\r\n".encode()
        stray = stray_bytes(self._rng) if fault.hits("garbage", number) else b""
        return fault.pieces(stray + head + body)

    def _befall(self, path: str, number: int) -> None:
        """Let happen what is due at this request."""
        if self.fault.kind not in ("overrun", "jump", "restart") or not path.endswith("/sample"):
            return
        if number < self.fault.at or self._instance != FIRST_INSTANCE or self._befallen:
            return
        self._befallen = True
        if self.fault.kind == "restart":
            self._instance, self._next = self._instance + 1, 1
            self._buffer.clear()
            self._latest.clear()
            return
        time = next(iter(self._latest.values()))[2] if self._latest else EPOCH.isoformat()
        for k in range(2 * (self._buffer.maxlen or 0)):
            self._note("Sload", time, f"{k % 100}")

    _befallen = False

    def _stream(self, query: dict[str, str]) -> Iterator[bytes]:
        yield (
            "HTTP/1.1 200 OK\r\nConnection: close\r\n"
            f"Content-Type: multipart/x-mixed-replace;boundary={BOUNDARY}\r\nTransfer-Encoding: chunked\r\n\r\n"
        ).encode()
        pause = max(float(query["interval"]) / 1e3, 1e-3)
        while True:
            with self._lock:
                number = self._requests
                self._requests += 1
                if self.fault.kind == "disconnect" and number >= self.fault.at:
                    return
                silent = self.fault.kind == "silence" and number >= self.fault.at
                self._befall("/sample", number)
                self._observe()
                body = b"" if silent else self._document("/sample", query)
                query["from"] = str(max(self._next_of(query), int(query.get("from", 1))))
            if not silent:
                part = f"--{BOUNDARY}\r\nContent-type: text/xml\r\nContent-length: {len(body)}\r\n\r\n".encode()
                part += body + b"\r\n"
                yield from self.fault.pieces(f"{len(part):x}\r\n".encode() + part + b"\r\n")
            if b"<MTConnectError" in body:  # the stream ends after an overrun
                yield b"0\r\n\r\n"
                return
            if self._server.ended.wait(pause):
                return

    # ------------------------------------------------------------------ documents

    def _document(self, path: str, query: Mapping[str, str]) -> bytes:
        what = path.rpartition("/")[2]
        if what == "probe":
            text = self._devices()
        elif what == "current":
            text = self._streams(self._latest.values(), self._next)
        elif what == "sample":
            text = self._sample(query)
        else:
            text = self._error("UNSUPPORTED", f"unknown path '{path}'")
        return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'.encode()

    @property
    def _first(self) -> int:
        return self._buffer[0][0] if self._buffer else self._next

    def _range(self, query: Mapping[str, str]) -> tuple[int, int]:
        return int(query.get("from", self._first)), int(query.get("count", 100))

    def _next_of(self, query: Mapping[str, str]) -> int:
        """Return the number that follows an answer to a request."""
        begin, count = self._range(query)
        return min(self._next, max(begin, self._first) + count)

    def _sample(self, query: Mapping[str, str]) -> str:
        try:
            begin, count = self._range(query)
        except ValueError:
            return self._error("INVALID_REQUEST", "from and count are numbers")
        if count < 1 or not (self._first <= begin or self.fault.kind == "jump") or begin > self._next:
            return self._error(
                "OUT_OF_RANGE", f"expected 'from' from {self._first} to {self._next}, and 'count' above 0"
            )
        end = self._next_of(query)
        return self._streams((seen for seen in self._buffer if begin <= seen[0] < end), end)

    def _header(self, sequences: str = "") -> str:
        created = (EPOCH + timedelta(seconds=self.world.time)).isoformat(timespec="microseconds")
        return (
            f'<Header creationTime="{created.replace("+00:00", "Z")}" sender="virtual" instanceId="{self._instance}" '
            f'version="{self._version}" bufferSize="{self._buffer.maxlen}" {sequences}/>'
        )

    def _framed(self, kind: str, content: str, sequences: str = "") -> str:
        space = f"urn:mtconnect.org:{kind}:{self._version}"
        return f'<{kind} xmlns="{space}">{self._header(sequences)}{content}</{kind}>'

    def _error(self, code: str, text: str) -> str:
        return self._framed("MTConnectError", f'<Errors><Error errorCode="{code}">{escape(text)}</Error></Errors>')

    def _devices(self) -> str:
        device = self._items(("Device", "vm", "VM"))
        axes = "".join(self._component(key) for key in ITEMS if key[0] in ("Linear", "Rotary"))
        path = f"<Components>{self._component(('Path', 'path', 'path'))}</Components>"
        controller = self._component(("Controller", "cont", "controller"), path)
        components = f'<Axes id="axes" name="base"><Components>{axes}</Components></Axes>{controller}'
        name = quoteattr(self.world.name)
        return self._framed(
            "MTConnectDevices",
            f'<Devices><Device id="vm" name={name} uuid="errormotion-{self.world.seed}">'
            f'<Description manufacturer="errormotion" model={name} serialNumber="seed {self.world.seed}"/>'
            f"{device}<Components>{components}</Components></Device></Devices>",
        )

    def _component(self, key: tuple[str, str, str], inside: str = "") -> str:
        kind, component_id, name = key
        return f'<{kind} id="{component_id}" name="{name}">{self._items(key)}{inside}</{kind}>'

    @staticmethod
    def _items(key: tuple[str, str, str]) -> str:
        items = []
        for item_id, (_, kind, sub_type, category, units) in ITEMS[key].items():
            more = (f' subType="{sub_type}"' if sub_type else "") + (f' units="{units}"' if units else "")
            items.append(f'<DataItem category="{category}" id="{item_id}" type="{kind}"{more}/>')
        return f"<DataItems>{''.join(items)}</DataItems>"

    def _streams(self, observations: Any, following: int) -> str:
        by_component: dict[tuple[str, str, str], dict[str, list[str]]] = {}
        for seen in observations:
            (_, _, _, category, _), component = _ELEMENTS[seen[1]]
            groups = by_component.setdefault(component, {"SAMPLE": [], "EVENT": [], "CONDITION": []})
            groups[category].append(_element(seen))
        wrapped = {"SAMPLE": "Samples", "EVENT": "Events", "CONDITION": "Condition"}
        components = "".join(
            f'<ComponentStream component="{kind}" name="{name}" componentId="{component_id}">'
            + "".join(f"<{wrapped[each]}>{''.join(texts)}</{wrapped[each]}>" for each, texts in groups.items() if texts)
            + "</ComponentStream>"
            for (kind, component_id, name), groups in by_component.items()
        )
        return self._framed(
            "MTConnectStreams",
            f'<Streams><DeviceStream name="{self.world.name}" uuid="errormotion-{self.world.seed}">{components}'
            "</DeviceStream></Streams>",
            f'firstSequence="{self._first}" lastSequence="{self._next - 1}" nextSequence="{following}" ',
        )


def _element(seen: Seen) -> str:
    """Return one observation as XML."""
    sequence, item_id, time, value = seen
    element, kind, sub_type, category, _ = _ELEMENTS[item_id][0]
    attributes = f'dataItemId="{item_id}" timestamp="{time}" sequence="{sequence}"'
    if category == "CONDITION":
        level, _, rest = value.partition(",")
        code, _, text = rest.partition(",")
        element = "Unavailable" if value == "UNAVAILABLE" else level
        native = f' nativeCode="{code}"' if code else ""
        return f'<{element} {attributes} type="{kind}"{native}>{escape(text)}</{element}>'
    sub = f' subType="{sub_type}"' if sub_type else ""
    return f"<{element} {attributes}{sub}>{escape(value)}</{element}>"
