"""Scans that are wrong: each costs its own errors, with a reason in words, and nobody else's."""

import json
import logging

import numpy as np
import pytest
from coded import raises

from errormotion.errors import DatasetError, MethodError
from errormotion.methods.crossbeam_scan import CrossbeamScan, simulation
from errormotion.methods.crossbeam_scan.identification.cutting import interruption
from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings
from errormotion.twin.artefacts.pieces import freeform, plane
from errormotion.twin.sensors.profiler import Profiler

PROFILER, LINES, FEED = Profiler(800, 25e-6), 400, 70e-6
#: two cold cycles, the second a repeat, and two warm ones, s
TIMES = [-120.0, -60.0, 1800.0, 7200.0]
PLACES = [-0.4, 0.0, 0.4]
#: the scan that is spoilt: a warm one, in the middle
CYCLE, ARTEFACT = 2, 1


def scan(gantry, times=TIMES, places=PLACES, *, seed=1, lines=LINES, artefact=None):
    """Return scans of the twin."""
    return simulation.raw_scans(
        gantry, times, places, seed=seed, profiles=lines, feed=FEED, profiler=PROFILER, artefact=artefact
    )


@pytest.fixture(autouse=True, scope="module")
def _remembering(remembering):
    with remembering():
        yield


@pytest.fixture(scope="module")
def whole(gantry):
    """Scans without a fault."""
    return scan(gantry).assign(warm_up=("cycle", np.maximum(TIMES, 0.0)))


@pytest.fixture(scope="module")
def errors(whole):
    """Errors from these."""
    return identify(whole)


@pytest.fixture
def raw(whole):
    """Return a copy of the scans, to be modified."""
    return whole.copy(deep=True)


@pytest.fixture(autouse=True)
def _quiet(caplog):
    caplog.set_level(logging.ERROR)


def identify(raw, **settings):
    return CrossbeamScan().identify(raw, CrossbeamScanSettings(**settings))


def spoil(raw, heights, cycle=CYCLE, artefact=ARTEFACT):
    raw["height"][cycle, artefact] = heights


def assert_lost_alone(found, errors, reason, cycles=(CYCLE,), artefact=ARTEFACT):
    """Check that a faulty scan has only a reason, and all others the same bits as without the fault."""
    rows = [c - 1 for c in cycles]  # the second cold cycle is no row of its own
    lost = np.zeros((3, 3), dtype=bool)
    lost[rows, artefact] = True
    np.testing.assert_array_equal(found["reason"].values != "", lost)
    for text in found["reason"].values[lost]:
        assert reason in text
    names = found["source"].values.tolist()  # without those that had an effect on the lost scan alone
    errors = errors.sel(source=errors["source"].isin(names)) if "source" in errors.indexes else errors.isel(
        source=np.flatnonzero(np.isin(errors["source"].values, names)))  # fmt: skip
    for name in (*found.em.iso_names(), "covariance", "influence", "registration_u", "strain"):
        there, clean = (np.moveaxis(one[name].transpose("time", "position", ...).values, (0, 1), (0, 1))
                        for one in (found, errors))  # fmt: skip
        assert np.isnan(there[lost]).all()
        np.testing.assert_array_equal(there[~lost], clean[~lost])
    assert not found["points_used"].values[lost].any()
    assert any(
        note.startswith(f"{lost[1:].sum()} of 6 warm scans have no known errors (at 0 m)") for note in notes(found)
    )


def notes(found):
    return found.attrs["notes"]


def bumpy(x, y):
    """A free form other than that of the artefact."""
    waves = np.sin(2 * np.pi * x / 21e-3 + 1) + np.cos(2 * np.pi * y / 19e-3)
    return 1.2e-3 * waves + 0.4e-3 * np.sin(2 * np.pi * (x + y) / 13e-3)


# ---------------------------------------------------------------- one scan


def test_a_scan_that_is_all_nan(raw, errors):
    spoil(raw, np.nan)
    assert_lost_alone(identify(raw), errors, "all values are NaN")


def test_a_scan_of_another_artefact(gantry, raw, errors):
    other = scan(gantry, [1800.0], [0.0], seed=9, artefact=freeform(bumpy))
    spoil(raw, other["height"][0, 0].values)
    assert_lost_alone(identify(raw), errors, "check that both scans are of the same artefact")


def test_a_scan_shifted_by_a_quarter_of_the_artefact(gantry, raw, errors):
    # a scan of 28 mm out of one of 42 mm that begins 7 mm earlier
    longer = scan(gantry, [1800.0], [0.0], seed=9, lines=600)
    spoil(raw, longer["height"][0, 0, :LINES].values)
    assert_lost_alone(identify(raw), errors, "6.96 mm across and 0.000 rad; start both scans at the same position")


def test_heights_that_are_no_surface(raw, errors):
    spoil(raw, np.random.default_rng(0).normal(0, 5e-3, (LINES, PROFILER.points)))
    assert_lost_alone(identify(raw), errors, "expected ")


