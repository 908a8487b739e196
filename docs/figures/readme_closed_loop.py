"""Draw docs/figures/readme_closed_loop.png: a warm-up of the virtual machine without and with compensation."""

from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from errormotion.cli.demo.closed_loop import WarmUp, close
from errormotion.cli.demo.compensated import FURTHER, SEED, TRAINING
from errormotion.compensation.effect.text import percent
from errormotion.twin import VirtualMachine

FREEDOMS = ("EX", "EY", "EZ")
SHOWN = {"without compensation": "#c8553d", "with compensation": "#1f5a96"}
TRUTH = "#8a8f98"


def draw(axes: Axes, warm_up: WarmUp, k: int) -> None:
    """Draw one displacement without and with compensation: as probed with U, over the truth."""
    name, found = FREEDOMS[k], warm_up.effect
    hours = found.ground.coords["time"].values / 3600
    axes.axhline(0, color="#444444", lw=0.6)
    for values in (warm_up.true_before, warm_up.true_after):
        axes.plot(warm_up.time / 3600, 1e6 * values[:, k], color=TRUTH, lw=3.5, alpha=0.45, zorder=0)
    for estimate, colour in zip(found.ground.estimates, SHOWN.values(), strict=True):
        U = 2e6 * np.sqrt(estimate.variance()[:, k])
        axes.errorbar(
            hours, 1e6 * estimate.value[:, k], U, fmt="o", ms=3.2, lw=1.1, capsize=1.8, color=colour, zorder=3
        )
    axes.set(title=f"{name} of the tool, µm: {percent(found.part(name).reduction.value)} less", xlim=(0, 3.05))


def main() -> None:
    """Close the loop, draw its second warm-up, and save."""
    machine = VirtualMachine("cframe", seed=SEED)
    warm_up = close(machine, TRAINING, FURTHER[:1]).warm_ups[0]
    plt.rcParams.update({"font.size": 10, "axes.titlesize": 11, "axes.spines.top": False, "axes.spines.right": False})
    figure, axes = plt.subplots(2, 3, figsize=(10, 4.4), height_ratios=(3.2, 1), sharex=True, layout="constrained")
    for k in range(3):
        draw(axes[0, k], warm_up, k)
    time = warm_up.offsets.time / 3600
    for axis, strip, values in zip("XYZ", axes[1], warm_up.offsets.offset.T, strict=True):
        strip.plot(time, 1e6 * values, color=SHOWN["with compensation"], lw=1.1)
        strip.set(xlabel="hours of warm-up", ylabel=f"{axis} offset, µm")
    handles = [
        Line2D([], [], color=colour, lw=1.4, marker="o", ms=4, label=f"{name}, probed, with $U$ (95 %)")
        for name, colour in SHOWN.items()
    ]
    handles.append(Line2D([], [], color=TRUTH, lw=4, alpha=0.45, label="truth of the virtual machine"))
    figure.legend(handles=handles, loc="outside upper center", ncols=3, frameon=False)
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.06)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    main()
