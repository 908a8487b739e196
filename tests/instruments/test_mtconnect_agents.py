"""The driver with other agents: published devices, agents with less information, another project's."""

import http.server
import math
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from urllib.parse import parse_qs, urlsplit
from xml.etree import ElementTree

import pytest
from armed import CONTROLLER
from wire_vectors import Vector, vectors

from errormotion.errors import InstrumentError
from errormotion.instruments.controller.mtconnect import MTConnect, MTConnectSettings
from errormotion.instruments.controller.virtual import VirtualController
from errormotion.instruments.transports.http.serving import HttpServer

HEADER = '<Header creationTime="2025-03-01T12:00:00Z" instanceId="17" version="2.0" sender="shop"'
TIME = 'timestamp="2025-03-01T12:00:00Z"'


class Agent:
    """A scripted agent; it answers with its observations from the requested number on."""

    def __init__(self, probe: bytes, *, numbers: bool = True) -> None:
        self.probe, self.numbers = probe, numbers
        self.observations: list[tuple[int, str]] = []
        self.asked: list[tuple[str, Mapping[str, str]]] = []
        self._server = HttpServer("agent", self._respond)
        self.url = self._server.url.replace("tcp://", "http://")

    def close(self) -> None:
        self._server.close()

    def _respond(self, path: str, query: Mapping[str, str]) -> Iterator[bytes]:
        self.asked.append((path, query))
        body = self.probe if path.endswith("probe") else self._streams(int(query.get("from", 0)))
        yield b"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-Length: %d\r\n\r\n%s" % (len(body), body)

    def _streams(self, first: int) -> bytes:
        held = [text for number, text in self.observations if number >= first]
        last = self.observations[-1][0]
        numbers = f' nextSequence="{last + 1}" firstSequence="1" lastSequence="{last}"' if self.numbers else ""
        return f"<MTConnectStreams>{HEADER}{numbers}/><Streams>{''.join(held)}</Streams></MTConnectStreams>".encode()


@contextmanager
def agent(probe: bytes, *, numbers: bool = True) -> Iterator[Agent]:
    made = Agent(probe, numbers=numbers)
    try:
        yield made
    finally:
        made.close()


def probe_of(items: str) -> bytes:
    return (
        f'<MTConnectDevices>{HEADER}/><Devices><Device id="d" name="M"><Components><Path id="p"><DataItems>{items}'
        "</DataItems></Path></Components></Device></Devices></MTConnectDevices>"
    ).encode()


FEED = '<DataItem category="SAMPLE" id="f" type="PATH_FEEDRATE" units="MILLIMETER/SECOND"/>'


def feed(number: int, value: str, item: str = "f") -> tuple[int, str]:
    return number, f'<PathFeedrate dataItemId="{item}" {TIME} sequence="{number}">{value}</PathFeedrate>'


def test_an_agent_that_states_no_next_number_does_not_repeat_observations() -> None:
    with agent(probe_of(FEED), numbers=False) as there, MTConnect(there.url) as driver:
        there.observations = [feed(1, "UNAVAILABLE"), feed(7, "10")]
        assert [each.value for each in driver.sample().observations] == ["UNAVAILABLE", "10"]
        there.observations.append(feed(8, "11"))
        assert [each.value for each in driver.sample().observations] == ["11"]
        assert there.asked[-1][1]["from"] == "8"
        assert driver.sample().observations == ()
        assert (driver.lost, driver.restarts) == (0, 0)


def test_the_last_value_of_a_named_time_series_counts() -> None:
    series = FEED.replace('id="f"', 'id="s" representation="TIME_SERIES"')
    with agent(probe_of(series + FEED)) as there:
        there.observations = [feed(1, "1 2 3", "s"), feed(2, "10")]
        with MTConnect(there.url) as driver:
            assert driver.state()["feed"] == pytest.approx(0.01)
        with MTConnect(there.url, MTConnectSettings(items={"feed": "s"})) as driver:
            assert driver.state()["feed"] == pytest.approx(0.003)


@pytest.mark.parametrize("vector", vectors("mtconnect", "probe"), ids=str)
def test_published_devices_open_and_are_read_with_default_settings(vector: Vector) -> None:
    with agent(vector.data) as there:
        chosen = vector.expected["items"]
        there.observations = [
            (1, f'<Position dataItemId="{chosen["position.X"]}" {TIME} sequence="1">-12.5</Position>'),
            (2, f'<Position dataItemId="{chosen.get("spindle_speed", "none")}" {TIME} sequence="2">6000</Position>'),
        ]
        with MTConnect(there.url) as driver:
            state = driver.state()
            assert sorted(driver.unclear) == vector.expected["unclear"]
    assert state["position"][0] == pytest.approx(-0.0125)
    if "spindle_speed" in chosen:
        assert state["spindle_speed"] == 6000.0
    else:
        assert math.isnan(state["spindle_speed"])
        assert "spindle_speed" in state["unavailable"]


