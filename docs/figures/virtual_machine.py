"""Draw docs/figures/virtual_machine.png: what the virtual machine is, and what it does in the demonstration."""

from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from errormotion.twin import Event, StepProgram, VirtualMachine

BLUE, ORANGE, GREEN, PURPLE, RED, GREY = "#1f5a96", "#d9822b", "#2e8b57", "#7b4fa3", "#c0392b", "#8a8f98"
COLOURS = {"X": BLUE, "Y": ORANGE, "Z": GREEN}
MINUTE = 60.0


def demonstration() -> VirtualMachine:
    """Return the machine under the schedule of the demonstration."""
    machine = VirtualMachine("cframe", seed=3)
    machine.start(
        [
            Event(0, spindle_speed=15000),
            Event(101 * MINUTE, compensation={"Z": False}),
            Event(102 * MINUTE, compensation={"Y": False}),
        ]
    )
    return machine


def draw_frame(ax: Axes, machine: VirtualMachine) -> None:
    """Draw the bar and the beams, looking along Y; beams along Y are dots on the bar."""
    frame, r = machine.frame, machine.bar_radius * 1e3
    ax.add_patch(Rectangle((-r, 0), 2 * r, 62, facecolor="#dfe3e8", edgecolor=GREY))
    ax.add_patch(Rectangle((-14, 62), 28, 10, facecolor="#b8bec6", edgecolor=GREY))
    ax.text(0, 67, "spindle", ha="center", va="center", fontsize=8)
    ax.plot([0, 0], [-6, 76], color=GREY, lw=0.8, ls=(0, (8, 3, 1, 3)))
    for name, origin, beam in zip(frame.channels, frame.nominal_origin * 1e3, frame.nominal_direction, strict=True):
        colour = COLOURS[name[0]]
        if name[0] == "Y":
            ax.plot(0, origin[2], "o", color=colour, ms=6)
            ax.annotate(name, (-r - 2.5, origin[2]), color=colour, ha="right", va="center", fontsize=9)
            continue
        start = origin - 12 * beam
        head = {"arrowstyle": "-|>", "color": colour, "lw": 1.6, "shrinkA": 0, "shrinkB": 0}
        ax.annotate("", (origin + beam)[[0, 2]], start[[0, 2]], arrowprops=head)
        housing = start - 5 * beam
        ax.add_patch(Rectangle((housing[0] - 5, housing[2] - 4), 10, 8, facecolor="white", edgecolor=colour, lw=1.4))
        ax.text(housing[0], housing[2], name, color=colour, ha="center", va="center", fontsize=9)
    for label, z in zip(("L1", "L2"), frame.levels * 1e3, strict=True):
        ax.plot([-22, -r - 11], [z, z], color=GREY, lw=0.8, ls=":")
        ax.text(-23, z, f"{label}  z = {z:.0f} mm", ha="right", va="center", fontsize=8, color="#444")
    ax.set(xlim=(-52, 36), ylim=(-25, 78), aspect="equal")
    ax.axis("off")
    ax.set_title("Five sensors on a 10 mm bar, seen along Y")


def draw_temperatures(ax: Axes, machine: VirtualMachine, minutes: np.ndarray) -> None:
    """Draw some temperatures over time."""
    values = machine.temperatures(minutes * MINUTE)
    shown = {
        "spindle_front": RED,
        "motor": PURPLE,
        "head": ORANGE,
        "column_front": BLUE,
        "frame": GREEN,
        "ambient": GREY,
    }
    for name, colour in shown.items():
        curve = values[:, machine.temperature_sensors.index(name)]
        ax.plot(minutes, curve, color=colour)
        ax.text(minutes[-1] + 1.5, curve[-1], name.replace("_", " "), color=colour, va="center", fontsize=8)
    ax.set(xlim=(0, 104), xlabel="time in min", ylabel="temperature in °C", title="Temperatures at 15 000 /min")


