"""NC programs: time and memory of a correction, compared with the interpreter of LinuxCNC."""

import math
import os
import resource
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from errormotion.compensation.correction import correction
from errormotion.compensation.program import ByTool, Offsets, ProgramSettings, Reader, Rewriting, compensate
from errormotion.compensation.program.interpreter.canonical import interpreter
from errormotion.twin import VirtualMachine

BLOCKS = 200_000


def contour() -> list[str]:
    """Return the finishing program of a free-form surface: blocks of about 0.8 mm."""
    lines = ["G21 G90 G17 G94 G54", "G0 X90 Y0 Z5", "F1500"]
    for k in range(BLOCKS):
        a = 0.01 * k
        x, y = 90 * math.cos(a) * math.cos(1e-5 * k), 90 * math.sin(a)
        lines.append(f"N{k + 1} G1 X{x:.4f} Y{y:.4f} Z{-5 + 3 * math.sin(3.3 * a):.4f}")
    return [*lines, "M2"]


def volume() -> ByTool:
    """Return the correction of a virtual machine, measured at 504 targets."""
    axes = np.linspace(-0.2, 0.2, 9), np.linspace(-0.15, 0.15, 7), np.linspace(0.05, 0.4, 8)
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return ByTool(correction(VirtualMachine("cframe", seed=3).volumetric_truth(points)))


def speed(folder: Path) -> None:
    part, out = folder / "part.ngc", folder / "new.ngc"
    part.write_text("\n".join(contour()) + "\n")
    correcting, offsets = volume(), Offsets().with_system("G54", (0.0, 0.0, 0.2))
    list(Rewriting(Reader(offsets), correcting).lines(["G0 X0 Y0 Z0", "G1 X100 F100", "M2"]))  # for the compilation
    start, cpu = time.perf_counter(), time.process_time()
    found = compensate(part, out, correcting, offsets, ProgramSettings())
    wall, used = time.perf_counter() - start, time.process_time() - cpu
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{BLOCKS} blocks corrected by {1e6 * found.summary.largest:.1f} um at most: {wall:.1f} s, {used:.1f} s of CPU,"
    )
    print(
        f"  process {memory:.0f} MB in all; {found.summary.divided} cuts divided, {found.summary.written} lines written"
    )
    if program := interpreter():
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        start = time.perf_counter()
        with (folder / "canonical").open("wb") as file:
            home = {**os.environ, "HOME": str(folder)}  # the tools of a running control are in a file there
            subprocess.run([program, "-g", str(part)], cwd=folder, env=home, stdout=file, stderr=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        own = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        print(f"  LinuxCNC's interpreter reads it in {time.perf_counter() - start:.1f} s, {own:.1f} s of CPU")


def main() -> None:
    folder = Path(tempfile.mkdtemp(prefix="errormotion-"))
    try:
        speed(folder)
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
