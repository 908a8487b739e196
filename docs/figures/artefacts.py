"""Draw docs/figures/artefacts.png: what the line profiler sees on the virtual gantry."""

from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from errormotion.methods.crossbeam_scan import simulation
from errormotion.twin import VirtualMachine
from errormotion.twin.artefacts.pieces import circular_pocket, swept
from errormotion.twin.sensors.profiler import Disturbances, Profiler

BLUE, ORANGE, GREEN, PURPLE, RED, GREY = "#1f5a96", "#d9822b", "#2e8b57", "#7b4fa3", "#c0392b", "#8a8f98"
COLOURS = {"EX": BLUE, "EY": ORANGE, "EZ": GREEN, "EA": PURPLE, "EB": RED, "EC": GREY}
WARM = 180 * 60.0
PERFECT = Disturbances.none()


def draw_artefact(figure: Figure, ax: Axes) -> None:
    """Draw the free form as a map of heights, with the place of a scan."""
    artefact = swept()
    x, y = (np.linspace(-half, half, 300) for half in artefact.half_size)
    z = artefact.height(x[:, None], y).T * 1e3
    picture = ax.contourf(x * 1e3, y * 1e3, z, 24, cmap="viridis")
    figure.colorbar(picture, ax=ax, label="height in mm", ticks=[-3, -2, -1, 0, 1, 2, 3])
    ax.plot([-20, 20, 20, -20, -20], [-28, -28, 28, 28, -28], color="white", lw=1, ls=(0, (5, 3)))
    ax.set(aspect="equal", xlabel="x in mm", ylabel="y in mm (feed)", title="A swept free form, and the scan on it")


def draw_disturbances(ax: Axes) -> None:
    """Draw what one real profile has too much, at the edge of a narrow artefact."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 1, 3] = 70e-6
    artefact = swept((18e-3, 30e-3))
    real = Profiler(disturbances=Disturbances(outliers=0.015, missing=0.015)).scan(artefact, poses, key=(15,))[0]
    true = Profiler(disturbances=PERFECT).scan(artefact, poses)[0]
    x = Profiler().x * 1e3
    shown = (x > 16.6) & (x < 18.1)
    off = (real - true)[shown] * 1e6
    off_scale = np.abs(off) > 60
    ax.plot(x[shown], np.where(off_scale, np.nan, off), ".", color=BLUE, ms=3)
    ax.plot(x[shown][off_scale], 24 * np.sign(off[off_scale]), "^", color=RED, ms=6)
    lost = np.isnan(real[shown]) & np.isfinite(true[shown])
    ax.plot(x[shown][lost], np.full(lost.sum(), -9.0), "|", color=ORANGE, ms=9)
    ax.axvline(18, color=GREY, lw=0.8)
    ax.text(17.85, 17, "stray light\nat the edge", ha="right", va="center", fontsize=8)
    ax.text(16.6, -13, "no reading", color=ORANGE, fontsize=8)
    ax.text(16.6, -24.5, "ambient light (off scale)", color=RED, fontsize=8)
    ax.text(16.6, 4, "noise, speckle, jitter of the line", color=BLUE, fontsize=8)
    ax.set(ylim=(-30, 32), xlabel="x in mm", ylabel="reading less truth in µm", title="One real profile at an edge")


def draw_change(figure: Figure, ax: Axes, machine: VirtualMachine) -> None:
    """Draw how the heights of one artefact change as the machine warms up."""
    profiler = Profiler(400, 100e-6, disturbances=PERFECT)
    poses = []
    for t in (0.0, WARM):
        y = 0.5 + np.linspace(-0.028, 0.028, 300)
        carriage = machine.crossbeam.carriage(t, y, 0.5, "axis")
        poses.append(machine.crossbeam.lines(carriage, machine.crossbeam.artefact_pose(machine.seed, 0.5)))
    cold, warm = (profiler.scan(swept(), p) for p in poses)
    change = (warm - cold) * 1e6
    most = np.nanmax(np.abs(change))
    extent = (profiler.x[0] * 1e3, profiler.x[-1] * 1e3, -28, 28)
    picture = ax.imshow(change, origin="lower", extent=extent, cmap="RdBu_r", vmin=-most, vmax=most)
    figure.colorbar(picture, ax=ax, label="change of height in µm")
    ax.set(xlabel="x in mm", ylabel="y in mm", title="The same scan after 3 h, less the cold one")


def pocket_scan(machine: VirtualMachine) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, heights (line, point) and the feed of a real scan of the pocket."""
    feed = (np.arange(400) - 199.5) * 70e-6 - machine.crossbeam.pose[1, 3]
    poses = machine.crossbeam.pocket_lines(feed, 0.174)
    return Profiler().x, Profiler().scan(circular_pocket(), poses, key=(3, 0)), feed


