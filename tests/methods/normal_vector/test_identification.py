"""From touches of the virtual machine to its errors, with true uncertainties, on a gantry and on a C-frame."""

import json

import numpy as np
import pytest
import xarray as xr

from errormotion.datasets import validate
from errormotion.errors import MethodError
from errormotion.kinematics.iso import DOF
from errormotion.measurement.identification import solve
from errormotion.methods.normal_vector import NormalVector, NormalVectorSettings
from errormotion.methods.normal_vector.conformance import subjects

METHOD = NormalVector()


def sigma(errors):
    return np.sqrt(np.einsum("kii->ki", errors["covariance"].values))


def test_recovers_truth_with_true_uncertainty_on_a_gantry(probed, off):
    """The C-frame is the subject of the conformance kit."""
    z, alarms = [], 0
    for seed in range(25):
        machine, raw = probed("gantry", seed)
        errors = METHOD.identify(raw)
        z.append(off(machine, errors)[1:])
        alarms += int((errors["left_out"].values > 1).any())
    z = np.array(z)
    # 25 seeds; the cycles of a seed share half of their variance: the standard deviation of the mean square of one
    # freedom is sqrt(0.5 / 25 * 1.3), of all together about 0.07.
    assert abs(np.mean(z**2) - 1) < 0.3
    assert np.mean(np.abs(z) <= 1.96) > 0.9
    assert np.abs(z).max() < 4.5
    assert alarms == 0


def test_c_frame_taken_for_a_gantry_is_reported(probed, off):
    machine, raw = probed("cframe", seed=3)
    del raw.attrs["tool_axes"]
    right, wrong = (METHOD.identify(raw, NormalVectorSettings(tool_axes=axes, robust=False)) for axes in ("Z", "XYZ"))
    assert np.nanmax(np.abs(off(machine, right))) < 4
    assert any("scatter" in note and "tool_axes" in note for note in wrong.attrs["notes"])
    assert not any("scatter" in note for note in right.attrs["notes"])
    # The machine's turn about X shears the balls along Y and does not lift them: a rigid motion takes half of it.
    assert np.abs(wrong["EA"].values[-1] - right["EA"].values[-1]) > 10 * sigma(right)[-1, 3]


@pytest.mark.parametrize("noise", ["stated", "unknown"])
@pytest.mark.parametrize(("kind", "stated", "right"), [("cframe", "XYZ", "Z"), ("gantry", "Z", "XYZ")])
def test_axes_that_contradict_the_touches_are_refused_with_those_that_agree(probed, kind, stated, right, noise):
    """Balls at rest seem to move, and without them the other touches agree: one true error in four was within U."""
    for seed in range(3):
        _, raw = probed(kind, seed)
        raw = raw if noise == "stated" else raw.drop_vars("touch_noise")
        with pytest.raises(MethodError, match=f"contradict tool_axes = {stated},.*agree with .*{right}"):
            METHOD.identify(raw.assign_attrs(tool_axes=stated))


def test_a_ball_that_moved_is_no_contradiction_of_the_axes(probed):
    for balls in (4, 5):
        raw = probed("cframe", 2, balls=balls, moved=(1, 1500.0, (4e-6, -3e-6, 3e-6)))[1]
        notes = " ".join(METHOD.identify(raw).attrs["notes"])
        assert "moved before cycle 3" in notes
        assert "would agree" not in notes


def test_assumed_axes_of_the_tool_are_in_a_note(probed):
    raw = probed()[1]
    unknown = raw.drop_attrs(deep=False).assign_attrs({k: v for k, v in raw.attrs.items() if k != "tool_axes"})
    assumed = "Assumed, because it is not stated: X, Y and Z carry the tool (tool_axes = XYZ)."
    assert assumed in METHOD.identify(unknown).attrs["notes"]
    for stated in (METHOD.identify(raw), METHOD.identify(unknown, NormalVectorSettings(tool_axes="XYZ"))):
        assert assumed not in stated.attrs["notes"]


