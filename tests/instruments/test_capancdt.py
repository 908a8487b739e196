"""The driver of the capaNCDT 6200, with a scripted controller."""

import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from coded import raises
from pydantic import ValidationError
from scripted_capancdt import ScriptedController, block

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.point_lds.capancdt import CapaNCDT, CapaSettings
from errormotion.instruments.spindle_frame.five_sensor_frame import FiveSensorFrame, FrameSettings

MIDDLE = 0x7FFFFF


@pytest.fixture
def controllers() -> Iterator[list[ScriptedController]]:
    started: list[ScriptedController] = []
    yield started
    for each in started:
        each.close()


@pytest.fixture
def controller(controllers: list[ScriptedController]) -> ScriptedController:
    controllers.append(ScriptedController())
    return controllers[0]


def sensor(controller: ScriptedController, **settings: Any) -> CapaNCDT:
    return CapaNCDT(controller.address, CapaSettings(**{"timeout": 1.5, **settings}))


def test_opening_queries_the_configuration_of_the_controller(controller: ScriptedController) -> None:
    with sensor(controller) as capa:
        assert capa.measuring_range == pytest.approx((0.0, 2e-3))
        assert capa.mid_range == pytest.approx(1e-3)
        assert capa.rate == pytest.approx(1000.0)
        identity = capa.identify()
    assert (identity.manufacturer, identity.model, identity.serial_number) == ("Micro-Epsilon", "DT6230", "1234")
    assert identity.firmware == "1.2a"
    assert identity.details["demodulator"] == "DL6230 0815"
    assert controller.received == ["TRG?", "TRG1", "CHS", "CHI1", "AVT?", "STI?", "COI", "LIN?", "TRG1"]


def test_the_trigger_mode_is_restored(controllers: list[ScriptedController]) -> None:
    controllers.append(ScriptedController(**{"TRG?": "0"}))
    with sensor(controllers[0]):
        pass
    assert controllers[0].received[1] == "TRG1"
    assert controllers[0].received[-1] == "TRG0"


def test_only_settings_that_are_given_are_written(controller: ScriptedController) -> None:
    settings = {"rate": 500.0, "averaging": "arithmetic", "averaging_number": 4}
    controller.answers |= {"STI2000": ",1920", "AVT?": "2", "AVN?": "4"}
    with sensor(controller, **settings) as capa:
        assert capa.rate == pytest.approx(1e6 / 1920 / 4)
    assert [command for command in controller.received if command[-1] != "?"][3:6] == ["AVT2", "AVN4", "STI2000"]


def test_a_channel_has_its_own_range(controller: ScriptedController) -> None:
    controller.readings = [block(1, (MIDDLE, MIDDLE))]
    with sensor(controller, channel=2, measuring_range=0.5e-3) as capa:
        assert capa.read() == pytest.approx(0.25e-3, abs=1e-9)


@pytest.mark.parametrize(
    ("answers", "settings", "message"),
    [
        ({}, {"channel": 3}, "expected a sensor at channel 3; found none"),
        ({"CHS": "1"}, {"channel": 2}, "found none"),
        ({"CHS": "2,1"}, {}, "mathematical function"),
        ({}, {"measuring_range": 0.2e-3}, "states 2 mm"),
        ({"CHI1": ":NAMx,RNG5,UNTinch"}, {}, "range in 'inch'"),
        ({"STI?": "fast"}, {}, "expected a number"),
        ({"TRG?": ""}, {}, "expected a number"),
    ],
)
def test_invalid_values_are_refused(
    controllers: list[ScriptedController], answers: dict[str, str], settings: dict[str, Any], message: str
) -> None:
    controllers.append(ScriptedController(**answers))
    with pytest.raises(InstrumentError, match=f"(?i){message}"), sensor(controllers[0], **settings):
        pass


def test_settings_that_no_controller_has_are_refused() -> None:
    for settings in (
        {"channel": 5},
        {"rate": 5000.0},
        {"averaging": "moving", "averaging_number": 9},
        {"averaging_number": 4},
        {"averaging": "none", "averaging_number": 4},
    ):
        with pytest.raises(ValidationError):
            CapaSettings.model_validate(settings)


def test_readings_are_requested_one_by_one(controller: ScriptedController) -> None:
    controller.readings = [block(n, (value, 0)) for n, value in enumerate((MIDDLE, 0, 0xFFFFFF, 1 << 24, 4194304))]
    with sensor(controller) as capa:
        found = [(capa.read(), capa.no_value) for _ in range(5)]
    values, reasons = zip(*found, strict=True)
    assert values[0] == pytest.approx(999.99994e-6, abs=1e-11)
    assert values[4] == pytest.approx(500.00003e-6, abs=1e-11)
    assert all(math.isnan(value) for value in values[1:4])
    assert reasons == ("", "under range", "over range", "unknown code", "")


def test_a_missing_value_is_a_timeout_and_a_late_one_is_not_taken_for_the_next(controller: ScriptedController) -> None:
    with sensor(controller) as capa:
        with pytest.raises(InstrumentTimeoutError):
            capa.read()
        controller.data.send(block(7, (1000, 0)))  # late
        controller.readings = [block(8, (MIDDLE, 0))]
        assert capa.read() == pytest.approx(1e-3, abs=1e-9)


