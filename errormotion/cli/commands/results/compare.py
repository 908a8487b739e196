"""``errormotion compare``: whether several results of one machine agree, and possible causes of differences."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from errormotion import datasets
from errormotion.cli.output import show, show_json, table, working
from errormotion.cli.page import Page, new_files
from errormotion.cli.results import Loaded, load
from errormotion.compare import compare as compared
from errormotion.compare.comparable import parts_compared
from errormotion.compare.repeats import labels
from errormotion.compare.text import SPREAD_HEAD, cause_text, probability, spreads, verdict, within
from errormotion.datasets.schemas import STRAIGHTNESS_REFERENCES
from errormotion.errors import DatasetError


@dataclass(frozen=True)
class Stated:
    """Options on the results: names, changes, origins of frames (m), chain, grouping, dims, straightness."""

    names: list[str]
    changes: list[str]
    origins: dict[str, tuple[float, float, float]]
    chain: str | None
    by: str | None = None
    over: str | None = None
    select: Sequence[str] = ()
    straightness: Sequence[str] = ()


def compare(
    paths: list[Path],
    stated: Stated,
    at: tuple[float, float, float] | None,
    freedoms: list[str],
    since: float | None,
    same_start: bool,
    out: Path | None,
    page: Page | None,
    as_json: bool,
) -> xr.Dataset:
    """Compare error datasets, print the comparison, and write the requested files.

    Raises
    ------
    DatasetError
        The datasets cannot be read or compared, or a file already exists.
    """
    files = new_files(page, out)
    loaded = load(paths, _named(stated.names), every=stated.by is not None)
    results, left_out = _of_one_part(loaded, _completed(loaded.results, stated))
    left_out += loaded.omitted
    results = {name: over_one(name, ds, stated) for name, ds in results.items()}
    if not freedoms and loaded.chosen >= set(results):
        freedoms = _of_one_body(results, left_out)
    groups = _groups(results, stated.by)
    with working(f"Comparing {len(results)} results"):
        found = compared(results, at=at, freedoms=freedoms, since=since, same_start=same_start, groups=groups)
    if stated.over is not None and stated.over not in found["value"].dims:
        raise DatasetError(
            f"--over {stated.over}: the results are compared over {_common(found) or 'nothing'}",
            code="compare.over.unknown",
        )
    if left_out:
        found.attrs["notes"] = [*filter(None, found.attrs["notes"]), *left_out]
    if out is not None:
        datasets.save(found, out)
    if page is not None:
        from errormotion.compare.report import write

        write(found, page.file, page.form)
    if as_json:
        show_json(as_plain(found))
        return found
    show(text(found))
    for path in files:
        show(f"written: {path}")
    return found


def _of_one_part(loaded: Loaded, results: dict[str, xr.Dataset]) -> tuple[dict[str, xr.Dataset], list[str]]:
    """Return the results of one part of the machine, and a note on each that was chosen from a folder and is left out.

    Raises
    ------
    DatasetError
        A result that was named is of another part than the others.
    """
    part = {name: parts_compared(str(ds.attrs["component"])) for name, ds in results.items()}
    most = max(part.values(), key=lambda each: sum(other & each != set() for other in part.values()), default=set())
    others = [name for name, each in part.items() if not each & most]
    kept = [name for name in results if name not in others]
    if not others or len(kept) < 2:
        return results, []
    named = [name for name in others if name not in loaded.chosen]
    if named:
        shown = "; ".join(f"'{name}': {results[name].attrs['component']}" for name in results)
        places = dict.fromkeys(str(loaded.paths[name]) for name in kept if name in loaded.paths)
        raise DatasetError(
            f"The results are of different parts of the machine ({shown}). Compare those of one part: "
            f"errormotion compare {' '.join(places)}",
            code="compare.component.differs",
        )
    return {name: results[name] for name in kept}, [
        f"omitted: '{name}', whose component '{results[name].attrs['component']}' differs from that of the others."
        for name in others
    ]


def _of_one_body(results: dict[str, xr.Dataset], notes: list[str]) -> list[str]:
    """Return the displacements that all results state if their rotations are of different bodies, else nothing."""
    if len({str(ds.attrs.get("lever_axes", "XYZ")) for ds in results.values()}) < 2:
        return []
    notes.append("The rotations are those of different bodies (attribute lever_axes): only displacements are compared.")
    return [name for name in datasets.DOF[:3] if all(np.isfinite(ds[name]).any() for ds in results.values())]


def _named(names: list[str]) -> dict[str, Path]:
    found = {}
    for each in names:
        name, equals, path = each.partition("=")
        if not (name and equals and path):
            raise DatasetError(
                f"--name {each}: expected NAME=PATH, as in --name 'five sensors=runs/drift-1'", code="option.form"
            )
        found[name] = Path(path)
    return found


def _completed(results: dict[str, xr.Dataset], stated: Stated) -> dict[str, xr.Dataset]:
    """Return the results with what the command line states about them."""
    found = dict(results)
    for each in stated.changes:
        name, _, paths = each.partition("=")
        parts = [part for part in paths.split(",") if part]
        if not name or len(parts) != 2:
            raise DatasetError(
                f"--change {each}: expected NAME=AFTER,BEFORE, as in --change volume=warm.nc,cold.nc",
                code="option.form",
            )
        both = load([], {"after": Path(parts[0]), "before": Path(parts[1])}).results
        found[name] = both["after"].em.change_from(both["before"])
    if unmatched := [name for name in stated.origins if name not in found]:
        raise DatasetError(
            f"--origin {unmatched[0]}: expected the name of a result: {', '.join(found)}", code="compare.result.unknown"
        )
    for name, origin in stated.origins.items():
        found[name] = found[name].assign_attrs(frame_origin=np.array(origin))
    for each in stated.straightness:
        name, _, place = each.rpartition("=")
        if name not in found or place not in STRAIGHTNESS_REFERENCES:
            raise DatasetError(
                f"--straightness {each}: expected NAME={' or NAME='.join(STRAIGHTNESS_REFERENCES)}, with the name of a "
                f"result: {', '.join(found)}",
                code="option.form",
            )
        found[name] = found[name].assign_attrs({"straightness_reference": place} | found[name].attrs)
    if stated.chain is not None:
        found = {name: ds.assign_attrs({"chain": stated.chain} | ds.attrs) for name, ds in found.items()}
    return found


def over_one(name: str, ds: xr.Dataset, stated: Stated) -> xr.Dataset:
    """Return a result at the selected element of every dimension other than that of the comparison."""
    for each in stated.select:
        dim, _, index = each.partition("=")
        if not dim or not re.fullmatch("[0-9]{1,9}", index):
            raise DatasetError(f"--select {each}: expected DIM=NUMBER, as in --select position=3", code="option.form")
        if dim in ds["EX"].dims:
            if int(index) >= ds.sizes[dim]:
                raise DatasetError(
                    f"--select {each}: '{name}' has the elements {dim}=0 to {dim}={ds.sizes[dim] - 1}",
                    code="errors.index.outside",
                )
            ds = ds.isel({dim: int(index)})
    others = map(str, ds["EX"].dims) if stated.over is not None and len(ds["EX"].dims) > 1 else ()
    for dim in others:
        if dim != stated.over and ds.sizes[dim] > 1:
            raise DatasetError(
                f"'{name}': its errors depend on {', '.join(map(str, ds['EX'].dims))}; select one {dim}, "
                f"as in --select {dim}=0 (0 to {ds.sizes[dim] - 1})",
                code="compare.dims.too_many",
            )
        ds = ds if dim == stated.over else ds.isel({dim: 0})
    return ds


def _common(found: xr.Dataset) -> str:
    return ", ".join(str(dim) for dim in found["value"].dims if dim not in ("dataset", "dof"))


def _groups(results: dict[str, xr.Dataset], by: str | None) -> dict[str, str] | None:
    """Return the group of each result; without ``by`` the repeats of each test, or None if there are none."""
    if by not in (None, "test"):
        return labels(results, str(by))
    tests = {name: re.sub(r" \(\d+\)$", "", name) for name in results}
    return tests if by or len(set(tests.values())) < len(tests) else None


def text(ds: xr.Dataset) -> str:
    """Return the comparison as text."""
    names = [str(name) for name in ds["dof"].values]
    rows = []
    for j, pair in enumerate(ds["pair"].values):
        p = [probability(each) for each in (ds["p"].values[j], *ds["curve_p"].values[j])]
        rows.append([str(pair), *within(ds["en"].values[j]), *p])
    head = ["pair", "|En| <= 1", "max |En|", "p", *(f"p {name}" for name in names)]
    notes = [note for note in ds.attrs["notes"] if note]
    spread = [list(row) for row in spreads(ds)]
    more = ["", table(SPREAD_HEAD, spread)] if spread else []
    return "\n".join([*verdict(ds), "", table(head, rows), *more, *(["", *notes] if notes else [])])


def as_plain(ds: xr.Dataset) -> dict[str, Any]:
    """Return the comparison for JSON output."""
    pairs = []
    for j, pair in enumerate(ds["pair"].values):
        causes = [cause_text(ds, j, rank) for rank in range(ds.sizes["rank"])]
        pairs.append(
            {
                "pair": str(pair),
                "chi2": float(ds["chi2"].values[j]),
                "degrees": int(ds["degrees"].values[j]),
                "p": float(ds["p"].values[j]),
                "p_of_freedoms": dict(
                    zip(map(str, ds["dof"].values), map(float, ds["curve_p"].values[j]), strict=True)
                ),
                "causes": [cause._asdict() for cause in causes if cause is not None],
            }
        )
    return {
        "ok": True,
        "agree": bool(ds.attrs["fit_p"] >= 0.05),
        "p": float(ds.attrs["fit_p"]),
        "birge_ratio": float(ds.attrs["birge_ratio"]),
        "verdict": verdict(ds),
        "misfit_p": dict(zip(map(str, ds["dataset"].values), map(float, ds["misfit_p"].values), strict=True)),
        "pairs": pairs,
        **({"spread": [row._asdict() for row in spreads(ds)]} if "spread" in ds.variables else {}),
        "notes": [note for note in ds.attrs["notes"] if note],
    }