def test_without_interpolation_a_cycle_has_the_mean_time_of_its_valid_touches(probed):
    """The motion is the mean over the touches: at the start of the cycle it would be that of another time."""
    _, raw = probed("cframe", 1)
    flag = raw["touch_flag"].values.copy()
    flag[2, :, :2] = 1  # missing touches are not part of the mean
    raw = raw.assign(touch_flag=(raw["touch_flag"].dims, flag, raw["touch_flag"].attrs))
    errors = METHOD.identify(raw, NormalVectorSettings(interpolate=False))
    expected = np.where(flag == 0, raw["touch_time"].values, np.nan)
    np.testing.assert_allclose(errors["time"].values, np.nanmean(expected, axis=(1, 2)), atol=1e-9)
    assert errors["time"].values[2] > raw["touch_time"].values[2].mean() + 1.0
    np.testing.assert_array_equal(errors["cycle_time"].values, raw["time"].values)
    untimed = METHOD.identify(raw.drop_vars("touch_time"), NormalVectorSettings(interpolate=False))
    np.testing.assert_array_equal(untimed["time"].values, raw["time"].values)


def test_data_state_the_axes_that_carry_the_tool(probed):
    _, raw = probed("cframe")
    errors = METHOD.identify(raw, NormalVectorSettings(tool_axes="XYZ"))
    assert errors.attrs["tool_axes"] == "Z"
    assert np.isnan(errors["EC"]).all()
    assert np.isnan(errors["normals_errors"]).all()
    assert "the setting XYZ was not used" in errors.attrs["notes"][0]
    assert "shears" in errors.attrs["notes"][1]


def test_result_contains_the_variables_for_reports_and_models(probed):
    machine, raw = probed()
    errors = METHOD.identify(raw)
    validate(errors)
    assert errors.attrs["component"] == "tool"
    assert errors["EX"].dims == ("time",)
    assert list(errors["ball"].values) == list(raw["ball"].values)
    assert errors["centre"].dims == errors["ball_displacement"].dims == ("time", "ball", "direction")
    assert errors["residual"].dims == errors["left_out"].dims == ("time", "ball", "touch")
    np.testing.assert_array_equal(errors["temperature"].values, raw["temperature"].values)
    np.testing.assert_array_equal(errors["cycle_time"].values, raw["time"].values)
    np.testing.assert_allclose(errors["time"].values, raw["time"].values + 60.0)  # the middle of two minutes
    np.testing.assert_allclose(errors["centre"][0], machine.balls.centre, atol=0.5e-3)  # geometric errors
    assert set(errors["source_group"].values) == {"cold reference"}
    assert json.loads(errors.attrs["provenance"])["settings"]["procedure"] == "rigid"


def test_apparent_motion_of_balls_is_opposite_to_the_error(probed):
    _, raw = probed()
    errors = METHOD.identify(raw)
    shift = errors["ball_displacement"].values[-1].mean(axis=0)
    error = np.array([errors[name].values[-1] for name in ("EX", "EY", "EZ")])
    np.testing.assert_allclose(shift, -error, atol=0.3e-6)  # the functional point is the balls' mean


def test_error_at_another_point_is_that_of_the_moved_twist(probed):
    _, raw = probed()
    here, there = METHOD.identify(raw), METHOD.identify(raw, NormalVectorSettings(functional_point=(0.5, 0.2, 0.1)))
    moved = here.em.at((0.5, 0.2, 0.1))
    for name in DOF:
        # The same up to the square of the turn, 1e-9 of the lever.
        np.testing.assert_allclose(there[name], moved[name], atol=1e-9)
    np.testing.assert_allclose(sigma(there), sigma(moved), rtol=1e-3)


