"""The chapter of a test: figures, graphs, the table of the standard, uncertainty, data."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr

from errormotion.estimation.extremes import expanded
from errormotion.methods.linear_positioning.figures import ALIGNED_FIGURES
from errormotion.methods.linear_positioning.identification.standard import FIGURES, MEANINGS
from errormotion.methods.linear_positioning.report import drawings
from errormotion.methods.linear_positioning.report.view import View, views
from errormotion.methods.linear_positioning.schema import APPROACHES
from errormotion.methods.linear_positioning.settings import LIMITS
from errormotion.report import budget, provenance, quality
from errormotion.report.document import Block, Cell, KeyFigure, Part, Section, Source, Table, Text, estimate
from errormotion.report.text import decimals_of, fixed, listed

KEY_FIGURES = ("A", "R", "E", "B", "M")
TARGETS_PER_TABLE = 8


def part(source: Source, key: str) -> Part:
    """Return the chapter; ``key`` makes the identifiers of its figures unique."""
    errors, freedoms = source.errors, views(source.errors)
    limits = drawings.limits_of(errors, LIMITS) if freedoms[0].along else {}
    aligned = [_aligned_table(errors, freedoms[0])] if "aligned_value" in errors and freedoms[0].along else []
    of_standard = _figures(freedoms, limits, f"{key}-limits")
    sections = [Section("figures", "Figures of ISO 230-2", [*of_standard[:1], *aligned, *of_standard[1:]])]
    sections += [
        Section(
            f"graph-{view.name}",
            f"{_title(view)} {view.name}",
            [drawings.over_position(view, f"{key}-{view.name}", source.limits), *target_tables(view)],
        )
        for view in freedoms
    ]
    sections += [
        Section("uncertainty", "Uncertainty", _uncertainty(errors, freedoms[0])),
        Section("quality", "Data quality", [*quality.notes(errors), *quality.sentences(errors, source.raw)]),
        Section("provenance", "Provenance", provenance.blocks(source)),
    ]
    axis = str(errors.attrs["component"])
    summary = _summary(errors, freedoms, limits)
    return Part(f"Positioning of axis {axis}", _key_figures(freedoms[0], limits), summary, sections)


def _figures(freedoms: list[View], limits: dict[str, float], key: str) -> list[Block]:
    bars = [drawings.against_limits(freedoms[0], limits, key)] if limits else []
    first, *others = (figure_table(view, limits) for view in freedoms)
    return [first, *bars, *others]


def _title(view: View) -> str:
    return "Positioning" if view.along else "Straightness" if view.straight else "Angle"


def _key_figures(view: View, limits: dict[str, float]) -> list[KeyFigure]:
    return [
        KeyFigure(
            f"{name} of {view.name}",
            estimate(view.value[name], view.expanded(name), signed=False),
            view.unit,
            f"limit {limits[name]:g} µm" if name in limits else "",
        )
        for name in KEY_FIGURES
        if math.isfinite(view.value[name])
    ]


def _summary(errors: xr.Dataset, freedoms: list[View], limits: dict[str, float]) -> list[str]:
    view, runs = freedoms[0], errors.sizes["run"]
    return [
        f"{view.position.size} targets from {fixed(view.position[0], 1)} mm to {fixed(view.position[-1], 1)} mm, "
        f"{runs} run{'s' if runs > 1 else ''}; {listed([each.name for each in freedoms])} measured. Errors are "
        f"relative to the {errors.attrs['reference']}.",
        *(f"{name} is {_verdict(view, name, limit)} {limit:g} µm." for name, limit in limits.items()),
    ]


def _verdict(view: View, name: str, limit: float) -> str:
    """Return the decision, with the expanded uncertainty as guard band (ISO 14253-1)."""
    if view.value[name] + view.expanded(name) <= limit:
        return "within its limit of"
    if view.value[name] - view.expanded(name) > limit:
        return "above its limit of"
    return "not decided, since its uncertainty contains the limit of"


def figure_table(view: View, limits: dict[str, float]) -> Table:
    """Return the table of the figures of one freedom or diagonal, with excess and uncertainty."""
    rows: list[list[Cell | str]] = []
    for name in FIGURES:
        value, bias, u = view.value[name], view.bias[name], view.u[name]
        rows.append(
            [
                _sign(name),
                MEANINGS[name],
                estimate(value, view.expanded(name), signed=name == "B_mean", reason="not measured in both directions"),
                fixed(bias, decimals_of(2.0 * u, 2), signed=True) if name != "B_mean" else "",
                estimate(value - bias, 2.0 * u, signed=name == "B_mean", reason="needs several runs"),
                f"{limits[name]:g}" if name in limits and view.along else "",
            ]
        )
    caption = (
        f"Figures of {view.name} in {view.unit} as the standard defines them; after ±: expanded uncertainty, k = 2, "
        "excess included. Excess: mean increase of an extreme value by scatter; true figure: the limit for an infinite "
        "number of runs."
    )
    return Table(caption, ["figure", "meaning", "value", "excess", "true figure", "limit"], rows, numeric=False)


def _aligned_table(errors: xr.Dataset, view: View) -> Table:
    """Return the figures that are corrected for the stated alignment."""
    rows: list[list[Cell | str]] = []
    for name in ALIGNED_FIGURES:
        value, bias, u = (
            float(errors[f"aligned_{part}"].sel(figure=name)) / view.size for part in ("value", "bias", "u")
        )
        if math.isfinite(value):
            rows.append([_sign(name), MEANINGS[name], estimate(value, float(expanded(bias, u)), signed=False)])
    caption = (
        f"Figures of {view.name} in {view.unit} corrected for the mean cosine error of the stated alignment; after ±: "
        "expanded uncertainty, k = 2, excess included."
    )
    return Table(caption, ["figure", "meaning", "value"], rows, numeric=False)


def _sign(name: str) -> str:
    return name.replace("_forward", "↑").replace("_backward", "↓").replace("B_mean", "mean B")


def target_tables(view: View) -> list[Block]:
    """Return the results by target as in the standard, in tables of some targets."""
    tables: list[Block] = []
    decimals = _decimals(view)
    m = view.position.size
    for targets in np.array_split(np.arange(m), math.ceil(m / TARGETS_PER_TABLE)):
        head = ["", *(f"{i + 1}" for i in targets)]
        rows: list[list[Cell | str]] = [["target position / mm", *(fixed(view.position[i], 3) for i in targets)]]
        for k, approach in enumerate(APPROACHES):
            arrow = "↑" if k == 0 else "↓"
            for j, run in enumerate(view.readings[k]):
                rows.append([f"run {j + 1} {arrow}", *(fixed(run[i], decimals) for i in targets)])
            mean, s = view.mean[k], view.s[k]
            for label, values in (
                (f"mean {approach}", mean),
                (f"s {arrow}", s),
                (f"2 s {arrow}", 2 * s),
                (f"mean − 2 s {arrow}", mean - 2 * s),
                (f"mean + 2 s {arrow}", mean + 2 * s),
                (f"R = 4 s {arrow}", 4 * s),
            ):
                rows.append([label, *(fixed(values[i], decimals) for i in targets)])
        reversal = view.mean[0] - view.mean[1]
        both = np.maximum(2 * view.s.sum(axis=0) + np.abs(reversal), 4 * view.s.max(axis=0))
        for label, values in (("B", reversal), ("mean of both", view.mean.mean(axis=0)), ("R of both", both)):
            rows.append([label, *(fixed(values[i], decimals) for i in targets)])
        tables.append(Table(f"{view.name} by target, {view.unit}.", head, rows))
    return tables


def _decimals(view: View) -> int:
    """Return the number of decimals that resolves a tenth of the scatter."""
    typical = float(np.nanmedian(view.s)) if np.isfinite(view.s).any() else math.nan
    return min(max(1 - math.floor(math.log10(typical)), 1), 4) if typical > 0 else 2


def _uncertainty(errors: xr.Dataset, view: View) -> list[Block]:
    middle = errors.sizes["position"] // 2
    return [
        budget.table(errors.isel(position=middle), f"at {fixed(view.position[middle], 1)} mm"),
        budget.table(errors.isel(position=-1), f"at {fixed(view.position[-1], 1)} mm"),
        Text(
            "Independent: from target to target, by the scatter of the readings. The error of every other source is "
            "the same in the whole test. Bands and figures use the readings corrected for expansion."
        ),
    ]
