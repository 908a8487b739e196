"""Signs: the model against poses multiplied by hand, and against the kinematic chain of the package."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from errormotion.kinematics.iso import DOF
from errormotion.kinematics.machines import Machine
from errormotion.methods.r_test import RTest, RTestSettings
from errormotion.methods.r_test.layout import Layout, expected

ANGLE = np.arange(24) * 2 * np.pi / 24
POINT = np.array([0.3, -0.2, 0.4])
"""Of the line of the axis; not the origin."""
LOCATION = {"EX": 12e-6, "EY": -7e-6, "EZ": 5e-6, "EA": 20e-6, "EB": -35e-6, "EC": 11e-6}


def matrix(rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return a pose as a matrix (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(rotation).as_matrix(), shift
    return T


def about(T: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return a motion that is stated at a point."""
    return matrix(np.zeros(3), point) @ T @ matrix(np.zeros(3), -point)


def motion(axis: str) -> np.ndarray:
    """Return error motions (angle, 6) with second and third harmonics: the datum does not change them."""
    k = np.arange(6)
    return np.r_[[1e-6] * 3, [10e-6] * 3] * (np.cos(2 * ANGLE[:, None] + k) + 0.5 * np.sin(3 * ANGLE[:, None] + k))


def test_raw_data_of_matrices_give_back_the_errors() -> None:
    """The table C turns by -q in the machine's frame; its line is displaced; the tool is at the nominal sphere."""
    place = POINT + np.array([[0.1, 0.0, 0.05], [-0.04, 0.09, 0.06], [-0.06, -0.08, 0.1]])
    sensor = np.array([[0.8, 0.0, 0.6], [-0.4, 0.7, 0.59], [-0.5, -0.6, 0.62], [0.0, 0.0, 1.0]])
    sensor /= np.linalg.norm(sensor, axis=1)[:, None]
    location = np.array(list(LOCATION.values()))
    error = motion("C")
    # The line is displaced by L: a turn about the displaced line leaves the table in place at angle 0.
    L = about(matrix(location[3:], location[:3]), POINT)
    own = np.array([[30e-6, -10e-6, 5e-6], [-20e-6, 15e-6, 0.0], [4e-6, 8e-6, -12e-6]])
    reading = np.zeros((ANGLE.size, 3, 4))
    for a, q in enumerate(ANGLE):
        turned = about(matrix(np.array([0.0, 0.0, -q]), np.zeros(3)), POINT)
        # Tool side relative to workpiece side: a positive error of the table moves the table backwards.
        wrong = np.linalg.inv(about(matrix(error[a, 3:], error[a, :3]), POINT))
        table = L @ wrong @ turned @ np.linalg.inv(L)
        for i, p in enumerate(place):
            actual = (table @ np.r_[p + own[i], 1.0])[:3]
            nominal = (turned @ np.r_[p, 1.0])[:3]
            reading[a, i] = sensor @ (actual - nominal)
    raw = expected(RTestSettings(angles=ANGLE.size)).drop_dims(["sphere", "sensor"]).assign_coords(angle=ANGLE)
    raw["angle"].attrs["units"] = "rad"
    raw["displacement"] = (("angle", "sphere", "sensor"), reading)
    raw["sphere_position"] = (("sphere", "direction"), place)
    raw["sensor_direction"] = (("sensor", "direction"), sensor)
    raw["axis_point"] = (("direction",), POINT)
    errors = RTest().identify(raw)
    # products of two errors: 40 urad times 40 um, and 40 urad squared times 0.1 m
    assert errors["location_error"].values == pytest.approx(
        [LOCATION[name] for name in ("EX", "EY", "EA", "EB")], abs=4e-9
    )
    assert errors["location"].values.tolist() == ["EX0C", "EY0C", "EA0C", "EB0C"]
    found = np.stack([errors[name].values for name in DOF], axis=1)
    assert found[:, :3] == pytest.approx(error[:, :3], abs=4e-9)
    assert found[:, 3:] == pytest.approx(error[:, 3:], abs=20e-9)


@pytest.mark.parametrize("axis", ["A", "B", "C"])
def test_the_chain_of_the_package_gives_the_same_displacements(axis: str) -> None:
    machine = Machine(f"workpiece-{axis}-bed-X-Y-Z-tool", {axis: POINT})
    place = POINT + np.roll(
        np.array([[0.1, 0.0, 0.05], [-0.04, 0.09, 0.06], [-0.06, -0.08, 0.1]]), "CAB".index(axis), 1
    )
    error = motion(axis)
    layout = Layout(axis, ANGLE, place - POINT, POINT, np.eye(3), np.zeros((ANGLE.size, 3, 3)))
    names = machine.error_names
    value = np.zeros((ANGLE.size, len(names)))
    for k, dof in enumerate(DOF):
        value[:, names.index(dof + axis)] = error[:, k]
    lines = {name: LOCATION[name[:2]] for name in layout.locations}
    for name, size in lines.items():
        value[:, names.index(name)] = size
    shift = np.zeros(6)
    for name, k in layout.locations.items():
        shift[k] = lines[name]
    # At angle 0 the displaced line has no effect, since the part stands where it stands: the spheres are displaced by
    # the opposite of the line.
    own = np.array([-(shift[:3] + np.cross(shift[3:], p - POINT)) for p in place])
    d = layout.displacement(error - shift, own)
    for i, p in enumerate(place):
        commands = np.zeros((ANGLE.size, 4))
        nominal = POINT + np.einsum("aij,j->ai", layout.turn, p - POINT)
        commands[:, :3] = nominal - p  # the linear axes follow the sphere
        commands[:, machine.axis_names.index(axis)] = ANGLE
        twist = machine.volumetric_error(commands, value, tool=p)
        # Workpiece frame to machine frame; the sphere is the workpiece side.
        here = -np.einsum("aij,aj->ai", layout.turn, twist[:, :3])
        assert d[:, i] == pytest.approx(here, abs=1e-15)
        exact = machine.volumetric_error(commands, value, tool=p, exact=True)
        here = -np.einsum("aij,aj->ai", layout.turn, exact[:, :3])
        assert d[:, i] == pytest.approx(here, abs=1e-9)  # products of two errors
