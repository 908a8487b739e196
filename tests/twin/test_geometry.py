"""The geometric errors: 21 of three linear axes, and more with rotary ones."""

import json
from dataclasses import replace

import numpy as np
import pytest
from coded import raises

from errormotion.datasets import validate
from errormotion.kinematics.description import MachineDescription
from errormotion.kinematics.iso import DOF
from errormotion.kinematics.machines import Machine
from errormotion.kinematics.twists import move
from errormotion.twin import VirtualMachine
from errormotion.twin.geometry import AxisErrors


@pytest.fixture(params=["cframe", "gantry"])
def either(request):
    return VirtualMachine(request.param, seed=7)


def test_there_are_21_errors_and_none_is_missing(either):
    errors = either.geometry.machine.errors_at([0.1, 0.1, 0.1], either.geometry.motions, either.geometry.locations)
    assert errors.shape == (21,)
    assert np.all(np.abs(errors) > 0)


def test_axes_have_no_error_at_their_zero(either):
    for axis in "XYZ":
        truth = either.truth_axis(axis, [0.0])
        assert all(truth[name].item() == 0 for name in ("EX", "EY", "EZ", "EA", "EB", "EC"))


def test_errors_are_smooth_and_of_a_machine_tools_size(either):
    for axis, (low, high) in either.travel.items():
        twist = either.geometry.motions[axis](np.linspace(low, high, 1001))
        assert 0.3e-6 < np.max(np.abs(twist[:, :3])) < 200e-6
        assert 1e-6 < np.max(np.abs(twist[:, 3:])) < 200e-6
        # half a wave is a quarter of the travel or longer: a thousandth of it turns by pi / 250
        assert np.max(np.abs(np.diff(twist, axis=0))) < 0.02 * np.max(np.abs(twist))


def test_truth_of_an_axis_is_a_valid_error_dataset(either):
    truth = either.truth_axis("Y", np.linspace(-0.2, 0.2, 5))
    validate(truth)
    assert truth.attrs["component"] == "Y"
    assert truth.EY.dims == ("position",)
    assert truth.y.values == pytest.approx(np.linspace(-0.2, 0.2, 5))


def test_volumetric_truth_is_a_valid_error_dataset(either):
    truth = either.volumetric_truth(np.random.default_rng(0).uniform(0, 0.2, (8, 3)))
    validate(truth)
    assert truth.attrs["component"] == "tool"
    assert truth.EX.dims == ("target",)


def test_volume_along_the_last_axis_shows_this_axis_only(either):
    # The Z axis carries the tool: with X and Y at zero, the tool sees the errors of Z at the machine's origin.
    z = np.array([0.1, 0.3])
    points = np.column_stack([np.zeros(2), np.zeros(2), z])
    axis = either.truth_axis("Z", z)
    volume = either.volumetric_truth(points)
    squareness = either.geometry.locations
    assert volume.EZ.values == pytest.approx(axis.EZ.values, abs=1e-15)
    assert volume.EA.values == pytest.approx(axis.EA.values, abs=1e-15)
    assert np.abs(volume.EX.values - axis.EX.values) == pytest.approx(np.abs(squareness["EB0Z"] * z), abs=1e-12)
    assert np.abs(volume.EY.values - axis.EY.values) == pytest.approx(np.abs(squareness["EA0Z"] * z), abs=1e-12)


def test_unknown_axis_is_refused_with_the_known_ones(machine):
    with raises("virtual.axis.unknown"):
        machine.truth_axis("A", [0.0])


def test_fast_displacement_agrees_with_the_model(either):
    low, high = np.array([either.travel[axis] for axis in "XYZ"]).T
    places = low + np.random.default_rng(0).uniform(size=(40, 3)) * (high - low)
    # sums of some 10 um in another order: 1e-16 of that, some times
    np.testing.assert_allclose(
        either.geometry.displacement(places), either.geometry.twist(places)[:, :3], rtol=0, atol=1e-19
    )


TABLE = "workpiece-C-A-bed-X-Y-Z-spindle-tool"
TRAVEL = {"X": (0.0, 1.0), "Y": (-0.4, 0.4), "Z": (0.0, 0.5)}
POINTS = np.array([[0.1, 0.2, 0.3], [0.4, -0.1, 0.2], [0.9, 0.3, 0.05]])


def described(chain=TABLE, fixed=None, **travel):
    rotary = [axis for axis in "ABC" if axis in chain.split("-")]
    positions = {axis: (0.3, 0.01 * number, -0.1) for number, axis in enumerate(rotary)}
    return MachineDescription("Described", chain, TRAVEL | travel, positions=positions, fixed=fixed or {})


@pytest.mark.parametrize(
    ("chain", "fixed", "turning"),
    [
        (TABLE, {"A": 0.0, "C": 0.0}, ""),
        (TABLE, {"A": 0.0}, "C"),
        (TABLE, {}, "AC"),
        ("workpiece-Y-bed-X-Z-C-B-spindle-tool", {}, "BC"),
        ("workpiece-X-C-bed-Y-Z-tool", {"C": 0.0}, ""),
        ("workpiece-Z-X-Y-bed-spindle-tool", {}, ""),
        ("workpiece-bed-X-Y-Z-W-spindle-tool", {}, "W"),
    ],
)
def test_a_described_machine_has_the_errors_of_its_kinematic_model(chain, fixed, turning):
    description = described(chain, fixed, **dict.fromkeys(turning, (-1.0, 1.0)))
    geometry = VirtualMachine(description, seed=7).geometry
    more = np.random.default_rng(1).uniform(-0.5, 0.5, (len(POINTS), len(description.moving_axes) - 3))
    points = np.hstack([POINTS, more])
    q = description.commands(points)
    model = Machine(chain, description.positions)
    errors = model.errors_at(q, geometry.motions, geometry.locations)
    zero = {name for name, value in zip(model.error_names, errors[0], strict=True) if value == 0}
    assert zero == {dof + axis for axis in fixed for dof in DOF}  # error motions are zero at the axis's zero
    np.testing.assert_array_equal(geometry.twist(points), model.volumetric_error(q, errors))
    # the sum of the small errors in the exact model: products of two of them, 1e-4 rad x 1e-4 m, are left out
    np.testing.assert_allclose(geometry.twist(points), model.volumetric_error(q, errors, exact=True), rtol=0, atol=3e-8)


