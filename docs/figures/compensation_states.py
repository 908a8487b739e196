"""Draw docs/figures/compensation_states.png: the states of an online compensation, and what leads to another one."""

from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

PLACES = {
    "off": (0.3, 3.0),
    "armed": (3.0, 3.0),
    "following": (5.6, 3.0),
    "holding": (8.4, 3.0),
    "ramping": (5.6, 0.9),
    "fault": (8.4, 0.9),
}
COLOURS = {"following": "#2e8b57", "holding": "#d9a52b", "ramping": "#d9a52b", "fault": "#b23a3a"}
GREY = "#555b66"
WIDTH, HEIGHT = 1.25, 0.62
WAYS = (
    ("off", "armed", "--arm\nMACHINE", 0.0, (0.0, 0.28)),
    ("armed", "following", "valid\nprediction", 0.0, (0.0, 0.28)),
    ("following", "holding", "no valid prediction,\nor the machine is busy", -0.35, (0.0, 0.75)),
    ("holding", "following", "valid again", -0.3, (0.0, -0.52)),
    ("holding", "ramping", "longer than hold", 0.0, (0.68, -0.12)),
    ("ramping", "following", "valid for\nsettle", 0.0, (0.45, 0.1)),
    ("ramping", "armed", "zero", 0.0, (0.1, 0.22)),
    ("ramping", "off", "zero, after Ctrl-C", -0.25, (-0.95, -0.8)),
    ("holding", "fault", "stop, connection lost,\nforeign offset", 0.0, (0.85, 0.0)),
)

figure, axes = plt.subplots(figsize=(8.6, 3.7), layout="constrained")
for name, (x, y) in PLACES.items():
    colour = COLOURS.get(name, GREY)
    box = FancyBboxPatch(
        (x - WIDTH / 2, y - HEIGHT / 2), WIDTH, HEIGHT, boxstyle="round,pad=0.06", fc="white", ec=colour, lw=1.8
    )
    axes.add_patch(box)
    axes.text(x, y, name, ha="center", va="center", fontsize=11, color=colour, weight="bold")
for start, end, text, bend, (dx, dy) in WAYS:
    (x0, y0), (x1, y1) = PLACES[start], PLACES[end]
    arrow = FancyArrowPatch(
        (x0, y0),
        (x1, y1),
        connectionstyle=f"arc3,rad={bend}",
        arrowstyle="-|>",
        mutation_scale=13,
        shrinkA=36 if abs(x1 - x0) > 0.1 else 22,
        shrinkB=38 if abs(x1 - x0) > 0.1 else 24,
        color=GREY,
        lw=1.1,
    )
    axes.add_patch(arrow)
    axes.text((x0 + x1) / 2 + dx, (y0 + y1) / 2 + dy, text, ha="center", va="center", fontsize=8, color=GREY)
axes.text(8.4, 0.2, "also from armed, following, ramping", ha="center", fontsize=7.5, color=GREY, style="italic")
axes.set(xlim=(-0.6, 9.9), ylim=(0.0, 4.3))
axes.axis("off")
figure.savefig(Path(__file__).with_suffix(".png"), dpi=150)
