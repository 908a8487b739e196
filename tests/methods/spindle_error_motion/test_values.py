"""The values of motions that are known by hand, with every way to state the angle, and of records as they are."""

import numpy as np
import pytest
from coded import raises

from errormotion.errors import MethodError
from errormotion.methods.spindle_error_motion import (
    SpindleErrorMotion,
    SpindleErrorMotionSettings,
    synchronous,
    turning,
)

TAU = 2 * np.pi
A, B, C = 120e-9, 80e-9, 60e-9
EXACT = 0.4e-9
"""m: interpolation of the angle and of the tables, with an eccentricity of 5 um."""


def evaluated(raw, **settings):
    errors = SpindleErrorMotion().identify(raw, SpindleErrorMotionSettings(**settings))
    return errors, {each.name: each.value for each in SpindleErrorMotion.figures(errors)}


@pytest.mark.parametrize("angle", ["index", "encoder", "eccentricity"])
@pytest.mark.parametrize("speed", [3000.0, -3000.0])
def test_two_undulations_along_x_have_the_values_of_their_definition(recorded, angle, speed):
    """x = A cos 2q: fixed X 2A; rotating A cos 2q cos q = A/2 cos 3q plus what the circle removes, 1A; fixed Y 0."""
    _, of = evaluated(recorded(lambda q: A * np.cos(2 * q), angle=angle, speed=speed))
    assert of["synchronous radial, fixed X"] == pytest.approx(2 * A, abs=EXACT)
    assert of["synchronous radial, fixed Y"] == pytest.approx(0.0, abs=EXACT)
    if angle != "eccentricity":  # whose angle 0 is its own direction
        assert of["synchronous radial, rotating"] == pytest.approx(A, abs=EXACT)
    assert of["synchronous axial"] == pytest.approx(0.0, abs=EXACT)
    assert of["asynchronous radial, fixed X"] == pytest.approx(0.0, abs=2 * EXACT)
    assert of["total radial, fixed X"] == pytest.approx(2 * A, abs=2 * EXACT)


def test_the_errors_have_sign_and_angle(recorded):
    errors, _ = evaluated(recorded(lambda q: A * np.cos(2 * q), lambda q: B * np.sin(3 * q + 0.4)))
    q = errors["angle"].values
    np.testing.assert_allclose(errors["EX"].values, A * np.cos(2 * q), atol=EXACT)
    np.testing.assert_allclose(errors["EY"].values, B * np.sin(3 * q + 0.4), atol=EXACT)
    assert np.isnan(errors["EA"].values).all()
    assert float(errors["eccentricity"]) == pytest.approx(5e-6, rel=1e-4)


def test_a_motion_of_half_a_period_more_in_a_turn_is_asynchronous(recorded):
    """cos 2.5q is +-cos(2.5 q) at one angle in successive turns: the range is 2B, and the mean of 40 turns 0."""
    _, of = evaluated(recorded(lambda q: A * np.cos(2 * q) + B * np.cos(2.5 * q), turns=41))
    assert of["asynchronous radial, fixed X"] == pytest.approx(2 * B, rel=0.01)
    assert of["synchronous radial, fixed X"] == pytest.approx(2 * A, rel=0.01)
    # The largest and the smallest value of A cos 2q +- B |cos 2.5q|
    q = np.linspace(0, TAU, 7200)
    width = (A * np.cos(2 * q) + B * np.abs(np.cos(2.5 * q))).max()
    width -= (A * np.cos(2 * q) - B * np.abs(np.cos(2.5 * q))).min()
    assert of["total radial, fixed X"] == pytest.approx(width, rel=0.01)


def test_an_axial_motion_once_a_turn_is_fundamental(recorded):
    _, of = evaluated(recorded(z=lambda q: C * np.cos(q + 0.2) + B * np.cos(3 * q)))
    assert of["fundamental axial"] == pytest.approx(2 * C, abs=EXACT)
    assert of["residual synchronous axial"] == pytest.approx(2 * B, abs=EXACT)
    q = np.linspace(0, TAU, 7200)
    assert of["synchronous axial"] == pytest.approx(np.ptp(C * np.cos(q + 0.2) + B * np.cos(3 * q)), rel=1e-3)


def test_a_second_sensor_at_another_height_shows_the_tilt(recorded):
    """A motion that is larger by 20 nm at 50 mm is a rotation about Y by 0.4 urad."""
    raw = recorded(lambda q: A * np.cos(2 * q), second=(0.05, lambda q: (A + 20e-9) * np.cos(2 * q)), angle="encoder")
    errors, of = evaluated(raw)
    q = errors["angle"].values
    np.testing.assert_allclose(errors["EB"].values, 0.4e-6 * np.cos(2 * q), atol=0.01e-6)
    assert of["synchronous tilt, fixed X"] == pytest.approx(0.8e-6, rel=0.02)
    assert np.isnan(errors["EA"].values).all()