def test_missing_touches_only_increase_the_uncertainty(probed, off):
    machine, raw = probed(missing=0.15)
    errors, whole = METHOD.identify(raw), METHOD.identify(probed()[1])
    assert np.nanmax(np.abs(off(machine, errors))) < 4
    assert (sigma(errors)[1:] > sigma(whole)[1:] * 1.0).mean() > 0.9
    assert any("missing" in note for note in errors.attrs["notes"])
    assert (errors["left_out"].values == 1).sum() == np.isnan(raw["touch"].values[..., 0]).sum()


def test_cycle_without_touches_is_unknown_and_the_others_are_not(probed, off):
    machine, raw = probed()
    raw["touch"][3] = np.nan
    errors = METHOD.identify(raw)
    assert np.isnan(errors["EX"].values).tolist() == [False, False, False, True, False, False, False]
    assert np.nanmax(np.abs(off(machine, errors))) < 4
    assert any("unknown: 3" in note for note in errors.attrs["notes"])


def test_missing_ball_in_a_cycle_increases_its_uncertainty(probed, off):
    machine, raw = probed()
    raw["touch"][3, 1] = np.nan
    errors = METHOD.identify(raw)
    u = sigma(errors)
    assert np.nanmax(np.abs(off(machine, errors))) < 4
    assert (u[3] > u[5]).all()


def test_ball_missing_in_the_cold_cycle_still_helps_with_rotations(probed, off):
    machine, raw = probed(balls=5)
    raw["touch"][0, 2] = np.nan
    errors = METHOD.identify(raw)
    assert np.nanmax(np.abs(off(machine, errors))) < 4
    assert np.isfinite(errors["EX"]).all()


def test_unstated_noise_is_estimated_from_the_residuals(probed):
    _, raw = probed(touches=9)
    stated, found = METHOD.identify(raw), METHOD.identify(raw.drop_vars("touch_noise"))
    # 192 degrees of freedom tell a standard deviation to 5 %; the interval is widened by Student's factor, 1.006.
    assert float(found["noise"]) == pytest.approx(float(stated["noise"]), rel=0.17)
    assert "from the residuals" in found.attrs["notes"][0]


def test_noise_above_the_stated_one_is_reported_and_included(probed):
    _, raw = probed(noise=0.8e-6)
    raw["touch_noise"] = raw["touch_noise"] * 0 + 0.25e-6
    raised, kept = (
        METHOD.identify(raw, NormalVectorSettings(robust=False)),
        METHOD.identify(raw, NormalVectorSettings(noise="stated", robust=False)),
    )
    assert float(raised["noise"]) == pytest.approx(0.8e-6, rel=0.25)
    assert float(kept["noise"]) == pytest.approx(0.25e-6)
    for errors in (raised, kept):
        assert "times as much as stated" in errors.attrs["notes"][0]


@pytest.mark.parametrize("kind", ["gantry", "cframe"])
def test_centres_determine_the_errors_with_a_larger_uncertainty_along_z(probed, off, kind):
    machine, raw = probed(kind, variant="centres", cycle=0.0)
    errors = METHOD.identify(raw)
    assert np.nanmax(np.abs(off(machine, errors))) < 4
    _, touched = probed(kind, cycle=0.0)
    # Whoever made the centres left the radius free in each: along Z that doubles the variance.
    ratio = sigma(errors)[-1, :3] / sigma(METHOD.identify(touched))[-1, :3]
    np.testing.assert_allclose(ratio[:2], 1.0, rtol=0.01)
    assert 1.05 < ratio[2] < 1.5


def test_centres_without_covariance_have_it_from_their_scatter(probed, off):
    machine, raw = probed(variant="centres", cycle=0.0, cycles=19)
    errors = METHOD.identify(raw.drop_vars("centre_covariance"))
    assert 0.1e-6 < float(errors["noise"]) < 0.5e-6
    assert np.nanmax(np.abs(off(machine, errors))) < 5


