"""The two named virtual machines as tables: bodies, heat flows, thermal growth, chain and travel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from errormotion.errors import BenchError
from errormotion.kinematics.description import MachineDescription

Table = Mapping[str, float]


@dataclass(frozen=True)
class MachineKind:
    """One virtual machine without the individual deviations that a seed adds.

    Attributes
    ----------
    travel : mapping
        (Lowest, highest) position of each axis, m.
    chain : str
        Order of the bodies from workpiece to tool.
    capacity, links, to_air, heat_share
        The thermal network: J/K, W/K, W/K, share of the spindle's heat.
    heat_linear, heat_square : float
        Heat of the spindle at a speed of n (1/min): heat_linear n + heat_square n^2, W.
    growth : mapping
        For each error of the spindle at the end of the bar, the growth with each body, um/K or urad/K.
    behind : tuple of str
        Bodies after the last axis. They displace and tilt the spindle; the others also rotate the frame of the axes.
    compensation : mapping
        For each axis the steady correction at top speed, m, and the time constant of the control's model, s.
    top_speed : float
        1/min.
    rapid : float
        Feed of rapid moves, m/s.
    """

    name: str
    travel: Mapping[str, tuple[float, float]]
    chain: str
    capacity: Table
    links: tuple[tuple[str, str, float], ...]
    to_air: Table
    heat_share: Table
    heat_linear: float
    heat_square: float
    growth: Mapping[str, Table]
    compensation: Mapping[str, tuple[float, float]]
    behind: tuple[str, ...] = ("spindle_front", "spindle_rear", "motor", "head")
    top_speed: float = 15000.0
    rapid: float = 20.0 / 60

    @property
    def description(self) -> MachineDescription:
        """Description of the machine as in a bench file."""
        return MachineDescription(self.name, self.chain, self.travel)


CFRAME = MachineKind(
    name="C-frame 610",
    travel={"X": (-0.305, 0.305), "Y": (-0.255, 0.255), "Z": (0.0, 0.46)},
    chain="workpiece-X-Y-bed-Z-spindle-tool",
    capacity={
        "spindle_front": 6e3,
        "spindle_rear": 6e3,
        "motor": 12e3,
        "head": 50e3,
        "screw_x": 6e3,
        "screw_y": 6e3,
        "screw_z": 7e3,
        "column_front": 90e3,
        "column_rear": 120e3,
        "bed": 400e3,
        "frame": 1.5e3,
    },
    links=(
        ("spindle_front", "head", 25.0),
        ("spindle_rear", "head", 25.0),
        ("motor", "spindle_rear", 10.0),
        ("motor", "head", 20.0),
        ("head", "column_front", 45.0),
        ("head", "screw_z", 4.0),
        ("screw_z", "column_front", 6.0),
        ("column_front", "column_rear", 40.0),
        ("column_front", "bed", 20.0),
        ("column_rear", "bed", 30.0),
        ("screw_x", "bed", 6.0),
        ("screw_y", "bed", 6.0),
        ("frame", "bed", 0.3),
        ("frame", "spindle_front", 0.15),
    ),
    to_air={
        "spindle_front": 4.0,
        "spindle_rear": 3.0,
        "motor": 8.0,
        "head": 14.0,
        "screw_x": 2.0,
        "screw_y": 2.0,
        "screw_z": 2.0,
        "column_front": 18.0,
        "column_rear": 22.0,
        "bed": 40.0,
        "frame": 1.0,
    },
    heat_share={"spindle_front": 0.4, "spindle_rear": 0.25, "motor": 0.35},
    heat_linear=0.012,
    heat_square=8e-7,
    growth={
        "EX": {"motor": 0.15, "head": 0.35},
        "EY": {"head": 0.6, "column_front": 2.0, "column_rear": -1.0},
        "EZ": {"spindle_front": -0.4, "head": 6.0, "column_front": 9.0, "column_rear": 0.4},
        "EA": {"head": 11.2, "column_front": 47.3, "column_rear": -47.3},
        "EB": {"motor": -6.1, "head": -1.6},
        "EC": {"motor": 0.5, "column_front": 1.0},
    },
    compensation={"X": (2e-6, 900.0), "Y": (9.15e-6, 1500.0), "Z": (29.8e-6, 1500.0)},
)

GANTRY = MachineKind(
    name="Gantry 4000",
    travel={"X": (0.0, 4.0), "Y": (-0.9, 0.9), "Z": (0.0, 1.0)},
    chain="workpiece-bed-X-Y-Z-spindle-tool",
    capacity={
        "spindle_front": 8e3,
        "spindle_rear": 8e3,
        "motor": 18e3,
        "head": 90e3,
        "screw_x": 25e3,
        "screw_y": 12e3,
        "screw_z": 8e3,
        "beam_top": 350e3,
        "beam_bottom": 350e3,
        "column_front": 500e3,
        "column_rear": 500e3,
        "bed": 3e6,
        "frame": 1.5e3,
    },
    links=(
        ("spindle_front", "head", 30.0),
        ("spindle_rear", "head", 30.0),
        ("motor", "spindle_rear", 10.0),
        ("motor", "head", 25.0),
        ("head", "beam_bottom", 30.0),
        ("head", "beam_top", 10.0),
        ("head", "screw_z", 5.0),
        ("screw_y", "beam_top", 8.0),
        ("beam_top", "beam_bottom", 60.0),
        ("beam_bottom", "column_front", 25.0),
        ("beam_bottom", "column_rear", 25.0),
        ("column_front", "bed", 40.0),
        ("column_rear", "bed", 40.0),
        ("screw_x", "bed", 15.0),
        ("frame", "bed", 0.3),
        ("frame", "spindle_front", 0.15),
    ),
    to_air={
        "spindle_front": 4.0,
        "spindle_rear": 3.0,
        "motor": 10.0,
        "head": 18.0,
        "screw_x": 8.0,
        "screw_y": 4.0,
        "screw_z": 2.0,
        "beam_top": 35.0,
        "beam_bottom": 35.0,
        "column_front": 40.0,
        "column_rear": 40.0,
        "bed": 200.0,
        "frame": 1.0,
    },
    heat_share={"spindle_front": 0.4, "spindle_rear": 0.25, "motor": 0.35},
    heat_linear=0.016,
    heat_square=1.2e-6,
    growth={
        "EX": {"head": 2.0, "beam_bottom": 6.0, "column_front": 2.0, "column_rear": -2.0},
        "EY": {"motor": 0.2, "head": 0.5, "beam_top": 8.0, "beam_bottom": 8.0},
        "EZ": {"spindle_front": -1.2, "head": -3.0, "beam_top": -4.0, "beam_bottom": 6.0, "column_front": 6.0},
        "EA": {"beam_top": -45.0, "beam_bottom": 45.0},
        "EB": {"head": 3.0, "beam_bottom": 14.0, "column_front": 6.0, "column_rear": -6.0},
        "EC": {"motor": 0.6, "screw_y": 6.0, "beam_top": 6.0},
    },
    compensation={"X": (3e-6, 900.0), "Y": (2e-6, 900.0), "Z": (-20e-6, 900.0)},
)

KINDS: Mapping[str, MachineKind] = {"cframe": CFRAME, "gantry": GANTRY}


def machine_kind(machine: str | MachineDescription) -> tuple[str, MachineKind]:
    """Return the name of a kind and its tables.

    A machine with a description has the chain and travel of the description. It has the thermal properties of the
    gantry if X, Y and Z carry the tool, else those of the C-frame.

    Raises
    ------
    BenchError
        An unknown kind.
    """
    if isinstance(machine, MachineDescription):
        name = "gantry" if machine.tool_axes == "XYZ" else "cframe"
        return name, replace(KINDS[name], name=machine.name, travel=machine.travel, chain=machine.chain)
    if machine not in KINDS:
        raise BenchError(
            f"expected a virtual machine, {' or '.join(KINDS)}, or a description; found '{machine}'",
            code="virtual.machine.unknown",
        )
    return machine, KINDS[machine]
