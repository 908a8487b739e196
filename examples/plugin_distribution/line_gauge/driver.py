"""Driver of the LG7; `codec` describes its lines."""

import math
import time
from collections.abc import Iterator

import numpy as np

from errormotion.errors import ProtocolError
from errormotion.instruments.driver import Driver
from errormotion.plugins import Identity, InstrumentInfo, Samples
from line_gauge.codec import END, LONGEST, RATE, identity_of, sample_of, text_of, with_check
from line_gauge.settings import LineGaugeSettings


class LineGauge(Driver):
    summary = "LG7 line gauge, lines of ASCII on a serial line or TCP"
    simulator = "line_gauge.simulator:SimulatedLineGauge"
    info = InstrumentInfo("line_gauge", "point_lds", summary, "simulated_only", simulator=simulator)
    Settings = LineGaugeSettings
    measuring_range, mid_range = (0.0, 2e-3), 1e-3  # m

    def identify(self) -> Identity:
        (parts,) = self._ask("ID", 1, identity_of)
        return Identity("Example Instruments", *parts, simulated=self.transport.simulated)

    def read(self) -> float:
        return float(next(self.stream(block=1)).values[0, -1])

    def stream(self, block: int = 200) -> Iterator[Samples]:
        start = due = -1
        while True:
            found = dict(self._ask(f"GET {block}", block, sample_of))
            start, due = (start, due) if start >= 0 else (min(found), min(found))
            if not due <= min(found) <= max(found) <= due + 1000 * block:
                raise ProtocolError(f"The gauge at {self.address} sent no samples from {due} on after 'GET {block}'")
            values = np.array([[found.get(counter, math.nan) for counter in range(due, max(found) + 1)]])
            invalid = {"out of range": sum(math.isnan(value) for value in found.values())}
            yield Samples(values, due - start, RATE, time.monotonic(), values.size - len(found), invalid)
            due += values.size

    def _ask(self, request: str, most: int, decode) -> list:
        texts: list[str] = []
        with self.exchange() as line:  # after an error, late answers are discarded first
            line.write(with_check(request))
            while texts[-1:] != [END] and len(texts) <= most:
                texts.append(text_of(line.read_until(b"\r", limit=LONGEST)))
            if texts.pop() != END or not texts:
                raise ProtocolError(
                    f"Expected 1 to {most} lines and {END!r} after '{request}'; {self.address} sent {texts}"
                )
            return [decode(text) for text in texts]

    def resynchronise(self) -> None:  # any later answer ends before the name of the gauge
        super().resynchronise()
        self.transport.write(with_check("ID"))
        self.transport.read_until(b"LG7,", limit=1 << 20)
        self.transport.read_until(with_check(END), limit=LONGEST)
