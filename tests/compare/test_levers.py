"""A probing on a machine whose table moves: its rotations and its functional point are not those of a rigid tool."""

import numpy as np
import pytest
from coded import raises
from scipy.spatial.transform import RigidTransform, Rotation
from typer.testing import CliRunner

from errormotion import datasets
from errormotion.cli.app import app
from errormotion.compare import compare
from errormotion.errors import DatasetError


def test_the_probing_states_the_levers_of_its_rotations(results):
    assert results["probing"].attrs["lever_axes"] == "Z"
    assert "lever_axes" not in results["drift"].attrs


def test_rotations_of_different_bodies_are_not_compared(results):
    message = r"rotations \(EA, EB\) are those of different bodies.*'drift': XYZ; 'probing': Z.*--freedoms EX,EY,EZ"
    with pytest.raises(DatasetError, match=message):
        compare(results)
    with raises("compare.bodies.differ"):
        compare(results, freedoms=["EA"])
    assert compare(results, freedoms=["EX", "EY", "EZ"], causes=False).sizes["dof"] == 3


def test_two_probings_of_one_machine_are_compared(results, warm_up):
    found = compare({"one": results["probing"], "other": warm_up(3)["probing"].isel(time=slice(1, None))}, causes=False)
    assert {"EA", "EB"} <= {str(name) for name in found["dof"].values}


def test_errors_are_transformed_along_their_levers_only(results):
    probing = results["probing"]
    np.testing.assert_allclose(
        probing.em.at((0.0, 0.0, -0.1))["EX"], probing["EX"] - 0.1 * probing["EB"], rtol=1e-9, atol=1e-15
    )
    with raises("errors.point.not_rigid"):
        probing.em.at((0.1, 0.2, 0.0))
    with raises("errors.frame.not_rigid"):
        probing.em.in_frame(RigidTransform.from_rotation(Rotation.from_euler("z", 0.1)), "turned")
    shifted = probing.em.in_frame(RigidTransform.from_translation([1.0, 0.0, 0.0]), "shifted")
    np.testing.assert_array_equal(shifted["EX"], probing["EX"])


def test_the_command_line_states_where_they_can_be_compared(results, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    datasets.save(results["drift"].em.at((0.05, 0.0, 0.0)), "drift.nc")
    datasets.save(results["probing"], "probing.nc")
    refused = CliRunner().invoke(app, ["compare", "drift.nc", "probing.nc", "--freedoms", "EX,EZ"])
    assert refused.exit_code == 1
    assert "cannot be moved along X" in refused.stderr
    assert "compare at its own point (--at 0,0,0)" in refused.stderr
    there = CliRunner().invoke(app, ["compare", "drift.nc", "probing.nc", "--freedoms", "EX,EZ", "--at", "0,0,0"])
    assert there.exit_code == 0, there.output


@pytest.mark.parametrize("axes", ["ZX", "", "W", 7])
def test_invalid_levers_are_an_error(results, axes):
    with pytest.raises(DatasetError, match="attribute 'lever_axes': expected one of X, Y, Z"):
        datasets.validate(results["probing"].assign_attrs(lever_axes=axes))
