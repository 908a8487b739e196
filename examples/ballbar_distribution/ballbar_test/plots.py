"""Drawings of a circular test: the paths on the circle, and over the angle."""

import math

import numpy as np

from ballbar_test.path import TAU
from errormotion.report import canvas
from errormotion.report.document import Figure
from errormotion.report.text import fixed, rounded

INNER = 0.47
"""Radius of the innermost ring relative to the outermost."""
RINGS = 7
"""Largest number of divisions between the rings."""
STYLES = {"CCW": (canvas.BLUE, None), "CW": (canvas.VERMILLION, (5, 2))}
GREY, DARK = "#d8d8d8", "#555555"


def rings(values):
    """Return the deviations at which rings are drawn, inner to outer, in the unit of the values; 0 is one of them."""
    low, high = min(float(np.nanmin(values)), 0.0), max(float(np.nanmax(values)), 0.0)
    span = max(high - low, 1e-3)
    power = 10.0 ** math.floor(math.log10(span / RINGS))
    step = next(power * k for k in (1, 2, 5, 10) if span / (power * k) <= RINGS)
    return step * np.arange(math.floor(low / step - 0.1), math.ceil(high / step + 0.1) + 1)


def on_circle(errors, key):
    """Return the polar plot: radial deviations, enlarged, on rings around the centre of the least-squares circle."""
    deviation = 1e6 * errors["deviation"].transpose("direction_of_travel", "angle").values
    angle = errors["angle"].values
    levels = rings(deviation)
    first, second = errors.attrs["plane"]

    division = _level(levels[1] - levels[0])

    def radius(value):
        return INNER + (1 - INNER) * (value - levels[0]) / (levels[-1] - levels[0])

    def closed(values):
        r, a = radius(np.append(values, values[0])), np.append(angle, angle[0])
        return r * np.cos(a), r * np.sin(a)

    def paint(figure):
        axes = figure.add_axes((0.14, 0.01, 0.72, 0.98))
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.set_xlim(-1.22, 1.22)
        axes.set_ylim(-1.16, 1.16)
        turn = np.linspace(0, TAU, 361)
        for level in levels:
            nominal = abs(level) < 1e-9
            axes.plot(
                radius(level) * np.cos(turn),
                radius(level) * np.sin(turn),
                color=canvas.BLACK if nominal else GREY,
                linewidth=0.9 if nominal else 0.6,
                zorder=1,
            )
        for quarter in range(8):
            a = quarter * TAU / 8
            reach = np.array([INNER, 1.0])
            axes.plot(reach * np.cos(a), reach * np.sin(a), color=GREY, linewidth=0.6 if quarter % 2 == 0 else 0.4)
        for name, x, y in (
            (f"+{first}", 1.09, 0),
            (f"+{second}", 0, 1.08),
            (f"−{first}", -1.09, 0),
            (f"−{second}", 0, -1.08),
        ):
            axes.text(x, y, name, ha="center", va="center", fontsize=9, fontweight="bold", color=canvas.BLACK)
        for extreme in (np.nanmin(deviation), np.nanmax(deviation)):
            r = radius(extreme)
            axes.plot(r * np.cos(turn), r * np.sin(turn), color=canvas.GREEN, linewidth=0.8, linestyle=(0, (2, 2)))
        for name, values in zip(errors["direction_of_travel"].values, deviation, strict=True):
            colour, dash = STYLES[str(name)]
            axes.plot(*closed(values), color=colour, linewidth=1.3, linestyle=(0, dash) if dash else "-", zorder=3)
        _ring_labels(axes, levels, radius)
        _middle(axes, errors)
        _travel(axes)
        axes.text(1.2, -1.12, f"{division} µm per division", ha="right", fontsize=7.5, color=DARK)

    shown = ", ".join(f"{row} {value}" for row, value in _figure_texts(errors))
    caption = (
        f"Radial deviation on the circle in plane {errors.attrs['plane']}, positive outward, one division "
        f"{division} µm. Black ring: nominal circle of radius "
        f"{fixed(1e3 * errors.attrs['nominal_radius'], 1)} mm. Dotted green: the circles that enclose both paths, "
        "around the centre of their least-squares circle; the set-up error is removed."
    )
    return Figure(canvas.draw(paint, key, 5.0), caption, f"Polar plot of the radial deviation. {shown}.")


