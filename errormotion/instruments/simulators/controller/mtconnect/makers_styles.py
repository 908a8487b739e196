"""Device documents in the styles of two manufacturers, written after public documents."""

from __future__ import annotations

AXES = "XYZ"


def data_item(category: str, kind: str, item_id: str, src: str = "", content: str = "", **more: str) -> str:
    """Return a data item: category, type, identifier, reading, content, further attributes."""
    attributes = "".join(f' {name}="{value}"' for name, value in more.items())
    source = f' src="{src}"' if src else ""
    return f'<DataItem category="{category}" id="{item_id}" type="{kind}"{attributes}{source}>{content}</DataItem>'


def data_items(*items: str) -> str:
    """Return the data items of a component."""
    return f"<DataItems>{''.join(items)}</DataItems>"


def inside(*components: str) -> str:
    """Return the components of a component."""
    return f"<Components>{''.join(components)}</Components>"


def coordinate_systems(*systems: tuple[str, str, str]) -> str:
    """Return the configuration with coordinate systems: identifier, type, parent."""
    origin = "<Origin>0 0 0</Origin>"
    shifted = "<Transformation><Translation>0 0 0</Translation><Rotation>0 0 0</Rotation></Transformation>"
    each = (
        f'<CoordinateSystem id="{name}" type="{kind}"'
        + (f' parentIdRef="{parent}">{shifted}' if parent else f">{origin}")
        for name, kind, parent in systems
    )
    listed = "</CoordinateSystem>".join(each)
    return f"<Configuration><CoordinateSystems>{listed}</CoordinateSystem></CoordinateSystems></Configuration>"


