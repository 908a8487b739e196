"""Acquisition with instruments that behave like real ones: late, interrupted, started by the operator."""

import json
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion.datasets import clock
from errormotion.errors import InstrumentError
from errormotion.methods.spindle_drift import Event, SpindleDrift, SpindleDriftSettings
from errormotion.methods.spindle_drift.acquisition.drift import CHUNK_SAMPLES, MAX_FAILED_POLLS
from errormotion.plugins import Samples
from errormotion.twin import VirtualMachine

RATE = 1000.0
ENCODING = {"dtype": "uint16", "scale_factor": 3e-8, "add_offset": -2e-5, "_FillValue": 65535}


class Frame:
    """Five channels that read 1 mm; a sample is its own number times 1 pm more."""

    def __init__(self):
        nominal = VirtualMachine("cframe", seed=1).frame
        self.rate, self.warm, self.encoding = RATE, True, ENCODING
        self.geometry = SimpleNamespace(
            nominal_origin=nominal.nominal_origin, nominal_direction=nominal.nominal_direction, bar_radius=5e-3,
            levels=nominal.levels, noise=nominal.noise, expansion=nominal.expansion,
        )  # fmt: skip

    def stream(self, channels=None):
        first = 0
        while True:
            values = 1e-3 + np.tile(np.arange(first, first + 500) * 1e-12, (5, 1))
            yield Samples(values, first, RATE, 0.0, dropped=1, invalid={"X1 lost": 1})
            first += 500


class Thermometer:
    def __init__(self, fails=()):
        self.polls, self.fails = 0, fails

    def read(self):
        self.polls += 1
        if self.polls in self.fails:
            raise InstrumentError("no answer")
        return {"frame": 20.0 + self.polls, "ambient": 19.0}


class Bench:
    machine = "a machine"

    def __init__(self, **instruments):
        self.instruments, self.asked = instruments, []

    def has_kind(self, kind):
        return kind in self.instruments

    def of_kind(self, kind):
        return self.instruments[kind]

    def ask(self, message):
        self.asked.append(message)


def record(bench, settings, done=None):
    chunks = list(SpindleDrift().acquire(bench, settings, inputs={}, done=done))
    return chunks, xr.concat(chunks, dim="time", data_vars="minimal", coords="minimal", compat="override", join="exact")


def test_record_is_complete_and_counts_lost_samples():
    bench = Bench(spindle_frame=Frame(), thermometer=Thermometer())
    chunks, raw = record(bench, SpindleDriftSettings(duration=10.2, schedule=(Event(at=2.0, spindle_speed=3000.0),)))
    assert raw.sizes["time"] == 10200
    np.testing.assert_allclose(np.diff(raw["distance"].values[0]), 1e-12, rtol=1e-3)
    assert sum(chunk.attrs["dropped"] for chunk in chunks) == 21
    assert sum(chunk.attrs["invalid"]["X1 lost"] for chunk in chunks) == 21
    np.testing.assert_array_equal(raw["spindle_speed"].values, np.where(np.arange(10200) < 2000, 0.0, 3000.0))
    assert "3000 /min at 2 s" in bench.asked[0]
    assert chunks[0]["distance"].encoding == ENCODING


def test_record_starts_with_its_first_sample_and_not_with_the_prompt():
    class Slow(Bench):
        def ask(self, message):
            self.answered = datetime.now(UTC)

    bench = Slow(spindle_frame=Frame())
    chunks, _ = record(bench, SpindleDriftSettings(duration=2.0))
    # The first block holds half a second that lay before it came.
    assert datetime.fromisoformat(chunks[0].attrs["start"]) > bench.answered - timedelta(seconds=0.51)


def test_interruption_of_the_thermometer_loses_only_temperatures():
    bench = Bench(spindle_frame=Frame(), thermometer=Thermometer(fails=(3, 4)))
    chunks, raw = record(bench, SpindleDriftSettings(duration=10.0))
    warmth = raw["temperature"].sel(sensor="frame").values
    assert np.isnan(warmth[2000:6000]).all()
    assert np.isfinite(np.delete(warmth, slice(2000, 6000))).all()
    assert np.isfinite(raw["distance"]).all()
    assert sum(chunk.attrs["invalid"].get("thermometer without answer", 0) for chunk in chunks) == 2


def test_permanent_failure_of_the_thermometer_ends_the_record():
    bench = Bench(spindle_frame=Frame(), thermometer=Thermometer(fails=range(3, 1000)))
    with raises("instrument.other"):
        record(bench, SpindleDriftSettings(duration=2.0 * (MAX_FAILED_POLLS + 10)))


def interrupted(ago):
    """Return a record that started ``ago`` seconds ago and was interrupted after one second."""
    _, raw = record(Bench(spindle_frame=Frame(), thermometer=Thermometer()), SpindleDriftSettings(duration=1.0))
    return raw.assign_attrs(start=(datetime.now(UTC) - timedelta(seconds=ago)).isoformat())


def test_gap_of_an_interruption_is_nan_and_time_continues():
    bench = Bench(spindle_frame=Frame(), thermometer=Thermometer())
    settings = SpindleDriftSettings(duration=900.0)
    chunks, raw = record(bench, settings, interrupted(600.0))
    assert bench.asked == []
    assert max(chunk.sizes["time"] for chunk in chunks) <= CHUNK_SAMPLES + 500
    assert raw.sizes["time"] == 900_000 - 1000
    assert chunks[0].attrs["time_start"] == 1.0
    gap = np.isnan(raw["distance"].values[0])
    assert gap.argmin() == pytest.approx(599_000, abs=5000)  # a few seconds for the test itself
    np.testing.assert_array_equal(np.isnan(raw["temperature"].sel(sensor="frame").values), gap)


@pytest.mark.parametrize(("change", "restarted"), [(-3600.0, False), (86400.0, False), (-3600.0, True)])
def test_change_of_the_clock_neither_hides_nor_creates_a_gap(change, restarted):
    done = interrupted(600.0 + change)  # as the wall clock has it now: it was set by `change` since the last data
    started = datetime.fromisoformat(done.attrs["start"]).timestamp()
    now = clock.read()
    stored = {
        "wall": started + 1.0,
        "steady": now.steady - 599.0,
        "boot": "another" if restarted else now.boot,
        "began": started,
        "elapsed": 1.0,
    }
    done.attrs[clock.CLOCK] = json.dumps(stored)
    bench = Bench(spindle_frame=Frame(), thermometer=Thermometer())
    _, raw = record(bench, SpindleDriftSettings(duration=900.0), done)
    gap = int(np.isnan(raw["distance"].values[0]).sum())
    assert gap == (1 if restarted else pytest.approx(599_000, abs=5000))  # one row where the duration is unknown


def test_a_record_without_its_start_is_not_continued():
    done = interrupted(10.0)
    del done.attrs["start"]
    with raises("run.start.missing"):
        record(Bench(spindle_frame=Frame()), SpindleDriftSettings(duration=900.0), done)


def test_beams_are_not_scanned_without_a_machine_that_moves():
    with raises("bench.controller.no_steps"):
        list(
            SpindleDrift().acquire(
                Bench(spindle_frame=Frame()), SpindleDriftSettings(procedure="beam_detection"), inputs={}, done=None
            )
        )
