"""Draw docs/figures/multilateration.png: a volume's error vectors, deviations from the truth, and one axis."""

import os
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr

from errormotion.methods.multilateration import Multilateration, simulation
from errormotion.twin import VirtualMachine

BLUE, ORANGE, GREY = "#1f5a96", "#d9822b", "#8a8f98"
SEEDS = range(20)
LARGER = 8000
ERRORS = ("EX", "EY", "EZ")


def vectors(ds: xr.Dataset) -> np.ndarray:
    """Return the displacements (target, 3), m."""
    return np.stack([ds[name].values for name in ERRORS], axis=-1)


def draw_volume(ax, found: xr.Dataset) -> None:
    """Draw stations and enlarged error vectors in space."""
    place, station = 1e3 * found["target_nominal"].values, 1e3 * found["station_place"].values
    error = 1e3 * LARGER * vectors(found)
    long = np.linalg.norm(error, axis=1) > 0.5 * np.linalg.norm(error, axis=1).max()
    for chosen, colour in ((~long, BLUE), (long, ORANGE)):
        ax.quiver(*place[chosen].T, *error[chosen].T, color=colour, lw=1.2, arrow_length_ratio=0.25)
    for k in range(0, len(place), 9):
        for U in station:
            ax.plot(*np.stack([U, place[k]], axis=1), color=GREY, lw=0.25, alpha=0.6)
    ax.plot(*station.T, "o", color="#222222", ms=4)
    for name, U in zip(found["station"].values, station, strict=True):
        ax.text(*(U + 25), str(name), fontsize=7)
    ax.set_xlabel("x / mm", labelpad=-4)
    ax.set_ylabel("y / mm", labelpad=-4)
    ax.set_zlabel("z / mm", labelpad=-4)
    ax.set(xticks=(-300, 0, 300), yticks=(-300, 0, 300), zticks=(0, 200, 400))
    ax.tick_params(labelsize=6, pad=-2)
    ax.view_init(22, -60)
    ax.set_box_aspect((1, 1, 0.8), zoom=0.92)


def main() -> None:
    """Measure and draw."""
    machine, method = VirtualMachine("cframe", seed=3), Multilateration()
    results = [method.identify(simulation.raw(machine, seed=seed)) for seed in SEEDS]
    truth = vectors(simulation.true_errors(machine, simulation.target_grid(machine)))
    off = [
        (vectors(ds) - truth) / np.sqrt(np.diagonal(ds["covariance"].values, axis1=1, axis2=2))[:, :3] for ds in results
    ]
    plt.rcParams.update({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False})
    figure = plt.figure(figsize=(9.6, 3.2))
    draw_volume(figure.add_axes((0.0, 0.02, 0.36, 0.95), projection="3d"), results[0])
    ax = figure.add_axes((0.45, 0.17, 0.22, 0.72))
    ax.hist(np.concatenate(off).ravel(), np.linspace(-4, 4, 41), density=True, color=BLUE, alpha=0.55)
    x = np.linspace(-4, 4, 200)
    ax.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color="#222222", lw=1)
    ax.set(xlabel="deviation from the truth / stated uncertainty", yticks=[])
    ax.set_title("Targets, against the normal distribution", fontsize=9)
    ax = figure.add_axes((0.74, 0.17, 0.24, 0.72))
    one = results[0]
    q, value, u = (1e3 * one["Z_position"], 1e6 * one["EZZ"], 2e6 * one["EZZ_u"])
    ax.fill_between(q, value - u, value + u, color=BLUE, alpha=0.2, lw=0)
    ax.plot(q, value, color=BLUE, lw=1.2)
    true = 1e6 * machine.truth_axis("Z", one["Z_position"].values)["EZ"].values
    ax.plot(q, true - true.mean(), "--", color="#222222", lw=1)
    ax.set(xlabel="Z / mm", ylabel="µm")
    ax.set_title("EZZ with its band, truth dashed", fontsize=9)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=150)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