def test_one_sensor_shows_its_direction_only(recorded):
    raw = recorded(lambda q: A * np.cos(2 * q) + C * np.cos(q)).isel(sensor=[0])
    errors, of = evaluated(raw)
    np.testing.assert_allclose(errors["EX"].values, A * np.cos(2 * errors["angle"].values), atol=10 * EXACT)
    assert {name.split(", fixed")[0] for name in of} == {
        f"{kind} radial" for kind in ("synchronous", "asynchronous", "total")
    }


def test_an_eccentric_ball_seems_to_move_twice_a_turn_which_is_removed(recorded):
    """40 um: e^2 / 4R = 32 nm would be a range of 64 nm."""
    _, of = evaluated(recorded(eccentricity=40e-6, angle="encoder"))
    assert of["synchronous radial, fixed X"] < 1e-9
    assert of["synchronous radial, rotating"] < 1e-9


@pytest.mark.parametrize("speed", [3000.0, -3000.0])
def test_a_stated_form_is_removed(recorded, speed):
    raw = recorded(form=lambda a: 50e-9 * np.cos(3 * a) + 30e-9 * np.sin(5 * a), speed=speed)
    _, of = evaluated(raw)
    assert of["synchronous radial, fixed X"] > 100e-9
    raw = raw.assign_coords(undulation=("undulation", [3.0, 5.0], {"units": "1"})).assign(
        form_cosine=("undulation", [50e-9, 0.0], {"units": "m"}), form_sine=("undulation", [0.0, 30e-9], {"units": "m"})
    )
    _, of = evaluated(raw)
    assert of["synchronous radial, fixed X"] < EXACT
    assert of["synchronous radial, fixed Y"] < EXACT


@pytest.mark.parametrize("angle", ["index", "encoder"])
def test_a_speed_that_varies_causes_no_error(recorded, angle):
    """2 % over seven turns; by pulses, the angle within a turn is interpolated to some 1e-4 rad, 0.5 nm."""
    _, of = evaluated(recorded(lambda q: A * np.cos(2 * q), ripple=0.14, angle=angle))
    assert of["synchronous radial, fixed X"] == pytest.approx(2 * A, abs=2e-9)


def test_samples_at_the_same_angles_in_every_turn_are_enough(recorded):
    errors, of = evaluated(recorded(lambda q: A * np.cos(2 * q), per_turn=100.0))
    assert of["synchronous radial, fixed X"] == pytest.approx(2 * A, abs=EXACT)
    assert errors.attrs["harmonics"] == 45
    assert any("determine 45 undulations" in note for note in errors.attrs["notes"])


def test_motions_above_the_evaluated_undulations_are_noted(recorded):
    raw = recorded(lambda q: A * np.cos(2 * q) + 10e-9 * np.cos(20 * q), noise=2e-9)
    errors, _ = evaluated(raw, harmonics=12)
    assert any("more than 12 undulations" in note and "sensor 1" in note for note in errors.attrs["notes"])
    assert not any("more than" in note for note in evaluated(raw, harmonics=30)[0].attrs["notes"])


def test_missing_and_double_pulses_are_noted_and_change_nothing(recorded):
    raw = recorded(lambda q: A * np.cos(2 * q))
    pulse = raw["index_time"].values
    wrong = np.sort(np.concatenate([np.delete(pulse, [7, 8, 20]), [pulse[3] + 0.002]]))
    errors, of = evaluated(raw.drop_vars("index_time").assign(index_time=("index", wrong, {"units": "s"})))
    assert of["synchronous radial, fixed X"] == pytest.approx(2 * A, abs=EXACT)
    notes = " ".join(errors.attrs["notes"])
    assert "1 index pulses follow another one" in notes
    assert "3 index pulses are missing" in notes


def test_single_wrong_readings_are_excluded_with_a_note(recorded):
    raw = recorded(lambda q: A * np.cos(2 * q), noise=2e-9)
    wrong = raw["displacement"].values.copy()
    wrong[0, [1111, 2500]] += 3e-6
    wrong[1, 3000] = np.nan
    errors, of = evaluated(raw.assign(displacement=raw["displacement"].copy(data=wrong)))
    assert of["asynchronous radial, fixed X"] < 30e-9
    assert of["synchronous radial, fixed X"] == pytest.approx(2 * A, abs=5e-9)
    notes = " ".join(errors.attrs["notes"])
    assert "2 readings stand out" in notes
    assert "1 of " in notes


def test_a_vibration_near_a_multiple_of_the_speed_is_doubted(recorded):
    """2.01 periods in a turn do not average out in 40 turns."""
    errors, _ = evaluated(recorded(lambda q: A * np.cos(2.01 * q), noise=2e-9))
    assert "alike" in " ".join(errors.attrs["doubts_uncertainty"])


