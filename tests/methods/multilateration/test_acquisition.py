"""Measurement from several stations, with a simulated machine and tracker."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion import datasets
from errormotion.errors import InstrumentError, MethodError
from errormotion.methods.multilateration.acquisition.measure import measure_stations
from errormotion.methods.multilateration.networks import solve
from errormotion.methods.multilateration.planning import layout
from errormotion.methods.multilateration.readings import latest
from errormotion.methods.multilateration.settings import Measuring, MultilaterationSettings

STATIONS = ((-0.35, -0.3, 0.0), (0.35, -0.3, 0.05), (0.35, 0.3, 0.0), (-0.3, 0.3, 0.5))
LAYOUT = {"low": (-0.1, -0.1, 0.0), "high": (0.1, 0.1, 0.2), "count": (3, 3, 2), "stations": STATIONS}
REFLECTOR = (0.02, -0.01, -0.08)
QUICK = Measuring(settle=0.25, returns=2)
NOISE, BULGE = 0.2e-6, 2e-3  # 1/m: the machine is wrong by up to some 0.1 mm


def settings(**changes):
    return MultilaterationSettings(layout=LAYOUT | {"reflector": REFLECTOR} | changes)


def true_place(position):
    """Return the position of the reflector: the commanded one, with errors that are not a rigid motion."""
    x, y, z = position
    return np.array(position) + REFLECTOR + BULGE * np.array([x * y, y * z, x * x])


class Machine:
    """Machine that moves to the commanded position, with its own clock."""

    def __init__(self):
        self.place, self.time, self.path = np.zeros(3), 0.0, []

    def move_to(self, position, feed=None):
        self.place = np.array(position, float)
        self.path.append(tuple(position))
        self.time += 1.0

    def elapse(self, seconds):
        self.time += seconds

    def state(self):
        return {"position": list(self.place), "time": self.time, "running": False}


class Tracker:
    """Interferometer that follows its reflector, upright at a station and rotated by any angle.

    ``broken`` lists the measurements, counted from 0, before which the beam breaks; ``shadow`` the targets (as
    commanded, by set-up) that it never sees.
    """

    info = SimpleNamespace(id="tracker")
    settings = SimpleNamespace(noise=NOISE)
    distance_is_displacement = True

    def __init__(self, bench, broken=(), shadow=(), air=True):
        self.bench, self.broken, self.shadow, self.air = bench, set(broken), set(shadow), air
        self.rng = np.random.default_rng(7)
        self.count, self.number, self.locked, self.last, self.asked = 0, 0, True, None, 0.003

    def place_at(self, station):
        self.station, self.turn = np.array(station), self.rng.uniform(-3, 3)
        self.rise()

    def rise(self):
        self.number, self.locked, self.dead = self.number + 1, True, self.rng.uniform(-0.01, 0.01)

    def measure(self, target=None):
        if self.count in self.broken:
            self.locked = False
        self.count += 1
        c, s = np.cos(self.turn), np.sin(self.turn)
        way = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ (true_place(self.bench.machine_.place) - self.station)
        if (self.bench.asked_for, tuple(np.round(self.bench.machine_.place, 6))) in self.shadow:
            self.locked = False
            return self.answer(None, "beam broken")
        if not self.locked:
            if target is None or np.linalg.norm(np.array(target) - way) > 0.05:
                return self.answer(None, "beam broken")
            self.rise()
        return self.answer(way, "")

    def answer(self, way, reason):
        length = np.nan if way is None else np.linalg.norm(way)
        distance = length + self.dead + NOISE * self.rng.normal()
        place = (np.nan,) * 3 if way is None else tuple(way * distance / length)
        air = SimpleNamespace(temperature=21.0, pressure=100800.0, humidity=43.0 if self.air else np.nan)
        return SimpleNamespace(
            distance=distance, position=place, environment=air, refraction_index=1.00027 if self.air else np.nan,
            valid=way is not None, reason=reason, dead_path=self.number,
        )  # fmt: skip


class Bench:
    machine = "a machine"

    def __init__(self, moved=True, **tracker):
        self.machine_, self.moved = Machine(), moved
        self.tracker = Tracker(self, **tracker)
        self.messages, self.actions, self.asked_for = [], [], 0

    def has_kind(self, kind):
        return kind in ("laser_tracker", "controller")

    def of_kind(self, kind):
        return self.tracker if kind == "laser_tracker" else self.machine_

    def ask(self, message, action="", **values):
        self.messages.append(message)
        self.actions.append((action, values))
        self.asked_for = int(message.split("Station S")[1][0])
        if self.moved or not hasattr(self.tracker, "station"):
            self.tracker.place_at(STATIONS[self.asked_for - 1])


def joined(chunks):
    raw = xr.concat(chunks, dim="station", data_vars="minimal", coords="minimal", compat="override", join="exact")
    return raw.drop_attrs(deep=False).assign_attrs({k: v for k, v in chunks[0].attrs.items() if k != "invalid"})


def measured(bench, measuring=QUICK, done=None, **changes):
    return list(measure_stations(bench, settings(**changes), {}, done, measuring))


def position_of(k):
    return tuple(np.round(layout.grid(settings().layout)[0][k], 6))


def test_stations_return_one_dataset_each_and_determine_the_errors():
    bench = Bench()
    chunks = measured(bench)
    assert [list(chunk["station"].values) for chunk in chunks] == [["S1"], ["S2"], ["S3"], ["S4"]]
    raw = joined(chunks)
    datasets.validate(raw)
    assert raw["displacement"].shape == (4, 18 + 2)
    network = solve(
        raw["displacement"].values, raw["target_nominal"].values, raw["station_nominal"].values, noise=NOISE
    )
    true = np.array([true_place(q) for q in (raw["target_nominal"] - raw["reflector"]).values])
    nominal = raw["target_nominal"].values
    lever = nominal - nominal.mean(axis=0)
    G = np.concatenate([np.broadcast_to(np.eye(3), (20, 3, 3)), -np.cross(lever[:, None], np.eye(3)).swapaxes(1, 2)], 2)
    G = G.reshape(-1, 6)
    error = (true - nominal).ravel()
    error -= G @ np.linalg.lstsq(G, error)[0]
    miss = (network.target - nominal).ravel() - error
    spread = np.sqrt(np.diagonal(network.covariance, axis1=1, axis2=2)).ravel()
    # 60 numbers, and the fitted rotation is small but not infinitely so: its square times 0.2 m is far below 1e-8 m.
    assert np.all(np.abs(miss) < 4.5 * spread + 1e-8)
    assert np.abs(error).max() > 20 * spread.max()


def test_operator_is_prompted_for_every_station_with_the_machine_at_the_first_target():
    bench = Bench()
    measured(bench)
    assert len(bench.messages) == 4
    assert "S2: set up the tracker near (350, -300, 50) mm" in bench.messages[1]
    assert bench.actions[1] == ("set_station", {"position": [0.35, -0.3, 0.05]})


def test_machine_settles_before_a_reading_and_moves_between_neighbours():
    bench = Bench()
    raw = measured(bench)[0]
    times = np.sort(raw["reading_time"].values[0])
    np.testing.assert_allclose(np.diff(times), 1.25)  # the fake takes 1 s to move, and 0.25 s are waited
    path = np.array(bench.machine_.path[1:19])
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() <= 0.2 + 1e-12


def test_targets_are_measured_again_at_the_end():
    raw = measured(Bench())[0]
    nominal, times = raw["target_nominal"].values, raw["reading_time"].values[0]
    for k in (18, 19):
        first = np.flatnonzero((nominal[:18] == nominal[k]).all(axis=1))
        assert first.size == 1
        assert times[k] > times[:18].max() > times[first[0]]


def test_air_is_recorded_if_the_tracker_reports_it():
    raw = measured(Bench())[0]
    assert float(raw["relative_humidity"][0, 0]) == pytest.approx(0.43)
    assert float(raw["refractive_index"][0, 0]) == pytest.approx(1.00027)
    without = measured(Bench(air=False))[0]
    assert "air_temperature" not in without
    assert "refractive_index" not in without


def test_a_failed_weather_station_stops_the_measurement():
    bench = Bench()
    chunks = measure_stations(bench, settings(), {}, None, QUICK)
    next(chunks)
    bench.tracker.air = False
    with raises("network.air.missing"):
        next(chunks)


def test_a_broken_beam_restarts_the_count_for_all_targets():
    bench = Bench(broken=[6])
    raw = measured(bench)[0]
    d = raw["displacement"].values[0]
    assert np.isfinite(d).all()
    assert raw.attrs["invalid"] == {}
    true = np.array(
        [np.linalg.norm(true_place(q) - STATIONS[0]) for q in (raw["target_nominal"] - raw["reflector"]).values]
    )
    assert np.ptp(d - true) < 10 * NOISE  # dead paths differ by millimetres


def test_a_target_that_is_never_visible_is_nan_with_its_reason():
    bench = Bench(shadow=[(1, position_of(5))])
    raw = measured(bench)[0]
    d = raw["displacement"].values[0]
    lost = np.isnan(d)
    assert lost[5]
    assert np.count_nonzero(lost) <= 2  # a return to it is no better
    assert raw.attrs["invalid"] == {"beam broken": int(np.count_nonzero(lost))}


def test_with_repeatedly_broken_beams_the_longest_count_is_kept():
    bench = Bench(broken=[5, 9, 20, 40])
    raw = measured(bench, Measuring(settle=0.0, returns=0, renewals=0, repeats=0))[0]
    d = raw["displacement"].values[0]
    kept = np.isfinite(d)
    assert 0 < np.count_nonzero(kept) < 18
    assert raw.attrs["invalid"] == {"count lost": int(np.count_nonzero(~kept))}
    true = np.array(
        [np.linalg.norm(true_place(q) - STATIONS[0]) for q in (raw["target_nominal"] - raw["reflector"]).values]
    )
    assert np.ptp((d - true)[kept]) < 10 * NOISE


def test_a_poor_set_up_is_repeated_and_replaced():
    class Awkward(Bench):
        def ask(self, message, action="", **values):
            super().ask(message, action, **values)
            # Somebody stands in the way of the first set-up at S2.
            in_the_way = self.asked_for == 2 and sum("Station S2" in text for text in self.messages) == 1
            self.tracker.shadow = {(2, position_of(k)) for k in range(8)} if in_the_way else set()

    chunks = measured(Awkward())
    assert [str(chunk["station"].values[0]) for chunk in chunks] == ["S1", "S2", "S2", "S3", "S4"]
    raw = latest(joined(chunks))
    assert list(raw["station"].values) == ["S1", "S2", "S3", "S4"]
    assert np.isfinite(raw["displacement"].values).all()
    assert np.isnan(chunks[1]["displacement"].values).sum() >= 8


def test_a_repeated_station_replaces_the_earlier_one():
    chunks = measured(Bench(), Measuring(settle=0.0, returns=0, sequence=(1, 2, 3, 4, 2)))
    raw = joined(chunks)
    assert list(raw["station"].values) == ["S1", "S2", "S3", "S4", "S2"]
    np.testing.assert_array_equal(latest(raw)["displacement"].values[-1], raw["displacement"].values[4])
    with raises("network.sequence.form"):
        measured(Bench(), Measuring(sequence=(1, 5)))


def test_an_interrupted_run_continues_after_its_last_set_up():
    chunks = measured(Bench())
    bench = Bench()
    rest = measured(bench, done=joined(chunks[:2]))
    assert [str(chunk["station"].values[0]) for chunk in rest] == ["S3", "S4"]
    assert len(bench.messages) == 2
    assert measured(Bench(), done=joined(chunks)) == []
    with raises("network.sequence.changed"):
        measured(Bench(), Measuring(sequence=(2, 1)), done=joined(chunks[:1]))


def test_a_poor_last_set_up_of_an_interrupted_run_is_repeated():
    chunks = measured(Bench(), Measuring(settle=0.0, returns=0))
    poor = chunks[1].copy(deep=True)
    poor["displacement"][:, :9] = np.nan
    rest = measured(Bench(), Measuring(settle=0.0, returns=0), done=joined([chunks[0], poor]))
    assert [str(chunk["station"].values[0]) for chunk in rest] == ["S2", "S3", "S4"]


def test_a_tracker_that_was_not_moved_is_detected():
    with raises("network.tracker.elsewhere"):
        measured(Bench(moved=False))


def test_a_machine_that_does_not_reach_the_target_is_reported():
    bench = Bench()
    bench.machine_.move_to = lambda position, feed=None: None
    with pytest.raises(MethodError, match=r"Target 1: the machine is \d+ mm from this position after 0\.1 s"):
        measured(bench, Measuring(timeout=0.1))


def test_unsuitable_instruments_are_refused_before_any_motion():
    bench = Bench()
    bench.has_kind = lambda kind: kind == "laser_tracker"
    with raises("bench.controller.no_moves"):
        measured(bench)
    bench = Bench()
    bench.tracker = SimpleNamespace(read=lambda: 0.0)
    with raises("network.tracker.imports"):
        measured(bench)
    assert bench.machine_.path == []


def test_absolute_distances_require_no_repetition():
    bench = Bench(broken=[6])
    bench.tracker.distance_is_displacement = False
    rise = bench.tracker.rise

    def absolute():
        rise()
        bench.tracker.number, bench.tracker.dead = 0, 1e-4

    bench.tracker.rise = absolute
    raw = measured(bench)[0]
    assert np.isfinite(raw["displacement"].values).all()
    assert len(bench.machine_.path) == 4 * (20 + 1)  # no target came twice


class Warm(Bench):
    """Return a bench with a thermometer; the scales warm up by 0.01 K with every reading."""

    channels = ("x", "y", "z", "ambient")

    def __init__(self, failing=()):
        super().__init__()
        self.count, self.failing = 0, failing

    def has_kind(self, kind):
        return kind == "thermometer" or super().has_kind(kind)

    def of_kind(self, kind):
        return self if kind == "thermometer" else super().of_kind(kind)

    def read(self):
        self.count += 1
        if self.count in self.failing:
            raise InstrumentError("no answer")
        return {"x": 20.0 + 0.01 * self.count, "y": 21.0, "z": np.nan, "ambient": 19.0}


def test_temperatures_of_the_scales_are_recorded_at_start_and_end_of_a_set_up():
    sensors = QUICK.model_copy(update={"scale_sensors": ("x", "y", "z")})
    raw = joined(measured(Warm(failing=(3, 4)), sensors))
    datasets.validate(raw)
    found = raw["scale_temperature"].values
    # Two readings for each set-up; both of the second fail but for one.
    np.testing.assert_allclose(found[:, 0], [20.015, np.nan, 20.055, 20.075], equal_nan=True)
    assert (found[:, 1][np.isfinite(found[:, 0])] == 21.0).all()
    assert np.isnan(found[:, 2]).all()
    assert "scale_temperature" not in joined(measured(Warm()))


def test_unknown_sensors_are_refused_before_any_motion():
    sensors = QUICK.model_copy(update={"scale_sensors": ("x", "y", "scale of Z")})
    bench = Warm()
    with raises("bench.thermometer.channels"):
        measured(bench, sensors)
    assert not bench.machine_.path
    with raises("bench.thermometer.missing"):
        measured(Bench(), sensors)


def test_the_targets_of_a_plan_are_visited_in_order_and_again():
    chosen = ((0.0, 0.0, 0.0), (0.1, 0.1, 0.2), (0.0, 0.1, 0.0), (0.1, 0.0, 0.2), (-0.1, 0.0, 0.1), (0.1, 0.1, 0.0))
    bench = Bench()
    chunk = next(measure_stations(bench, settings(targets=chosen), {}, None, QUICK))
    assert chunk.sizes["target"] == len(chosen) + QUICK.returns
    np.testing.assert_allclose(chunk["target_nominal"].values[: len(chosen)], np.array(chosen) + REFLECTOR)
    assert set(map(tuple, np.round(bench.machine_.path, 6))) == set(chosen)
