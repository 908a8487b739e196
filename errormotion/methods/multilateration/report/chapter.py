"""Chapters of a multilateration: errors of the volume, the network, errors of the axes, and undetermined freedoms."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr

from errormotion.kinematics.iso import DOF, iso_names
from errormotion.methods.multilateration.report import drawings, plan, quality
from errormotion.methods.multilateration.report.network import AXES, left_out, longest, network, used
from errormotion.report.document import Block, Source, Text
from errormotion.report.elements import (
    PROVENANCE,
    Budget,
    Chapter,
    Column,
    Curves,
    FigureTable,
    KeyFigures,
    KeyValue,
    On,
    Own,
    Section,
    Sentence,
    Table,
)
from errormotion.report.fields import remarks
from errormotion.report.text import fixed, integer, significant

_UNKNOWN = "not determined at any target"
_ABSENT = "not part of this result"
_WORDS = {
    "stations": "stations, by the noise of the readings",
    "targets": "targets that define the datum, by the noise of the readings",
}


def _expanded(net: xr.Dataset) -> xr.DataArray:
    return (2 * net["worst_direction"]).assign_attrs(units="m")


def _count(net: xr.Dataset) -> xr.DataArray | None:
    """Return which readings are used; None without residuals."""
    found = used(net)
    if not np.isfinite(net["residual"]).any():
        return None
    return found.copy(data=np.isfinite(found.values).astype(float)).assign_attrs(units="1")


def _deviation(net: xr.Dataset) -> xr.DataArray:
    """Return the distance of each station from its approximate position."""
    away = net["station_place"] - net["station_nominal"]
    return net["dead_path"].copy(data=np.linalg.norm(away.transpose("station", "direction").values, axis=1))


def _ignored(net: xr.Dataset) -> str:
    return f"used; {integer(int((left_out(net) > 0).sum()))} ignored"


def _volume(net: xr.Dataset) -> xr.Dataset:
    """Return the three errors and the length of the vectors over ``error``, with U."""
    size = net["length"].values
    U = 2 * np.sqrt(np.diagonal(net["variance"].values, axis1=1, axis2=2).clip(0)).T
    metre = {"units": "m"}
    return xr.Dataset(
        {
            "value": (("error", "target"), np.concatenate([net["error"].values.T, size[None]]), metre),
            "U": (("error", "target"), np.concatenate([U, np.full((1, size.size), np.nan)]), metre),
            "why": ("error", [_UNKNOWN] * 3 + ["see the ellipsoids"]),
        },
        {"error": [*DOF[:3], "length"]},
    )


# ---------------------------------------------------------------------- summary


def _targets(net: xr.Dataset) -> str:
    count = f"{integer(net.sizes['target'])} targets"
    return f"{count} from {integer(net.sizes['station'])} positions of the tracker" if net.sizes["station"] else count


def _lost(net: xr.Dataset) -> str | None:
    lost = int((~np.isfinite(net["length"].values)).sum())
    return f"{integer(lost)} targets" if lost else None


def _vector(net: xr.Dataset) -> str | None:
    worst = longest(net)
    return ", ".join(fixed(1e6 * v, 1, signed=True) for v in net["error"].values[worst]) if worst is not None else None


def _number(name: str, format: Callable[[float], str], size: float = 1.0) -> Callable[[xr.Dataset], str | None]:
    """Return the reader of a scalar as text; None if it is unknown."""

    def of(net: xr.Dataset) -> str | None:
        value = float(net[name])
        return format(value / size) if math.isfinite(value) else None

    return of


def _two(value: float) -> str:
    return fixed(value, 2)


# ---------------------------------------------------------------------- uncertainty


def _worst(net: xr.Dataset) -> Sequence[int] | None:
    sigma = net["worst_direction"].values
    return [int(np.nanargmax(sigma))] if np.isfinite(sigma).any() else None


def _at_worst(net: xr.Dataset, dims: Sequence[str], index: Sequence[int]) -> str:  # noqa: ARG001 - over targets
    return f"at {net['target'].values[index[0]]}, the target with the largest uncertainty"


def _shared(net: xr.Dataset) -> str | None:
    """Return the share of the sources with a name in the variance of the target with the largest one."""
    trace = np.trace(net["variance"].values, axis1=1, axis2=2)
    if "influence" not in net or not np.isfinite(trace).any():
        return None
    worst = int(np.nanargmax(trace))
    influence = net["influence"].isel(target=worst).transpose("source", "dof").values[:, :3]
    share = float(np.nansum(influence**2) / trace[worst])
    return f"{fixed(100 * min(share, 1.0), 0)} %" if math.isfinite(share) else None


def _no_sources(net: xr.Dataset) -> bool:
    return "influence" not in net or _worst(net) is None


# ---------------------------------------------------------------------- axes and readings


def _motions(axis: str) -> list[str]:
    return [iso_names(axis)[dof] for dof in DOF]


def _unseen(net: xr.Dataset) -> str | None:
    """Return the errors of the axes that are not determined, with the reason."""
    square = [str(name) for name in net.data_vars if str(name)[2:3] == "0" and len(str(name)) == 4]
    names = [name for axis in AXES for name in _motions(axis)] + sorted(square)
    found = [(name, net[name].attrs.get("unseen", "")) for name in names if name in net]
    return "; ".join(f"{name}: {reason}" for name, reason in found if reason) or None


def _has_axes(net: xr.Dataset) -> bool:
    return any(name in net for axis in AXES for name in _motions(axis))


def _explained(good: bool) -> Sentence:
    return Sentence(
        "The residuals of the targets' errors after the errors of the axes are {axes_sigma0} times their uncertainty; "
        "with about 1, the errors of the axes explain those of the targets.",
        {"axes_sigma0": _number("axes_sigma0", _two)},
        when=lambda net: bool(net["axes_sigma0"] < 1.5) is good,
        kind="plain" if good else "warning",
    )


def _remarks(source: Source, key: str) -> list[Block]:  # noqa: ARG001 - texts have no identifiers
    return [Text(note, "warning") for note in remarks(source.errors) if "\n" not in note]  # a map as text: drawn


def _solution(net: xr.Dataset) -> xr.Dataset | None:
    """Return the known numbers of the solution as text over ``quantity``."""
    facts = {
        "noise of a reading, as used / µm": _number("noise", _two, 1e-6)(net),
        "ratio of the scatter to the stated one": _number("sigma0", lambda value: fixed(value, 3))(net),
        "readings minus unknowns": _number("freedom", integer)(net),
        "condition of the determined freedoms": _number("condition", lambda value: significant(value, 3))(net),
        "repeatability of the machine / µm": _number("repeatability", _two, 1e-6)(net),
        "its standard uncertainty / µm": _number("repeatability_u", _two, 1e-6)(net),
    }
    share = net.get("scatter_share")
    if share is not None and share.dims == ("cause",) and share.size > 1:
        names = {"stations": "tracker", "repeatability": "repeatability of the machine"}
        for cause, part in zip(map(str, share["cause"].values), share.values, strict=True):
            of = f"share of the {names.get(cause, cause)} in the variance of a reading / %"
            facts[of] = fixed(100 * float(part), 0)
    known = {name: value for name, value in facts.items() if value is not None}
    return xr.Dataset({"value": ("quantity", list(known.values()))}, {"quantity": list(known)}) if known else None


# ---------------------------------------------------------------------- parts

_UNCERTAINTY = Section(
    "uncertainty",
    "Uncertainty",
    (
        Own(drawings.ellipsoids),
        Sentence("The result does not state the sources of its uncertainty.", when=_no_sources, kind="note"),
        Budget(_worst, _at_worst, noise="noise of the target's own readings", words=_WORDS),
        Sentence("Of the variance of that target, {share} is shared with other targets.", {"share": _shared}),
    ),
)
_UNSEEN = Section(
    "unseen",
    "Undetermined freedoms",
    (
        Sentence(
            "Distances determine only the positions of the targets relative to one another. The six rigid motions of "
            "the volume, three translations and three rotations, are not determined: the targets are fitted to their "
            "commanded positions. An error that displaces or rotates the whole volume does not appear here, and is not "
            "in the uncertainty.",
            kind="warning",
        ),
        Sentence(
            "A reflector is a point: rotations of the tool at a target, EA to EC, are unknown, not zero. Rotations of "
            "the axes are measured only as displacements of the reflector."
        ),
    ),
)
_UNCERTAIN = (
    KeyValue(
        "uncertainty of the targets",
        Column(_expanded, format="2", signed=False, reduce="median"),
        "U, k = 2, worst direction, median",
    ),
    KeyValue("largest uncertainty", Column(_expanded, format="2", signed=False, reduce="highest"), "U, k = 2"),
    KeyValue("readings", Column(_count, format="integer", reduce="sum"), _ignored),
)
_SCATTER = Sentence(
    "The scatter of the readings is {sigma0} times the stated one; there are {freedom} more readings than unknowns.",
    {"sigma0": _number("sigma0", _two), "freedom": _number("freedom", integer)},
    when=lambda net: bool(net["freedom"] > 0),
)
_SURPLUS = Sentence(
    "There are {freedom} more readings than unknowns.",
    {"freedom": _number("freedom", integer)},
    when=lambda net: bool(net["freedom"] > 0),
)
_CHECKED = (
    Sentence(
        "There are as many readings as unknowns, so that there is no check.",
        when=lambda net: bool(net["freedom"] == 0),
    ),
    Sentence("Translations and rotations of the whole volume are not determined."),
)
_STATIONS = Table(
    "Positions of the tracker and dead paths (zero offsets of its counter), with expanded uncertainty, k = 2. "
    "Deviation: distance from the approximate position. Residual: root mean square.",
    (
        *(
            Column("station_place", "station_covariance", "mm", {"direction": axis}, head=axis, signed=False,
                   reason=_ABSENT)
            for axis in "xyz"
        ),
        Column("dead_path", unit="mm", signed=False, reason=_ABSENT),
        Column(_deviation, "none", "mm", head="deviation", format=".1", signed=False, reason=_ABSENT),
        Column(_count, head="used", format="integer", reduce="sum", reason=_ABSENT),
        Column(used, "none", "um", head="residual", format=".2", signed=False, reduce="rms", reason=_ABSENT),
    ),
    over="station",
    groups=(("", 1), ("position", 3), ("", 1), ("", 1), ("readings", 2)),
    absent="The result contains no stations.",
)  # fmt: skip

MEASURED = Chapter(
    "Volumetric errors by multilateration",
    (
        KeyFigures(("largest volumetric error*", "root mean square*")),
        On(
            network,
            (
                *_UNCERTAIN,
                Sentence("{targets}.", {"targets": _targets}),
                Sentence("The errors of {lost} are unknown.", {"lost": _lost}),
                Sentence("The longest error vector is ({vector}) µm.", {"vector": _vector}),
                _SCATTER,
                *_CHECKED,
                Section(
                    "volume",
                    "Errors of the volume",
                    (
                        Table(
                            "Errors of the targets: actual minus commanded, after the best rigid fit.",
                            (
                                *(
                                    Column("value", "none", head=head, format=".2", signed=False, reduce=how,
                                           reason=_UNKNOWN)
                                    for head, how in (
                                        ("lowest", "lowest"), ("highest", "highest"), ("root mean square", "rms")
                                    )
                                ),
                                *(
                                    Column("U", head=head, format="2", signed=False, reduce=how, reason="why")
                                    for head, how in (("U (k = 2), median", "median"), ("U, largest", "highest"))
                                ),
                            ),
                            over="error",
                            of=_volume,
                        ),
                        Own(drawings.vectors),
                        Own(drawings.slices),
                        Own(drawings.histograms),
                    ),
                ),
                _UNSEEN,
                Section("stations", "Stations", (Own(drawings.layout), _STATIONS)),
                _UNCERTAINTY,
                Section(
                    "axes",
                    "Errors of the axes",
                    (
                        Sentence(
                            "The errors of the axes were not estimated; the remarks state the reason if it is known.",
                            when=lambda net: not _has_axes(net),
                            kind="note",
                        ),
                        *(
                            Curves(
                                f"Error motions of axis {axis}. Each has a mean of zero, and straightness has no "
                                "slope: these are rigid motions of the volume, or squareness.",
                                _motions(axis),
                                over=f"{axis}_position",
                                columns=3,
                            )
                            for axis in AXES
                        ),
                        FigureTable(
                            "Squareness of the axes' mean lines, with expanded uncertainty, k = 2.", ("squareness *",)
                        ),
                        Sentence(
                            "Not determined by these targets: {unseen}. Unknown, not zero.",
                            {"unseen": _unseen},
                            kind="warning",
                        ),
                        _explained(good=True),
                        _explained(good=False),
                    ),
                ),
                Section(
                    "quality",
                    "Readings",
                    (
                        Own(_remarks),
                        Own(quality.left_out),
                        Own(quality.drawing),
                        Table("The solution.", (Column("value"),), over="quantity", of=_solution),
                    ),
                ),
            ),
        ),
        PROVENANCE,
    ),
)  # fmt: skip

PLANNED = Chapter(
    "Expected uncertainty of a multilateration",
    (
        On(
            network,
            (
                *_UNCERTAIN,
                Sentence("Planned, not measured: {targets}.", {"targets": _targets}),
                _SURPLUS,
                *_CHECKED,
                Section("map", "Predicted uncertainty", plan.PARTS),
                _UNSEEN,
                Section("stations", "Stations", (Own(drawings.layout), plan.STATIONS)),
                _UNCERTAINTY,
                Section("quality", "Remarks", (Own(_remarks),)),
            ),
        ),
        PROVENANCE,
    ),
)