# ---------------------------------------------------------------------- values that are no numbers, restarts


def machine_of(x: str) -> bytes:
    """Return the description of a machine whose X has the data item ``x``."""
    linear = "".join(
        f'<Linear id="a{axis}" name="{axis}"><DataItems><DataItem id="{key}" category="SAMPLE" type="POSITION" '
        'subType="ACTUAL" units="MILLIMETER"/></DataItems></Linear>'
        for axis, key in (("X", x), ("Y", "y"), ("Z", "z"))
    )
    rotary = (
        '<Rotary id="c" name="C"><DataItems><DataItem id="speed" category="SAMPLE" type="ROTARY_VELOCITY" '
        'subType="ACTUAL" units="REVOLUTION/MINUTE"/></DataItems></Rotary>'
    )
    return (
        f'<MTConnectDevices>{HEADER}/><Devices><Device id="d" name="M"><Components><Axes id="ax"><Components>{linear}'
        f"{rotary}</Components></Axes></Components></Device></Devices></MTConnectDevices>"
    ).encode()


def observed(*values: tuple[str, str], first: int = 1) -> list[tuple[int, str]]:
    return [
        (number, f'<Position dataItemId="{item}" {TIME} sequence="{number}">{value}</Position>')
        for number, (item, value) in enumerate(values, start=first)
    ]


@pytest.mark.parametrize("word", ["NaN", "1,5", "inf", "near", "1.234,5", "1 2"])
def test_a_value_that_is_no_number_is_unknown_and_the_others_are_known(word: str) -> None:
    with agent(machine_of("x")) as there:
        there.observations = observed(("x", word), ("y", "2"), ("z", "-3.5"), ("speed", "6000"))
        with MTConnect(there.url) as driver:
            state = driver.state()
    assert math.isnan(state["position"][0])
    assert state["position"][1:] == pytest.approx([0.002, -0.0035])
    assert state["spindle_speed"] == 6000.0
    assert "position" in state["unavailable"]
    assert list(state["reasons"]) == ["position.X"]
    assert word.split()[0] in state["reasons"]["position.X"]


def test_an_agent_that_begins_anew_with_the_same_instance_is_described_again() -> None:
    with agent(machine_of("x")) as there:
        there.observations = observed(("x", "1"), ("y", "2"), ("z", "3"), first=100)
        with MTConnect(there.url) as driver:
            assert driver.state()["position"][0] == pytest.approx(0.001)
            there.probe = machine_of("another")
            there.observations = observed(("another", "9"), ("y", "2"), ("z", "3"), first=1)
            assert driver.state()["position"][0] == pytest.approx(0.009)
            assert driver.restarts == 1
            assert driver.state()["position"][0] == pytest.approx(0.009)
            assert driver.restarts == 1


def test_an_agent_that_begins_anew_with_the_same_instance_does_not_stop_the_samples() -> None:
    with agent(machine_of("x")) as there:
        there.observations = observed(("x", "1"), ("y", "2"), ("z", "3"), first=100)
        with MTConnect(there.url) as driver:
            driver.sample()
            there.observations = observed(("x", "9"), ("y", "2"), first=1)
            found = driver.sample()
            assert found.restarted
            assert [each.value for each in found.observations] == ["9", "2"]


# ---------------------------------------------------------------------- the package mtconnect, version 0.3

PEER_ITEMS = {
    "X": [("xact", "POSITION", {"subType": "ACTUAL", "units": "MILLIMETER"})],
    "Y": [("yact", "POSITION", {"subType": "ACTUAL", "units": "MILLIMETER"})],
    "Z": [("zact", "POSITION", {"subType": "ACTUAL", "units": "MILLIMETER"})],
    "C": [("cspeed", "ROTARY_VELOCITY", {"subType": "ACTUAL", "units": "REVOLUTION/MINUTE"})],
}


