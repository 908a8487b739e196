"""A plan says what a set-up will be worth, and what it will not show."""

import numpy as np
import pytest
from coded import raises
from pydantic import ValidationError

from errormotion.errors import MethodError
from errormotion.kinematics.iso import DOF
from errormotion.methods.normal_vector import Ball, NormalVector, NormalVectorSettings
from errormotion.methods.normal_vector.acquisition.touching import touch_normals

METHOD = NormalVector()


def sigma(errors):
    return np.sqrt(np.einsum("kii->ki", errors["covariance"].values))


def settings_of(raw, **more):
    balls = tuple(Ball(centre=tuple(place), radius=12.5e-3, name=str(name))
                  for place, name in zip(raw["ball_nominal"].values, raw["ball"].values, strict=True))  # fmt: skip
    return NormalVectorSettings(balls=balls, interval=600.0, duration=3600.0, tool_axes=raw.attrs["tool_axes"], **more)


@pytest.mark.parametrize("kind", ["gantry", "cframe"])
def test_plan_foretells_what_identification_states(probed, kind):
    _, raw = probed(kind)
    planned, found = METHOD.plan(settings_of(raw)), METHOD.identify(raw)
    assert planned.sizes["time"] == found.sizes["time"] == 7
    # The plan makes all touches of a cycle at once; balls are off their places by 0.1 mm.
    np.testing.assert_allclose(sigma(planned)[2:], sigma(found)[2:], rtol=0.02)
    np.testing.assert_allclose(planned["normals_loss"], found["normals_loss"][-1], rtol=0.02)
    np.testing.assert_array_equal(np.nan_to_num(np.stack([planned[name] for name in DOF])), 0.0)


def test_plan_says_what_a_c_frame_does_not_show(probed):
    planned = METHOD.plan(settings_of(probed("cframe")[1]))
    assert np.isnan(planned["EC"]).all()
    text = " ".join(planned.attrs["notes"])
    assert "Not determined: EC." in text
    assert "tilt of the spindle relative to the last axis" in text


def test_plan_of_balls_that_do_not_do_is_refused():
    one_height = tuple(Ball(centre=(x, y, 0.1)) for x, y in ((0, 0), (0.2, 0), (0, 0.2), (0.2, 0.2)))
    with raises("probing.balls.one_height"):
        METHOD.plan(NormalVectorSettings(balls=one_height, tool_axes="Z"))
    planned = METHOD.plan(NormalVectorSettings(balls=one_height, tool_axes="XYZ"))
    assert np.isfinite(sigma(planned)).all()
    assert np.isinf(planned["normals_loss"]).all()
    assert "both normals are equal" in planned.attrs["notes"][-1]
    with raises("probing.balls.too_few"):
        METHOD.plan(NormalVectorSettings())
    with pytest.raises(MethodError, match="has none"):
        METHOD.plan(NormalVectorSettings(balls=one_height, duration=60.0))


def test_more_balls_and_touches_are_better(probed):
    _, few = probed()
    _, many = probed(balls=8)
    assert (sigma(METHOD.plan(settings_of(many)))[-1] < sigma(METHOD.plan(settings_of(few)))[-1]).all()
    assert (
        sigma(METHOD.plan(settings_of(few, touches=9)))[-1, :2] < sigma(METHOD.plan(settings_of(few)))[-1, :2]
    ).all()


def test_touches_lie_around_the_ball_and_on_top():
    normals = touch_normals(5)
    np.testing.assert_allclose(normals, [(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0), (0, 0, 1)], atol=1e-15)
    raised = touch_normals(7, np.radians(30))
    np.testing.assert_allclose(np.linalg.norm(raised, axis=1), 1.0)
    np.testing.assert_allclose(raised[:-1, 2], 0.5)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"balls": ({"centre": (0, 0, 0), "name": "A"}, {"centre": (1, 0, 0), "name": "A"})}, "different names"),
        (
            {"schedule": ({"at": 60.0, "spindle_speed": 1e3}, {"at": 0.0, "spindle_speed": 0.0})},
            "expected increasing times",
        ),
        ({"normals_balls": ("1", "2", "3", "3")}, "four different balls"),
        ({"touches": 3}, "greater than or equal to 4"),
    ],
)
def test_settings_that_contradict_themselves_are_refused(wrong, message):
    with pytest.raises(ValidationError, match=message):
        NormalVectorSettings(**wrong)
