"""The chapter of the direction of a beam: comparison with nominal, planes, inclination error, check bar.

It is not made of `errormotion.report.elements`: half of it are drawings that exist nowhere else (the beam in space, the
lines of the planes, the maps of the inclination error, the section of the bar), which need the arrays of `view` anyway.
The tables of direction, zero point and bar have a few rows, each in another unit and with another uncertainty; as
datasets for the parts they would be longer than the tables.
"""

from __future__ import annotations

import math

import numpy as np
import xarray as xr

from errormotion.methods.beam_direction.report import check_bar, drawings, surface
from errormotion.methods.beam_direction.report import planes as planes_section
from errormotion.methods.beam_direction.report.view import STROKES, BeamView, beam_view, is_direction
from errormotion.report import budget, provenance, quality
from errormotion.report.budget import FREEDOMS
from errormotion.report.document import Block, Cell, KeyFigure, Part, Section, Source, Table, Text, estimate, or_dash
from errormotion.report.fields import remarks, unit_of
from errormotion.report.parts.beams import angle_between
from errormotion.report.text import ARCSEC, DASH, finite, fixed, integer, listed, rounded, significant

__all__ = ["is_direction", "part"]

_UNKNOWN = "the direction was not determined"
_NO_ORIGIN = "the known points of the planes do not determine the position of the beam"
_NO_NOMINAL = "the nominal value is unknown"
_ABOUT_ITSELF = "the rotation of a beam about its own axis cannot be measured"
_INDEPENDENT = "noise of the readings"
_UNITS = (("arcsec", ARCSEC), ("mrad", 1e-3), ("°", math.pi / 180))


def part(source: Source, key: str) -> Part:
    """Return the chapter of one beam; ``key`` makes the identifiers of its figures unique."""
    beam = beam_view(source.errors, source.raw)
    calibration, reason = surface.calibration_of(source, beam.planes)
    bar = check_bar.bar_of(source)
    sections = [
        Section("direction", "Direction and origin", _direction(beam, source.errors, key)),
        Section("planes", "Planes and residuals", planes_section.blocks(beam.planes, f"{key}-residual")),
        Section("compensation", "Compensation of the inclination error", _compensation(beam, key)),
        Section(
            "surface",
            "Inclination error of the sensor",
            surface.blocks(beam, calibration, reason, f"{key}-surface"),
        ),
    ]
    if bar is not None:
        sections.append(Section("bar", "Check bar", check_bar.blocks(bar, f"{key}-bar")))
    sections += [
        Section("uncertainty", "Uncertainty", _uncertainty(source.errors, beam)),
        Section("quality", "Data quality", _quality(source)),
        Section("provenance", "Provenance", provenance.blocks(source)),
    ]
    return Part(
        f"Direction of the beam '{beam.name}'",
        _key_figures(beam, bar),
        _summary(beam, source.errors, bar),
        sections,
    )


def _largest_u(beam: BeamView) -> float:
    """Return the largest standard uncertainty of the direction, over all directions across the beam, rad."""
    C = beam.covariance[3:, 3:]
    return float(np.sqrt(np.linalg.eigvalsh(C)[-1].clip(0))) if np.isfinite(C).all() else math.nan


def _to_nominal(beam: BeamView) -> tuple[float, float]:
    """Return the angle to nominal and its standard uncertainty, rad; NaN if either direction is unknown."""
    if not (beam.known and np.isfinite(beam.nominal).all()):
        return math.nan, math.nan
    return angle_between(beam.direction, beam.nominal, beam.covariance[3:, 3:])


def _shift(beam: BeamView) -> float:
    return float(np.linalg.norm(beam.origin - beam.nominal_origin))