def okuma(name: str, uuid: str, serial: str) -> str:
    """Return a document in one manufacturer's style: a lathe, schema 2: positions in machine and work coordinates.

    Source of the style: the demo device OKUMA of mtconnect/cppagent.
    """

    def axis(letter: str, tag: str, src: str) -> str:
        common = {"subType": "ACTUAL", "units": "MILLIMETER", "nativeUnits": "MILLIMETER"}
        pair = (
            data_item(
                "SAMPLE",
                "POSITION",
                f"L{tag}actw",
                f"{src}.work",
                coordinateSystemIdRef="work",
                name=f"{tag}actw",
                **common,
            ),
            data_item(
                "SAMPLE",
                "POSITION",
                f"L{tag}actm",
                f"{src}.machine",
                coordinateSystemIdRef="machine",
                name=f"{tag}actm",
                **common,
            ),
        )
        load = data_item("SAMPLE", "LOAD", f"L{tag}load", name=f"{tag}load", units="PERCENT", nativeUnits="PERCENT")
        return f'<Linear id="L{tag.lower()}" name="{letter}">{data_items(*pair, load)}</Linear>'

    def spindle(number: int, src: str) -> str:
        speed = {"units": "REVOLUTION/MINUTE", "nativeUnits": "REVOLUTION/MINUTE"}
        return (
            f'<Rotary id="Lc{number}" name="C{number}" nativeName="S{number if number > 1 else ""}">'
            + data_items(
                data_item(
                    "SAMPLE",
                    "ROTARY_VELOCITY",
                    f"LS{number}cmd",
                    src and f"{src}.commanded",
                    name=f"S{number}cmd",
                    subType="PROGRAMMED",
                    **speed,
                ),
                data_item(
                    "SAMPLE",
                    "ROTARY_VELOCITY",
                    f"LS{number}speed",
                    src,
                    name=f"S{number}speed",
                    subType="ACTUAL",
                    **speed,
                ),
                data_item("EVENT", "ROTARY_VELOCITY_OVERRIDE", f"LS{number}ovr", "=100", name=f"S{number}ovr"),
                data_item("EVENT", "ROTARY_MODE", f"LS{number}Mode", "=SPINDLE", name=f"S{number}Mode"),
                data_item(
                    "SAMPLE",
                    "LOAD",
                    f"LS{number}load",
                    "spindle.load" if src else "",
                    name=f"S{number}load",
                    units="PERCENT",
                ),
            )
            + "</Rotary>"
        )

    feed = {"units": "MILLIMETER/SECOND", "nativeUnits": "MILLIMETER/MINUTE"}
    path = data_items(
        data_item("SAMPLE", "PATH_FEEDRATE", "Lp1Fcmd", name="p1Fcmd", subType="PROGRAMMED", **feed),
        data_item("SAMPLE", "PATH_FEEDRATE", "Lp1Fact", "feed", name="p1Fact", subType="ACTUAL", **feed),
        data_item("EVENT", "BLOCK", "Lp1block", name="p1block"),
        data_item(
            "SAMPLE",
            "PATH_POSITION",
            "Lp1LPathPos",
            "path.work",
            name="p1LPathPos",
            subType="ACTUAL",
            units="MILLIMETER_3D",
            coordinateSystem="WORK",
        ),
        data_item("EVENT", "TOOL_NUMBER", "Lp1CurrentTool", name="p1CurrentTool"),
        data_item("EVENT", "WORK_OFFSETS", "Lp1offsets", "offsets", name="p1offsets", representation="TABLE"),
    )
    controller = data_items(
        data_item("EVENT", "EMERGENCY_STOP", "Lestop", "estop", name="estop"),
        data_item("CONDITION", "SYSTEM", "Lsystem", "system", name="system"),
        data_item("EVENT", "CONTROLLER_MODE", "Lpmode", "mode", name="pmode"),
        data_item("EVENT", "EXECUTION", "Lpexecution", "execution", name="pexecution"),
        data_item("EVENT", "PROGRAM", "Lpprogram", "program", name="pprogram"),
        data_item("EVENT", "PATH_FEEDRATE_OVERRIDE", "LpFovr", "=100", name="pFovr", subType="PROGRAMMED"),
        data_item("EVENT", "PART_COUNT", "Lppartcount", "=0", name="ppartcount"),
    )
    agent = (
        f'<Agent id="agent_1" name="Agent" uuid="{uuid}-agent" mtconnectVersion="2.7">'
        + data_items(data_item("EVENT", "AVAILABILITY", "agent_avail", "=AVAILABLE"))
        + "</Agent>"
    )
    systems = (
        ("world", "WORLD", ""),
        ("base", "BASE", "world"),
        ("machine", "MACHINE", "base"),
        ("work", "OBJECT", "machine"),
    )
    return agent + (
        f'<Device id="{name}.1" name="{name}" uuid="{uuid}">'
        f'<Description manufacturer="errormotion" model="{name}" serialNumber="{serial}">A lathe</Description>'
        + coordinate_systems(*systems)
        + data_items(
            data_item("EVENT", "AVAILABILITY", "Lavail", "avail", name="avail"),
            data_item("EVENT", "FUNCTIONAL_MODE", "Lfmode", "=PRODUCTION", name="fmode"),
        )
        + inside(
            '<Axes id="Laxes1" name="Axes">'
            + inside(
                axis("X", "X1", "X"), axis("Y", "YI1", "Y"), axis("Z1", "Z1", "Z"), spindle(1, "rpm"), spindle(2, "")
            )
            + "</Axes>",
            f'<Controller id="Lct1" name="controller">{controller}'
            + inside(f'<Path id="Lp1" name="path">{path}</Path>')
            + "</Controller>",
            '<Systems id="LSystems1" name="Systems1">'
            + inside(
                '<Coolant id="LCoolantSystem1" name="CoolantSystem1">'
                + data_items(
                    data_item("CONDITION", "SYSTEM", "LCoolantSystem1_cond", "normal", name="CoolantSystem1_cond")
                )
                + "</Coolant>"
            )
            + "</Systems>",
        )
        + "</Device>"
    )


