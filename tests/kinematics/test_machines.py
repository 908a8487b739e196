import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from errormotion.kinematics.axes import Axis, ErrorMotion
from errormotion.kinematics.machines import Machine
from errormotion.kinematics.twists import move

CFRAME = "workpiece-X-Y-bed-Z-spindle-tool"
CHAINS = [
    CFRAME,
    "workpiece-bed-Y-X-Z-spindle-tool",
    "workpiece-Y-bed-X-Z-tool",
    "workpiece-C-A-Y-bed-X-Z-spindle-tool",
    "workpiece-X-bed-Y-Z-C-B-spindle-tool",
    "workpiece-C-bed-Z-W-X-tool",
]
TOOL = np.array([0.05, -0.1, -0.2])


def references(machine):
    rng = np.random.default_rng(7)
    return {axis: rng.uniform(-0.5, 0.5, 3) for axis in machine.axis_names}


def machine_of(chain):
    return Machine(chain, references(Machine(chain)))


def commands(machine, n=5):
    return np.random.default_rng(3).uniform(-0.6, 0.6, (n, len(machine.axis_names)))


def test_three_linear_axes_have_21_errors():
    names = Machine(CFRAME).error_names
    assert len(names) == len(set(names)) == 21
    assert names[:6] == ("EXX", "EYX", "EZX", "EAX", "EBX", "ECX")
    assert names[18:] == ("EC0Y", "EA0Z", "EB0Z")


def test_order_of_commands_does_not_depend_on_the_chain():
    assert Machine("workpiece-bed-Z-Y-X-tool").axis_names == ("X", "Y", "Z")
    assert Machine("workpiece-C-A-Y-bed-X-Z-tool").axis_names == ("X", "Y", "Z", "A", "C")


def test_rotary_axes_add_six_motions_and_four_location_errors_each():
    assert len(Machine("workpiece-C-A-Y-bed-X-Z-tool").error_names) == 21 + 2 * 10


@pytest.mark.parametrize("chain", CHAINS)
def test_jacobian_is_the_derivative_of_the_exact_model(chain):
    machine = machine_of(chain)
    q = commands(machine)
    n, step = len(machine.error_names), 1e-5
    ahead = np.stack([machine.volumetric_error(q, +step * e, TOOL, exact=True) for e in np.eye(n)], axis=-1)
    behind = np.stack([machine.volumetric_error(q, -step * e, TOOL, exact=True) for e in np.eye(n)], axis=-1)
    # Central differences: rounding 1e-16 m / 1e-5, truncation step^2 * lever.
    np.testing.assert_allclose(machine.jacobian(q, TOOL), (ahead - behind) / (2 * step), atol=2e-9)


@pytest.mark.parametrize("chain", CHAINS)
def test_first_order_differs_from_exact_by_products_of_errors(chain):
    machine = machine_of(chain)
    q = commands(machine)
    errors = np.random.default_rng(9).normal(size=len(machine.error_names)) * 1e-3

    def missed(scale):
        exact = machine.volumetric_error(q, scale * errors, TOOL, exact=True)
        return np.abs(exact - machine.volumetric_error(q, scale * errors, TOOL)).max()

    assert missed(1.0) < 20 * len(machine.joints) ** 2 * 1e-6
    assert missed(0.1) == pytest.approx(0.01 * missed(1.0), rel=0.05)


@pytest.mark.parametrize("chain", CHAINS)
def test_no_error_without_axis_errors(chain):
    machine = machine_of(chain)
    none = np.zeros(len(machine.error_names))
    q = commands(machine)
    np.testing.assert_array_equal(machine.volumetric_error(q, none, TOOL), 0.0)
    np.testing.assert_allclose(machine.volumetric_error(q, none, TOOL, exact=True), 0.0, atol=1e-15)


def test_a_positive_command_takes_the_tool_forward_whichever_side_moves():
    for chain in CHAINS[:3]:
        moved = Machine(chain).nominal_pose([0.1, 0.2, 0.3]).apply([0.0, 0.0, 0.0])
        np.testing.assert_allclose(moved, [[0.1, 0.2, 0.3]], atol=1e-16)


def test_rotary_table_turns_the_tool_around_the_workpiece():
    machine = Machine("workpiece-C-bed-X-tool", {"C": [0.1, 0.0, 0.0]})
    pose = machine.nominal_pose([0.0, np.pi / 2])
    np.testing.assert_allclose(pose.apply([0.3, 0.0, 0.0]), [[0.1, 0.2, 0.0]], atol=1e-16)


