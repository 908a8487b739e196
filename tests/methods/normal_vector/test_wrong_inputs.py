"""What is wrong with the data is said in a sentence that names it and what to do."""

import numpy as np
import pytest
import xarray as xr
from pydantic import ValidationError

from errormotion.errors import DatasetError, MethodError
from errormotion.methods.normal_vector import NormalVector, NormalVectorSettings

METHOD = NormalVector()


def moved(raw, shift):
    """Return the data of balls that stand elsewhere by ``shift`` (ball, 3), m."""
    shift = xr.DataArray(shift, dims=("ball", "direction"))
    return raw.assign({name: (raw[name] + shift).transpose(*raw[name].dims).assign_attrs(units="m")
                       for name in ("touch", "ball_nominal")})  # fmt: skip


def refused(raw, match, error=MethodError, **settings):
    with pytest.raises(error, match=match):
        METHOD.identify(raw, NormalVectorSettings(**settings))


def test_fewer_than_three_balls(probed):
    refused(probed()[1].isel(ball=[0, 1]), "Expected 3 balls or more.*found 2")


def test_balls_in_one_line(probed):
    _, raw = probed()
    line = raw["ball_nominal"][0].values + np.outer([0, 1, 2, 3], [1.0, 0.1, 0.0])
    raw = moved(raw, line - raw["ball_nominal"].values)
    refused(raw, "lie in one line.*Set up one ball as far")


def test_balls_at_one_height_on_a_c_frame_are_enough_for_a_gantry_alone(probed):
    _, raw = probed("cframe")
    shift = np.zeros((4, 3))
    shift[:, 2] = 0.1 - raw["ball_nominal"].values[:, 2]
    raw = moved(raw, shift)
    refused(raw, r"only by balls at different positions along Z.*EA, EB cannot be distinguished.*posts")
    errors = METHOD.identify(raw.assign_attrs(tool_axes="XYZ"), NormalVectorSettings(robust=False))
    assert np.isfinite(errors["EC"]).all()
    assert any("both normals are equal" in note for note in errors.attrs["notes"])


def test_no_axis_carries_the_tool_so_that_only_displacements_show(probed):
    errors = METHOD.identify(probed("cframe")[1].assign_attrs(tool_axes=""), NormalVectorSettings(robust=False))
    assert np.isnan(errors["EA"]).all()
    assert np.isfinite(errors["EX"]).all()


def test_unknown_axes(probed):
    refused(probed()[1].assign_attrs(tool_axes="ZX"), "tool_axes: expected the linear axes.*found 'ZX'")


def test_too_few_touches_for_a_sphere(probed):
    refused(probed()[1].isel(touch=slice(0, 3)), "Ball B1 was touched in 3 directions; a sphere needs four")
    refused(probed()[1].isel(touch=slice(0, 4)), "no sphere through its touches.*one plane")


def test_ball_that_was_never_touched(probed):
    _, raw = probed()
    raw["touch"][:, 2] = np.nan
    refused(raw, "Ball B3 was never touched")


@pytest.mark.parametrize("kind", ["gantry", "cframe"])
def test_millimetres_for_metres(probed, kind):
    _, raw = probed(kind)
    raw["touch"] = (raw["touch"] * 1e3).assign_attrs(units="m")
    refused(raw, "is it in mm", DatasetError)


def test_radii_that_the_touches_contradict(probed):
    _, raw = probed()
    raw["ball_radius"] = (raw["ball_radius"] * 2).assign_attrs(units="m")
    refused(raw, "lie on a sphere of radius 15.5 mm; expected 28 mm")


def test_balls_in_another_order_than_stated(probed):
    _, raw = probed()
    raw["ball_nominal"] = raw["ball_nominal"].copy(data=raw["ball_nominal"].values[[1, 0, 2, 3]])
    refused(raw, "Ball B1 was found at the position of ball B2")


def test_ball_far_from_its_position(probed):
    _, raw = probed()
    raw["ball_nominal"][2, 0] += 0.05
    refused(raw, "Ball B3 was found 50.1 mm from its nominal position")


def test_balls_in_another_order_in_one_cycle(probed):
    _, raw = probed()
    raw["touch"][3] = raw["touch"].values[3, [1, 0, 2, 3]]
    refused(raw, "In cycle 3 ball B1 was touched at the position of ball B2")


def test_another_object_was_touched(probed):
    _, raw = probed()
    raw["touch"][3, 2] += 0.02
    refused(raw, "In cycle 3 ball B3 was touched 34.64 mm from its touches")


def test_time_that_does_not_increase(probed):
    refused(probed()[1].isel(time=[0, 2, 1]), "expected increasing seconds", DatasetError)


def test_touches_on_another_clock(probed):
    _, raw = probed()
    raw["touch_time"] = (raw["touch_time"] * 0 + raw["touch_time"].values[0]).assign_attrs(units="s")
    refused(raw, "touch_time: expected cycle 0 to end before cycle 1 starts")


def test_cold_cycle_that_is_missing(probed):
    _, raw = probed()
    refused(
        raw.isel(time=slice(2, None)), 'cold cycle is missing: expected the first cycle at 0 s.*reference = "first"'
    )
    raw["touch"][0] = np.nan
    refused(raw, "cycle 0 has no good touch")


def test_one_cycle_only(probed):
    refused(probed()[1].isel(time=[0]), "at least one more")


def test_no_good_touch_at_all(probed):
    _, raw = probed()
    raw["touch_flag"] = raw["touch_flag"] * 0 + 1
    raw["touch_flag"].attrs["units"] = "1"
    refused(raw, "none that is good")


def test_flags_are_counted_by_name(probed):
    _, raw = probed()
    raw["touch_flag"][2, 1, 3] = 3
    errors = METHOD.identify(raw)
    assert "1 touches are flagged: repeat differs." in errors.attrs["notes"]
    assert errors["left_out"].values[2, 1, 3] == 1


def test_noise_of_zero(probed):
    _, raw = probed()
    raw["touch_noise"] = raw["touch_noise"] * 0
    raw["touch_noise"].attrs["units"] = "m"
    refused(raw, "touch_noise: expected more than 0 m")


def test_normals_where_they_are_not_determined(probed):
    refused(probed("cframe")[1], "procedure = normals: .*shears", procedure="normals")
    refused(probed(balls=3)[1], "procedure = normals: .*need four balls; found 3", procedure="normals")
    refused(probed()[1], "expected names of B1, B2, B3, B4; found B9", normals_balls=("B1", "B2", "B3", "B9"))


def test_data_of_another_method(probed):
    raw = probed()[1].assign_attrs(schema="errormotion.raw.other/1")
    refused(raw, "raw.other", DatasetError)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"normals_balls": ("1", "2", "3", "5")}, "normals_balls: expected names of 1, 2, 3, 4; found 5"),
        ({"centre_of_4": (0.42, 0.0, 0.0)}, "balls: expected separate balls; 2 and 4 overlap"),
    ],
)
def test_invalid_balls_are_refused_before_any_touch(settings, said):
    places = [(0.0, 0.0, 0.0), (0.4, 0.0, 0.0), (0.0, 0.3, 0.0), settings.pop("centre_of_4", (0.4, 0.3, 0.2))]
    balls = [{"centre": [f"{x * 1e3} mm" for x in place]} for place in places]
    with pytest.raises(ValidationError, match=said):
        NormalVectorSettings(balls=balls, **settings)
