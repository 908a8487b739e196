"""A simulated gauge that measures the virtual machine at the position of the sensor X1 of the frame."""

from errormotion.instruments.simulators.device import SimulatedDevice
from line_gauge.codec import OUT_OF_RANGE, RATE, with_check


class SimulatedLineGauge(SimulatedDevice):
    faults = ("silence", "split", "garbage", "out_of_range", "drop", "disconnect", "late")

    def __init__(self, address):
        self.counter = 0
        super().__init__(address, line_end=b"\r", default_name="gauge", every=50)
        self.world.machine.distances(0, 1, RATE, channels=["X1"])  # compiles, so that the first answer is not late

    def answer(self, request: bytes) -> bytes:
        match request.partition(b"*")[0].decode(errors="replace").split():
            case ["ID"]:
                lines = [f"LG7,{self.world.seed:04d},1.3"]
            case ["GET", count]:
                lines = self.samples(int(count))
            case _:
                lines = []
        return b"".join(with_check(line) for line in [*lines, "."])

    def samples(self, count: int) -> list[str]:
        first, self.counter = self.counter, self.counter + count
        distances = self.world.machine.distances(first, count, RATE, channels=["X1"])[0]
        lines = []
        for number, distance in enumerate(distances, start=first):
            if self.fault.hits("drop", number):
                continue
            blind = self.fault.hits("out_of_range", number)
            lines.append(f"{number},{OUT_OF_RANGE if blind else format(distance * 1e3, '+.6f')}")
        return lines
