"""Styles of agents: their device documents, schema versions, work offsets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from errormotion.instruments.simulators.controller.mtconnect.makers_styles import (
    AXES,
    data_item,
    data_items,
    inside,
    mazak,
    okuma,
)


@dataclass(frozen=True)
class Style:
    """A style of agents.

    Attributes
    ----------
    document : callable
        ``document(name, uuid, serial)`` returns the devices as XML.
    version : str
        Schema version.
    offset : tuple of float
        Work offset, mm.
    multipart : str
        Type of multipart stream.
    """

    document: Callable[[str, str, str], str]
    version: str
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    multipart: str = "x-mixed-replace"


def series() -> str:
    """Return a component whose data items have several values for each observation."""
    positions = (
        data_item(
            *("SAMPLE", "POSITION", f"{name}series", f"{name}.series"),
            subType="ACTUAL",
            units="MILLIMETER",
            representation="TIME_SERIES",
            sampleRate="100",
        )
        for name in AXES
    )
    return (
        '<Controller id="more" name="more">'
        + data_items(
            *positions,
            data_item("EVENT", "VARIABLE", "morevars", "variables", representation="DATA_SET"),
            data_item("EVENT", "WORK_OFFSETS", "moreoffsets", "offsets", representation="TABLE"),
        )
        + "</Controller>"
    )


def own(name: str, uuid: str, serial: str) -> str:
    """Return a minimal document: one device, three axes, a spindle, a controller with a path."""
    axes = "".join(
        f'<Linear id="axis{axis}" name="{axis}">'
        + data_items(
            data_item("SAMPLE", "POSITION", f"{axis}act", f"{axis}.machine", subType="ACTUAL", units="MILLIMETER"),
            data_item("SAMPLE", "POSITION", f"{axis}com", f"{axis}.commanded", subType="COMMANDED", units="MILLIMETER"),
        )
        + "</Linear>"
        for axis in AXES
    )
    spindle = data_items(
        data_item("SAMPLE", "ROTARY_VELOCITY", "Srpm", "rpm", subType="ACTUAL", units="REVOLUTION/MINUTE"),
        data_item("SAMPLE", "LOAD", "Sload", "spindle.load", units="PERCENT"),
    )
    rotary = f'<Rotary id="axisS" name="S">{spindle}</Rotary>'
    path = data_items(
        data_item("EVENT", "CONTROLLER_MODE", "mode", "mode"),
        data_item("EVENT", "EXECUTION", "exec", "execution"),
        data_item("EVENT", "PROGRAM", "pgm", "program"),
        data_item("SAMPLE", "PATH_FEEDRATE", "feed", "feed", subType="ACTUAL", units="MILLIMETER/SECOND"),
    )
    controller = data_items(
        data_item("EVENT", "EMERGENCY_STOP", "estop", "estop"), data_item("CONDITION", "SYSTEM", "system", "system")
    )
    return (
        f'<Device id="vm" name="{name}" uuid="{uuid}">'
        f'<Description manufacturer="errormotion" model="{name}" serialNumber="{serial}"/>'
        + data_items(data_item("EVENT", "AVAILABILITY", "avail", "avail"))
        + inside(
            f'<Axes id="axes" name="base">{inside(axes + rotary)}</Axes>',
            f'<Controller id="cont" name="controller">{controller}'
            + inside(f'<Path id="path" name="path">{path}</Path>')
            + "</Controller>",
        )
        + "</Device>"
    )


def vmc(name: str, uuid: str, serial: str) -> str:
    """Return a document in the style of the first schemas: a spindle of type ``SPINDLE_SPEED``, overrides in percent.

    Source of the style: the simulated device VMC-3Axis of mtconnect/cppagent.
    """
    mm = {"nativeUnits": "MILLIMETER", "units": "MILLIMETER"}
    percent = {"nativeUnits": "PERCENT", "units": "PERCENT"}
    speed = {"nativeUnits": "REVOLUTION/MINUTE", "units": "REVOLUTION/MINUTE"}
    rotary = data_items(
        data_item(
            "SAMPLE",
            "SPINDLE_SPEED",
            "c3",
            "=100",
            "<Source>SspeedOvr</Source>",
            name="Sovr",
            subType="OVERRIDE",
            **percent,
        ),
        data_item(
            "SAMPLE",
            "SPINDLE_SPEED",
            "c2",
            "rpm",
            "<Source>spindle_speed</Source>",
            name="Sspeed",
            subType="ACTUAL",
            **speed,
        ),
        data_item(
            "EVENT", "ROTARY_MODE", "cm", "=SPINDLE", "<Constraints><Value>SPINDLE</Value></Constraints>", name="Cmode"
        ),
        data_item("CONDITION", "LOAD", "Cloadc", "normal"),
        data_item("SAMPLE", "LOAD", "cl3", "spindle.load", name="Cload", **percent),
    )
    axes = (
        f'<Linear id="{axis.lower()}1" name="{axis}">'
        + data_items(
            data_item(
                "SAMPLE", "POSITION", f"{axis.lower()}2", f"{axis}.machine", name=f"{axis}act", subType="ACTUAL", **mm
            ),
            data_item(
                "SAMPLE",
                "POSITION",
                f"{axis.lower()}3",
                f"{axis}.commanded",
                name=f"{axis}com",
                subType="COMMANDED",
                **mm,
            ),
            data_item("SAMPLE", "LOAD", f"{axis.lower()}4", name=f"{axis}load", **percent),
            data_item("CONDITION", "LOAD", f"{axis}loadc", "normal"),
        )
        + "</Linear>"
        for axis in AXES
    )
    controller = data_items(
        data_item("EVENT", "MESSAGE", "msg"),
        data_item("EVENT", "EMERGENCY_STOP", "estop", "estop"),
        data_item("CONDITION", "LOGIC_PROGRAM", "clp", "normal"),
        data_item("CONDITION", "SYSTEM", "system", "system"),
    )
    path = data_items(
        data_item("EVENT", "BLOCK", "cn2", name="block"),
        data_item("EVENT", "CONTROLLER_MODE", "cn3", "mode", name="mode"),
        data_item("EVENT", "LINE", "cn4", name="line"),
        data_item("EVENT", "PROGRAM", "cn5", "program", name="program"),
        data_item("EVENT", "EXECUTION", "cn6", "execution", name="execution"),
        data_item(
            "SAMPLE",
            "PATH_POSITION",
            "Ppos",
            "path.work",
            subType="ACTUAL",
            nativeUnits="MILLIMETER_3D",
            units="MILLIMETER_3D",
        ),
        data_item("SAMPLE", "PATH_FEEDRATE", "Fovr", "=100", "<Source>feed_ovr</Source>", **percent),
        data_item(
            "SAMPLE",
            "PATH_FEEDRATE",
            "Frt",
            "feed",
            "<Source>path_feedrate</Source>",
            nativeUnits="MILLIMETER/SECOND",
            units="MILLIMETER/SECOND",
        ),
    )
    return (
        f'<Device id="dev" iso841Class="6" name="{name}" sampleRate="10" uuid="{uuid}">'
        f'<Description manufacturer="errormotion" serialNumber="{serial}"/>'
        + data_items(data_item("EVENT", "AVAILABILITY", "avail", "avail"))
        + inside(
            f'<Axes id="ax" name="Axes">{inside(f"""<Rotary id="c1" name="C">{rotary}</Rotary>""", *axes)}</Axes>',
            f'<Controller id="cn1" name="controller">{controller}'
            + inside(f'<Path id="pth" name="path">{path}</Path>')
            + "</Controller>",
            '<Systems id="systems" name="systems">'
            + inside(
                '<Electric id="el" name="electric">'
                + data_items(data_item("EVENT", "POWER_STATE", "p2", "=ON", name="power"))
                + "</Electric>"
            )
            + "</Systems>",
        )
        + "</Device>"
    )


STYLES = {
    "own": Style(own, "1.3"),
    "okuma": Style(okuma, "2.7", (-120.0, 40.0, 25.5), "mixed"),
    "mazak": Style(mazak, "1.7", (210.0, 275.0, 30.0)),
    "vmc": Style(vmc, "1.3", (12.5, -7.5, 100.0)),
}
