"""The architecture as a drawing: layers of the package, and what each may import."""

from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.patches import FancyBboxPatch

LAYERS = [
    [("cli", "the command errormotion")],
    [("dashboard", "pages in a browser")],
    [("record", "runs of a machine")],
    [("campaign", "benches, tests, runs")],
    [("compensation", "thermal models")],
    [("compare", "agreement of several results")],
    [("testing", "conformance kit for plugins")],
    [("montecarlo", "uncertainty by JCGM 101")],
    [("methods", "one folder a method"), ("instruments", "one folder a kind, a device")],
    [("report", "elements of chapters")],
    [("tolerances", "limits and decisions")],
    [("twin", "virtual machines, artefacts, sensors")],
    [("measurement", "a method as a model, stated once")],
    [("datasets", "schemas, units, provenance, files")],
    [("plugins", "contracts and registry")],
    [("kinematics", "poses, twists, chains, fits")],
    [("estimation", "least squares, covariances, extremes")],
]
COLOURS = ("#dbe9f6", "#e8eef4")


def main() -> None:
    figure, axes = plt.subplots(figsize=(7.6, 11.3), dpi=130)
    height, gap = 0.78, 0.22
    for level, row in enumerate(reversed(LAYERS)):
        width = 8.0 / len(row)
        for k, (name, text) in enumerate(row):
            x, y = k * width + 0.06, level * (height + gap)
            box = FancyBboxPatch(
                (x, y),
                width - 0.12,
                height,
                boxstyle="round,pad=0,rounding_size=0.08",
                fc=COLOURS[level % 2],
                ec="#5b7083",
            )
            axes.add_patch(box)
            axes.text(
                x + (width - 0.12) / 2, y + 0.52, name, ha="center", va="center", fontweight="bold", fontsize=10.5
            )
            axes.text(x + (width - 0.12) / 2, y + 0.22, text, ha="center", va="center", fontsize=8.5, color="#33424f")
    top = len(LAYERS) * (height + gap)
    axes.annotate("", (8.45, 0.1), (8.45, top - 0.3), arrowprops={"arrowstyle": "-|>", "color": "#5b7083", "lw": 1.6})
    axes.text(8.62, top / 2, "imports", rotation=-90, va="center", ha="left", fontsize=9.5, color="#33424f")
    axes.text(
        4.0,
        -0.42,
        "plugins of other distributions enter beside methods and instruments, through the registry",
        ha="center",
        fontsize=8.5,
        style="italic",
        color="#33424f",
    )
    axes.set(xlim=(-0.1, 9.0), ylim=(-0.6, top))
    axes.axis("off")
    figure.savefig(Path(__file__).with_suffix(".png"), bbox_inches="tight")


if __name__ == "__main__":
    main()
