"""The simulated capaNCDT 6200 on its lines: dialogues of the manuals, refusals, and blocks."""

import struct
import time

import numpy as np
import pytest
from data_port_client import DataPortClient
from wire_vectors import Vector, vectors

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators import world
from errormotion.instruments.simulators.point_lds.capancdt import SimulatedCapaNCDT
from errormotion.instruments.transports import parse_address

FULL_SCALE = 0xFFFFFF
HEADER = struct.Struct("<4sIIQIHHI")


class Client(DataPortClient):
    def __init__(self, device: SimulatedCapaNCDT) -> None:
        super().__init__(device)
        self.greeting = self.line()

    def line(self) -> str:
        return self.text(b"\r\n")

    def ask(self, command: str) -> str:
        """Send a command without its dollar; return the text after its echo."""
        self.send(f"${command}\r")
        line = self.line()
        assert line.startswith(f"${command}")
        return line.removeprefix(f"${command}")

    def block(self) -> tuple[int, list[int], np.ndarray]:
        """Return counter, channels and frames of the next block."""
        if self.data is None:
            self.open_data()
        preamble, _, serial, field, status, width, count, counter = HEADER.unpack(self.exactly(HEADER.size))
        assert (preamble, serial, status) == (b"SAEM", self.device.serial, 0)
        channels = [channel + 1 for channel in range(32) if field >> 2 * channel & 3 == 1]
        assert width == 4 * len(channels)
        return counter, channels, np.frombuffer(self.exactly(width * count), "<i4").reshape(count, -1)


def simulated(parameters: str = "", name: str = "X1") -> Client:
    return Client(SimulatedCapaNCDT(parse_address(f"sim://cframe/{name}?seed=3{parameters}")))


# ---------------------------------------------------------------------- commands


@pytest.mark.parametrize("vector", vectors("capancdt", "command"), ids=str)
def test_commands_by_the_documents(vector: Vector) -> None:
    with simulated("&beams=X1,,Y1,Z") as client:
        client.send(vector.data.decode("latin-1"))
        echo = vector.data.decode("latin-1").rstrip("\r\n")
        assert client.line() == echo + vector.expected["answer"]


def test_a_mathematical_function_is_shown_in_the_status_of_its_channel() -> None:
    with simulated("&beams=X1,,Y1,Z") as client:
        assert client.ask("SMF3:+000000,+1.0,+0.0,+0.0,+0.0") == ",OK"
        assert client.ask("CHS") == "1,0,2,1OK"  # as in 6200 p. 63
        assert client.ask("GMF3") == ":+000000,+1.0,+0.0,+0.0,+0.0OK"
        assert client.ask("CMF3") == "OK"
        assert client.ask("CHS") == "1,0,1,1OK"


def test_a_new_connection_is_greeted() -> None:
    with simulated("&greeting=hello") as client:
        assert client.greeting == "hello"
        assert client.ask("STI?") == "256OK"


def test_every_character_is_echoed_before_the_command_is_ended() -> None:
    with simulated() as client:
        for character in "$VER":
            client.send(character)
            assert client.commands.recv(1) == character.encode()
        client.send("\r")
        assert client.line() == "DT6220;V1.2a;8010079OK"


def test_an_incomplete_command_times_out_and_is_discarded() -> None:
    with simulated("&time_limit=0.1") as client:
        client.send("$VE")
        assert client.line() == "$VE$TIMEOUT"
        assert client.ask("STI?") == "256OK"


@pytest.mark.parametrize("command", ["sti?", "ST", "STIx", "STI", "STI0", "STI-5", "LIN", "CHI5", "COI1", "", "AVN1"])
def test_invalid_grammar_is_refused(command: str) -> None:
    with simulated() as client:
        answer = client.ask(command)
        assert answer in ("$UNKNOWN COMMAND", "$WRONG PARAMETER")
        assert (answer == "$UNKNOWN COMMAND") == (command in ("sti?", "ST", ""))


def test_the_sample_time_is_the_nearest_one() -> None:
    with simulated() as client:
        for wanted, found in ((1200, 960), (1, 256), (400, 480), (999_999_999, 384000)):
            assert client.ask(f"STI{wanted}") == f",{found}OK"
            assert client.ask("STI?") == f"{found}OK"


def test_a_channel_states_its_sensor() -> None:
    with simulated("&beams=X1,Y1&ranges=500,2000&serial=77") as client:
        assert client.ask("CHI1") == ":ANO6610051,NAMCS0.5,SNO7701,OFS0,RNG500,UNT\u00b5m,DTY1OK"
        assert client.ask("CHI2") == ":ANO6610051,NAMCS2,SNO7702,OFS0,RNG2000,UNT\u00b5m,DTY1OK"
        assert client.ask("CHI3") == "$WRONG PARAMETER"
        assert client.ask("COI") == "ANO2303023,NAMDT6220,SNO77,OPT000,VERV1.2aOK"


def test_the_data_port_is_the_one_that_listens() -> None:
    with simulated() as client:
        assert client.ask("GDP") == f"{client.device.port}OK"
        assert client.device.urls["data"].endswith(f":{client.device.port}")


def test_a_password_is_requested_if_one_is_set() -> None:
    with simulated("&password=abc") as client:
        assert client.ask("LGI") == "$WRONG PASSWORD"
        assert client.ask("LGIabc") == "OK"
        assert client.ask("LGO") == "OK"


