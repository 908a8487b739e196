"""From raw data to the measurement model, and from its solution to what the result says besides the errors.

`observe` reads raw data, corrects displacements for the air, the drift of each set-up and the expansion of the scales,
and states the network (`model`). `_Finish` adds to its solution the stations, the noise, the errors of the axes and
notes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.special import chdtri

from errormotion.arrays import Array
from errormotion.datasets.certificates import certified
from errormotion.errors import MethodError
from errormotion.estimation.checks.candidates import Candidate, steps
from errormotion.estimation.fit import Fit
from errormotion.estimation.variance import TAIL
from errormotion.methods.multilateration import determinacy, repeatability
from errormotion.methods.multilateration.axes import fit_machine, misfit_note, parametric_extras, parametric_labels
from errormotion.methods.multilateration.drift import Drift, estimate_drift, positions
from errormotion.methods.multilateration.model import STATIONS, TARGETS, Sources, determined, network
from errormotion.methods.multilateration.networks import station_covariance
from errormotion.methods.multilateration.readings import Readings, assumptions, listed, read
from errormotion.methods.multilateration.repeatability import Repeatability
from errormotion.methods.multilateration.scale import air_scale, along_beams, expansion_sources, scale_strain
from errormotion.methods.multilateration.start import GROSS, Stations, directions, gross, initial_stations

if TYPE_CHECKING:
    from collections.abc import Iterable

    from errormotion.estimation.sources import Errors
    from errormotion.measurement.observed import Observed, Solved
    from errormotion.methods.multilateration.settings import MultilaterationSettings

CERTIFIED = {
    "air temperature": ("thermometer", "offset"),
    "air pressure": ("barometer", "offset"),
    "air humidity": ("hygrometer", "offset"),
    "wavelength": ("tracker", "wavelength"),
    "tracker scale": ("tracker", "scale"),
    "coefficient of expansion": ("scales", "coefficient of expansion"),
    **{f"scale temperature {axis}": ("scale_thermometer", f"offset at {axis}") for axis in "XYZ"},
}
"""Sources whose error is the same in all measurements with one certificate."""
OF_DATUM = (TARGETS, f"{STATIONS} of the datum")
"""Sources of the noise by which targets define the datum."""
NOTHING = 1e-3
"""Scatter, relative to the noise, below which readings are expected ones: there are no errors of axes to be fitted."""


def observe(raw: xr.Dataset, settings: MultilaterationSettings) -> Observed:
    """Return the model of raw data.

    Raises
    ------
    MethodError
        Readings that do not determine the network, contradict one another, or are in another unit.
    """
    notes: list[str] = []
    data = read(raw, notes)
    notes += assumptions(raw, settings)
    factor, air = air_scale(raw, settings.air, notes)
    reading = data.displacement * factor
    known = np.isfinite(reading)
    determinacy.refuse_too_few(known & (known.sum(axis=0) >= 3), None, data.nominal)
    start = initial_stations(reading, known / data.noise, data.nominal, data.station)
    e = directions(data.nominal, start.position)
    wrong = gross(reading, data.nominal, start, data.noise) if settings.robust else np.zeros(reading.shape, dtype=bool)
    reading = np.where(wrong, np.nan, reading)
    machine = repeatability.stated(settings.repeatability, settings.repeatability_uncertainty)
    drift, machine = _drift(reading, data, e, machine, settings, notes)
    correction = np.zeros(reading.shape) if drift is None else drift.correction
    scales = []
    if (its := settings.expansion) is not None:
        excess, strain = scale_strain(raw, its)
        correction = correction + along_beams(strain, data.position - data.position.mean(axis=0), e)
        scales = expansion_sources(excess, data.position, e, its)
    known_as = certified(raw.attrs, CERTIFIED)
    sources = Sources(
        air, {"tracker scale": settings.scale_or_assumed}, scales, [] if drift is None else drift.sources, known_as
    )
    of_visits = 0.0 if settings.together else machine.variance
    every = data.displacement * factor - correction
    finish = _Finish(data, settings, machine, drift, every, wrong, start, raw.attrs)
    notes += finish.of_gross()
    reflector = data.reflector
    attributes = {"measured": {**raw.attrs, **({"chain": settings.chain} if settings.chain else {})}}
    return network(
        reading - correction,
        float(np.hypot(data.noise, np.sqrt(of_visits))),
        data.nominal,
        start,
        sources,
        noise_freedom=np.inf if settings.together else machine.freedom(data.noise),
        coords={
            "target": ("target", np.array(data.targets), {}),
            **{name: ("target", data.position[:, k], {"units": "m"}) for k, name in enumerate("xyz")},
            **{name: (name, values, {}) for name, values in finish.labels().items()},
        },
        functional_point=reflector[0] if np.ptp(reflector, axis=0).max() == 0 else reflector.mean(axis=0),
        frame=str(raw.attrs.get("frame", "machine")),
        recorded=("displacement", ("station", "target")),
        record=partial(_recorded, correction=correction, factor=factor, noise=data.noise),
        robust=settings.robust,
        noise_increases=settings.noise == "auto",
        noise_cause="" if settings.together or machine.sources else "Possible cause: repeatability of the machine.",
        name=lambda at: data.named(int(at[0])),
        suspects=finish.moves(reading.ravel(), e),
        finish=finish,
        attributes=attributes,
        notes=notes,
    )


def _drift(
    reading: Array,
    data: Readings,
    e: Array,
    machine: Repeatability,
    settings: MultilaterationSettings,
    notes: list[str],
) -> tuple[Drift | None, Repeatability]:
    """Return drift and repeatability by returns: each is estimated with the other one known."""
    if settings.drift == "none" or settings.together:
        return None, machine
    if not data.timed:
        notes.append("The data contain no times of the readings (reading_time): drift is not determined.")
        return None, machine
    certain = bool(machine.sources) and machine.spread == 0
    number, stated = positions(data.nominal), machine

    def estimate(of: Repeatability) -> tuple[Drift, list[str], float]:
        its: list[str] = []
        sd = float(np.hypot(data.noise, np.sqrt(of.variance)))
        noise = np.broadcast_to(sd, reading.shape)
        return estimate_drift(reading, data.time, number, e, noise, data.stations, its, certain=certain), its, sd

    drift, its, sd = estimate(stated)
    machine = repeatability.from_returns(stated, drift, data.noise, sd, [])
    if drift.freedom and machine != stated:
        drift, its, sd = estimate(machine)
    notes += its
    return drift, repeatability.from_returns(stated, drift, data.noise, sd, notes)


def _recorded(
    raw: xr.Dataset, y: Array, generator: np.random.Generator, *, correction: Array, factor: Array | float, noise: float
) -> xr.Dataset:
    """Return raw data with readings of the tracker that have these corrected values and its noise."""
    d = (y.reshape(correction.shape) + correction + noise * generator.standard_normal(correction.shape)) / factor
    before = raw["displacement"]
    d = np.where(np.isfinite(before.transpose("station", "target").values), d, np.nan)
    return raw.assign(displacement=xr.DataArray(d, dims=("station", "target"), attrs=before.attrs))


@dataclass(frozen=True, eq=False)
class _Finish:
    """What follows from a solution besides the errors; called with it.

    ``reading`` are all corrected readings (n, m), m, ``wrong`` those that contradict the commanded positions.
    """

    data: Readings
    settings: MultilaterationSettings
    machine: Repeatability
    drift: Drift | None
    reading: Array
    wrong: NDArray[np.bool_]
    start: Stations
    attrs: dict[Any, Any]

    def __call__(self, solved: Solved) -> Solved:
        """Return the solution with stations, noise, errors of the axes and notes.

        Raises
        ------
        FitError
            A freedom is undetermined.
        MethodError
            A station was moved between its readings.
        """
        if not solved.propagated:  # a trial, of which only the errors are wanted
            return solved
        data, fit, notes = self.data, solved.fit, list[str]()
        self._refuse_moves(solved)
        free = fit.problem.unknowns.target.freed[:, 0]
        x = fit.unknowns
        stations = Stations(x.station[:, :3], x.station[:, 3])
        relative = solved.relative
        machine = self.machine
        own = np.where(free[:, None, None], solved.factor * fit.normal.own, np.nan)
        if self.settings.together:
            target = np.where(free[:, None], x.target, np.nan)
            machine = repeatability.from_positions(machine, target, own, positions(data.nominal), notes)
            if machine.variance > 0:
                visits = machine.variance * np.eye(3)
                own = own + visits
                relative = replace(relative, errors=replace(relative.errors, own=relative.errors.own + visits))
        solved, condition = determined(replace(solved, relative=relative), self.start.position)
        sd = float(np.sqrt(solved.factor) * np.median(np.asarray(fit.problem.noise.sd)))
        machine = machine if self.settings.together else machine.with_residuals(data.noise, solved.scatter)
        notes += self._of_targets(solved, free)
        notes += self._of_stations(stations)
        if "returns" in machine.sources and machine.variance > 2 * machine.spread:
            notes.append(
                f"The repeatability of the machine is {machine.value * 1e6:.2g} um (standard deviation of a "
                f"coordinate, standard uncertainty {machine.uncertainty * 1e6:.1g} um), from {machine.source}."
            )
        joint = station_covariance(solved)
        shares = repeatability.shares(self._of_visits(self.machine), self._of_visits(machine), data.noise, solved)
        extras = self._extras(solved, stations, joint, machine, shares, free) | {
            "condition": _array(condition, (), "1", "of the stations' information, without motions of the whole"),
            "noise": _array(sd, (), "m", "of a reading, repeatability included"),
        }
        coords = {**solved.observed.coords, "cause": ("cause", list(shares), {})}
        if (more := self._axes(solved, relative.errors, own, notes)) is not None:
            extras |= more[0]
            coords |= more[1]
        observed = replace(solved.observed, notes=[*solved.observed.notes, *notes], coords=coords, extras=extras)
        return replace(solved, observed=observed)

    def _of_visits(self, machine: Repeatability) -> float:
        """Return the variance of a reading by the repeatability of the machine, m^2."""
        return 0.0 if self.settings.together else machine.variance

    def labels(self) -> dict[str, list[str]]:
        """Return the labels of the dims of further variables."""
        labels = {"station": self.data.stations, "direction": list("xyz"), "direction_": list("xyz")}
        if self.drift is not None and self.drift.pairs:
            labels["drift_term"] = ["dead path", "x", "y", "z"]
        return labels

    def of_gross(self) -> list[str]:
        """Return a note on readings that contradict the commanded positions."""
        which = np.flatnonzero(self.wrong.ravel())
        if not which.size:
            return []
        shown = "; ".join(self.data.named(int(k)) for k in which[:8]) + (
            f" and {which.size - 8} more" if which.size > 8 else ""
        )
        return [
            f"Some distances contradict the commanded positions more than {GROSS:g} times as much as others ({shown}); "
            f"{which.size} of them {'is' if which.size == 1 else 'are'} not used."
        ]

    def moves(self, reading: Array, e: Array) -> Callable[[Fit], Iterable[Candidate]] | None:
        """Return the search for stations that moved, in readings that scatter more than stated."""
        station = np.where(np.isfinite(reading), np.repeat(np.arange(e.shape[0]), e.shape[1]), -1)
        design = np.concatenate([e, np.ones((*e.shape[:2], 1))], axis=2).reshape(-1, 1, 4)
        time = np.where(np.isfinite(self.data.time), self.data.time, 0.0)
        search = steps(time.ravel(), station, design, lambda j, at: self.moved(j, at))

        def found(fit: Fit) -> Iterable[Candidate]:
            return search(fit) if fit.chi2 > chdtri(max(fit.freedom, 1), TAIL) else []

        return found

    def moved(self, j: int, at: float) -> str:
        """Return the words for station j that moved at a time."""
        later = np.where(self.data.time[j] >= at, self.data.time[j], np.inf)
        return f"station {self.data.stations[j]} moved before target {self.data.targets[int(np.argmin(later))]}"

    def _refuse_moves(self, solved: Solved) -> None:
        """Raise MethodError if the readings are explained by a station that was moved between them."""
        for exclusion in () if solved.cleaned is None else (*solved.cleaned.made, *solved.cleaned.undecided):
            if " moved before target " in exclusion.words:
                name, target = exclusion.words.removeprefix("station ").split(" moved before target ")
                raise MethodError(
                    f"Expected every station at rest; station {name} was moved by about "
                    f"{float(np.linalg.norm(exclusion.size[:3])) * 1e3:.3g} mm before target {target}. Measure "
                    "this set-up again, or state its readings from this target on as a separate station. A drifting "
                    "set-up has the same effect: measure some of its targets twice.",
                    code="network.station.moved",
                )

    def _of_targets(self, solved: Solved, free: NDArray[np.bool_]) -> list[str]:
        """Return notes on targets without a position, besides those with too few readings."""
        data = self.data
        enough = np.count_nonzero(np.isfinite(data.displacement), axis=0) >= 3
        out = self._left_out(solved).any(axis=0)
        weak, excluded = np.flatnonzero(~free & enough & ~out), np.flatnonzero(~free & enough & out)
        notes = []
        if weak.size:
            notes.append(
                f"{weak.size} of {len(free)} targets are weakly determined, since they lie nearly in one plane with "
                f"the stations that measured them; their errors are unknown: {listed(data.targets, weak)}."
            )
        if excluded.size:
            notes.append(
                f"{excluded.size} of {len(free)} targets are unknown without the distances that are not used: "
                f"{listed(data.targets, excluded)}. Distances from a further station would determine them."
            )
        return notes

    def _of_stations(self, stations: Stations) -> list[str]:
        """Return notes on stations that are swapped, or far from their stated positions."""
        stated = self.data.station
        notes = determinacy.swap_note(stations.position, stated)
        if stated is None or notes:
            return notes
        off = np.linalg.norm(stations.position - stated, axis=1)
        return [
            f"Station {self.data.stations[j]} is {off[j] * 1e3:.3g} mm from its approximate position. Check this "
            "position, and that the targets are stated in machine coordinates."
            for j in np.flatnonzero(off > self.settings.station_tolerance)
        ]

    def _left_out(self, solved: Solved) -> NDArray[np.int8]:
        """Return for each reading (n, m): 0 = used, 1 = wrong, 2 = one of several of which one is wrong."""
        excluded = self.wrong.astype(np.int8)
        for exclusion in () if solved.cleaned is None else solved.cleaned.made:
            excluded[exclusion.readings.reshape(excluded.shape)] = 2 if exclusion.rivals else 1
        return excluded

    def _extras(
        self,
        solved: Solved,
        stations: Stations,
        joint: Array,
        machine: Repeatability,
        shares: dict[str, float],
        free: NDArray[np.bool_],
    ) -> dict[str, xr.DataArray]:
        """Return the further variables of the result."""
        data, vector, n = self.data, ("station", "direction"), len(self.data.stations)
        blocks = joint.reshape(n, 4, n, 4)
        target = np.where(free[:, None], solved.fit.unknowns.target, np.nan)
        every = replace(solved.fit.problem, readings=self.reading.ravel())
        residual = np.where(free, every.residuals(solved.fit.linear.at).reshape(self.reading.shape), np.nan)
        extras = {
            "target_nominal": _array(data.nominal, ("target", "direction"), "m", "commanded position of the reflector"),
            "target_place": _array(target, ("target", "direction"), "m", "estimated position of the reflector"),
            "station_place": _array(stations.position, vector, "m", "estimated position of the tracker"),
            "station_covariance": _array(
                blocks[np.arange(n), :3, np.arange(n), :3], (*vector, "direction_"), "m^2", "by the readings"
            ),
            "dead_path": _array(stations.dead_path, ("station",), "m"),
            "dead_path_u": _array(np.sqrt(np.diag(joint)[3::4]), ("station",), "m"),
            "residual": _array(residual, ("station", "target"), "m", "reading minus model, also of wrong readings"),
            "left_out": _array(
                self._left_out(solved), ("station", "target"), "", "1: wrong; 2: one of several of which one is wrong"
            ),
            "sigma0": _array(solved.scatter.ratio, (), "1", "ratio of the scatter of the readings to the stated one"),
            "freedom": _array(solved.fit.freedom, (), "", "readings minus unknowns"),
            "scatter_share": _array(
                list(shares.values()), ("cause",), "1", "share of each cause in the variance of a reading"
            ),
        }
        if data.station is not None:
            extras["station_nominal"] = _array(data.station, vector, "m", "approximate position of the tracker")
        if self.drift is not None and self.drift.pairs:
            extras["drift_rate"] = _array(self.drift.rate, ("station", "drift_term"), "m/s", "during each set-up")
        if machine.sources:
            meaning = "of the machine, each coordinate of each visit"
            extras["repeatability"] = _array(machine.value, (), "m", meaning).assign_attrs(source=machine.source)
            extras["repeatability_u"] = _array(machine.uncertainty, (), "m")
        return extras

    def _axes(
        self, solved: Solved, errors: Errors, own: Array, notes: list[str]
    ) -> tuple[dict[str, xr.DataArray], dict[str, Any]] | None:
        """Return the errors of the axes and their labels; if they are not determined, a note states the reason."""
        data, settings, fit = self.data, self.settings, solved.fit
        if not settings.parametric or (fit.freedom > 0 and fit.chi2 < NOTHING**2 * fit.freedom):
            return None
        chain = settings.chain or self.attrs.get("chain")
        if not isinstance(chain, str):
            notes.append("No errors of the axes: the chain of the machine is unknown (setting or attribute 'chain').")
            return None
        try:
            axes = fit_machine(
                chain,
                data.position,
                errors.value,
                own,
                # what the datum adds is a motion of the whole, which is fitted as well
                np.array([each.effect for each in errors.sources if each.joined not in OF_DATUM]),
                reflector=data.reflector,
                max_order=settings.max_order,
            )
        except MethodError as refusal:
            notes.append(f"No errors of the axes. {refusal}")
            return None
        notes += misfit_note(axes, settings.max_order)
        if axes.undetermined:
            reasons = "; ".join(f"{name}: {each.reason}" for name, each in axes.undetermined.items())
            notes.append(f"Errors of the axes that these targets do not determine: {reasons}.")
        return parametric_extras(axes), parametric_labels(axes)


def _array(values: Any, dims: tuple[str, ...], unit: str, meaning: str = "") -> xr.DataArray:
    attrs = ({"units": unit} if unit else {}) | ({"long_name": meaning} if meaning else {})
    return xr.DataArray(values, dims=dims, attrs=attrs)
