"""Scans out of a record of lines, however it went."""

import json

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion import datasets
from errormotion.errors import MethodError
from errormotion.methods.crossbeam_scan import simulation
from errormotion.methods.crossbeam_scan.identification.cutting import Interruption, Scans, interruption, interruptions

PITCH, POINTS, COUNT = 70e-6, 3, 1e-6
POSITIONS = np.array([0.3, 0.45])
LENGTH = 56e-3


def a_pass(cycle, low=0.267, high=0.483):
    """Return positions of the lines and number of the pass, in the order of acquisition."""
    y = np.arange(np.ceil(low / PITCH), np.ceil(high / PITCH)) * PITCH
    return y, np.full(y.size, cycle)


def record(passes, **attributes):
    """Return a raw dataset of passes; all points of a line are its position."""
    place = np.concatenate([y for y, _ in passes])
    cycle = np.concatenate([c for _, c in passes])
    ds = xr.Dataset(
        {
            "record": (("line", "point"), np.tile(place[:, None] * 1e-2, (1, POINTS)).astype(np.float32)),
            "encoder": ("line", np.rint(place / COUNT)),
            "cycle_of_line": ("line", cycle),
            "line_time": ("line", cycle * 1000.0 + place),
            "x": ("point", np.arange(POINTS) * 1e-5),
            "position": ("artefact", POSITIONS),
            "warm_up": ("cycle", [0.0, 420.0, 900.0]),
            "encoder_pitch": ((), COUNT),
            "encoder_zero": ((), 0.0),
            "scan_length": ((), LENGTH),
        }
    )
    return ds.assign_attrs(attributes)


@pytest.fixture
def whole():
    """Three whole passes."""
    return record([a_pass(0), a_pass(1), a_pass(2)])


def assert_whole(scan, artefact, size=800):
    height, x, y, _ = scan
    assert height.dtype == np.float32
    assert height.shape == (size, POINTS)
    np.testing.assert_array_equal(x, np.arange(POINTS) * 1e-5)
    # float32 of 4.5e-3 has steps of 5e-10: 50 nm of place
    seen = np.isfinite(height[:, 0])
    np.testing.assert_allclose(height[seen, 0] * 1e2 - POSITIONS[artefact], y[seen], atol=6e-7)
    np.testing.assert_allclose(np.diff(y), PITCH, atol=1.1e-6)  # counts are whole micrometres


def test_each_scan_is_the_lines_around_its_artefact(whole):
    scans = Scans(whole)
    assert (scans.cycles, scans.artefacts) == (3, 2)
    for cycle in range(3):
        for artefact in range(2):
            scan = scans.scan(cycle, artefact)
            assert_whole(scan, artefact)
            assert np.abs(scan[2]).max() <= LENGTH / 2
            assert scan[3] == pytest.approx(cycle * 1000 + POSITIONS[artefact], abs=1e-4)
    assert scans.notes == []


def test_only_the_lines_of_the_scan_are_read(tmp_path, whole):
    path = tmp_path / "raw.zarr"
    whole.chunk(line=512).to_zarr(path, zarr_format=3, consolidated=False)
    raw = datasets.load(path)
    read = []

    class Spy:
        def transpose(self, *dims):
            return self

        def isel(self, line):
            read.append(line.stop - line.start)
            return raw["record"].isel(line=line)

    scans = Scans(raw)
    scans._record._record = Spy()
    assert_whole(scans.scan(2, 1), 1)
    assert read == [800]


def test_lost_lines_are_nan_at_their_positions(whole):
    scan = whole.copy(deep=True)
    lost = np.flatnonzero((scan["cycle_of_line"] == 1) & (np.abs(scan["encoder"] * COUNT - 0.3) < 0.01))[[5, 6, 90]]
    scan["encoder"][lost] = np.nan
    scan["record"][lost] = np.nan
    scans = Scans(scan)
    found = scans.scan(1, 0)
    assert_whole(found, 0)
    assert np.isnan(found[0]).all(axis=1).sum() == 3
    assert scans.notes == ["Pass 1 at 0.3 m: 3 of 800 lines are lost and NaN."]


def test_lines_that_were_not_received_are_nan(whole):
    keep = np.ones(whole.sizes["line"], bool)
    keep[1000:1004] = False
    found = Scans(whole.isel(line=keep)).scan(0, 0)
    first = Scans(whole).scan(0, 0)
    np.testing.assert_allclose(found[2], first[2], atol=1.1e-6)


def test_long_gap_is_reported_with_its_position(whole):
    middle = int(np.argmin(np.abs(whole["encoder"].values[:3000] * COUNT - 0.31)))
    gap = whole.isel(line=np.r_[0:middle, middle + 30 : whole.sizes["line"]])
    with pytest.raises(MethodError, match=r"lines are lost over 2\.17 mm at \+0\.0\d+ m from the artefact"):
        Scans(gap).scan(0, 0)
    assert_whole(Scans(gap).scan(0, 1), 1)


def test_a_scan_that_lost_many_single_lines_is_refused(whole):
    scan = whole.copy(deep=True)
    scan["encoder"][::10] = np.nan
    with pytest.raises(MethodError, match="10% of its lines are lost; expected at most 5%"):
        Scans(scan).scan(0, 0)


def test_lines_in_the_wrong_order_are_sorted_with_a_note(whole):
    order = np.arange(whole.sizes["line"])
    order[[800, 801]] = order[[801, 800]]
    order[[900, 902]] = order[[902, 900]]
    scans = Scans(whole.isel(line=order))
    assert_whole(scans.scan(0, 0), 0)
    assert "were before the previous one" in scans.notes[0]


