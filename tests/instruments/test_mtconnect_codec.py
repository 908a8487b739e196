"""XML of MTConnect agents: all versions, hostile documents, and the assignment of data items."""

import math
import re
import tracemalloc

import pytest
from coded import raises
from hypothesis import given
from hypothesis import strategies as st
from wire_vectors import Vector, vectors

from errormotion.errors import ProtocolError
from errormotion.instruments.controller.mtconnect import xml
from errormotion.instruments.controller.mtconnect.choice import Choice, choose
from errormotion.instruments.controller.mtconnect.codec import DataItem, Device, Observation, parse, parse_time
from errormotion.instruments.controller.mtconnect.settings import MTConnectSettings

HEADER = '<Header creationTime="2025-03-01T12:00:00Z" instanceId="17" version="2.0.0.1" sender="shop"'
DEVICES = f"""<?xml version="1.0" encoding="UTF-8"?>
<m:MTConnectDevices xmlns:m="urn:mtconnect.org:MTConnectDevices:2.0" xmlns="urn:mtconnect.org:MTConnectDevices:2.0">
{HEADER}/>
<Devices>
 <Agent id="agent" name="Agent"><DataItems><DataItem category="EVENT" id="av" type="AVAILABILITY"/></DataItems></Agent>
 <Device id="d" name="VMC" uuid="000">
  <Description manufacturer="Maker" model="V5" serialNumber="123">A mill</Description>
  <DataItems><DataItem category="EVENT" id="avail" type="AVAILABILITY"/></DataItems>
  <Components>
   <Axes id="a" name="base"><Components>
    <Linear id="x" name="X1" nativeName="X"><DataItems>
     <DataItem category="SAMPLE" id="xw" type="POSITION" subType="ACTUAL" units="MILLIMETER" coordinateSystem="WORK"/>
     <DataItem category="SAMPLE" id="xm" type="POSITION" subType="ACTUAL" units="MILLIMETER"
      coordinateSystem="MACHINE"><Source>X</Source></DataItem>
     <DataItem category="CONDITION" id="xc" type="POSITION"/>
    </DataItems></Linear>
    <Rotary id="c" name="C"><DataItems>
     <DataItem category="SAMPLE" id="cv" type="ROTARY_VELOCITY" subType="ACTUAL" units="REVOLUTION/MINUTE"/>
     <DataItem category="SAMPLE" id="cl" type="LOAD" units="PERCENT"/>
    </DataItems></Rotary>
    <Rotary id="b" name="B"><DataItems>
     <DataItem category="SAMPLE" id="bv" type="ROTARY_VELOCITY" subType="ACTUAL" units="REVOLUTION/MINUTE"/>
    </DataItems></Rotary>
   </Components></Axes>
   <Controller id="ct"><Components><Path id="p" name="P1"><DataItems>
     <DataItem category="SAMPLE" id="pp" type="PATH_POSITION" subType="ACTUAL" units="MILLIMETER_3D"/>
     <DataItem category="SAMPLE" id="pf" type="PATH_FEEDRATE" nativeUnits="MILLIMETER/MINUTE"/>
   </DataItems></Path></Components></Controller>
  </Components>
 </Device>
</Devices></m:MTConnectDevices>"""
STREAMS = f"""<MTConnectStreams xmlns="urn:mtconnect.org:MTConnectStreams:1.2">
{HEADER} firstSequence="5" lastSequence="9" nextSequence="10" bufferSize="131072"/>
<Streams><DeviceStream name="VMC" uuid="000"><ComponentStream component="Linear" name="X" componentId="x">
 <Samples><Position dataItemId="xm" timestamp="2025-03-01T11:59:59.1234567Z" sequence="9" subType="ACTUAL">-12.5
 </Position></Samples>
 <Events><Execution dataItemId="ex" timestamp="2025-03-01T11:59:59Z" sequence="5">UNAVAILABLE</Execution></Events>
 <Condition><Fault dataItemId="xc" timestamp="2025-03-01T11:59:59Z" sequence="7" type="POSITION" nativeCode="1104"
  nativeSeverity="1">overtravel</Fault>
  <Normal dataItemId="y" timestamp="2025-03-01T11:59:59Z" sequence="8" type="SYSTEM"/></Condition>
</ComponentStream></DeviceStream></Streams></MTConnectStreams>"""


