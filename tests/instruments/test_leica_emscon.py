"""The driver of an emScon server against the simulated one, over TCP."""

from itertools import islice

import numpy as np
import pytest
from coded import raises

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments import simulators
from errormotion.instruments.laser_tracker.leica_emscon import EmSconSettings, LeicaEmScon
from errormotion.instruments.laser_tracker.leica_emscon.targets import BeamBrokenError
from errormotion.instruments.simulators.virtual_world.tracker_scene import refraction_index
from errormotion.plugins.readings import Environment
from errormotion.testing import InstrumentConformance, InstrumentSubject

ADDRESS = "sim://cframe/tracker?seed=3"
STATION = np.array([-1.2, -0.9, 0.3])
QUICK = EmSconSettings(timeout=0.5, busy_timeout=0.3)
ABSOLUTE = EmSconSettings(tracker="AT4xx", timeout=0.5, busy_timeout=0.3)


class TestKit(InstrumentConformance):
    """With a name of a reflector, the air as given, and single measurements with covariances."""

    subject = InstrumentSubject(
        LeicaEmScon,
        "sim://gantry/tracker?seed=2&result=2&station=-1.5,-1.5,0.4",
        settings={"reflector": "Cat's eye", "meteo": "manual", "timeout": 0.5, "busy_timeout": 0.3},
        vary=simulators.in_steps("gantry", 2),
        name="gantry",
        mutants=40,
    )


def true_distance(place: tuple[float, float, float]) -> float:
    machine = simulators.world("cframe", seed=3).machine
    shift = np.asarray(machine.volumetric_truth([place]).em.twist())[0, :3]
    return float(np.linalg.norm(np.array(place) + shift - STATION))


def test_displacements_are_those_of_the_machine_with_its_errors() -> None:
    places = [(0.0, 0.0, 0.1), (0.2, 0.1, 0.3), (-0.25, -0.2, 0.05)]
    with LeicaEmScon(ADDRESS + "&noise=0&angle_noise=0", QUICK) as tracker:
        world = simulators.world("cframe", seed=3)
        found = []
        for place in places:
            world.move_to(place)
            found.append(tracker.measure())
    truth = [true_distance(place) for place in places]
    assert all(each.valid for each in found)
    assert {each.dead_path for each in found} == {0}
    # one dead path for all: differences hold to the last bits of a metre
    np.testing.assert_allclose(np.diff([each.distance for each in found]), np.diff(truth), rtol=0, atol=1e-14)
    assert 0 < abs(found[0].distance - truth[0]) < 0.01


def test_an_at4xx_measures_absolute_distances_and_angles_at_positions() -> None:
    place = (0.1, -0.1, 0.2)
    with LeicaEmScon(ADDRESS + "&tracker=AT4xx&noise=0&angle_noise=0&dead_path=0", ABSOLUTE) as tracker:
        simulators.world("cframe", seed=3).move_to(place)
        found = tracker.measure(tuple(np.array(place) - STATION))
        assert not tracker.distance_is_displacement
    assert found.distance == pytest.approx(true_distance(place), abs=1e-14)
    np.testing.assert_allclose(found.position, np.array(place) - STATION, rtol=0, atol=50e-6)  # the machine's errors
    assert found.reason == ""


def test_a_position_without_a_reflector_is_a_measurement_with_that_reason() -> None:
    with LeicaEmScon(ADDRESS + "&tracker=AT4xx", ABSOLUTE) as tracker:
        found = tracker.measure((-1.0, 2.0, 0.5))
        again = tracker.measure(tuple(-STATION))
    assert (found.valid, np.isnan(found.distance)) == (False, True)
    assert "no result" in found.reason
    assert again.valid


def test_an_interferometer_keeps_its_count_while_it_follows_the_reflector() -> None:
    with LeicaEmScon(ADDRESS, QUICK) as tracker:
        first = tracker.measure(tuple(-STATION))
        simulators.world("cframe", seed=3).move_to((0.1, 0.1, 0.1))
        second = tracker.measure(tuple(np.array([0.1, 0.1, 0.1]) - STATION))
        tracker.home()
        nest = tracker.measure()
        tracker.go_to(tuple(np.array([0.1, 0.1, 0.1]) - STATION))
        third = tracker.measure()
    assert [each.dead_path for each in (first, second, nest, third)] == [0, 0, 1, 2]
    assert nest.distance == pytest.approx(0.3, abs=0.01)
    assert third.distance != pytest.approx(second.distance, abs=1e-6)  # another dead path


def test_a_broken_beam_is_locked_again_and_counts_as_a_new_dead_path() -> None:
    with LeicaEmScon(ADDRESS + "&fault=beam_broken&fault_at=1&fault_for=1", QUICK) as tracker:
        first, second = tracker.measure(), tracker.measure()
        kinds = [event.kind for event in tracker.events]
        assert not tracker.beam_broken
    assert (first.valid, second.valid) == (True, True)
    assert second.dead_path > first.dead_path
    assert "error" in kinds


