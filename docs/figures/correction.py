"""Draw docs/figures/correction.png: what a correction leaves along a diagonal, and where it is held."""

from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np

from errormotion.compensation.correction import correction
from errormotion.datasets.schemas import DOF
from errormotion.twin import VirtualMachine

BLUE, ORANGE, GREY = "#1f5a96", "#d9822b", "#8a8f98"
NOISE = 0.5e-6


def main() -> None:
    machine = VirtualMachine("cframe", 3)
    low, high = np.array([machine.travel[axis] for axis in "XYZ"]).T
    middle, half = (low + high) / 2, 0.8 * (high - low) / 2
    lines = [np.linspace(m - h, m + h, 7) for m, h in zip(middle, half, strict=True)]
    nodes = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    ds = machine.volumetric_truth(nodes).load()
    rng = np.random.default_rng(1)
    C = np.zeros((len(nodes), 6, 6))
    C[:, range(3), range(3)] = NOISE**2
    for name in DOF[:3]:
        ds[name] = ds[name] + NOISE * rng.normal(size=len(nodes))
    ds["covariance"] = (ds["covariance"].dims, C)
    share = np.linspace(0, 1, 801)
    way = low + share[:, None] * (high - low)
    found = correction(ds).at(way, covariance=True)
    assert found.covariance is not None
    before = machine.geometry.twist(way)[:, :3]
    after = found.offset + machine.geometry.twist(way + found.offset)[:, :3]
    u = 2 * np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    s = 1e3 * share * np.linalg.norm(high - low)
    fig, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    k = 0
    for ax in axes:
        ax.axvspan(s[0], s[found.valid][0], color=GREY, alpha=0.15, lw=0)
        ax.axvspan(s[found.valid][-1], s[-1], color=GREY, alpha=0.15, lw=0, label="outside: held and flagged")
        ax.axhline(0, color="#222222", lw=0.6)
        ax.set_xlabel("way along the diagonal of the volume / mm")
        ax.set_xlim(s[0], s[-1])
    axes[0].plot(s, 1e6 * before[:, k], color=ORANGE, label="error EX without correction")
    axes[0].plot(s, -1e6 * found.offset[:, k], color=BLUE, lw=1, label="correction, opposite sign")
    axes[0].set_ylabel("µm")
    axes[0].set_title("Error and correction", fontsize=10)
    axes[1].fill_between(s, -1e6 * u[:, k], 1e6 * u[:, k], color=BLUE, alpha=0.2, lw=0, label="stated, k = 2")
    axes[1].plot(s, 1e6 * after[:, k], color=BLUE, lw=1.2, label="true error that remains")
    axes[1].set_ylabel("µm")
    axes[1].set_title("What remains", fontsize=10)
    for ax in axes:
        ax.legend(fontsize=8)
    fig.savefig(Path(__file__).with_suffix(".png"), dpi=130)


if __name__ == "__main__":
    main()
