"""Errors over time beside temperatures, speed and feed on one time axis, with the events of a schedule."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr

from errormotion.report.document import Block, Figure, Source, Text
from errormotion.report.drawings import timeline
from errormotion.report.drawings.series import commanded_speed, events
from errormotion.report.elements.tables import filled
from errormotion.report.text import fixed


@dataclass(frozen=True)
class Timeline:
    """Errors, temperatures, spindle speed and feed on one time axis, with the events of the schedule.

    Attributes
    ----------
    caption : str
        ``{point}`` is replaced by the functional point in mm, another `{name}` by an attribute of the dataset.
    held : bool
        Whether speed and feed are means since the previous instant.
    absent : str
        A warning in place of the drawing if nothing is known.
    """

    caption: str
    held: bool = False
    absent: str = ""

    def blocks(self, source: Source, key: str) -> list[Block]:
        """Return the drawing; a warning or nothing without known values."""
        errors = source.errors
        names = timeline.sensor_names(errors)
        panels = timeline.errors(errors, source.limits)
        if names:
            panels += timeline.temperatures(
                names, errors["temperature"].transpose("time", "sensor").values.astype(float)
            )
        panels += timeline.working(errors, held=self.held, commanded=commanded_speed(source))
        if not panels:
            return [Text(self.absent, "warning")] if self.absent else []
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
