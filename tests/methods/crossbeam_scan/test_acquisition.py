"""Measuring scans: with a control, with an operator, with profilers that fall silent, and on the virtual gantry."""

import json
import os
import threading
import time
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from armed import CONTROLLER
from coded import raises

from errormotion import datasets
from errormotion.campaign.storage.store import RawStore
from errormotion.errors import InstrumentError, InstrumentTimeoutError, MethodError
from errormotion.instruments.controller.virtual import VirtualController
from errormotion.instruments.line_profiler.keyence_ljx import KeyenceLJX
from errormotion.instruments.line_profiler.profile_files import ProfileFiles
from errormotion.instruments.simulators import world
from errormotion.instruments.simulators.virtual_world.nc_program import interpret
from errormotion.methods.crossbeam_scan.acquisition import moving
from errormotion.methods.crossbeam_scan.acquisition.scans import CHUNK_LINES, expected_lines, record_scans
from errormotion.methods.crossbeam_scan.acquisition.schedule import schedule
from errormotion.methods.crossbeam_scan.identification.cutting import Scans, interruptions
from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings, PoseSettings
from errormotion.plugins.readings import Profiles

PITCH = 70e-6
TRAVEL = {"X": (0.0, 1.0), "Y": (-1.0, 3.0), "Z": (0.0, 1.0)}
POINTS = 4
LEAD_IN = 1.7
SETTINGS = CrossbeamScanSettings(
    positions=(0.3, 0.45), warm_up=(420.0, 900.0, 1800.0), cold_repeats=1, profiler_pose=PoseSettings(dz=-0.17)
)


