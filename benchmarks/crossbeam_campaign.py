"""A crossbeam campaign of 1.6 GB identified out of core: time, memory, and the errors against the truth.

``python -m benchmarks.crossbeam_campaign [--quick]``: 8 artefacts x 20 scans x 3200 x 800 points as float32;
``--quick`` uses 4 scans of each. The true scans of one artefact are computed once and used for all artefacts with
independent noise, so that all eight have the errors of the axis at the position of this one.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import xarray as xr

from errormotion.datasets import DOF

ARTEFACTS, CYCLES, LINES, POINTS = 8, 20, 800, 3200
FEED, PITCH, COUNT = 70e-6, 12.5e-6, 1e-6
NOISE, JITTER = 0.5e-6, 0.5e-6
PLACES = -0.7 + 0.2 * np.arange(ARTEFACTS)
CHUNK = 200
"""Lines of a chunk: 2.6 MB."""
FOLDER_ROOM = 1.2


class Campaign:
    """True scans of one artefact, and the other data of a raw dataset."""

    def __init__(self, cycles: int) -> None:
        from errormotion.twin import VirtualMachine
        from errormotion.twin.artefacts.pieces import swept
        from errormotion.twin.sensors.profiler import Disturbances, Profiler

        beam = VirtualMachine("gantry", seed=3).crossbeam
        profiler, artefact = Profiler(POINTS, PITCH, disturbances=Disturbances.none()), swept()
        self.cycles, self.time = cycles, np.concatenate([[0.0], np.linspace(420.0, 10800.0, cycles - 1)])
        middle = float(PLACES[0])
        self.truth = beam.twist(self.time, middle)
        rng = np.random.default_rng(0)
        # Lines are at integer counts of the encoder, so that both variants are equal.
        self.y = (np.arange(LINES) - (LINES - 1) / 2) * FEED + rng.integers(-30, 31, (cycles, 1)) * COUNT
        self.scans = np.empty((cycles, LINES, POINTS), dtype=np.float32)
        stands = beam.artefact_pose(3, middle)
        for cycle, t in enumerate(self.time):
            carriage = beam.carriage(float(t), middle + self.y[cycle], middle, "axis")
            self.scans[cycle] = profiler.scan(artefact, beam.lines(carriage, stands))
        metres = {"units": "m"}
        self.rest = xr.Dataset(
            {
                "x": ("point", profiler.x, metres),
                "position": ("artefact", PLACES, metres),
                "profiler_pose": (("row", "column"), beam.pose),
                "pose_covariance": (("p", "p_"), np.diag([18e-6, 1e-7, 1e-5, 8e-8, 15e-8, 2e-8]) ** 2),
                "lever": ("direction", beam.lever, metres),
                "lever_uncertainty": ("direction", np.full(3, 1e-3), metres),
                "height_noise": ((), NOISE, metres),
            },
            {"direction": np.array(list("xyz"), dtype=np.dtypes.StringDType())},
            {"schema": "errormotion.raw.crossbeam_scan/1", "machine": "virtual gantry"},
        )

    def noisy(self) -> Iterator[tuple[int, int, np.ndarray]]:
        """Yield cycle, artefact and heights (line, point) of all scans, always the same."""
        rng = np.random.default_rng(1)
        for cycle in range(self.cycles):
            for artefact in range(ARTEFACTS):
                wrong = rng.standard_normal((LINES, POINTS), dtype=np.float32)
                wrong *= np.float32(NOISE)
                wrong += JITTER * rng.standard_normal((LINES, 1), dtype=np.float32)
                yield cycle, artefact, wrong + self.scans[cycle]

    def write(self, path: Path, variant: str) -> None:
        """Write the raw dataset, scan by scan, uncompressed."""
        import zarr

        metres = {"units": "m"}
        if variant == "scans":
            name, dims, shape = "height", ("cycle", "artefact", "profile", "point"), (self.cycles, ARTEFACTS, LINES)
            y = np.broadcast_to(self.y[:, None], shape)
            more = {"y": (dims[:3], y, metres), "time": ("cycle", self.time, {"units": "s"})}
            chunks: tuple[int, ...] = (1, 1, CHUNK, POINTS)
        else:
            name, dims, shape = "record", ("line", "point"), (self.cycles * ARTEFACTS * LINES,)
            place = PLACES[:, None] + self.y[:, None]
            more = {
                "encoder": ("line", np.rint(place / COUNT).ravel()),
                "cycle_of_line": ("line", np.repeat(np.arange(self.cycles), ARTEFACTS * LINES)),
                "line_time": ("line", np.repeat(self.time, ARTEFACTS * LINES), {"units": "s"}),
                "warm_up": ("cycle", self.time, {"units": "s"}),
                "encoder_pitch": ((), COUNT, metres),
                "encoder_zero": ((), 0.0, metres),
                "scan_length": ((), LINES * FEED, metres),
            }
            chunks = (CHUNK, POINTS)
        self.rest.assign(more).to_zarr(path, zarr_format=3, consolidated=False)
        array = zarr.open_group(path, mode="r+").create_array(
            name, shape=(*shape, POINTS), chunks=chunks, dtype="float32", fill_value=float("nan"),
            dimension_names=dims, attributes=metres, compressors=None,
        )  # fmt: skip
        for cycle, artefact, height in self.noisy():
            first = (cycle * ARTEFACTS + artefact) * LINES
            array[(cycle, artefact) if variant == "scans" else slice(first, first + LINES)] = height


def peak_memory() -> int:
    """Return the largest memory of this process, bytes (Linux)."""
    line = next(row for row in Path("/proc/self/status").read_text().splitlines() if row.startswith("VmHWM"))
    return int(line.split()[1]) * 1024


def identify(path: str, strain: str) -> None:
    """Identify a campaign and print time and memory as JSON; runs in a separate process."""
    from errormotion.datasets import load, provenance
    from errormotion.methods.crossbeam_scan import CrossbeamScan
    from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings

    raw, hashing = load(path), [0.0]
    hash_dataset = provenance.hash_dataset

    def timed(ds: xr.Dataset) -> str:
        begun = time.perf_counter()
        found = hash_dataset(ds)
        hashing[0] += time.perf_counter() - begun
        return found

    provenance.hash_dataset = timed
    before, start, used = peak_memory(), time.perf_counter(), time.process_time()
    errors = CrossbeamScan().identify(raw, CrossbeamScanSettings(strain=strain))
    answer = {"seconds": time.perf_counter() - start, "processor": time.process_time() - used, "peak": peak_memory()}
    answer |= {"hash": hashing[0], "before": before}
    start = time.perf_counter()
    plain_read(raw)
    answer["read"] = time.perf_counter() - start
    tool = errors.em.at(raw["lever"].values + raw["profiler_pose"].values[:3, 3])
    answer["twist"] = tool.em.twist().values.tolist()
    answer["u"] = tool.em.expanded(k=1).values.tolist()
    print(json.dumps(answer))


def plain_read(raw: xr.Dataset) -> float:
    """Read all heights once, chunk by chunk, and add them up."""
    heights = raw["height"] if "height" in raw else raw["record"]
    total = 0.0
    if "height" in raw:
        for cycle in range(heights.sizes["cycle"]):
            for artefact in range(heights.sizes["artefact"]):
                total += float(heights[cycle, artefact].values.sum())
    else:
        for first in range(0, heights.sizes["line"], LINES):
            total += float(heights[first : first + LINES].values.sum())
    return total


def report(variant: str, size: float, answer: dict, campaign: Campaign, tool: np.ndarray) -> None:
    found, u = np.array(answer["twist"])[1:], np.array(answer["u"])[1:]
    lever = np.cross(campaign.truth[1:, 3:], tool)  # the errors at the tool: E + R x r
    truth = campaign.truth[1:] + np.concatenate([lever, np.zeros_like(lever)], axis=1)
    miss = found - truth[:, None]
    print(
        f"  {variant}: {answer['seconds']:.1f} s wall, {answer['processor']:.1f} s of processors, "
        f"{answer['hash']:.1f} s of the wall for the hash of the provenance; a plain read of the same takes "
        f"{answer['read']:.1f} s ({size / answer['read']:.2f} GB/s). Peak memory {answer['peak'] / 2**20:.0f} MiB, "
        f"of which {answer['before'] / 2**20:.0f} MiB before the first scan"
    )
    shift, turn = (np.sqrt(np.mean(miss[..., part] ** 2, axis=(0, 1))) for part in (slice(3), slice(3, 6)))
    print(
        f"  {'':{len(variant)}}  errors at the tool against truth, rms: "
        + ", ".join(f"{name} {value * 1e9:.0f} nm" for name, value in zip(DOF[:3], shift, strict=True))
        + "; "
        + ", ".join(f"{name} {value * 1e6:.2f} urad" for name, value in zip(DOF[3:], turn, strict=True))
        + f"; over stated {np.sqrt(np.mean((miss / u) ** 2)):.2f}, at worst {np.abs(miss / u).max():.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="4 scans of each artefact, 0.3 GB")
    parser.add_argument("--strain", default="free")
    parser.add_argument("--identify", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.identify:
        identify(options.identify, options.strain)
        return
    cycles = 4 if options.quick else CYCLES
    size = cycles * ARTEFACTS * LINES * POINTS * 4 / 1e9
    print(f"{ARTEFACTS} artefacts x {cycles} scans x {POINTS} x {LINES} points, {size:.2f} GB as float32, uncompressed")
    with tempfile.TemporaryDirectory() as folder:
        if shutil.disk_usage(folder).free < size * 1e9 * FOLDER_ROOM:
            print(f"  skipped: {folder} has less than the required {size:.1f} GB")
            return
        start = time.perf_counter()
        campaign = Campaign(cycles)
        tool = campaign.rest["lever"].values + campaign.rest["profiler_pose"].values[:3, 3]
        print(f"  true scans made in {time.perf_counter() - start:.0f} s; load {os.getloadavg()[0]:.1f}", flush=True)
        for variant in ("scans", "scans as recorded"):
            path = Path(folder) / "raw.zarr"
            start = time.perf_counter()
            campaign.write(path, variant)
            written = time.perf_counter() - start
            answer = subprocess.run(
                [sys.executable, __file__, "--identify", str(path), "--strain", options.strain],
                capture_output=True, text=True, check=False,
            )  # fmt: skip
            if answer.returncode:
                raise SystemExit(answer.stderr)
            report(variant, size, json.loads(answer.stdout.splitlines()[-1]), campaign, tool)
            print(f"  {'':{len(variant)}}  (written in {written:.0f} s; load {os.getloadavg()[0]:.1f})", flush=True)
            shutil.rmtree(path)


if __name__ == "__main__":
    main()