def _travel(axes):
    """Draw the two directions of travel as arrows outside the rings."""
    for name, middle, sense in (("CCW", 45.0, 1), ("CW", -45.0, -1)):
        colour, _ = STYLES[name]
        a = np.radians(middle + sense * np.linspace(-9, 9, 30))
        x, y = 1.06 * np.cos(a), 1.06 * np.sin(a)
        axes.plot(x, y, color=colour, linewidth=1.2)
        arrow = {"arrowstyle": "-|>", "color": colour, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 9}
        axes.annotate("", (x[-1], y[-1]), (x[-4], y[-4]), arrowprops=arrow)
        axes.text(
            1.11 * math.cos(a[15]),
            1.11 * math.sin(a[15]),
            name,
            color=colour,
            fontsize=7.5,
            fontweight="bold",
            va="center",
        )


def _level(value):
    return fixed(value, max(0, -math.floor(math.log10(abs(value)) + 1e-9))) if abs(value) > 1e-9 else "0"


def _ring_labels(axes, levels, radius):
    """Write the deviation at each ring, along a line between the axes."""
    a = math.radians(67.5)
    for level in levels:
        axes.text(
            radius(level) * math.cos(a),
            radius(level) * math.sin(a),
            _level(level).replace("-", "−") if level <= 0 else f"+{_level(level)}",
            fontsize=6.5,
            color=DARK,
            ha="center",
            va="center",
            zorder=4,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.85},
        )


def _middle(axes, errors):
    """Write direction of travel, figures and scale into the middle of the plot."""
    y = 0.27
    for name, (colour, dash) in STYLES.items():
        axes.plot([-0.2, -0.04], [y, y], color=colour, linewidth=1.5, linestyle=(0, dash) if dash else "-")
        axes.text(0.02, y, name, color=colour, fontsize=8, va="center", fontweight="bold")
        y -= 0.085
    y -= 0.02
    for name, value in _figure_texts(errors):
        axes.text(-0.36, y, name, fontsize=7.5, va="center", color=canvas.BLACK)
        axes.text(0.37, y, value, fontsize=7.5, va="center", ha="right", color=canvas.BLACK)
        y -= 0.075
    axes.text(0, y - 0.01, "U: k = 2", fontsize=6.5, va="center", ha="center", color=DARK)


def _figure_texts(errors):
    u = np.sqrt(np.diagonal(errors["figure_covariance"].values))
    for name, value, sigma in zip(errors["figure"].values, errors["figures"].values, u, strict=True):
        if name in ("G(CCW)", "G(CW)", "G(b)", "H", "D"):
            text, expanded = rounded(1e6 * float(value), 2e6 * float(sigma), signed=str(name) == "D")
            yield str(name), f"{text} ± {expanded} µm"


def over_angle(errors, key):
    """Return the deviations over the angle with their bands, and the residuals of the model of the path."""
    angle = np.degrees(errors["angle"].values)
    deviation, model, noise = (
        1e6 * errors[name].transpose("direction_of_travel", "angle").values
        for name in ("deviation", "model", "noise_u")
    )
    offset = 1e6 * float(errors["figures"].sel(figure="D"))

    def paint(figure):
        upper, lower = canvas.stack(figure, HEIGHTS, right=0.6)
        ends = []
        for k, name in enumerate(map(str, errors["direction_of_travel"].values)):
            colour, dash = STYLES[name]
            canvas.curve(upper, angle, deviation[k], 2 * noise[k], colour=colour, dash=dash)
            upper.plot(angle, model[k], color=canvas.BLACK, linewidth=0.5)
            canvas.curve(lower, angle, deviation[k] - model[k], 2 * noise[k], colour=colour, dash=dash)
            ends.append((deviation[k, -1], name, colour))
        upper.axhline(offset, color=DARK, linewidth=0.6, linestyle=(0, (2, 2)))
        canvas.label_ends(upper, ends)
        upper.set_ylabel("deviation / µm", labelpad=2)
        lower.set_ylabel("residual / µm", labelpad=2)
        lower.set_xlabel("angle / °")
        lower.set_xlim(0, 360)
        lower.set_xticks(range(0, 361, 45))

    caption = (
        "Radial deviation over the angle, thin black: the fitted model of the path; dotted: mean radial deviation D. "
        "Below: residuals of the model. Bands: expanded uncertainty by noise, k = 2, without the calibration of the "
        "bar, which has the same effect on all values."
    )
    left = float(np.sqrt(np.nanmean((deviation - model) ** 2)))
    alt = f"Deviation over the angle; residuals of the model: {fixed(left, 3)} µm rms."
    return Figure(canvas.draw(paint, key, canvas.stack_height(HEIGHTS)), caption, alt)


HEIGHTS = (1.7, 1.0)
"""Of the panels over the angle, inch."""