def _key_figures(beam: BeamView, bar: check_bar.Bar | None) -> list[KeyFigure]:
    figures = []
    angle, sigma = _to_nominal(beam)
    if math.isfinite(angle):
        value = estimate(angle / ARCSEC, 2 * sigma / ARCSEC, signed=False)
        figures.append(KeyFigure("angle to nominal", value, "arcsec", f"{fixed(1e3 * angle, 3)} mrad"))
    if math.isfinite(_largest_u(beam)):
        value = Cell(significant(2 * _largest_u(beam) / ARCSEC))
        figures.append(
            KeyFigure("uncertainty of the direction", value, "arcsec", "U, k = 2, largest over all directions")
        )
    if math.isfinite(_shift(beam)):
        figures.append(KeyFigure("zero point", Cell(fixed(1e6 * _shift(beam), 0)), "µm", "from nominal"))
    if beam.known and beam.compensated:
        change = drawings.angle_between(beam.direction, beam.uncompensated)
        note = "of the direction, by the compensation of the inclination error"
        figures.append(KeyFigure("correction", Cell(fixed(change / ARCSEC, 0)), "arcsec", note))
    if bar is not None and math.isfinite(bar.rms):
        out = int(bar.left_out.sum())
        note = f"rms; {integer(out)} {'point' if out == 1 else 'points'} left out"
        figures.append(KeyFigure("check bar residual", Cell(fixed(1e6 * bar.rms, 2)), "µm", note))
    return figures


def _summary(beam: BeamView, errors: xr.Dataset, bar: check_bar.Bar | None) -> list[str]:
    planes = beam.planes
    sentences = []
    if len(planes):
        used, out = int((planes.given & ~planes.left_out).sum()), int(planes.left_out.sum())
        left = f"; {integer(out)} left out" if out else ""
        count = f"{integer(len(planes))} planes" if len(planes) != 1 else "one plane"
        sentences.append(f"The direction was determined from {integer(used)} readings on {count}{left}.")
    angle, sigma = _to_nominal(beam)
    if not beam.known:
        sentences.append("The direction could not be determined.")
    elif not math.isfinite(angle):
        sentences.append("No nominal direction was given for comparison.")
    else:
        value, expanded = rounded(angle / ARCSEC, 2 * sigma / ARCSEC, signed=False)
        within = f" ± {expanded}" if expanded != DASH else ""
        sentences.append(
            f"The angle between beam and nominal is {value}{within} arcsec, which is {fixed(1e4 * angle, 1)} µm over "
            "10 mm."
        )
    if beam.known and math.isfinite(_shift(beam)):
        sentences.append(f"The zero point is {fixed(1e6 * _shift(beam), 0)} µm from nominal.")
    elif beam.known and not np.isfinite(beam.origin).all():
        sentences.append(f"The zero point is unknown: {_NO_ORIGIN}.")
    sentences += _inclination_sentences(beam)
    off = planes_section.not_closed(planes) if np.isfinite(planes.closure).sum() > 2 else []
    if off:
        sentences.append(
            f"The planes contradict one another: {listed([f'plane {name}' for name, _ in off])} "
            f"{'do' if len(off) > 1 else 'does'} not close."
        )
    if bar is not None and math.isfinite(bar.radius):
        known = f" (known: {fixed(1e3 * bar.given, 4)} mm)" if math.isfinite(bar.given) else ""
        sentences.append(f"The measured radius of the check bar is {fixed(1e3 * bar.radius, 4)} mm{known}.")
    unknown = [name for name in FREEDOMS if not np.isfinite(errors[name].values).any()]
    if beam.known and unknown:
        sentences.append(f"Not determined: {listed(unknown)}. Reported as unknown, not as zero.")
    return sentences


def _inclination_sentences(beam: BeamView) -> list[str]:
    correction = np.abs(beam.planes.compensation)
    if beam.known and beam.compensated:
        change = drawings.angle_between(beam.direction, beam.uncompensated)
        return [
            f"Up to {fixed(1e6 * finite(np.max, correction), 1)} µm of inclination error were subtracted from the "
            f"readings; without this correction the direction would differ by {fixed(change / ARCSEC, 0)} arcsec."
        ]
    tilted = beam.planes.inclination[np.isfinite(beam.planes.inclination)]
    if beam.known and tilted.size and not np.nan_to_num(correction).any():
        return [
            "The readings were not compensated for the tilt of the planes (up to "
            f"{fixed(np.rad2deg(tilted.max()), 0)}°); an inclination error of the sensor changes the direction and is "
            "not included in the uncertainty."
        ]
    return []


