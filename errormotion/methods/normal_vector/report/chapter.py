"""Chapter of a warm-up with probed balls: errors and temperatures, balls, residuals, normals, sensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr

from errormotion.kinematics.iso import DOF
from errormotion.methods.normal_vector.report import balls, drawings
from errormotion.methods.normal_vector.schema import flag_text
from errormotion.report.document import Block, Source, Text, estimate
from errormotion.report.drawings.series import commanded_speed
from errormotion.report.elements import (
    NOT_DETERMINED,
    PROVENANCE,
    Budget,
    Chapter,
    Column,
    Curves,
    KeyFigures,
    KeyValue,
    LargestAndLast,
    Notes,
    Of,
    On,
    Own,
    Section,
    Sensors,
    Sentence,
    Table,
    Timeline,
    sensors,
)
from errormotion.report.elements.chapter import written
from errormotion.report.fields import unit_of
from errormotion.report.provenance import read
from errormotion.report.text import finite, fixed, integer, listed


def _last(errors: xr.Dataset) -> Sequence[int] | None:
    """Return the last cycle with a known error."""
    known = np.flatnonzero(np.any([np.isfinite(errors[name].values) for name in DOF], axis=0))
    return [int(known[-1])] if known.size else None


def _when(errors: xr.Dataset, cycle: int) -> str:
    return f"after {fixed(float(errors['time'][cycle]) / 60, 1)} min"


def _in_last(errors: xr.Dataset, dims: Sequence[str], index: Sequence[int]) -> str:  # noqa: ARG001 - over time
    return f"in the last known cycle, {_when(errors, index[0])}"


def _noise(errors: xr.Dataset) -> str | None:
    known = "noise" in errors and np.isfinite(float(errors["noise"]))
    return fixed(1e6 * float(errors["noise"]), 3) if known and balls.what(errors) == "touches" else None


def _rms(errors: xr.Dataset) -> str:
    noise = _noise(errors)
    return f"rms; noise of a touch: {noise} µm" if noise is not None else "rms"


# ---------------------------------------------------------------------- summary


def _cycles(errors: xr.Dataset) -> str:
    minutes = np.ptp(errors["time"].values) / 60 if errors.sizes["time"] else np.nan
    return (
        f"{integer(errors.sizes['time'])} cycles over {integer(len(balls.names_of(errors)))} balls in "
        f"{fixed(float(minutes), 1)} min"
    )


def _unknown(errors: xr.Dataset) -> str:
    lost = int((~np.any([np.isfinite(errors[name].values) for name in DOF], axis=0)).sum())
    return f"the errors of {integer(lost)} are unknown" if lost else "all errors are known"


def _strongest(first: int) -> Callable[[xr.Dataset], str | None]:
    """Return the reader of the largest displacement (0) or rotation (3); None where it is always zero."""

    def of(errors: xr.Dataset) -> str | None:
        names = [name for name in DOF[first : first + 3] if np.isfinite(errors[name].values).any()]
        found = errors.em.largest(*names) if names else None
        if found is None or not found.value > 0:
            return None
        unit, size = unit_of(first)
        cell = written(estimate(found.value / size, found.expanded / size, signed=False), unit)
        return f"{cell}, {_when(errors, found.place)}"

    return of


def _speed(source: Source) -> list[str]:
    commanded, errors = commanded_speed(source), source.errors
    speed = np.abs(errors["spindle_speed"].values.astype(float)) if "spindle_speed" in errors else np.array([])
    highest = f"{integer(finite(np.max, speed))} /min"
    known = bool(np.isfinite(speed).any())
    if commanded is not None and commanded.any():
        mean = f"; the highest mean between two cycles was {highest}" if known else ""
        return [f"Commanded spindle speed: up to {integer(commanded.max())} /min{mean}."]
    return [f"The highest mean spindle speed between two cycles was {highest}."] if known else []


def _warmest(source: Source) -> list[str]:
    found = sensors.of_dataset(source.errors, source)
    return [sensors.warmest(found)] if found else []


def _excluded(errors: xr.Dataset) -> str | None:
    code = balls.residuals(errors)[1]
    counts = [(int((code == kind).sum()), name) for kind, name in balls.KINDS]
    some = listed([f"{integer(count)} {name}" for count, name in counts if count])
    return f"{integer(code.size)} {balls.what(errors)}: {some}" if some else None


def _reasons(errors: xr.Dataset) -> dict[str, str]:
    """Return why an error is unknown in all cycles."""
    tool = str(errors.attrs.get("tool_axes", "")) or "XYZ"
    if tool == "XYZ":
        return {}
    reason = (
        f"not determined: only {' and '.join(tool)} carry the tool, and the balls do not show this rotation of the "
        "frame of axes"
    )
    return dict.fromkeys(DOF[3:], reason)


# ---------------------------------------------------------------------- flags and normals


def _flagged(source: Source, key: str) -> list[Block]:  # noqa: ARG001 - a text has no identifiers
    """Return the flags that the probe set, if the raw dataset contains them for the same touches."""
    raw, code = source.raw, balls.residuals(source.errors)[1]
    if raw is None or "touch_flag" not in raw or set(raw["touch_flag"].dims) != {"time", "ball", "touch"}:
        return []
    flag = raw["touch_flag"].transpose("time", "ball", "touch").values.astype(np.int64)
    if flag.shape != code.shape:
        return []
    if not flag.any():
        return [Text("The probe flagged no touch.")]
    words = []
    for kind in np.unique(flag[flag > 0]):
        where = np.argwhere(flag == kind)
        first = f"the first of {balls.names_of(source.errors)[where[0, 1]]} in cycle {where[0, 0]}"
        words.append(f"{flag_text(kind)}: {integer(len(where))} ({first})")
    return [Text(f"Flagged by the probe: {'; '.join(words)}.", "warning")]


def _by_normals(errors: xr.Dataset) -> bool:
    """Return whether the result itself is that of the published construction."""
    settings = read(errors).get("settings", {})
    return isinstance(settings, dict) and settings.get("procedure") == "normals"


def _difference(name: str) -> Callable[[xr.Dataset], xr.DataArray | None]:
    def of(errors: xr.Dataset) -> xr.DataArray | None:
        if "normals_errors" not in errors or _by_normals(errors):
            return None
        return (errors["normals_errors"].sel(dof=name, drop=True) - errors[name]).assign_attrs(
            units=errors[name].attrs["units"]
        ).rename(name)  # fmt: skip

    return of


def _ratio(name: str) -> Callable[[xr.Dataset], xr.DataArray | None]:
    def of(errors: xr.Dataset) -> xr.DataArray | None:
        return errors["normals_loss"].sel(dof=name, drop=True).rename(name) if "normals_loss" in errors else None

    return of


def _normals(errors: xr.Dataset) -> xr.Dataset | None:
    """Return the published normals over the freedoms, in units of the page."""
    needed = {"normals_errors", "normals_covariance", "normals_loss"}
    if not needed <= set(errors.data_vars) or not np.isfinite(errors["normals_errors"].values).any():
        return None
    units, sizes = zip(*(unit_of(i) for i in range(6)), strict=True)
    values, u = (part.transpose("time", "dof") for part in (errors["normals_errors"], _normals_u(errors)))
    known = np.isfinite(values.values)
    last, every = len(known) - 1 - known[::-1].argmax(axis=0), np.arange(6)
    rest = np.stack([values.values[:, i] - errors[name].values for i, name in enumerate(DOF)], axis=1)
    reasons = _reasons(errors)
    why = [reasons.get(name, "not determined by this method") for name in DOF]
    own = "the result is that of the normals" if _by_normals(errors) else ""
    return xr.Dataset(
        {
            "unit": ("dof", list(units)),
            "last": ("dof", values.values[last, every] / sizes),
            "last_u": ("dof", u.values[last, every] / sizes),
            "rest": (("dof", "time"), (np.full_like(rest, np.nan) if own else rest / sizes).T),
            "loss": errors["normals_loss"],
            "why": ("dof", why),
            "why_alone": ("dof", [own or each for each in why]),
        },
        {"dof": list(DOF)},
    )


def _normals_u(errors: xr.Dataset) -> xr.DataArray:
    found = Of("normals_errors", uncertainty="normals_covariance").read(errors)
    assert found is not None
    assert found.u is not None
    return found.u


CHAPTER = Chapter(
    "Thermal errors by probing of balls",
    (
        On(lambda errors: errors if _last(errors) else None, (KeyFigures(signed=True),)),
        KeyValue("residual", Column(balls.kept, unit="um", format=".2", signed=False, reduce="rms"), _rms),
        KeyValue(
            "uncertainty by the published normals",
            Column("normals_loss", format=".2", signed=False, reduce="median"),
            "times that of the fit, median",
        ),
        Sentence("{cycles}; {unknown}.", {"cycles": _cycles, "unknown": _unknown}),
        Sentence("The largest displacement is {size}.", {"size": _strongest(0)}),
        Sentence("The largest rotation is {size}.", {"size": _strongest(3)}),
        _speed,
        _warmest,
        Sentence("Excluded of {counts}.", {"counts": _excluded}),
        Sentence("Moved on the table: {names}.", {"names": lambda errors: listed(balls.moved_names(errors)) or None}),
        NOT_DETERMINED,
        Section(
            "errors",
            "Errors and temperatures",
            (
                Timeline(
                    "Errors of the tool side relative to the workpiece side at ({point}) mm since the cold cycle, "
                    "temperatures and spindle speed on one time axis. Bands: expanded uncertainty, k = 2 (about 95 %). "
                    "Mean speeds are those since the previous cycle; the spindle stands still for probing.",
                    held=True,
                    absent="The errors are unknown at all times.",
                ),
                LargestAndLast("The six errors. The cold cycle is zero by definition.", _reasons),
            ),
        ),
        Section(
            "balls",
            "Balls",
            (
                Own(drawings.balls),
                Table(
                    "Apparent centres of the balls: in the cold cycle, and displacement in the last cycle in which "
                    "they were determined. After ±: expanded uncertainty, k = 2.",
                    (
                        *(
                            Column(
                                "cold",
                                select={"direction": axis},
                                head=axis,
                                unit="mm",
                                format=".3",
                                signed=False,
                                reason="never determined",
                            )
                            for axis in "xyz"
                        ),
                        *(
                            Column("moved", select={"direction": axis}, head=axis, reason="never determined")
                            for axis in "xyz"
                        ),
                        Column("largest", format=".1", signed=False, reason="never determined"),
                        Column("since", head="moved on the table"),
                    ),
                    over="ball",
                    of=balls.travelled,
                    groups=(("", 1), ("cold", 3), ("displacement", 4), ("", 1)),
                    absent="The result lists no balls.",
                ),
            ),
        ),
        Section(
            "residuals",
            "Touches and residuals",
            (
                Own(drawings.residuals),
                Table(
                    "The readings of each ball: used ones with their residuals, and those that are missing, outliers, "
                    "of a ball that had moved, or of a cycle that is not determined.",
                    (
                        *(
                            Column(balls.counted(kind), head=head, format="integer", reduce="sum")
                            for kind, head in enumerate(("used", "missing", "outliers", "ball moved", "cycle lost"))
                        ),
                        *(
                            Column(balls.kept, head=how, format=".3", signed=False, reduce=how, reason="none was used")
                            for how in ("rms", "largest")
                        ),
                    ),
                    over="ball",
                    groups=(("", 1), ("readings", 5), ("residual", 2)),
                    total="all",
                ),
                Sentence("Standard deviation of a touch used in the identification: {noise} µm.", {"noise": _noise}),
                Own(_flagged),
            ),
        ),
        Section(
            "normals",
            "Published normals compared with the fit",
            (
                Sentence(
                    "The result of this page is that of the published normals, not that of the fit of all touches.",
                    when=_by_normals,
                    kind="note",
                ),
                Curves(
                    "Normals minus fit: the published construction (rotation of the normals of two planes of four "
                    "balls) minus the fit of all touches.",
                    tuple(Of(_difference(name), uncertainty="none") for name in DOF),
                    columns=3,
                ),
                Curves(
                    "Standard uncertainty by the normals over that of the fit.",
                    (tuple(Of(_ratio(name), uncertainty="none") for name in DOF),),
                    absent="The result contains no published normals; the reason is stated under data quality.",
                ),
                Table(
                    "The published normals. Ratio: standard uncertainty by the normals over that of the fit of all "
                    "touches. After ±: expanded uncertainty, k = 2.",
                    (
                        Column("unit"),
                        Column("last", head="last known", reason="why"),
                        Column(
                            "rest",
                            head="rms, minus fit",
                            format="2",
                            signed=False,
                            reduce="rms",
                            reason="why_alone",
                        ),
                        *(
                            Column("loss", head=f"ratio, {how}", format=".2", signed=False, reduce=how, reason="why")
                            for how in ("median", "largest")
                        ),
                    ),
                    over="dof",
                    head="error",
                    of=_normals,
                ),
            ),
        ),
        Section("sensors", "Temperature sensors", (Sensors(drawings.cold),)),
        Section(
            "uncertainty",
            "Uncertainty",
            (
                Sentence("No cycle determines the errors.", when=lambda errors: _last(errors) is None, kind="warning"),
                Budget(_last, _in_last, noise="touches of the cycle itself"),
                Sentence(
                    "The cold cycle is the reference of all others: the uncertainty of its touches is common to all "
                    "cycles."
                ),
                Sentence(
                    "The position of the tip in the spindle is constant. A tilt of the spindle relative to the last "
                    "axis therefore displaces all balls equally: it is part of the displacements, and of no rotation. "
                    "The rotations are those of the frame of axes relative to the table.",
                    kind="note",
                ),
            ),
        ),
        Section("quality", "Data quality", (Notes(),)),
        PROVENANCE,
    ),
)
