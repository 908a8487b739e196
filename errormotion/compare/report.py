"""The page of a comparison: the verdict, the curves with their bands, the normalised errors, and the causes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure as Drawing

from errormotion.compare.text import SPREAD_HEAD, cause_text, probability, spreads, verdict
from errormotion.report.canvas import COLOURS, GREEN, WIDTH, curve, draw
from errormotion.report.document import Block, Cell, Figure, KeyFigure, Part, Section, Source, Table, Text
from errormotion.report.write import write_page

PANEL = 1.9
"""Height of a panel, inches."""


def write(comparison: xr.Dataset, out: Path) -> Path:
    """Write the page of a comparison; an older one is replaced in one step."""
    source = Source(comparison, None, {}, {})
    path: Path = write_page([source], [part(comparison, source.key)], out)
    return path


def part(ds: xr.Dataset, key: str) -> Part:
    """Return the chapter of a comparison."""
    lines = verdict(ds)
    pairs: list[Block] = [*_pair_tables(ds), *_cause_blocks(ds)]
    return Part(
        f"Comparison of {', '.join(str(name) for name in ds['dataset'].values)}",
        _key_figures(ds),
        lines,
        [
            Section("curves", "Errors on common ground", [_curves(ds, key)] if _common(ds) else [_values(ds)]),
            Section("pairs", "Pairs", pairs),
            *_repeats(ds),
            Section(
                "ground", "Common ground", [Text(_ground(ds)), *[Text(note) for note in ds.attrs["notes"] if note]]
            ),
        ],
        kind="Comparison",
    )


def _key_figures(ds: xr.Dataset) -> list[KeyFigure]:
    largest = float(np.nanmax(np.abs(ds["en"].values))) if np.isfinite(ds["en"].values).any() else float("nan")
    return [
        KeyFigure(
            "Agreement of all datasets", Cell(probability(float(ds.attrs["fit_p"]))), "", "joint chi-square test"
        ),
        KeyFigure("Birge ratio", Cell(f"{float(ds.attrs['birge_ratio']):.2f}"), "", "1 if the uncertainties fit"),
        KeyFigure("Largest |En|", Cell(f"{largest:.2f}"), "", "k = 2"),
    ]


def _common(ds: xr.Dataset) -> str:
    dims = [str(dim) for dim in ds["consensus"].dims if dim != "dof"]
    return dims[0] if dims else ""


def _abscissa(ds: xr.Dataset) -> tuple[np.ndarray, str, bool]:
    dim = _common(ds)
    if dim == "time":
        return np.asarray(ds["time"].values) / 60.0, "time / min", True
    for name in ("x", "y", "z"):
        if dim == "position" and name in ds.coords and ds[name].dims == (dim,):
            return np.asarray(ds[name].values) * 1e3, f"{name.upper()} / mm", True
    return np.arange(ds.sizes[dim]), f"{dim} number", False


def _curves(ds: xr.Dataset, key: str) -> Figure:
    x, label, joined = _abscissa(ds)
    names = [str(name) for name in ds["dof"].values]
    u = 2 * np.sqrt(np.diagonal(ds["covariance"].values, axis1=-2, axis2=-1))
    values, en = ds["value"].values, ds["en"].values

    def paint(drawing: Drawing) -> None:
        panels = drawing.subplots(len(names) + 1, 1, sharex=True, gridspec_kw={"hspace": 0.12})
        drawing.subplots_adjust(left=0.1, right=0.82, top=0.985, bottom=0.06)
        for k, (axes, name) in enumerate(zip(panels, names, strict=False)):
            factor, unit = _field(name)
            for i, dataset in enumerate(ds["dataset"].values):
                colour = COLOURS[i % len(COLOURS)]
                if joined:
                    curve(axes, x, factor * values[i, :, k], factor * u[i, :, k], colour=colour)
                else:
                    shift = 0.12 * (i - (len(values) - 1) / 2)
                    axes.errorbar(
                        x + shift,
                        factor * values[i, :, k],
                        yerr=factor * u[i, :, k],
                        fmt="o",
                        ms=2.5,
                        lw=0.8,
                        color=colour,
                    )
                if k == 0:
                    axes.plot([], [], color=colour, label=str(dataset))
            axes.set_ylabel(f"{name} / {unit}")
        panels[0].legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False)
        last = panels[-1]
        last.axhspan(-1, 1, color=GREEN, alpha=0.12, linewidth=0)
        for j in range(en.shape[0]):
            worst = np.nanmax(np.abs(np.nan_to_num(en[j])), axis=1)
            last.plot(x, worst, color=COLOURS[(j + len(values)) % len(COLOURS)], lw=1, label=str(ds["pair"].values[j]))
        last.set_ylim(0, max(1.5, float(np.nanmax(np.abs(en), initial=0.0)) * 1.08))
        last.set_ylabel("largest |En|")
        last.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False)
        last.set_xlabel(label)

    svg = draw(paint, f"{key}-compare", PANEL * (len(names) + 1), WIDTH)
    return Figure(
        svg,
        "Errors of each dataset with expanded uncertainty (k = 2), and the largest normalised error |En| of each pair; "
        "the datasets agree where it is below 1 (green).",
        "Curves of all datasets over " + label,
    )


def _values(ds: xr.Dataset) -> Table:
    rows: list[Sequence[Cell | str]] = []
    u = 2 * np.sqrt(np.diagonal(ds["covariance"].values, axis1=-2, axis2=-1))
    for k, name in enumerate(str(each) for each in ds["dof"].values):
        factor, unit = _field(name)
        for i, dataset in enumerate(ds["dataset"].values):
            rows.append(
                [name, str(dataset), f"{factor * ds['value'].values[i, k]:.3f}", f"{factor * u[i, k]:.3f}", unit]
            )
    return Table("Errors of each dataset", ["freedom", "dataset", "value", "U (k = 2)", "unit"], rows)


def _pair_tables(ds: xr.Dataset) -> list[Table]:
    names = [str(each) for each in ds["dof"].values]
    rows: list[Sequence[Cell | str]] = []
    single: list[Sequence[Cell | str]] = []
    for j, name in enumerate(ds["pair"].values):
        inside = np.abs(ds["en"].values[j])
        inside = 100 * float(np.mean(inside[np.isfinite(inside)] <= 1)) if np.isfinite(inside).any() else float("nan")
        row = [str(name), f"{inside:.0f} %", f"{ds['chi2'].values[j]:.1f}", f"{ds['degrees'].values[j]:.0f}"]
        rows.append([*row, probability(ds["p"].values[j])])
        single.append([str(name), *(probability(p) for p in ds["curve_p"].values[j])])
    whole = Table(
        "Agreement of each pair: share of points within the expanded uncertainty, and the joint test of all points and "
        "freedoms. A p below 0.05 contradicts agreement.",
        ["pair", "|En| ≤ 1", "chi-square", "degrees", "p"],
        rows,
    )
    return [whole, Table("p of each freedom, over all points", ["pair", *names], single)]


def _cause_blocks(ds: xr.Dataset) -> list[Block]:
    found: list[Block] = []
    for j, name in enumerate(ds["pair"].values):
        rows: list[Sequence[Cell | str]] = []
        for rank in range(ds.sizes["rank"]):
            text = cause_text(ds, j, rank)
            if text is not None:
                rows.append([str(rank + 1), text.name, text.size, f"{text.ratio:.1f}", probability(text.p), text.alike])
        if rows:
            head = ["", "cause", "size (U, k = 2)", "ln likelihood ratio", "p of the rest", "cannot be told from"]
            found.append(
                Table(f"Single causes that could explain {name}, the most likely one first", head, rows, numeric=False)
            )
    return found


def _repeats(ds: xr.Dataset) -> list[Section]:
    """Return the section of repeatability and reproducibility; none without groups."""
    rows: list[Sequence[Cell | str]] = [list(row) for row in spreads(ds)]
    if not rows:
        return []
    groups: dict[str, list[str]] = {}
    for name, group in zip(ds["dataset"].values, ds["group"].values, strict=True):
        groups.setdefault(str(group), []).append(str(name))
    text = "Groups: " + "; ".join(f"{group} ({', '.join(names)})" for group, names in groups.items()) + "."
    caption = (
        "Standard deviations over all points. Found: from the differences of the datasets. Stated: what their "
        "uncertainties let expect. p: probability of a larger spread if these are right. Shared by all: uncertainty of "
        "sources that all groups have in common, which no repeat shows."
    )
    return [Section("repeats", "Repeatability and reproducibility", [Text(text), Table(caption, SPREAD_HEAD, rows)])]


def _ground(ds: xr.Dataset) -> str:
    point = ", ".join(f"{1e3 * float(each):g}" for each in np.atleast_1d(ds.attrs["functional_point"]))
    text = (
        f"Machine {ds.attrs['machine']}, {ds.attrs['component']}, frame '{ds.attrs['frame']}', "
        f"functional point ({point}) mm."
    )
    if "since" in ds.attrs:
        text += (
            f" All errors are changes since {float(ds.attrs['since']):g} s after {ds.attrs.get('start') or 'time 0'}."
        )
    return text


def _field(freedom: str) -> tuple[float, str]:
    return (1e6, "um") if freedom in ("EX", "EY", "EZ") else (648000 / np.pi, "arcsec")


def chapters(source: Any) -> list[Part]:
    """Return the chapters of a stored comparison."""
    return [part(source.errors, source.key)]
