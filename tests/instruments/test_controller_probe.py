"""Probing through a controller: contacts, false triggers, and no motion after an error."""

import math
import re
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from armed import CONTROLLER, PROBE
from coded import raises

from errormotion.datasets.calibrations.pretravel import PretravelMap, assemble, terms_up_to, unit
from errormotion.errors import DatasetError, InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.controller.virtual import VirtualController
from errormotion.instruments.simulators import world
from errormotion.instruments.touch_probe.controller_probe import ControllerProbe, ControllerProbeSettings
from errormotion.instruments.touch_probe.touching import Toucher
from errormotion.plugins import Contact, Touch

ADDRESS = "sim://cframe/controller?seed=3"
NORMALS = ((1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0), (0, 0, 1))


def touches(items: Sequence[int] = (0,), normals: Sequence[Sequence[float]] = NORMALS) -> list[Touch]:
    """Return touches of balls of the machine at their estimated positions."""
    machine = world("cframe", 3).machine
    reach = machine.balls.nominal_radius + machine.probe.nominal_tip_radius
    return [
        Touch(*(tuple(machine.balls.nominal[item] + (reach + way) * n) for way in (2e-3, -1e-3)), item)
        for item in items
        for n in unit(normals)
    ]


def gathered(probe: ControllerProbe, items: Sequence[int] = (0,)) -> tuple[list[Contact], InstrumentError | None]:
    """Return the contacts up to an error, and the error."""
    contacts = []
    try:
        for contact in probe.measure(touches(items)):
            contacts.append(contact)
    except InstrumentError as error:
        return contacts, error
    return contacts, None


def test_contacts_agree_with_the_twin() -> None:
    with ControllerProbe(ADDRESS, PROBE) as probe:
        machine = world("cframe", 3).machine
        orders = touches((0, 1))
        contacts = list(probe.measure(orders))
        for touch, contact in zip(orders, contacts, strict=True):
            true, _ = machine.contact(touch.start, touch.target, contact.time, noise=False)
            # two contacts, each with 0.25 um of scatter: five sigma of the mean
            assert np.linalg.norm(np.subtract(contact.position, true)) < 5 * 0.25e-6 / math.sqrt(2)
        assert all(contact.flag == "" for contact in contacts)
        assert all(a.time < b.time for a, b in pairwise(contacts))
        reading = probe.read()
    assert reading["contacts"] == 10
    assert reading["contact"] == list(contacts[-1].position)
    assert reading["position"][2] == pytest.approx(max(touch.start[2] for touch in orders) + 30e-3)  # it has risen


def test_more_repeats_scatter_less() -> None:
    spread = []
    for repeats in (1, 8):
        settings = ControllerProbeSettings(arm=True, repeats=repeats, agreement=5e-6)
        with ControllerProbe(ADDRESS, settings) as probe:
            order = touches(normals=[(0, 0, 1)]) * 12
            heights = [contact.position[2] for contact in probe.measure(order)]
        spread.append(np.std(heights))
    # 0.25 um, and 0.25 um / sqrt 8; a standard deviation of 12 values is known to 20 %
    assert spread[0] == pytest.approx(0.25e-6, rel=0.6)
    assert spread[1] < 0.6 * spread[0]


def test_the_probe_states_its_identity_and_type() -> None:
    settings = ControllerProbeSettings(arm=True, tip_radius=2e-3, noise=0.3e-6)
    with ControllerProbe(ADDRESS, settings) as probe:
        assert probe.identify().model == "cframe touch probe"
        assert (probe.tip_radius, probe.noise, probe.pretravel) == (2e-3, 0.3e-6, None)
    assert math.isnan(ControllerProbe(ADDRESS, PROBE).noise)


# ---------------------------------------------------------------------- pre-travel


def lobed(lobing: float, directions: Sequence[Sequence[float]] = NORMALS) -> PretravelMap:
    degrees, orders = terms_up_to(3)
    coefficients = np.where((degrees == 0), 8e-6, np.where((degrees == 3) & (orders == 3), lobing, 0.0))
    n = unit(directions)
    values = {"normal": n, "residual": np.zeros(len(n)), "left_out": np.zeros(len(n)), "reach": 0.1, "noise": 1e-7}
    return PretravelMap(
        assemble(
            {
                **values,
                "coefficient": coefficients,
                "coefficient_covariance": np.eye(len(degrees)) * 1e-14,
                "degree": degrees,
                "order": orders,
                "cross_validated": [1e-7],
                "highest": [3],
                "ball_radius": 12.5e-3,
                "tip_radius": 3e-3,
            },
            {"provenance": "{}"},
        )
    )


