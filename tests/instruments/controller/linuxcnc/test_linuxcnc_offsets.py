"""The bridge's last check of an offset, and its statements, with a dictionary of pins."""

from typing import Any

import pytest
from coded import raises

from errormotion.errors import ProtocolError
from errormotion.instruments.controller.linuxcnc import codec
from errormotion.instruments.controller.linuxcnc.bridge import Offsets, RefusedError

UNIT = 1e-3  # m: the INI file is in mm
LIMIT, SLEW, WATCHDOG = 0.05, 0.001, 5.0  # mm, mm/s, s


class Pins:
    """HAL with the pins of compensation.tcl, external offsets, machine on."""

    def __init__(self) -> None:
        self.values: dict[str, Any] = {
            "errormotion-alive.out": False,
            "errormotion-alive.width": WATCHDOG,
            "errormotion-hold-2.in1": False,
            "errormotion-motion.out5": False,
            "errormotion-sign.in0": False,
            "errormotion-slew.in0": SLEW,
            "errormotion-thread.in": False,
            "errormotion-thread.out": False,
            "motion.debug-float-1": 0.0,
            "motion.eoffset-limited": False,
            "motion.is-all-homed": True,
            "motion.motion-enabled": True,
            "spindle.0.index-enable": False,
        }
        for each in "xyz":
            self.values |= {
                f"errormotion-counts-{each}.out": 0,
                f"errormotion-limit-{each}.max": LIMIT,
                f"errormotion-limit-{each}.out": 0.0,
                f"errormotion-source-{each}.in1": 0.0,
                f"axis.{each}.eoffset": 0.0,
                f"axis.{each}.eoffset-request": 0.0,
            }

    def get_value(self, name: str) -> Any:
        return self.values[name]

    def set_p(self, name: str, text: str) -> None:
        assert name in self.values
        self.values[name] = type(self.values[name])(float(text))

    def asked(self) -> list[float]:
        return [self.values[f"errormotion-source-{each}.in1"] for each in "xyz"]


@pytest.fixture
def pins() -> Pins:
    return Pins()


@pytest.mark.parametrize(
    "offset",
    [
        [float("nan"), 0.0, 0.0],
        [0.0, float("inf"), 0.0],
        [0.0, 0.0, 50.1e-6],
        [0.0, -1.0, 0.0],
        [6.1e-6, 0.0, 0.0],  # a jump: 5 s at 1 um/s
        [0.0, 0.0],
        [0.0, 0.0, 0.0, 0.0],
        [True, 0.0, 0.0],
        ["1e-6", 0.0, 0.0],
        [10**400, 0.0, 0.0],
        "000",
        None,
        {"X": 0.0},
    ],
)
def test_an_invalid_step_of_an_offset_is_refused_and_is_not_a_heartbeat(pins: Pins, offset: Any) -> None:
    before = dict(pins.values)
    with pytest.raises(RefusedError):
        Offsets(pins).set(offset, UNIT)
    assert pins.values == before


def test_an_offset_is_set_in_the_unit_of_the_ini_file_with_a_heartbeat(pins: Pins) -> None:
    Offsets(pins).set([1e-6, -2e-6, 0], UNIT)
    assert pins.asked() == pytest.approx([1e-3, -2e-3, 0.0])
    assert pins.values["errormotion-sign.in0"] is True


def test_two_heartbeats_within_one_servo_cycle_would_be_lost(pins: Pins) -> None:
    offsets = Offsets(pins)
    offsets.set([0, 0, 0], UNIT)
    offsets.set([1e-6, 0, 0], UNIT)
    assert pins.values["errormotion-sign.in0"] is True
    assert pins.asked()[0] == pytest.approx(1e-3)


