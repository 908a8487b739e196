"""Chapter of a multilateration: errors of the volume, the network, errors of the axes, and undetermined freedoms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import xarray as xr

from errormotion.kinematics.iso import DOF
from errormotion.methods.multilateration.figures import root_mean_square
from errormotion.methods.multilateration.report import axes, drawings, plan, quality
from errormotion.methods.multilateration.report.view import Network, is_multilateration, network, scalar
from errormotion.report import budget, provenance
from errormotion.report.document import Block, Cell, KeyFigure, Part, Section, Source, Table, Text, estimate, or_dash
from errormotion.report.fields import remarks
from errormotion.report.text import DASH, finite, fixed, integer, significant

__all__ = ["is_multilateration", "part"]

_OWN = "noise of the target's own readings"
_WORDS = {
    "stations": "stations, by the noise of the readings",
    "targets": "targets that define the datum, by the noise of the readings",
}
_UNKNOWN = "not determined at any target"
_RIGID_MOTIONS = (
    "Distances determine only the positions of the targets relative to one another. The six rigid motions of the "
    "volume, three translations and three rotations, are not determined: the targets are fitted to their commanded "
    "positions. An error that displaces or rotates the whole volume does not appear here, and is not in the "
    "uncertainty."
)
_ROTATIONS = (
    "A reflector is a point: rotations of the tool at a target, EA to EC, are unknown, not zero. Rotations of the axes "
    "are measured only as displacements of the reflector."
)


def part(source: Source, key: str) -> Part:
    """Return the chapter of one result; ``key`` is a unique prefix of the identifiers of its figures."""
    errors = source.errors
    net = network(errors, source.raw)
    planned = "target_uncertainty" in errors
    volume: list[Block] = [] if planned else [_table(net)]
    if not planned:
        volume += [
            drawings.vectors(net, f"{key}-vectors"),
            drawings.slices(net, f"{key}-slices"),
            drawings.histograms(net, f"{key}-histograms"),
        ]
    stations: list[Block] = [
        drawings.layout(net, f"{key}-layout"),
        quality.planned(errors, net) if planned else quality.stations(net),
    ]
    predicted = plan.blocks(errors, f"{key}-map")
    sections = [
        *([Section("volume", "Errors of the volume", volume)] if volume else []),
        *([Section("map", "Predicted uncertainty", predicted)] if predicted else []),
        Section("unseen", "Undetermined freedoms", [Text(_RIGID_MOTIONS, "warning"), Text(_ROTATIONS)]),
        Section("stations", "Stations", stations),
        Section("uncertainty", "Uncertainty", _uncertainty(errors, net, key)),
    ]
    if not planned:
        sections += [
            Section("axes", "Errors of the axes", axes.blocks(errors, f"{key}-axes")),
            Section("quality", "Readings", _readings(errors, net, key)),
        ]
    else:
        sections.append(Section("quality", "Remarks", _remarks(errors)))
    sections.append(Section("provenance", "Provenance", provenance.blocks(source)))
    title = "Expected uncertainty of a multilateration" if planned else "Volumetric errors by multilateration"
    return Part(title, _key_figures(errors, net, planned), _summary(errors, net, planned), sections)


def _key_figures(errors: xr.Dataset, net: Network, planned: bool) -> list[KeyFigure]:
    found = []
    longest = None if planned else errors.em.largest(*DOF[:3])
    if longest is not None:
        value = estimate(1e6 * longest.value, 1e6 * longest.expanded, signed=False)
        found.append(KeyFigure("longest error vector", value, "µm", f"at {net.targets[longest.place]}"))
        value = estimate(*(1e6 * each for each in root_mean_square(errors)), signed=False)
        found.append(KeyFigure("root mean square", value, "µm", "of the error vectors"))
    sigma = net.worst_direction
    if np.isfinite(sigma).any():
        middle = Cell(significant(2e6 * finite(np.median, sigma)))
        found.append(KeyFigure("uncertainty of the targets", middle, "µm", "U, k = 2, worst direction, median"))
        found.append(KeyFigure("largest uncertainty", Cell(significant(2e6 * finite(np.max, sigma))), "µm", "U, k = 2"))
    out = int((net.left_out > 0).sum())
    if np.isfinite(net.residual).any():
        used = int((np.isfinite(net.residual) & (net.left_out == 0)).sum())
        found.append(KeyFigure("readings", Cell(integer(used)), "", f"used; {integer(out)} ignored"))
    return found


def _summary(errors: xr.Dataset, net: Network, planned: bool) -> list[str]:
    known = int(np.isfinite(net.length).sum())
    m, n = len(net.targets), len(net.stations)
    words = [f"{integer(m)} targets" + (f" from {integer(n)} positions of the tracker." if n else ".")]
    if planned:
        words = [f"Planned, not measured: {words[0]}"]
    elif known < m:
        words.append(f"The errors of {integer(m - known)} targets are unknown.")
    if not planned and net.worst is not None:
        cells = [fixed(1e6 * v, 1, signed=True) for v in net.error[net.worst]]
        words.append(f"The longest error vector is ({', '.join(cells)}) µm.")
    sigma0, freedom = scalar(errors, "sigma0"), scalar(errors, "freedom")
    if math.isfinite(sigma0) and freedom > 0:
        words.append(
            f"The scatter of the readings is {fixed(sigma0, 2)} times the stated one; there are {integer(freedom)} "
            "more readings than unknowns."
        )
    elif freedom == 0:
        words.append("There are as many readings as unknowns, so that there is no check.")
    words.append("Translations and rotations of the whole volume are not determined.")
    return words


def _table(net: Network) -> Table:
    rows: list[list[Cell | str]] = []
    columns = [*zip(("EX", "EY", "EZ"), net.error.T, net.sigma.T, strict=True), ("length", net.length, None)]
    for name, values, sigma in columns:
        spans = [finite(np.min, values), finite(np.max, values), float(np.sqrt(finite(np.mean, values**2)))]
        expanded = [math.nan, math.nan] if sigma is None else [2 * finite(f, sigma) for f in (np.median, np.max)]
        reason = "see the ellipsoids" if sigma is None else _UNKNOWN
        rows.append(
            [
                name,
                *(
                    or_dash(fixed(1e6 * v, 2, signed=k < 2 and sigma is not None), _UNKNOWN)
                    for k, v in enumerate(spans)
                ),
                *(or_dash(significant(1e6 * v), reason) for v in expanded),
            ]
        )
    return Table(
        "Errors of the targets in µm: actual minus commanded, after the best rigid fit.",
        ["error", "lowest", "highest", "root mean square", "U (k = 2), median", "U, largest"],
        rows,
    )


def _uncertainty(errors: xr.Dataset, net: Network, key: str) -> list[Block]:
    found: list[Block] = [drawings.ellipsoids(net, f"{key}-ellipsoids")]
    sigma = net.worst_direction
    if "influence" not in errors or not np.isfinite(sigma).any():
        return [*found, Text("The result does not state the sources of its uncertainty.", "note")]
    worst = int(np.nanargmax(sigma))
    table = budget.table(errors.isel(target=worst), f"at {net.targets[worst]}, the target with the largest uncertainty")
    own = budget.readable("independent")
    rows = [[_WORDS.get(str(row[0]), _OWN if row[0] == own else row[0]), *row[1:]] for row in table.rows]
    found.append(replace(table, rows=rows))
    shared = _shared(errors)
    if shared:
        found.append(Text(f"Of the variance of that target, {shared} is shared with other targets.", "plain"))
    return found


def _shared(errors: xr.Dataset) -> str:
    variance = np.asarray(errors["covariance"].transpose("target", "dof", "dof_").values, float)[:, :3, :3]
    trace = np.trace(variance, axis1=1, axis2=2)
    if not np.isfinite(trace).any():
        return ""
    worst = int(np.nanargmax(trace))
    influence = np.asarray(errors["influence"].isel(target=worst).transpose("source", "dof").values, float)[:, :3]
    share = float(np.nansum(influence**2) / trace[worst])
    return f"{fixed(100 * min(share, 1.0), 0)} %" if math.isfinite(share) else ""


def _shares(errors: xr.Dataset) -> list[tuple[str, str]]:
    """Return the share of each cause in the variance of a reading, if there are several."""
    found = errors.get("scatter_share")
    if found is None or found.dims != ("cause",) or found.size < 2:
        return []
    names = {"stations": "tracker", "repeatability": "repeatability of the machine"}
    causes = [str(cause) for cause in found["cause"].values]
    return [
        (f"share of the {names.get(cause, cause)} in the variance of a reading / %", fixed(100 * float(share), 0))
        for cause, share in zip(causes, found.values, strict=True)
    ]


def _remarks(errors: xr.Dataset) -> list[Block]:
    return [Text(note, "warning") for note in remarks(errors) if "\n" not in note]  # the map as text: drawn above


def _readings(errors: xr.Dataset, net: Network, key: str) -> list[Block]:
    facts = [
        ("noise of a reading, as used / µm", fixed(1e6 * net.noise, 2)),
        ("ratio of the scatter to the stated one", fixed(scalar(errors, "sigma0"), 3)),
        ("readings minus unknowns", integer(scalar(errors, "freedom"))),
        ("condition of the determined freedoms", significant(scalar(errors, "condition"), 3)),
        ("repeatability of the machine / µm", fixed(1e6 * scalar(errors, "repeatability"), 2)),
        ("its standard uncertainty / µm", fixed(1e6 * scalar(errors, "repeatability_u"), 2)),
        *_shares(errors),
    ]
    rows: list[list[Cell | str]] = [[name, value] for name, value in facts if value != DASH]
    found = [*_remarks(errors), *quality.left_out(net)]
    found.append(quality.residuals(net, f"{key}-residuals"))
    if rows:
        found.append(Table("The solution.", ["quantity", "value"], rows))
    return found
