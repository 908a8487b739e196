"""What follows from the solution of a drift: the reference state, ISO 230-3 values, and further variables."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.estimation.sources import Source
from errormotion.methods.spindle_drift.identification import iso230_3
from errormotion.methods.spindle_drift.identification.bar import axis_direction, errors_of, states
from errormotion.methods.spindle_drift.identification.record import length_of_means, sensors
from errormotion.methods.spindle_drift.schema import CHANNELS
from errormotion.methods.spindle_drift.settings import TrialSettings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.estimation.checks.slow_noise import SlowNoise
    from errormotion.estimation.sources import Errors
    from errormotion.measurement.observed import Solved
    from errormotion.methods.spindle_drift.identification.record import Record
    from errormotion.methods.spindle_drift.identification.setup import Setup
    from errormotion.methods.spindle_drift.settings import SpindleDriftSettings

REFERENCE = "reference state"
"""Group of the sources that are the uncertainty of the reference state."""


@dataclass(frozen=True, eq=False)
class Result:
    """A drift record, its reference state (instants), the states (n + 1, 5) of instants and reference, and the point.

    ``off_axis`` is the group of the sources without effect on the axis of the spindle, ``slow`` the noise of the five
    readings that may be alike at neighbouring instants.
    """

    raw: xr.Dataset
    record: Record
    setup: Setup
    settings: SpindleDriftSettings
    reference: NDArray[np.int64]
    state: Array
    point: Array
    off_axis: str
    slow: SlowNoise

    @property
    def zero(self) -> float:
        """Time of the reference state in the record, s."""
        return float(self.record.averages.time[self.reference].mean())

    @cached_property
    def time(self) -> Array:
        """Times since the reference state, s."""
        return self.record.averages.time - self.zero

    @property
    def interval(self) -> tuple[float, float]:
        """First and last time of the reference state, s."""
        return float(self.time[self.reference[0]]), float(self.time[self.reference[-1]])

    @property
    def reference_words(self) -> str:
        """The reference state in words."""
        time, half = self.record.averages.time, self.settings.average / 2
        first, last = time[self.reference[0]] - half, time[self.reference[-1]] + half
        return f"mean of the record from {first:.3f} s to {last:.3f} s"

    @property
    def coordinates(self) -> dict[str, Any]:
        """Coordinates of the result."""
        start = str(self.raw.attrs.get("start", ""))
        record = self.record
        coords: dict[str, Any] = {"time": ("time", self.time, {"units": "s", **({"start": start} if start else {})})}
        if record.temperature is not None:
            coords["temperature"] = (("time", "sensor"), record.temperature.T, {"units": "degC"})
            coords["sensor"] = ("sensor", sensors(self.raw))
        if record.spindle_speed is not None:
            coords["spindle_speed"] = ("time", record.spindle_speed, {"units": "1/min"})
        if not self._brief:
            coords |= {"channel": list(CHANNELS), "direction": list("xyz"), **iso230_3.LABELS}
        return coords

    @property
    def _brief(self) -> bool:
        """Whether results that do not affect the errors are omitted."""
        return isinstance(self.settings, TrialSettings)

    def finish(self, solved: Solved) -> Solved:
        """Return a solution whose instants of the reference state share its noise, with all further results."""
        errors = solved.relative.errors
        of_reference = self._of_reference(solved) if solved.propagated else []
        sources = [*of_reference, *(source for source in errors.sources if source.group != REFERENCE)]
        m = self.reference.size
        # What each mean does not share with the mean of all; a single one is 0 by definition.
        own = errors.own.copy()
        own[self.reference] *= 1.0 - 1.0 / m
        for source in sources if m == 1 else of_reference:
            source.effect[self.reference] = 0.0
        value = errors.value.copy()
        value[self.reference] *= 0.0 if m == 1 else 1.0
        errors = replace(errors, value=value, own=own, sources=sources)
        names = [source.name for source in sources if source.group == REFERENCE]
        observed = solved.observed
        observed = replace(observed, attributes={**observed.attributes, "reference_sources": names})
        if solved.propagated and not self._brief:
            iso = self._iso(errors)
            extras = self._extras(solved.fit.residual[:-1].T) | iso.as_extras(self._on_axis(errors))
            attrs = {**observed.attrs, "iso_test": iso.test, "iso_temperature_sensor": iso.sensor}
            observed = replace(observed, extras=extras, attrs=attrs)
        # The noise is checked by its scatter over time, not by the residuals, of which there are none.
        scatter = replace(solved.scatter, note="")
        return replace(solved, observed=observed, scatter=scatter, relative=replace(solved.relative, errors=errors))

    def _of_reference(self, solved: Solved) -> list[Source]:
        """Return the readings of the reference state as sources, one for each channel.

        The five readings determine the five numbers of the state: with its whitened derivatives A, the readings change
        it by the columns of A^-1, which have the same covariance as the root of the normal equations. A larger reading
        decreases the residual of a side channel, and that of Z if the end of the bar is above the levels.
        """
        effects = [source.effect for source in solved.relative.errors.sources if source.group == REFERENCE]
        A = solved.fit.linear.border[-1]
        sense = np.diag([1.0, 1.0, 1.0, 1.0, np.sign(self.state[-1, 2] - self.setup.levels.mean())])
        turn = np.linalg.solve(A @ solved.fit.normal.root, sense)
        return [
            Source(f"reference {name}", REFERENCE, np.einsum("s,spd->pd", turn[:, k], np.array(effects)))
            for k, name in enumerate(CHANNELS)
        ]

    def _on_axis(self, errors: Errors) -> NDArray[np.bool_]:
        """Whether each source affects the values of ISO 230-3, which are those on the axis of the bar, (s,)."""
        return np.array([source.group != self.off_axis for source in errors.sources], dtype=bool)

    def _iso(self, errors: Errors) -> iso230_3.Results:
        record, settings = self.record, self.settings
        influence = errors.influence[self._on_axis(errors)]
        E0, point = self.state[-1, :3], self.point
        return iso230_3.evaluate(
            iso230_3.quantities(
                errors.value, errors.own, influence, self.setup.levels - point[2], E0 - point, self._alike()
            ),
            self.time,
            temperature=record.temperature,
            sensors=sensors(self.raw) if record.temperature is not None else (),
            spindle_speed=record.spindle_speed,
            running_end=None if settings.running_end is None else settings.running_end - self.zero,
            sensor=settings.iso_temperature,
            average=settings.iso_average,
            reference=self.reference,
            mean=length_of_means(record.averages, settings),
            changes=[event.at - self.zero for event in settings.schedule if event.compensation],
        )

    def _alike(self) -> tuple[Array, Array, float] | None:
        """Return the effects (channel, n, 5) of the noise that is alike on the errors, its times and its duration."""
        if not self.slow.duration > 0:
            return None
        effects = np.zeros((len(CHANNELS), self.time.size, 5))
        for k in np.flatnonzero(self.slow.sd > 0):
            change = np.zeros((len(CHANNELS), 1))
            change[k] = self.slow.sd[k]
            above, below = (self._errors(self.record.averages.mean + each) for each in (change, -change))
            effects[k] = (above - below) / 2.0
        effects[:, self.reference] *= np.sqrt(1.0 - 1.0 / self.reference.size)  # as in `finish`
        return effects, self.time, self.slow.duration

    def _errors(self, readings: Array) -> Array:
        """Return EX EY EZ EA EB (n, 5) for readings (5, n), without the expansion of the frame."""
        setup = self.setup
        its = states(readings, setup.origin, setup.direction, setup.radius, setup.levels)
        return errors_of(its, self.state[-1:], self.point)

    def _extras(self, residual: Array) -> dict[str, xr.DataArray]:
        def over_channel(values: Array, unit: str) -> xr.DataArray:
            return xr.DataArray(values, dims=("channel", "time"), attrs={"units": unit})

        averages, setup = self.record.averages, self.setup
        first = self.state[int(np.flatnonzero(np.isfinite(self.state).all(axis=1))[0])]
        along = np.concatenate(axis_direction(first[None]))
        vectors = {"beam_origin": (setup.origin, "m"), "beam_direction": (setup.direction, "1")}
        extras = {
            name: xr.DataArray(values, dims=("channel", "direction"), attrs={"units": unit})
            for name, (values, unit) in vectors.items()
        }
        extras |= {
            "fit_residual": over_channel(residual, "m"),
            "distance_mean": over_channel(averages.mean, "m"),
            "valid_fraction": over_channel(averages.count / np.maximum(averages.expected, 1), "1"),
            "bar_axis_point": xr.DataArray(first[:3], dims="direction", attrs={"units": "m"}),
            "bar_axis_direction": xr.DataArray(along, dims="direction", attrs={"units": "1"}),
            "bar_radius": xr.DataArray(setup.radius, attrs={"units": "m"}),
            "level_height": xr.DataArray(setup.levels, dims="level", attrs={"units": "m"}),
        }
        for name in ("dropped_samples", "invalid_samples"):
            if name in self.raw:
                extras[name] = self.raw[name].reset_coords(drop=True).load()
        return extras