@pytest.mark.parametrize(
    ("changed", "fault"),
    [
        ({"motion.motion-enabled": False}, "the machine is off or in e-stop"),
        ({"motion.is-all-homed": False}, "the machine is not homed"),
        ({"axis.y.eoffset-request": 0.0105}, "LinuxCNC has an external offset that differs by 10.5 um"),
    ],
)
def test_a_machine_that_accepts_no_offset_has_a_reason(pins: Pins, changed: dict[str, Any], fault: str) -> None:
    pins.values |= changed
    offsets = Offsets(pins)
    assert fault in offsets.state(UNIT)["fault"]
    with pytest.raises(RefusedError, match=fault):
        offsets.set([0, 0, 0], UNIT)


@pytest.mark.parametrize(
    ("changed", "busy"),
    [
        ({"errormotion-motion.out5": True}, "the machine probes"),
        ({"errormotion-thread.out": True}, "a thread is cut"),
        ({"errormotion-hold-2.in1": True}, "the program holds the offset"),
        ({"motion.eoffset-limited": True}, "LinuxCNC limits the offset at an end of travel"),
        ({"errormotion-limit-x.out": 0.02, "axis.x.eoffset-request": 0.02}, "LinuxCNC limits the offset"),
    ],
)
def test_a_held_offset_has_a_reason(pins: Pins, changed: dict[str, Any], busy: str) -> None:
    pins.values |= changed
    assert busy in Offsets(pins).state(UNIT)["busy"]


def test_an_offset_that_moves_while_it_is_read_is_neither_limited_nor_that_of_another_program() -> None:
    """A busy computer reads the pins tens of milliseconds apart; the servo thread continues."""

    class Moving(Pins):
        def get_value(self, name: str) -> Any:
            if name.startswith("axis.y") or name == "errormotion-limit-y.out":
                self.values[name] = self.time
            self.time += 0.0015  # mm
            return super().get_value(name)

        time = 0.0

    found = Offsets(Moving()).state(UNIT)
    assert (found["busy"], found["fault"]) == ("", "")


@pytest.mark.parametrize("pin", ["motion.debug-float-1", "spindle.0.index-enable"])
def test_the_axes_follow_the_spindle(pins: Pins, pin: str) -> None:
    offsets = Offsets(pins)
    assert not offsets.spindle_leads()
    pins.values[pin] = True
    assert offsets.spindle_leads()
    offsets.hold()
    assert pins.values["errormotion-thread.in"] is True


def test_without_the_realtime_part_nothing_is_set() -> None:
    class Empty:
        def get_value(self, name: str) -> Any:
            raise RuntimeError(name)

    offsets = Offsets(Empty())
    assert offsets.route == ""
    with pytest.raises(RefusedError, match=r"has not loaded compensation\.tcl"):
        offsets.set([0, 0, 0], UNIT)


def test_the_statements_of_the_bridge_are_read(pins: Pins) -> None:
    pins.values |= {"axis.z.eoffset": -0.003, "errormotion-limit-z.out": -0.003, "axis.z.eoffset-request": -0.003}
    found = codec.decode_offset({**Offsets(pins).state(UNIT), "by": None})
    assert found == codec.Offset("external", (0.0, 0.0, -3e-6), 50e-6, 1e-6, 5.0, "", "", "")


@pytest.mark.parametrize(
    "changed",
    [{"offset": [0, 0]}, {"offset": [0, 0, None]}, {"offset": 7}, {"limit": None}, {"slew": "1"}, {"watchdog": 1e999}],
)
def test_an_offset_that_is_not_known_is_no_offset(pins: Pins, changed: dict[str, Any]) -> None:
    with pytest.raises(ProtocolError, match="Expected the offset of LinuxCNC"):
        codec.decode_offset({**Offsets(pins).state(UNIT), "by": None, **changed})
    with pytest.raises(ProtocolError, match="Expected the offset of LinuxCNC"):
        codec.decode_offset(None)


def test_a_bridge_without_compensation_is_named() -> None:
    with raises("protocol.linuxcnc.version"):
        codec.decode_right({"protocol": 2, "control": False, "controlled_by": None})
