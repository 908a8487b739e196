"""The chapter of a spindle test: values, curves, temperatures, set-up, uncertainty, quality."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from errormotion.kinematics.iso import iso_names
from errormotion.methods.spindle_drift.report import iso230_3, setup_drawing
from errormotion.report import budget, quality
from errormotion.report.document import Block, Source, estimate
from errormotion.report.drawings.series import (
    LOOK,
    QUANTITIES,
    WHAT,
    curves,
    end_of_running,
    events,
    last_known,
    minutes_of,
    steps,
    unit_of,
)
from errormotion.report.elements import (
    PROVENANCE,
    Budget,
    Chapter,
    Column,
    KeyValue,
    Notes,
    On,
    Own,
    Section,
    Sentence,
    Table,
    Timeline,
    TimePanel,
)
from errormotion.report.elements.chapter import written
from errormotion.report.text import fixed, integer, listed, minutes

DISPLACEMENTS, TILTS = ("X1", "X2", "Y1", "Y2", "Z"), ("A", "B")
LIMITS = {name: f"E{name}" for name in ("Z", "A", "B")}
"""The errors at the functional point."""


def _last(errors: xr.Dataset) -> int:
    """Return the last instant of running; of the record if it is unknown."""
    stop = end_of_running(errors)
    return errors.sizes["time"] - 1 if stop is None else stop


def _when(errors: xr.Dataset) -> str:
    return "at the end of the record" if end_of_running(errors) is None else "at the end of running"


def _after(errors: xr.Dataset) -> str:
    return f"after {errors.attrs['minutes']} min"


def _quantities(errors: xr.Dataset) -> xr.Dataset:
    """Return the dataset with the seven quantities of ISO 230-3 over time."""
    found = curves(errors)
    made = {
        f"{name}{end}": ("time", values, {"units": "rad" if name in TILTS else "m"})
        for name, curve in found.items()
        for end, values in (("", curve.values), ("_u", curve.uncertainty))
    }
    return errors.assign(made)


def _at_end(errors: xr.Dataset) -> xr.Dataset | None:
    """Return the quantities at the end of running, or at the last known instant before it."""
    if not errors.sizes["time"]:
        return None
    made = _quantities(errors)
    last = {name: last_known(made[name].values, _last(errors)) for name in QUANTITIES}
    found = {
        part: made[part].isel(time=place, drop=True)
        for name, place in last.items()
        if place is not None
        for part in (name, f"{name}_u")
    }
    return xr.Dataset(found, attrs={"minutes": fixed(minutes_of(errors)[_last(errors)], 1)})


# ---------------------------------------------------------------------- summary


def _summary(source: Source) -> list[str]:
    errors = source.errors
    if errors.sizes["time"] < 2:
        return ["The record contains fewer than two instants: no drift can be reported."]
    found, values = curves(errors), iso230_3.values(errors)
    known = {name: float(np.nanmax(np.abs(v))) for name in DISPLACEMENTS if np.isfinite(v := found[name].values).any()}
    largest = max(known, key=lambda name: known[name], default=None)
    words = [_procedure(errors), *(_largest(errors, largest) if largest is not None else []), *_changes(source)]
    if values is not None:
        words += [*_first_hour(values), *(_course(errors, values, largest) if largest is not None else [])]
    share = budget.largest(errors.isel(time=_last(errors)), "EZ")
    if share:
        words.append(f"The largest share in the variance of Z {_when(errors)}: {share[0]}, {share[1]}.")
    return words


def _procedure(errors: xr.Dataset) -> str:
    time, stop = minutes_of(errors), end_of_running(errors)
    length = f"The record is {fixed(time[-1] - time[0], 1)} min long"
    if stop is None:
        known = "spindle_speed" in errors
        return f"{length}; {'the spindle did not turn' if known else 'the spindle speed was not recorded'}."
    speed = np.abs(np.nan_to_num(np.asarray(errors["spindle_speed"].values, float)))
    low, high = (float(value) for value in np.percentile(speed[speed > 0], [2, 98]))
    at = f"{integer(high)} /min" if high - low < 1e-2 * high else f"{integer(low)} to {integer(high)} /min"
    return f"{length}; the spindle turned at {at} until {fixed(time[stop], 1)} min."


def _largest(errors: xr.Dataset, name: str) -> list[str]:
    unit, size = unit_of(name)
    moved = errors
    if name != "Z":
        height = float(errors["level_height"].values["12".index(name[1])])
        moved = errors.em.at([*np.asarray(errors.attrs["functional_point"], float)[:2], height])
    largest = moved.em.largest(f"E{name[0]}")
    value = written(estimate(largest.value / size, largest.expanded / size), unit)
    when = fixed(minutes_of(errors)[largest.place], 1)
    return [
        f"The largest displacement is {WHAT[name].removeprefix('displacement ')}: {value}, reached after {when} min."
    ]


def _changes(source: Source) -> list[str]:
    """Return the effect of each switched compensation: the step of the displacement at the functional point."""
    words = []
    for event, axis, step in steps(source.errors, events(source)):
        head = f"{event.what[0].upper()}{event.what[1:]} at {fixed(event.minute, 1)} min"
        if step is None:
            words.append(
                f"{head}: the step of {axis} is unknown: fewer than two means before or after it are complete. "
                "A smaller 'average' gives more of them."
            )
            continue
        change, start = (
            written(estimate(1e6 * value, 2e6 * u), "µm")
            for value, u in ((step.step, step.u_step), (step.before, step.u_before))
        )
        words.append(f"{head}: {axis} at the functional point stepped by {change}, from {start}.")
    return words


def _first_hour(values: xr.Dataset) -> list[str]:
    """Return the ranges of the first 60 min: Z, the largest lateral one, the largest tilt."""
    ranges = []
    for names in (("Z",), DISPLACEMENTS[:4], TILTS):
        of = values["value"].sel(measure="range_60min", quantity=list(names)).dropna("quantity")
        if of.size:
            name = str(of["quantity"].values[int(np.argmax(of.values))])
            ranges.append(f"d({name}) {written(iso230_3.cell(values, name, 'range_60min'), unit_of(name)[0])}")
    return [f"Largest ranges within the first 60 min: {listed(ranges)}."] if ranges else []


def _course(errors: xr.Dataset, values: xr.Dataset, name: str) -> list[str]:
    slope, constant = (values.sel(quantity=name, measure=each) for each in ("end_slope", "time_constant"))
    words = []
    if np.isfinite(slope["value"]) and not str(slope["step"].values):
        state = "still drifting" if abs(slope["value"]) > 2 * slope["u"] else "steady within the uncertainty"
        size = written(iso230_3.cell(values, name, "end_slope"), f"{unit_of(name)[0]}/h")
        words.append(f"{_when(errors).capitalize()} d({name}) is {state}: {size}.")
    if np.isfinite(constant["value"]):
        size = written(iso230_3.cell(values, name, "time_constant"), "min")
        words.append(f"d({name}) approaches its end value with a time constant of {size}.")
    return words


def _unseen(errors: xr.Dataset) -> str | None:
    names = iso_names("spindle")
    return ", ".join(f"{name} ({iso})" for name, iso in names.items() if not np.isfinite(errors[name]).any()) or None


# ---------------------------------------------------------------------- temperatures, uncertainty, channels


def _meaning(errors: xr.Dataset) -> str | None:
    if "iso_value" not in errors:
        return None
    meaning = "; ".join(f"{name}: {WHAT[name]}" for name in QUANTITIES)
    setup = setup_drawing.setup_of(errors)
    if setup is not None and setup.levels.size == 2:
        heights = [f"{'xyz'[setup.along]} = {fixed(1e3 * height, 3)} mm" for height in setup.levels]
        meaning += f". L1: {heights[0]}; L2: {heights[1]}"
    sensor = str(errors.attrs.get("iso_temperature_sensor", ""))
    return f"{meaning}. Per kelvin: of the temperature sensor '{sensor}'" if sensor else meaning


def _temperatures(errors: xr.Dataset) -> xr.Dataset | None:
    """Return the temperatures with those at the start and at the end of running; None without any."""
    if "temperature" not in errors or not np.isfinite(errors["temperature"].values).any():
        return None
    values = errors["temperature"].transpose("time", "sensor").reset_coords(drop=True)
    known = np.isfinite(values.values)
    before, every = known[: _last(errors) + 1], np.arange(values.sizes["sensor"])
    one = values.isel(time=0, drop=True)
    start = one.copy(data=values.values[known.argmax(axis=0), every])
    end = one.copy(data=values.values[len(before) - 1 - before[::-1].argmax(axis=0), every])
    made = xr.Dataset({"temperature": values, "start": start, "end": end, "change": end - start})
    return made.assign_attrs(end=_when(errors).removeprefix("at the "))


def _places(source: Source, key: str) -> list[Block]:  # noqa: ARG001 - a table has no identifiers
    """Return the six errors after an hour, at the end of running, and at the end of the record."""
    errors, time = source.errors, minutes_of(source.errors)
    if not time.size:
        return []
    place, hour = _last(errors), int(np.searchsorted(time, 60.0))
    places = {f"after {minutes(60 * time[hour])}": errors.isel(time=hour)} if hour < min(place, time.size - 1) else {}
    places[f"{_when(errors)} ({fixed(time[place], 1)} min)"] = errors.isel(time=place)
    if place < time.size - 1:
        places[f"end of the record ({fixed(time[-1], 1)} min)"] = errors.isel(time=-1)
    return [budget.twist_table(errors, places, iso_names("spindle"))]


def _end(errors: xr.Dataset, dims: Sequence[str], index: Sequence[int]) -> str:  # noqa: ARG001 - over time
    return f"{_when(errors)} ({fixed(minutes_of(errors)[index[0]], 1)} min)"


def _point(errors: xr.Dataset) -> str:
    return ", ".join(fixed(1e3 * float(value), 3) for value in np.atleast_1d(errors.attrs["functional_point"]))


def _gaps(errors: xr.Dataset) -> xr.Dataset | None:
    """Return the gaps of the samples of each channel."""
    if not {"valid_fraction", "fit_residual"} & set(errors.data_vars):
        return None
    if "valid_fraction" not in errors:
        return errors
    valid = np.nan_to_num(errors["valid_fraction"].transpose("channel", "time").values) > 0
    found = [quality.gaps(row, minutes_of(errors)) for row in valid]
    longest = [minutes(60 * length) if count else "none" for count, length in found]
    return errors.assign(gaps=("channel", [count for count, _ in found]), longest=("channel", longest))


def _is_exact(errors: xr.Dataset) -> bool:
    residual = np.abs(errors["fit_residual"].values) if "fit_residual" in errors else np.array([np.nan])
    return bool(np.isfinite(residual).any() and np.nanmax(residual) < 1e-11)


def _channels(variable: str) -> On:
    """Return the drawing of a variable over time, a panel for each channel."""

    def split(errors: xr.Dataset) -> xr.Dataset | None:
        if variable not in errors or (variable == "fit_residual" and _is_exact(errors)):
            return None
        own = {str(name): errors[variable].sel(channel=name, drop=True) for name in errors["channel"].values}
        return errors.assign({name: values.assign_attrs(units="m") for name, values in own.items()})

    def panels(errors: xr.Dataset) -> list[TimePanel]:
        return [
            TimePanel(str(name), str(name), 0.42, LOOK, empty="no valid value", zero=variable == "fit_residual")
            for name in errors["channel"].values
        ]

    caption = {
        "fit_residual": "Residuals of the fit by channel.",
        "distance_mean": "Averaged readings of the sensors by channel.",
    }
    return On(split, (Timeline(caption[variable], panels, temperatures=False, working=False),))


CHAPTER = Chapter(
    "Thermal drift of the spindle",
    (
        On(
            _at_end,
            tuple(
                KeyValue(label, Column(name), _after)
                for name, label in (
                    ("X1", "X at L1"),
                    ("Y1", "Y at L1"),
                    ("Z", "Z"),
                    ("A", "tilt about X"),
                    ("B", "tilt about Y"),
                )
            ),
        ),
        _summary,
        Sentence(
            "Nominal beams were used, not detected ones: the position of the bar is only as accurate as the drawing.",
            when=lambda errors: errors.attrs.get("beams") == "nominal",
        ),
        Sentence("Not observed by this test: {names}. It is reported as unknown, not as zero.", {"names": _unseen}),
        Section(
            "iso",
            "Thermal drift values (ISO 230-3)",
            (iso230_3.DRIFT, iso230_3.COURSE, Sentence("{meaning}.", {"meaning": _meaning}, kind="note")),
        ),
        Section(
            "drift",
            "Drift over time",
            (
                On(
                    _quantities,
                    (
                        Timeline(
                            "Displacement of the spindle side relative to the workpiece side since the reference "
                            "state. L1 and L2 are the two levels of measurement. Bands: expanded uncertainty, k = 2.",
                            tuple(
                                TimePanel(f"Displacement in {names[0][0]}", names, 1.4, LOOK, LIMITS)
                                for names in (("X1", "X2"), ("Y1", "Y2"), ("Z",))
                            ),
                            temperatures=False,
                            absent="No instant has a valid result.",
                        ),
                        Timeline(
                            "Tilt of the spindle axis about X (A, inclination in the YZ plane) and about Y (B, "
                            "inclination in the XZ plane), right-handed. Bands: expanded uncertainty, k = 2.",
                            (TimePanel("Tilt about X (A) and about Y (B)", TILTS, 1.5, LOOK, LIMITS),),
                            temperatures=False,
                            working=False,
                        ),
                    ),
                ),
            ),
        ),
        Section(
            "temperatures",
            "Temperatures",
            (
                Timeline("Temperatures during the test.", (), working=False),
                Table(
                    "Temperatures in °C, and their change in K from the start to the end of running.",
                    tuple(
                        Column(
                            name,
                            head=head,
                            unit="1",
                            format=".2",
                            signed=name == "change",
                            reduce=how,
                            reason="no valid reading",
                        )
                        for name, head, how in (
                            ("start", "", ""),
                            ("end", "{end}", ""),
                            ("temperature", "lowest", "lowest"),
                            ("temperature", "highest", "highest"),
                            ("change", "", ""),
                        )
                    ),
                    over="sensor",
                    of=_temperatures,
                    absent="No temperatures were recorded with this test.",
                ),
            ),
        ),
        Section("setup", "Set-up", (Own(setup_drawing.drawing), setup_drawing.BEAMS)),
        Section(
            "uncertainty",
            "Uncertainty",
            (
                Sentence("The record is empty.", when=lambda errors: not errors.sizes["time"], kind="warning"),
                Own(_places),
                Budget(
                    lambda errors: [_last(errors)] if errors.sizes["time"] else None, _end, noise="independent noise"
                ),
                Sentence(
                    "Functional point ({point}) mm in the frame '{frame}'. Sources that affect many instants are "
                    "common to all of them; differences between instants take their covariance into account, so that "
                    "the uncertainty of a difference may be smaller than that of either value. The budget covers only "
                    "the listed sources.",
                    {"point": _point},
                    kind="note",
                ),
            ),
        ),
        Section(
            "quality",
            "Residuals and data quality",
            (
                Notes(),
                Table(
                    "Validity of the samples and residuals of the fit, by channel. A gap is a sequence of instants "
                    "without a valid sample. Residual: reading minus the reading predicted from the fitted bar.",
                    (
                        Column("valid_fraction", head="valid samples", format="percent", reduce="mean"),
                        Column("valid_fraction", head="lowest instant", format="percent", reduce="lowest"),
                        Column("gaps", format="integer"),
                        Column("longest", head="longest gap"),
                        *(
                            Column(
                                "fit_residual",
                                head=how,
                                unit="um",
                                format=".3",
                                signed=False,
                                reduce=how,
                                reason="no instant with a residual",
                            )
                            for how in ("rms", "largest")
                        ),
                    ),
                    over="channel",
                    of=_gaps,
                    groups=(("", 1), ("validity", 4), ("residual", 2)),
                ),
                Sentence(
                    "The fit is exact: as many readings as unknowns. The residuals are zero by construction and do "
                    "not show the accuracy, which depends on the sensors and the beam calibration.",
                    when=_is_exact,
                    kind="note",
                ),
                _channels("fit_residual"),
                _channels("distance_mean"),
            ),
        ),
        PROVENANCE,
    ),
    overview=On(
        _quantities,
        (
            Timeline(
                "All displacements in one scale.",
                (TimePanel("Displacement", DISPLACEMENTS, 1.6, LOOK),),
                temperatures=False,
                working=False,
            ),
        ),
    ),
)
