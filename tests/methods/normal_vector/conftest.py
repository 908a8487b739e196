"""Touches of the virtual machine for every test of the method."""

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr

from errormotion.kinematics.iso import DOF
from errormotion.methods.normal_vector import simulation
from errormotion.twin import Event, VirtualMachine

#: The cold cycle takes two minutes; then the spindle starts.
CYCLE, SPEED = 120.0, 12000.0


@pytest.fixture(scope="session")
def probed() -> Callable[..., tuple[VirtualMachine, xr.Dataset]]:
    """Return machine and raw dataset of a warm-up: one cycle every ten minutes."""

    def make(kind: str = "gantry", seed: int = 1, cycles: int = 7, **options) -> tuple[VirtualMachine, xr.Dataset]:
        machine = VirtualMachine(kind, seed=seed)
        machine.start([Event(time=CYCLE, spindle_speed=SPEED)])
        raw = simulation.raw(machine, 600.0 * np.arange(cycles), **({"seed": seed, "cycle": CYCLE} | options))
        return machine, raw

    return make


@pytest.fixture(scope="session")
def off() -> Callable[[VirtualMachine, xr.Dataset], np.ndarray]:
    """Return the deviation of a result from the truth, (cycle, 6), in standard uncertainties; NaN where unknown."""

    def compare(machine: VirtualMachine, errors: xr.Dataset) -> np.ndarray:
        truth = machine.truth_probing(errors["time"].values, errors.attrs["functional_point"])
        values, true = (np.stack([ds[name].values for name in DOF], axis=-1) for ds in (errors, truth))
        u = np.sqrt(np.einsum("kii->ki", errors["covariance"].values))
        return (values - true + true[0]) / np.where(u > 0, u, np.nan)

    return compare
