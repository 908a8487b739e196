"""The 21 geometric errors."""

import numpy as np
import pytest

from errormotion.datasets import validate
from errormotion.errors import BenchError
from errormotion.twin import VirtualMachine


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


def test_along_the_last_axis_before_the_tool_the_volume_shows_that_axis_alone(either):
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


def test_an_unknown_axis_names_the_known_ones(machine):
    with pytest.raises(BenchError, match="X, Y, Z"):
        machine.truth_axis("A", [0.0])


def test_the_quick_way_to_the_displacement_is_the_model_itself(either):
    low, high = np.array([either.travel[axis] for axis in "XYZ"]).T
    places = low + np.random.default_rng(0).uniform(size=(40, 3)) * (high - low)
    # sums of some 10 um in another order: 1e-16 of that, some times
    np.testing.assert_allclose(
        either.geometry.displacement(places), either.geometry.twist(places)[:, :3], rtol=0, atol=1e-19
    )
