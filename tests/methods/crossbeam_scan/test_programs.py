"""NC programs of a campaign."""

import re

import numpy as np
import pytest
from coded import raises

from errormotion.errors import MethodError
from errormotion.instruments.simulators.virtual_world.nc_program import interpret
from errormotion.methods.crossbeam_scan.acquisition.programs import measuring_pass, warm_up_piece
from errormotion.methods.crossbeam_scan.acquisition.schedule import program_texts
from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings

TRAVEL = {"X": (0.0, 1.0), "Y": (-1.0, 3.0), "Z": (0.0, 1.0)}
SETTINGS = CrossbeamScanSettings(positions=(0.35, 0.55), warm_up=(420.0, 900.0))


def path_of(text, start=0.317):
    return interpret(text, (0.0, start, 0.0), TRAVEL, rapid=1.0)


def test_there_is_a_program_for_each_piece_of_the_campaign():
    assert list(program_texts(SETTINGS)) == ["pass.nc", "warm_up_1.nc", "warm_up_2.nc"]


def test_a_program_is_plain_iso_6983():
    for text in program_texts(SETTINGS).values():
        lines = text.splitlines()
        assert (lines[0], lines[-1], lines[-2]) == ("%", "%", "M30")
        words = r"%|\([^()]*\)|G90 G94 G21|G1 [YZ]-?\d+\.\d{3} F[\d.]+|G4 P\d+\.\d|M30"
        assert all(re.fullmatch(words, line) for line in lines)
        assert text.isascii()


def test_the_pass_goes_from_a_margin_before_the_first_scan_to_a_margin_behind_the_last():
    path = path_of(program_texts(SETTINGS)["pass.nc"], start=0.6)
    y = path.places[1:, 1]
    assert y.min() == pytest.approx(0.35 - 0.028 - 0.005, abs=1e-6)
    assert y.max() == pytest.approx(0.55 + 0.028 + 0.005, abs=1e-6)
    assert y.tolist() == sorted(y)
    np.testing.assert_allclose(np.abs(np.diff(path.places[:, 1])) / np.diff(path.times), [0.025, 0, 0.025], atol=1e-9)


def test_warm_up_moves_take_exactly_the_available_time():
    for seconds in (10.0, 100.0, 1234.5):
        program = warm_up_piece(SETTINGS, 1, seconds, start=0.317)
        # half a micrometre of rounding in each of some hundred moves at 60 mm/s
        assert path_of(program.text()).duration == pytest.approx(seconds, abs=5e-3)
        assert program.end == pytest.approx(0.317)


def test_warm_up_moves_may_have_other_ends():
    wide = SETTINGS.model_copy(update={"warm_up_travel": (0.9, -0.1)})
    y = path_of(program_texts(wide)["warm_up_1.nc"]).places[:, 1]
    assert (y.min(), y.max()) == (pytest.approx(-0.1), pytest.approx(0.9))


def test_warm_up_moves_with_equal_ends_are_refused():
    with raises("scan.warm_up.travel"):
        program_texts(SETTINGS.model_copy(update={"warm_up_travel": (0.4, 0.4)}))


def test_a_program_that_leaves_the_travel_is_refused_with_its_name_and_both_ends():
    short = SETTINGS.model_copy(update={"travel": (0.3, 0.58)})
    with pytest.raises(
        MethodError, match=r"pass\.nc would move from Y317\.000 to Y583\.000, .* from 300\.000 to 580\.000"
    ):
        program_texts(short)
    assert program_texts(SETTINGS.model_copy(update={"travel": (0.317, 0.583)}))


def test_pocket_programs_lift_the_spindle_first():
    pocket = CrossbeamScanSettings(procedure="profiler_pose", pocket_position=0.1, pocket_z=0.2)
    found = program_texts(pocket)
    assert list(found) == ["pocket_1.nc", "pocket_2.nc"]
    for text, lift in zip(found.values(), pocket.pocket_lifts, strict=True):
        moved = path_of(text, start=0.0).places
        assert moved[1].tolist() == pytest.approx([0.0, 0.0, 0.2 + lift])
        assert moved[:, 2][1:].tolist() == pytest.approx([0.2 + lift] * (len(moved) - 1))
        assert moved[:, 1].max() == pytest.approx(0.1 + 0.014 + 0.005)


def test_a_pass_goes_to_the_height_of_the_scans_where_that_is_given():
    moved = path_of(program_texts(SETTINGS.model_copy(update={"scan_z": 0.4}))["pass.nc"]).places
    assert set(moved[1:, 2]) == {0.4}
    assert " Z" not in program_texts(SETTINGS)["pass.nc"]


def test_no_position_is_written_as_minus_zero():
    text = measuring_pass(CrossbeamScanSettings(positions=(0.033 - 1e-8, 0.2), warm_up=())).text()
    assert "Y0.000" in text
    assert "Y-0.000" not in text