def device(**settings: object) -> tuple[Device, MTConnectSettings]:
    return parse(DEVICES.encode()).devices[0], MTConnectSettings(**settings)


def test_devices_are_read_with_components_and_without_namespaces() -> None:
    document = parse(DEVICES.encode())
    assert (document.header.instance, document.header.version) == (17, "2.0.0.1")
    (vmc,) = document.devices  # the agent itself is not one
    assert (vmc.name, vmc.manufacturer, vmc.model, vmc.serial_number) == ("VMC", "Maker", "V5", "123")
    assert vmc.items["xm"] == DataItem(
        *("xm", "SAMPLE", "POSITION", "ACTUAL", "", "MILLIMETER", "MACHINE", "Linear", "X1", "X", "x")
    )
    assert vmc.items["pf"].units == "MILLIMETER/MINUTE"
    assert len(vmc.items) == 9


def test_observations_are_in_the_order_of_their_numbers() -> None:
    document = parse(STREAMS.encode())
    header = document.header
    assert (header.first, header.last, header.next, header.buffer) == (5, 9, 10, 131072)
    assert [each.sequence for each in document.observations] == [5, 7, 8, 9]
    position = document.observations[-1]
    assert position.number(1e-3) == -0.0125
    assert position.time == pytest.approx(1740830399.123456, abs=1e-6)
    fault = document.observations[1]
    assert (fault.level, fault.type, fault.code, fault.value) == ("Fault", "POSITION", "1104", "overtravel")
    assert math.isnan(document.observations[0].number())


@pytest.mark.parametrize(
    "errors",
    [
        '<Errors><Error errorCode="OUT_OF_RANGE">from must be more</Error></Errors>',
        '<Errors><OutOfRange errorCode="OUT_OF_RANGE"><URI/><ErrorMessage>from must be more</ErrorMessage>'
        "</OutOfRange></Errors>",
        '<Error errorCode="OUT_OF_RANGE">from must be more</Error>',  # agents of version 1.0 are still in use
    ],
)
def test_errors_are_identified_by_their_code_in_every_version(errors: str) -> None:
    document = parse(f"<MTConnectError>{HEADER}/>{errors}</MTConnectError>".encode())
    assert document.errors == {"OUT_OF_RANGE": "from must be more"}


@pytest.mark.parametrize(
    ("document", "code"),
    [
        ("", "protocol.xml.form"),
        ("<MTConnectStreams", "protocol.xml.form"),
        ('{"json": 1}', "protocol.xml.form"),
        ('<?xml version="1.0" encoding="klingon"?><a/>', "protocol.xml.form"),
        ("<html><body/></html>", "protocol.mtconnect.form"),
        (f"<Other>{HEADER}/></Other>", "protocol.mtconnect.form"),
        (
            '<MTConnectStreams><Header creationTime="2025-03-01T12:00:00Z"/></MTConnectStreams>',
            "protocol.mtconnect.number",
        ),
        ('<MTConnectStreams><Header creationTime="noon" instanceId="1"/></MTConnectStreams>', "protocol.time.form"),
        (STREAMS.replace('sequence="7"', 'sequence="-7"'), "protocol.mtconnect.number"),
        (STREAMS.replace('sequence="7"', ""), "protocol.mtconnect.number"),
        (DEVICES.replace('id="xm"', ""), "protocol.mtconnect.form"),
    ],
)
def test_anything_else_is_a_protocol_error(document: str, code: str) -> None:
    with raises(code):
        parse(document.encode())