def test_a_late_answer_shifts_no_later_reading(controller: ScriptedController) -> None:
    controller.readings = [block(n, (1000 * n, 0)) for n in range(1, 6)]
    with sensor(controller, timeout=0.3) as capa:
        assert capa.read() == pytest.approx(1000 / 0xFFFFFF * 2e-3)
        controller.late = {"GMD"}
        with pytest.raises(InstrumentTimeoutError):
            capa.read()
        readings = [capa.read() for _ in range(3)]
    assert readings == pytest.approx([n * 1000 / 0xFFFFFF * 2e-3 for n in (3, 4, 5)])


def test_a_stream_starts_and_ends_with_the_trigger_mode(controller: ScriptedController) -> None:
    controller.blocks = [block(10 * n, *[(MIDDLE + 10 * n + k, 5) for k in range(10)]) for n in range(5)]
    controller.readings = [block(99, (4194304, 0))]
    with sensor(controller) as capa:
        first, second = itertools.islice(capa.stream(block=15), 2)
        assert capa.read() == pytest.approx(0.5e-3, abs=1e-9)  # not a value from the previous stream
    assert (first.first, second.first, first.rate) == (0, 15, capa.rate)
    raws = np.concatenate([first.values, second.values], axis=1) / 2e-3 * 0xFFFFFF
    np.testing.assert_allclose(raws, MIDDLE + np.arange(30)[np.newaxis], atol=0.01)
    assert (first.dropped, dict(first.invalid)) == (0, {})
    started = controller.received.index("TRG0")
    assert controller.received[started + 1] == "TRG1"


def test_gaps_and_values_out_of_range_are_counted_with_their_reasons(controller: ScriptedController) -> None:
    controller.blocks = [block(1, (1, 0), (0, 0)), block(5, (0xFFFFFF, 0), (7, 0)), block(7, (8, 0)), block(8, (9, 0))]
    with sensor(controller) as capa:
        (found,) = itertools.islice(capa.stream(block=7), 1)
    assert found.dropped == 2
    assert dict(found.invalid) == {"under range": 1, "over range": 1}
    assert np.isnan(found.values[0]).tolist() == [False, True, True, True, True, False, False]


def test_a_silent_stream_and_a_wrong_channel_are_errors(controller: ScriptedController) -> None:
    with sensor(controller) as capa, pytest.raises(InstrumentTimeoutError):
        next(capa.stream())
    controller.blocks = [block(1, (1,)), block(2, (1,))]
    with sensor(controller, channel=2) as capa, pytest.raises(InstrumentError, match="sends the channels 1; expected"):
        next(capa.stream(block=1))


def test_answers_to_other_commands_are_skipped(controller: ScriptedController) -> None:
    controller.readings = [block(1, (MIDDLE, 0)), block(2, (MIDDLE, 0))]
    with sensor(controller) as capa:
        for other in (b"$STI?1000OK\r\n$TRG1OK\r\n", b"noise\r\n" * 40):
            controller.command.send(other)
            assert capa.read() == pytest.approx(1e-3, abs=1e-9)
    controller.answers["TRG?"] = "\r\nother" * 20
    controller.echo = False
    with pytest.raises(ProtocolError, match="16 other lines"), sensor(controller):
        pass


def test_a_refused_command_names_it(controllers: list[ScriptedController]) -> None:
    controllers.append(ScriptedController())
    del controllers[0].answers["CHS"]
    with pytest.raises(InstrumentError, match=r"refuses '\$CHS': unknown command"), sensor(controllers[0]):
        pass


def test_an_older_controller_reports_a_version_only(controller: ScriptedController) -> None:
    del controller.answers["COI"]
    controller.answers["VER"] = "DT6220;V1.0;8010074"
    with sensor(controller) as capa:
        identity = capa.identify()
    assert (identity.model, identity.serial_number, identity.firmware) == ("DT6220", "0815", "V1.0")


def test_two_simultaneous_uses_are_refused(controller: ScriptedController) -> None:
    controller.blocks = [block(n, (5, 5)) for n in range(50)]
    with sensor(controller) as capa:
        stream = capa.stream(block=5)
        next(stream)
        for use in (capa.read, lambda: capa.configure(CapaSettings()), lambda: next(capa.stream())):
            with raises("stream.running"):
                use()
        stream.close()


def test_five_of_them_make_a_frame(controllers: list[ScriptedController]) -> None:
    sensors = {}
    for number, name in enumerate(("X1", "X2", "Y1", "Y2", "Z")):
        controllers.append(ScriptedController())
        controllers[-1].always = block(1, (MIDDLE if number else 0, 5))
        sensors[name] = {"driver": "capancdt", "address": controllers[-1].address, "measuring_range": 2e-3}
    with FiveSensorFrame(settings=FrameSettings.model_validate({"rate": 50.0, "sensors": sensors})) as frame:
        (found,) = itertools.islice(frame.stream(block=10), 1)
        identity = frame.identify()
    known = np.isfinite(found.values[1:])
    np.testing.assert_allclose(found.values[1:][known], 1e-3, atol=1e-9)
    assert known.sum() >= 4
    assert np.isnan(found.values[0]).all()
    assert found.invalid["X1 under range"] + found.dropped == 10
    assert identity.manufacturer == "Micro-Epsilon"
