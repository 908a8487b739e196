"""The parts of one freedom or diagonal: its figures, its graph, and its results by target as in the standard."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr

from errormotion.datasets.results.places import coordinate_of
from errormotion.estimation.extremes import expanded
from errormotion.methods.linear_positioning.figures import ALIGNED_FIGURES
from errormotion.methods.linear_positioning.identification.standard import MEANINGS, Statistics
from errormotion.methods.linear_positioning.report.drawings import over_position
from errormotion.methods.linear_positioning.settings import LIMITS
from errormotion.report.elements import Across, Column, Own, Table
from errormotion.report.elements.quantities import unit_of as field_unit

Read = Callable[[xr.Dataset], xr.DataArray]

ALONG, STRAIGHT, ANGLE = "Positioning", "Straightness", "Angle"
"""What a freedom is."""


def kind_of(freedom: str) -> str:
    """Return what a freedom of a linear axis is, by its name in ISO 230-1."""
    return ALONG if freedom[1] == freedom[2] else STRAIGHT if freedom[1] in "XYZ" else ANGLE


def freedoms(errors: xr.Dataset) -> list[xr.Dataset]:
    """Return every measured freedom as a dataset over ``target``, the positioning first."""
    names = sorted(map(str, errors["freedom"].values), key=lambda name: kind_of(name) != ALONG)
    position = errors[coordinate_of(errors, "position")].variable
    named = errors.assign(place=position).rename_dims(position="target")
    return [_line(named.sel(freedom=name), name, kind_of(name)) for name in names]


def diagonals(errors: xr.Dataset) -> list[xr.Dataset]:
    """Return every diagonal as a dataset over ``target``."""
    named = errors.assign(place=errors["distance"])
    return [_line(named.sel(diagonal=name), str(name), "Diagonal") for name in errors["diagonal"].values]


def _line(found: xr.Dataset, name: str, kind: str) -> xr.Dataset:
    """Return the readings of a line and their statistics, a straightness from its least-squares line."""
    mean, s = (found[f"unidirectional_{each}"].transpose("approach", "target") for each in ("mean", "s"))
    readings = found["deviations"].transpose("approach", "run", "target")
    place = found["place"]
    if kind == STRAIGHT:
        middle = mean.dropna("approach", how="all").mean("approach", skipna=False).values
        known = np.isfinite(middle)
        line = xr.DataArray(np.polyval(np.polyfit(place[known], middle[known], 1), place), dims="target")
        mean, readings = mean - line, readings - line
    units = "rad" if kind == ANGLE else "m"
    of = Statistics(mean.values, s.values)
    names = ("figure_value", "figure_bias", "figure_u") + ("aligned_value", "aligned_bias", "aligned_u") * (
        kind == ALONG and "aligned_value" in found
    )
    made = xr.Dataset(
        {
            **{each: found[each] for each in names},
            "reading": readings,
            "mean": mean,
            "s": s,
            "reversal": ("target", of.reversal),
            "both": ("target", of.bidirectional),
            "repeatability": ("target", of.repeatability),
        },
        attrs={**found.attrs, "line": name, "kind": kind, "unit": field_unit(units)[0]},
    ).drop_vars([name for name in found.coords if name not in ("approach", "figure")], errors="ignore")
    for each in made.data_vars.values():
        each.attrs["units"] = units
    return made.assign(place=("target", place.values, {"units": "m"}))


# ---------------------------------------------------------------------- figures


def sign(name: str) -> str:
    """Return the symbol of a figure."""
    return name.replace("_forward", "↑").replace("_backward", "↓").replace("B_mean", "mean B")


def spread(kind: str) -> Read:
    """Return the reader of half of the expanded uncertainty of figures: of ``figure`` or ``aligned`` ones."""

    def read(ds: xr.Dataset) -> xr.DataArray:
        bias, u = ds[f"{kind}_bias"], ds[f"{kind}_u"]
        return u.copy(data=expanded(bias.values, u.values) / 2)

    return read


def _true(ds: xr.Dataset) -> xr.DataArray:
    return (ds["figure_value"] - ds["figure_bias"]).assign_attrs(ds["figure_value"].attrs)


def _excess(ds: xr.Dataset) -> xr.DataArray:
    return ds["figure_bias"].where(ds["figure"] != "B_mean").assign_attrs(ds["figure_bias"].attrs)


def _limit(ds: xr.Dataset) -> xr.DataArray | None:
    """Return the limits of the figures of positioning."""
    limits = [float(ds.attrs.get(LIMITS.get(str(name), ""), math.nan)) for name in ds["figure"].values]
    if ds.attrs["kind"] != ALONG or not np.isfinite(limits).any():
        return None
    return xr.DataArray(limits, dims="figure", attrs={"units": "m"})


def _figure(ds: xr.Dataset, dims: Sequence[str], index: Sequence[int]) -> str:  # noqa: ARG001 - one dim
    name = str(ds["figure"].values[index[0]])
    return f"{sign(name)}, {MEANINGS[name]}"


FIGURES = Table(
    "Figures of {line} as the standard defines them; after ±: expanded uncertainty, k = 2, excess included. Excess: "
    "mean increase of an extreme value by scatter; true figure: the limit for an infinite number of runs.",
    (
        Column(
            "figure_value",
            uncertainty=spread("figure"),
            head="value",
            signed=False,
            reason="not measured in both directions",
        ),
        Column(_excess, uncertainty="none", head="excess", format="2", reason="a mean has no excess"),
        Column(_true, uncertainty="figure_u", head="true figure", signed=False, reason="needs several runs"),
        Column(_limit, head="limit", format="{:g}".format, reason="", optional=True),
    ),
    over="figure",
    place=_figure,
)
ALIGNED = Table(
    "Figures of {line} corrected for the mean cosine error of the stated alignment; after ±: expanded uncertainty, "
    "k = 2, excess included.",
    (Column("aligned_value", uncertainty=spread("aligned"), head="value", signed=False),),
    over="figure",
    place=_figure,
    where=lambda ds: ds["aligned_value"].notnull() & ds["figure"].isin(ALIGNED_FIGURES),
)

# ---------------------------------------------------------------------- results by target


def _sum(k_mean: int, k_s: int) -> Read:
    return lambda ds: (k_mean * ds["mean"] + k_s * ds["s"]).assign_attrs(ds["s"].attrs)


def _of_approach(name: str, arrow: str) -> list[Column]:
    statistics = {
        f"s {arrow}": (0, 1),
        f"2 s {arrow}": (0, 2),
        f"mean − 2 s {arrow}": (1, -2),
        f"mean + 2 s {arrow}": (1, 2),
        f"R = 4 s {arrow}": (0, 4),
    }
    one = {"approach": name}
    return [
        Column("reading", select=one, head=f"run {{}} {arrow}"),
        Column("mean", select=one, head=f"mean {name}"),
        *(Column(_sum(*weights), select=one, head=head) for head, weights in statistics.items()),
    ]


def _decimals(ds: xr.Dataset) -> int:
    """Return the number of decimals that resolves a tenth of the scatter."""
    s = ds["s"].values / field_unit(ds["s"].attrs["units"])[1]
    typical = float(np.nanmedian(s)) if np.isfinite(s).any() else math.nan
    return min(max(1 - math.floor(math.log10(typical)), 1), 4) if typical > 0 else 2


BY_TARGET = Across(
    "{line} by target, {unit}.",
    (
        Column("place", head="target position", unit="mm", format=".3", signed=False),
        *_of_approach("forward", "↑"),
        *_of_approach("backward", "↓"),
        Column("reversal", head="B"),
        Column("both", head="mean of both"),
        Column("repeatability", head="R of both"),
    ),
    over="target",
    decimals=_decimals,
)
GRAPH = Own(over_position)