def test_a_beam_that_stays_broken_is_nan_with_its_reason() -> None:
    with LeicaEmScon(ADDRESS + "&fault=beam_broken", QUICK) as tracker:
        found = tracker.measure()
        assert tracker.beam_broken
        assert np.isnan(tracker.read())
        with pytest.raises(BeamBrokenError, match="check the position of the reflector"):
            tracker.find_reflector(1.5)
    assert not found.valid
    assert "no result" in found.reason


def test_without_reacquisition_a_broken_beam_stays_broken() -> None:
    settings = EmSconSettings(reacquire=0, timeout=0.5)
    with LeicaEmScon(ADDRESS + "&fault=beam_broken&fault_for=1", settings) as tracker:
        reasons = [tracker.measure().reason for _ in range(2)]
    assert "not ready to measure" in reasons[0]
    assert reasons[1] == "beam broken"


def test_points_lost_by_a_broken_beam_are_counted_at_their_times() -> None:
    with LeicaEmScon(ADDRESS + "&fault=beam_broken&fault_at=30&fault_for=25", QUICK) as tracker:
        blocks = list(islice(tracker.stream(40), 2))
        dead_path = tracker.dead_path
    values = np.concatenate([block.values[0] for block in blocks])
    assert np.flatnonzero(np.isnan(values)).tolist() == list(range(30, 55))
    assert [block.invalid for block in blocks] == [{"beam broken": 10}, {"beam broken": 15}]
    assert dead_path == 1
    assert abs(np.nanmean(values[:30]) - np.nanmean(values[55:])) > 1e-6


def test_lost_points_are_nan_at_their_positions() -> None:
    with LeicaEmScon(ADDRESS + "&fault=drop&fault_at=3&fault_every=4", QUICK) as tracker:
        (block,) = islice(tracker.stream(20), 1)
    assert np.flatnonzero(np.isnan(block.values[0])).tolist() == [3, 7, 11, 15, 19]
    assert (block.dropped, block.invalid) == (5, {"lost": 5})


def test_after_a_stream_the_tracker_measures_single_points_again() -> None:
    with LeicaEmScon(ADDRESS, QUICK) as tracker:
        stream = tracker.stream(10)
        block = next(stream)
        with raises("stream.running"):
            tracker.measure()
        stream.close()
        after = tracker.read()
    assert after == pytest.approx(block.values.mean(), abs=3e-6)  # noise of 0.2 um


def test_the_clock_of_the_world_follows_the_reader_of_a_stream() -> None:
    with LeicaEmScon(ADDRESS, QUICK) as tracker:
        world = simulators.world("cframe", seed=3)
        list(islice(tracker.stream(50), 4))
        assert world.time == pytest.approx(2.0)


def test_a_stream_of_an_at4xx_is_refused() -> None:
    with (
        LeicaEmScon(ADDRESS + "&tracker=AT4xx", ABSOLUTE) as tracker,
        raises("tracker.stream.none"),
    ):
        next(tracker.stream())


def test_air_and_refraction_come_from_the_weather_station_or_as_given() -> None:
    air = Environment(21.5, 99_800.0, 40.0)
    station = ADDRESS + "&air_temperature=25&air_pressure=98000&air_humidity=30&noise=0&dead_path=0&angle_noise=0"
    manual = {"temperature": air.temperature, "pressure": air.pressure, "humidity": air.humidity, "timeout": 0.5}
    with LeicaEmScon(station, QUICK) as tracker:
        assert tracker.environment() == Environment(25.0, 98_000.0, 30.0)
        automatic = tracker.measure()
    with LeicaEmScon(station, EmSconSettings(meteo="manual", **manual)) as tracker:
        assert tracker.environment() == air
        given = tracker.measure()
    with LeicaEmScon(station, EmSconSettings(meteo="read", refraction_index=1.0, timeout=0.5)) as tracker:
        vacuum = tracker.measure()
    index = refraction_index(25.0, 98_000.0, 30.0)
    assert automatic.refraction_index == pytest.approx(index, abs=1e-12)
    # the optical path is the same, whatever the tracker divides it by
    paths = [each.distance * each.refraction_index for each in (automatic, given, vacuum)]
    np.testing.assert_allclose(paths, paths[0], rtol=1e-14)
    assert vacuum.refraction_index == 1.0
    assert given.environment == air


@pytest.mark.parametrize(
    ("air", "published"),
    # NIST, Engineering Metrology Toolbox, Edlen as modified by Birch and Downs, 633 nm
    [((20.0, 101_325.0, 0.0), 1.000271800), ((20.0, 101_325.0, 50.0), 1.000271374)],
)
def test_the_air_of_the_scene_refracts_as_published(air: tuple[float, float, float], published: float) -> None:
    assert refraction_index(*air) == pytest.approx(published, abs=1e-7)