def test_the_opposite_sense_is_refused(recorded):
    raw = recorded(lambda q: A * np.cos(2 * q))
    raw["spindle_speed"] = raw["spindle_speed"].copy(data=-3000.0)
    with raises("readings.sense.opposite"):
        evaluated(raw)


def test_the_eccentricity_must_be_clear_to_state_the_angle(recorded):
    raw = recorded(lambda q: 1e-6 * np.cos(2 * q), eccentricity=0.5e-6, angle="eccentricity")
    with pytest.raises(MethodError, match="Record an index pulse"):
        evaluated(raw)


def test_a_record_in_small_pieces_has_the_same_result(recorded, monkeypatch):
    raw = recorded(lambda q: A * np.cos(2 * q) + B * np.cos(2.3 * q), noise=5e-9)
    whole = evaluated(raw)[0]
    monkeypatch.setattr(turning, "_CHUNK_BYTES", 8 * 3 * 1000)
    pieces = evaluated(raw)[0]
    np.testing.assert_allclose(pieces["EX"].values, whole["EX"].values, atol=1e-14)
    np.testing.assert_allclose(pieces["asynchronous_high"].values, whole["asynchronous_high"].values, atol=1e-14)


def test_a_slow_drift_is_no_error_motion(recorded):
    raw = recorded(lambda q: A * np.cos(2 * q))
    raw["displacement"] = raw["displacement"] + 1e-6 * np.linspace(0, 1, raw.sizes["time"])
    raw["displacement"].attrs["units"] = "m"
    _, of = evaluated(raw)
    # 25 nm in a turn: a saw tooth, of which what occurs once a turn is removed
    assert of["asynchronous radial, fixed X"] < 30e-9
    assert of["synchronous radial, fixed X"] == pytest.approx(2 * A, abs=20e-9)


def test_harmonics_of_means_over_parts_are_not_reduced():
    """A mean over a part of width w reduces k undulations by sinc(k w / 2); with its variance it does not."""
    parts, k = 64, 12
    middle = (np.arange(parts) + 0.5) * TAU / parts
    width = TAU / parts
    means = np.cos(k * middle) * np.sin(k * width / 2) / (k * width / 2)
    design = synchronous.harmonics_at(middle, 16, np.full(parts, width**2 / 12))
    found = np.linalg.lstsq(design, means, rcond=None)[0]
    assert found[k] == pytest.approx(1.0, abs=(k * width) ** 4 / 1920 * 1.2)


@pytest.mark.parametrize("per_turn", [200.0, 179.37])
def test_rounded_readings_are_inside_their_uncertainty(recorded, per_turn):
    """With a step of 100 nm and samples at the same angles in all turns, these are rounded alike."""
    raw = recorded(lambda q: A * np.cos(2 * q), per_turn=per_turn, noise=1e-9)
    q = 100e-9
    raw["displacement"] = (np.rint(raw["displacement"] / q) * q).assign_attrs(units="m")
    errors, of = evaluated(raw)
    off = errors["EX"].values - A * np.cos(2 * errors["angle"].values)
    u = np.sqrt(errors["covariance"].values[:, 0, 0])
    assert 0.5e-9 < np.sqrt(np.mean(off**2)) < 1.5 * np.sqrt(np.mean(u**2))
    assert np.mean(np.abs(off) < 2 * u) > 0.9
    if per_turn == 200.0:  # else each turn is rounded at other angles, and the scatter shows it
        assert any("rounded" in note for note in errors.attrs["notes"])
    [figure] = [each for each in SpindleErrorMotion.figures(errors) if each.name == "asynchronous radial, fixed X"]
    assert abs(of[figure.name]) <= figure.expanded_uncertainty + 2 * q / np.sqrt(12)


def test_the_structural_motion_is_the_range_at_rest(recorded):
    """A vibration of 30 nm along X, and a drift that is removed; with noise of 2 nm, U contains its excess."""
    raw = recorded(lambda q: A * np.cos(2 * q), noise=2e-9)
    t = np.arange(4000) / 4000
    rest = np.stack([30e-9 * np.sin(TAU * 50 * t) + 1e-6 * t, 0 * t, 0 * t], axis=1)
    raw["standstill"] = (("rest", "sensor"), rest + 2e-9 * np.random.default_rng(1).standard_normal(rest.shape))
    raw["standstill"].attrs["units"] = "m"
    errors, _ = evaluated(raw)
    [figure] = [each for each in SpindleErrorMotion.figures(errors) if each.name == "structural radial, fixed X"]
    assert abs(figure.value - 60e-9) < figure.expanded_uncertainty < 60e-9
    assert figure.value < 60e-9 + 2 * 5 * 2e-9
    assert not any("structural" in name and "rotating" in name for name in errors["figure"].values.tolist())
