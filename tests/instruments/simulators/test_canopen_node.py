"""The simulated CANopen thermometer, read by the package canopen and with manually written frames."""

import math
import struct
import time
from contextlib import contextmanager

import can
import canopen
import pytest
from canopen.sdo.exceptions import SdoAbortedError

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.thermometer.canopen_node import SimulatedCanopen
from errormotion.instruments.transports.address import parse_address

NODE = 5
WAIT = 2.0  # s, for an expected frame
QUIET = 0.2  # s, without an unexpected frame
NOT_THERE = {"object": 0x06020000, "subindex": 0x06090011}


@contextmanager
def simulated(**params):
    text = "&".join(f"{key}={value}" for key, value in {"seed": 3, "node": NODE, **params}.items())
    device = SimulatedCanopen(parse_address(f"sim://cframe/can?{text}"))
    try:
        yield device
    finally:
        device.close()


@contextmanager
def network(**params):
    """Yield the device, a RemoteNode of canopen, and a list to which every frame on the bus is added."""
    with simulated(**params) as device:
        seen = []
        master = canopen.Network()
        master.NOTIFIER_CYCLE = 0.02
        master.bus = can.Bus(interface="virtual", channel=parse_address(device.url).path, ignore_config=True)
        master.connect()
        try:
            for first in (0x080, 0x180, 0x280, 0x380, 0x480, 0x700):
                master.subscribe(first + NODE, lambda i, data, t: seen.append((i, bytes(data))))
            node = master.add_node(NODE, canopen.ObjectDictionary())
            yield device, node, seen
        finally:
            master.disconnect()


@contextmanager
def raw(**params):
    """Yield a function that sends an SDO request and returns the answer of the node, None without one."""
    with simulated(heartbeat=0, **params) as device:
        bus = can.Bus(interface="virtual", channel=parse_address(device.url).path, ignore_config=True)

        def ask(request: str, *, wait: float = WAIT):
            bus.send(can.Message(arbitration_id=0x600 + NODE, data=bytes.fromhex(request), is_extended_id=False))
            message = bus.recv(wait)
            if message is None:
                return None
            assert message.arbitration_id == 0x580 + NODE
            return message.data.hex(" ")

        try:
            yield ask
        finally:
            bus.shutdown()


def number(node, index, subindex, kind):
    return struct.unpack("<" + kind, node.sdo.upload(index, subindex))[0]


def until(seen, wanted):
    end = time.monotonic() + WAIT
    while time.monotonic() < end:
        if found := [each for each in list(seen) if wanted(*each)]:
            return found
        time.sleep(0.005)
    return []


def aborted(action):
    with pytest.raises(SdoAbortedError) as caught:
        action()
    return caught.value.code


def test_identity_is_read_expedited_and_in_segments():
    with network() as (device, node, _):
        assert number(node, 0x1000, 0, "I") == 0x00020194  # profile 404, analogue inputs
        assert node.sdo.upload(0x1008, 0) == b"Virtual CiA 404 thermometer"  # 27 bytes: four segments
        assert node.sdo.upload(0x1009, 0) == b"1.0"  # 3 bytes: expedited
        assert node.sdo.upload(0x100A, 0) == b"1.02.3"
        assert number(node, 0x1018, 0, "B") == 4
        assert number(node, 0x1018, 4, "I") == device.world.seed


def test_values_units_digits_and_status_follow_the_machine():
    with network(values="float,int16,int32", digits=2, noise=0) as (device, node, _):
        truth = device.world.machine.temperatures([device.world.time])[0, 0]
        assert number(node, 0x6130, 0, "B") == 5
        assert number(node, 0x6130, 1, "f") == pytest.approx(truth, abs=0.05)
        assert number(node, 0x7130, 1, "h") == pytest.approx(100 * truth, abs=5)
        assert number(node, 0x9130, 1, "i") == pytest.approx(100 * truth, abs=5)
        assert number(node, 0x6131, 1, "I") == 0x002D0000
        assert number(node, 0x6132, 1, "B") == 2
        assert number(node, 0x6150, 1, "B") == 0


