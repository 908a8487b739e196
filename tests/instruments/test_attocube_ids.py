"""The driver attocube_ids against the simulated device."""

import math

import numpy as np
import pytest
from coded import raises

from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.instruments import simulators
from errormotion.instruments.interferometer.attocube_ids import AttocubeIds, IdsSettings
from errormotion.instruments.simulators.interferometer.attocube_ids import SimulatedIds
from errormotion.instruments.transports import parse_address
from errormotion.testing import InstrumentConformance, InstrumentSubject

QUIET = "sim://cframe/ids?seed=3&noise=0&running=1"
ONE = IdsSettings(timeout=0.7)


class TestKit(InstrumentConformance):
    """Three beams and an angle; a port without a server."""

    subject = InstrumentSubject(
        AttocubeIds,
        "sim://cframe/ids?seed=3&running=1&lever2=0,0.05,0&beam2=1,0,0",
        settings={"timeout": 0.7, "axes": (1, 2, 3), "angles": {"yaw": {"plus": 2, "minus": 1, "base": 0.05}}},
        vary=simulators.in_steps(seed=3),
        dead_address="tcp://127.0.0.1:9",
        mutants=60,
    )


def moved(instrument: AttocubeIds, *place: float) -> dict[str, float]:
    simulators.world("cframe", 3).move_to(place)
    return instrument.read()


def test_displacements_are_those_of_the_virtual_machine_since_zero() -> None:
    with AttocubeIds(QUIET, ONE.model_copy(update={"axes": (1, 2)})) as ids:
        moved(ids, 0.1, 0.05, 0.0)
        ids.zero()
        assert ids.read() == pytest.approx({"axis1": 0.0, "axis2": 0.0}, abs=1e-12)
        found = moved(ids, 0.15, 0.03, 0.0)
    machine = simulators.world("cframe", 3).machine
    true = np.array([(0.05, -0.02)]) + np.diff(machine.geometry.twist([(0.1, 0.05, 0), (0.15, 0.03, 0)])[:, :2], axis=0)
    assert [found["axis1"], found["axis2"]] == pytest.approx(true[0], abs=1e-12)  # whole picometres
    assert ids.channels == {"axis1": "m", "axis2": "m"}


def test_two_parallel_beams_give_an_angle() -> None:
    settings = IdsSettings(axes=(1, 2), angles={"yaw": {"plus": 1, "minus": 2, "base": 0.1}}, timeout=0.7)
    with AttocubeIds(f"{QUIET}&beam2=1,0,0&lever1=0,-0.05,0&lever2=0,0.05,0", settings) as ids:
        moved(ids, 0.0, 0.0, 0.0)
        ids.zero()
        found = moved(ids, 0.2, 0.0, 0.0)
    rotation = np.diff(simulators.world("cframe", 3).machine.geometry.twist([(0, 0, 0), (0.2, 0, 0)])[:, 5])[0]
    assert abs(rotation) > 1e-6
    assert found["yaw"] == pytest.approx(rotation, abs=2e-11)  # a picometre over the base
    assert ids.channels["yaw"] == "rad"


def test_an_idle_device_is_started_and_an_aligned_one_is_unchanged() -> None:
    with AttocubeIds("sim://cframe/ids?seed=3&init=0.05", ONE) as ids:
        assert math.isfinite(ids.read()["axis1"])
    with raises("interferometer.not_measuring"):
        AttocubeIds("sim://cframe/ids?seed=3", ONE.model_copy(update={"start": False})).open()
    with raises("interferometer.mode.other"):
        AttocubeIds("sim://cframe/ids?seed=3&aligning=1", ONE).open()
    with raises("interferometer.not_started"):
        AttocubeIds("sim://cframe/ids?seed=3&contrast=50", ONE).open()
    with raises("instrument.no_answer"):
        AttocubeIds("sim://cframe/ids?seed=3&init=9", ONE.model_copy(update={"start_timeout": 0.2})).open()


@pytest.mark.parametrize("functions", ["ids", "sen", "ids,sen"])
def test_either_family_of_functions_is_used(functions: str) -> None:
    settings = IdsSettings(axes=(1, 2), averaging=1e-6, timeout=0.7, after_break="clear")
    with AttocubeIds(f"sim://cframe/ids?seed=3&noise=0&functions={functions}", settings) as ids:
        assert ids.identify().model == "IDS3010"
        assert ids.identify().details["average_parameter"] == 4.0
        ids.zero()
        assert ids.read() == pytest.approx({"axis1": 0.0, "axis2": 0.0}, abs=1e-12)
        assert ids.refraction() > 1.0
    with AttocubeIds(f"{QUIET}&functions={functions}&fault=beam_broken&broken=2&fault_at=1", settings) as ids:
        ids.read()
        found = ids.read()
        assert math.isfinite(found["axis1"])
        assert math.isnan(found["axis2"])
        assert "interrupted" in ids.flags["axis2"]