def mazak(name: str, uuid: str, serial: str) -> str:
    """Return a document in one manufacturer's style: a 5-axis mill, schema 1.7: extensions, data sets, tilting table.

    Source of the style: the demo device Mazak of mtconnect/cppagent.
    """

    def axis(letter: str) -> str:
        common = {"subType": "ACTUAL", "units": "MILLIMETER"}
        return (
            f'<Linear id="{letter.lower()}" name="{letter}" nativeName="{letter}">'
            + data_items(
                data_item(
                    "SAMPLE",
                    "POSITION",
                    f"{letter}abs",
                    f"{letter}.machine",
                    coordinateSystemIdRef="machcoord",
                    **common,
                ),
                data_item(
                    "SAMPLE", "POSITION", f"{letter}pos", f"{letter}.work", coordinateSystemIdRef="workcoord", **common
                ),
                data_item("CONDITION", "POSITION", f"{letter}travel", "normal"),
                data_item("SAMPLE", "AXIS_FEEDRATE", f"{letter}frt", units="MILLIMETER/SECOND"),
                data_item(
                    *(
                        "SAMPLE",
                        "LOAD",
                        f"{letter}load",
                        "",
                        '<Filters><Filter type="MINIMUM_DELTA">3</Filter></Filters>',
                    ),
                    units="PERCENT",
                ),
            )
            + "</Linear>"
        )

    rotary = data_items(
        data_item("SAMPLE", "LOAD", "Sload", "spindle.load", units="PERCENT"),
        data_item("SAMPLE", "ROTARY_VELOCITY", "Srpm", "rpm", subType="ACTUAL", units="REVOLUTION/MINUTE"),
        data_item("EVENT", "ROTARY_MODE", "c2rfunc", "=SPINDLE", "<Constraints><Value>SPINDLE</Value></Constraints>"),
        data_item("CONDITION", "LOAD", "Sload_cond", "normal"),
    )
    table = data_items(
        data_item(
            "SAMPLE", "ANGLE", "Babs", "=0.0", coordinateSystemIdRef="machcoord", subType="ACTUAL", units="DEGREE"
        ),
        data_item(
            "SAMPLE", "ANGLE", "Bpos", "=0.0", coordinateSystemIdRef="workcoord", subType="ACTUAL", units="DEGREE"
        ),
        data_item("CONDITION", "ANGLE", "Btravel", "normal"),
    )
    controller = data_items(
        data_item("CONDITION", "COMMUNICATIONS", "comms_cond", "normal"),
        data_item("CONDITION", "SYSTEM", "system_cond", "system"),
        data_item("EVENT", "EMERGENCY_STOP", "estop", "estop"),
        data_item("SAMPLE", "ACCUMULATED_TIME", "auto_time", subType="x:AUTO", units="SECOND"),
    )
    path = data_items(
        data_item(
            "SAMPLE", "PATH_POSITION", "pathpos", "path.work", units="MILLIMETER_3D", coordinateSystemIdRef="workcoord"
        ),
        data_item("EVENT", "PATH_FEEDRATE_OVERRIDE", "Frapidovr", "=100", subType="RAPID"),
        data_item("EVENT", "PATH_FEEDRATE_OVERRIDE", "Fovr", "=100", subType="PROGRAMMED"),
        data_item("EVENT", "PROGRAM", "program", "program", subType="MAIN"),
        data_item("EVENT", "PROGRAM", "activeprog", subType="ACTIVE"),
        data_item("EVENT", "x:SEQUENCE_NUMBER", "sequenceNum", "=0"),
        data_item(
            "SAMPLE",
            "PATH_FEEDRATE",
            "Fact",
            "feed",
            subType="ACTUAL",
            units="MILLIMETER/SECOND",
            coordinateSystem="WORK",
        ),
        data_item("EVENT", "EXECUTION", "execution", "execution"),
        data_item("EVENT", "CONTROLLER_MODE", "mode", "mode"),
        data_item("CONDITION", "MOTION_PROGRAM", "motion_cond", "normal"),
        data_item("EVENT", "VARIABLE", "cvars", "variables", representation="DATA_SET"),
        data_item(
            "EVENT",
            "TRANSLATION",
            "workoffsettrans",
            "offset",
            coordinateSystemIdRef="workcoord",
            units="MILLIMETER_3D",
        ),
    )
    systems = (("base", "BASE", ""), ("machcoord", "MACHINE", "base"), ("workcoord", "OBJECT", "machcoord"))
    return (
        f'<Device id="d1" name="{name}" uuid="{uuid}"><Description>errormotion {name} {serial}</Description>'
        + coordinate_systems(*systems)
        + data_items(
            data_item("EVENT", "AVAILABILITY", "avail", "avail"),
            data_item("EVENT", "EQUIPMENT_MODE", "empowered", "=ON", subType="POWERED"),
        )
        + inside(
            f'<Axes id="a" name="base">{data_items(data_item("CONDITION", "ACTUATOR", "servo_cond", "normal"))}'
            + inside(
                *(axis(letter) for letter in AXES),
                f'<Rotary id="c" name="C1" nativeName="S">{rotary}</Rotary>',
                f'<Rotary id="br" name="B" nativeName="B">{table}</Rotary>',
            )
            + "</Axes>",
            f'<Controller id="cont" name="controller">{controller}'
            + inside(f'<Path id="path1" name="path">{path}</Path>')
            + "</Controller>",
            '<Door id="door1" name="door">'
            + data_items(data_item("EVENT", "DOOR_STATE", "doorstate", "=CLOSED"))
            + "</Door>",
        )
        + "</Device>"
    )