def test_digits_change_the_integers():
    with network(values="int32", noise=0) as (_, node, _):
        coarse = number(node, 0x9130, 1, "i")
        node.sdo.download(0x6132, 1, b"\x03")
        assert number(node, 0x9130, 1, "i") == pytest.approx(100 * coarse, abs=60)
        assert aborted(lambda: node.sdo.download(0x6132, 1, b"\x04")) == 0x06090030


@pytest.mark.parametrize(
    ("unit", "expected"), [("0x00050000", lambda c: c + 273.15), ("0x00AC0000", lambda c: 1.8 * c + 32)]
)
def test_the_unit_decides_the_value(unit, expected):
    with network(unit=unit, noise=0) as (device, node, _):
        truth = device.world.machine.temperatures([device.world.time])[0, 0]
        assert number(node, 0x6131, 1, "I") == int(unit, 16)
        assert number(node, 0x6130, 1, "f") == pytest.approx(expected(truth), abs=0.1)


def test_a_prefix_scales_the_value():
    with network(unit="0xFD2D0000", noise=0) as (device, node, _):  # 10^-3 degC
        truth = device.world.machine.temperatures([device.world.time])[0, 0]
        assert number(node, 0x6130, 1, "f") == pytest.approx(1000 * truth, abs=50)


@pytest.mark.parametrize(
    ("params", "index", "subindex", "code"),
    [
        ({"values": "int32"}, 0x6130, 1, NOT_THERE["object"]),
        ({"values": "int16"}, 0x9130, 0, NOT_THERE["object"]),
        ({"unit": "none"}, 0x6131, 1, NOT_THERE["object"]),
        ({"status": "none"}, 0x6150, 1, NOT_THERE["object"]),
        ({"status": "single"}, 0x6150, 1, NOT_THERE["subindex"]),
        ({"pdo": "none"}, 0x1800, 1, NOT_THERE["object"]),
        ({}, 0x6130, 6, NOT_THERE["subindex"]),
        ({}, 0x1008, 1, NOT_THERE["subindex"]),
        ({}, 0x1800, 4, NOT_THERE["subindex"]),
        ({}, 0x6125, 1, 0x06010001),  # the autozero is write-only
        ({"fault": "abort"}, 0x6130, 1, 0x08000024),
        ({"fault": "abort", "code": "0x08000000"}, 0x6150, 2, 0x08000000),
    ],
)
def test_missing_objects_of_a_node_are_refused_with_the_code(params, index, subindex, code):
    with network(**params) as (_, node, _):
        assert aborted(lambda: node.sdo.upload(index, subindex)) == code


@pytest.mark.parametrize(
    ("index", "subindex", "data", "code"),
    [
        (0x6130, 1, bytes(4), 0x06010002),
        (0x1000, 0, bytes(4), 0x06010002),
        (0x6131, 1, bytes(4), 0x06010002),
        (0x1017, 0, b"\x01", 0x06070013),
        (0x1017, 0, bytes(4), 0x06070012),
        (0x1017, 0, bytes(9), 0x06070012),
        (0x6125, 1, b"load", 0x08000020),
        (0x1003, 0, b"\x01", 0x06090030),
        (0x1800, 2, b"\xfc", 0x06090030),
        (0x1800, 3, b"\x01\x00", 0x08000022),
        (0x1A00, 0, b"\x00", 0x08000022),
        (0x5000, 0, bytes(1), 0x06020000),
        (0x6132, 9, bytes(1), 0x06090011),
    ],
)
def test_invalid_values_for_a_node_are_refused_with_the_code(index, subindex, data, code):
    with network() as (_, node, _):
        assert aborted(lambda: node.sdo.download(index, subindex, data)) == code
        assert number(node, 0x1001, 0, "B") == 0  # it still answers


def test_broken_inputs_state_it():
    with network(open="1", shorted="3") as (_, node, _):
        assert [number(node, 0x6150, k, "B") for k in range(1, 6)] == [0, 0x01, 0, 0x05, 0]
        assert number(node, 0x6130, 2, "f") == pytest.approx(853.498)
        assert number(node, 0x6130, 4, "f") == pytest.approx(-200.715)
        assert number(node, 0x1001, 0, "B") == 0x21  # generic, device profile
        assert number(node, 0x1003, 0, "B") == 1
        node.sdo.download(0x1003, 0, b"\x00")
        assert number(node, 0x1003, 0, "B") == 0
    with network(open="1", shorted="3", status="single") as (_, node, _):
        assert number(node, 0x6150, 0, "B") == 0x05
    with network(fault="out_of_range") as (_, node, _):
        assert number(node, 0x6150, 1, "B") == 0x03


