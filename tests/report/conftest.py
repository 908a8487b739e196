"""Error datasets of a warm-up with its end, and of a beam detection."""

import json

import numpy as np
import pytest
import xarray as xr
from markupsafe import Markup

from errormotion.datasets import build_errors, provenance
from errormotion.report import canvas

CHANNELS = ["X1", "X2", "Y1", "Y2", "Z"]
QUANTITIES = ["X1", "X2", "Y1", "Y2", "Z", "A", "B"]
MEASURES = [
    *(f"{kind}_{span}" for span in ("60min", "running", "total") for kind in ("range", "difference")),
    "time_constant",
    "end_slope",
    "per_kelvin",
]
ARCSEC = np.pi / 180 / 3600
ORIGIN = np.array(
    [[6e-3, 1e-4, 0.01], [6e-3, -8e-5, 0.05], [5e-5, 6e-3, 0.01], [-9e-5, 6e-3, 0.05], [5e-5, 1e-4, -1e-3]]
)
DIRECTION = np.array([[-1, 4e-3, 2e-3], [-1, -3e-3, 1e-3], [2e-3, -1, 5e-3], [-4e-3, -1, -1e-3], [3e-3, -2e-3, 1.0]])
INSTRUMENTS = [
    {
        "name": "frame",
        "driver": "five_sensor_frame",
        "kind": "spindle_frame",
        "status": "simulated_only",
        "address": "tcp://192.0.2.7:1024",
        "settings": {"sample_rate": 20000.0},
        "identity": {
            "manufacturer": "Micro-Epsilon",
            "model": "ILD2300-2",
            "serial_number": "10123",
            "simulated": False,
        },
    }
]


def settings_of_a_warm_up():
    return {
        "procedure": "drift",
        "average": 0.5,
        "beams": "raw",
        "schedule": [
            {"at": 0.0, "spindle_speed": 15000.0, "compensation": None},
            {"at": 6060.0, "spindle_speed": None, "compensation": {"Z": False}},
            {"at": 6120.0, "spindle_speed": None, "compensation": {"Y": False}},
        ],
    }


