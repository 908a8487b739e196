"""Records of a spindle, written down from the definitions: a plane, a ball, and the sensors' lines of sight."""

import numpy as np
import pytest
import xarray as xr

TAU = 2 * np.pi
R = 12.5e-3


def record(
    x=None,
    y=None,
    z=None,
    *,
    turns=40.25,
    per_turn=179.37,
    speed=3000.0,
    eccentricity=5e-6,
    angle="index",
    ripple=0.0,
    second=None,
    form=None,
    noise=0.0,
    seed=0,
    start=0.013,
):
    """Return raw data of motions x, y, z (functions of the angle q of the axis, rad, to m) of a ball.

    Sensors at +X, looking outward, and at +Y, looking inward; along Z; ``second`` is (height, x at this height).
    ``form`` is the deviation of the ball from a sphere over its azimuth, outward.
    """
    sense, rate = np.sign(speed), abs(speed) / 60
    time = start + np.arange(int(turns * per_turn)) / (rate * per_turn)
    turned = TAU * rate * time
    turned = turned + ripple * np.sin(turned / 7)
    q = sense * turned
    none = np.zeros_like(q)
    dx = (x(q) if x else none) + eccentricity * np.cos(q + 0.7)
    dy = (y(q) if y else none) + eccentricity * np.sin(q + 0.7)
    dz = z(q) if z else none
    f = form or (lambda azimuth: 0 * azimuth)
    east = dx + np.sqrt(R**2 - dy**2) - R + f(0.0 - q)  # the surface at +X, outward
    north = dy + np.sqrt(R**2 - dx**2) - R + f(TAU / 4 - q)
    rows = [east, -north, dz]
    direction, position = [[1, 0, 0], [0, -1, 0], [0, 0, 1]], [[R, 0, 0], [0, R, 0], [0, 0, -R]]
    if second is not None:
        height, there = second
        rows.append(there(q) + eccentricity * np.cos(q + 0.7) + np.sqrt(R**2 - dy**2) - R)
        direction.append([1, 0, 0])
        position.append([R, 0, height])
    generator = np.random.default_rng(seed)
    readings = np.array(rows) + noise * generator.standard_normal((len(rows), q.size))
    m = {"units": "m"}
    raw = xr.Dataset(
        {
            "displacement": (("sensor", "time"), readings, m),
            "sensor_direction": (("sensor", "direction"), np.array(direction, float), {"units": "1"}),
            "sensor_position": (("sensor", "direction"), np.array(position, float), m),
            "axis_point": (("direction",), np.zeros(3), m),
            "artefact_radius": ((), R, m),
            "spindle_speed": ((), speed, {"units": "1/min"}),
            "displacement_noise": ((), noise or 1e-9, m),
            "gain_uncertainty": ((), 0.0, {"units": "1"}),
            "sensor_direction_uncertainty": ((), 0.0, {"units": "rad"}),
            "position_uncertainty": ((), 0.0, m),
            "roundness": ((), 0.0, m),
        },
        {"time": ("time", time, {"units": "s"}), "direction": list("xyz")},
        {"schema": "errormotion.raw.spindle_error_motion/1", "axis": "C", "machine": "written down"},
    )
    if angle == "index":
        whole = TAU * np.arange(np.ceil(turned[0] / TAU), np.floor(turned[-1] / TAU) + 1)
        raw["index_time"] = ("index", np.interp(whole, turned, time), {"units": "s"})
    elif angle == "encoder":
        raw["angle"] = ("time", q, {"units": "rad"})
    return raw


@pytest.fixture
def recorded():
    """Return the function `record`."""
    return record
