"""The simulated MTConnect agent on its line: answers and refusals."""

import http.client
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from urllib.parse import urlencode, urlsplit
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import pytest

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.controller.mtconnect import SimulatedAgent
from errormotion.instruments.simulators.controller.mtconnect.observations import Buffer
from errormotion.instruments.transports import parse_address

STYLES = ("own", "okuma", "mazak", "vmc")
TIMEOUT = 5.0


@dataclass
class Client:
    """Sends requests and keeps the device, whose world can be commanded."""

    agent: SimulatedAgent

    @property
    def place(self) -> tuple[str, int]:
        parts = urlsplit(self.agent.url)
        assert parts.hostname is not None
        assert parts.port is not None
        return parts.hostname, parts.port

    def get(self, target: str, /, **query: object) -> tuple[int, Element]:
        """Return status and document."""
        line = http.client.HTTPConnection(*self.place, timeout=TIMEOUT)
        try:
            names = {name.rstrip("_"): value for name, value in query.items()}
            line.request("GET", target + (f"?{urlencode(names)}" if names else ""))
            answer = line.getresponse()
            return answer.status, plain(ElementTree.fromstring(answer.read()))
        finally:
            line.close()

    def read(self, target: str, /, **query: object) -> Element:
        return self.get(target, **query)[1]

    def error(self, target: str, /, **query: object) -> tuple[int, str, str]:
        """Return status, code and text of a refused request."""
        status, document = self.get(target, **query)
        assert document.tag == "MTConnectError"
        (error,) = document.iterfind("Errors/")
        return status, error.attrib["errorCode"], error.findtext("ErrorMessage") or error.text or ""


def plain(document: Element) -> Element:
    """Remove the namespaces after a check of the root."""
    kind = document.tag.rpartition("}")[2]
    assert document.tag.startswith(f"{{urn:mtconnect.org:{kind}:")
    for each in document.iter():
        each.tag = each.tag.rpartition("}")[2]
    return document


def header(document: Element) -> dict[str, str]:
    found = document.find("Header")
    assert found is not None
    return found.attrib


def values(document: Element) -> dict[str, str]:
    """Return the text of the last observation of each data item; a condition's is its level."""
    seen = sorted(
        (each for each in document.iter() if "sequence" in each.attrib), key=lambda each: int(each.attrib["sequence"])
    )
    return {each.attrib["dataItemId"]: each.tag if "type" in each.attrib else (each.text or "") for each in seen}


def sequences(document: Element) -> list[int]:
    return sorted(int(each.attrib["sequence"]) for each in document.iter() if "sequence" in each.attrib)


@contextmanager
def agent(query: str = "") -> Iterator[Client]:
    device = SimulatedAgent(parse_address(f"sim://cframe/mtconnect?seed=3{'&' if query else ''}{query}"))
    try:
        yield Client(device)
    finally:
        device.close()


@pytest.mark.parametrize("style", STYLES)
def test_every_data_item_of_the_device_document_has_a_present_value(style: str) -> None:
    with agent(f"style={style}&series=1") as client:
        probe, current = client.read("/probe"), client.read("/current")
    items = {each.attrib["id"]: each for each in probe.iter("DataItem")}
    assert values(current).keys() == items.keys()
    assert not any("src" in each.attrib for each in items.values())
    identifiers = [each.attrib["id"] for each in probe.iter() if "id" in each.attrib]
    assert len(identifiers) == len(set(identifiers))
    for seen in current.iter():
        if "dataItemId" in seen.attrib:
            item = items[seen.attrib["dataItemId"]]
            assert seen.get("name") == item.get("name")
            assert seen.get("subType") == item.get("subType")


@pytest.mark.parametrize("style", STYLES)
def test_references_to_coordinate_systems_are_resolved_in_the_document(style: str) -> None:
    with agent(f"style={style}") as client:
        probe = client.read("/probe")
    systems = {each.attrib["id"]: each for each in probe.iter("CoordinateSystem")}
    named = {
        each.attrib["coordinateSystemIdRef"]
        for each in probe.iter("DataItem")
        if "coordinateSystemIdRef" in each.attrib
    }
    assert named <= systems.keys()
    assert bool(systems) == (style in ("okuma", "mazak"))
    assert all(each.get("parentIdRef") in (None, *systems) for each in systems.values())


