"""Duration of an interruption of a record, with clocks that are set, stop and restart."""

import json
import math
from dataclasses import asdict, replace

import pytest
import xarray as xr

from errormotion.datasets import clock
from errormotion.datasets.clock import Reading, RecordClock

HOUR, DAY, YEARS = 3600.0, 86400.0, 50 * 365.25 * 86400.0
START = "2026-03-01T08:00:00+00:00"
AT_START = 1772352000.0
STORED = Reading(wall=AT_START + 100.0, steady=5000.0, boot="a", began=AT_START, elapsed=100.0)


@pytest.fixture
def at(monkeypatch):
    """Set the clocks of the computer."""

    def set_to(wall, steady, boot):
        monkeypatch.setattr(clock.time, "time", lambda: wall)
        monkeypatch.setattr(clock, "steady", lambda: steady)
        monkeypatch.setattr(clock, "_boot", lambda: boot)

    return set_to


@pytest.mark.parametrize("change", [0.0, HOUR, -HOUR, DAY, -DAY, YEARS, -YEARS])
def test_without_a_restart_the_duration_does_not_depend_on_the_wall_clock(change):
    now = replace(STORED, wall=STORED.wall + 30.0 + change, steady=STORED.steady + 30.0)
    seconds, reason = clock.interval(STORED, now)
    assert seconds == 30.0
    assert ("changed by" in reason) == (change != 0)


@pytest.mark.parametrize(
    ("passed", "uptime", "expected"),
    [
        (120.0, 60.0, 120.0),
        (3 * DAY, 60.0, 3 * DAY),
        (-HOUR, 60.0, math.nan),
        (30.0, 60.0, math.nan),  # less than the computer has run since its start
        (-YEARS, 60.0, math.nan),
        (YEARS, 60.0, math.nan),
    ],
)
def test_after_a_restart_the_wall_clock_is_used_if_it_is_possible(passed, uptime, expected):
    seconds, reason = clock.interval(STORED, Reading(STORED.wall + passed, uptime, "b", 0.0, 0.0))
    assert seconds == pytest.approx(expected, nan_ok=True)
    assert bool(reason) == math.isnan(expected)


def test_time_without_identity_of_the_boot_is_the_wall_clock():
    first = replace(STORED, boot="")
    assert clock.interval(first, Reading(STORED.wall + 30.0, 10.0, "", 0.0, 0.0)) == (30.0, "")
    assert math.isnan(clock.interval(first, Reading(STORED.wall - 30.0, 10.0, "", 0.0, 0.0))[0])


def test_record_counts_its_duration_over_several_interruptions(at):
    at(AT_START, 10.0, "a")
    record = RecordClock({})
    at(AT_START + 5.0, 15.0, "a")
    attrs = record.attributes()
    assert clock.joins(attrs) == []
    at(AT_START - HOUR, 20.0, "a")  # 5 s later, set back by an hour
    record = RecordClock(attrs, index=50, at=4.9)
    at(AT_START - HOUR + 1.0, 21.0, "a")
    attrs = record.attributes()
    assert json.loads(attrs[clock.CLOCK])["elapsed"] == pytest.approx(11.0)
    at(AT_START - DAY, 3.0, "b")  # restarted and set back: unknown
    attrs = RecordClock(attrs, index=60, at=5.9).attributes()
    known, unknown = clock.joins(attrs)
    assert (known.index, known.seconds, known.time) == (50, 5.0, 4.9)
    assert "changed by" in known.reason
    assert (unknown.index, unknown.seconds) == (60, None)
    (note,) = clock.notes(attrs)
    assert "before sample 60, for an unknown time" in note


def test_age_of_a_record_is_that_of_its_own_clock(at):
    done = xr.Dataset(attrs={"start": START, clock.CLOCK: json.dumps(asdict(STORED))})
    at(STORED.wall - HOUR, STORED.steady + 20.0, "a")
    assert clock.age(done) == pytest.approx(120.0)
    at(STORED.wall - HOUR, 20.0, "b")
    assert math.isnan(clock.age(done))


@pytest.mark.parametrize("stored", ["", "{}", "[]", '{"wall": "x"}', "no JSON", '{"wall": NaN, "steady": 1}'])
def test_age_of_a_record_without_a_readable_clock_is_that_of_the_wall_clock(at, stored):
    done = xr.Dataset(attrs={"start": START, clock.CLOCK: stored, clock.JOINS: "[1]"})
    at(AT_START + 60.0, 1.0, "a")
    assert clock.age(done) == pytest.approx(60.0)
    assert clock.joins(done.attrs) == []
    at(AT_START - 60.0, 1.0, "a")
    assert math.isnan(clock.age(done))


@pytest.mark.parametrize("start", ["", "yesterday", "0001-01-01T00:00:00+14:00"])
def test_record_without_a_start_has_no_age(start):
    with pytest.raises(ValueError, match="attribute start"):
        clock.age(xr.Dataset(attrs={"start": start}))


@pytest.mark.parametrize("text", ["[" * 5000, '{"wall": ' + "9" * 400 + "}", "null"])
def test_damaged_clocks_of_a_record_are_ignored(text):
    attrs = {clock.CLOCK: text, clock.JOINS: text, "start": START}
    whole = json.dumps(asdict(STORED)).replace("5000.0", "9" * 400)
    for stated in (attrs, attrs | {clock.CLOCK: whole}):
        assert clock.joins(stated) == []
        assert clock.age(xr.Dataset(attrs=stated)) >= 0 or math.isnan(clock.age(xr.Dataset(attrs=stated)))
        assert clock.RecordClock(stated).attributes().keys() == {clock.CLOCK}


def test_an_interruption_of_unknown_duration_is_in_the_notes_of_the_errors_of_any_method():
    unknown = clock.Join(index=60, seconds=None, reason="the wall clock was set", time=5.9)
    raw = xr.Dataset(attrs={clock.JOINS: json.dumps([asdict(unknown), asdict(replace(unknown, seconds=3.0))])})
    (expected,) = clock.notes(raw.attrs)
    for before in ([""], ["Sensor X1 was cold."], [], "Sensor X1 was cold.", [expected]):
        errors = clock.noted(xr.Dataset(attrs={"notes": before}), raw)
        assert errors.attrs["notes"].count(expected) == 1
        assert "" not in errors.attrs["notes"]
        assert ("Sensor X1 was cold." in errors.attrs["notes"]) == ("cold" in str(before))
    errors = xr.Dataset(attrs={"notes": [""]})
    assert clock.noted(errors, xr.Dataset()) is errors
