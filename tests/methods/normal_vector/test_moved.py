"""Balls that moved and touches that are wrong are found, named and left out."""

import numpy as np
import pytest
from coded import raises

from errormotion.methods.normal_vector import NormalVector, NormalVectorSettings, simulation

METHOD = NormalVector()


def moves(errors):
    return [note for note in errors.attrs["notes"] if "moved before" in note]


@pytest.mark.parametrize("kind", ["gantry", "cframe"])
@pytest.mark.parametrize("ball", [0, 3])
def test_moved_ball_is_named_with_the_cycle_and_does_no_harm(probed, off, kind, ball):
    machine, raw = probed(kind, moved=(ball, 1500.0, (5e-6, -3e-6, 0.0)))
    errors = METHOD.identify(raw)
    (note,) = moves(errors)
    assert f"Ball B{ball + 1} moved before cycle 3 (1800 s)" in note
    assert "may also" not in note
    assert np.nanmax(np.abs(off(machine, errors))) < 4
    expected = np.zeros((7, 4))
    expected[3:, ball] = 1
    np.testing.assert_array_equal(errors["ball_moved"], expected)
    assert (errors["left_out"].values[3:, ball] == 3).all()


def test_moved_ball_does_harm_where_nothing_may_be_left_out(probed, off):
    machine, raw = probed(moved=(1, 1500.0, (5e-6, -3e-6, 0.0)))
    errors = METHOD.identify(raw, NormalVectorSettings(robust=False, noise="stated"))
    assert np.nanmax(np.abs(off(machine, errors))) > 8


def test_small_move_of_one_ball_of_eight_is_found(probed):
    _, raw = probed(balls=8, moved=(5, 1500.0, (1.5e-6, -1e-6, 0.0)), cycles=13)
    assert "Ball B6 moved before cycle 3" in moves(METHOD.identify(raw))[0]


def test_two_balls_that_moved_are_both_found(probed, off):
    machine, raw = probed(balls=6, moved=(1, 900.0, (0.0, 4e-6, 0.0)))
    raw["touch"][4:, 4] += np.array([3e-6, 0.0, 2e-6])
    errors = METHOD.identify(raw)
    found = " ".join(moves(errors))
    assert "Ball B2 moved before cycle 2" in found
    assert "Ball B5 moved before cycle 4" in found
    assert np.nanmax(np.abs(off(machine, errors))) < 4


def test_one_of_three_balls_leaves_the_later_cycles_unknown(probed, off):
    machine, raw = probed(balls=3, moved=(1, 1500.0, (5e-6, -3e-6, 0.0)))
    errors = METHOD.identify(raw)
    assert moves(errors)
    assert np.isnan(errors["EX"].values).tolist() == [False] * 3 + [True] * 4
    assert np.nanmax(np.abs(off(machine, errors))) < 4


def test_move_without_stated_noise_is_found_too(probed):
    _, raw = probed(moved=(2, 1500.0, (5e-6, -3e-6, 0.0)), cycles=13)
    assert "Ball B3 moved before cycle 3" in moves(METHOD.identify(raw.drop_vars("touch_noise")))[0]


def test_centres_show_a_move_as_well(probed):
    _, raw = probed(variant="centres", moved=(2, 1500.0, (5e-6, -3e-6, 0.0)), cycle=0.0)
    assert "Ball B3 moved before cycle 3" in moves(METHOD.identify(raw))[0]


@pytest.mark.parametrize("where", [(3, 1, 2), (0, 1, 4), (6, 0, 0)])
def test_one_wrong_touch_is_the_only_one_that_goes(probed, off, where):
    machine, raw = probed()
    k, i, j = where
    raw["touch"][where] -= 20e-6 * raw["approach"][i, j]
    errors = METHOD.identify(raw)
    assert np.argwhere(errors["left_out"].values > 1).tolist() == [[k, i, j]]
    assert not moves(errors)
    assert np.nanmax(np.abs(off(machine, errors))) < 4


def test_wrong_touches_in_many_cycles_are_all_found(probed, off):
    machine, raw = probed(balls=6, touches=9, cycles=13)
    rng = np.random.default_rng(2)
    wrong = [(k, int(rng.integers(6)), int(rng.integers(9))) for k in range(13)]
    for k, i, j in wrong:
        raw["touch"][k, i, j] -= 30e-6 * raw["approach"][i, j]
    errors = METHOD.identify(raw)
    assert sorted(map(tuple, np.argwhere(errors["left_out"].values > 1).tolist())) == wrong
    assert np.nanmax(np.abs(off(machine, errors))) < 4


def test_ball_that_creeps_by_less_than_asked_for_is_left_alone(probed):
    _, raw = probed(moved=(0, 1500.0, (2e-6, 0.0, 0.0)))
    assert not moves(METHOD.identify(raw, NormalVectorSettings(smallest_move=10e-6)))


def test_cold_cycle_in_which_all_is_wrong_is_refused(probed):
    _, raw = probed()
    raw["touch"][0, 1:] = np.nan
    with raises("probing.cold.undetermined"):
        METHOD.identify(raw)


@pytest.mark.parametrize("draw", [40, 42])
def test_touches_that_are_missing_make_no_ball_move(probed, off, draw):
    """A cycle that shows next to nothing of a ball along an axis accuses it of no shift of millimetres along it."""
    machine, raw = probed("cframe", seed=1)
    raw = simulation.raw(machine, raw["time"].values, seed=draw, cycle=120.0, missing=0.2)
    errors = METHOD.identify(raw)
    assert not moves(errors)
    assert np.isfinite(errors["EX"].values).all()
    assert np.nanmax(np.abs(off(machine, errors))) < 4