def test_autozero_needs_its_signature():
    with network(noise=0) as (_, node, _):
        assert number(node, 0x6130, 1, "f") > 10.0
        node.sdo.download(0x6125, 1, b"zero")
        assert abs(number(node, 0x6130, 1, "f")) < 0.1
        assert number(node, 0x6130, 2, "f") > 10.0


def test_frames_of_a_segmented_upload():
    """As in Nanotec's N5 manual (p. 113): seven bytes per segment, then the toggle bit, 5 unused bits and the end."""
    with raw() as ask:
        assert ask("40 0a 10 00 00 00 00 00") == "41 0a 10 00 06 00 00 00"
        assert ask("60 00 00 00 00 00 00 00") == "03 31 2e 30 32 2e 33 00"
        assert ask("40 08 10 00 00 00 00 00") == "41 08 10 00 1b 00 00 00"
        assert ask("60 00 00 00 00 00 00 00") == "00 " + b"Virtual".hex(" ")
        assert ask("70 00 00 00 00 00 00 00") == "10 " + b" CiA 40".hex(" ")
        assert ask("60 00 00 00 00 00 00 00") == "00 " + b"4 therm".hex(" ")
        assert ask("70 00 00 00 00 00 00 00") == "13 " + b"ometer".hex(" ") + " 00"
        assert ask("60 00 00 00 00 00 00 00") == "80 08 10 00 01 00 04 05"  # nothing is left


def test_frames_of_expedited_transfers():
    with raw() as ask:
        assert ask("40 00 10 00 00 00 00 00") == "43 00 10 00 94 01 02 00"
        assert ask("40 01 10 00 00 00 00 00") == "4f 01 10 00 00 00 00 00"
        assert ask("40 17 10 00 00 00 00 00") == "4b 17 10 00 00 00 00 00"
        assert ask("40 09 10 00 00 00 00 00") == "47 09 10 00 31 2e 30 00"
        assert ask("2b 17 10 00 e8 03 00 00") == "60 17 10 00 00 00 00 00"
        assert ask("40 17 10 00 00 00 00 00") == "4b 17 10 00 e8 03 00 00"
        assert ask("22 17 10 00 00 00 00 00") == "60 17 10 00 00 00 00 00"  # size not stated


@pytest.mark.parametrize(
    ("first", "then", "answer"),
    [
        ("40 08 10 00 00 00 00 00", "70 00 00 00 00 00 00 00", "80 08 10 00 00 00 03 05"),  # toggle
        (None, "60 00 00 00 00 00 00 00", "80 00 00 00 01 00 04 05"),  # no transfer is running
        (None, "00 01 02 03 04 05 06 07", "80 00 00 00 01 00 04 05"),
        (None, "a0 08 10 00 7f 00 00 00", "80 08 10 00 01 00 04 05"),  # block transfer
        (None, "e0 08 10 00 00 00 00 00", "80 00 00 00 01 00 04 05"),
        ("21 17 10 00 02 00 00 00", "09 e8 03 00 00 00 00 00", "80 17 10 00 12 00 07 06"),  # 3 bytes, 2 announced
        ("20 17 10 00 00 00 00 00", "0d 01 00 00 00 00 00 00", "80 17 10 00 13 00 07 06"),  # 1 byte for UNSIGNED16
        (None, "21 17 10 00 00 00 01 00", "80 17 10 00 12 00 07 06"),  # 64 kB announced
    ],
)
def test_wrong_requests_are_aborted(first, then, answer):
    with raw() as ask:
        if first:
            assert ask(first)[:2] in ("41", "60")
        assert ask(then) == answer
        assert ask("40 01 10 00 00 00 00 00") == "4f 01 10 00 00 00 00 00"


