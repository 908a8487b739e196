"""The chapter of a circular test: figures of ISO 230-4, polar plot, model of the path, uncertainty, data."""

from dataclasses import replace

import numpy as np

from ballbar_test import plots
from ballbar_test.path import PARAMETERS, basis, sector_angles
from ballbar_test.result import figures_of
from errormotion.report import budget, provenance, quality
from errormotion.report.document import Cell, KeyFigure, Part, Section, Table, Text, estimate
from errormotion.report.text import fixed, integer, listed

#: Words, field unit and its size in SI of each parameter; {0} and {1} are the axes.
WORDS = {
    "squareness": ("squareness of {1} to {0}", "µrad", 1e-6),
    "scale_mismatch": ("scale of {0} minus that of {1}", "µm/m", 1e-6),
    "servo_mismatch": ("following lag of {0} minus that of {1}", "ms", 1e-3),
    "backlash_1": ("backlash of {0}", "µm", 1e-6),
    "backlash_2": ("backlash of {1}", "µm", 1e-6),
    "bow_1": ("straightness of {0} (bow)", "µm", 1e-6),
    "bow_2": ("straightness of {1} (bow)", "µm", 1e-6),
    "spike_1": ("reversal spike of {0}", "µm", 1e-6),
    "spike_2": ("reversal spike of {1}", "µm", 1e-6),
}


def chapters(source):
    """Return the chapter of a circular test."""
    errors, key = source.errors, source.key
    plane = errors.attrs["plane"]
    part = Part(
        f"Circular test in plane {plane}",
        key_figures(errors),
        summary(errors),
        [
            Section("circle", "Paths", [plots.on_circle(errors, f"{key}-circle"), figure_table(errors)]),
            Section("model", "Errors of the axes", [parameter_table(errors), plots.over_angle(errors, f"{key}-angle")]),
            Section("uncertainty", "Uncertainty", uncertainty(errors)),
            Section("quality", "Data quality", data(errors)),
            Section("provenance", "Provenance", provenance.blocks(source)),
        ],
    )
    return [part]


def key_figures(errors):
    """Return the figures of the standard for the head of the report."""
    return [
        KeyFigure(
            figure.name,
            estimate(1e6 * figure.value, 1e6 * figure.expanded_uncertainty, signed=figure.name[0] in "FD"),
            "µm",
            f"limit {1e6 * figure.limit:g} µm" if figure.limit else "",
        )
        for figure in figures_of(errors)
    ]


def summary(errors):
    """Return sentences on the test, the verdicts and the largest contributions."""
    plane, counts = errors.attrs["plane"], errors["reading_count"].values
    words = [
        f"Circles of radius {fixed(1e3 * errors.attrs['nominal_radius'], 1)} mm in plane {plane} at a feed of "
        f"{fixed(6e4 * errors.attrs['feed'], 0)} mm/min, {integer(int(counts.sum()))} readings in both directions."
    ]
    for figure in figures_of(errors):
        if figure.limit:
            words.append(f"{figure.name}: {verdict(figure)}.")
    parts = contributions(errors)
    order = sorted(parts, key=lambda name: -parts[name])[:3]
    names = [f"{words_of(errors, name)} ({fixed(1e6 * parts[name], 1)} µm)" for name in order]
    return [*words, f"Largest contributions to the circular deviation: {listed(names)}."]


def verdict(figure):
    """Return whether a figure conforms to its limit, with the guard band of its uncertainty (ISO 14253-1)."""
    if figure.value + figure.expanded_uncertainty <= figure.limit:
        return "within its limit"
    if figure.value - figure.expanded_uncertainty > figure.limit:
        return "above its limit"
    return "not decided: the limit is within the uncertainty"


def words_of(errors, name):
    return WORDS[name][0].format(*errors.attrs["plane"])