def draw_pocket(figure: Figure, ax: Axes, machine: VirtualMachine) -> None:
    """Draw the pocket as it is scanned."""
    x, z, feed = pocket_scan(machine)
    level = z[::4, ::8]
    picture = ax.pcolormesh(x[::8] * 1e3, feed[::4] * 1e3, level * 1e3, cmap="viridis", vmin=-6.5, vmax=-0.5)
    figure.colorbar(picture, ax=ax, label="height in mm")
    ax.set(aspect="equal", xlabel="x in mm", ylabel="feed in mm", title="Circular pocket for the profiler's pose")


def draw_rim(ax: Axes, machine: VirtualMachine) -> None:
    """Draw the points of a profile at the rim, without and with losses."""
    feed = np.array([0.0, 70e-6])
    for disturbances, colour, size, label in ((PERFECT, GREY, 5, "perfect"), (Disturbances(), BLUE, 3, "real")):
        profiler = Profiler(disturbances=disturbances)
        z = profiler.scan(circular_pocket(), machine.crossbeam.pocket_lines(feed, 0.174), key=(8, 0))[0]
        if colour == GREY:
            left, step = profiler.x[:1600], np.argmin(np.diff(z[:1600]))
            top = z[step - 8]
            rim = np.interp(top - 2.5e-3, z[:1600][::-1], left[::-1])
        ax.plot((profiler.x - rim) * 1e6, (z - top) * 1e3, "o-", color=colour, ms=size, lw=0.8, label=label)
    ax.axvline(0, color=ORANGE, lw=1)
    ax.text(4, -0.4, "rim", color=ORANGE, fontsize=9)
    ax.legend(frameon=False, loc="upper right")
    ax.set(xlim=(-110, 110), xlabel="x from the rim in µm", ylabel="height in mm", title="A spot of 12 µm on the rim")


def draw_crossbeam(ax: Axes, machine: VirtualMachine) -> None:
    """Draw the six thermal errors along the crossbeam after three hours."""
    y = np.linspace(-0.8, 0.8, 200)
    truth = simulation.truth_axis(machine, [WARM], y).isel(time=0)
    lowest = np.inf
    for name in sorted(COLOURS, key=lambda name: -float(truth[name][-1])):
        curve = truth[name].values * 1e6
        ax.plot(y * 1e3, curve, color=COLOURS[name], ls="-" if name[1] in "XYZ" else "--")
        lowest = min(curve[-1], lowest - 4)
        ax.text(830, lowest, f"{name}Y", color=COLOURS[name], va="center", fontsize=9)
    ax.axhline(0, color="black", lw=0.5)
    ax.set(
        xlim=(-800, 1000),
        xlabel="position of Y in mm",
        ylabel="µm (full), µrad (dashed)",
        title="True errors after 3 h",
    )


def main() -> None:
    """Draw and save."""
    plt.rcParams.update({"font.size": 9, "axes.titlesize": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure, axes = plt.subplots(2, 3, figsize=(13, 7.6), layout="constrained")
    machine = VirtualMachine("gantry", seed=3)
    draw_artefact(figure, axes[0, 0])
    draw_disturbances(axes[0, 1])
    draw_change(figure, axes[0, 2], machine)
    draw_pocket(figure, axes[1, 0], machine)
    draw_rim(axes[1, 1], machine)
    draw_crossbeam(axes[1, 2], machine)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    main()