def test_fixed_table_rotates_the_frame_of_the_workpiece_but_not_the_errors_of_the_linear_axes():
    def linear_only(machine):
        geometry = machine.geometry
        still = {axis: geometry.motions[axis] for axis in "XYZ"} | {
            axis: AxisErrors(np.pi, np.zeros((6, 4)), np.zeros((6, 4)), np.zeros(6)) for axis in "AC"
        }
        places = {name: value if name[-1] in "XYZ" else 0.0 for name, value in geometry.locations.items()}
        return replace(geometry, motions=still, locations=places).twist(POINTS)

    at_zero = VirtualMachine(described(fixed={"A": 0.0, "C": 0.0}), seed=7)
    turned = VirtualMachine(described(fixed={"A": 0.4, "C": -1.2}), seed=7)
    np.testing.assert_allclose(linear_only(turned), linear_only(at_zero), rtol=0, atol=1e-18)


def test_errors_of_a_fixed_rotary_axis_displace_all_targets_as_one_body():
    machine = VirtualMachine(described(fixed={"A": 0.4, "C": -1.2}), seed=7)
    geometry = machine.geometry
    names = geometry.locations
    none = AxisErrors(1.0, np.zeros((6, 4)), np.zeros((6, 4)), np.zeros(6))
    motions = dict.fromkeys("XYZ", none) | {axis: geometry.motions[axis] for axis in "AC"}
    places = {name: 0.0 if name[-1] in "XYZ" else value for name, value in names.items()}
    twist = replace(geometry, motions=motions, locations=places).twist(POINTS)
    assert np.abs(twist).max() > 1e-6
    np.testing.assert_allclose(move(twist, -POINTS), np.broadcast_to(move(twist[0], -POINTS[0]), (3, 6)), atol=1e-18)


def test_errors_of_a_rotary_axis_repeat_after_a_turn():
    motion = VirtualMachine(described(A=(-1.0, 1.0), C=(-10.0, 10.0)), seed=7).geometry.motions["C"]
    angle = np.linspace(-3, 3, 25)
    np.testing.assert_allclose(motion(angle + 2 * np.pi), motion(angle), rtol=0, atol=1e-18)
    assert 0.3e-6 < np.abs(motion(angle)).max() < 200e-6


def test_truth_of_a_described_machine_is_valid_and_contains_the_description():
    machine = VirtualMachine(described(fixed={"A": 0.0}, C=(-3.0, 3.0)), seed=7)
    volume = machine.volumetric_truth([[0.1, 0.2, 0.3, 0.5]])
    validate(volume)
    assert volume.c.item() == 0.5
    assert volume.c.attrs["units"] == "rad"
    assert json.loads(volume.attrs["provenance"])["settings"]["machine"]["chain"] == TABLE
    axis = machine.truth_axis("C", [-0.5, 0.0, 0.5])
    validate(axis)
    np.testing.assert_array_equal(axis.attrs["functional_point"], machine.description.positions["C"])


def test_a_rotary_axis_that_is_not_commanded_is_at_zero():
    geometry = VirtualMachine(described(fixed={"A": 0.0}, C=(-3.0, 3.0)), seed=7).geometry
    np.testing.assert_array_equal(geometry.twist(POINTS), geometry.twist(np.hstack([POINTS, np.zeros((3, 1))])))


@pytest.mark.parametrize(("chain", "kind"), [(TABLE, "gantry"), ("workpiece-A-X-Y-bed-Z-tool", "cframe")])
def test_a_described_machine_warms_up_and_measures_like_its_kind(chain, kind):
    description = described(chain, dict.fromkeys((a for a in "AC" if a in chain.split("-")), 0.0))
    machine, alike = VirtualMachine(description, seed=7), VirtualMachine(kind, seed=7)
    assert (machine.kind, machine.tool_axes) == (kind, alike.tool_axes)
    np.testing.assert_array_equal(machine.spindle_twist([0.0, 3600.0]), alike.spindle_twist([0.0, 3600.0]))
    assert machine.chain == description.moving_chain
    assert list(machine.travel) == ["X", "Y", "Z"]
    np.testing.assert_array_equal(machine.geometry.displacement(POINTS), machine.geometry.twist(POINTS)[:, :3])


@pytest.mark.parametrize("kind", ["cframe", "gantry"])
def test_the_two_kinds_equal_machines_of_their_descriptions(kind):
    machine = VirtualMachine(kind, seed=7)
    same = VirtualMachine(machine.description, seed=7)
    np.testing.assert_array_equal(same.geometry.twist(POINTS), machine.geometry.twist(POINTS))
    assert (same.kind, same.chain, same.travel) == (machine.kind, machine.chain, machine.travel)


def test_a_machine_without_one_of_the_axes_has_the_errors_of_those_it_has():
    lathe = MachineDescription("Lathe", "workpiece-bed-Z-X-tool", {"X": (0.0, 0.2), "Z": (0.0, 0.6)})
    truth = VirtualMachine(lathe, seed=1).volumetric_truth([[0.1, 0.2]])
    validate(truth)
    assert (truth.x.item(), truth.z.item()) == (0.1, 0.2)