@pytest.fixture(autouse=True, scope="module")
def _unsynced():
    """Files of these tests need not survive a power failure."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


class Machine:
    """A control and a profiler on one clock; the points of a line are the position of the axis and the time.

    ``breaks`` maps the number of a pass (repeats counted) to a position and the error that the profiler raises there.
    """

    def __init__(self, breaks=None, scale=1e-6, real=False):
        self.t, self.start_of_day = 0.0, datetime.now(UTC).timestamp()
        self.breaks, self.scale = breaks or {}, scale
        self.place, self.path, self.begun, self.end = 0.1, None, 0.0, -1.0
        self.passes, self.orders, self.opened, self.open_streams = -1, [], 0, 0
        self.warm_since = None
        if not real:
            self.virtual, self.elapse = True, self._elapse

    # the control
    def state(self):
        return {"time": self.t, "position": [0.0, self._place(), 0.0], "running": self.t < self.end}

    def run_program(self, text):
        assert self.t >= self.end, "the control is still busy"
        self.path = interpret(text, (0.0, self._place(), 0.0), TRAVEL, rapid=1.0)
        self.begun, self.end = self.t + LEAD_IN, self.t + LEAD_IN + self.path.duration
        name = text.splitlines()[1].split(":")[0].strip("(")
        self.orders.append(name)
        if name == "pass.nc":
            self.passes += 1
        elif self.warm_since is None:
            self.warm_since = self.begun
        return {"duration": self.path.duration, "longest_lead_in": 2.5}

    def _place(self):
        if self.path is None:
            return self.place
        return float(self.path.place(np.array([max(self.t - self.begun, 0.0)]))[0, 1])

    def _elapse(self, seconds):
        self.t += seconds

    # the profiler
    def open(self):
        self.opened += 1

    def close(self):
        self.opened -= 1

    def stream(self, block):
        self.open_streams += 1
        try:
            if self.path is None or self.t >= self.end:
                raise InstrumentTimeoutError("profiler: no data for 1 s")
            place, what = self.breaks.get(self.passes, (np.inf, None))
            low, high = self.path.places[:, 1].min(), self.path.places[:, 1].max()
            began = self.begun + abs(self.path.places[0, 1] - low) / SETTINGS.measuring_feed + 2.0
            y = np.arange(np.ceil(low / PITCH), np.floor(high / PITCH)) * PITCH
            for first in range(0, y.size - block, block):
                part = y[first : first + block]
                if part[-1] > place:
                    raise what
                when = began + (part - low) / SETTINGS.measuring_feed
                self.t = float(when[-1])
                values = np.zeros((POINTS, block))
                values[0], values[1] = part * 1e-3, when * 1e-6
                yield Profiles(
                    values=values, first=first, rate=1000.0, host_time=0.0, x=np.arange(POINTS) * 1e-5,
                    trigger=np.arange(first, first + block), encoder=np.rint(part / self.scale), invalid={"dark": 1},
                )  # fmt: skip
            raise InstrumentTimeoutError("profiler: no data for 1 s")
        finally:
            self.open_streams -= 1


class Bench:
    machine = "a gantry"

    def __init__(self, asks=None, **instruments):
        self.instruments, self.asked, self.asks = instruments, [], asks

    def has_kind(self, kind):
        return kind in self.instruments

    def of_kind(self, kind):
        return self.instruments[kind]

    def ask(self, message):
        self.asked.append(message)
        if self.asks:
            self.asks(message)


def bench_of(machine):
    return Bench(line_profiler=machine, controller=machine)


def store(chunks, path, *, append=False):
    """Return chunks as read from disk."""
    chunks = iter(chunks)
    first = next(chunks)
    raw = RawStore(path, "line") if append else RawStore.create(path, first, "line", 4000)
    try:
        raw.append(first)
        for chunk in chunks:
            raw.append(chunk)
    finally:
        raw.commit()
    return datasets.load(path)


def record(machine, path, settings=SETTINGS, done=None, **keywords):
    return store(record_scans(bench_of(machine), settings, None, done), path, append=done is not None, **keywords)


@pytest.fixture(scope="module")
def machine():
    """Return the machine of an uninterrupted campaign."""
    return Machine()


@pytest.fixture(scope="module")
def chunks(machine):
    """Return what it yields, not to be changed."""
    return list(record_scans(bench_of(machine), SETTINGS, None, None))


@pytest.fixture(scope="module")
def raw(chunks, tmp_path_factory):
    """Return the record of it, not to be changed."""
    return store(chunks, tmp_path_factory.mktemp("campaign") / "raw.zarr")


def test_campaign_has_cold_passes_then_moves_and_a_pass_for_each_warm_up_time(machine, raw):
    assert machine.orders == [
        *["pass.nc"] * 2, "warm_up_1.nc", "pass.nc", "warm_up_2.nc", "pass.nc", "warm_up_3.nc", "pass.nc"
    ]  # fmt: skip
    datasets.validate(raw)
    np.testing.assert_array_equal(raw["warm_up"], [0, 0, 420, 900, 1800])
    scans = Scans(raw)
    for cycle in range(5):
        for artefact in range(2):
            height, _, y, at = scans.scan(cycle, artefact)
            assert height.shape == (800, POINTS)
            # heights are float32: 0.45e-3 has steps of 3e-11, which is 30 nm of place
            np.testing.assert_allclose(height[:, 0] * 1e3 - SETTINGS.positions[artefact], y, atol=1e-7)
            if cycle > 1:
                assert at == pytest.approx(height[:, 1].mean() * 1e6 - machine.warm_since, abs=0.2)
                # a pass begins with its lead-in, a way of 60 mm/s to its start, a rest, and 25 mm/s
                assert SETTINGS.warm_up[cycle - 2] < at < SETTINGS.warm_up[cycle - 2] + 20
            else:
                assert at < 0
    assert scans.notes == []


def test_lines_have_the_time_at_which_they_were_taken(machine, raw):
    warm = (raw["cycle_of_line"].values > 1) & np.isfinite(raw["encoder"].values)
    true = raw["record"].values[warm, 1] * 1e6 - machine.warm_since
    # the begin of the warm-up is looked for every 0.1 s; float32 holds 1800e-6 to 1e-10, 0.1 ms
    np.testing.assert_allclose(raw["line_time"].values[warm], true, atol=0.06)


def test_only_lines_at_artefacts_are_kept(raw):
    place = raw["encoder"].values * 1e-6
    off = np.abs(place[np.isfinite(place), None] - np.array(SETTINGS.positions)).min(axis=1)
    assert off.max() <= SETTINGS.scan_length / 2 + SETTINGS.margin + 1e-9
    # where the stream is left it may lack up to half of the margin behind the last scan
    assert expected_lines(SETTINGS) == pytest.approx(raw.sizes["line"], rel=0.03)


def test_chunks_are_small_and_counts_are_kept(chunks, raw):
    assert max(chunk.sizes["line"] for chunk in chunks) < CHUNK_LINES + 64
    assert json.loads(raw.attrs["invalid"])["dark"] > 100
    assert raw.attrs["dropped"] == 0


def test_dataset_contains_schedule_and_programs(raw):
    assert json.loads(raw.attrs["schedule"])[2]["program"] == "warm_up_1.nc"
    assert json.loads(raw.attrs["programs"])["pass.nc"].splitlines()[-2] == "M30"


def test_failure_of_the_stream_loses_only_the_rest_of_the_pass(tmp_path):
    machine = Machine({3: (0.4, InstrumentError("profiler: connection lost"))})
    raw = record(machine, tmp_path / "raw.zarr")
    assert machine.opened == 0  # closed and opened once
    scans = Scans(raw)
    assert scans.scan(3, 0)[0].shape == (800, POINTS)
    with pytest.raises(MethodError, match=r"pass 3 broke at 0\.3\d+ m \(profiler: connection lost\)"):
        scans.scan(3, 1)
    assert scans.scan(4, 1)[0].shape == (800, POINTS)
    (broken,) = interruptions(raw)
    assert (broken.cycle, broken.reason) == (3, "profiler: connection lost")
    assert 0.39 < broken.position < 0.4


def test_timeout_in_a_pass_interrupts_it_but_not_before_it(tmp_path):
    silent = InstrumentTimeoutError("profiler: no data for 1 s")
    raw = record(Machine({2: (0.3, silent)}), tmp_path / "raw.zarr")
    with pytest.raises(MethodError, match=r"complete, .* m: pass 2 broke at 0\.29\d m \(profiler: no"):
        Scans(raw).scan(2, 0)
    assert [broken.cycle for broken in interruptions(raw)] == [2]


def test_interrupted_cold_pass_is_repeated_while_the_machine_is_cold(tmp_path):
    machine = Machine({0: (0.4, InstrumentError("connection lost"))})
    raw = record(machine, tmp_path / "raw.zarr")
    assert machine.orders.count("pass.nc") == 6
    scans = Scans(raw)
    for cycle in range(5):
        assert scans.scan(cycle, 1)[0].shape == (800, POINTS)
    assert scans.scan(0, 1)[3] < 0


def test_three_successive_failed_passes_end_the_campaign_and_keep_the_data(tmp_path):
    lost = InstrumentError("connection lost")
    machine = Machine(dict.fromkeys(range(2, 9), (0.4, lost)))
    with raises("scan.passes.failed"):
        record(machine, tmp_path / "raw.zarr")
    raw = datasets.load(tmp_path / "raw.zarr")
    assert [broken.cycle for broken in interruptions(raw)] == [2, 3, 4]
    assert Scans(raw).scan(4, 0)[0].shape == (800, POINTS)


def test_failed_passes_that_are_not_successive_do_not_end_the_campaign(tmp_path):
    lost = InstrumentError("connection lost")
    raw = record(Machine({0: (0.4, lost), 2: (0.4, lost), 4: (0.4, lost)}), tmp_path / "raw.zarr")
    assert [broken.cycle for broken in interruptions(raw)] == [0, 1, 2]
    assert Scans(raw).scan(4, 1)[0].shape == (800, POINTS)


@pytest.mark.parametrize("pitch", [1e-3, 1e-9, -1e-6])
def test_a_wrong_encoder_pitch_is_reported_at_the_first_pass(tmp_path, pitch):
    with pytest.raises(
        MethodError, match=r"none of them in a scan; the scans are at 0\.3, 0\.45 m\. Check encoder_pitch"
    ):
        record(Machine(), tmp_path / "raw.zarr", SETTINGS.model_copy(update={"encoder_pitch": pitch}))


def test_encoder_with_negative_pitch_and_offset_is_read(tmp_path):
    other = SETTINGS.model_copy(update={"encoder_pitch": -1e-6, "encoder_zero": 0.0})
    raw = record(Machine(scale=-1e-6), tmp_path / "raw.zarr", other)
    assert Scans(raw).scan(2, 1)[0].shape == (800, POINTS)


def test_missing_pose_is_reported_with_ways_to_obtain_it():
    with pytest.raises(MethodError, match="procedure = 'profiler_pose'"):
        record_scans(bench_of(Machine()), SETTINGS.model_copy(update={"profiler_pose": None}), None, None)


def test_pose_of_an_earlier_test_has_priority_over_the_settings(tmp_path):
    pose = np.eye(4)
    pose[2, 3] = -0.2
    found = xr.Dataset({"profiler_pose": (("row", "column"), pose), "pose_covariance": (("p", "p_"), np.eye(6) * 1e-9)})
    raw = store(record_scans(bench_of(Machine()), SETTINGS, found, None), tmp_path / "raw.zarr")
    np.testing.assert_array_equal(raw["profiler_pose"], pose)
    np.testing.assert_array_equal(raw["pose_covariance"], np.eye(6) * 1e-9)


def test_a_stated_pose_has_its_stated_uncertainty(raw):
    assert float(raw["profiler_pose"][2, 3]) == -0.17
    np.testing.assert_allclose(np.sqrt(np.diag(raw["pose_covariance"])), 5e-3)


# ---------------------------------------------------------------------- going on


def cut_off(chunks, tmp_path, cycle, place):
    """Return the record of a run that was killed in a pass at a position of the axis."""
    kept = []
    for chunk in chunks:
        here = chunk["cycle_of_line"].values == cycle
        past = (chunk["encoder"].values * 1e-6 > place) & here
        if past.any() or chunk["cycle_of_line"].values[0] > cycle:
            kept.append(chunk.isel(line=~past & (chunk["cycle_of_line"].values <= cycle)))
            break
        kept.append(chunk)
    return store([chunk for chunk in kept if chunk.sizes["line"]], tmp_path / "raw.zarr")


@pytest.mark.parametrize("cycle", [0, 1, 3])
def test_a_virtual_machine_repeats_the_campaign_after_a_crash_and_the_record_is_an_uninterrupted_one(
    chunks, raw, tmp_path, cycle
):
    done = cut_off(chunks, tmp_path, cycle, 0.4)
    assert 0 < done.sizes["line"] < raw.sizes["line"]
    again = record(Machine(), tmp_path / "raw.zarr", done=done)
    assert again.attrs["invalid"] == raw.attrs["invalid"]
    for name, expected in raw.variables.items():
        np.testing.assert_array_equal(again[name].values, expected.values, err_msg=str(name))


def still_there(done):
    """Return the machine of an interrupted record, some seconds after its last line."""
    machine = Machine()
    machine.t = float(np.nanmax(done["line_clock"])) + 10.0
    return machine


def test_running_virtual_machine_keeps_the_interrupted_pass_and_makes_the_next_one(chunks, tmp_path):
    done = cut_off(chunks, tmp_path, 3, 0.4)
    machine = still_there(done)
    raw = record(machine, tmp_path / "raw.zarr", done=done)
    assert machine.orders == ["warm_up_3.nc", "pass.nc"]
    scans = Scans(raw)
    assert [scans.scan(cycle, 0)[0].shape for cycle in range(5)] == [(800, POINTS)] * 5
    with pytest.raises(MethodError, match="the scan has no lines"):
        scans.scan(3, 1)
    assert 1800 < scans.scan(4, 1)[3] < 1820


def test_cold_pass_is_repeated_after_a_crash_before_the_warm_up(chunks, tmp_path):
    done = cut_off(chunks, tmp_path, 1, 0.4)
    machine = still_there(done)
    raw = record(machine, tmp_path / "raw.zarr", done=done)
    assert machine.orders[:2] == ["pass.nc", "warm_up_1.nc"]
    scans = Scans(raw)
    assert [scans.scan(cycle, 1)[0].shape for cycle in range(5)] == [(800, POINTS)] * 5


@pytest.fixture
def day(monkeypatch):
    """Use the time of the day as the clock of a machine."""

    def use(machine):
        def sleep(seconds):
            machine.t += seconds

        monkeypatch.setattr(moving, "time", SimpleNamespace(sleep=sleep))
        monkeypatch.setattr(moving, "steady", lambda: machine.start_of_day + machine.t)
        return machine

    return use


def test_passes_on_a_real_machine_start_at_their_warm_up_times(tmp_path, day):
    machine = day(Machine(real=True))
    raw = record(machine, tmp_path / "raw.zarr")
    scans = Scans(raw)
    for cycle, due in enumerate(SETTINGS.warm_up, 2):
        assert due < scans.scan(cycle, 0)[3] < due + 20
    warm = (raw["cycle_of_line"].values > 1) & np.isfinite(raw["encoder"].values)
    true = raw["record"].values[warm, 1] * 1e6 - machine.warm_since
    np.testing.assert_allclose(raw["line_time"].values[warm], true, atol=0.06)


@pytest.mark.parametrize(("ago", "made", "first"), [(700.0, [3, 4], 900), (1300.0, [3, 4], 1300), (1900.0, [4], 1900)])
def test_warm_up_of_a_real_machine_continues_by_the_clock_without_overdue_passes(
    chunks, tmp_path, day, ago, made, first
):
    done = cut_off(chunks, tmp_path, 2, 0.4)
    mark = int(np.flatnonzero(done["line_time"].values == 0)[0])
    began = datetime.now(UTC) - timedelta(seconds=ago + float(done["line_clock"][mark]))
    done = done.assign_attrs(start=began.isoformat())
    machine = day(Machine(real=True))
    machine.start_of_day = datetime.now(UTC).timestamp()
    raw = record(machine, tmp_path / "raw.zarr", done=done)
    fresh = raw.isel(line=slice(done.sizes["line"], None))
    assert np.unique(fresh["cycle_of_line"]).tolist() == made
    # a pass begins when it is due, or at once; a few seconds pass until its first line
    assert float(fresh["line_time"].min()) == pytest.approx(first, abs=20)
    missing = sorted({2, 3, 4} - set(made) - {2})
    for cycle in missing:
        with pytest.raises(MethodError, match=f"pass {cycle} was not made"):
            Scans(raw).scan(cycle, 0)


def test_record_without_a_start_time_is_not_resumed(chunks, tmp_path, day):
    done = cut_off(chunks, tmp_path, 2, 0.4)
    del done.attrs["start"]
    with raises("run.start.missing"):
        record_scans(bench_of(day(Machine(real=True))), SETTINGS, None, done)


def test_operator_is_prompted_with_program_and_purpose(tmp_path, day):
    machine = day(Machine(real=True))
    texts = {program.name: program.text() for program in schedule(SETTINGS).programs.values()}

    def obey(message):
        machine.t = max(machine.t, machine.end)  # the operator waits for the last one
        name = next(name for name in texts if f" {name} (" in f" {message}")
        machine.run_program(texts[name])
        if "confirm at the moment it starts" in message:
            machine.t = machine.begun

    bench = Bench(asks=obey, line_profiler=machine)
    raw = store(record_scans(bench, SETTINGS, None, None), tmp_path / "raw.zarr")
    assert bench.asked[0].startswith(
        "prepare pass.nc (measuring pass over 2 artefacts; 19 s), confirm, and then start it"
    )
    assert bench.asked[2].startswith("When pass.nc has ended: start warm_up_1.nc (warm-up moves, 6.9 min;")
    assert len(bench.asked) == 8
    warm = (raw["cycle_of_line"].values > 1) & np.isfinite(raw["encoder"].values)
    true = raw["record"].values[warm, 1] * 1e6 - machine.warm_since
    np.testing.assert_allclose(raw["line_time"].values[warm], true, atol=1e-3)


def test_end_of_the_acquisition_between_two_chunks_stops_the_stream():
    machine = Machine()
    chunks = record_scans(bench_of(machine), SETTINGS, None, None)
    next(chunks)
    assert machine.open_streams == 1
    chunks.close()
    assert machine.open_streams == 0


# ---------------------------------------------------------------------- the virtual gantry

PLACES = (-0.3, 0.1)
ON_GANTRY = CrossbeamScanSettings(
    positions=PLACES, warm_up=(420.0, 1800.0), cold_repeats=0, profiler_pose=PoseSettings(), travel=(-0.9, 0.9)
)


def gantry(seed, parameters=""):
    """Return control and profiler of a virtual gantry."""
    places = ",".join(map(str, PLACES))
    address = f"sim://gantry/profiler?seed={seed}&points=64&pitch=5e-4&artefacts={places}{parameters}"
    return VirtualController(f"sim://gantry/controller?seed={seed}", CONTROLLER), KeyenceLJX(address)


def test_times_and_positions_on_the_virtual_gantry_are_true(tmp_path):
    control, profiler = gantry(11)
    with control, profiler:
        raw = store(
            record_scans(Bench(controller=control, line_profiler=profiler), ON_GANTRY, None, None),
            tmp_path / "raw.zarr",
        )
        last = float(raw["line_time"][-1])
        end = float(world("gantry", 11).warm_time(np.array([float(raw["line_clock"][-1])]))[0])
    datasets.validate(raw)
    assert last == pytest.approx(end, abs=0.06)  # the first motion is looked for every 0.1 s
    scans = Scans(raw)
    assert [scans.scan(cycle, artefact)[0].shape for cycle in range(3) for artefact in range(2)] == [(800, 64)] * 6
    assert scans.notes == []


def test_overflow_of_the_encoder_is_corrected(tmp_path):
    half = 1 << 31
    control, profiler = gantry(12, f"&encoder_start={half + 100_000}")  # overflows between the artefacts, at -0.1 m
    zero = -(half + 100_000) * 1e-6
    settings = ON_GANTRY.model_copy(update={"encoder_zero": zero, "warm_up": (420.0,)})
    with control, profiler:
        raw = store(
            record_scans(Bench(controller=control, line_profiler=profiler), settings, None, None), tmp_path / "raw.zarr"
        )
    scans = Scans(raw)
    assert [scans.scan(cycle, artefact)[0].shape for cycle in range(2) for artefact in range(2)] == [(800, 64)] * 4
    assert scans.notes == []  # nothing was left to mend
    assert np.nanmax(np.abs(np.diff(raw["encoder"].values[raw["cycle_of_line"].values == 1]))) < 1e6


def test_profiler_is_reopened_after_a_lost_connection(tmp_path):
    settings = ON_GANTRY.model_copy(update={"cold_repeats": 1})
    control, profiler = gantry(13, "&fault=disconnect&fault_at=5000")
    with control, profiler:
        reopened = []
        profiler.close = lambda: (reopened.append(1), KeyenceLJX.close(profiler))[1]
        with raises("scan.passes.failed"):
            store(
                record_scans(Bench(controller=control, line_profiler=profiler), settings, None, None),
                tmp_path / "raw.zarr",
            )
        assert len(reopened) == 2
    raw = datasets.load(tmp_path / "raw.zarr")
    assert Scans(raw).scan(0, 0)[0].shape == (800, 64)  # the line is cut behind the first artefact, every time
    assert interruptions(raw)[0].position == pytest.approx(0.017, abs=0.02)


def test_stop_leaves_no_thread_and_instruments_are_usable():
    control, profiler = gantry(14)
    with control, profiler:
        before = set(threading.enumerate())
        chunks = record_scans(Bench(controller=control, line_profiler=profiler), ON_GANTRY, None, None)
        next(chunks)
        chunks.close()
        deadline = time.monotonic() + 5
        while (left := set(threading.enumerate()) - before) and time.monotonic() < deadline:
            time.sleep(0.02)
        assert not left
        assert profiler.program() == 0


# ---------------------------------------------------------------------- files


def write_files(folder, count, *, lines=400, spoil=None):
    """Write scans as NetCDF files; the first point of a line is its number in the file."""
    for number in range(count):
        y = np.arange(lines) * PITCH + (number % 3) * 1e-5
        heights = np.tile(y[:, None], (1, POINTS)) * 1e-2
        ds = xr.Dataset(
            {
                "height": (("profile", "point"), heights, {"units": "m"}),
                "x": ("point", np.arange(POINTS) * 1e-2, {"units": "mm"}),
                "y": ("profile", y, {"units": "m"}),
            }
        )
        if spoil:
            ds = spoil(number, ds)
        ds.to_netcdf(folder / f"scan_{number:02d}.nc", engine="h5netcdf")
    return ProfileFiles(str(folder / "scan_*.nc"))


FROM_FILES = SETTINGS.model_copy(update={"warm_up": (420.0, 900.0), "cold_repeats": 0})


def from_files(profiler, path, done=None):
    with profiler:
        chunks = record_scans(Bench(line_profiler=profiler), FROM_FILES, None, done)
        return store(chunks, path, append=done is not None)


def test_files_are_scans_pass_by_pass_and_artefact_by_artefact(tmp_path):
    raw = from_files(write_files(tmp_path, 6), tmp_path / "raw.zarr")
    datasets.validate(raw)
    scans = Scans(raw)
    for cycle in range(3):
        for artefact in range(2):
            height, _, y, at = scans.scan(cycle, artefact)
            assert y.size in (399, 400)  # the grid of a later scan is shifted against the window of the first
            middle = (399 * PITCH) / 2 + artefact % 3 * 1e-5  # that of the first scan of this artefact
            np.testing.assert_allclose(height[:, 0] * 1e2 - middle, y, atol=1e-6)
            assert at == pytest.approx([at, 420.0, 900.0][cycle])


def test_wrong_number_of_files_is_reported_with_the_expected_number(tmp_path):
    with pytest.raises(
        MethodError, match=r"Expected 6 files.*3 passes \(1 cold and 2 warm\) over 2 artefacts; found 5"
    ):
        from_files(write_files(tmp_path, 5), tmp_path / "raw.zarr")


def test_incomplete_file_is_a_missing_scan_with_a_reason(tmp_path):
    raw = from_files(
        write_files(tmp_path, 6, spoil=lambda k, ds: ds.isel(profile=slice(0, 200)) if k == 3 else ds),
        tmp_path / "raw.zarr",
    )
    with pytest.raises(MethodError, match="50% complete"):
        Scans(raw).scan(1, 1)
    assert Scans(raw).scan(2, 1)[2].size in (399, 400)


def test_files_with_other_points_are_refused_by_name(tmp_path):
    files = write_files(tmp_path, 6, spoil=lambda k, ds: ds.isel(point=slice(0, 3)) if k == 3 else ds)
    with raises("scan.files.points"):
        from_files(files, tmp_path / "raw.zarr")


def test_recorded_files_are_not_read_again(tmp_path):
    files = write_files(tmp_path, 6)
    whole = from_files(files, tmp_path / "whole.zarr")
    with files:
        chunks = list(record_scans(Bench(line_profiler=files), FROM_FILES, None, None))
    half = store([*chunks[:2], chunks[2].isel(line=slice(0, 150))], tmp_path / "half.zarr")
    again = from_files(files, tmp_path / "half.zarr", done=half)
    for name in ("record", "encoder", "cycle_of_line", "line_time"):
        np.testing.assert_array_equal(again[name], whole[name])
