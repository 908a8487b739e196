"""Draw docs/figures/r_test.png: the set-up of an R-test, its error motions, and what a displaced line does."""

from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np

from errormotion.methods.r_test import RTest, RTestSettings

BLUE, ORANGE, GREY = "#1f5a96", "#d9822b", "#8a8f98"


def draw_setup(ax) -> None:
    """Draw the table from above, two positions of the spheres, and the nest at one of them."""
    circle = np.linspace(0, 2 * np.pi, 200)
    ax.plot(160 * np.cos(circle), 160 * np.sin(circle), color=GREY, lw=1)
    ax.plot(120 * np.cos(circle), 120 * np.sin(circle), color=GREY, lw=0.5, ls=":")
    for turn, style in ((0.0, {"color": BLUE}), (-30.0, {"mfc": "none", "mec": BLUE})):
        q = np.radians([0, 120, 240]) + np.radians(turn)
        ax.plot(120 * np.cos(q), 120 * np.sin(q), "o", ms=9, ls="", **style)
    for k in np.radians([10, 130, 250]):
        tip = np.array([120.0, 0.0]) + 16 * np.array([np.cos(k), np.sin(k)])
        tail = np.array([120.0, 0.0]) + 46 * np.array([np.cos(k), np.sin(k)])
        ax.annotate("", tip, tail, arrowprops={"arrowstyle": "-|>", "color": ORANGE, "lw": 1.4})
    ax.text(0, -24, "axis C", ha="center")
    ax.plot(0, 0, "+", color="#222222", ms=8)
    ax.text(70, 42, "nest of sensors", color=ORANGE, ha="center")
    ax.annotate(
        "", (-112, 88), (-72, 122), arrowprops={"arrowstyle": "<|-", "color": GREY, "connectionstyle": "arc3,rad=0.2"}
    )
    ax.text(0, 172, "command q: the table turns by -q", ha="center", fontsize=7)
    ax.set(aspect="equal", xlabel="x / mm", ylabel="y / mm", xlim=(-180, 190), ylim=(-180, 195))


def main() -> None:
    """Simulate, identify and draw."""
    method, settings = RTest(), RTestSettings()
    raw, truth = method.simulate(settings, 4)
    errors = method.identify(raw, settings)
    angle = np.degrees(errors["angle"].values)
    plt.rcParams.update({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False})
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(9.6, 3.2), layout="constrained")
    draw_setup(left)
    for ax, name, label, scale in ((middle, "EX", "EXC / µm", 1e6), (right, "EC", "ECC / µrad", 1e6)):
        k = ("EX", "EC").index(name) * 5
        u = np.sqrt(errors["covariance"].values[:, k, k])
        value = errors[name].values
        ax.fill_between(angle, scale * (value - 1.96 * u), scale * (value + 1.96 * u), color=BLUE, alpha=0.25, lw=0)
        ax.plot(angle, scale * value, color=BLUE, lw=1, label="R-test, 95 %")
        ax.plot(angle, scale * truth[name].values, ".", color=ORANGE, ms=4, label="truth")
        ax.set(xlabel="angle of C / deg", ylabel=label, xticks=range(0, 361, 90))
    middle.legend(frameon=False, loc="upper right")
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=150)


if __name__ == "__main__":
    main()
