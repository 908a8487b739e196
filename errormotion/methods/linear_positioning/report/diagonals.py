"""The chapter of a test along diagonals: figures of ISO 230-6, squareness, graphs of all diagonals and of each."""

from __future__ import annotations

from collections.abc import Sequence

import xarray as xr

from errormotion.methods.linear_positioning.report import lines
from errormotion.report.elements import (
    PROVENANCE,
    Budget,
    Chapter,
    Column,
    Curves,
    KeyFigures,
    Notes,
    On,
    Section,
    Sentence,
    Table,
)
from errormotion.report.text import listed

SHOWN = ("E", "E_forward", "E_backward", "R", "B", "B_mean")
FACES = {"EC0Y": "Y to X", "EA0Z": "Z to Y", "EB0Z": "Z to X"}
DISTANCE = "distance along the diagonal"


def _means(errors: xr.Dataset) -> xr.Dataset:
    """Return the mean bidirectional deviations over the distance."""
    mean = errors["unidirectional_mean"].mean("approach").assign_attrs(units="m")
    return errors.assign({"deviation": mean, DISTANCE: errors["distance"]})


def _length(errors: xr.Dataset) -> xr.DataArray:
    return errors["distance"].isel(target=-1)


def _face(errors: xr.Dataset) -> xr.DataArray:
    return xr.DataArray([FACES[str(name)] for name in errors["squareness_of"].values], dims="squareness_of")


def _end(errors: xr.Dataset, dims: Sequence[str], index: Sequence[int]) -> str:  # noqa: ARG001 - the last stop
    return f"at the end of {errors['diagonal'].values[index[0]]}"


CHAPTER = Chapter(
    "Diagonals of the volume",
    (
        KeyFigures(("E of *",)),
        KeyFigures(("squareness *",), signed=True),
        Sentence(
            "Displacements along {names}: a letter for each of X, Y and Z, P for an axis that moves in positive "
            "direction, N in negative direction, 0 for an axis at rest. {stops} stops, {runs} runs in both directions. "
            "Errors are relative to the {reference}.",
            {
                "names": lambda errors: listed([str(name) for name in errors["diagonal"].values]),
                "stops": lambda errors: errors.sizes["target"],
                "runs": lambda errors: errors.sizes["run"],
            },
        ),
        Section(
            "figures",
            "Figures of ISO 230-6",
            (
                On(
                    _means,
                    (
                        Curves(
                            "Mean bidirectional deviations along the diagonals over the distance from their first "
                            "stop. If the curves of the two diagonals of a face diverge, its axes are not square.",
                            ("deviation",),
                            over="target",
                            band=False,
                            at=DISTANCE,
                            most=10,
                        ),
                    ),
                ),
                Table(
                    "Figures along each diagonal, and its measured length. After ±: expanded uncertainty, k = 2, "
                    "excess of extreme values by scatter included.",
                    (
                        Column(_length, head="length", unit="mm", format=".1", signed=False),
                        *(
                            Column(
                                "figure_value",
                                uncertainty=lines.spread("figure"),
                                unit="um",
                                select={"figure": name},
                                head=lines.sign(name),
                                signed=name == "B_mean",
                                reason="not measured",
                            )
                            for name in SHOWN
                        ),
                    ),
                    over="diagonal",
                ),
            ),
        ),
        Section(
            "squareness",
            "Squareness",
            (
                Table(
                    "Squareness from the slopes of two diagonals of one face; positive: the second axis is turned in "
                    "the positive direction about the axis of the name. After ±: expanded uncertainty, k = 2.",
                    (
                        Column(_face, head="axes"),
                        Column("squareness", head="in arcsec"),
                        Column("squareness", unit="um/m", head="in µm/m"),
                    ),
                    over="squareness_of",
                    head="squareness",
                    notes=(
                        "The squareness is that over the whole face: it contains slopes of straightness, and angles of "
                        "the axes with their lever in the face. It is independent of the scale of the instrument and "
                        "of uniform expansion.",
                    ),
                ),
            ),
        ),
        On(
            lines.diagonals,
            (Section("diagonal-{line}", "Diagonal {line}", (lines.GRAPH, lines.FIGURES, lines.BY_TARGET)),),
        ),
        Section(
            "uncertainty",
            "Uncertainty",
            (
                Budget(lambda errors: [0, errors.sizes["target"] - 1], _end, noise="independent noise"),
                Sentence(
                    "Independent: from stop to stop, by the scatter of the readings. Errors of drift and alignment are "
                    "independent from diagonal to diagonal; the error of the scale of the lengths is the same for all."
                ),
            ),
        ),
        Section("quality", "Data quality", (Notes(),)),
        PROVENANCE,
    ),
)