def test_reflectors_are_chosen_by_name() -> None:
    with LeicaEmScon(ADDRESS, EmSconSettings(reflector="RRR 0.5in", timeout=0.5)) as tracker:
        known = tracker.reflectors()
        with raises("tracker.reflector.unknown"):
            tracker.set_reflector("big one")
    assert [(each.number, each.kind) for each in known] == [
        (1, "red ring 1.5 in"),
        (2, "red ring 0.5 in"),
        (3, "cat's eye"),
    ]
    assert known[0].surface_offset == 0.01905


def test_a_tracker_is_initialised_if_necessary() -> None:
    with LeicaEmScon(ADDRESS + "&initialised=0", QUICK) as tracker:
        assert tracker.measure().valid
        assert any(event.text == "initialisation changed" for event in tracker.events)
    never = EmSconSettings(initialise="never", timeout=0.5)
    with (
        LeicaEmScon(ADDRESS + "&initialised=0", never) as tracker,
        pytest.raises(InstrumentError, match="not initialised"),
    ):
        tracker.measure()


def test_a_request_to_a_busy_tracker_is_repeated() -> None:
    with LeicaEmScon(ADDRESS + "&fault=busy&fault_at=9&fault_for=2", QUICK) as tracker:
        assert tracker.measure().valid


def test_a_tracker_that_stays_busy_is_reported_as_busy() -> None:
    with pytest.raises(InstrumentError, match=r"status 1: the server is busy, for 0\.3 s"):
        LeicaEmScon(ADDRESS + "&fault=busy", QUICK).open()


@pytest.mark.parametrize("fault", ["refuse", "error"])
@pytest.mark.parametrize(
    ("code", "words"), [(10015, "does not answer its controller"), (3007, "an error of the tracker processor")]
)
def test_refusals_and_errors_are_reported_with_a_text(fault: str, code: int, words: str) -> None:
    with (
        LeicaEmScon(ADDRESS + f"&fault={fault}&fault_at=8&code={code}", QUICK) as tracker,
        pytest.raises(InstrumentError, match=f"status {code}.*{words}"),
    ):
        tracker.measure()


def test_after_silence_or_stray_bytes_the_connection_is_unusable() -> None:
    for fault, error in (("silence", InstrumentTimeoutError), ("garbage", ProtocolError)):
        with LeicaEmScon(ADDRESS + f"&fault={fault}&fault_at=8&fault_every=1000", QUICK) as tracker:
            with pytest.raises(error):
                tracker.environment()
            with pytest.raises(InstrumentError, match="open it again"):
                tracker.read()


def test_settings_refuse_what_does_not_go_together() -> None:
    with pytest.raises(ValueError, match="multiple of 1 ms"):
        EmSconSettings(rate=300.0)
    with pytest.raises(ValueError, match="meteo = read or manual"):
        EmSconSettings(refraction_index=1.00027)


@pytest.mark.parametrize("query", ["tracker=AT100", "station=1,2", "station=a,b,c", "lever=0"])
def test_addresses_of_no_tracker_are_refused(query: str) -> None:
    with raises("simulator.setting"):
        LeicaEmScon(f"sim://cframe/tracker?seed=3&{query}", QUICK).open()


def test_two_trackers_at_one_machine_measure_the_same_reflector() -> None:
    places = ["-1.2,-0.9,0.3", "1.5,-0.7,0.2"]
    found = []
    with (
        LeicaEmScon(f"sim://cframe/A?seed=3&noise=0&dead_path=0&angle_noise=0&station={places[0]}", QUICK) as one,
        LeicaEmScon(
            f"sim://cframe/B?seed=3&noise=0&dead_path=0&angle_noise=0&station={places[1]}&heading=0.7", QUICK
        ) as other,
    ):
        simulators.world("cframe", seed=3).move_to((0.05, 0.02, 0.1))
        for tracker, place, heading in ((one, places[0], 0.0), (other, places[1], 0.7)):
            x, y, z = tracker.measure().position
            turned = np.array([x * np.cos(heading) - y * np.sin(heading), x * np.sin(heading) + y * np.cos(heading), z])
            found.append(turned + np.array([float(word) for word in place.split(",")]))
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-14)


def test_deviations_between_set_ups_are_constant_within_one_set_up() -> None:
    with LeicaEmScon(ADDRESS + "&noise=0&repeatability=1e-5", QUICK) as tracker:
        world = simulators.world("cframe", seed=3)
        first, same = tracker.read(), tracker.read()
        world.move_to((0.1, 0.0, 0.0))
        tracker.read()
        world.move_to((0.0, 0.0, 0.0))
        back = tracker.read()
    assert first == same
    assert 0 < abs(back - first) < 1e-4