@pytest.mark.parametrize(
    ("style", "machine", "work", "path"),
    [("okuma", "LX1actm", "LX1actw", "Lp1LPathPos"), ("mazak", "Xabs", "Xpos", "pathpos")],
)
def test_work_positions_differ_from_machine_positions_by_the_offset(
    style: str, machine: str, work: str, path: str
) -> None:
    with agent(f"style={style}&offset=100,-20,3.5") as client:
        client.agent.world.move_to([0.010, 0.0, 0.0], 0.05)
        client.agent.world.elapse(10.0)
        seen = values(client.read("/current"))
    assert float(seen[machine]) - float(seen[work]) == pytest.approx(100.0)
    assert float(seen[path].split()[0]) == float(seen[work])
    assert float(seen[path].split()[2]) == pytest.approx(-3.5)


def test_the_document_follows_the_schema_version() -> None:
    with agent("version=2.3") as client:
        probe = client.read("/probe")
        raw = ElementTree.tostring(probe)
    assert header(probe)["version"].startswith("2.3.")
    assert "deviceModelChangeTime" in header(probe)
    assert b"<Device" in raw
    with agent() as client:
        assert "deviceModelChangeTime" not in header(client.read("/probe"))


@pytest.mark.parametrize("version", ["1.4", "1.7", "2.0", "2.7"])
def test_the_header_of_assets_states_no_buffer_of_observations(version: str) -> None:
    with agent(f"version={version}") as client:
        assets, probe = (set(header(client.read(path))) for path in ("/assets", "/probe"))
    assert {"assetBufferSize", "assetCount"} <= assets
    assert "bufferSize" not in assets
    assert {"assetBufferSize", "assetCount", "bufferSize"} <= probe


@pytest.mark.parametrize("style", sorted(STYLES))
def test_the_parts_of_a_component_have_the_order_of_the_schema(style: str) -> None:
    order = ["Description", "Configuration", "DataItems", "Components", "Compositions", "References"]
    with agent(f"style={style}&series=1") as client:
        probe = client.read("/probe")
    devices = next(each for each in probe if each.tag == "Devices")
    assert [each.tag for each in devices] in (["Device"], ["Agent", "Device"])
    for each in devices.iter():
        parts = [part.tag for part in each if part.tag in order]
        assert parts == sorted(set(parts), key=order.index)


@pytest.mark.parametrize("query", ["style=haas", "version=1.2", "version=9", "multipart=x", "offset=1,2", "fault=sulk"])
def test_unknown_parameters_of_the_address_are_refused(query: str) -> None:
    with pytest.raises(InstrumentError), agent(query):
        pass


def test_a_data_item_is_unavailable_before_its_first_value() -> None:
    with agent() as client:
        items = len(list(client.read("/probe").iter("DataItem")))
        first = client.read("/sample", count=items)
    assert sequences(first) == list(range(1, items + 1))
    assert set(values(first).values()) == {"UNAVAILABLE", "Unavailable"}


def test_samples_continue_at_the_next_sequence() -> None:
    with agent() as client:
        current = client.read("/current")
        after = int(header(current)["nextSequence"])
        assert sequences(client.read("/sample", from_=after)) == []
        client.agent.world.spindle(3000.0)
        client.agent.world.elapse(5.0)
        changed = client.read("/sample", from_=after)
    assert values(changed)["Srpm"] != values(current)["Srpm"]
    assert sequences(changed) == list(range(after, int(header(changed)["nextSequence"])))
    assert int(header(changed)["lastSequence"]) == int(header(changed)["nextSequence"]) - 1


def test_count_limits_and_pages_join() -> None:
    with agent() as client:
        whole = sequences(client.read("/sample", count=1000))
        pages: list[int] = []
        begin = 1
        while len(pages) < len(whole):
            page = client.read("/sample", from_=begin, count=7)
            assert len(sequences(page)) <= 7
            pages += sequences(page)
            begin = int(header(page)["nextSequence"])
    assert pages == whole


def test_count_is_of_the_chosen_data_items() -> None:
    with agent() as client:
        page = client.read("/sample", path='//DataItem[@id="Xact"]', count=2)
    assert set(values(page)) == {"Xact"}
    assert len(sequences(page)) == 2


def test_a_negative_count_goes_backwards_where_the_schema_has_it() -> None:
    with agent("version=2.0") as client:
        assert sequences(client.read("/sample", count=-3)) == [
            *range(
                int(header(client.read("/current"))["nextSequence"]) - 3,
                int(header(client.read("/current"))["nextSequence"]),
            )
        ]
    with agent("version=1.3") as client:
        assert client.error("/sample", count=-3)[1] == "OUT_OF_RANGE"


def test_the_state_at_an_earlier_sequence_number() -> None:
    with agent() as client:
        before = int(header(client.read("/current"))["lastSequence"])
        client.agent.world.spindle(3000.0)
        client.agent.world.elapse(5.0)
        now = client.read("/current")
        then = client.read("/current", at=before)
        assert values(then)["Srpm"] == "0.0"
        assert values(now)["Srpm"] != "0.0"
        assert client.error("/current", at=header(now)["nextSequence"])[1] == "OUT_OF_RANGE"


