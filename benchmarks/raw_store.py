"""Raw stores: the cost of a commit during a measurement, and of reading the record, for two lengths of the blocks.

``python -m benchmarks.raw_store [--hours 0.5]``. Five channels at 20 kHz, packed to 16 bits, committed twice a second.
The short blocks are those of the program; the long ones have 2^18 samples, as in stores of earlier versions. Plain
writing of the same bytes with the same number of flushes shows what the disk needs.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np
import xarray as xr

from errormotion.campaign.storage import store as store_module
from errormotion.campaign.storage.store import RawStore
from errormotion.datasets import hash_dataset, load

RATE = 20_000
NEW = RATE // 2
LSB = 3.1e-8  # m
REPEATS = 3


def parts(count: int) -> list[xr.Dataset]:
    """Return half seconds of noise."""
    rng = np.random.default_rng(0)
    made = []
    for _ in range(count):
        steps = np.rint(30_000 + 300 * rng.standard_normal((5, NEW)))
        raw = xr.Dataset({"distance": (("channel", "time"), steps * LSB, {"units": "m"})}, {"channel": list("ABCDE")})
        raw["distance"].encoding = {"dtype": "uint16", "scale_factor": LSB, "add_offset": 0.0, "_FillValue": 65535}
        made.append(raw.assign_attrs(sample_rate=float(RATE)))
    return made


def at(part: xr.Dataset, number: int) -> xr.Dataset:
    """Return a part at its time."""
    return part.assign_attrs(time_start=number * NEW / RATE)


def commits(folder: Path, known: list[xr.Dataset], count: int = 120) -> None:
    """Print the cost of commits."""
    store = RawStore.create(folder / "commits.zarr", at(known[0], 0), "time", 4 * 3600.0)
    wall, used = [], []
    for number in range(count):
        store.append(at(known[number % len(known)], number))
        start, processor = time.perf_counter(), time.process_time()
        store.commit()
        wall.append(time.perf_counter() - start)
        used.append(time.process_time() - processor)
    print(
        f"  blocks of {store.block:6d} samples: commit of {NEW} samples {np.median(wall) * 1e3:5.1f} ms "
        f"(95 %: {np.quantile(wall, 0.95) * 1e3:.1f} ms), processor {np.mean(used) * 1e3:.1f} ms"
    )


def plain(folder: Path, count: int = 60) -> None:
    """Print the time of the same flushes without a store."""
    wall, content = [], os.urandom(NEW * 10)
    for number in range(count):
        start = time.perf_counter()
        for name in ("chunk", "root"):
            with (folder / f"{name}.part").open("wb") as file:
                file.write(content if name == "chunk" else content[:4096])
                file.flush()
                os.fsync(file.fileno())
            (folder / f"{name}.part").replace(folder / f"{name}{number}")
            descriptor = os.open(folder, os.O_RDONLY)
            os.fsync(descriptor)
            os.close(descriptor)
        wall.append(time.perf_counter() - start)
    print(f"  the same bytes and flushes without a store: {np.median(wall) * 1e3:.1f} ms")


def best(work: Callable[[], object]) -> float:
    """Return the shortest of several times, s."""
    found = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        work()
        found.append(time.perf_counter() - start)
    return min(found)


def reading(folder: Path, known: list[xr.Dataset], hours: float) -> None:
    """Print the times of opening, reading and hashing a record."""
    path = folder / "record.zarr"
    store = RawStore.create(path, at(known[0], 0), "time", hours * 3600)
    count = round(hours * 3600 * RATE / NEW)
    for number in range(count):
        store.append(at(known[number % len(known)], number))
        if number % 500 == 499:
            store.commit()
    store.close()
    size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    raw = load(path)
    step = 60 * RATE

    def read() -> None:
        for start in range(0, raw.sizes["time"], step):
            raw["distance"].isel(time=slice(start, start + step)).values.sum()

    opened, whole, hashed = best(lambda: load(path).close()), best(read), best(lambda: hash_dataset(raw))
    values = raw["distance"].nbytes / 1e9
    print(
        f"  blocks of {store.block:6d} samples: {size / 1e6:.0f} MB, opened in {opened * 1e3:.0f} ms, read and added "
        f"up {values / whole:.2f} GB/s, hash {values / hashed:.2f} GB/s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=0.5, help="length of the record that is read")
    hours = parser.parse_args().hours
    known = parts(20)
    for title, work in (
        ("Commits at 5 x 20 kHz", commits),
        (f"Reading a record of {hours:g} h", lambda folder, known: reading(folder, known, hours)),
    ):
        print(title)
        for small in (store_module.SMALL_BLOCK_BYTES, store_module.BLOCK_BYTES):
            with tempfile.TemporaryDirectory() as folder, mock.patch.object(store_module, "SMALL_BLOCK_BYTES", small):
                work(Path(folder), known)
    with tempfile.TemporaryDirectory() as folder:
        plain(Path(folder))


if __name__ == "__main__":
    main()