def test_a_map_of_another_probe_is_refused_unless_allowed(tmp_path: Path) -> None:
    made = lobed(1e-6)
    made.dataset.attrs["serial_number"] = "P1"
    path = str(made.save(tmp_path / "probe.nc"))
    with raises("calibration.sensor.other"):
        ControllerProbe(ADDRESS, ControllerProbeSettings(arm=True, pretravel=path, serial_number="P2")).open()
    for allowed in ({"serial_number": "P1"}, {"serial_number": "P2", "allow_other_sensor": True}, {}):
        assert ControllerProbeSettings(arm=True, pretravel=path, **allowed).pretravel_map() is not None


def test_a_map_without_a_serial_number_is_used_with_a_note(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = str(lobed(1e-6).save(tmp_path / "probe.nc"))
    ControllerProbeSettings(arm=True, pretravel=path, serial_number="P2").pretravel_map()
    assert "states no serial number" in caplog.text


def test_a_map_corrects_contacts_to_the_position_of_the_tip(tmp_path: Path) -> None:
    made = lobed(1e-6)
    path = made.save(tmp_path / "probe.nc")
    results = []
    for pretravel in ("", str(path)):
        with ControllerProbe(ADDRESS, ControllerProbeSettings(arm=True, pretravel=pretravel)) as probe:
            results.append(np.array([contact.position for contact in probe.measure(touches())]))
    value, _ = made.length(NORMALS)
    np.testing.assert_allclose(results[1] - results[0], value[:, None] * np.array(NORMALS), atol=1e-15)


def test_touches_beyond_the_map_are_refused_without_motion(tmp_path: Path) -> None:
    path = lobed(0.0, NORMALS[:4]).save(tmp_path / "probe.nc")
    with ControllerProbe(ADDRESS, ControllerProbeSettings(arm=True, pretravel=str(path))) as probe:
        with raises("touch.pre_travel.not_covered"):
            next(probe.measure(touches()))
        assert world("cframe", 3).time == 0.0


def test_a_missing_map_is_reported_on_opening() -> None:
    with pytest.raises(DatasetError, match=r"nowhere\.nc.*no such file"):
        ControllerProbe(ADDRESS, ControllerProbeSettings(arm=True, pretravel="nowhere.nc")).open()


# ---------------------------------------------------------------------- faults


@pytest.mark.parametrize(
    ("fault", "message", "error"),
    [
        ("alarm", "in alarm: servo alarm", InstrumentError),
        ("estop", "in emergency stop", InstrumentError),
        ("disconnect", "connection .* is lost", InstrumentError),
        ("silence", "expected an answer", InstrumentTimeoutError),
        ("garbage", "Expected an answer in JSON", ProtocolError),
    ],
)
def test_a_fault_in_the_middle_ends_the_cycle_and_keeps_the_contacts(
    fault: str, message: str, error: type[InstrumentError]
) -> None:
    settings = ControllerProbeSettings(arm=True, controller_settings={"timeout": 0.3})
    with ControllerProbe(f"{ADDRESS}&fault={fault}&fault_at=30", settings) as probe:
        here = world("cframe", 3)
        contacts, raised = gathered(probe)
        assert type(raised) is error
        assert re.search(rf"Touch 3 of 5 \(item 0\): .*{message}", str(raised))
        assert [contact.flag for contact in contacts] == ["", ""]
        rests = here.position()
        here.elapse(10.0)
        assert here.position() == rests  # no further motion


def test_nothing_starts_in_alarm_or_emergency_stop() -> None:
    with ControllerProbe(ADDRESS, PROBE) as probe, VirtualController(ADDRESS, CONTROLLER) as control:
        control.press_estop()
        with raises("machine.not_ready"):
            next(probe.measure(touches()))
        control.reset()
        world("cframe", 3).raise_alarm("oil low")
        with raises("machine.not_ready"):
            next(probe.measure(touches()))


def test_a_probe_that_never_trips_is_found_at_the_second_ball() -> None:
    with ControllerProbe(f"{ADDRESS}&fault=no_trip", PROBE) as probe:
        contacts, raised = gathered(probe, (0, 1, 2))
        assert [contact.flag for contact in contacts] == ["no trip", *["not made"] * 4, "no trip"]
        assert all(math.isnan(x) for contact in contacts for x in contact.position)
        assert "did not trip on items 0 and 1" in str(raised)
        rests = touches((1,))[0].start
        assert world("cframe", 3).position() == pytest.approx(rests, abs=1e-12)  # back at the start of its touch


def test_a_missing_ball_only_costs_its_own_touches() -> None:
    orders = [Touch(tuple(np.add(t.start, (0, 0, 0.1))), tuple(np.add(t.target, (0, 0, 0.1))), 0) for t in touches()]
    with ControllerProbe(ADDRESS, PROBE) as probe:
        contacts = list(probe.measure([*orders, *touches((1,))]))
    assert [contact.flag for contact in contacts] == ["no trip", *["not made"] * 4, *[""] * 5]


def test_a_stuck_probe_gives_its_flag_and_then_an_error() -> None:
    with ControllerProbe(f"{ADDRESS}&fault=tripped&fault_at=30", PROBE) as probe:
        contacts, raised = gathered(probe)
    assert [contact.flag for contact in contacts] == ["", "", "tripped at the start"]
    assert "Touch 3 of 5 (item 0): the probe is tripped before it moves, and remains so" in str(raised)


def test_the_driver_waits_for_a_probe_that_sticks_briefly() -> None:
    with ControllerProbe(f"{ADDRESS}&fault=tripped&fault_at=30&fault_for=1", PROBE) as probe:
        contacts, raised = gathered(probe)
    assert raised is None
    assert [contact.flag for contact in contacts] == [""] * 5


def test_an_obstacle_stops_the_machine() -> None:
    """Without clearance the straight path between two sides of the ball passes through it."""
    settings = ControllerProbeSettings(arm=True, clearance=0.0)
    with ControllerProbe(ADDRESS, settings) as probe:
        source = probe.measure([touches()[0], touches()[2]])
        assert next(source).flag == ""
        with raises("probe.path.not_free"):
            next(source)
        here = world("cframe", 3)
        assert here.machine.probe_gap(here.position(), here.time)[0] < 1e-6
        assert here.alarms == []


def test_a_turning_spindle_is_refused() -> None:
    with ControllerProbe(ADDRESS, PROBE) as probe, VirtualController(ADDRESS, CONTROLLER) as control:
        control.spindle(3000.0)
        with pytest.raises(InstrumentError, match="spindle turns at 3000"):
            next(probe.measure(touches()))


def test_a_cycle_that_the_caller_stops_leaves_the_probe_at_the_start_of_a_touch() -> None:
    with ControllerProbe(ADDRESS, PROBE) as probe:
        source = probe.measure(touches())
        next(source)
        source.close()
        assert world("cframe", 3).position() == pytest.approx(touches()[0].start, abs=1e-12)


def test_an_interrupted_cycle_stops_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    with ControllerProbe(ADDRESS, PROBE) as probe:
        source = probe.measure(touches())
        next(source)
        stopped = []

        def interrupted(target: Sequence[float], feed: float) -> dict[str, Any]:
            raise KeyboardInterrupt

        monkeypatch.setattr(probe.control, "probe", interrupted)
        monkeypatch.setattr(probe.control, "stop", lambda: stopped.append(True))
        with pytest.raises(KeyboardInterrupt):
            next(source)
    assert stopped == [True]


def test_controllers_that_cannot_probe_or_do_not_exist_are_refused() -> None:
    with raises("probe.controller.no_probing"):
        ControllerProbe("sim://cframe/x", ControllerProbeSettings(arm=True, controller="mtconnect")).open()
    with raises("plugin.unknown"):
        ControllerProbe(ADDRESS, ControllerProbeSettings(arm=True, controller="virtul_controller")).open()
    with pytest.raises(InstrumentError, match="colour"):
        ControllerProbe(ADDRESS, ControllerProbeSettings(arm=True, controller_settings={"colour": 1})).open()
    with raises("instrument.not_open"):
        ControllerProbe(ADDRESS, PROBE).read()


def test_a_recorded_cycle_plays_back(tmp_path: Path) -> None:
    path = tmp_path / "probe.rec"
    orders = touches()
    with ControllerProbe(ADDRESS, PROBE, record=path) as probe:
        contacts = list(probe.measure(orders))
    with ControllerProbe(f"replay://{path}", PROBE) as probe:
        assert list(probe.measure(orders)) == contacts


@pytest.mark.parametrize("off", [-0.4e-6, 0.4e-6])
def test_no_probing_move_is_shorter_than_controllers_accept(monkeypatch: pytest.MonkeyPatch, off: float) -> None:
    """A machine stops a fraction of a micrometre from its target; LinuxCNC's bridge refuses to probe such a short
    distance."""
    with ControllerProbe(ADDRESS, PROBE) as probe:
        control, moves = probe.control, []
        state, move = control.state, control.probe

        def beside() -> dict[str, Any]:
            found = dict(state())
            for name in ("position", "commanded_position"):
                found[name] = [x + off for x in found[name]]
            return found

        def noted(target: Sequence[float], feed: float) -> dict[str, Any]:
            moves.append(math.dist(target, beside()["commanded_position"]))
            return dict(move(target, feed))

        monkeypatch.setattr(control, "state", beside)
        monkeypatch.setattr(control, "probe", noted)
        list(probe.measure(touches()))
        list(probe.measure(touches()))  # from its raised position
    assert min(moves) > 1e-6


# ---------------------------------------------------------------------- one touch with controller faults


class Controller:
    """A controller whose probe trips at stated positions along X, m."""

    def __init__(self, trips: Callable[[int, float, float], float | None]) -> None:
        self.trips = trips
        self.place = np.zeros(3)
        self.probings = 0
        self.aside = 0.0

    def state(self) -> dict[str, Any]:
        return {"time": float(self.probings)}

    def move_to(self, position: Sequence[float], feed: float | None = None) -> None:
        self.place = np.array(position)

    def probe(self, target: Sequence[float], feed: float) -> dict[str, Any]:
        where = self.trips(self.probings, float(self.place[0]), float(target[0]))
        self.probings += 1
        self.place = np.array(target if where is None else [where, self.aside, 0.0])
        return {"tripped": where is not None, "position": self.place.tolist(), "time": float(self.probings)}

    def elapse(self, seconds: float) -> None: ...

    def stop(self) -> None: ...


SURFACE = 2e-3
WAY = Touch((0.0, 0.0, 0.0), (3e-3, 0.0, 0.0))


def surface(begin: float, target: float) -> float | None:
    return SURFACE if begin < SURFACE <= target else None


def touch(trips: Callable[[int, float, float], float | None], **settings: float) -> tuple[Contact, Controller]:
    control = Controller(trips)
    return Toucher(control, ControllerProbeSettings(arm=True, **settings).strategy).touch(WAY), control


def test_a_false_trip_on_the_way_is_not_taken_for_a_contact() -> None:
    contact, control = touch(lambda n, begin, target: 1e-3 if n == 0 else surface(begin, target))
    assert contact.position == pytest.approx((SURFACE, 0.0, 0.0), abs=1e-15)
    assert control.place.tolist() == [0.0, 0.0, 0.0]


def test_a_move_with_a_false_trip_at_the_start_is_repeated() -> None:
    contact, control = touch(lambda n, begin, target: 0.1e-3 if n == 0 else surface(begin, target))
    assert contact.flag == ""
    assert control.probings == 4
    with pytest.raises(InstrumentError, match=r"trips within 0\.2 mm of the start, where its path is free"):
        touch(lambda n, begin, target: 0.1e-3)


def test_false_trips_without_end_are_no_contact() -> None:
    contact, control = touch(lambda n, begin, target: 1e-3 if n % 2 == 0 else None)
    assert contact.flag == "no trip"
    assert math.isnan(contact.position[0])
    assert control.place.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(("difference", "flag"), [(2.9e-6, ""), (3.1e-6, "repeat differs")])
def test_repeats_must_agree(difference: float, flag: str) -> None:
    places = [SURFACE, SURFACE - difference, SURFACE]
    contact, _ = touch(lambda n, begin, target: places[n], agreement=3e-6)
    assert contact.flag == flag
    assert math.isnan(contact.position[0]) == bool(flag)
    if not flag:
        assert contact.position[0] == pytest.approx(SURFACE - difference / 2, abs=1e-15)
    assert contact.time == 2.5


def test_slow_contacts_far_before_the_fast_one_differ() -> None:
    contact, _ = touch(lambda n, begin, target: SURFACE if n == 0 else SURFACE - 0.2e-3, margin=0.1e-3)
    assert contact.flag == "repeat differs"


def test_a_position_off_the_path_is_an_error() -> None:
    control = Controller(lambda n, begin, target: surface(begin, target))
    control.aside = 0.2e-3
    with pytest.raises(InstrumentError, match=r"2\.000 mm along it and 0\.200 mm aside"):
        Toucher(control, ControllerProbeSettings(arm=True).strategy).touch(WAY)
    with raises("touch.target.same"):
        Toucher(control, ControllerProbeSettings(arm=True).strategy).touch(Touch((0, 0, 0), (0, 0, 0)))
