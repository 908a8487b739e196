"""What each built-in method takes from the machine of its bench, and which machines it refuses."""

import math

import numpy as np
import pytest

from errormotion import plugins
from errormotion.campaign.sections.machine import completed, contradictions
from errormotion.kinematics.description import MachineDescription
from errormotion.methods.multilateration import simulation
from errormotion.twin import VirtualMachine

TRAVEL = {"X": (-0.3, 0.3), "Y": (-0.25, 0.25), "Z": (0.0, 0.46)}
CFRAME = MachineDescription("C-frame", "workpiece-X-Y-bed-Z-spindle-tool", TRAVEL)
GANTRY = MachineDescription("Gantry", "workpiece-bed-X-Y-Z-spindle-tool", TRAVEL)
HORIZONTAL = MachineDescription("Horizontal", "workpiece-X-bed-Y-Z-spindle-tool", TRAVEL, "X")
TABLE = {"C": (0.0, 0.0, -0.05)}
STILL = MachineDescription(
    "Table", "workpiece-C-X-Y-bed-Z-spindle-tool", TRAVEL, positions=TABLE, fixed={"C": math.pi / 2}
)
TURNING = MachineDescription("Table", STILL.chain, TRAVEL | {"C": (-7.0, 7.0)}, positions=TABLE)


def read(method_id, machine, **settings):
    """Return the settings of a campaign on this machine, and what contradicts it."""
    method = plugins.get("methods", method_id)
    found = completed(method, method.Settings(**settings), machine)
    return found, contradictions(method, found, machine)


@pytest.mark.parametrize(
    ("method", "key", "machine", "value"),
    [
        ("multilateration", "chain", CFRAME, CFRAME.chain),
        ("multilateration", "chain", STILL, CFRAME.chain),
        ("normal_vector", "tool_axes", CFRAME, "Z"),
        ("normal_vector", "tool_axes", GANTRY, "XYZ"),
        ("crossbeam_scan", "travel", GANTRY, (-0.25, 0.25)),
    ],
)
def test_a_setting_that_is_not_stated_follows_from_the_machine(method, key, machine, value):
    settings, wrong = read(method, machine)
    assert getattr(settings, key) == value
    assert not wrong


@pytest.mark.parametrize(
    ("method", "key", "machine", "value"),
    [
        ("multilateration", "chain", CFRAME, CFRAME.chain),
        ("normal_vector", "tool_axes", CFRAME, "Z"),
        ("crossbeam_scan", "travel", GANTRY, (-0.2, 0.2)),
    ],
)
def test_a_stated_setting_that_agrees_with_the_machine_is_kept(method, key, machine, value):
    settings, wrong = read(method, machine, **{key: value})
    assert getattr(settings, key) == value
    assert not wrong


@pytest.mark.parametrize(
    ("method", "machine", "settings", "key", "text"),
    [
        ("multilateration", CFRAME, {"chain": GANTRY.chain}, "chain", f"expected '{CFRAME.chain}'; found"),
        ("multilateration", TURNING, {}, "", "found X, Y, Z, C. Fix the rotary axes"),
        (
            "multilateration",
            CFRAME,
            {"layout": {"low": (-0.31, 0, 0)}},
            "layout",
            "within the travel of X, -300 mm to 300 mm; found -310 mm to 200 mm",
        ),
        (
            "multilateration",
            CFRAME,
            {"layout": {"targets": ((0, 0, 0), (0, 0, 0.5))}},
            "layout",
            "within the travel of Z, 0 mm to 460 mm; found 0 mm to 500 mm",
        ),
        ("normal_vector", CFRAME, {"tool_axes": "XYZ"}, "tool_axes", "expected 'Z', the axes that carry the tool; fo"),
        ("crossbeam_scan", CFRAME, {}, "", "whose axis Y carries the tool; found the chain 'workpiece-X-Y-bed-Z"),
        ("crossbeam_scan", GANTRY, {"travel": (-0.3, 0.2)}, "travel", "-250 mm to 250 mm; found -300 mm to 200 mm"),
        ("crossbeam_scan", GANTRY, {"positions": (0.0, 0.3)}, "positions", "-250 mm to 250 mm; found 300 mm"),
        (
            "crossbeam_scan",
            GANTRY,
            {"procedure": "profiler_pose", "pocket_position": 0.4},
            "positions",
            "-250 mm to 250 mm; found 400 mm",
        ),
        ("spindle_drift", HORIZONTAL, {}, "", "expected a spindle axis Z"),
    ],
)
def test_a_setting_that_contradicts_the_machine_is_refused(method, machine, settings, key, text):
    _, wrong = read(method, machine, **settings)
    assert list(wrong) == [key]
    assert text in wrong[key]


@pytest.mark.parametrize("method", ["spindle_drift", "multilateration", "normal_vector", "crossbeam_scan"])
def test_without_a_description_settings_stay_as_they_are(method):
    settings, wrong = read(method, None)
    assert settings == plugins.get("methods", method).Settings()
    assert not wrong


def test_linear_axes_of_a_machine_with_fixed_rotary_axes_are_identified_within_their_uncertainty():
    # The rotary axes displace the workpiece as one body, which distances do not show.
    description = MachineDescription(
        "Trunnion mill",
        "workpiece-C-A-bed-X-Y-Z-spindle-tool",
        TRAVEL,
        positions={"A": (0.0, 0.0, -0.12), "C": (0.0, 0.0, -0.05)},
        fixed={"A": 0.0, "C": math.pi / 6},
    )
    machine = VirtualMachine(description, seed=3)
    target = simulation.target_grid(machine)
    errors = plugins.get("methods", "multilateration")().identify(simulation.raw(machine, target, seed=1))
    truth = simulation.true_errors(machine, target)
    freedoms = ["EX", "EY", "EZ"]
    true = np.stack([truth[name].values for name in freedoms])
    miss = np.stack([errors[name].values for name in freedoms]) - true
    stated = np.sqrt(np.stack([errors["covariance"].values[:, i, i] for i in range(3)]))
    size = np.sqrt(np.mean((miss / stated) ** 2))
    assert 0.7 < size < 1.3  # 300 values that are correlated through the stations
    assert np.sqrt(np.mean((true / stated) ** 2)) > 4  # the errors themselves are large compared with it
    assert errors.attrs["machine"] == "Trunnion mill"