def test_narrow_strip_is_refused(raw, errors):
    raw["height"][CYCLE, ARTEFACT, 50:] = np.nan
    assert_lost_alone(identify(raw), errors, "found a warm scan that leaves 2 of them undetermined: EY, EC")


def test_half_a_scan_states_a_larger_uncertainty(gantry, raw, errors):
    raw["height"][CYCLE, ARTEFACT, LINES // 2 :] = np.nan
    found = identify(raw)
    assert not (found["reason"] != "").any()
    worse = found["registration_u"][1, 1].values / errors["registration_u"][1, 1].values
    assert np.all(worse > 1.3)  # half the lines: sqrt(2), and more for what needs a long scan
    truth = simulation.truth_axis(gantry, [1800.0], [0.0]).em.twist().values[0, 0]
    assert np.all(np.abs(found.em.twist().values[1, 1] - truth) < 4 * found["registration_u"][1, 1].values)


def test_lines_that_do_not_increase(raw, errors):
    raw["y"][CYCLE, ARTEFACT, 50] = raw["y"][CYCLE, ARTEFACT, 40].values
    assert_lost_alone(
        identify(raw), errors, "expected y to increase from line to line; 1 of 400 lines are at or before"
    )


def test_a_scan_backwards_is_the_same_scan(raw, errors):
    for name in ("y", "height"):
        raw[name][CYCLE, ARTEFACT] = raw[name][CYCLE, ARTEFACT, ::-1].values
    np.testing.assert_array_equal(identify(raw).em.twist().values, errors.em.twist().values)


def test_positions_opposite_to_the_heights(raw, errors):
    raw["y"][CYCLE, ARTEFACT] = raw["y"][CYCLE, ARTEFACT, ::-1].values
    assert_lost_alone(identify(raw), errors, "start both scans at the same position of the artefact")


def test_positions_in_millimetres(raw, errors):
    raw["y"][CYCLE, ARTEFACT] *= 1000
    assert_lost_alone(identify(raw), errors, "if these are millimetres, divide by 1000")


@pytest.mark.parametrize("name", ["height", "x"])
def test_a_dataset_in_millimetres_is_refused(raw, name):
    with pytest.raises(DatasetError, match=f"{name} = .*expected -1..1 m; is it in mm"):
        identify(raw.assign({name: raw[name] * 1000}))


def test_one_scan_in_millimetres_is_refused_before_registration(raw):
    raw["height"][CYCLE, ARTEFACT] *= 1000
    with pytest.raises(DatasetError, match=r"is it in mm\?"):
        identify(raw)


# ---------------------------------------------------------------- the cold scan


def test_cold_repeat_replaces_an_incomplete_cold_scan(gantry, raw, errors):
    spoil(raw, np.nan, cycle=0)
    found = identify(raw)
    assert not (found["reason"] != "").any()
    assert not found.em.twist().values[0].any()
    np.testing.assert_array_equal(found.em.twist().values[:, [0, 2]], errors.em.twist().values[:, [0, 2]])
    truth = simulation.truth_axis(gantry, [1800.0, 7200.0], [0.0]).em.twist().values[:, 0]
    u = np.sqrt(np.diagonal(found["covariance"].values[1:, 1], axis1=-2, axis2=-1))
    assert np.all(np.abs(found.em.twist().values[1:, 1] - truth) < 4 * u)


def test_complete_cold_pass_may_fail(raw):
    raw["height"][0] = np.nan
    found = identify(raw)
    assert np.isfinite(found.em.twist().values).all()
    assert not found.em.twist().values[0].any()
    assert found["time"].values.tolist() == [0, 1800, 7200]


def test_artefact_without_any_cold_scan_is_unknown(raw, errors):
    raw["height"][:2, ARTEFACT] = np.nan
    found = identify(raw)
    assert found["reason"][1:, ARTEFACT].values.tolist() == ["there is no cold scan to register it onto"] * 2
    assert np.isnan(found.em.twist().values[:, ARTEFACT]).all()  # not zero when it was cold: unknown
    np.testing.assert_array_equal(found.em.twist().values[:, [0, 2]], errors.em.twist().values[:, [0, 2]])


def test_flat_artefact_is_refused_with_its_undetermined_freedoms(gantry, raw, errors):
    spoil(raw, scan(gantry, places=[0.0], artefact=plane())["height"][:, 0].values, cycle=slice(None))
    reason = "found a cold scan that leaves 3 of them undetermined: EX, EY, EC"
    assert_lost_alone(identify(raw), errors, reason, cycles=(2, 3))


# ---------------------------------------------------------------- the whole campaign


def test_not_one_usable_scan_is_refused_with_the_reasons(raw):
    raw["height"][2:] = np.nan
    with pytest.raises(
        MethodError, match="None of 6 warm scans could be registered onto its cold scan: there is no scan"
    ):
        identify(raw)


def test_cold_scans_alone_are_refused(raw):
    with raises("scan.no_warm_scans"):
        identify(raw.isel(cycle=slice(None, 2)))


def test_positions_that_do_not_increase_are_refused(raw):
    with raises("scan.positions.not_increasing"):
        identify(raw.isel(artefact=[0, 2, 1]))


def test_a_pose_that_is_no_rotation_is_refused(raw):
    raw["profiler_pose"][0, 0] = -1.0
    with raises("scan.pose.no_rotation"):
        identify(raw)


# ---------------------------------------------------------------- a record of lines


def recorded(raw, pitch=1e-6, zero=0.0):
    """Return the scans as recorded by a profiler: line by line, with a count of whole micrometres."""
    cycles, artefacts, lines = raw["y"].shape
    place = raw["position"].values[:, None] + raw["y"].values
    out = raw[["x", "position", "profiler_pose", "lever", "height_noise", "warm_up"]]
    return out.assign(
        record=(("line", "point"), raw["height"].values.reshape(-1, raw.sizes["point"]), {"units": "m"}),
        encoder=("line", np.rint((place.ravel() - zero) / pitch)),
        cycle_of_line=("line", np.repeat(np.arange(cycles), artefacts * lines)),
        line_time=("line", np.repeat(raw["time"].values, artefacts * lines), {"units": "s"}),
        encoder_pitch=((), pitch, {"units": "m"}),
        encoder_zero=((), zero, {"units": "m"}),
        scan_length=((), lines * FEED + 10e-6, {"units": "m"}),
    ).assign_attrs(raw.attrs)


@pytest.fixture(scope="module")
def record(whole):
    """Return the campaign as a record."""
    return recorded(whole)


@pytest.fixture(scope="module")
def record_errors(record):
    """Errors from it."""
    return identify(record)


def test_record_and_its_scans_give_the_same_errors(record_errors, errors):
    # the counts put every line up to half a micrometre off, of which the mean is left: a jitter along the feed
    miss = record_errors.em.twist().values - errors.em.twist().values
    assert np.all(np.abs(miss) <= 0.5 * errors["registration_u"].values)
    assert not (record_errors["reason"] != "").any()


def test_exact_positions_give_the_same_errors(whole, errors):
    # every line is 0.3 nm off: less than a thousandth of the jitter
    found = identify(recorded(whole, pitch=1e-9))
    miss = found.em.twist().values - errors.em.twist().values
    assert np.all(np.abs(miss) <= 2e-3 * errors["registration_u"].values)
    assert found["registration_u"].values == pytest.approx(errors["registration_u"].values, rel=2e-3)


def test_overflow_of_the_encoder_is_corrected_and_noted(record, record_errors):
    jumped = record.copy(deep=True)
    jumped["encoder"][record.sizes["line"] // 2 + 5 :] += 2.0**32
    found = identify(jumped)
    np.testing.assert_array_equal(found.em.twist().values, record_errors.em.twist().values)
    assert any("overflowed" in note for note in notes(found))


def test_half_a_file_keeps_its_complete_scans(record, record_errors):
    # the record breaks off in the second of the three scans of cycle 2
    lines = (2 * 3 + 1) * LINES + LINES // 2
    found = identify(record.isel(line=slice(None, lines)))
    assert found["reason"].values[:2].tolist()[0] == ["", "", ""]
    assert found["reason"].values[1, 0] == ""
    assert "the record ends in pass 2" in found["reason"].values[1, 1]
    assert "the record ends in pass 2" in found["reason"].values[1, 2]
    assert found["reason"].values[2].tolist() == ["pass 3 was not made"] * 3
    assert found["time"].values.tolist() == [0.0, 1800.0, 7200.0]  # as planned
    assert np.isnan(found.em.twist().values[1, 1:]).all()
    assert np.isnan(found.em.twist().values[2]).all()
    np.testing.assert_array_equal(found.em.twist().values[1, 0], record_errors.em.twist().values[1, 0])


def test_interrupted_pass_states_position_and_reason(record, record_errors):
    cut = (record["cycle_of_line"] == CYCLE) & (record["encoder"] > 0.1e6)
    text = interruption(CYCLE, 0.1, "no data for 1 s; is the cable in?")
    broken = record.isel(line=~cut.values).assign_attrs(invalid=json.dumps({text: 1}))
    found = identify(broken)
    assert (
        found["reason"].values[1, 2]
        == "the scan has no lines: pass 2 broke at 0.100 m (no data for 1 s; is the cable in?)"
    )
    np.testing.assert_array_equal(found.em.twist().values[:, :2], record_errors.em.twist().values[:, :2])
    np.testing.assert_array_equal(found.em.twist().values[2, 2], record_errors.em.twist().values[2, 2])


@pytest.mark.parametrize("pitch", [1e-3, 1e-9])
def test_a_wrong_encoder_pitch_is_reported(record, pitch):
    with pytest.raises(MethodError, match="Check encoder_pitch"):
        identify(record.assign(encoder_pitch=((), pitch)))
