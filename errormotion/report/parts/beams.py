"""Chapter of a beam detection: origins and directions, their uncertainty, and deviation from nominal."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from matplotlib.figure import Figure as Canvas

from errormotion.report import canvas, provenance, quality
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
from errormotion.report.drawings.series import LOOK
from errormotion.report.text import ARCSEC, DASH, finite, fixed, integer, listed, rounded, significant

_UNKNOWN = "the beam was not determined"


def part(source: Source, key: str) -> Part:
    """Return the chapter of one beam detection; ``key`` makes the identifiers of its figures unique."""
    errors = source.errors
    return Part(
        "Detection of the laser beams",
        _key_figures(errors),
        _summary(errors),
        [
            Section("beams", "Origins and directions", _beams(errors)),
            Section("nominal", "Difference from nominal", _nominal(errors)),
            Section("constructions", "Circles and line compared with the likelihood fit", _constructions(errors)),
            Section("quality", "Residuals and data quality", [*quality.notes(errors), *_residuals(errors, key)]),
            Section("provenance", "Provenance", provenance.blocks(source)),
        ],
    )


def angle_between(
    direction: np.ndarray, other: np.ndarray, covariance: np.ndarray | None = None
) -> tuple[float, float]:
    """Return the angle between two unit vectors and its standard uncertainty, rad.

    Parameters
    ----------
    direction, other : ndarray, (3,)
    covariance : ndarray, (3, 3), optional
        Of ``direction``, in rad^2; without it the uncertainty is NaN. If the two vectors coincide, the angle is not
        linear, and the uncertainty is that of the worst perpendicular direction.
    """
    across = direction - (direction @ other) * other
    angle = math.atan2(float(np.linalg.norm(across)), float(direction @ other))
    if covariance is None or not np.isfinite(covariance).all():
        return angle, math.nan
    worst = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1].clip(0)))
    size = np.linalg.norm(across)
    if size < worst:
        return angle, worst
    toward = across / size
    return angle, float(np.sqrt(max(toward @ covariance @ toward, 0.0)))


def _names(errors: xr.Dataset) -> list[str]:
    if "beam" in errors.coords:
        return [str(name) for name in errors["beam"].values]
    return [f"beam {i + 1}" for i in range(errors.sizes["beam"])]


def _vectors(errors: xr.Dataset, name: str) -> np.ndarray | None:
    """Return a variable (beam, direction); None if the dataset does not contain it."""
    return errors[name].transpose("beam", "direction").values if name in errors else None


def _covariance(errors: xr.Dataset) -> np.ndarray:
    """Return the covariance (beam, 6, 6) over origin and direction; NaN if the dataset does not contain it."""
    if "beam_covariance" not in errors:
        return np.full((errors.sizes["beam"], 6, 6), np.nan)
    return errors["beam_covariance"].transpose("beam", "p", "p_").values


def _differences(errors: xr.Dataset) -> list[tuple[float, float, float]]:
    """Return per beam: distance of origins (m), angle to nominal (rad) and its standard uncertainty."""
    origin, direction = _vectors(errors, "beam_origin"), _vectors(errors, "beam_direction")
    at, toward = _vectors(errors, "nominal_origin"), _vectors(errors, "nominal_direction")
    if origin is None or direction is None or at is None or toward is None:
        return []
    covariance = _covariance(errors)
    return [
        (float(np.linalg.norm(origin[i] - at[i])), *angle_between(direction[i], toward[i], covariance[i, 3:, 3:]))
        for i in range(len(origin))
    ]


def _key_figures(errors: xr.Dataset) -> list[KeyFigure]:
    found, names = _differences(errors), _names(errors)
    known = [i for i, row in enumerate(found) if math.isfinite(row[0])]
    if not known:
        return []
    far, off = max(known, key=lambda i: found[i][0]), max(known, key=lambda i: found[i][1])
    sigma = np.sqrt(np.einsum("bii->bi", _covariance(errors)))
    return [
        KeyFigure(
            "largest deviation of origin", Cell(fixed(1e6 * found[far][0], 0)), "µm", f"{names[far]}, from nominal"
        ),
        KeyFigure(
            "largest angle",
            estimate(found[off][1] / ARCSEC, 2 * found[off][2] / ARCSEC, signed=False),
            "arcsec",
            f"{names[off]}, from nominal",
        ),
        KeyFigure(
            "uncertainty of origin", Cell(significant(2e6 * finite(np.max, sigma[:, :3]))), "µm", "largest U, k = 2"
        ),
        KeyFigure(
            "uncertainty of direction",
            Cell(significant(2 * finite(np.max, sigma[:, 3:]) / ARCSEC)),
            "arcsec",
            "largest U, k = 2",
        ),
    ]


def _summary(errors: xr.Dataset) -> list[str]:
    names, found = _names(errors), _differences(errors)
    origin = _vectors(errors, "beam_origin")
    missing = [name for i, name in enumerate(names) if origin is None or not np.isfinite(origin[i]).all()]
    words = [f"{len(names) - len(missing)} of {len(names)} beams were determined."]
    if missing:
        words.append(f"Not determined: {listed(missing)}.")
    known = [(name, row) for name, row in zip(names, found, strict=False) if math.isfinite(row[0])]
    if known:
        far, off = max(known, key=lambda entry: entry[1][0]), max(known, key=lambda entry: entry[1][1])
        angle, expanded = rounded(off[1][1] / ARCSEC, 2 * off[1][2] / ARCSEC, signed=False)
        words.append(
            f"Origins deviate from nominal by up to {fixed(1e6 * far[1][0], 0)} µm ({far[0]}) and directions by "
            f"up to {angle} ± {expanded} arcsec ({off[0]}); an evaluation with nominal beams would have errors from "
            "these differences."
        )
    both = _construction_differences(errors)
    both = [row for row in both if math.isfinite(row[0])]
    if both:
        words.append(
            "The construction from circles and a line agrees with the likelihood fit within "
            f"{fixed(1e6 * max(row[0] for row in both), 1)} µm and "
            f"{fixed(max(row[1] for row in both) / ARCSEC, 0)} arcsec."
        )
    return words


def _beams(errors: xr.Dataset) -> list[Block]:
    origin, direction = _vectors(errors, "beam_origin"), _vectors(errors, "beam_direction")
    if origin is None or direction is None:
        return [Text("The result contains no origins and directions.", "warning")]
    expanded = 2 * np.sqrt(np.einsum("bii->bi", _covariance(errors)))
    names = _names(errors)
    origins: list[list[Cell | str]] = []
    directions: list[list[Cell | str]] = []
    noise = errors["noise"].values if "noise" in errors else np.full(len(names), np.nan)
    for i, name in enumerate(names):
        origins.append(
            [
                name,
                *(estimate(1e3 * v, 1e3 * u, reason=_UNKNOWN) for v, u in zip(origin[i], expanded[i, :3], strict=True)),
                or_dash(fixed(1e6 * noise[i], 2), "no noise was stated"),
            ]
        )
        across = np.nan_to_num(_covariance(errors)[i, 3:, 3:], nan=-1.0)
        largest = float(np.sqrt(np.linalg.eigvalsh(across)[-1])) if (np.diag(across) >= 0).all() else math.nan
        directions.append(
            [
                name,
                *(or_dash(fixed(value, 6, signed=True), _UNKNOWN) for value in direction[i]),
                or_dash(significant(2 * largest / ARCSEC), "no covariance is stated"),
            ]
        )
    return [
        Table(
            "Origins in machine coordinates: the position of reading zero, the start of the measuring range. Noise: "
            "standard deviation of an averaged reading. After ±: expanded uncertainty, k = 2.",
            ["beam", "x / mm", "y / mm", "z / mm", "noise / µm"],
            origins,
        ),
        Table(
            "Directions as unit vectors, from the sensor to the object, and their expanded uncertainty as an angle in "
            "the worst direction, k = 2. A change of 0.000 01 across the beam is 2.1 arcsec.",
            ["beam", "u_x", "u_y", "u_z", "U / arcsec"],
            directions,
        ),
    ]


def _nominal(errors: xr.Dataset) -> list[Block]:
    found = _differences(errors)
    origin, at = _vectors(errors, "beam_origin"), _vectors(errors, "nominal_origin")
    if not found or origin is None or at is None:
        return [Text("The nominal origins and directions are unknown.", "note")]
    expanded = 2 * np.sqrt(np.einsum("bii->bi", _covariance(errors)))
    rows: list[list[Cell | str]] = []
    for i, name in enumerate(_names(errors)):
        apart = 1e6 * (origin[i] - at[i])
        distance, angle, sigma = found[i]
        rows.append(
            [
                name,
                *(estimate(v, 1e6 * u, reason=_UNKNOWN) for v, u in zip(apart, expanded[i, :3], strict=True)),
                or_dash(fixed(1e6 * distance, 1), _UNKNOWN),
                estimate(angle / ARCSEC, 2 * sigma / ARCSEC, reason=_UNKNOWN, signed=False),
            ]
        )
    return [_difference_table("Detected minus nominal. After ±: expanded uncertainty, k = 2.", rows)]


def _difference_table(caption: str, rows: list[list[Cell | str]]) -> Table:
    head = ["beam", "Δx / µm", "Δy / µm", "Δz / µm", "distance / µm", "angle / arcsec"]
    return Table(caption, head, rows, [("", 1), ("origin", 4), ("direction", 1)])


def _construction_differences(errors: xr.Dataset) -> list[tuple[float, float]]:
    """Return per beam the distance of origins (m) and the angle (rad) between the two constructions."""
    values = [_vectors(errors, name) for name in ("beam_origin", "beam_direction", "paper_origin", "paper_direction")]
    if any(value is None for value in values):
        return []
    origin, direction, at, toward = (value for value in values if value is not None)
    return [
        (float(np.linalg.norm(at[i] - origin[i])), angle_between(toward[i], direction[i])[0])
        for i in range(len(origin))
    ]


def _constructions(errors: xr.Dataset) -> list[Block]:
    both = _construction_differences(errors)
    if not both:
        return [Text("Only one construction was evaluated.", "note")]
    origin, at = _vectors(errors, "beam_origin"), _vectors(errors, "paper_origin")
    rows: list[list[Cell | str]] = []
    for i, name in enumerate(_names(errors)):
        apart = 1e6 * (at[i] - origin[i]) if origin is not None and at is not None else np.full(3, np.nan)
        rows.append(
            [
                name,
                *(or_dash(fixed(value, 2, signed=True), _UNKNOWN) for value in apart),
                or_dash(fixed(1e6 * both[i][0], 2), _UNKNOWN),
                or_dash(fixed(both[i][1] / ARCSEC, 1), _UNKNOWN),
            ]
        )
    caption = (
        "Construction from circles and a line, minus the maximum-likelihood fit of all readings to the "
        "intersection of ray and sphere. The result is that of the likelihood fit."
    )
    return [_difference_table(caption, rows)]


def _residuals(errors: xr.Dataset, key: str) -> list[Block]:
    if "residual" not in errors or not np.isfinite(errors["residual"].values).any():
        return [Text("The result contains no residuals.", "note")]
    values = 1e6 * errors["residual"].transpose("beam", "profile", "step").values
    names = _names(errors)
    left = errors["left_out"].values if "left_out" in errors else None
    rows: list[list[Cell | str]] = []
    for i, name in enumerate(names):
        rows.append(
            [
                name,
                str(int(np.isfinite(values[i]).sum())),
                str(int(np.isnan(values[i]).sum())),
                Cell(DASH, reason="not counted") if left is None else integer(float(left[i])),
                or_dash(fixed(math.sqrt(finite(np.mean, values[i] ** 2)), 3), _UNKNOWN),
                or_dash(fixed(finite(np.max, np.abs(values[i])), 2), _UNKNOWN),
            ]
        )
    table = Table(
        "Residuals of the likelihood fit: reading minus predicted reading. Excluded: readings not used in the fit.",
        ["beam", "residuals", "without value", "excluded", "rms / µm", "largest / µm"],
        rows,
    )

    heights = [0.8] * len(names)

    def paint(figure: Canvas) -> None:
        panels = canvas.stack(figure, heights)
        for axes, name, rows_of in zip(panels, names, values, strict=True):
            for j, row in enumerate(rows_of):
                axes.plot(
                    np.arange(1, row.size + 1),
                    row,
                    color=canvas.COLOURS[j % len(canvas.COLOURS)],
                    linewidth=0.7,
                    marker=".",
                    markersize=1.5,
                )
            axes.axhline(0, color="#888888", linewidth=0.6)
            if not np.isfinite(rows_of).any():
                axes.text(0.5, 0.5, "no valid value", transform=axes.transAxes, ha="center", va="center")
                axes.set_yticks([])
            axes.set_ylabel("µm")
            axes.annotate(
                name,
                (1, 0.5),
                xycoords="axes fraction",
                xytext=(5, 0),
                textcoords="offset points",
                va="center",
                fontweight="bold",
                color=LOOK.get(name, (canvas.BLACK, None))[0],
            )
        panels[0].legend(
            panels[0].get_lines()[: values.shape[1]],
            [f"profile {j + 1}" for j in range(values.shape[1])],
            loc="lower center",
            bbox_to_anchor=(0.5, 1.0),
            ncols=6,
            handlelength=1.2,
            columnspacing=1.0,
        )
        panels[-1].set_xlabel("step of the sphere")

    worst = ", ".join(
        f"{name} {fixed(math.sqrt(finite(np.mean, values[i] ** 2)), 3)} µm" for i, name in enumerate(names)
    )
    svg = canvas.draw(paint, f"{key}-residual", canvas.stack_height(heights))
    alt = f"Residuals over the steps of the sphere; rms: {worst}."
    return [table, Figure(svg, "Residuals by beam and profile.", alt)]
