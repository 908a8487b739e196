"""Complete identification of a multilateration with very many targets: time, memory and correctness.

``python -m benchmarks.multilateration_identify [--most 1000000] [--plain]``

A virtual C-frame and four stations, noise 0.5 um. One process computes and stores the data, and another identifies
them: it reads them, solves, fits the errors of the axes (not with ``--plain``), and builds and checks the dataset. The
largest memory is that of this process including imports. Linear algebra has one thread.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

SIZES = (1000, 10_000, 100_000, 1_000_000)
SMALL = (5, 5, 4)


def make(size: int, folder: Path) -> None:
    """Store the readings of about this number of targets, and their true errors."""
    from errormotion import datasets
    from errormotion.twin import VirtualMachine

    machine = VirtualMachine("cframe", seed=3)
    across = max(2, round(size ** (1 / 3)))
    from errormotion.methods.multilateration import simulation

    q = simulation.target_grid(machine, (across, across, max(2, round(size / across**2))))
    datasets.save(simulation.raw(machine, q, seed=1), folder / "raw.nc")
    truth = simulation.true_errors(machine, q)
    np.save(folder / "truth.npy", np.stack([truth[name].values for name in ("EX", "EY", "EZ")], axis=-1))


def identify(folder: Path, *, plain: bool) -> dict[str, float]:
    """Identify the stored data; return time, memory and the share of errors within their 95 % intervals."""
    from errormotion import datasets
    from errormotion.methods.multilateration import Multilateration, MultilaterationSettings, simulation
    from errormotion.twin import VirtualMachine

    method, settings = Multilateration(), MultilaterationSettings(parametric=not plain)
    machine = VirtualMachine("cframe", seed=3)
    method.identify(simulation.raw(machine, simulation.target_grid(machine, SMALL), seed=2), settings)  # compiles
    raw = datasets.load(folder / "raw.nc")
    wall, processor = time.perf_counter(), time.process_time()
    found = method.identify(raw, settings)
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    truth = np.load(folder / "truth.npy")
    held = [
        np.abs(found[name].values - truth[:, k]) < 1.96 * np.sqrt(found["covariance"].values[:, k, k])
        for k, name in enumerate(("EX", "EY", "EZ"))
    ]
    return {
        "targets": found.sizes["target"],
        "wall": wall,
        "processor": processor,
        "memory": memory,
        "result": found.nbytes / 2**20,
        "held": float(np.mean(held)),
    }


def _child(*words: str) -> str:
    environment = dict(os.environ, OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1", MKL_NUM_THREADS="1")
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.multilateration_identify", *words],
        check=True, capture_output=True, text=True, env=environment,
    )  # fmt: skip
    return done.stdout


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--most", type=int, default=SIZES[-1], help="targets of the largest problem")
    parser.add_argument("--plain", action="store_true", help="without the errors of the axes")
    parser.add_argument("--make", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--read", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.make:
        make(int(chosen.make[0]), Path(chosen.make[1]))
        return
    if chosen.read:
        print(json.dumps(identify(Path(chosen.read), plain=chosen.plain)))
        return
    print("targets    wall/s  processor/s  most memory/MiB  result/MiB  within 95 %")
    for size in SIZES:
        if size > chosen.most:
            break
        with tempfile.TemporaryDirectory() as folder:
            _child("--make", str(size), folder)
            answer = json.loads(_child("--read", folder, *(["--plain"] if chosen.plain else [])).splitlines()[-1])
        print(
            f"{answer['targets']:>7}  {answer['wall']:>8.2f}  {answer['processor']:>11.2f}  {answer['memory']:>15.0f}"
            f"  {answer['result']:>10.0f}  {100 * answer['held']:>10.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