def test_an_abort_of_the_client_and_a_short_frame_are_not_answered():
    with raw() as ask:
        assert ask("40 08 10 00 00 00 00 00").startswith("41")
        assert ask("80 08 10 00 00 00 04 05", wait=QUIET) is None
        assert ask("60 00 00 00 00 00 00 00") == "80 08 10 00 01 00 04 05"
        assert ask("40 00 10 00", wait=QUIET) is None


def test_boot_up_message_then_heartbeat_with_the_state():
    with network(state="pre-operational", heartbeat=0.02) as (_, node, seen):
        assert until(seen, lambda i, data: (i, data) == (0x700 + NODE, b"\x7f"))
        node.nmt.state = "RESET"
        assert until(seen, lambda i, data: (i, data) == (0x700 + NODE, b"\x00"))
        node.nmt.state = "OPERATIONAL"
        assert until(seen, lambda i, data: (i, data) == (0x700 + NODE, b"\x05"))
        node.nmt.state = "STOPPED"
        assert until(seen, lambda i, data: (i, data) == (0x700 + NODE, b"\x04"))
        node.sdo.RESPONSE_TIMEOUT, node.sdo.MAX_RETRIES = QUIET, 1
        with pytest.raises(canopen.SdoCommunicationError):
            node.sdo.upload(0x1000, 0)  # a stopped node has no SDO


def test_the_heartbeat_time_is_written():
    with network(heartbeat=0) as (_, node, seen):
        time.sleep(QUIET)
        assert not [each for each in seen if each[0] == 0x700 + NODE]
        node.sdo.download(0x1017, 0, (20).to_bytes(2, "little"))
        assert until(seen, lambda i, data: (i, data) == (0x700 + NODE, b"\x05"))


def pdos(seen):
    return [each for each in list(seen) if 0x180 < each[0] < 0x580]


def test_pdos_on_sync_only_in_operational():
    with network(state="pre-operational", pdo="sync", noise=0) as (_, node, seen):
        node.network.sync.transmit()
        time.sleep(QUIET)
        assert not pdos(seen)
        node.nmt.state = "OPERATIONAL"
        node.network.sync.transmit()
        assert until(seen, lambda i, data: i == 0x480 + NODE)
        frames = dict(pdos(seen))
        assert sorted(frames) == [0x180 + NODE, 0x280 + NODE, 0x380 + NODE, 0x480 + NODE]
        values = [*struct.unpack("<ff", frames[0x180 + NODE]), *struct.unpack("<ff", frames[0x280 + NODE])]
        values += struct.unpack("<f", frames[0x380 + NODE])
        assert values == pytest.approx([number(node, 0x6130, k, "f") for k in range(1, 6)], abs=0.05)
        assert frames[0x480 + NODE] == bytes(5)  # the status of each input


def test_the_mapping_is_read_from_the_node():
    with network(pdo="sync", values="int16") as (_, node, _):
        used = [number(node, 0x1A00 + k, 0, "B") for k in range(3)]
        assert used == [4, 1, 5]
        assert number(node, 0x1A00, 1, "I") == 0x71300110
        assert number(node, 0x1A02, 5, "I") == 0x61500508
        assert number(node, 0x1800, 1, "I") == 0x180 + NODE


def test_sync_counts():
    with network(pdo="sync", values="int32", sensors="frame", status="none") as (_, node, seen):
        node.sdo.download(0x1800, 2, b"\x03")
        for _ in range(7):
            node.network.sync.transmit()
            time.sleep(0.01)
        until(seen, lambda i, data: len(pdos(seen)) >= 2)
        assert len(pdos(seen)) == 2


def test_pdos_by_event_timer_and_by_remote_frame():
    with network(pdo="timer", event_timer=10, sensors="frame,ambient", status="single") as (_, node, seen):
        assert until(seen, lambda i, data: i == 0x280 + NODE and data == b"\0")
        first = len([each for each in pdos(seen) if each[0] == 0x180 + NODE])
        assert until(seen, lambda i, data: len([e for e in pdos(seen) if e[0] == 0x180 + NODE]) > first + 3)
    with network(pdo="event") as (_, node, seen):
        time.sleep(QUIET)
        assert not pdos(seen)
        node.network.send_message(0x180 + NODE, b"", remote=True)
        assert until(seen, lambda i, data: i == 0x180 + NODE and len(data) == 8)