def drift_dataset(
    n=1200, *, minutes=104.0, machine="C-frame 610", instruments=INSTRUMENTS, temperature=True, speed=True
):
    """A spindle's warm-up: (dataset), compensation off at 101 and 102 min, spindle off for the last minute."""
    rng = np.random.default_rng(1)
    t = np.linspace(0, 60 * minutes, n)

    def rise(size, tau):
        return size * (1 - np.exp(-t / tau))

    values = np.full((n, 6), np.nan)
    values[:, 0] = rise(-4e-6, 1500) + rng.normal(0, 5e-9, n)
    values[:, 1] = rise(6e-6, 2400) + 9e-6 * (t > 6120) + rng.normal(0, 5e-9, n)
    values[:, 2] = rise(19.9e-6, 1800) + 29.3e-6 * (t > 6060) + rng.normal(0, 5e-9, n)
    values[:, 3] = rise(26 * ARCSEC, 2200) + rng.normal(0, 1e-7, n)
    values[:, 4] = rise(-12.5 * ARCSEC, 2200) + rng.normal(0, 1e-7, n)
    sizes = np.array([60e-9, 60e-9, 20e-9, 2e-6, 2e-6])
    growth = 0.2 + np.abs(values[:, :5]) / np.nanmax(np.abs(values[:, :5]), axis=0)
    influence = np.full((4, n, 6), np.nan)
    for s, share in enumerate((3.0, 2.0, 1.0, 1.5)):
        influence[s, :, :5] = share * sizes * growth
    independent = np.array([8e-9, 8e-9, 6e-9, 2e-7, 2e-7, np.nan]) ** 2
    covariance = np.einsum("sni,snj->nij", influence, influence) + np.diag(independent)
    heights = np.array([0.01, 0.05])
    moved = np.stack([np.stack([values[:, 0] + values[:, 4] * z, values[:, 1] - values[:, 3] * z]) for z in heights])
    coords = {"time": ("time", t, {"units": "s", "start": "2026-03-02T08:15:00Z"})}
    if temperature:
        sensors = ["frame", "ambient", "spindle front", "spindle rear", "column"]
        warm = np.stack(
            [21 + rise(g, tau) for g, tau in ((0.6, 4000), (0.3, 9000), (14, 1500), (11, 1900), (2, 5000))], 1
        )
        coords |= {
            "temperature": (("time", "sensor"), warm + rng.normal(0, 0.02, warm.shape), {"units": "degC"}),
            "sensor": ("sensor", sensors),
        }
    if speed:
        coords["spindle_speed"] = ("time", np.where(t < 60 * (minutes - 1), 15000.0, 0.0), {"units": "1/min"})
    valid = np.ones((5, n))
    valid[1, n // 3 : n // 3 + 40] = 0.4
    reading = 1e-3 - np.stack([moved[0, 0], moved[1, 0], moved[0, 1], moved[1, 1], -values[:, 2]])
    iso = np.full((7, len(MEASURES)), np.nan)
    iso_u = np.full_like(iso, np.nan)
    stop = np.flatnonzero(t < 60 * (minutes - 1))[-1]
    quantity_values = [moved[0, 0], moved[1, 0], moved[0, 1], moved[1, 1], values[:, 2], values[:, 3], values[:, 4]]
    for i, v in enumerate(quantity_values):
        for j, last in enumerate((np.searchsorted(t, 3600), stop if speed else None, n - 1)):
            if last is not None and last < n:
                iso[i, 2 * j : 2 * j + 2] = np.ptp(v[: last + 1]), v[last] - v[0]
        iso[i, 6], iso[i, 7] = 1800.0, (v[stop] - v[stop - 40]) / (t[stop] - t[stop - 40])
        iso_u[i] = np.where(np.isfinite(iso[i]), [2e-7] * 6 + [30.0, 1e-11, 2e-8], np.nan)
        if temperature:
            iso[i, 8], iso_u[i, 8] = v[stop] / 13.0, abs(v[stop]) / 400.0
    iso[:4, 6] = iso_u[:4, 6] = np.nan
    direction = DIRECTION / np.linalg.norm(DIRECTION, axis=1, keepdims=True)
    extras = {
        "displacement": xr.DataArray(moved, dims=("level", "lateral", "time"), attrs={"units": "m"}),
        "displacement_u": xr.DataArray(
            np.broadcast_to(4 * sizes[0] * growth[:, 0], moved.shape),
            dims=("level", "lateral", "time"),
            attrs={"units": "m"},
        ),
        "fit_residual": xr.DataArray(rng.normal(0, 3e-8, (5, n)), dims=("channel", "time"), attrs={"units": "m"}),
        "valid_fraction": xr.DataArray(valid, dims=("channel", "time"), attrs={"units": "1"}),
        "distance_mean": xr.DataArray(reading, dims=("channel", "time"), attrs={"units": "m"}),
        "iso_value": xr.DataArray(iso, dims=("quantity", "measure")),
        "iso_uncertainty": xr.DataArray(iso_u, dims=("quantity", "measure")),
        "beam_origin": xr.DataArray(ORIGIN, dims=("channel", "direction"), attrs={"units": "m"}),
        "beam_direction": xr.DataArray(direction, dims=("channel", "direction"), attrs={"units": "1"}),
        "bar_axis_point": xr.DataArray([2e-5, -3e-5, 0.0], dims=("direction",), attrs={"units": "m"}),
        "bar_axis_direction": xr.DataArray([1e-4, 2e-4, 1.0], dims=("direction",), attrs={"units": "1"}),
        "bar_radius": xr.DataArray(5e-3, attrs={"units": "m"}),
        "level_z": xr.DataArray(heights, dims=("height",), attrs={"units": "m"}),
    }
    coords |= {
        "channel": ("channel", CHANNELS),
        "level": ("level", ["L1", "L2"]),
        "lateral": ("lateral", ["x", "y"]),
        "quantity": ("quantity", QUANTITIES),
        "measure": ("measure", MEASURES),
        "direction": ("direction", ["x", "y", "z"]),
        "height": ("height", ["L1", "L2"]),
    }
    return build_errors(
        values,
        covariance,
        dims=("time",),
        coords=coords,
        component="spindle",
        machine=machine,
        frame="machine",
        functional_point=[0, 0, 0],
        reference="cold, spindle at rest, 2026-03-02T08:15:00Z",
        method="spindle_drift",
        method_version="1",
        provenance=provenance.make(settings_of_a_warm_up(), None, instruments),
        influence=influence,
        sources=["beam 1", "beam 2", "cold reference", "frame expansion"],
        source_groups=["beams", "beams", "reference", "expansion"],
        extras=extras,
    )


def beam_dataset():
    """Five detected beams, X2 not found."""
    rng = np.random.default_rng(2)
    direction = DIRECTION / np.linalg.norm(DIRECTION, axis=1, keepdims=True)
    nominal_direction = np.round(direction)
    nominal_origin = np.round(ORIGIN, 3)
    covariance = np.zeros((5, 6, 6))
    for i in range(5):
        across = np.eye(3) - np.outer(direction[i], direction[i])
        covariance[i, :3, :3] = (4e-7) ** 2 * across + (5e-8) ** 2 * np.eye(3)
        covariance[i, 3:, 3:] = (6e-5) ** 2 * across
    origin = ORIGIN.copy()
    origin[1], covariance[1] = np.nan, np.nan
    direction[1] = np.nan
    values = np.full((5, 6), np.nan)
    values[:, :3] = origin - nominal_origin
    values[:, 3:] = np.cross(nominal_direction, direction)
    names = ("beam", "direction")
    residual = rng.normal(0, 2e-7, (5, 6, 101))
    residual[1] = np.nan
    extras = {
        "beam_origin": xr.DataArray(origin, dims=names, attrs={"units": "m"}),
        "beam_direction": xr.DataArray(direction, dims=names, attrs={"units": "1"}),
        "beam_covariance": xr.DataArray(covariance, dims=("beam", "p", "p_")),
        "residual": xr.DataArray(residual, dims=("beam", "profile", "step"), attrs={"units": "m"}),
        "noise": xr.DataArray([2e-7, np.nan, 2.2e-7, 1.9e-7, 2.1e-7], dims=("beam",), attrs={"units": "m"}),
        "paper_origin": xr.DataArray(origin + 7e-7, dims=names, attrs={"units": "m"}),
        "paper_direction": xr.DataArray(
            direction + np.roll(direction, 1, axis=1) * 1e-4, dims=names, attrs={"units": "1"}
        ),
        "nominal_origin": xr.DataArray(nominal_origin, dims=names, attrs={"units": "m"}),
        "nominal_direction": xr.DataArray(nominal_direction, dims=names, attrs={"units": "1"}),
    }
    six = np.where(np.isnan(values)[:, :, None] | np.isnan(values)[:, None, :], np.nan, np.eye(6) * 1e-12)
    return build_errors(
        values,
        six,
        dims=("beam",),
        coords={"beam": CHANNELS, "direction": ("direction", ["x", "y", "z"])},
        component="beam",
        machine="C-frame 610",
        frame="machine",
        functional_point=[0, 0, 0],
        reference="nominal beams",
        method="spindle_drift",
        method_version="1",
        provenance=provenance.make({"procedure": "beam_detection"}, None, INSTRUMENTS),
        extras=extras,
    )


@pytest.fixture
def undrawn(monkeypatch):
    """Leave out what is in the figures of a report, for tests of its texts and tables."""
    monkeypatch.setattr(canvas, "draw", lambda *_, **__: Markup("<svg></svg>"))


@pytest.fixture
def make_drift():
    return drift_dataset


@pytest.fixture(scope="session")
def drift():
    return drift_dataset()


@pytest.fixture(scope="session")
def beams():
    return beam_dataset()


@pytest.fixture
def simulated_instruments():
    return [{**json.loads(json.dumps(INSTRUMENTS[0])), "address": "sim://cframe/frame?seed=3"}]
