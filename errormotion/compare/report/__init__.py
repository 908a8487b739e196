"""The page of a comparison: verdict, curves with bands, normalised errors, and causes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from errormotion.compare.report.picture import abscissa, common, field, height, paint
from errormotion.compare.text import SPREAD_HEAD, cause_text, probability, spreads, verdict, within
from errormotion.report.canvas import WIDTH, draw
from errormotion.report.document import Block, Cell, Figure, KeyFigure, Part, Section, Source, Table, Text
from errormotion.report.page.language import texts_of
from errormotion.report.write import PLAIN, Form, write_page


def write(comparison: xr.Dataset, out: Path, form: Form = PLAIN) -> Path:
    """Write the page of a comparison; an existing page is replaced."""
    source = Source(comparison, None, {}, {})
    return write_page([source], lambda: [part(comparison, source.key)], out, form=form)


def part(ds: xr.Dataset, key: str) -> Part:
    """Return the chapter of a comparison."""
    lines = verdict(ds)
    pairs: list[Block] = [*_pair_tables(ds), *_cause_blocks(ds)]
    return Part(
        f"Comparison of {', '.join(str(name) for name in ds['dataset'].values)}",
        _key_figures(ds),
        lines,
        [
            Section("curves", "Errors on common ground", [_curves(ds, key)] if common(ds) else [_values(ds)]),
            Section("pairs", "Pairs", pairs),
            *_repeats(ds),
            Section(
                "ground", "Common ground", [Text(_ground(ds)), *[Text(note) for note in ds.attrs["notes"] if note]]
            ),
        ],
        kind="Comparison",
    )


def _key_figures(ds: xr.Dataset) -> list[KeyFigure]:
    birge = float(ds.attrs["birge_ratio"])
    return [
        KeyFigure(
            "Agreement of all datasets", Cell(probability(float(ds.attrs["fit_p"]))), "", "joint chi-square test"
        ),
        KeyFigure(
            "Birge ratio",
            Cell(f"{birge:.2f}" if np.isfinite(birge) else "unknown"),
            "",
            "1 if the uncertainties are consistent",
        ),
        KeyFigure("Largest |En|", Cell(within(ds["en"].values)[1]), "", "k = 2"),
    ]


def _curves(ds: xr.Dataset, key: str) -> Figure:
    svg = draw(lambda figure: paint(figure, ds), f"{key}-compare", height(ds), WIDTH)
    return Figure(
        svg,
        "Left: errors of each dataset with expanded uncertainty (k = 2). Right: normalised error En of each pair; the "
        "datasets agree where it is between -1 and 1 (green).",
        f"Curves of all datasets over {abscissa(ds)[1]}, and their normalised errors",
    )


def _values(ds: xr.Dataset) -> Table:
    rows: list[Sequence[Cell | str]] = []
    u = 2 * np.sqrt(np.diagonal(ds["covariance"].values, axis1=-2, axis2=-1))
    for k, name in enumerate(str(each) for each in ds["dof"].values):
        factor, unit = field(name)
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
        row = [
            str(name),
            within(ds["en"].values[j])[0],
            f"{ds['chi2'].values[j]:.1f}",
            f"{ds['degrees'].values[j]:.0f}",
        ]
        rows.append([*row, probability(ds["p"].values[j])])
        single.append([str(name), *(probability(p) for p in ds["curve_p"].values[j])])
    whole = Table(
        "Agreement of each pair: fraction of points within the expanded uncertainty, and joint test of all points and "
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
            head = [
                "",
                "cause",
                "size (U, k = 2)",
                "ln likelihood ratio",
                "p of the residuals",
                "indistinguishable from",
            ]
            found.append(
                Table(f"Possible single causes of {name}, the most likely one first", head, rows, numeric=False)
            )
    return found


def _repeats(ds: xr.Dataset) -> list[Section]:
    """Return the section of repeatability and reproducibility; empty without groups."""
    rows: list[Sequence[Cell | str]] = [list(row) for row in spreads(ds)]
    if not rows:
        return []
    groups: dict[str, list[str]] = {}
    for name, group in zip(ds["dataset"].values, ds["group"].values, strict=True):
        groups.setdefault(str(group), []).append(str(name))
    text = "Groups: " + "; ".join(f"{group} ({', '.join(names)})" for group, names in groups.items()) + "."
    caption = (
        "Standard deviations over all points. Found: from the differences of the datasets. Stated: expected from "
        "their uncertainties. p: probability of a larger spread if the uncertainties are correct. Shared by all: "
        "uncertainty from sources that all groups have in common, which repeats do not show."
    )
    return [Section("repeats", "Repeatability and reproducibility", [Text(text), Table(caption, SPREAD_HEAD, rows)])]


def _ground(ds: xr.Dataset) -> str:
    point = ", ".join(f"{1e3 * float(each) + 0.0:g}" for each in np.atleast_1d(ds.attrs["functional_point"]))
    text = (
        f"Machine {ds.attrs['machine']}, {ds.attrs['component']}, frame '{ds.attrs['frame']}', "
        f"functional point ({point}) mm."
    )
    if "since" in ds.attrs:
        text += (
            f" All errors are changes since {float(ds.attrs['since']):g} s after {ds.attrs.get('start') or 'time 0'}."
        )
    return text


def chapters(source: Any) -> list[Part]:
    """Return the chapters of a stored comparison."""
    return [part(source.errors, source.key)]


def texts(language: str) -> dict[str, str]:
    """Return the catalogue of these pages: English text = text in the language."""
    return texts_of(__name__, language)
