"""Spindle drift: averages compared with a plain read, the bar fit with scipy, a four-hour record in constant memory.

``python -m benchmarks.spindle_drift [--quick] [--hours 4]``; ``--quick`` skips the long record (6 GB on disk).
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
from scipy.optimize import least_squares

from errormotion.methods.spindle_drift import simulation
from errormotion.methods.spindle_drift.identification.averaging import slices, window_sums
from errormotion.methods.spindle_drift.identification.bar import fit_axis

R = 5e-3
LEVELS = np.array([0.01, 0.05])
RATE = 20_000


@numba.njit(parallel=True, fastmath=True)
def plain_read(x):
    """Add up an array: the minimum work of a reader."""
    total = 0.0
    for i in numba.prange(x.size):
        total += x[i]
    return total


def best(work: Callable[[], object], times: int = 7) -> float:
    """Return the shortest of several times, s, without the first call, which compiles."""
    work()
    found = []
    for _ in range(times):
        start = time.perf_counter()
        work()
        found.append(time.perf_counter() - start)
    return min(found)


def averages() -> None:
    print("Averages of 0.5 s at 20 kHz, five channels, against a plain read of the same array on all cores")
    print("(ours on one core, as each thread of an identification uses it)")
    print(
        f"{'layout':>18} {'dtype':>8} {'ours':>11} {'plain read':>11} {'numpy sum':>11} {'ours/read':>10} {'error':>10}"
    )
    rng = np.random.default_rng(0)
    for dtype in (np.float32, np.float64):
        base = (1e-3 + 1e-6 * rng.standard_normal((5, 20_000_000), dtype=np.float32)).astype(dtype)
        for layout in ("(channel, time)", "(time, channel)"):
            values = base if layout == "(channel, time)" else np.ascontiguousarray(base.T).T
            flat = values.reshape(-1) if layout == "(channel, time)" else values.T.reshape(-1)
            edges = np.arange(0, values.shape[1] + 1, RATE // 2)
            read, peer = best(lambda f=flat: plain_read(f)), best(flat.sum, 3)
            exact = values[:, : 3 * RATE // 2].astype(np.longdouble).reshape(5, 3, -1).sum(axis=2)
            size = values.nbytes / 1e9
            ours = best(lambda v=values, e=edges: window_sums(v, e))
            sums, counts = window_sums(values, edges)
            error = float(np.max(np.abs(sums[:, :3] / counts[:, :3] - exact / (RATE // 2))))
            print(
                f"{layout:>18} {np.dtype(dtype).name:>8} {size / ours:6.1f} GB/s {size / read:6.1f} GB/s "
                f"{size / peer:6.1f} GB/s {read / ours:9.0%} {error:8.1e} m"
            )


def bar_fit() -> None:
    rng = np.random.default_rng(0)
    near = R + 1e-3
    origin = np.array([[near, 0, 0.01], [near, 0, 0.05], [0, near, 0.01], [0, near, 0.05], [0, 0, -1e-3]])
    direction = np.array([[-1.0, 0, 0], [-1, 0, 0], [0, -1, 0], [0, -1, 0], [0, 0, 1]]) + rng.normal(0, 5e-3, (5, 3))
    origin += rng.normal(0, 1e-4, (5, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    instants, checked = 12_000, 300
    distance = 1e-3 + rng.normal(0, 2e-5, (5, instants))

    def gaps(q, d):
        A, B = np.array([q[0], q[1], LEVELS[0]]), np.array([q[2], q[3], LEVELS[1]])
        a = (B - A) / np.linalg.norm(B - A)
        return np.linalg.norm(np.cross(origin[:4] + direction[:4] * d[:4, None] - A, a), axis=1) - R

    ours = best(lambda: fit_axis(distance, origin, direction, R, LEVELS))
    q = fit_axis(distance, origin, direction, R, LEVELS)
    print(
        f"\nBar fit of {instants} instants against scipy.optimize.least_squares for each ({checked} timed and scaled)"
    )
    for name, options in (
        ("default tolerances", {}),
        ("to 1e-15", {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15, "x_scale": 1e-3}),
    ):
        start = time.perf_counter()
        peer = np.array([least_squares(gaps, q[0], args=(distance[:, t],), **options).x for t in range(checked)])
        each = (time.perf_counter() - start) / checked
        difference = np.abs(peer - q[:checked]).max()
        print(
            f"  {name:>18}: ours {ours * 1e3:.1f} ms, scipy {each * instants:.1f} s, "
            f"ratio {each * instants / ours:.0f}, "
            f"largest difference {difference:.1e} m"
        )
    residual = max(np.abs(gaps(q[t], distance[:, t])).max() for t in range(checked))
    print(f"  residual of our fit at most {residual:.1e} m")


def write_record(path: Path, hours: float) -> None:
    """Write a raw dataset of five channels at 20 kHz, as the runner stores one."""
    import zarr

    from errormotion.datasets import save
    from errormotion.twin import Event, VirtualMachine

    machine = VirtualMachine("cframe", seed=3)
    machine.start([Event(0.0, 15000.0)])
    skeleton = simulation.raw_drift(machine, np.array([0.0, 1.0]), seed=0).drop_vars(["temperature", "spindle_speed"])
    samples = round(hours * 3600 * RATE)
    piece = 30 * RATE
    skeleton = (
        skeleton.drop_vars(["distance", "time"]).drop_dims("time", errors="ignore").drop_dims("sensor", errors="ignore")
    )
    save(skeleton.assign_attrs(sample_rate=float(RATE)).assign(distance_noise=0.3e-6), path)
    array = zarr.open_group(path, mode="r+").create_array(
        "distance", shape=(5, samples), chunks=(5, piece), dtype="float32", fill_value=float("nan"),
        dimension_names=("channel", "time"), attributes={"units": "m"}, compressors=None,
    )  # fmt: skip
    block = machine.distances(0, piece, RATE).astype(np.float32)
    for begin in range(0, samples, piece):
        # The same half minute repeated, displaced by 1 nm each, so that all windows differ.
        array[:, begin : begin + piece] = (block + np.float32(1e-9 * (begin // piece)))[:, : samples - begin]


def peak_memory() -> int:
    """Return the largest memory of this process, bytes (Linux)."""
    line = next(row for row in Path("/proc/self/status").read_text().splitlines() if row.startswith("VmHWM"))
    return int(line.split()[1]) * 1024


def identify_record(path: str) -> None:
    """Identify a record and print time, peak memory and the last errors as JSON; runs in a separate process."""
    from errormotion.datasets import hash_dataset, load
    from errormotion.methods.spindle_drift import SpindleDrift

    raw = load(path)
    before = peak_memory()
    start, used = time.perf_counter(), time.process_time()
    errors = SpindleDrift().identify(raw)
    seconds, used = time.perf_counter() - start, time.process_time() - used
    start, distance = time.perf_counter(), raw["distance"]
    for _, part in slices(raw):
        part["distance"].values.sum()
    read = time.perf_counter() - start
    start = time.perf_counter()
    hash_dataset(raw)
    print(
        json.dumps(
            {
                "bytes": distance.nbytes,
                "seconds": seconds,
                "used": used,
                "read": read,
                "hash": time.perf_counter() - start,
                "before": before,
                "peak": peak_memory(),
                "instants": errors.sizes["time"],
                "EZ": float(errors["EZ"][-1]),
            }
        )
    )


def record(hours: float) -> None:
    print(f"\nIdentification of a {hours:g} h record, 5 channels at 20 kHz, out of core")
    with tempfile.TemporaryDirectory() as folder:
        samples = round(hours * 3600 * RATE) * 5
        if shutil.disk_usage(folder).free < samples * 4 * 1.2:
            print(f"  skipped: {folder} has less than the required {samples * 4 / 1e9:.0f} GB")
            return
        path = Path(folder) / "raw.zarr"
        write_record(path, hours)
        answer = subprocess.run(
            [sys.executable, "-m", "benchmarks.spindle_drift", "--identify", str(path)],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        result = json.loads(answer.stdout.splitlines()[-1])
        size = result["bytes"] / 1e9
        print(
            f"  {samples / 1e9:.2f}e9 samples ({size:.1f} GB) to {result['instants']} instants in "
            f"{result['seconds']:.1f} s ({size / result['seconds']:.2f} GB/s, hash included; processor "
            f"{result['used']:.1f} s); peak memory {result['peak'] / 2**20:.0f} MiB, of which "
            f"{result['before'] / 2**20:.0f} MiB before the first sample\n"
            f"  the same file afterwards: read and added up {size / result['read']:.2f} GB/s, hash alone "
            f"{size / result['hash']:.2f} GB/s; identification takes {result['seconds'] / result['read']:.1f} times "
            "the plain read"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="without the four-hour record")
    parser.add_argument("--hours", type=float, default=4.0, help="length of the record")
    parser.add_argument("--identify", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.identify:
        identify_record(options.identify)
        return
    averages()
    bar_fit()
    if not options.quick:
        record(options.hours)


if __name__ == "__main__":
    main()