def contributions(errors):
    """Return the range of the radial deviation caused by each single parameter, m."""
    angle = sector_angles(errors.sizes["angle"])
    settings = errors.attrs
    values = errors["parameters"].values
    decay = float(errors["spike_decay"])
    sense = np.array([1.0, -1.0])[:, None, None]
    every = np.broadcast_to(angle, (2, *angle.shape))
    path = basis(every, np.broadcast_to(sense, every.shape), settings["nominal_radius"], settings["feed"], decay)
    spans = np.ptp(path.mean(axis=2).reshape(-1, len(PARAMETERS)) * values, axis=0)
    return dict(zip(PARAMETERS, map(float, spans), strict=True))


def figure_table(errors):
    """Return the table of the figures of the standard."""
    rows = []
    for figure, meaning in zip(figures_of(errors), errors["meaning"].values, strict=True):
        limit = fixed(1e6 * figure.limit, 1) if figure.limit else "none"
        value = estimate(1e6 * figure.value, 1e6 * figure.expanded_uncertainty, signed=figure.name[0] in "FD")
        rows.append([figure.name, str(meaning), value, limit, verdict(figure) if figure.limit else ""])
    return Table(
        "Figures of ISO 230-4 in µm. After ±: expanded uncertainty, k = 2. G and H compare the paths with one another; "
        "F and D depend on the calibrated length of the bar.",
        ["figure", "quantity", "value", "limit", "verdict"],
        rows,
        numeric=False,
    )


def parameter_table(errors):
    """Return the parameters of the path with their uncertainty and their contribution."""
    parts = contributions(errors)
    u = np.sqrt(np.diagonal(errors["parameter_covariance"].values))
    rows = []
    for name, value, sigma in zip(PARAMETERS, errors["parameters"].values, u, strict=True):
        _, unit, size = WORDS[name]
        rows.append(
            [
                words_of(errors, name),
                unit,
                estimate(float(value) / size, 2 * float(sigma) / size),
                fixed(1e6 * parts[name], 2),
            ]
        )
    return Table(
        "Errors of the two axes by the model of the path. After ±: expanded uncertainty, k = 2. Contribution: range of "
        "the radial deviation caused by this error.",
        ["error", "unit", "value", "contribution / µm"],
        rows,
    )


def uncertainty(errors):
    """Return the budget of a deviation."""
    here = errors.isel(direction_of_travel=0, angle=0)
    made = budget.table(here, "of the radial deviation in the first sector of the counterclockwise path")
    noise = budget.readable("independent")
    rows = [["noise, independent from sector to sector" if row[0] == noise else row[0], *row[1:]] for row in made.rows]
    return [
        replace(made, rows=rows),
        Text(
            "Noise is independent from sector to sector. All other sources are constant in the test: they affect all "
            "deviations equally, so that G and H hardly depend on them."
        ),
        Text(
            "G, H, Fmax and Fmin are extreme values, which are too large on average due to noise. The mean excess is "
            "removed, and the uncertainty of this correction is included."
        ),
    ]


def data(errors):
    """Return noise, set-up error, drift and gaps."""
    counts = errors["reading_count"].values
    offset, offset_u = 1e6 * errors["offset"].values, 2e6 * errors["offset_u"].values
    rows = [
        [f"set-up error along {name}, removed", estimate(float(value), float(u)), "µm"]
        for name, value, u in zip(errors["axis"].values, offset, offset_u, strict=True)
    ]
    rows += [
        ["noise of a reading", Cell(fixed(1e6 * float(errors["reading_noise"]), 3)), "µm"],
        [
            "drift of the bar, removed",
            estimate(6e7 * float(errors["drift"]), 1.2e8 * float(errors["drift_u"])),
            "µm/min",
        ],
        ["chi-square of the model by degree of freedom", Cell(fixed(float(errors["misfit"]), 2)), ""],
        ["readings in a sector", Cell(f"{integer(int(counts.min()))} to {integer(int(counts.max()))}"), ""],
    ]
    table = Table("Set-up, noise and drift. After ±: expanded uncertainty, k = 2.", ["quantity", "value", "unit"], rows)
    return [*quality.notes(errors), table]
