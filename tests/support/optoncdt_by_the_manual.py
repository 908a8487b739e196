"""An optoNCDT for tests that answers as the manufacturer's manuals print it, and refuses what they do not list.

2300: *optoNCDT 2300 Instruction Manual*, chapters 8, 9 and A 6; 1420: *optoNCDT 1420 Instruction Manual*, chapters 7.5,
8 and A 3. Independent of the driver and of its simulator. The numbers of the errors are examples: no page at hand shows
them.
"""

import re
import threading
import time
from collections.abc import Callable

from errormotion.instruments.transports.loopback.serving import TcpServer

TICK = 0.002
"""Time between two groups of measurements, s; the tests do not depend on it."""

WORD = r"(?:{0})(?: (?:{0}))*"
ADDED = "TEMP|SHUTTER|COUNTER|TIMESTAMP|INTENSITY|STATE"
COMMON = {
    "ECHO": "ON|OFF",
    "MASTERMV": r"NONE|MASTER -?\d+(?:\.\d+)?",
    "OUTHOLD": r"NONE|INFINITE|\d{1,4}",
    "LASERPOW": "FULL|REDUCED|OFF",
    "TRIGGER": "NONE|EDGE|PULSE|SOFTWARE",
    "AVERAGE": r"NONE|(?:MOVING|RECURSIVE|MEDIAN)(?: \d{1,5})?",
}
GRAMMAR = {
    "ILD2300": COMMON
    | {
        "OUTPUT": "NONE|RS422|ETHERNET",
        "MEASRATE": r"1\.5|2\.5|5|10|20|30|49",
        "SYNC": "(?:NONE|SLAVE|MASTER|MASTER_ALT) (?:TERMON|TERMOFF)",
        "OUTSTATISTIC_RS422": f"NONE|{WORD.format('MIN|MAX|PEAK2PEAK')}",
        "OUTDIST_RS422": f"NONE|{WORD.format('DIST1|DIST2')}",
        "TRIGGER": "(?:NONE|EDGE|PULSE|SOFTWARE) (?:TERMON|TERMOFF)",
        "OUTREDUCE": r"\d{1,7}",
        "OUTADD_RS422": f"NONE|{WORD.format(ADDED)}",
    },
    "ILD1420": COMMON
    | {
        "OUTPUT": "NONE|RS422|ANALOG",
        "MEASRATE": r"0\.25|0\.5|1|2|4",
        "OUTREDUCEDEVICE": f"NONE|{WORD.format('RS422|ANALOG')}",
        "OUTADD_RS422": f"NONE|{WORD.format('SHUTTER|COUNTER|TIMESTAMP|INTENSITY|STATE|DIST_RAW')}",
    },
}
COUNTERS = {"ILD2300": "TIMESTAMP|MEASCNT|TRIGCNT", "ILD1420": "TIMESTAMP|MEASCNT"}
DELIVERED = {
    "ECHO": "ON",
    "MASTERMV": "NONE",
    "OUTHOLD": "NONE",
    "LASERPOW": "FULL",
    "TRIGGER": "NONE",
    "AVERAGE": "NONE",
    "SYNC": "NONE TERMOFF",
    "OUTSTATISTIC_RS422": "NONE",
    "OUTDIST_RS422": "DIST1",
    "OUTADD_RS422": "NONE",
    "OUTREDUCEDEVICE": "NONE",
    "OUTREDUCE": "1",
}
INFO = {  # 2300 p. 127, 1420 p. 97
    "ILD2300": "Name: ILD2300\r\nSerial: 10110002\r\nOption: 000\r\nArticle: 4120178\r\n"
    "MAC-Address: 00-0C-12-01-03-04\r\nMeasuring range: {0:.2f}mm\r\nName CalTab: DIFFUSE\r\n"
    "Version: 0003.066.087\r\nImagetype: User\r\n",
    "ILD1420": "Name: ILD1420-{0:.0f}\r\nSerial: 15030002\r\nOption: 000\r\nArticle: 4120212\r\nCable head: Wire\r\n"
    "Measuring range: {0:.2f}mm\r\nVersion: 001.010\r\nHardware-rev: 00\r\nBoot-version: 001.000\r\n",
}


def three_bytes(raw: int, *, first: bool) -> bytes:
    """L, M and H byte of one value: 1420 p. 84."""
    return bytes([raw & 0x3F, 0x40 | raw >> 6 & 0x3F, (0x80 if first else 0xC0) | raw >> 12 & 0x3F])


