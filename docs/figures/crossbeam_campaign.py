"""Draw docs/figures/crossbeam_campaign.png: a campaign on the virtual gantry beside its truth."""

from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from errormotion.datasets import DOF
from errormotion.methods.crossbeam_scan import CrossbeamScan, simulation
from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings
from errormotion.twin import VirtualMachine
from errormotion.twin.sensors.profiler import Profiler

COLOURS = {7: "#7fb0dd", 30: "#2e8b57", 180: "#d9822b"}  # drawn, by minutes
GREY = "#8a8f98"
PLACES = np.arange(-0.7, 0.71, 0.2)
MINUTES = [0, 7, 30, 60, 120, 180]


def measured(machine: VirtualMachine) -> xr.Dataset:
    """Return the errors of a campaign: the pose from a pocket, then scans of eight artefacts at six times."""
    method = CrossbeamScan()
    pose = method.identify(simulation.raw_pocket(machine, seed=1))
    raw = simulation.raw_scans(
        machine,
        60.0 * np.array(MINUTES),
        PLACES,
        seed=1,
        profiler=Profiler(1600, 25e-6),
        pose=pose["profiler_pose"].values,
    ).assign(
        pose_covariance=(("p", "p_"), pose["pose_covariance"].values),
        lever_uncertainty=("direction", np.full(3, 1e-3), {"units": "m"}),
    )
    return method.identify(raw, CrossbeamScanSettings(strain="guided"))


def truth(machine: VirtualMachine, seconds, place, point) -> np.ndarray:
    """Return the true errors (..., 6) at a point that hangs off the carriage, m and rad."""
    twist = machine.crossbeam.twist(seconds, place)
    twist[..., :3] += np.cross(twist[..., 3:], point)
    return twist


def draw_freedom(ax: Axes, errors: xr.Dataset, machine: VirtualMachine, i: int) -> None:
    """Draw one freedom of the carriage over position: points, smooth curve with its band, truth."""
    fine = np.linspace(PLACES[0], PLACES[-1], 200)
    for minute, colour in COLOURS.items():
        one = errors.isel(time=MINUTES.index(minute))
        known = truth(machine, 60.0 * minute, fine, np.zeros(3))[:, i]
        curve, u = (one[name].values[:, i] for name in ("smooth_position", "smooth_position_u"))
        band = np.array([curve - 2 * u, curve + 2 * u])
        ax.fill_between(one.place, *band * 1e6, color=colour, alpha=0.25, lw=0)
        ax.plot(one.place, curve * 1e6, color=colour, lw=1.2)
        ax.plot(one.y, one[DOF[i]].values * 1e6, "o", color=colour, ms=3.5)
        ax.plot(fine, known * 1e6, "--", color="#222222", lw=0.9)
    ax.set(title=f"{errors.em.iso_names()[DOF[i]]}", ylabel="µm" if i < 3 else "µrad")
    ax.axhline(0, color=GREY, lw=0.6, zorder=0)


def draw_tool(ax: Axes, errors: xr.Dataset, machine: VirtualMachine) -> None:
    """Draw EYY at the tool, with error bars, and the truth."""
    point = errors["lever"].values
    there = errors.em.at(point)
    fine = np.linspace(PLACES[0], PLACES[-1], 200)
    for minute, colour in COLOURS.items():
        one = there.isel(time=MINUTES.index(minute))
        U = one.em.expanded().sel(dof="EY").values
        ax.errorbar(one.y, one.EY * 1e6, U * 1e6, fmt="o", color=colour, ms=3.5, capsize=2)
        ax.plot(fine, truth(machine, 60.0 * minute, fine, point)[:, 1] * 1e6, "--", color="#222222", lw=0.9)
    ax.axhline(0, color=GREY, lw=0.6, zorder=0)
    ax.set(title="EYY moved to the tool", ylabel="µm")


def draw_check(ax: Axes, errors: xr.Dataset, machine: VirtualMachine) -> None:
    """Draw how far all points are off the truth, in their stated standard uncertainty."""
    warm = errors.isel(time=slice(1, None))
    known = truth(machine, warm["scan_time"].values, warm.y.values, np.zeros(3))
    off = (warm.em.twist().values - known) / warm.em.expanded(k=1).values
    ax.hist(off.ravel(), np.arange(-4, 4.1, 0.5), density=True, color=GREY, alpha=0.6)
    z = np.linspace(-4, 4, 200)
    ax.plot(z, np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi), color="#222222", lw=1)
    inside = np.mean(np.abs(off) < 2)
    ax.set(title=f"{off.size} points: {inside:.0%} within k = 2", xlabel="(measured - true) / u", yticks=[])


def main() -> None:
    """Draw and save."""
    plt.rcParams.update({"font.size": 9, "axes.titlesize": 10, "axes.spines.top": False, "axes.spines.right": False})
    machine = VirtualMachine("gantry", seed=3)
    errors = measured(machine)
    figure, axes = plt.subplots(2, 4, figsize=(13, 5.8), layout="constrained")
    for i, ax in enumerate(axes[:, :3].flat):
        draw_freedom(ax, errors, machine, i)
    draw_tool(axes[0, 3], errors, machine)
    draw_check(axes[1, 3], errors, machine)
    for ax in [*axes[1, :3], axes[0, 3]]:
        ax.set_xlabel("position of the axis in m")
    for minute, colour in COLOURS.items():
        axes[0, 0].plot([], [], "o-", color=colour, ms=3.5, label=f"{minute} min")
    axes[0, 0].plot([], [], "--", color="#222222", lw=0.9, label="truth")
    axes[0, 0].legend(frameon=False, fontsize=8)
    figure.get_layout_engine().set(w_pad=0.1, h_pad=0.08)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    main()