def test_mapping_is_written_in_the_order_of_the_standard():
    with network(pdo="sync") as (_, node, seen):
        off, on = (0x80000180 + NODE).to_bytes(4, "little"), (0x180 + NODE).to_bytes(4, "little")
        value, state = (0x61300120).to_bytes(4, "little"), (0x61500108).to_bytes(4, "little")
        node.sdo.download(0x1800, 1, off)
        assert aborted(lambda: node.sdo.download(0x1A00, 1, value)) == 0x08000022  # sub-index 0 is not 0 yet
        node.sdo.download(0x1A00, 0, b"\0")
        assert aborted(lambda: node.sdo.download(0x1A00, 1, (0x61310120).to_bytes(4, "little"))) == 0x06040041
        assert aborted(lambda: node.sdo.download(0x1A00, 1, (0x61300110).to_bytes(4, "little"))) == 0x06040041
        assert aborted(lambda: node.sdo.download(0x1A00, 1, (0x70000120).to_bytes(4, "little"))) == 0x06020000
        for place, mapped in enumerate((state, value, value), 1):
            node.sdo.download(0x1A00, place, mapped)
        assert aborted(lambda: node.sdo.download(0x1A00, 0, b"\3")) == 0x06040042  # 72 bit
        node.sdo.download(0x1A00, 0, b"\2")
        node.network.sync.transmit()
        assert until(seen, lambda i, data: i == 0x280 + NODE)
        assert not [each for each in seen if each[0] == 0x180 + NODE]  # switched off
        node.sdo.download(0x1800, 1, on)
        node.network.sync.transmit()
        found = until(seen, lambda i, data: i == 0x180 + NODE)
        assert len(found[0][1]) == 5
        assert math.isfinite(struct.unpack("<Bf", found[0][1])[1])


def test_an_emergency_announces_a_broken_sensor():
    with network(open="0") as (_, node, seen):
        node.nmt.state = "RESET COMMUNICATION"
        assert until(seen, lambda i, data: (i, data) == (0x080 + NODE, bytes.fromhex("30 50 21 00 00 00 00 00")))


def test_a_node_boots_after_a_loss_of_power():
    with network(fault="unplugged", fault_at=1, unplugged_for=0.3, heartbeat=0.05) as (_, node, seen):
        node.sdo.RESPONSE_TIMEOUT, node.sdo.MAX_RETRIES = QUIET / 2, 1
        node.sdo.upload(0x1000, 0)
        with pytest.raises(canopen.SdoCommunicationError):
            node.sdo.upload(0x1000, 0)
        assert until(seen, lambda i, data: (i, data) == (0x700 + NODE, b"\0"))
        assert number(node, 0x1000, 0, "I") == 0x00020194


def test_a_late_answer_precedes_the_next_one() -> None:
    with raw(fault="late") as ask:
        assert ask("40 00 10 00 00 00 00 00", wait=QUIET) is None
        assert ask("40 01 10 00 00 00 00 00") == "43 00 10 00 94 01 02 00"  # of the previous request
    with raw(fault="late", late_by=0.1) as ask:
        assert ask("40 00 10 00 00 00 00 00") == "43 00 10 00 94 01 02 00"


@pytest.mark.parametrize("wrong", [{"values": "double"}, {"status": "some"}, {"unit": "degC"}, {"digits": 4}])
def test_unknown_variants_are_refused(wrong):
    with pytest.raises(InstrumentError, match=next(iter(wrong))), simulated(**wrong):
        pass


@pytest.mark.parametrize("delay", [{}, {"late_by": 0.15}])
def test_a_late_answer_is_sent_before_the_next_one_or_after_its_delay(delay):
    with raw(fault="late", fault_at=0, pdo="none", **delay) as ask:
        assert ask("40 00 10 00 00 00 00 00", wait=0.05) is None
        first = ask("40 18 10 00 00 00 00 00")
        second = ask("40 01 10 00 00 00 00 00")
    assert first.startswith("43 00 10 00")  # the device type, which was requested first
    assert second.startswith("4f 18 10 00")
