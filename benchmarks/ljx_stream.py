"""Profiles a second that the LJ-X8000A driver receives on one core, over real sockets.

    python benchmarks/ljx_stream.py [SECONDS]

A device in a separate process sends profiles that were computed before, over loopback. The process of the driver, with
reader thread and caller, is limited to one core, the device to another one if possible. One run is as fast as the
driver receives profiles, and one at 16 000 profiles a second: there the device does not wait, but discards profiles
that are older than half a second, because its memory is finite.
"""

from __future__ import annotations

import multiprocessing
import os
import socket
import sys
import time
from multiprocessing.connection import Connection

import numpy as np
from rich.console import Console
from rich.table import Table

from errormotion.instruments.line_profiler.keyence_ljx import KeyenceLJX, LJXSettings, codec, kernels
from errormotion.instruments.line_profiler.keyence_ljx.codec import INTENSITY, StreamLayout

BATCH = 64
RATE = 16e3
MEMORY = 0.5  # s


def pin(core: int) -> None:
    """Limit this process to one of its available cores."""
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[core % len(cores)]})


def play(ports: Connection, layout: StreamLayout, rate: float) -> None:
    """Simulate the device: answer requests, send profiles at a rate; 0: as fast as they are received."""
    pin(1)
    doors = [socket.create_server(("127.0.0.1", 0)) for _ in range(2)]
    ports.send([door.getsockname()[1] for door in doors])
    commands, data = (door.accept()[0] for door in doors)
    profiles = make_profiles(layout)
    sums = profiles[:, -1] - profiles[:, codec.TRIGGER_WORD]
    while opcode := answer(commands, layout):
        if opcode != codec.START_STREAM:
            continue
        number, began = 0, time.perf_counter()
        commands.setblocking(False)
        while answer(commands, layout) != codec.STOP_STREAM:
            if rate:
                due = int((time.perf_counter() - began) * rate)
                if due < number + BATCH:
                    time.sleep((number + BATCH - due) / rate)
                elif due > number + rate * MEMORY:
                    number = due
            triggers = (number + np.arange(BATCH)).astype(np.uint32)
            profiles[:, codec.TRIGGER_WORD] = profiles[:, codec.ENCODER_WORD] = triggers
            profiles[:, -1] = sums + 2 * triggers
            data.sendall(profiles)
            number += BATCH
        commands.setblocking(True)
        data.sendall(codec.notice(1))


def answer(commands: socket.socket, layout: StreamLayout) -> int | None:
    """Answer the next request and return its opcode; None without request, or after the driver has closed."""
    try:
        frame = commands.recv(64)
    except BlockingIOError:
        return None
    if not frame:
        return None
    opcode = codec.parse_request(frame)[0]
    commands.sendall(codec.reply(codec.layout_data(layout) if opcode == codec.PREPARE_STREAM else bytes(64)))
    return opcode


def make_profiles(layout: StreamLayout) -> np.ndarray:
    """Return a batch of profiles with random heights."""
    rng = np.random.default_rng(1)
    profiles = np.empty((BATCH, layout.words), dtype=np.uint32)
    for words in profiles:
        heights = rng.integers(-20000, 20000, layout.points).astype(np.int32)
        light = rng.integers(0, 1024, layout.points if layout.with_intensity else 0).astype(np.uint16)
        kernels.pack(heights, light, 0, 0, words)
    return profiles


def take(layout: StreamLayout, rate: float, seconds: float) -> tuple[int, float, float, int]:
    """Return profiles, wall and processor time (s), and lost profiles of a stream."""
    here, there = multiprocessing.Pipe()
    device = multiprocessing.get_context("spawn").Process(target=play, args=(there, layout, rate), daemon=True)
    device.start()
    command, stream = here.recv()
    try:
        settings = LJXSettings(rate=RATE, timeout=10.0)
        with KeyenceLJX(f"tcp://127.0.0.1:{command}?stream={stream}", settings) as profiler:
            profiler.read()  # everything compiled
            taken = lost = 0
            wall, processor = time.perf_counter(), time.process_time()
            for block in profiler.stream():
                taken += block.values.shape[1]
                lost += block.dropped
                if time.perf_counter() - wall > seconds:
                    break
            return taken, time.perf_counter() - wall, time.process_time() - processor, lost
    finally:
        device.terminate()
        device.join()


def main() -> int:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 5.0
    pin(0)
    table = Table(title=f"Profiles of {codec.MAX_POINTS} points, driver on one of {os.cpu_count()} cores")
    for column in ("", "sent at", "taken in", "bytes", "heights", "CPU", "CPU a profile", "lost"):
        table.add_column(column, justify="right")
    failed = False
    for name, kind, rate in (
        ("as fast as possible", 0, 0.0),
        ("with intensities", INTENSITY, 0.0),
        ("at the sensor's pace", 0, RATE),
    ):
        layout = StreamLayout(1, kind, codec.MAX_POINTS, 1e-7, -0.02, 12.5e-6)
        taken, wall, processor, lost = take(layout, rate, seconds)
        failed = failed or bool(lost)
        table.add_row(
            name,
            f"{rate / 1e3:g} kHz" if rate else "any",
            f"{taken / wall / 1e3:.1f} kHz",
            f"{taken * layout.words * 4 / wall / 1e6:.0f} MB/s",
            f"{taken * layout.points / wall / 1e6:.0f} M/s",
            f"{processor / wall * 100:.0f} %",
            f"{processor / taken * 1e6:.1f} us",
            str(lost),
        )
    Console(width=120).print(table)
    bits = 8 * (StreamLayout(1, 0, codec.MAX_POINTS, 1e-7, 0.0, 1e-5).words * 4)
    gigabit = 1e9 * 1448 / 1538 / bits  # data in an Ethernet frame with TCP time stamps, of the bytes on the wire
    print(f"A gigabit line carries {gigabit / 1e3:.1f} kHz of these profiles at most.")
    if failed:
        print("Profiles were lost: this computer is too slow for this rate at present.")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