class Bus:
    """The synchronisation line: its pulses are those of the sensor that is the master."""

    def __init__(self) -> None:
        self.sensors: list[Sensor] = []

    @property
    def pulses(self) -> bool:
        return any(sensor.settings["SYNC"].startswith("MASTER") for sensor in self.sensors)


class Sensor:
    """One sensor on a TCP port; ``values(n)`` is the raw distance at instant n of the bus."""

    def __init__(
        self,
        model: str = "ILD2300",
        *,
        millimetres: float = 2.0,
        bus: Bus | None = None,
        values: Callable[[int], int] = lambda n: 1000 + n % 60000,
        counter_first: bool = False,
        rates: str = "",
        **settings: str,
    ) -> None:
        self.model, self.millimetres, self.values, self.counter_first = model, millimetres, values, counter_first
        self.grammar = GRAMMAR[model] | ({"MEASRATE": rates} if rates else {})
        rate = "2.5" if model == "ILD2300" else "4"
        self.settings = {**DELIVERED, "OUTPUT": "NONE", "MEASRATE": rate}
        if model == "ILD2300":
            self.settings["TRIGGER"] = "NONE TERMOFF"
        self.settings |= settings
        self.received: list[str] = []
        self.late = 0.0
        self.late_for = ""
        self.silent_for = ""
        self.bus = Bus() if bus is None else bus
        self.bus.sensors.append(self)
        self.counter = 0
        self._line = b""
        self.wire = TcpServer(model, self._accept)
        self.wire.start()

    @property
    def url(self) -> str:
        return self.wire.url

    def sample(self, instant: int) -> None:
        """Measure once, where the sensor measures now, and send the values."""
        sync = self.settings["SYNC"].split()[0]
        if sync == "SLAVE" and not self.bus.pulses:
            return
        number, self.counter = self.counter, self.counter + 1
        if self.settings["OUTPUT"] != "RS422":
            return
        named = {"COUNTER": number & 0x3FFFF}
        row = [named.get(name, self.values(instant)) for name in self.layout()]
        self.wire.send(b"".join(three_bytes(raw, first=i == 0) for i, raw in enumerate(row)))

    def layout(self) -> list[str]:
        """Names of the values of one sample, in their sequence."""
        settings = self.settings
        distance = settings["OUTDIST_RS422"].split() if self.model == "ILD2300" else ["DIST1"]
        added = settings["OUTADD_RS422"].split() + settings["OUTSTATISTIC_RS422"].split()
        row = added + distance if self.counter_first else distance + added
        return [name for name in row if name != "NONE"]

    def _accept(self, data: bytes) -> None:
        self._line += data
        while b"\n" in self._line:
            line, self._line = self._line.split(b"\n", 1)
            command = line.strip(b"\r").decode("latin-1")
            self.received.append(command)
            if command == self.silent_for:
                continue
            answer = self._answer(command)
            if command == self.late_for:
                self.late_for = ""
                time.sleep(self.late)  # the answers to later commands follow this one
            self.wire.send(answer)

    def _answer(self, command: str) -> bytes:
        name, _, parameters = command.partition(" ")
        echo = self.settings["ECHO"] == "ON"
        if name == "GETINFO" and not parameters:
            text = ("GETINFO\r\n" if echo else "") + INFO[self.model].format(self.millimetres)
        elif name == "GETOUTINFO_RS422" and not parameters:
            text = f"GETOUTINFO_RS422 {' '.join(self.layout())}\r\n"
        elif name == "RESETCNT" and re.fullmatch(WORD.format(COUNTERS[self.model]), parameters):
            if "MEASCNT" in parameters.split():
                self.counter = 0
            text = f"{command} ok\r\n" if echo else "\r\n"
        elif name in self.grammar and not parameters:
            text = f"{name} {self.settings[name]}\r\n"
        elif name in self.grammar and re.fullmatch(self.grammar[name], parameters):
            self.settings[name] = parameters
            text = f"{command} ok\r\n" if echo else "\r\n"
        else:
            error = "E236 Wrong parameter value" if name in self.grammar else "E210 Unknown command"
            text = (f"{command}\r\n" if echo else "") + f"{error}\r\n"
        return text.encode("latin-1") + b"->"


class Bench:
    """Sensors on one bus, measuring all the time; a context manager."""

    def __init__(self, *sensors: Sensor) -> None:
        self.sensors = sensors
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="optoncdt-by-the-manual")

    def __enter__(self) -> "Bench":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        for sensor in self.sensors:
            sensor.wire.close()
        self._thread.join()

    def _run(self) -> None:
        instant = 0
        while not self._ended.is_set():
            for _ in range(5):
                instant += 1
                for sensor in self.sensors:
                    sensor.sample(instant)
            time.sleep(TICK)
