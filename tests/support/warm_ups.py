"""Warm-ups of the virtual C-frame, as errors that a thermal model is fitted to."""

import numpy as np
import xarray as xr

from errormotion.twin import Event, VirtualMachine


def warm_up(seed: int) -> xr.Dataset:
    """Return the errors of three hours with three speeds, in an order that follows from a seed."""
    machine = VirtualMachine("cframe", 3)
    speeds = np.random.default_rng(seed).permutation([3000.0, 6000.0, 12000.0])
    machine.start([Event(3600.0 * k, speed, dict.fromkeys("XYZ", False)) for k, speed in enumerate(speeds)])
    ds = machine.truth_spindle(np.arange(0.0, 3 * 3600.0 + 1, 360.0)).load()
    covariance = np.tile(np.diag([9e-14] * 3 + [1e-12] * 3), (ds.sizes["time"], 1, 1))
    ds["covariance"] = (ds["covariance"].dims, covariance)
    return ds
