"""Rate of a stream of five channels over real sockets, from the simulated sensors to the caller.

    python benchmarks/instruments_stream.py [SECONDS]

Two runs: at the highest rate of real sensors, without loss, and as fast as this computer can. Simulation, encoding,
sockets and decoding all run in this process.
"""

from __future__ import annotations

import os
import sys
import time

from rich.console import Console
from rich.table import Table

from errormotion.instruments.spindle_frame.five_sensor_frame import FiveSensorFrame, FrameSettings
from errormotion.instruments.spindle_frame.settings import CHANNELS
from errormotion.twin import Event

RATE = 49.14e3


def stream(address: str, rate: float, samples: int) -> tuple[float, float, int, int]:
    """Return wall and processor time (s), lost samples, and NaN values of a stream."""
    from errormotion.instruments.simulators import world

    lost = invalid = 0
    with FiveSensorFrame(address, FrameSettings(rate=rate)) as frame:
        frame.read()  # everything compiled
        world("cframe", 1).start([Event(0.0, spindle_speed=15000.0)])
        wall, processor = time.perf_counter(), sum(os.times()[:2])
        for block in frame.stream():
            lost += block.dropped
            invalid += sum(block.invalid.values())
            if block.first + block.values.shape[1] >= samples:
                break
        return time.perf_counter() - wall, sum(os.times()[:2]) - processor, lost, invalid


def main() -> int:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    table = Table(title=f"{len(CHANNELS)} channels with counter, rates a channel, {os.cpu_count()} cores")
    for column in ("", "sensors at", "samples each", "wall", "reached", "CPU", "lost", "no value"):
        table.add_column(column, justify="right")
    failed = False
    for name, address, rate, samples in (
        ("real time", "sim://cframe?seed=1&pace=1", RATE, round(seconds * RATE)),
        ("free, slow sensors", "sim://cframe?seed=1", 1.5e3, 6240 * 1500),
        ("free", "sim://cframe?seed=1", RATE, round(100 * RATE)),
    ):
        wall, processor, lost, invalid = stream(address, rate, samples)
        failed = failed or bool(lost or invalid)
        table.add_row(
            name,
            f"{rate / 1e3:g} kHz",
            f"{samples}",
            f"{wall:.2f} s",
            f"{samples / wall / 1e3:.1f} kHz",
            f"{processor / wall * 100:.0f} %",
            str(lost),
            str(invalid),
        )
    Console().print(table)
    if failed:
        print("Samples were lost: this computer is too slow for this rate at present.")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
