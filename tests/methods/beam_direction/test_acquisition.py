"""Measurement of a beam on the faces of a gauge, with a simulated stage and sensor."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion import datasets
from errormotion.errors import MethodError
from errormotion.methods.beam_direction.acquisition import measure_planes
from errormotion.methods.beam_direction.planning import design
from errormotion.methods.beam_direction.settings import BeamDirectionSettings

BEAM = np.array([np.sin(np.radians(21.0)), 0.01, -np.cos(np.radians(21.0))])
BEAM /= np.linalg.norm(BEAM)
ORIGIN, PIVOT = np.array([0.05, 0.0, -0.08]), np.array([0.1, 0.05, 0.12])
LAYOUT = {
    "nominal_origin": tuple(ORIGIN + 1e-4),
    "nominal_direction": (np.sin(np.radians(20)), 0.0, -np.cos(np.radians(20))),
    "pivot": tuple(PIVOT),
    "readings": 12,
    "average": 2,
}


class Stage:
    """Stage that moves to the commanded position within 1 um and returns its position."""

    def __init__(self):
        self.place, self.moves = np.zeros(3), 0

    def move_to(self, position, feed=None):
        self.place = np.array(position) + 1e-6
        self.moves += 1

    def state(self):
        return {"position": list(self.place)}


class SettingStage(Stage):
    """Stage whose control also sets the gauge."""

    def __init__(self):
        super().__init__()
        self.set = []

    def set_target(self, kind, inclination=None, rotation=None):
        self.set.append((kind, inclination, rotation))


class Sensor:
    """Sensor that reads the distance of the last face set; NaN out of range."""

    info = SimpleNamespace(id="sensor")
    settings = SimpleNamespace(noise=2e-7)
    measuring_range, mid_range = (-10e-3, 10e-3), 0.0
    no_value = ""

    def __init__(self, bench, sign=1.0, carries=1.0):
        self.bench, self.sign, self.carries, self.reads = bench, sign, carries, 0

    def read(self):
        self.reads += 1
        normal = design.plane_normals([self.bench.face])[0]
        reading = normal @ (PIVOT - ORIGIN - self.carries * self.bench.stage.place) / (normal @ BEAM)
        low, high = self.measuring_range
        self.no_value = "" if low < reading < high else "too near" if reading < low else "too far"
        return self.sign * reading if low < reading < high else float("nan")


class Bench:
    machine = "a machine"

    def __init__(self, stage=None, **sensor):
        self.stage = stage or SettingStage()
        self.sensor = Sensor(self, **sensor)
        self.asked = []

    @property
    def face(self):
        if isinstance(self.stage, SettingStage):
            return self.stage.set[-1][1:]
        return self.by_hand

    def has_kind(self, kind):
        return kind in ("point_lds", "controller")

    def of_kind(self, kind):
        return self.sensor if kind == "point_lds" else self.stage

    def ask(self, message, action="", **values):
        if isinstance(self.stage, SettingStage):
            getattr(self.stage, action)(**values)
            return
        self.asked.append((message, self.stage.place.copy()))
        self.by_hand = np.radians([20.0, (0.0, 90.0, 180.0)[len(self.asked) - 1]])


def settings(**layout):
    return BeamDirectionSettings(layout=LAYOUT | layout)


def joined(chunks):
    raw = xr.concat(chunks, dim="plane", data_vars="minimal", coords="minimal", compat="override", join="exact")
    return raw.drop_attrs().assign_attrs({k: v for k, v in chunks[0].attrs.items() if k != "invalid"})


def test_faces_return_one_dataset_each_and_conform_to_the_schema():
    bench = Bench()
    chunks = list(measure_planes(bench, settings(), {}, None))
    assert [angles[1:] for angles in bench.stage.set] == [
        pytest.approx((np.radians(20.0), np.radians(b))) for b in (0.0, 90.0, 180.0)
    ]
    raw = joined(chunks)
    datasets.validate(raw)
    assert dict(raw.sizes) == {"plane": 3, "reading": 12, "direction": 3, "limit": 2}
    assert np.isfinite(raw["distance"]).all()
    assert all(chunk.attrs["invalid"] == {} for chunk in chunks)
    assert float(raw["distance_noise"]) == pytest.approx(2e-7 / np.sqrt(2))
    np.testing.assert_array_equal(raw["plane_point"], np.tile(PIVOT, (3, 1)))


def test_positions_are_those_of_the_control_and_readings_use_most_of_the_range():
    (chunk, *_) = measure_planes(Bench(), settings(), {}, None)
    normal = chunk["nominal_normal"].values[0]
    exact = (PIVOT - ORIGIN - chunk["stage"].values[0]) @ normal / (normal @ BEAM)
    np.testing.assert_allclose(chunk["distance"].values[0], exact, atol=1e-12)
    # Four fifths of 20 mm, to what a beam 1 deg off its nominal direction changes; about mid-range.
    assert np.ptp(exact) == pytest.approx(16e-3, rel=0.05)
    assert abs(np.ptp(exact) / 2 - exact.max()) < 1e-3


def test_an_interrupted_run_continues_with_the_next_face():
    before = joined(list(measure_planes(Bench(), settings(), {}, None))[:2])
    bench = Bench()
    (last,) = measure_planes(bench, settings(), {}, before)
    assert [angle[2] for angle in bench.stage.set] == [pytest.approx(np.pi)]
    assert last.sizes["plane"] == 1


def test_the_operator_sets_a_manual_gauge_while_the_sensor_is_retracted():
    bench = Bench(Stage())
    chunks = list(measure_planes(bench, settings(search=15e-3), {}, None))
    assert len(chunks) == len(bench.asked) == 3
    message, place = bench.asked[1]
    assert "Face 2 of 3" in message
    assert "inclination of 20 deg and its turntable to 90 deg" in message
    nominal = np.array(LAYOUT["nominal_direction"])
    assert place @ nominal == pytest.approx((PIVOT - ORIGIN - 1e-4) @ nominal - 15e-3, abs=1e-5)


def test_readings_out_of_range_are_nan_and_counted_by_reason():
    chunk = next(iter(measure_planes(Bench(), settings(strokes=(1e-3, 1e-3, 30e-3)), {}, None)))
    lost = int(np.isnan(chunk["distance"]).sum())
    assert lost == 2  # of four places over 30 mm the outer ones are 15 mm off
    assert chunk.attrs["invalid"] == {"too near": 2, "too far": 2}  # two readings at each place
    assert np.isfinite(chunk["stage"]).all()


def test_a_stage_that_carries_the_target_moves_in_the_opposite_direction():
    bench = Bench(carries=-1.0)
    chunks = list(measure_planes(bench, settings().model_copy(update={"moves": "target"}), {}, None))
    assert all(np.isfinite(chunk["distance"]).all() for chunk in chunks)
    assert chunks[0].attrs["moves"] == "target"


def test_a_path_replaces_the_strokes():
    path = [(x, y, z) for x in (-1e-3, 1e-3) for y in (-1e-3, 1e-3) for z in (-2e-3, 0.0, 2e-3)]
    chunk = next(iter(measure_planes(Bench(), settings(path=path), {}, None)))
    places = chunk["stage"].values[0]
    np.testing.assert_allclose(places - places.mean(axis=0), path, atol=1e-12)


def test_readings_that_increase_as_the_sensor_approaches_are_refused():
    with raises("beam.sensor.gain"):
        list(measure_planes(Bench(sign=-1.0), settings(), {}, None))


def test_a_face_that_is_not_found_is_reported_with_the_search_range():
    with pytest.raises(MethodError, match=r"no reading from -5 to 5 mm along the beam"):
        list(measure_planes(Bench(), settings(start=(0.05, 0.05, 0.3), search=5e-3), {}, None))


def test_an_incomplete_bench_is_refused_with_what_is_missing():
    bench = Bench()
    bench.stage = SimpleNamespace(state=dict)
    with raises("bench.controller.no_moves"):
        list(measure_planes(bench, settings(), {}, None))
    with raises("beam.search.start_unknown"):
        list(measure_planes(Bench(), settings(pivot=None), {}, None))