def test_procedure_normals_gives_the_published_estimate_with_its_own_uncertainty(probed, off):
    machine, raw = probed()
    rigid, normals = METHOD.identify(raw), METHOD.identify(raw, NormalVectorSettings(procedure="normals"))
    np.testing.assert_array_equal(normals["EA"].values, rigid["normals_errors"].sel(dof="EA").values)
    np.testing.assert_allclose(sigma(normals)[1:] / sigma(rigid)[1:], rigid["normals_loss"].values[1:])
    assert np.nanmax(np.abs(off(machine, normals))) < 4
    assert (rigid["normals_loss"].values[1:] > 0.99).all()  # most likely is never worse
    assert rigid["normals_loss"].values[1:].max() > 1.3


def test_normals_of_other_balls_are_other_normals(probed):
    _, raw = probed(balls=6)
    first, other = (
        METHOD.identify(raw, NormalVectorSettings(normals_balls=balls))["normals_loss"].values[-1]
        for balls in (None, ("B2", "B4", "B5", "B1"))
    )
    assert np.abs(first - other).max() > 0.05


def test_first_cycle_for_the_reference_where_there_is_no_cold_one(probed):
    _, raw = probed()
    late = METHOD.identify(raw.isel(time=slice(2, None)), NormalVectorSettings(reference="first"))
    whole = METHOD.identify(raw)
    difference = whole["EZ"].values[2:] - whole["EZ"].values[2]
    np.testing.assert_allclose(
        late["EZ"].values, difference, atol=0.1e-6
    )  # the drift around the first cycle is not known
    assert late["EZ"].values[0] == 0


def test_raw_data_of_single_cycles_joined_are_the_whole(probed):
    _, raw = probed()
    joined = xr.concat([raw.isel(time=[k]) for k in range(raw.sizes["time"])], "time", data_vars="minimal")
    xr.testing.assert_allclose(METHOD.identify(joined)["EX"], METHOD.identify(raw)["EX"])


def test_residuals_hold_no_lobing_of_the_probe(probed):
    _, raw = probed(touches=9, cycles=13)
    errors = METHOD.identify(raw)
    lasting = np.nanmean(errors["residual"].values, axis=0)
    assert np.abs(lasting).max() < 0.3 * float(errors["noise"])  # 0.25 um / sqrt(13), less what is fitted


def test_every_touch_has_its_redundancy_and_the_smallest_error_that_is_found():
    """The redundancies add up to the degrees of freedom; an error of the smallest size moves no result by more."""
    [subject] = subjects()
    raw, _ = subject.make(2)
    method, settings = NormalVector(), subject.effective_settings()
    errors = method.identify(raw, settings)
    used = np.isfinite(errors["redundancy"].values)
    assert errors["redundancy"].dims == errors["residual"].dims
    assert used.sum() == (errors["left_out"].values == 0).sum()
    solution = solve(method.observe(raw, settings))
    assert np.nansum(errors["redundancy"].values) == pytest.approx(solution.white.freedom, rel=1e-6)
    k, ball, touch = 4, 1, 2
    wrong = raw.copy(deep=True)
    position = wrong["touch"].transpose("time", "ball", "touch", "direction")
    along = np.mean(position.values[k, ball], axis=0) - position.values[k, ball, touch]
    size = float(errors["smallest_error"].values[k, ball, touch])
    position.values[k, ball, touch] += size * along / np.linalg.norm(along)
    moved = method.identify(wrong, settings.model_copy(update={"robust": False, "noise": "stated"}))
    plain = method.identify(raw, settings.model_copy(update={"robust": False, "noise": "stated"}))
    change = np.asarray(moved.em.twist() - plain.em.twist())[k]
    seen, C = np.isfinite(change), errors["covariance"].values[k]
    effect = np.sqrt(change[seen] @ np.linalg.solve(C[np.ix_(seen, seen)], change[seen]))
    largest = float(errors["smallest_error_effect"].values[k, ball, touch])
    assert 0.5 * largest < effect < 1.1 * largest  # on this cycle; the largest effect is on it and on the reaches