def _direction(beam: BeamView, errors: xr.Dataset, key: str) -> list[Block]:
    if not beam.known:
        return [Text("The direction could not be determined.", "warning")]
    figures = [drawings.space(beam, f"{key}-space"), drawings.lines(beam, f"{key}-lines")]
    present = [figure for figure in figures if figure is not None]
    return [*present, _angles(beam, errors), _vectors(beam), _origins(beam)]


def _angles(beam: BeamView, errors: xr.Dataset) -> Table:
    angle, sigma = _to_nominal(beam)
    rows = [["to nominal", *_in_units(angle, sigma, _NO_NOMINAL, signed=False)]]
    for i, name in enumerate(FREEDOMS[3:]):
        value = float(errors[name].values[0])
        variance = float(errors["covariance"].isel(beam=0, dof=3 + i, dof_=3 + i))
        deviation = math.sqrt(variance) if variance >= 0 else math.nan
        reason = _ABOUT_ITSELF if np.abs(beam.nominal[i]) > 0.99 else _UNKNOWN
        rows.append([f"{name}, about {STROKES[i]}", *_in_units(value, deviation, reason)])
    return Table(
        "Angles from the nominal to the measured direction: the smallest rotation from one to the other, and its "
        "components about the machine's axes. After ±: expanded uncertainty, k = 2.",
        ["angle", *(f"/ {unit}" for unit, _ in _UNITS)],
        rows,
    )


def _in_units(value: float, sigma: float, reason: str, *, signed: bool = True) -> list[Cell | str]:
    return [estimate(value / size, 2 * sigma / size, reason=reason, signed=signed) for _, size in _UNITS]


def _vectors(beam: BeamView) -> Table:
    variance = np.diag(beam.covariance[3:, 3:])
    sigma = np.sqrt(np.where(variance >= 0, variance, np.nan))
    rows: list[list[Cell | str]] = []
    for i, name in enumerate(STROKES):
        sine = math.sqrt(max(1 - beam.direction[i] ** 2, 0.0))
        # Near an axis the angle to it is not linear; the largest uncertainty of the direction is used.
        spread = sigma[i] / sine if sine > 1e-2 else _largest_u(beam)
        inclined = math.acos(float(np.clip(beam.direction[i], -1, 1)))
        row: list[Cell | str] = [
            f"u_{name.lower()}",
            estimate(beam.direction[i], 2 * sigma[i], digits=7),
            or_dash(fixed(beam.nominal[i], 7, signed=True), _NO_NOMINAL),
        ]
        if beam.compensated:
            row.append(fixed(beam.uncompensated[i], 7, signed=True))
        rows.append([*row, estimate(math.degrees(inclined), math.degrees(2 * spread), signed=False, digits=6)])
    before = ["without compensation"] if beam.compensated else []
    return Table(
        "Direction as a unit vector, from the sensor to the target, and its angle to each machine axis. After ±: "
        "expanded uncertainty, k = 2; the three components are not independent.",
        ["", "measured", "nominal", *before, "angle to the axis / °"],
        rows,
    )


def _origins(beam: BeamView) -> Block:
    if not np.isfinite(beam.origin).any():
        return Text(f"The zero point of the beam is unknown: {_NO_ORIGIN}.")
    variance = np.diag(beam.covariance[:3, :3])
    expanded = 2 * np.sqrt(np.where(variance >= 0, variance, np.nan))
    difference = beam.origin - beam.nominal_origin
    rows: list[list[Cell | str]] = [
        [
            name.lower(),
            estimate(1e3 * beam.origin[i], 1e3 * expanded[i], reason=_NO_ORIGIN),
            or_dash(fixed(1e3 * beam.nominal_origin[i], 3, signed=True), _NO_NOMINAL),
            estimate(1e6 * difference[i], 1e6 * expanded[i], reason=_NO_NOMINAL),
        ]
        for i, name in enumerate(STROKES)
    ]
    return Table(
        "Zero point: point of the beam at which the reading is 0, with the stage at its zero. After ±: expanded "
        "uncertainty, k = 2.",
        ["", "measured / mm", "nominal / mm", "difference / µm"],
        rows,
    )


