"""Draw docs/figures/registration.png: what the distance between two clouds says about the pose, and what does."""

from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from scipy.spatial import cKDTree

from errormotion.kinematics import poses
from errormotion.methods.crossbeam_scan.identification.registration import clouds, prepare, register
from errormotion.methods.crossbeam_scan.identification.registration.solver import Problem, State

BLUE, ORANGE, GREEN, GREY = "#1f5a96", "#d9822b", "#2e8b57", "#8a8f98"
PITCH_X, PITCH_Y, NOISE = 12.5e-6, 70e-6, 0.5e-6
ROWS, COLUMNS = 240, 960
X = (np.arange(COLUMNS) - COLUMNS / 2) * PITCH_X
Y = (np.arange(ROWS) - ROWS / 2) * PITCH_Y


def surface(x, y):
    """Waves with slopes up to 0.3 and their derivatives."""
    z, zx, zy = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
    for a, lx, ly, phase in [(0.5e-3, 17e-3, 40e-3, 0.3), (0.45e-3, -35e-3, 15e-3, 1.1), (0.12e-3, 9e-3, 11e-3, 2.0)]:
        kx, ky = 2 * np.pi / lx, 2 * np.pi / ly
        angle = kx * x + ky * y + phase
        z += a * np.sin(angle)
        zx += a * kx * np.cos(angle)
        zy += a * ky * np.cos(angle)
    return z, zx, zy


def scan(rng, twist):
    """Return a noisy scan by a profiler that has moved."""
    M = poses.displaced(twist).as_matrix()
    x, y = np.meshgrid(X, Y)
    z = np.zeros_like(x)
    for _ in range(10):
        P, Q, R = (M[i, 0] * x + M[i, 1] * y + M[i, 2] * z + M[i, 3] for i in range(3))
        S, Sx, Sy = surface(P, Q)
        z -= (R - S) / (M[2, 2] - Sx * M[0, 2] - Sy * M[1, 2])
    return (z + NOISE * rng.standard_normal(z.shape)).astype(np.float32), X, Y


def draw_distance(ax: Axes, cold, warm, twist) -> None:
    """Draw the distance to the nearest point along y through the true pose, and that from the surface."""
    tree = cKDTree(clouds.points_of(cold))
    some = clouds.points_of(warm)[::17]
    offsets = np.linspace(-120e-6, 120e-6, 121)
    block_maps = prepare(*cold), prepare(*warm)
    problem = Problem.of(*block_maps)
    nearest, height = [], []
    for offset in offsets:
        pose = poses.displaced(twist + np.array([0, offset, 0, 0, 0, 0]))
        nearest.append(np.sqrt(np.mean(tree.query(pose.apply(some))[0] ** 2)))
        height.append(np.sqrt(np.nanmean(problem.evaluate(State.of(pose)).residual ** 2)))
    ax.semilogy(offsets * 1e6, np.array(nearest) * 1e6, color=ORANGE)
    ax.semilogy(offsets * 1e6, np.array(height) * 1e6, color=BLUE)
    ax.axvline(0, color=GREY, lw=0.8)
    ax.text(60, 42, "to the nearest point", color=ORANGE, ha="center")
    ax.text(20, 0.3, "of blocks from\nthe surface", color=BLUE)
    ax.text(3, 90, "truth", color=GREY)
    ax.set(xlim=(-120, 120), ylim=(0.05, 130), xlabel="pose off the truth along y in µm", ylabel="rms distance in µm")
    ax.set_title("Distances between points are least off the truth")


def draw_ways(ax: Axes, pairs) -> None:
    """Draw stated rms against true error for some pairs and ways, with the stated uncertainty of ours."""
    ways = {
        "published chain": ("paper", ORANGE),
        "Open3D point-to-plane": ("open3d_plane", GREEN),
        "height map": ("height_map", BLUE),
    }
    for label, (backend, colour) in ways.items():
        found = [(register(prepare(*c), prepare(*w), registration=backend, point=np.zeros(3)), t) for c, w, t in pairs]
        rms = [r.rms * 1e6 for r, _ in found]
        error = [np.linalg.norm((r.twist - t)[:3]) * 1e6 for r, t in found]
        ax.loglog(rms, error, "o", color=colour, ms=6, mec="white", label=label)
        if backend == "height_map":
            stated = np.mean([np.sqrt(np.trace(r.covariance[:3, :3])) for r, _ in found]) * 1e6
            ax.axhline(stated, color=BLUE, lw=0.8, ls=(0, (4, 3)))
            ax.text(0.17, stated * 1.15, "its stated uncertainty", color=BLUE, fontsize=8)
    ax.legend(frameon=False, fontsize=8, loc="upper left")
    ax.set(
        xlim=(0.05, 170), ylim=(2e-3, 300), xlabel="rms that it states in µm", ylabel="true error of the shift in µm"
    )
    ax.set_title("Eight pairs of scans: a smaller rms is no better pose")


def draw_residual(figure, ax: Axes, cold, warm) -> None:
    """Draw the residual map of ours."""
    found = register(prepare(*cold), prepare(*warm))
    image = ax.pcolormesh(found.x * 1e3, found.y * 1e3, found.residual * 1e6, cmap="RdBu_r", vmin=-0.3, vmax=0.3)
    figure.colorbar(image, ax=ax, label="residual in µm", shrink=0.85)
    ax.set(aspect="equal", xlabel="x in mm", ylabel="y in mm", title="What is left is noise")


def main() -> None:
    """Draw and save."""
    plt.rcParams.update({"font.size": 9, "axes.titlesize": 10, "axes.spines.top": False, "axes.spines.right": False})
    rng = np.random.default_rng(4)
    pairs = []
    for _ in range(8):
        twist = np.concatenate([rng.uniform(-40e-6, 40e-6, 3), rng.uniform(-80e-6, 80e-6, 3)])
        pairs.append((scan(rng, np.zeros(6)), scan(rng, twist), twist))
    figure, axes = plt.subplots(1, 3, figsize=(13, 4.1), layout="constrained", width_ratios=[1, 1, 0.85])
    between = np.array([5e-6, 27e-6, 10e-6, 20e-6, -30e-6, 10e-6])
    draw_distance(axes[0], scan(rng, np.zeros(6)), scan(rng, between), between)
    draw_ways(axes[1], pairs)
    draw_residual(figure, axes[2], *pairs[0][:2])
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    main()
