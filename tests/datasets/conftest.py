"""Error datasets and raw datasets for the tests of this folder."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
import xarray as xr

from errormotion.datasets import build_errors, provenance

Build = Callable[..., xr.Dataset]


def error_dataset(seed: int = 0, n: int = 7, unseen: tuple[int, ...] = (), **changes: Any) -> xr.Dataset:
    """Return an error dataset over time with influences in two groups and independent noise."""
    rng = np.random.default_rng(seed)
    E = rng.normal(size=(n, 6)) * 1e-5
    F = rng.normal(size=(3, n, 6)) * 1e-6
    L = rng.normal(size=(n, 6, 6)) * 1e-6
    E[:, list(unseen)] = np.nan
    arguments: dict[str, Any] = {
        "values": E,
        "covariance": np.einsum("spi,spj->pij", F, F) + L @ np.swapaxes(L, 1, 2),
        "dims": ("time",),
        "coords": {
            "time": 0.5 * np.arange(n),
            "sensor": ["frame", "ambient"],
            "temperature": (("time", "sensor"), np.full((n, 2), 20.0), {"units": "degC"}),
        },
        "component": "spindle",
        "machine": "C-frame",
        "frame": "machine",
        "functional_point": (0.1, -0.2, 0.01),
        "reference": "cold",
        "method": "spindle_drift",
        "method_version": "1",
        "provenance": provenance.make({"average": 0.5}, None, [{"serial_number": "7"}], seed=seed),
        "influence": F,
        "sources": [f"source {k}" for k in range(3)],
        "source_groups": ["beams", "beams", "reference"],
    }
    return build_errors(**{**arguments, **changes})


def drift_dataset(n: int = 50, **variables: Any) -> xr.Dataset:
    """Return a valid raw dataset of a drift measurement."""
    rng = np.random.default_rng(0)
    side = [[-1, 0, 0], [-1, 0, 0], [0, -1, 0], [0, -1, 0], [0, 0, 1]]
    origin = [[0.006, 0, 0.01], [0.006, 0, 0.05], [0, 0.006, 0.01], [0, 0.006, 0.05], [0, 0, -0.001]]
    ds = xr.Dataset(
        {
            "distance": (("channel", "time"), 1e-3 + rng.normal(size=(5, n)) * 1e-6, {"units": "m"}),
            "beam_origin": (("channel", "direction"), np.array(origin), {"units": "m"}),
            "beam_direction": (("channel", "direction"), np.array(side, dtype=float)),
            "beam_covariance": (("channel", "p", "p_"), np.tile(np.diag([1e-12] * 3 + [1e-10] * 3), (5, 1, 1))),
            "bar_radius": 0.005,
            "distance_noise": 3e-7,
            "level": ("height", [0.01, 0.05]),
            "temperature": (("time", "sensor"), np.full((n, 1), 21.0)),
        },
        coords={
            "channel": ["X1", "X2", "Y1", "Y2", "Z"],
            "direction": ["x", "y", "z"],
            "height": ["L1", "L2"],
            "sensor": ["frame"],
            "time": ("time", 0.5 * np.arange(n), {"units": "s"}),
        },
        attrs={"schema": "errormotion.raw.spindle_drift/1"},
    )
    return ds.assign(variables)


def beam_dataset() -> xr.Dataset:
    """Return a valid raw dataset of a beam detection."""
    shape = (5, 6, 11)
    return xr.Dataset(
        {
            "distance": (("channel", "profile", "step"), np.full(shape, 1e-3)),
            "sphere_centre": (("channel", "profile", "step", "direction"), np.zeros((*shape, 3))),
            "sphere_radius": 0.005,
            "scan_direction": (("channel", "profile", "direction"), np.tile([1.0, 0, 0], (5, 6, 1))),
            "nominal_origin": (("channel", "direction"), np.zeros((5, 3))),
            "nominal_direction": (("channel", "direction"), np.tile([0, 0, 1.0], (5, 1))),
        },
        coords={"channel": ["X1", "X2", "Y1", "Y2", "Z"]},
        attrs={"schema": "errormotion.raw.spindle_drift/1"},
    )


@pytest.fixture
def errors() -> Build:
    return error_dataset


@pytest.fixture(scope="session")
def errors_of_seed() -> Callable[[int], xr.Dataset]:
    """Error datasets of three instants, built once for each seed."""
    return cache(lambda seed: error_dataset(seed=seed, n=3))


@pytest.fixture
def drift() -> Build:
    return drift_dataset


@pytest.fixture
def beams() -> Build:
    return beam_dataset
