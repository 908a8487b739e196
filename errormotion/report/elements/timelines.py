"""Errors over time beside temperatures, speed and feed on one time axis, with the events of a schedule."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import xarray as xr

from errormotion.report.document import Block, Figure, Source, noted
from errormotion.report.drawings import timeline
from errormotion.report.drawings.series import commanded_speed, events
from errormotion.report.elements.panels import Look, Panel, look, quantities
from errormotion.report.elements.tables import filled
from errormotion.report.text import fixed


@dataclass(frozen=True)
class TimePanel:
    """One panel of a `Timeline`: quantities of one unit over time; those that are unknown at all times are left out.

    Attributes
    ----------
    title : str
    variables : str, `Of`, or several
    height : float
        Inch.
    looks : mapping of str to (str, dashes)
        Colour and dashes of a quantity by its name; by default in their order.
    limits : mapping of str to str
        The freedom whose limits are those of a quantity, by its name.
    empty : str
        Text of a panel without known values, which is else left out.
    zero : bool
        Whether a line marks zero.
    """

    title: str
    variables: Panel
    height: float = 1.35
    looks: Mapping[str, Look] = field(default_factory=dict)
    limits: Mapping[str, str] = field(default_factory=dict)
    empty: str = ""
    zero: bool = True

    def made(self, source: Source) -> list[timeline.Panel]:
        """Return the panel; nothing without known values over time."""
        found = [
            each
            for each in quantities(self.variables, source.errors)
            if each.values.dims == ("time",) and (self.empty or each.known.any())
        ]
        lines = [
            timeline.Line(
                each.name,
                each.values.values.astype(float) / each.size,
                None if each.u is None else 2 * each.u.values / each.size,
                *self.looks.get(each.name, look(k)),
            )
            for k, each in enumerate(found)
        ]
        limits = [
            (freedom, source.limits[freedom][0] / each.size, source.limits[freedom][1] / each.size)
            for each in found
            if (freedom := self.limits.get(each.name, each.of)) in source.limits
        ]
        return [
            timeline.Panel(self.title, each.unit, lines, self.height, limits=limits, empty=self.empty, zero=self.zero)
            for each in found[:1]
        ]


@dataclass(frozen=True)
class Timeline:
    """Quantities, temperatures, spindle speed and feed on one time axis, with the events of the schedule.

    Attributes
    ----------
    caption : str
        ``{point}`` is replaced by the functional point in mm, another `{name}` by an attribute of the dataset.
    panels : sequence of `TimePanel` or callable
        A function of the dataset returns them. By default displacements and rotations.
    temperatures, working : bool
        Whether the temperatures, and speed and feed, are shown.
    held : bool
        Whether speed and feed are means since the previous instant.
    absent : str
        A warning in place of the drawing if none of the quantities or temperatures is known.
    """

    caption: str
    panels: Sequence[TimePanel] | Callable[[xr.Dataset], Sequence[TimePanel]] | None = None
    temperatures: bool = True
    working: bool = True
    held: bool = False
    absent: str = ""

    def blocks(self, source: Source, key: str) -> list[Block]:
        """Return the drawing; a warning or nothing without known values."""
        errors = source.errors
        names = timeline.sensor_names(errors) if self.temperatures else []
        own = self.panels(errors) if callable(self.panels) else self.panels
        panels = (
            timeline.errors(errors, source.limits) if own is None else [p for each in own for p in each.made(source)]
        )
        if names:
            panels += timeline.temperatures(
                names, errors["temperature"].transpose("time", "sensor").values.astype(float)
            )
        if not panels:
            return noted(self.absent, "warning")
        if self.working:
            panels += timeline.working(errors, held=self.held, commanded=commanded_speed(source) if self.held else None)
        done = events(source)
        point = ", ".join(fixed(1e3 * float(value), 1) for value in np.atleast_1d(errors.attrs["functional_point"]))
        caption = filled(self.caption.replace("{point}", point), errors) + timeline.events_in_words(done)
        words = ". ".join(panel.in_words() for panel in panels)
        drawn = timeline.draw(np.asarray(errors["time"].values, float), panels, key, done)
        return [Figure(drawn, caption, f"Over time: {words}.")]


@dataclass(frozen=True)
class LargestAndLast:
    """The table of the six errors over time: range, largest and last known value.

    Attributes
    ----------
    caption : str
    reasons : callable
        Returns why a freedom is unknown at all times, by its name.
    """

    caption: str
    reasons: Callable[[xr.Dataset], Mapping[str, str]] | None = None

    def blocks(self, source: Source, key: str) -> list[Block]:  # noqa: ARG002 - a table has no identifiers
        """Return the table."""
        errors = source.errors
        return [timeline.table(errors, self.caption, self.reasons(errors) if self.reasons is not None else None)]
