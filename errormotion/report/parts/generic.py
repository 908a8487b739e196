"""The chapter of any error dataset: error motions or deviation over the dims, with uncertainty bands."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from errormotion.report import budget, canvas, provenance, quality
from errormotion.report.document import (
    Block,
    Cell,
    Figure,
    KeyFigure,
    Part,
    Section,
    Source,
    Table,
    Text,
    estimate,
    or_dash,
)
from errormotion.report.fields import unit_of
from errormotion.report.text import finite, fixed, listed, percent

_MOST = 5  # curves drawn over a further dim
unit_at = unit_of
DEVIATION = ("deviation", "deviation_variance", "deviation_influence", "sensitivity")


def part(source: Source, key: str) -> Part:
    """Return the chapter of one error dataset; ``key`` makes the identifiers of its figures unique."""
    errors = source.errors
    component = str(errors.attrs.get("component", "unknown"))
    return Part(
        f"Errors of component {component}",
        _key_figures(errors),
        _summary(errors),
        [
            Section("errors", "Error motions", _curves(source, key)),
            Section("uncertainty", "Uncertainty", _uncertainty(errors)),
            Section(
                "quality",
                "Data quality",
                [*quality.notes(errors), *quality.sentences(errors, source.raw), _further(errors)],
            ),
            Section("provenance", "Provenance", provenance.blocks(source)),
        ],
    )


def names_of(errors: xr.Dataset) -> dict[str, str]:
    """Return the ISO 230-1 names of the freedoms of the component, or their names without such names."""
    found: dict[str, str] = errors.em.iso_names()
    return found


def _dims(errors: xr.Dataset) -> tuple[str, ...]:
    return tuple(str(dim) for dim in errors["EX"].dims)


def _sigma(errors: xr.Dataset, index: int) -> np.ndarray:
    return np.asarray(budget.sigma(errors)[..., index])


def _key_figures(errors: xr.Dataset) -> list[KeyFigure]:
    names, found = names_of(errors), []
    for i, freedom in enumerate(errors.em.names):
        unit, size = unit_of(i)
        largest = errors.em.largest(freedom)
        if largest is not None:
            cell = estimate(largest.value / size, largest.expanded / size)
            found.append(KeyFigure(names[freedom], cell, unit, "largest"))
    return found


def _summary(errors: xr.Dataset) -> list[str]:
    names = names_of(errors)
    seen = [name for name in errors.em.names if np.isfinite(errors[name].values).any()]
    unseen = [name for name in errors.em.names if name not in seen]
    places = " × ".join(f"{errors.sizes[dim]} ({dim})" for dim in _dims(errors)) or "one place"
    words = [f"Observed: {listed([names[name] for name in seen]) or 'nothing'}, at {places}."]
    if unseen:
        words.append(f"Not observed: {listed([names[name] for name in unseen])}. Reported as unknown, not as zero.")
    if "deviation" in errors:
        words.append("The errors are measured along one known direction only; no single freedom is determined.")
    return words


def _abscissa(errors: xr.Dataset, dim: str) -> tuple[np.ndarray, str]:
    """Return the abscissa of a dim, and its name with the unit."""
    size = errors.sizes[dim]
    if dim == "time" and "time" in errors.coords:
        return np.asarray(errors["time"].values, float) / 60, "time / min"
    for axis in (str(errors.attrs.get("component", "")).lower(), "x", "y", "z"):
        if axis in errors.coords and errors[axis].dims == (dim,) and np.ptp(errors[axis].values) > 0:
            return 1e3 * np.asarray(errors[axis].values, float), f"{axis} / mm"
    if dim in errors.coords and errors[dim].dtype.kind in "iuf":
        scale, unit = (1e3, "mm") if dim == "position" else (1.0, str(errors[dim].attrs.get("units", "1")))
        return scale * np.asarray(errors[dim].values, float), f"{dim} / {unit}"
    return np.arange(1.0, size + 1), f"number of {dim}"


def _curves(source: Source, key: str) -> list[Block]:
    errors = source.errors
    dims = _dims(errors)
    if not dims:
        return [budget.twist_table(errors, {"value": errors}, names_of(errors))]
    along = max(dims, key=lambda dim: (dim == "time", errors.sizes[dim]))
    others = [dim for dim in dims if dim != along]
    flat = errors.em.estimates().to_dataset().assign(sigma=(errors.em.estimates().dims, budget.sigma(errors)))
    flat = flat.stack(other_=others, create_index=False) if others else flat.expand_dims("other_", -1)
    picks = np.unique(np.linspace(0, flat.sizes["other_"] - 1, _MOST).astype(int))
    x, label = _abscissa(errors, along)
    if np.any(np.diff(x) < 0):
        order = np.argsort(x, kind="stable")
        x, flat = x[order], flat.isel({along: order})
    names = names_of(errors)

    single = len(names) == 1

    def paint(figure: Canvas) -> None:
        panels = figure.subplots(*((1, 1) if single else (3, 2)), sharex=True, squeeze=False)
        bottom = 0.18 if single else 0.09
        figure.subplots_adjust(left=0.075, right=0.985, top=1 - bottom / 1.8, bottom=bottom, wspace=0.19, hspace=0.3)
        for i, freedom in enumerate(errors.em.names):
            axes: Axes = panels[i % 3, i // 3]
            unit, size = unit_of(i)
            values = flat["estimates"].isel(dof=i).transpose("other_", along).values / size
            expanded = 2 * flat["sigma"].isel(dof=i).transpose("other_", along).values / size
            axes.set_title(names[freedom])
            axes.set_ylabel(unit)
            if not np.isfinite(values).any():
                axes.text(0.5, 0.5, "not observed", transform=axes.transAxes, ha="center", va="center", color="#555555")
                axes.set_yticks([])
                continue
            for place, pick in enumerate(picks):
                colour, name = canvas.COLOURS[place % len(canvas.COLOURS)], _place_name(errors, others, int(pick))
                canvas.curve(axes, x, values[pick], expanded[pick], colour=colour, name=name or names[freedom])
            if x.size == 1:
                axes.errorbar(x, values[picks[0]], expanded[picks[0]], fmt="o", markersize=3, color=canvas.BLUE)
            if freedom in source.limits:
                lower, upper = source.limits[freedom]
                canvas.limit_lines(axes, [(names[freedom], lower / size, upper / size)])
        for axes in panels[-1]:
            axes.set_xlabel(label)

    shown = f" Shown: {len(picks)} of {flat.sizes['other_']} curves over {listed(others)}." if others else ""
    caption = f"Error motions over {along}, actual minus commanded. Bands: expanded uncertainty, k = 2.{shown}"
    spans = "; ".join(f"{names[name]} {_span(errors, name, i)}" for i, name in enumerate(errors.em.names))
    height = 2.3 if single else 4.6
    return [Figure(canvas.draw(paint, f"{key}-errors", height), caption, f"Error motions over {along}: {spans}.")]


def _place_name(errors: xr.Dataset, others: list[str], index: int) -> str:
    """Return the position of a curve along the other dims in words; empty without other dims."""
    found = []
    for dim, k in zip(others, np.unravel_index(index, [errors.sizes[dim] for dim in others]), strict=True):
        x, label = _abscissa(errors, dim)
        found.append(f"{label.partition(' / ')[0]} {x[k]:.4g} {label.partition(' / ')[2]}".strip())
    return ", ".join(found)


def _span(errors: xr.Dataset, name: str, index: int) -> str:
    unit, size = unit_of(index)
    values = errors[name].values / size
    if not np.isfinite(values).any():
        return "not observed"
    return f"{fixed(finite(np.min, values), 2)} to {fixed(finite(np.max, values), 2)} {unit}"


def _uncertainty(errors: xr.Dataset) -> list[Block]:
    names = names_of(errors)
    rows: list[list[Cell | str]] = []
    for i, freedom in enumerate(errors.em.names):
        unit, size = unit_of(i)
        values, expanded = errors[freedom].values / size, 2 * _sigma(errors, i) / size
        spans = (finite(np.min, values), finite(np.max, values), finite(np.median, expanded), finite(np.max, expanded))
        cells = [or_dash(fixed(value, 2, signed=j < 2), "not observed by this method") for j, value in enumerate(spans)]
        rows.append([names[freedom], unit, *cells, percent(float(np.isfinite(values).mean()))])
    blocks: list[Block] = [
        Table(
            "Span of the error motions and their expanded uncertainty, k = 2.",
            ["error", "unit", "lowest", "highest", "U, median", "U, largest", "determined"],
            rows,
        )
    ]
    dims = _dims(errors)
    if {"influence", "deviation_influence"} & set(errors.data_vars):
        blocks.append(budget.table(errors.isel(dict.fromkeys(dims, -1)), "at the last place" if dims else ""))
    return blocks


def _further(errors: xr.Dataset) -> Block:
    """Return the table of all further variables of the dataset."""
    known = {*budget.FREEDOMS, "covariance", "influence", *DEVIATION}
    rows: list[list[Cell | str]] = []
    for name, variable in errors.data_vars.items():
        if name in known:
            continue
        span = ""
        if variable.dtype.kind in "iuf" and np.isfinite(np.asarray(variable.values, float)).any():
            values = np.asarray(variable.values, float)
            span = f"{finite(np.min, values):.4g} to {finite(np.max, values):.4g}"
        shape = ", ".join(f"{dim} {variable.sizes[dim]}" for dim in variable.dims) or "scalar"
        rows.append([str(name), shape, str(variable.attrs.get("units", "")), span])
    if not rows:
        return Text("The result contains only the errors and their covariance.", "note")
    return Table("Further results in the dataset, in SI units.", ["name", "dims", "unit", "span"], rows, numeric=False)