def _peer_device(_: str) -> tuple[dict[str, object], ElementTree.ElementTree]:
    """Return a device of the package; its own reader calls `Element.getchildren`, which Python 3.9 has removed."""
    from mtconnect.device import MTComponent, MTDevice
    from mtconnect.xmlhelper import process_dataitem

    root = ElementTree.Element("Device", {"id": "d1", "name": "peer", "uuid": "000"})
    device = MTDevice("d1", "peer", root, "000", None)
    items = ElementTree.SubElement(root, "DataItems")
    ElementTree.SubElement(items, "DataItem", {"id": "avail", "type": "AVAILABILITY", "category": "EVENT"})
    process_dataitem(items, device, device)
    axes = ElementTree.SubElement(ElementTree.SubElement(root, "Components"), "Axes", {"id": "a", "name": "axes"})
    parts = ElementTree.SubElement(axes, "Components")
    for name, listed in PEER_ITEMS.items():
        kind = "Rotary" if name == "C" else "Linear"
        part = ElementTree.SubElement(parts, kind, {"id": f"i{name}", "name": name})
        component = MTComponent(f"i{name}", name, kind, part, device, device, None)
        device.add_sub_component(component)
        device.add_subcomponent(component)
        inside = ElementTree.SubElement(part, "DataItems")
        for item, data, attributes in listed:
            named = {"id": item, "type": data, "category": "SAMPLE", **attributes}
            ElementTree.SubElement(inside, "DataItem", named)
        process_dataitem(inside, device, component)
    return {"d1": device}, ElementTree.ElementTree(root)


@contextmanager
def peer(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[object, str]]:
    """Yield an agent of the package, and the address of a server of the standard library in front of it."""
    package = pytest.importorskip("mtconnect")
    monkeypatch.setattr("mtconnect.agent.read_devices", _peer_device)
    made = package.MTConnect()

    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            parts = urlsplit(self.path)
            query = {key: int(values[0]) for key, values in parse_qs(parts.query).items()}
            if parts.path == "/sample":
                answer = made.sample(start=query["from"] - 1, count=query["count"])  # its own start is exclusive
            else:
                answer = made.probe() if parts.path == "/probe" else made.current()
            body = answer.get_xml().encode()
            self.send_response(answer.get_status())
            self.send_header("Content-Type", "text/xml")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = False
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield made, f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.filterwarnings("ignore:datetime.datetime.utcnow:DeprecationWarning")
def test_an_agent_of_the_package_mtconnect_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    with peer(monkeypatch) as (there, url), MTConnect(url) as driver:
        assert driver.identify().model == "peer"
        state = driver.state()
        assert all(math.isnan(x) for x in [*state["position"], state["spindle_speed"]])
        assert not state["enabled"]
        for item, value in (("avail", "AVAILABLE"), ("xact", 12.5), ("yact", -3), ("zact", 0.001), ("cspeed", 6000)):
            there.push_data(item, value)
        state = driver.state()
        assert state["position"] == pytest.approx([0.0125, -0.003, 1e-6])
        assert state["spindle_speed"] == 6000.0
        assert state["enabled"]
        assert state["unavailable"] == [
            "commanded_position",
            "spindle_load",
            "feed",
            *("mode", "program", "execution", "estop"),
        ]


@pytest.mark.filterwarnings("ignore:datetime.datetime.utcnow:DeprecationWarning")
def test_observations_of_the_package_mtconnect_are_returned_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its header states no sequence numbers at all."""
    with peer(monkeypatch) as (there, url), MTConnect(url) as driver:
        first = driver.sample()
        assert {each.item for each in first.observations} == {"avail", "xact", "yact", "zact", "cspeed"}
        there.push_data("xact", 1.5)
        there.push_data("xact", 2.5)
        assert [(each.item, each.value) for each in driver.sample().observations] == [("xact", "1.5"), ("xact", "2.5")]
        there.push_data("yact", 3.5)
        assert [each.value for each in driver.sample().observations] == ["3.5"]


def test_a_device_that_the_address_does_not_name_is_refused() -> None:
    two = b"<Device id='a' name='A'/><Device id='b' name='B'/>"
    probe = b"<MTConnectDevices>%s/><Devices>%s</Devices></MTConnectDevices>" % (HEADER.encode(), two)
    with agent(probe) as there, pytest.raises(InstrumentError, match="the devices A, B; state one in the address"):
        MTConnect(there.url).open()


# ---------------------------------------------------------------------- styles of the simulated agent


@pytest.mark.parametrize("style", ["own", "okuma", "mazak", "vmc"])
@pytest.mark.parametrize("more", ["", "&series=1", "&next=0", "&offset=10,20,30"])
def test_machine_coordinates_are_read_at_agents_of_each_style(style: str, more: str) -> None:
    address = f"sim://cframe/mtconnect?seed=3&style={style}{more}"
    with MTConnect(address) as driver, VirtualController("sim://cframe/controller?seed=3", CONTROLLER) as control:
        control.move_to((0.1, 0.05, 0.2), 0.05)
        state, true = driver.state(), control.state()
        assert driver.sample().observations
        assert driver.sample().observations == ()
    assert state["position"] == pytest.approx(true["position"], abs=1e-6)
    assert "position" not in state["unavailable"]
    assert "feed" not in state["unavailable"]
    assert set(driver.unclear) <= {"spindle_speed"}
    assert ("spindle_speed" in state["unavailable"]) == bool(driver.unclear)
