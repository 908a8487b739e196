"""CANopen thermometers: values by PDO, of nodes of the package canopen and of the simulated node."""

import math
from pathlib import Path

import can
import pytest
from canopen_nodes import (
    F32,
    I32,
    ONE,
    TWO,
    U8,
    U32,
    a_device,
    a_node,
    await_state,
    count_reads,
    sending,
    sent,
    two_inputs,
)
from coded import raises

from errormotion.instruments.thermometer.can_temperature import CanSettings, CanTemperature
from errormotion.instruments.thermometer.cia404 import CELSIUS
from errormotion.testing import InstrumentConformance, InstrumentSubject

ADDRESS = "sim://cframe/can?seed=3&node=5"
QUICK = CanSettings(timeout=0.7, retry=0.05)


def test_pdos_of_a_timer_are_received() -> None:
    entries = two_inputs(status=False)
    sent(entries, 0, [0x61300120, 0x61300220], transmission=255, timer=20)
    settings = TWO.model_copy(update={"transfer": "pdo"})
    with (
        a_node(entries) as (address, local),
        sending(local, at_sync=False),
        CanTemperature(address, settings) as thermometer,
    ):
        asked = count_reads(local)
        assert thermometer.read() == {"air": 20.25, "bed": pytest.approx(26.85, abs=1e-4)}
        assert asked == []


def test_pdos_at_sync_are_requested_if_so_set() -> None:
    entries = two_inputs(second_status=1)
    sent(entries, 0, [0x61300120, 0x61500108], transmission=1)
    sent(entries, 1, [0x61500208, 0x61300220], transmission=3)
    settings = TWO.model_copy(update={"transfer": "pdo", "sync": True})
    with (
        a_node(entries) as (address, local),
        sending(local, at_sync=True) as syncs,
        CanTemperature(address, settings) as thermometer,
    ):
        asked = count_reads(local)
        for k in range(1, 4):
            entries[0x6130, 1] = (F32, 20.0 + k)
            assert thermometer.read()["air"] == 20.0 + k
            assert thermometer.flags == {"air": "", "bed": "faulty"}
            assert syncs[0] == 3 * k
        assert asked == []


def test_sync_of_another_participant_is_waited_for() -> None:
    entries = two_inputs(status=False)
    sent(entries, 0, [0x61300120, 0x61300220], transmission=1)
    settings = TWO.model_copy(update={"transfer": "pdo"})
    with a_node(entries) as (address, local), sending(local, at_sync=True) as syncs:
        master = can.Bus(interface="virtual", channel=address.split("/")[-1].split("?")[0], ignore_config=True)
        with CanTemperature(address, settings) as thermometer:
            with raises("instrument.no_answer"):
                thermometer.read()
            assert syncs[0] == 0
            task = master.send_periodic(can.Message(arbitration_id=0x80, is_extended_id=False), 0.02)
            assert thermometer.read()["air"] == 20.25
            task.stop()
        master.shutdown()


def test_values_without_a_pdo_are_read_by_sdo() -> None:
    entries = two_inputs(second_status=2)
    sent(entries, 0, [0x61300120], transmission=1)
    sent(entries, 1, [0x61300220], transmission=255)  # by event alone
    settings = TWO.model_copy(update={"transfer": "pdo", "sync": True})
    with (
        a_node(entries) as (address, local),
        sending(local, at_sync=True),
        CanTemperature(address, settings) as thermometer,
    ):
        asked = count_reads(local)
        assert thermometer.read()["air"] == 20.25
        assert thermometer.flags == {"air": "", "bed": "out of range"}
        assert asked == [(0x6150, 1), (0x6130, 2), (0x6150, 2)]