@pytest.mark.parametrize(
    "doctype",
    [
        '<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]>',
        '<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;">]>',
        '<!DOCTYPE a SYSTEM "http://127.0.0.1:9/evil.dtd">',
        '<!DOCTYPE html PUBLIC "-//W3C//DTD XHTML 1.0//EN" "xhtml.dtd">',
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_no_entity_is_ever_expanded(doctype: str, encoding: str) -> None:
    document = f'<?xml version="1.0" encoding="{encoding}"?>{doctype}<a>&x;&b;</a>'
    with raises("protocol.xml.document_type"):
        parse(document.encode(encoding))


@given(st.binary(max_size=300))
def test_any_invalid_bytes_are_a_protocol_error(data: bytes) -> None:
    with pytest.raises(ProtocolError):
        parse(data)


@given(st.integers(0, len(STREAMS)), st.binary(max_size=4))
def test_a_damaged_document_is_read_or_refused(place: int, stray: bytes) -> None:
    data = STREAMS.encode()
    try:
        document = parse(data[:place] + stray + data[place:])
    except ProtocolError:
        return
    assert document.header.created > 0


@given(st.lists(st.floats(-1e4, 1e4), min_size=1, max_size=3))
def test_numbers_round_trip_in_si(values: list[float]) -> None:
    observation = Observation("p", 1, 0.0, " ".join(map(repr, values)))
    assert observation.numbers(1e-3) == [value * 1e-3 for value in values]


@pytest.mark.parametrize("text", ["two", "1,5", "0x10"])
def test_a_value_that_is_no_number_is_an_error(text: str) -> None:
    with raises("protocol.mtconnect.number"):
        Observation("p", 1, 0.0, text).number()


@pytest.mark.parametrize(
    ("units", "value", "si"),
    [
        ("MILLIMETER", 1.0, 1e-3),
        ("MILLIMETER/SECOND", 60.0, 0.06),
        ("MILLIMETER/MINUTE", 60.0, 1e-3),
        ("REVOLUTION/MINUTE", 15000.0, 15000.0),
        ("DEGREE", 180.0, math.pi),
        ("PERCENT", 50.0, 0.5),
        ("INCH", 1.0, 0.0254),
    ],
)
def test_units_become_si(units: str, value: float, si: float) -> None:
    assert value * DataItem("i", "SAMPLE", "POSITION", units=units).scale == pytest.approx(si, rel=1e-12)


def test_missing_units_follow_from_the_type_and_unknown_ones_are_refused() -> None:
    assert DataItem("i", "SAMPLE", "POSITION").scale == 1e-3
    with raises("protocol.mtconnect.unit"):
        _ = DataItem("i", "SAMPLE", "POSITION", units="FURLONG").scale


def test_times_without_a_zone_are_utc() -> None:
    assert parse_time("2025-03-01T12:00:00") == parse_time("2025-03-01T13:00:00+01:00") == 1740830400.0


# ---------------------------------------------------------------------- limits


def test_the_cost_of_a_long_namespace_is_linear() -> None:
    """Expanded into each of 8000 names, these 500 kB would be 4 GB."""
    tags = "<t/>" * 8000
    document = f'<MTConnectStreams xmlns="urn:{"x" * 500_000}">{HEADER}/><Streams>{tags}</Streams></MTConnectStreams>'
    tracemalloc.start()
    try:
        assert parse(document.encode()).observations == ()
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("inside", "code"),
    [
        ("<a>" * 100 + "</a>" * 100, "protocol.xml.too_large"),
        ("<a/>" * 1001, "protocol.xml.too_large"),
        ("<a " + " ".join(f"b{k}=''" for k in range(100)) + "/>", "protocol.xml.too_large"),
        (f"<{'a' * 300}/>", "protocol.xml.too_large"),
        (f"<a {'b' * 300}=''/>", "protocol.xml.too_large"),
        ("&a;", "protocol.xml.form"),
        (
            f'<P dataItemId="x" timestamp="2025-03-01T12:00:00Z" sequence="{"9" * 5000}">1</P>',
            "protocol.mtconnect.number",
        ),
        (f'<P dataItemId="x" timestamp="{"2" * 5000}" sequence="1">1</P>', "protocol.time.form"),
    ],
)
def test_data_beyond_their_limit_are_refused(inside: str, code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(xml, "MAX_ELEMENTS", 1000)
    with raises(code):
        parse(f"<MTConnectStreams>{HEADER}/>{inside}</MTConnectStreams>".encode())


@pytest.mark.parametrize("text", ["1e999", "inf", "nan", "1_0", "0x10", "1" * 200_000 + "x", "\u0661"])
def test_values_that_only_python_accepts_as_numbers_are_refused(text: str) -> None:
    with raises("protocol.mtconnect.number"):
        Observation("p", 1, 0.0, text).number()


def test_an_observation_that_contains_others_does_not_repeat_their_text() -> None:
    inner = '<P dataItemId="x" timestamp="2025-03-01T12:00:00Z" sequence="2">7</P>'
    outer = f'<P dataItemId="y" timestamp="2025-03-01T12:00:00Z" sequence="1">5{inner}</P>'
    document = parse(f"<MTConnectStreams>{HEADER}/>{outer}</MTConnectStreams>".encode())
    assert [each.value for each in document.observations] == ["5", "7"]


# ---------------------------------------------------------------------- assignment of data items


def test_native_names_and_machine_coordinates_decide() -> None:
    chosen = choose(*device(spindle="C")).items
    assert chosen["position.X"].id == "xm"
    assert chosen["spindle_speed"].id == "cv"
    assert chosen["spindle_load"].id == "cl"
    assert chosen["feed"].id == "pf"
    assert chosen["availability"].id == "avail"
    assert "position.Y" not in chosen
    assert "mode" not in chosen


def test_a_path_position_replaces_missing_axis_positions() -> None:
    chosen = choose(*device(spindle="C", axes=("U", "V", "W"))).items
    assert chosen["position"].id == "pp"


def test_two_spindles_are_unknown_until_a_setting_decides() -> None:
    choice = choose(*device())
    assert "spindle_speed" not in choice.items
    assert "spindle_load" not in choice.items
    assert re.search(r"Several data items report 'spindle_speed': .*[cb]v .*items = ", choice.unclear["spindle_speed"])
    choice = choose(*device(items={"spindle_speed": "bv"}))
    assert choice.items["spindle_speed"].id == "bv"
    assert choice.unclear == {}
    with raises("mtconnect.axis.unknown"):
        choose(*device(spindle="S"))
    with raises("mtconnect.item.unknown"):
        choose(*device(spindle="C", items={"feed": "nope"}))
    with pytest.raises(ValueError, match="found colour"):
        MTConnectSettings(items={"colour": "x"})


def made(inside: str, configuration: str = "", **settings: object) -> Choice:
    """Return the selected data items of a device with these components."""
    document = (
        f'<MTConnectDevices>{HEADER}/><Devices><Device id="d" name="M">{configuration}<Components>{inside}'
        "</Components></Device></Devices></MTConnectDevices>"
    )
    return choose(parse(document.encode()).devices[0], MTConnectSettings(**settings))


def item(id: str, kind: str, **attributes: str) -> str:
    named = "".join(f' {key}="{value}"' for key, value in attributes.items())
    return f'<DataItem category="SAMPLE" id="{id}" type="{kind}"{named}/>'


def axis(name: str, *items: str, component: str = "Linear") -> str:
    return f'<{component} id="i{name}" name="{name}"><DataItems>{"".join(items)}</DataItems></{component}>'


SYSTEMS = """<Configuration><CoordinateSystems>
<CoordinateSystem id="b" type="BASE"/><CoordinateSystem id="m" type="MACHINE" parentIdRef="b"/>
<CoordinateSystem id="w" type="OBJECT" parentIdRef="m"/></CoordinateSystems></Configuration>"""


@pytest.mark.parametrize("order", [("w", "m"), ("m", "w"), ("b", "m"), ("gone", "m")])
def test_from_version_2_the_configuration_of_the_device_decides_on_the_coordinates(order: tuple[str, str]) -> None:
    both = [item(f"x{ref}", "POSITION", subType="ACTUAL", coordinateSystemIdRef=ref) for ref in order]
    chosen = made(axis("X", *both), SYSTEMS).items["position.X"]
    assert (chosen.id, chosen.coordinate_system) == ("xm", "MACHINE")


def test_work_coordinates_are_only_used_without_others() -> None:
    work = item("xw", "POSITION", subType="ACTUAL", coordinateSystemIdRef="w")
    plain = item("x", "POSITION", subType="ACTUAL")
    assert made(axis("X", work, plain), SYSTEMS).items["position.X"].id == "x"
    assert made(axis("X", work), SYSTEMS).items["position.X"].coordinate_system == "WORK"


def test_percent_is_an_override_not_a_speed() -> None:
    feeds = [item("f", "PATH_FEEDRATE", units="MILLIMETER/SECOND"), item("o", "PATH_FEEDRATE", units="PERCENT")]
    speeds = [
        item("s", "SPINDLE_SPEED", subType="ACTUAL", units="REVOLUTION/MINUTE"),
        item("so", "SPINDLE_SPEED", subType="ACTUAL", units="PERCENT"),
    ]
    choice = made(axis("P", *feeds, component="Path") + axis("C", *speeds, component="Rotary"))
    assert choice.items["feed"].id == "f"
    assert choice.items["spindle_speed"].id == "s"
    assert choice.unclear == {}
    assert "feed" not in made(axis("P", feeds[1], component="Path")).items
    by_revolution = item("r", "PATH_FEEDRATE", units="MILLIMETER/REVOLUTION")
    assert made(axis("P", feeds[0], by_revolution, component="Path")).items["feed"].id == "f"
    assert "feed" not in made(axis("P", by_revolution, component="Path")).items
    angular = item("a", "ROTARY_VELOCITY", subType="ACTUAL", units="DEGREE/SECOND")
    assert "spindle_speed" not in made(axis("C", angular, component="Rotary")).items


@pytest.mark.parametrize("representation", ["TIME_SERIES", "DATA_SET", "TABLE"])
def test_items_of_many_values_do_not_compete(representation: str) -> None:
    feeds = [item("fs", "PATH_FEEDRATE", representation=representation), item("f", "PATH_FEEDRATE")]
    choice = made(axis("P", *feeds, component="Path"))
    assert choice.items["feed"].id == "f"
    assert choice.unclear == {}
    assert "feed" not in made(axis("P", feeds[0], component="Path")).items


def test_a_time_series_can_be_named_and_a_set_cannot() -> None:
    series = item("fs", "PATH_FEEDRATE", representation="TIME_SERIES", units="MILLIMETER/SECOND")
    assert made(axis("P", series, component="Path"), items={"feed": "fs"}).items["feed"].id == "fs"
    table = item("ft", "PATH_FEEDRATE", representation="TABLE")
    with raises("mtconnect.item.several_values"):
        made(axis("P", table, component="Path"), items={"feed": "ft"})


def test_the_first_of_numbered_axes_is_used() -> None:
    axes = [axis(name, item(name, "POSITION", subType="ACTUAL")) for name in ("Z4", "Z1", "X")]
    chosen = made("".join(axes)).items
    assert (chosen["position.Z"].id, chosen["position.X"].id) == ("Z1", "X")
    assert "position.Y" not in chosen


def test_sets_and_tables_are_text_of_keys_and_values() -> None:
    entries = (
        '<V dataItemId="v" timestamp="2025-03-01T12:00:00Z" sequence="1" count="2"><Entry key="a">1</Entry>'
        '<Entry key="b"><Cell key="X">2</Cell><Cell key="Y">3</Cell></Entry></V>'
    )
    document = parse(f"<MTConnectStreams>{HEADER}/>{entries}</MTConnectStreams>".encode())
    assert document.observations[0].value == "a=1 b={X=2 Y=3}"


# ---------------------------------------------------------------------- golden vectors


@pytest.mark.parametrize("vector", vectors("mtconnect", "probe"), ids=str)
def test_published_devices_open_with_default_settings(vector: Vector) -> None:
    found = parse(vector.data).devices[0]
    choice = choose(found, MTConnectSettings())
    assert {key: each.id for key, each in choice.items.items()} == vector.expected["items"]
    assert sorted(choice.unclear) == vector.expected["unclear"]
    for each in choice.items.values():
        assert each.category != "SAMPLE" or each.scale > 0


@pytest.mark.parametrize("vector", vectors("mtconnect", "streams"), ids=str)
def test_published_observations(vector: Vector) -> None:
    document = parse(vector.data)
    found = {
        each.item: each.value if not each.level else f"{each.level} {each.value}" for each in document.observations
    }
    assert found == vector.expected["values"]
    assert document.header.next == vector.expected["next"]


@pytest.mark.parametrize("vector", vectors("mtconnect", "error"), ids=str)
def test_published_errors(vector: Vector) -> None:
    assert parse(vector.data).errors == vector.expected["errors"]
