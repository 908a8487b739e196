"""Files with which LinuxCNC runs a virtual machine without hardware: INI file, and the balls in HAL.

The servo thread simulates the probe, after the joints: for each ball the distance of the measured position from a
centre (``sum2``, ``hypot``) is compared with a contact distance (``comp``), and any of them trips the probe (``or2``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

PINS = "ball"
SERVO_PERIOD = 1e-3  # s
ACCELERATION = 3000.0  # mm/s^2
SLACK = 1e-3  # mm, so that the ends of travel can be reached
FAR = 1e9  # mm

HOLD = "motion.digital-out-00"

_COMPENSATION = """TWOPASS = ON
HALFILE = compensation.tcl

[ERRORMOTION]
ROUTE = {route}
LIMIT = {limit:.9g}
SLEW = {slew:.9g}
WATCHDOG = {watchdog:g}
HOLD = {hold}
"""

_AXIS = """
[AXIS_{axis}]
MIN_LIMIT = {low:.6f}
MAX_LIMIT = {high:.6f}
MAX_VELOCITY = {speed:.6f}
MAX_ACCELERATION = {acceleration:g}
OFFSET_AV_RATIO = {ratio:.9g}

[JOINT_{joint}]
TYPE = LINEAR
MIN_LIMIT = {low:.6f}
MAX_LIMIT = {high:.6f}
MAX_VELOCITY = {speed:.6f}
MAX_ACCELERATION = {acceleration:g}
FERROR = {ferror:g}
MIN_FERROR = {ferror:g}
HOME = 0
HOME_OFFSET = 0
HOME_SEARCH_VEL = 0
HOME_LATCH_VEL = 0
HOME_ABSOLUTE_ENCODER = 2
HOME_SEQUENCE = 0
"""

_INI = """# Written by errormotion: a machine without hardware.
[EMC]
VERSION = 1.1
MACHINE = {machine}
DEBUG = 0
NML_FILE = {folder}/linuxcnc.nml

[DISPLAY]
DISPLAY = {folder}/bridge.py {arguments}

[TASK]
TASK = milltask
CYCLE_TIME = 0.005

[RS274NGC]
PARAMETER_FILE = linuxcnc.var

[EMCMOT]
EMCMOT = motmod
COMM_TIMEOUT = 5.0
SERVO_PERIOD = {servo:.0f}

[EMCIO]
EMCIO = io
CYCLE_TIME = 0.05
TOOL_TABLE = linuxcnc.tbl

[HAL]
HALFILE = LIB:basic_sim.tcl -no_use_hal_manualtoolchange -no_simulated_home -no_make_ddts
HALFILE = balls.hal
{compensation}
[KINS]
KINEMATICS = trivkins coordinates=XYZ
JOINTS = 3

[TRAJ]
COORDINATES = XYZ
LINEAR_UNITS = {unit}
ANGULAR_UNITS = degree
DEFAULT_LINEAR_VELOCITY = {speed:.6f}
MAX_LINEAR_VELOCITY = {fastest:.6f}
MAX_LINEAR_ACCELERATION = {acceleration:g}

[SPINDLE_0]
MAX_FORWARD_VELOCITY = {top_speed:g}
MAX_REVERSE_VELOCITY = {top_speed:g}
"""


@dataclass(frozen=True)
class Compensated:
    """Compensation of a simulated LinuxCNC.

    Attributes
    ----------
    route : str
        ``external`` or ``feedback``.
    limit, slew, watchdog : float
        Largest offset, m, its largest rate of change, m/s, and the time without a heartbeat until it ramps to zero, s.
    """

    route: str = "external"
    limit: float = 50e-6
    slew: float = 1e-6
    watchdog: float = 2.0


def ini_text(
    machine: str,
    travel: Mapping[str, tuple[float, float]],
    rapid: float,
    top_speed: float,
    *,
    arguments: str,
    inch: bool = False,
    compensated: Compensated | None = None,
) -> str:
    """Return an INI file for axes X, Y, Z with travels in m, a rapid feed in m/s and a top speed in 1/min.

    ``{folder}`` stands for the folder of the file.
    """
    unit = 1000.0 / 25.4 if inch else 1000.0
    scale = 1 / 25.4 if inch else 1.0
    text = _INI.format(
        machine=machine,
        folder="{folder}",
        arguments=arguments,
        servo=SERVO_PERIOD * 1e9,
        unit="inch" if inch else "mm",
        speed=unit * rapid,
        fastest=2 * unit * rapid,
        acceleration=2 * scale * ACCELERATION,
        top_speed=top_speed,
        compensation=""
        if compensated is None
        else _COMPENSATION.format(
            route=compensated.route,
            limit=unit * compensated.limit,
            slew=unit * compensated.slew,
            watchdog=compensated.watchdog,
            hold=HOLD,
        ),
    )
    for joint, (axis, (low, high)) in enumerate(travel.items()):
        text += _AXIS.format(
            axis=axis,
            joint=joint,
            low=unit * low - scale * SLACK,
            high=unit * high + scale * SLACK,
            speed=unit * rapid,
            acceleration=scale * ACCELERATION,
            ferror=5 * scale,
            ratio=0.0 if compensated is None else compensated.slew / rapid,
        )
    return text


def hal_text(balls: int) -> str:
    """Return a HAL file with a probe that trips on any of a number of balls, all initially far away."""
    names = [f"{PINS}{i}" for i in range(balls)]
    sums = ",".join(f"{name}.{axis}" for name in names for axis in "xyz")
    lines = [
        f"loadrt sum2 names={sums}",
        f"loadrt hypot names={','.join(f'{name}.distance' for name in names)}",
        f"loadrt comp names={','.join(f'{name}.trip' for name in names)}",
        f"loadrt or2 names={','.join(f'{name}.any' for name in names)}",
        "setp rpm_rps.gain 0.0166666666667",
    ]
    before = ""
    for name in names:
        for joint, axis in enumerate("xyz"):
            lines += [
                f"addf {name}.{axis} servo-thread",
                f"net J{joint}:pos-fb => {name}.{axis}.in0",
                f"net {name}:{axis} {name}.{axis}.out => {name}.distance.in{joint}",
                f"setp {name}.{axis}.offset {FAR:g}",
            ]
        lines += [
            f"addf {name}.distance servo-thread",
            f"addf {name}.trip servo-thread",
            f"addf {name}.any servo-thread",
            f"net {name}:distance {name}.distance.out => {name}.trip.in0",
            f"setp {name}.trip.in1 0",
            f"net {name}:trip {name}.trip.out => {name}.any.in0",
        ]
        if before:
            lines.append(f"net {before}:any => {name}.any.in1")
        lines.append(f"net {name}:any {name}.any.out")
        before = name
    lines.append(f"net {before}:any => motion.probe-input")
    return "\n".join(lines) + "\n"


def pin_values(
    ball: int, centre: tuple[float, float, float], contact_distance: float, *, inch: bool = False
) -> dict[str, float]:
    """Return the HAL pins of a ball: its centre, and the distance from there at which the probe trips, m."""
    unit = 1000.0 / 25.4 if inch else 1000.0
    name = f"{PINS}{ball}"
    offsets = {f"{name}.{axis}.offset": -unit * x for axis, x in zip("xyz", centre, strict=True)}
    return {**offsets, f"{name}.trip.in1": unit * contact_distance}