def test_a_value_of_32_bits_and_a_status_in_one_pdo() -> None:
    """As a probe with CANopen sends it: 4 bytes of 0x9130, a byte of 0x6150 without subindex."""
    entries = a_device() | {
        (0x9130, 1): (I32, 20310),
        (0x6131, 1): (U32, CELSIUS),
        (0x6132, 1): (U8, 3),
        (0x6150, 0): (U8, 0),
    }
    sent(entries, 0, [0x91300120, 0x61500008], transmission=1)
    settings = ONE.model_copy(update={"transfer": "pdo", "sync": True})
    with (
        a_node(entries) as (address, local),
        sending(local, at_sync=True),
        CanTemperature(address, settings) as thermometer,
    ):
        assert thermometer.read() == {"air": 20.31}
        entries[0x6150, 0] = (U8, 1)
        assert math.isnan(thermometer.read()["air"])
        assert thermometer.flags == {"air": "faulty"}


@pytest.mark.parametrize("how", ["none", "off", "event", "other"])
def test_a_node_that_sends_no_input_is_refused(how: str) -> None:
    entries = two_inputs()
    if how != "none":
        mapped = [0x20900020] if how == "other" else [0x61300120, 0x61300220]
        sent(entries, 0, mapped, transmission=255 if how == "event" else 1)
    if how == "off":
        entries[0x1800, 1] = (U32, 0x80000189)
    with (
        a_node(entries) as (address, _),
        raises("thermometer.inputs.not_sent"),
    ):
        CanTemperature(address, TWO.model_copy(update={"transfer": "pdo"})).open()


def test_a_short_pdo_is_an_error() -> None:
    entries = two_inputs(status=False)
    sent(entries, 0, [0x61300120, 0x61300220], transmission=1)
    with a_node(entries) as (address, local):
        local.network.subscribe(0x80, lambda *_: local.network.send_message(0x189, b"\x00\x00\xa2\x41\x00"))
        settings = TWO.model_copy(update={"transfer": "pdo", "sync": True})
        with (
            CanTemperature(address, settings) as thermometer,
            raises("protocol.can.pdo"),
        ):
            thermometer.read()


def test_a_recorded_session_with_pdos_plays_back(tmp_path: Path) -> None:
    path = tmp_path / "can.rec"
    settings = QUICK.model_copy(update={"transfer": "pdo"})
    with CanTemperature(f"{ADDRESS}&pdo=timer&event_timer=5&heartbeat=0.01", settings, record=path) as thermometer:
        readings = [thermometer.read() for _ in range(20)]
    assert len({str(reading) for reading in readings}) > 10  # the sensors have noise
    with CanTemperature(f"replay://{path}", settings) as thermometer:
        assert [thermometer.read() for _ in range(20)] == readings


@pytest.mark.parametrize("pdo", ["timer", "sync"])
def test_pdos_of_the_simulated_node_have_its_values(pdo: str) -> None:
    settings = QUICK.model_copy(update={"transfer": "pdo", "sync": pdo == "sync"})
    address = f"{ADDRESS}&noise=0&values=int32&digits=3&pdo={pdo}&open=1"
    with CanTemperature(address, settings) as by_pdo, CanTemperature(address, QUICK) as by_sdo:
        assert str(by_pdo.read()) == str(by_sdo.read())
        assert by_pdo.flags == by_sdo.flags
        assert by_pdo.flags["ambient"] == "faulty"


def test_pdos_need_a_node_that_is_operational() -> None:
    address = f"{ADDRESS}&pdo=timer&state=pre-operational&heartbeat=0.02"
    settings = QUICK.model_copy(update={"transfer": "pdo"})
    with CanTemperature(address, settings) as thermometer:
        await_state(thermometer, "PRE-OPERATIONAL")
        with raises("instrument.no_answer"):
            thermometer.read()
    with CanTemperature(address, settings.model_copy(update={"start": True})) as thermometer:
        assert all(math.isfinite(value) for value in thermometer.read().values())


class TestNodeThatSends(InstrumentConformance):
    """The conformance kit on values by PDO; a bus without a device."""

    subject = InstrumentSubject(
        CanTemperature,
        "sim://cframe/node?seed=3&open=0&shorted=1&pdo=timer&event_timer=10",
        settings={"timeout": 0.7, "transfer": "pdo"},
        name="node_that_sends",
        mutants=40,
        dead_address="can://virtual/nobody?node=5",
    )