def test_current_without_the_next_sequence() -> None:
    with agent("next=0") as client:
        assert "nextSequence" not in header(client.read("/current"))
        assert "nextSequence" in header(client.read("/sample"))


@pytest.mark.parametrize(
    ("path", "chosen"),
    [
        ("//Linear[@name='X']", {"Xact", "Xcom"}),
        ('//Axes//Linear[@name="X" or @name="Y"]/DataItems/DataItem[@subType="ACTUAL"]', {"Xact", "Yact"}),
        ("//DataItem[@category='CONDITION']", {"system"}),
        ("//Path", {"mode", "exec", "pgm", "feed"}),
        ("//Rotary//DataItem[@type='LOAD' and @units='PERCENT']|//DataItem[@id='avail']", {"Sload", "avail"}),
        ("//Devices/Device[@name='cframe']/DataItems", {"avail"}),
    ],
)
def test_paths_select_data_items(path: str, chosen: set[str]) -> None:
    with agent() as client:
        assert set(values(client.read("/current", path=path))) == chosen


@pytest.mark.parametrize(
    "path",
    [
        "//////Linear",
        "//Axes?//Linear",
        '//Device[@name="I_DON\'T_EXIST"',
        "//Linear[@name='Q']",
        "Linear",
        "//*[",
        "x" * 5000,
    ],
)
def test_paths_that_cannot_be_read_are_refused(path: str) -> None:
    with agent("version=2.0") as client:
        for what in ("/current", "/sample"):
            status, code, text = client.error(what, path=path)
            assert (status, code) == (400, "INVALID_XPATH")
            assert path in text


def test_devices_are_requested_by_name_or_uuid() -> None:
    with agent("style=okuma") as client:
        both = client.read("/probe").find("Devices")
        assert both is not None
        assert [each.tag for each in both] == ["Agent", "Device"]
        one = client.read("/errormotion-3/probe").find("Devices")
        assert one is not None
        assert [each.tag for each in one] == ["Device"]
        assert set(values(client.read("/Agent/current"))) == {"agent_avail"}
        assert client.error("/nobody/current")[:2] == (404, "NO_DEVICE")


@pytest.mark.parametrize(
    ("version", "path", "query", "expected"),
    [
        ("2.0", "/sample", {"count": "NON_INTEGER"}, (404, "INVALID_REQUEST")),
        ("2.6", "/sample", {"count": "NON_INTEGER"}, (400, "INVALID_PARAMETER_VALUE")),
        ("1.3", "/sample", {"count": "NON_INTEGER"}, (200, "OUT_OF_RANGE")),
        ("2.0", "/sample", {"from": "-1"}, (404, "INVALID_REQUEST")),
        ("2.0", "/sample", {"count": "0"}, (400, "OUT_OF_RANGE")),
        ("2.0", "/sample", {"count": "1025"}, (400, "OUT_OF_RANGE")),
        ("2.0", "/sample", {"count": "-1025"}, (400, "OUT_OF_RANGE")),
        ("2.0", "/sample", {"from": "0"}, (400, "OUT_OF_RANGE")),
        ("2.0", "/sample", {"from": "99999"}, (400, "OUT_OF_RANGE")),
        ("2.0", "/sample", {"from": "9", "to": "9"}, (400, "OUT_OF_RANGE")),
        ("2.0", "/sample", {"interval": "-1"}, (400, "OUT_OF_RANGE")),
        ("2.0", "/sample", {"interval": "10", "heartbeat": "0"}, (400, "OUT_OF_RANGE")),
        ("2.0", "/sample", {"interval": "10", "from": "99999"}, (400, "OUT_OF_RANGE")),
        ("2.0", "/current", {"interval": "10", "path": "//Q"}, (400, "INVALID_XPATH")),
        ("2.0", "/bad/path/", {}, (404, "INVALID_REQUEST")),
        ("2.0", "/Current", {}, (404, "INVALID_REQUEST")),
        ("2.0", "/cframe/current/blah", {}, (404, "INVALID_REQUEST")),
        ("2.0", "/asset/A.1", {}, (404, "ASSET_NOT_FOUND")),
        ("1.3", "/bad_path", {}, (200, "UNSUPPORTED")),
        ("1.3", "/nobody/probe", {}, (200, "NO_DEVICE")),
    ],
)
def test_refusals_of_an_agent(version: str, path: str, query: dict[str, str], expected: tuple[int, str]) -> None:
    with agent(f"version={version}") as client:
        names = {"from_" if name == "from" else name: value for name, value in query.items()}
        assert client.error(path, **names)[:2] == expected