def _compensation(beam: BeamView, key: str) -> list[Block]:
    corrections = planes_section.compensation(beam.planes, f"{key}-compensation")
    if not (beam.compensated and beam.known):
        if corrections:
            return corrections
        return [
            Text(
                "The readings were not corrected. On an inclined surface a triangulation sensor has an error "
                "proportional to depth; on a plane it changes the gradient, and therefore the direction.",
                "note",
            )
        ]
    rows: list[list[Cell | str]] = []
    for name, direction in (("without compensation", beam.uncompensated), ("compensated", beam.direction)):
        to_nominal = drawings.angle_between(direction, beam.nominal)
        off = drawings.angle_between(direction, beam.direction)
        rows.append(
            [
                name,
                *(fixed(value, 6, signed=True) for value in direction),
                or_dash(fixed(to_nominal / ARCSEC, 1), _NO_NOMINAL),
                fixed(off / ARCSEC, 1),
                fixed(math.degrees(off), 4),
            ]
        )
    table = Table(
        "Direction before and after compensation.",
        ["", "u_x", "u_y", "u_z", "to nominal / arcsec", "to the result / arcsec", "/ °"],
        rows,
        [("", 1), ("direction", 3), ("angle", 3)],
    )
    return [table, *corrections]


def _uncertainty(errors: xr.Dataset, beam: BeamView) -> list[Block]:
    here = errors.isel(beam=0)
    point = ", ".join(fixed(1e3 * float(value), 3) for value in np.atleast_1d(errors.attrs["functional_point"]))
    blocks: list[Block] = []
    if "influence" in errors and beam.known:
        blocks.append(budget.table(here, f"of the beam '{beam.name}'", _INDEPENDENT))
    else:
        blocks.append(_freedoms(here))
    blocks.append(
        Text(
            f"The errors are those of the beam relative to nominal, about the zero point ({point}) mm in the frame "
            f"'{errors.attrs.get('frame', 'not stated')}'. The uncertainty includes noise of the readings and the "
            "listed sources. It does not include straightness and squareness of the stage and flatness of the planes.",
            "note",
        )
    )
    return blocks


def _freedoms(here: xr.Dataset) -> Table:
    rows: list[list[Cell | str]] = []
    for i, name in enumerate(FREEDOMS):
        unit, size = unit_of(i)
        variance = float(here["covariance"].isel(dof=i, dof_=i))
        sigma = math.sqrt(variance) if variance >= 0 else math.nan
        reason = _NO_ORIGIN if i < 3 else _ABOUT_ITSELF
        rows.append([name, unit, estimate(float(here[name]) / size, 2 * sigma / size, reason=reason)])
    return Table(
        "Errors of the beam relative to nominal. After ±: expanded uncertainty, k = 2.",
        ["freedom", "unit", "value"],
        rows,
    )


def _quality(source: Source) -> list[Block]:
    errors = source.errors
    blocks: list[Block] = [Text(note, "warning") for note in remarks(errors)]
    if "noise" in errors and np.isfinite(errors["noise"].values).any():
        noise = float(errors["noise"].values.ravel()[0])
        blocks.append(
            Text(f"Noise of one reading about its plane: {significant(1e6 * noise)} µm, one standard deviation.")
        )
    counts = quality.counts(errors, source.raw)
    if counts:
        events = ", ".join(f"{name} {number}" for name, number in counts.items())
        blocks.append(Text(f"Events during the measurement: {events}."))
    return blocks or [Text("The result contains no remarks on the data.", "note")]
