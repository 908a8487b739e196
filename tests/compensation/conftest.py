"""Warm-ups of the virtual machine, measured with noise."""

import json
from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr

from errormotion.datasets.schemas import DOF
from errormotion.twin import Event, VirtualMachine

NOISE = np.array([0.3e-6] * 3 + [1e-6] * 3)
"""Of a measured error, m and rad."""

SENSOR_NOISE = 0.02  # K
OFF = {"X": False, "Y": False, "Z": False}
"""The control's own compensation would hide what the model is to learn."""

PROFILES = (
    (Event(0.0, 6000.0, OFF), Event(3600.0, 12000.0), Event(7200.0, 0.0)),
    (Event(0.0, 15000.0, OFF), Event(2400.0, 3000.0), Event(6000.0, 9000.0)),
    (
        Event(0.0, 10000.0, OFF),
        Event(1800.0, 0.0),
        Event(3600.0, 14000.0),
        Event(5400.0, 5000.0),
        Event(9000.0, 12000.0),
    ),
)
"""Spindle speeds of three warm-ups of three hours."""


@pytest.fixture(scope="session")
def warm_up() -> Callable[..., xr.Dataset]:
    """Return the measured errors of a warm-up of one machine."""

    def measured(seed: int, profile: int, hours: float = 3.0, kind: str = "cframe") -> xr.Dataset:
        machine = VirtualMachine(kind, seed)
        machine.start(PROFILES[profile])
        ds = machine.truth_spindle(np.arange(0.0, hours * 3600 + 1, 360.0)).load()
        rng = np.random.default_rng([seed, profile])
        ds["temperature"] = ds["temperature"] + SENSOR_NOISE * rng.normal(size=ds["temperature"].shape)
        covariance = np.tile(np.diag(NOISE**2), (ds.sizes["time"], 1, 1))
        covariance[0] = 0.0  # the reference
        for k, name in enumerate(DOF):
            ds[name] = ds[name] + np.where(ds["time"] > 0, NOISE[k] * rng.normal(size=ds.sizes["time"]), 0.0)
        ds["covariance"] = (ds["covariance"].dims, covariance)
        reported = json.loads(ds.attrs["provenance"]) | {"instruments": [{"address": f"twin://{kind}?seed={seed}"}]}
        return ds.assign_attrs(provenance=json.dumps(reported))

    return measured


@pytest.fixture(scope="session")
def pair(warm_up: Callable[..., xr.Dataset]) -> list[xr.Dataset]:
    """Two warm-ups of one machine."""
    return [warm_up(3, 0), warm_up(3, 1)]