def test_error_motions_have_the_effect_of_their_names():
    machine = Machine(CFRAME)
    error = dict.fromkeys(machine.error_names, 0.0) | {"EXX": 1e-6}
    twist = machine.volumetric_error([0.1, 0.2, 0.3], list(error.values()))
    np.testing.assert_allclose(twist, [1e-6, 0, 0, 0, 0, 0], atol=1e-20)

    # The pitch of a carriage acts through the height of the tool above the carriage's reference.
    carriage_below = Machine(CFRAME, {"Z": [0.0, 0.0, 0.4]})
    error = dict.fromkeys(machine.error_names, 0.0) | {"EBZ": 10e-6}
    twist = carriage_below.volumetric_error([0.1, 0.2, 0.3], list(error.values()), [0, 0, 0.1])
    np.testing.assert_allclose(twist, [10e-6 * -0.3, 0, 0, 0, 10e-6, 0], atol=1e-18)


def test_reference_moves_with_the_moving_body():
    # Yaw of X acts on the tool's distance from the reference: on the table it stays, on the tool's slide it moves.
    yaw = dict.fromkeys(Machine(CFRAME).error_names, 0.0) | {"ECX": 1e-6}
    on_table = Machine(CFRAME).volumetric_error([0.5, 0.0, 0.0], list(yaw.values()))
    on_slide = Machine("workpiece-Y-bed-X-Z-tool").volumetric_error([0.5, 0.0, 0.0], list(yaw.values()))
    np.testing.assert_allclose(on_table[:3], [0, 0.5e-6, 0], atol=1e-20)
    np.testing.assert_allclose(on_slide[:3], [0, 0, 0], atol=1e-20)


@pytest.mark.parametrize("chain", CHAINS[:3])
def test_squareness_tilts_the_axis_without_a_rotation(chain):
    machine = machine_of(chain)
    place = [0.3, 0.2, 0.1]
    for name, expected in {
        "EC0Y": [-0.2, 0, 0],  # Y turned about +Z goes towards -X
        "EA0Z": [0, -0.1, 0],  # Z turned about +X goes towards -Y
        "EB0Z": [0.1, 0, 0],  # Z turned about +Y goes towards +X
    }.items():
        errors = dict.fromkeys(machine.error_names, 0.0) | {name: 1e-6}
        twist = machine.volumetric_error(place, list(errors.values()), TOOL)
        np.testing.assert_allclose(twist * 1e6, [*expected, 0, 0, 0], atol=1e-12)


def test_displaced_line_of_a_rotary_table_shows_when_it_turns():
    machine = Machine("workpiece-C-bed-X-tool")
    errors = dict.fromkeys(machine.error_names, 0.0) | {"EX0C": 1e-6}
    at_rest = machine.volumetric_error([0.0, 0.0], list(errors.values()))
    np.testing.assert_allclose(at_rest, 0, atol=1e-20)
    half_turn = machine.volumetric_error([0.0, np.pi], list(errors.values()))
    np.testing.assert_allclose(half_turn, [2e-6, 0, 0, 0, 0, 0], atol=1e-18)


def test_moving_every_reference_with_its_errors_changes_nothing():
    machine, moved_machine = Machine(CFRAME), machine_of(CFRAME)
    twist = np.random.default_rng(2).normal(size=(3, 6)) * 1e-5
    moved = [
        move(twist[i], moved_machine_reference)
        for i, moved_machine_reference in enumerate(references(machine).values())
    ]
    q = commands(machine)
    places = np.zeros(3)
    np.testing.assert_allclose(
        machine.volumetric_error(q, [*twist.ravel(), *places], TOOL),
        moved_machine.volumetric_error(q, [*np.ravel(moved), *places], TOOL),
        atol=1e-19,
    )


def test_errors_come_from_the_axes_functions():
    machine = Machine(CFRAME)
    table = ErrorMotion(np.array([0.0, 0.5]), np.array([np.zeros(6), np.arange(1.0, 7.0)]) * 1e-6)
    q = np.array([[0.25, 0.1, 0.1], [0.5, 0.1, 0.1]])
    errors = machine.errors_at(q, {"X": table, "Y": table, "Z": table}, {"EC0Y": 3e-6, "EA0Z": 0, "EB0Z": 0})
    np.testing.assert_allclose(errors[0, :6], np.arange(1.0, 7.0) * 0.5e-6)
    assert errors[1, 18] == 3e-6
    assert machine.volumetric_error(q, errors).shape == (2, 6)