def test_a_device_that_knows_neither_family_is_named_with_both() -> None:
    class Other(SimulatedIds):
        def _function(self, method: str) -> None:
            return None

    device = Other(parse_address("sim://cframe/ids?seed=3"))
    try:
        with pytest.raises(InstrumentError, match=r"'com.attocube.ids.system.getDeviceType': .*'com.attocube.sen.sy"):
            AttocubeIds(device.url, ONE).open()
    finally:
        device.close()


def test_replies_to_other_requests_are_named_where_none_came_to_this_one() -> None:
    class Stray(SimulatedIds):
        def answer(self, request: bytes) -> bytes:
            return super().answer(request).replace(b'"id":', b'"id":9')

    device = Stray(parse_address("sim://cframe/ids?seed=3"))
    try:
        with pytest.raises(InstrumentTimeoutError, match=r"1 answer to other requests was discarded"):
            AttocubeIds(device.url, ONE).open()
    finally:
        device.close()


def test_another_pass_mode_is_refused() -> None:
    with AttocubeIds(f"{QUIET}&passes=2", ONE.model_copy(update={"passes": "dual"})) as ids:
        assert ids.identify().details["passes"] == "dual"
    with raises("interferometer.passes.differ"):
        AttocubeIds(f"{QUIET}&passes=2", ONE.model_copy(update={"passes": "single"})).open()


@pytest.mark.parametrize("after_break", ["restart", "clear"])
def test_a_broken_beam_has_no_value_until_the_next_zero(after_break: str) -> None:
    settings = IdsSettings(axes=(1, 2), after_break=after_break, timeout=0.7)
    # axis 1 is broken during the third reading of the beams
    with AttocubeIds(f"{QUIET}&fault=beam_broken&fault_at=2&fault_for=1&broken=1", settings) as ids:
        moved(ids, 0.0, 0.0, 0.0)
        ids.zero()
        assert math.isnan(moved(ids, 0.01, 0.01, 0.0)["axis1"])
        again = moved(ids, 0.02, 0.02, 0.0)
        assert math.isnan(again["axis1"])
        assert again["axis2"] == pytest.approx(0.02, abs=5e-5)
        assert "interrupted" in ids.flags["axis1"]
        assert ids.flags["axis2"] == ""
        ids.zero()
        found = moved(ids, 0.03, 0.03, 0.0)
        assert found == pytest.approx({"axis1": 0.01, "axis2": 0.01}, abs=5e-5)
        assert set(ids.flags.values()) == {""}


def test_no_zero_while_a_beam_is_broken() -> None:
    with (
        AttocubeIds(f"{QUIET}&fault=beam_broken", ONE.model_copy(update={"after_break": "clear"})) as ids,
        raises("interferometer.beam.broken"),
    ):
        ids.zero()


def test_a_broken_beam_that_is_not_used_has_no_effect() -> None:
    with AttocubeIds(f"{QUIET}&fault=beam_broken&broken=3", ONE) as ids:
        assert math.isfinite(ids.read()["axis1"])


def test_the_air_of_the_environmental_unit() -> None:
    with AttocubeIds(f"{QUIET}&air_temperature=21.5&air_pressure=98000&air_humidity=35", ONE) as ids:
        found = ids.environment()
        assert (found.temperature, found.pressure, found.humidity) == pytest.approx((21.5, 98000.0, 35.0))
        assert ids.refraction() == pytest.approx(1.00026, abs=1e-5)
    with AttocubeIds(f"{QUIET}&ecu=0", ONE) as ids:
        assert math.isnan(ids.environment().temperature)
        assert ids.identify().details["air_compensation"] is False


def test_the_averaging_time_is_the_longest_within_the_stated_one() -> None:
    assert IdsSettings(averaging=40e-9).average_parameter == 0
    assert IdsSettings(averaging=1e-3).average_parameter == 14  # 0.66 ms; 15: 1.31 ms
    with AttocubeIds(QUIET, ONE.model_copy(update={"averaging": 1e-3})) as ids:
        assert ids.identify().details["average_parameter"] == 14


def test_an_interface_without_error_numbers_is_named() -> None:
    with raises("protocol.reply.number_form"):
        AttocubeIds(f"{QUIET}&api=1", ONE).open()


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"axes": (0,)}, "from 1 to 3"),
        ({"axes": (1, 1)}, "each once"),
        ({"axes": (1,), "angles": {"yaw": {"plus": 1, "minus": 2, "base": 0.1}}}, "expected two of the axes 1"),
        (
            {"axes": (1, 2), "angles": {"axis1": {"plus": 1, "minus": 2, "base": 0.1}}},
            "another name than that of an axis",
        ),
    ],
)
def test_settings_that_do_not_fit_are_refused(wrong: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        IdsSettings(**wrong)