def test_texts_of_range_errors_state_the_bounds() -> None:
    with agent("version=2.0&buffer=131") as client:
        assert client.error("/sample", count=0)[2] == "'count' must not be zero(0)"
        assert client.error("/sample", count=132)[2] == "'count' must be less than 132"
        assert client.error("/sample", from_=0)[2] == "'from' must be greater than 0"


def test_an_error_names_its_parameter_from_schema_2_6_on() -> None:
    with agent("version=2.7") as client:
        errors = client.read("/sample", count=0).find("Errors")
    assert errors is not None
    assert errors[0].tag == "OutOfRange"
    parameter = errors[0].find("QueryParameter")
    assert parameter is not None
    assert parameter.attrib["name"] == "count"


def test_a_request_that_is_no_get_ends_the_connection() -> None:
    with agent() as client, socket.create_connection(client.place, timeout=TIMEOUT) as line:
        line.sendall(b"PUT /cframe HTTP/1.1\r\nContent-Length: 0\r\n\r\n")
        assert line.recv(100) == b""


@pytest.mark.parametrize("when", ["", "&late_by=0.2"])
def test_a_late_answer_precedes_the_next_one(when: str) -> None:
    with (
        agent(f"fault=late&fault_at=1{when}") as client,
        socket.create_connection(client.place, timeout=TIMEOUT) as line,
    ):
        received = line.makefile("rb")
        for path in ("/current", "/probe", "/current"):
            line.sendall(f"GET {path} HTTP/1.1\r\n\r\n".encode())
        kinds = []
        for _ in range(3):
            head = list(iter(received.readline, b"\r\n"))
            (length,) = (int(each.split(b": ")[1]) for each in head if each.startswith(b"Content-Length"))
            kinds.append(plain(ElementTree.fromstring(received.read(length))).tag)
        received.close()
    assert kinds == ["MTConnectStreams", "MTConnectDevices", "MTConnectStreams"]


def test_several_values_in_one_observation() -> None:
    with agent("series=1") as client:
        current = client.read("/current")
    (series,) = (each for each in current.iter("PositionTimeSeries") if each.attrib["dataItemId"] == "Xseries")
    assert len((series.text or "").split()) == int(series.attrib["sampleCount"])
    assert float(series.attrib["sampleRate"]) == 100.0
    (table,) = current.iter("WorkOffsetsTable")
    assert table.attrib["count"] == "1"
    assert {cell.attrib["key"]: cell.text for cell in table.iter("Cell")} == {
        "X": "0.0000",
        "Y": "0.0000",
        "Z": "0.0000",
    }
    (variables,) = current.iter("VariableDataSet")
    assert [each.attrib["key"] for each in variables.iter("Entry")] == ["v100", "v101"]


def test_overrides_compete_with_values_of_the_same_type() -> None:
    with agent("style=vmc") as client:
        probe, current = client.read("/probe"), client.read("/current")
    feeds = {
        each.attrib["id"]: each.attrib["units"]
        for each in probe.iter("DataItem")
        if each.attrib["type"] == "PATH_FEEDRATE"
    }
    assert set(feeds.values()) == {"PERCENT", "MILLIMETER/SECOND"}
    assert {each.attrib["dataItemId"]: each.text for each in current.iter("PathFeedrate")} == {
        "Fovr": "100",
        "Frt": "0.0000",
    }


def test_an_alarm_is_a_fault_with_its_native_code() -> None:
    with agent("fault=alarm&fault_at=1") as client:
        assert values(client.read("/current"))["system"] == "Normal"
        (fault,) = client.read("/current").iter("Fault")
    assert fault.attrib["nativeCode"] == "1104"
    assert fault.text == "the machine is in alarm"


def test_a_machine_that_is_off_is_unavailable() -> None:
    with agent("fault=unavailable&fault_at=1") as client:
        assert values(client.read("/current"))["avail"] == "AVAILABLE"
        assert set(values(client.read("/current")).values()) == {"UNAVAILABLE", "Unavailable"}


def test_an_overrun_buffer_refuses_and_a_jump_does_not() -> None:
    with agent("version=2.0&buffer=64&fault=overrun&fault_at=1") as client:
        begin = int(header(client.read("/current"))["nextSequence"])
        assert client.error("/sample", from_=begin)[1] == "OUT_OF_RANGE"
        assert sequences(client.read("/sample"))[0] > begin
    with agent("buffer=64&fault=jump&fault_at=1") as client:
        begin = int(header(client.read("/current"))["nextSequence"])
        page = client.read("/sample", from_=begin)
        assert sequences(page)[0] == int(header(page)["firstSequence"]) > begin