def test_repeated_lines_are_used_once(whole):
    scans = Scans(whole.isel(line=np.r_[0:700, 690 : whole.sizes["line"]]))
    assert_whole(scans.scan(0, 0), 0)
    assert any("10 lines were repeated" in note for note in scans.notes)


def test_pass_in_the_opposite_direction_gives_the_same_scan(whole):
    there = Scans(whole)
    back = Scans(whole.isel(line=slice(None, None, -1)))
    for one, other in zip(there.scan(1, 1), back.scan(1, 1), strict=True):
        np.testing.assert_array_equal(one, other)


def test_encoder_that_moves_back_and_forth_is_refused(whole):
    shaken = whole.copy(deep=True)
    shaken["encoder"] += 300.0 * np.sin(np.arange(whole.sizes["line"]) * 0.9)
    with raises("scan.lines.backwards"):
        Scans(shaken).scan(0, 0)


def test_second_attempt_is_used_where_the_first_is_incomplete():
    first = a_pass(0, high=0.44)
    raw = record([first, a_pass(0), a_pass(1)])
    raw["line_time"][first[0].size :] += 100.0
    scans = Scans(raw)
    assert_whole(scans.scan(0, 1), 1)
    assert_whole(scans.scan(0, 0), 0)
    assert scans.scan(0, 0)[3] == pytest.approx(100.3, abs=1e-3)  # both are whole: the later one


def test_overflow_of_the_count_is_corrected_with_a_note(whole):
    jumped = whole.copy(deep=True)
    jumped["encoder"][1500:] -= 2.0**32
    scans = Scans(jumped)
    for cycle in range(3):
        assert_whole(scans.scan(cycle, 0), 0)
    assert "overflowed (4294967296) in" in scans.notes[0]


@pytest.mark.parametrize(
    ("pitch", "found"),
    [(1e-3, r"none of \d+ lines there; they are at 267"), (1e-9, "none of"), (-1e-6, r"at -0\.48")],
)
def test_a_wrong_encoder_pitch_is_reported(whole, pitch, found):
    with pytest.raises(MethodError, match=rf"Expected lines at the artefacts .*{found}.*Check\s+encoder_pitch"):
        Scans(whole.assign(encoder_pitch=((), pitch)))


def test_a_pitch_that_puts_all_lines_into_one_scan_is_reported(whole):
    near = whole.assign(encoder_pitch=((), 1e-9), encoder_zero=((), 0.3))
    with pytest.raises(MethodError, match=r"found 0\.07 um from line to line"):
        Scans(near)


def test_half_a_record_states_the_missing_scans():
    raw = record([a_pass(0), a_pass(1, high=0.45)])
    scans = Scans(raw)
    assert scans.cycles == 3
    with pytest.raises(MethodError, match=r"50% complete, .*: the record ends in pass 1"):
        scans.scan(1, 1)
    with pytest.raises(MethodError, match="pass 2 was not made"):
        scans.scan(2, 0)


def test_a_pass_that_was_cut_off_between_others_says_where():
    with pytest.raises(MethodError, match=r"the scan has no lines: pass 1 was cut off at 0\.400 m"):
        Scans(record([a_pass(0), a_pass(1, high=0.4), a_pass(2)])).scan(1, 1)


def test_a_broken_pass_says_where_it_broke_and_why():
    text = interruption(1, 0.42, "keyence_ljx: no data for 1 s; is it on, is the cable in?")
    raw = record([a_pass(0), a_pass(1, high=0.42), a_pass(2)], invalid=json.dumps({"blind spot": 12, text: 1}))
    assert interruptions(raw) == [Interruption(1, 0.42, "keyence_ljx: no data for 1 s; is it on, is the cable in?")]
    with pytest.raises(MethodError, match=r"no lines: pass 1 broke at 0\.420 m \(keyence_ljx: no data for 1 s"):
        Scans(raw).scan(1, 1)
    assert_whole(Scans(raw).scan(1, 0), 0)


def test_scans_that_are_cut_already_are_handed_over_one_by_one(gantry):
    raw = simulation.raw_scans(gantry, [0.0, 600.0], [0.1, 0.3], seed=1, profiles=100)
    raw["y"][1, 0, 90:] = np.nan
    raw["height"][1, 1] = np.nan
    scans = Scans(raw)
    assert (scans.cycles, scans.artefacts) == (2, 2)
    height, x, y, time = scans.scan(1, 0)
    np.testing.assert_array_equal(height, raw["height"][1, 0, :90])
    np.testing.assert_array_equal(y, raw["y"][1, 0, :90])
    assert (x.size, time) == (3200, 600.0)
    with raises("scan.no_values"):
        scans.scan(1, 1)


def test_cut_scans_whose_y_turns_are_refused(gantry):
    raw = simulation.raw_scans(gantry, [0.0], [0.1], seed=1, profiles=100)
    raw["y"][0, 0, 50] = -0.002
    with raises("scan.lines.backwards"):
        Scans(raw).scan(0, 0)
    backwards = raw.isel(profile=slice(None, 40)).isel(profile=slice(None, None, -1))
    assert np.all(np.diff(Scans(backwards).scan(0, 0)[2]) > 0)


def test_what_is_no_campaign_of_scans_is_refused(gantry):
    with raises("scan.record.missing"):
        Scans(simulation.raw_pocket(gantry, seed=1, profiles=20))
