"""The description of a machine: what follows from it, and what is refused."""

import numpy as np
import pytest

from errormotion.kinematics.description import DescriptionError, MachineDescription
from errormotion.kinematics.machines import Machine

FIVE_AXES = "workpiece-C-A-bed-X-Y-Z-spindle-tool"
TRAVEL = {"X": (0.0, 1.0), "Y": (-0.4, 0.4), "Z": (0.0, 0.5)}
POSITIONS = {"A": (0.5, 0.0, -0.05), "C": (0.5, 0.0, 0.0)}


def five_axes(**changes):
    given = {"chain": FIVE_AXES, "travel": TRAVEL, "positions": POSITIONS, "fixed": {"A": 0.0, "C": 0.5}} | changes
    return MachineDescription("Five axes", **given)


def test_names_its_axes_and_those_that_move_in_the_order_of_commands():
    machine = five_axes(fixed={"A": 0.0}, travel=TRAVEL | {"C": (-3.0, 3.0)})
    assert machine.axes == ("X", "Y", "Z", "A", "C")
    assert machine.moving_axes == ("X", "Y", "Z", "C")
    assert machine.moving_chain == "workpiece-C-bed-X-Y-Z-spindle-tool"


@pytest.mark.parametrize(
    ("chain", "axes"),
    [
        ("workpiece-bed-X-Y-Z-spindle-tool", "XYZ"),
        ("workpiece-X-Y-bed-Z-spindle-tool", "Z"),
        ("workpiece-Y-bed-X-Z-tool", "XZ"),
        ("workpiece-X-Y-Z-bed-spindle-tool", ""),
    ],
)
def test_names_the_linear_axes_that_carry_the_tool(chain, axes):
    assert MachineDescription("Any", chain, TRAVEL).tool_axes == axes


def test_the_model_has_its_rotary_axes_where_the_description_says():
    machine = five_axes().machine()
    assert {joint.name: tuple(joint.reference) for joint in machine.joints if joint.rotary} == POSITIONS


def test_commands_of_moving_axes_are_completed_by_the_fixed_angles():
    moving = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(five_axes().commands(moving), [[0, 1, 2, 0, 0.5], [3, 4, 5, 0, 0.5]])
    with pytest.raises(ValueError, match=r"expected commands of shape \(..., 3\) for X Y Z; found \(2, 4\)"):
        five_axes().commands(np.zeros((2, 4)))


def test_fixed_table_below_all_linear_axes_keeps_their_directions():
    # The fixed angle turns the frame of the workpiece; the way of the tool between two positions is the same.
    full, linear = five_axes().machine(), Machine(five_axes().moving_chain)
    q = np.array([[0.1, 0.2, 0.3], [0.4, -0.1, 0.2]])
    at = full.nominal_pose(five_axes().commands(q))
    way = at[1].apply(np.zeros(3)) - at[0].apply(np.zeros(3))
    turned = Machine("workpiece-C-A-bed-X-tool").nominal_pose([[0.0, 0.0, 0.5]])[0].rotation
    plain = linear.nominal_pose(q)
    expected = plain[1].apply(np.zeros(3)) - plain[0].apply(np.zeros(3))
    np.testing.assert_allclose(way, turned.apply(expected), atol=1e-15)


@pytest.mark.parametrize(
    ("changes", "key", "text"),
    [
        ({"chain": "workpiece-X-Y-Z-tool"}, "chain", "over one 'bed'"),
        ({"chain": "workpiece-X-Y-bed-X-spindle-tool"}, "chain", "found X 2 times"),
        ({"chain": "workpiece-X-Q-bed-Z-spindle-tool"}, "chain", "found 'Q'"),
        ({"spindle_axis": "C"}, "spindle_axis", "X, Y or Z; found 'C'"),
        ({"travel": {"X": (0, 1), "Z": (0, 1)}}, "travel.Y", "missing; expected the lowest and the highest"),
        ({"fixed": {"A": 0.0}}, "travel.C", "missing"),
        ({"travel": TRAVEL | {"W": (0.0, 1.0)}}, "travel.W", "has no axis W"),
        ({"travel": TRAVEL | {"X": (1.0, 0.0)}}, "travel.X", "before the highest; found 1 m, 0 m"),
        ({"travel": TRAVEL | {"X": (1.0, 1.0)}}, "travel.X", "before the highest"),
        ({"travel": TRAVEL | {"Y": (np.nan, 1.0)}}, "travel.Y", "found nan m, 1 m"),
        ({"positions": {"A": (0.0, 0.0, 0.0)}}, "rotary.C.position", "missing; expected a point on the line of C"),
        ({"positions": POSITIONS | {"A": (0.0, 0.0)}}, "rotary.A.position", "three finite coordinates"),
        ({"positions": POSITIONS | {"B": (0.0, 0.0, 0.0)}}, "rotary.B", "has no axis B"),
        ({"fixed": {"A": 0.0, "C": 0.0, "X": 0.0}}, "rotary.X", "X is a linear axis"),
        (
            {"travel": TRAVEL | {"C": (0.0, 0.4)}},
            "rotary.C.fixed",
            "within the travel, 0 rad to 0.4 rad; found 0.5 rad",
        ),
        ({"fixed": {"A": 0.0, "C": np.inf}}, "rotary.C.fixed", "expected an angle; found inf rad"),
    ],
)
def test_inconsistent_description_is_refused_with_the_key(changes, key, text):
    with pytest.raises(DescriptionError) as caught:
        five_axes(**changes)
    assert list(caught.value.mistakes) == [key]
    assert text in caught.value.mistakes[key]


def test_a_fixed_angle_between_linear_axes_would_turn_some_of_them():
    chain = "workpiece-X-C-bed-Y-Z-spindle-tool"
    travel, positions = dict.fromkeys("XYZ", (0.0, 1.0)), {"C": (0.0, 0.0, 0.0)}
    at_zero = MachineDescription("Any", chain, travel, positions=positions, fixed={"C": 0.0})
    assert at_zero.moving_axes == ("X", "Y", "Z")
    with pytest.raises(DescriptionError, match=r"rotary\.C\.fixed: expected 0 rad.*both sides of C"):
        MachineDescription("Any", chain, travel, positions=positions, fixed={"C": 0.1})


def test_all_mistakes_are_reported_together():
    with pytest.raises(DescriptionError) as caught:
        MachineDescription(" ", FIVE_AXES, {"X": (1, 0), "W": (0, 1)}, "C")
    assert set(caught.value.mistakes) == {
        "name", "spindle_axis", "travel.X", "travel.Y", "travel.Z", "travel.A", "travel.C", "travel.W",
        "rotary.A.position", "rotary.C.position",
    }  # fmt: skip
