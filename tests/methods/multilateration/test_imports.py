"""What an identification imports."""

import subprocess
import sys
from pathlib import Path

from errormotion import datasets
from errormotion.methods.multilateration import simulation
from errormotion.twin import VirtualMachine

IDENTIFY = """
import sys
from errormotion import datasets
from errormotion.methods.multilateration import Multilateration

errors = Multilateration().identify(datasets.load("raw.nc"))
assert errors.sizes["target"] == 100
assert "numba" not in sys.modules, "numba was imported"
"""


def test_an_identification_compiles_nothing(tmp_path: Path) -> None:
    datasets.save(simulation.raw(VirtualMachine("cframe", seed=1), seed=1), tmp_path / "raw.nc")
    done = subprocess.run([sys.executable, "-c", IDENTIFY], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