def test_a_restarted_agent_has_a_new_instance_and_new_numbers() -> None:
    with agent("fault=restart&fault_at=1") as client:
        before = header(client.read("/current"))
        after = client.read("/sample")
    assert int(header(after)["instanceId"]) > int(before["instanceId"])
    assert sequences(after)[0] == 1


# ---------------------------------------------------------------------- streams


class Stream:
    """Reads the parts of a multipart stream in chunks, byte by byte as they are framed."""

    def __init__(self, place: tuple[str, int], target: str) -> None:
        self.line = socket.create_connection(place, timeout=TIMEOUT)
        self.line.sendall(f"GET {target} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
        self.file = self.line.makefile("rb")
        self.status = int(self.file.readline().split()[1])
        self.head = dict(line.decode().strip().split(": ", 1) for line in iter(self.file.readline, b"\r\n"))
        self.boundary = self.head.get("Content-Type", "").partition("boundary=")[2]

    def __enter__(self) -> "Stream":
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()
        self.line.close()

    def part(self) -> Element | None:
        """Return the next part; None at the end."""
        size = int(self.file.readline() or b"0", 16)
        chunk = self.file.read(size)
        assert self.file.readline() in (b"\r\n", b"")
        if not size:
            return None
        head, _, body = chunk.partition(b"\r\n\r\n")
        lines = head.decode().split("\r\n")
        assert lines[0] == f"--{self.boundary}"
        length = int(dict(line.split(": ") for line in lines[1:])["Content-Length"])
        assert body[length:] == b"\r\n"
        return plain(ElementTree.fromstring(body[:length]))


@pytest.mark.parametrize(("style", "kind"), [("own", "x-mixed-replace"), ("okuma", "mixed")])
def test_the_parts_of_a_stream_contain_new_observations(style: str, kind: str) -> None:
    with agent(f"style={style}") as client, Stream(client.place, "/sample?interval=10&count=1000") as stream:
        assert stream.head["Content-Type"].startswith(f"multipart/{kind};")
        assert stream.head["Transfer-Encoding"] == "chunked"
        first = stream.part()
        assert first is not None
        client.agent.world.spindle(3000.0)
        client.agent.world.elapse(5.0)
        second = stream.part()
        assert second is not None
        assert sequences(second)[0] == int(header(first)["nextSequence"])


def test_a_stream_without_changes_sends_heartbeats() -> None:
    with agent() as client:
        after = header(client.read("/current"))["nextSequence"]
        with Stream(client.place, f"/sample?interval=5&heartbeat=50&from={after}") as stream:
            for _ in range(3):
                part = stream.part()
                assert part is not None
                assert sequences(part) == []
                assert header(part)["nextSequence"] == after


def test_a_stream_of_the_present_state_repeats_it() -> None:
    with agent() as client, Stream(client.place, "/current?interval=10&path=//Linear") as stream:
        parts = [stream.part() for _ in range(3)]
    assert all(part is not None and len(values(part)) == 6 for part in parts)


def test_a_stream_ends_with_an_error_after_an_overrun() -> None:
    with (
        agent("version=2.0&buffer=64&fault=overrun&fault_at=3") as client,
        Stream(client.place, "/sample?interval=5&heartbeat=10") as stream,
    ):
        parts = list(iter(stream.part, None))
    assert [part.tag for part in parts] == ["MTConnectStreams"] * (len(parts) - 1) + ["MTConnectError"]


@pytest.mark.parametrize("fault", ["restart", "disconnect"])
def test_a_stream_is_cut_by_a_restart_and_by_a_broken_connection(fault: str) -> None:
    with (
        agent(f"fault={fault}&fault_at=3") as client,
        Stream(client.place, "/sample?interval=5&heartbeat=10") as stream,
    ):
        while stream.part() is not None:
            pass
        assert stream.file.read() == b""


# ---------------------------------------------------------------------- the ring


def test_the_ring_restores_every_state_that_it_keeps() -> None:
    ring = Buffer(5)
    for k in range(1, 21):
        ring.add("ab"[k % 2], "t", str(k))
        for sequence in range(ring.first, ring.next):
            state = {seen.item: seen.value for seen in ring.at(sequence).observations({"a", "b"})}
            assert state == {
                item: str(max(n for n in range(1, sequence + 1) if "ab"[n % 2] == item))
                for item in ("ab" if sequence > 1 else "b")
            }
    assert (ring.first, ring.next) == (16, 21)
