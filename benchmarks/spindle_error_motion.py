"""Spindle error motions: time and memory of the evaluation of a stored record of five sensors with an index pulse.

``python -m benchmarks.spindle_error_motion [--seconds 60]``; the record is simulated at 50 kHz, 24 MB a second in
memory as it is made, and stored in a temporary folder.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from errormotion import datasets
from errormotion.methods.spindle_error_motion import SpindleErrorMotion, SpindleErrorMotionSettings
from errormotion.methods.spindle_error_motion.simulation import expected

SPEED = 3000.0


def evaluate(path: str) -> None:
    """Print the times and the memory of an identification, which is compiled before."""
    method = SpindleErrorMotion()
    method.identify(method.simulate(SpindleErrorMotionSettings(turns=30, sample_rate=3000.0), 0)[0])
    raw = datasets.load(path)
    seconds = raw.sizes["time"] / 50_000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    wall, processor = time.perf_counter(), time.process_time()
    method.identify(raw)
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    more = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 - before
    print(
        f"{seconds:.0f} s of five sensors at 50 kHz: {wall:.2f} s ({seconds / wall:.0f} times real time), "
        f"{processor:.2f} s of processor time ({seconds / processor:.0f} times); {more:.0f} MB more memory"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--evaluate", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.evaluate:
        evaluate(options.evaluate)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "spindle.zarr"
        turns = max(int(options.seconds * SPEED / 60), 20)
        datasets.save(
            expected(SpindleErrorMotionSettings(turns=turns, sample_rate=50_000.0, spindle_speed=SPEED)), path
        )
        subprocess.run([sys.executable, __file__, "--evaluate", str(path)], check=True)


if __name__ == "__main__":
    main()