def test_unknown_errors_are_nan_where_they_matter():
    machine = Machine(CFRAME)
    table = ErrorMotion(np.array([0.0]), np.zeros((1, 6)))
    squareness = {"EC0Y": 0.0, "EA0Z": 0.0, "EB0Z": 0.0}
    errors = machine.errors_at(np.zeros(3), {"X": table, "Y": table}, squareness)
    assert np.isnan(errors[12:18]).all()
    assert np.isnan(machine.volumetric_error(np.zeros(3), errors)).all()
    errors[12:17] = 0.0  # only ECZ unknown, and the tool stands on its line
    np.testing.assert_array_equal(machine.volumetric_error(np.zeros(3), errors), [0, 0, 0, 0, 0, np.nan])
    assert np.isnan(machine.volumetric_error(np.zeros(3), errors, exact=True)).all()


def test_error_motion_is_linear_between_and_unknown_outside():
    motion = ErrorMotion(np.array([0.0, 1.0, 3.0]), np.arange(18.0).reshape(3, 6))
    np.testing.assert_allclose(motion(2.0), [9, 10, 11, 12, 13, 14])
    assert np.isnan(motion([-0.1, 3.1])).all()
    assert motion(np.zeros((2, 4))).shape == (2, 4, 6)


def test_error_motion_of_a_rotary_axis_is_periodic():
    angle = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    motion = ErrorMotion(angle, np.sin(angle)[:, None] * np.ones(6), period=2 * np.pi)
    np.testing.assert_allclose(motion(angle + 8 * np.pi), motion(angle), atol=1e-14)


@pytest.mark.parametrize(
    ("chain", "message"),
    [
        ("X-Y-Z", "expected a chain from 'workpiece'"),
        ("workpiece-X-Y-Z-tool", "one 'bed'"),
        ("workpiece-X-bed-Q-tool", "found 'Q'"),
        ("workpiece-X-bed-X-tool", "once"),
        ("workpiece-spindle-bed-X-tool", "only before 'tool'"),
        ("workpiece-bed-tool", "at least one"),
    ],
)
def test_a_wrong_chain_is_refused(chain, message):
    with pytest.raises(ValueError, match=message):
        Machine(chain)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Machine(CFRAME, {"C": [0, 0, 0]}), "found one for C"),
        (lambda: Machine(CFRAME, {"X": [0, 0]}), "three coordinates"),
        (lambda: Machine(CFRAME).jacobian([0.0, 0.0]), r"expected commands \(..., 3\)"),
        (lambda: Machine(CFRAME).volumetric_error(np.zeros(3), np.zeros(6)), r"errors of shape \(..., 21\)"),
        (lambda: Machine(CFRAME).errors_at(np.zeros(3), {"C": np.zeros}), "has no C"),
        (lambda: Machine(CFRAME).errors_at(np.zeros(3), {}, {"EC0Z": 0.0}), "has no EC0Z"),
        (lambda: ErrorMotion(np.array([0.0, 0.0]), np.zeros((2, 6))), "strictly increasing"),
        (lambda: ErrorMotion(np.array([0.0, 1.0]), np.zeros((3, 6))), r"twists of shape \(n, 6\)"),
        (lambda: ErrorMotion(np.array([0.0, 7.0]), np.zeros((2, 6)), period=6.28), "one period"),
        (lambda: Axis("Q", True), "found 'Q'"),
    ],
)
def test_wrong_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_exact_model_multiplies_the_poses_of_the_chain():
    # By hand, for one yawing carriage on the tool's side: the tool turns about the carriage's reference.
    machine = Machine("workpiece-bed-X-tool", {"X": [0.2, 0.0, 0.0]})
    errors = dict.fromkeys(machine.error_names, 0.0) | {"EYX": 0.01, "ECX": 0.3}
    turned = RigidTransform.from_components([0.7, 0.01, 0.0], Rotation.from_rotvec([0, 0, 0.3]))
    expected = turned.apply([0.4, 0.0, 0.0]) - [1.1, 0.0, 0.0]
    twist = machine.volumetric_error([0.5], list(errors.values()), [0.6, 0.0, 0.0], exact=True)
    np.testing.assert_allclose(twist, [*expected, 0, 0, 0.3], atol=1e-15)