def draw_errors(ax: Axes, machine: VirtualMachine, minutes: np.ndarray) -> None:
    """Draw the displacement at the end of the bar, and what it is without compensation."""
    t = minutes * MINUTE
    twist = machine.spindle_twist(t) * 1e6
    machine.start([Event(0, spindle_speed=15000, compensation={"X": False, "Y": False, "Z": False})])
    free = machine.spindle_twist(t) * 1e6
    for axis, name in enumerate("XYZ"):
        ax.plot(minutes, free[:, axis], color=COLOURS[name], lw=1, ls=(0, (4, 3)))
        ax.plot(minutes, twist[:, axis], color=COLOURS[name])
        ax.text(105.5, twist[-1, axis], f"E{name}", color=COLOURS[name], va="center", fontsize=9)
    ax.text(48, 41, "without compensation", rotation=33, color=COLOURS["Z"], fontsize=8, ha="center", va="center")
    ax.annotate(
        "Z off at 101 min,\nY off at 102 min",
        (100.6, 30),
        (62, 22),
        fontsize=8,
        arrowprops={"arrowstyle": "-", "color": GREY},
    )
    ax.set(xlim=(0, 104), xlabel="time in min", ylabel="displacement in µm", title="True error at the end of the bar")


def draw_samples(ax: Axes, machine: VirtualMachine) -> None:
    """Draw two turns of one sensor, at 20 kHz."""
    rate, n = 20000.0, 160
    first = int(60 * rate)
    reading = machine.distances(first, n, rate, ["X1"])[0]
    still = machine.still_readings((first + np.arange(n)) / rate)[0]
    time = np.arange(n) / rate * 1e3
    ax.plot(time, (reading - still) * 1e6, ".-", color=BLUE, lw=0.6, ms=3)
    ax.axhline(0, color=GREY, lw=0.8)
    ax.set(xlabel="time in ms", ylabel="X1 less its mean in µm", title="Runout, texture and noise in two turns")


def draw_sphere(ax: Axes, machine: VirtualMachine) -> None:
    """Draw a stepped sphere as one sensor sees it."""
    frame = machine.frame
    middle = frame.nominal_origin[0] + (1e-3 + machine.sphere_radius) * frame.nominal_direction[0]
    program = StepProgram(middle - [0, 1e-3, 0], (0, 1, 0), 20e-6, 101)
    rate = 100.0
    reading = machine.distances(0, int(program.end * rate), rate, ["X1"], "sphere", program)[0] * 1e3
    time = np.arange(reading.size) / rate
    ax.plot(time, reading, color=BLUE, lw=1)
    ax.set(xlabel="time in s", ylabel="X1 in mm", title="A sphere stepped through a beam")
    detail = ax.inset_axes((0.33, 0.5, 0.36, 0.42))
    near = (time > 20) & (time < 25)
    detail.plot(time[near], reading[near], color=BLUE, lw=1)
    detail.tick_params(labelsize=7)
    ax.indicate_inset_zoom(detail, edgecolor=GREY)


def draw_geometry(ax: Axes, machine: VirtualMachine) -> None:
    """Draw the straightness and positioning errors of the X axis."""
    x = np.linspace(*machine.travel["X"], 200)
    truth = machine.truth_axis("X", x)
    lowest = np.inf
    for name in sorted(COLOURS, key=lambda name: -truth[f"E{name}"].values[-1]):
        curve = truth[f"E{name}"].values * 1e6
        ax.plot(x * 1e3, curve, color=COLOURS[name])
        lowest = min(curve[-1], lowest - 0.7)  # the labels keep their distance
        ax.text(x[-1] * 1e3 + 8, lowest, f"E{name}X", color=COLOURS[name], va="center", fontsize=9)
    ax.set(xlabel="x in mm", ylabel="error in µm", title="Geometric errors of the X axis")


def main() -> None:
    """Draw and save."""
    plt.rcParams.update({"font.size": 9, "axes.titlesize": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure, axes = plt.subplots(2, 3, figsize=(13, 7.2), layout="constrained")
    minutes = np.unique(np.concatenate([np.linspace(0, 104, 500), 101 + np.linspace(0, 1.02, 103)]))
    draw_frame(axes[0, 0], demonstration())
    draw_temperatures(axes[0, 1], demonstration(), minutes)
    draw_errors(axes[0, 2], demonstration(), minutes)
    draw_samples(axes[1, 0], demonstration())
    draw_sphere(axes[1, 1], demonstration())
    draw_geometry(axes[1, 2], demonstration())
    figure.get_layout_engine().set(w_pad=0.12, h_pad=0.12)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    main()
