"""Driver of the LG7: asked ``GET 3``, it answers three lines ``17,+0.946142*57`` (counter, mm) and then ``.*2E``.

Behind the star stands the sum of all characters before it, in two hexadecimal digits.
"""

import math
import time
from collections.abc import Iterator

import numpy as np

from errormotion.errors import ProtocolError
from errormotion.instruments.driver import Driver
from errormotion.plugins import Identity, InstrumentInfo, Samples

RATE = 1000.0
OUT_OF_RANGE = "------"


def with_check(text: str) -> bytes:
    return f"{text}*{sum(text.encode()) & 0xFF:02X}\r".encode()


class LineGauge(Driver):
    summary = "LG7 line gauge, lines of ASCII on a serial line or TCP"
    simulator = "line_gauge.simulator:SimulatedLineGauge"
    info = InstrumentInfo("line_gauge", "point_lds", summary, "simulated_only", simulator=simulator)
    measuring_range, mid_range = (0.0, 2e-3), 1e-3  # m

    def identify(self) -> Identity:
        model, serial, firmware = self._ask("ID")[0].split(",")
        return Identity("Example Instruments", model, serial, firmware, simulated=self.transport.simulated)

    def read(self) -> float:
        return float(next(self.stream(block=1)).values[0, -1])

    def stream(self, block: int = 200) -> Iterator[Samples]:
        start, due = None, 0
        while True:
            found = {int(counter): text for counter, text in (line.split(",") for line in self._ask(f"GET {block}"))}
            if not found:
                raise ProtocolError(f"The gauge at {self.address} answered 'GET {block}' without a sample")
            start, due = (min(found), min(found)) if start is None else (start, due)
            texts = [found.get(counter) for counter in range(due, max(found) + 1)]
            values = [math.nan if text in (None, OUT_OF_RANGE) else float(text) * 1e-3 for text in texts]
            invalid = {"out of range": texts.count(OUT_OF_RANGE)}
            yield Samples(np.array([values]), due - start, RATE, time.monotonic(), texts.count(None), invalid)
            due += len(texts)

    def _ask(self, request: str) -> list[str]:
        self.transport.write(with_check(request))
        lines: list[str] = []
        while not lines or lines[-1] != ".":
            line = self.transport.read_until(b"\r")
            lines.append(line.partition(b"*")[0].decode(errors="replace"))
            if with_check(lines[-1]) != line:
                raise ProtocolError(f"The gauge at {self.address} sent {line!r}, whose check is wrong; open it again")
        return lines[:-1]