def test_settings_of_an_earlier_user_are_kept_and_wrong_ones_refused() -> None:
    with simulated("&left=TRG1;AVT3;AVN8;STI9600") as client:
        assert client.ask("STS") == "STI9600;AVT3;AVN8;CHS1,0,0,0;TRG1OK"
    with pytest.raises(InstrumentError, match=r"left=AVN9.*WRONG PARAMETER"):
        SimulatedCapaNCDT(parse_address("sim://cframe/X1?left=AVN9"))


@pytest.mark.parametrize("wrong", ["beams=,", "beams=X1,X2,Y1,Y2,Z", "ranges=1,2", "ranges=0", "ranges=x"])
def test_invalid_parameters_of_a_controller_are_refused(wrong: str) -> None:
    with pytest.raises(InstrumentError, match="invalid parameters of a controller"):
        SimulatedCapaNCDT(parse_address(f"sim://cframe/X1?{wrong}"))


# ---------------------------------------------------------------------- values


def test_values_are_those_of_the_virtual_machine() -> None:
    with simulated("&beams=X1,Y1,Z&left=STI960") as client:
        counter, channels, frames = client.block()
        rate = 1e6 / 960
        truth = world("cframe", 3).machine.distances(0, len(frames), rate, ["X1", "Y1", "Z"]).T
        following, _, _ = client.block()
    assert channels == [1, 2, 3]
    assert following == counter + len(frames)
    np.testing.assert_allclose(frames / FULL_SCALE * 2e-3, truth, rtol=0, atol=2e-3 / FULL_SCALE / 2 * 1.001)


def test_an_empty_field_has_no_value() -> None:
    with simulated("&beams=X1,,Z") as client:
        _, channels, frames = client.block()
    assert channels == [1, 3]
    assert frames.shape[1] == 2


def test_beyond_the_range_of_a_sensor_the_value_stays_at_its_end() -> None:
    with simulated("&ranges=500") as client:
        assert (client.block()[2] == FULL_SCALE).all()


def test_a_mathematical_function_replaces_its_channel_and_may_be_negative() -> None:
    with simulated("&beams=X1,Y1") as client:
        client.ask("SMF2:+000000,+0.0,-1.0,+0.0,+0.0")
        client.ask("SMF4:+1FFFFF,+0.0,+0.0,+0.0,+0.0")
        _, channels, frames = client.block()
    assert channels == [1, 2, 4]
    assert (frames[:, 1] < 0).all()
    assert (frames[:, 2] == 0x1FFFFF << 3).all()  # 21 bits are the measuring range


def test_in_the_trigger_modes_one_frame_is_sent_for_each_request() -> None:
    with simulated("&beams=X1,Y1&left=TRG1") as client:
        client.open_data()
        assert client.quiet()
        counters = []
        for _ in range(3):
            assert client.ask("GMD") == "OK"
            counter, _, frames = client.block()
            assert frames.shape == (1, 2)
            counters.append(counter)
        assert np.diff(counters).tolist() == [1, 1]
        assert client.quiet()
        client.ask("TRG0")
        assert len(client.block()[2]) > 1


def test_averages_smooth_and_the_arithmetic_one_thins_out() -> None:
    spreads = {}
    for kind in ("AVT0", "AVT1", "AVT2", "AVT3"):
        with simulated(f"&left={kind};AVN8;STI256&frames=4096") as client:
            frames = np.concatenate([client.block()[2] for _ in range(3)])
            spreads[kind] = float(np.diff(frames[:, 0].astype(float)).std())
    assert spreads["AVT1"] < spreads["AVT0"] / 4  # differences of a moving average of 8
    assert spreads["AVT2"] < spreads["AVT0"] / 2
    assert spreads["AVT3"] < spreads["AVT0"] / 2


def test_no_value_is_sent_between_echo_and_answer_and_settings_change_at_a_block() -> None:
    with simulated() as client:
        before = client.block()[0]
        assert client.ask("STI9600") == ",9600OK"
        after = client.block()[0]
    assert after > before


def test_a_second_client_of_the_data_port_follows_the_first() -> None:
    with simulated() as client:
        first = client.block()[0]
        assert client.data is not None
        client.data.close()
        client.data, client.rest = None, b""
        time.sleep(0.2)
        assert client.block()[0] > first


# ---------------------------------------------------------------------- faults


def test_missing_frames_show_in_the_counter() -> None:
    with simulated("&fault=drop&fault_at=100&fault_every=1000") as client:
        blocks = [client.block() for _ in range(3)]
    ends = [counter + len(frames) for counter, _, frames in blocks]
    assert len(blocks[0][2]) == 100
    assert blocks[1][0] == ends[0] + 1


def test_a_missing_target_is_the_end_of_the_range() -> None:
    with simulated("&fault=out_of_range&fault_at=10&fault_for=5") as client:
        values = client.block()[2][:, 0]
    assert np.flatnonzero(values == FULL_SCALE).tolist() == [10, 11, 12, 13, 14]


def test_silence_ends_values_and_answers() -> None:
    with simulated("&fault=silence&fault_at=50") as client:
        assert len(client.block()[2]) == 50
        assert client.quiet()
        client.commands.settimeout(0.2)
        client.send("$VER\r")
        with pytest.raises(TimeoutError):
            client.commands.recv(1)


def test_a_late_answer_precedes_the_next_one() -> None:
    with simulated("&fault=late&fault_at=0") as client:
        client.send("$VER\r")
        client.send("$GDP\r")
        assert client.line() == "$VER$GDPDT6220;V1.2a;8010079OK"
        assert client.line() == f"{client.device.port}OK"
