"""Two results of one warm-up of one virtual C-frame: a bar before five sensors, and a probe on balls."""

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr

from errormotion import plugins
from errormotion.methods.normal_vector import simulation as probing
from errormotion.methods.spindle_drift import simulation as drifting
from errormotion.twin import Event, VirtualMachine

START = "2026-03-02T07:00:00+00:00"
DURATION = 5400.0
"""Of the warm-up, s."""


def identified(method: str, raw: xr.Dataset, settings: dict) -> xr.Dataset:
    cls = plugins.get("methods", method)
    return cls().identify(raw, cls.Settings.model_validate(settings))


@pytest.fixture(scope="session")
def warm_up() -> Callable[..., dict[str, xr.Dataset]]:
    def make(seed: int, start: str = START) -> dict[str, xr.Dataset]:
        machine = VirtualMachine("cframe", seed=seed)
        machine.start([Event(120.0, 12000.0, None)])
        beams = drifting.calibrated_beams(machine, seed)
        times = np.arange(0.25, DURATION, 10.0)
        drift = drifting.raw_drift(machine, times, seed=seed, beams=beams, warm_up=False, radius_error=False)
        balls = probing.raw(machine, np.arange(0.0, DURATION, 300.0), seed=seed)
        point = {"functional_point": (0.0, 0.0, 0.0)}
        return {
            "drift": identified("spindle_drift", drift.assign_attrs(start=start), {"average": 20.0} | point),
            "probing": identified("normal_vector", balls.assign_attrs(start=start), {"tool_axes": "Z"} | point),
        }

    return make


@pytest.fixture(scope="session")
def results(warm_up: Callable[..., dict[str, xr.Dataset]]) -> dict[str, xr.Dataset]:
    return warm_up(3)
