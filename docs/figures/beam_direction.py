"""Draw docs/figures/beam_direction.png: beams with and without compensation against the truth, a bar seen by both."""

import os
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from errormotion.datasets.calibrations.inclination import InclinationCalibration
from errormotion.kinematics.beams import across
from errormotion.methods.beam_direction import BeamDirection, simulation
from errormotion.methods.beam_direction.identification.check_bar.measure import measure_bar
from errormotion.methods.beam_direction.identification.inclination.calibrate import calibrate
from errormotion.methods.beam_direction.settings import BeamDirectionSettings
from errormotion.twin import VirtualMachine

BLUE, ORANGE, GREY = "#1f5a96", "#d9822b", "#8a8f98"
ARCSEC = np.pi / 180 / 3600
FACES = [(25.0, 0.0), (35.5, 120.6), (35.5, 239.4)]
SEEDS = range(60)
CIRCLE = np.linspace(0, 2 * np.pi, 91)


def measured(machine: VirtualMachine, folder: Path) -> tuple[list, list]:
    """Return the results of many measurements on the same faces, compensated and not."""
    calibrate(simulation.raw_inclination(machine, seed=1)).save(folder / "lk-h050.nc")
    faces = [(np.radians(a), np.radians(b)) for a, b in FACES]
    raws = [simulation.raw(machine, faces, seed=seed, speckle=True) for seed in SEEDS]
    method = BeamDirection()
    with_it, without = (BeamDirectionSettings(compensation=name) for name in (str(folder / "lk-h050.nc"), None))
    return [method.identify(raw, with_it) for raw in raws], [method.identify(raw, without) for raw in raws]


def draw_tips(ax: Axes, found: list, true: np.ndarray, colour: str, label: str) -> None:
    """Draw where the beams point, seen along the true one."""
    tips = np.array([across(true) @ e["beam_direction"].values[0] for e in found]) / ARCSEC
    ax.plot(*tips.T, ".", color=colour, ms=4, alpha=0.7, mew=0, label=label)


def draw_region(ax: Axes, one, true: np.ndarray) -> None:
    """Draw the region about the truth in which 95 % should lie, by the covariance that one result states."""
    C = across(true) @ one["beam_covariance"].values[0][3:, 3:] @ across(true).T
    values, vectors = np.linalg.eigh(C)
    size = np.sqrt(5.991 * values)  # 95 % of chi-square with two degrees of freedom
    outline = vectors @ (size[:, None] * np.stack([np.cos(CIRCLE), np.sin(CIRCLE)])) / ARCSEC
    ax.fill(*outline, color=BLUE, alpha=0.13, lw=0)
    ax.plot(*outline, color=BLUE, lw=1)


def draw_bar(ax: Axes, machine: VirtualMachine, beams: list, calibrations: list) -> None:
    """Draw the residuals of a check bar as each beam sees it."""
    scan = simulation.raw_check_bar(machine, seed=2)
    for errors, calibration, colour in zip(beams, calibrations, (ORANGE, BLUE), strict=True):
        where = [errors[name].values[0] for name in ("beam_origin", "beam_direction", "beam_covariance")]
        points, bar = measure_bar(scan, *where, calibration=calibration)
        place = points.points - bar.centre
        angle = np.degrees(np.arctan2(place[:, 0], place[:, 2]))
        ax.plot(angle, bar.residuals * 1e6, ".-", color=colour, lw=1, ms=4)
        out = list(bar.left_out)
        ax.plot(angle[out], bar.residuals[out] * 1e6, "x", color="#222222", ms=5)
        label = f"r = {bar.free_radius * 1e3:.4f} mm"
        ax.text(0.97, 0.4 if colour == ORANGE else 0.32, label, color=colour, transform=ax.transAxes, ha="right")
    ax.axhline(0, color=GREY, lw=0.8)
    ax.text(0.97, 0.24, "× left out", transform=ax.transAxes, ha="right")
    ax.set(xlabel="azimuth on the bar in °", ylabel="residual in µm")
    ax.set_title("A bar of 25.0000 mm, seen by both", fontsize=9)


def main() -> None:
    """Measure and draw."""
    machine = VirtualMachine("cframe", seed=3)
    with tempfile.TemporaryDirectory() as folder:
        compensated, plain = measured(machine, Path(folder))
        calibration = InclinationCalibration.load(Path(folder) / "lk-h050.nc")
    true = machine.point_sensor.true_direction
    plt.rcParams.update({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False})
    figure, (far, near, bar) = plt.subplots(1, 3, figsize=(9.6, 3.1), layout="constrained")
    draw_tips(far, plain, true, ORANGE, "readings as they are")
    draw_tips(far, compensated, true, BLUE, "compensated")
    far.set_title(f"{len(SEEDS)} measurements of one beam", fontsize=9)
    far.legend(frameon=False, loc="lower right", handletextpad=0.2)
    draw_region(near, compensated[0], true)
    draw_tips(near, compensated, true, BLUE, "")
    near.set_title("The compensated ones, and the 95 % stated", fontsize=9)
    for ax in (far, near):
        ax.plot(0, 0, "+", color="#222222", ms=9)
        ax.set(aspect="equal", xlabel="off the true beam in arcsec", ylabel="off the true beam in arcsec")
        ax.set_adjustable("datalim")
    draw_bar(bar, machine, [plain[0], compensated[0]], [None, calibration])
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=150)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
