"""What a model states about raw data: the problem, the places of its errors, and what the result is called."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

from errormotion.kinematics.iso import DOF

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr

    from errormotion.arrays import Array
    from errormotion.estimation.blocks import Index
    from errormotion.estimation.checks.candidates import Candidate
    from errormotion.estimation.checks.exclusions import Cleaned
    from errormotion.estimation.checks.resolution import Rounding
    from errormotion.estimation.datum import Datum, Relative
    from errormotion.estimation.fit import Fit
    from errormotion.estimation.problem import Problem
    from errormotion.estimation.sources import Places
    from errormotion.estimation.variance import Scatter

__all__ = ["Model", "Observed", "Solved", "as_expected"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Observed:
    """Raw data as a problem of least squares, and the errors that follow from its solution.

    Attributes
    ----------
    problem : Problem
        Readings with their equation, unknowns and constants; `errormotion.estimation`.
    places : Places
        Where errors are wanted; its equation returns (place, d), m and rad.
    freedoms : sequence of str, (d,)
        What the d errors are, among EX EY EZ EA EB EC.
    dims : sequence of str
        Of the result; the places are in their order. Empty for one place. One of them may have no coordinate.
    coords : mapping
        As for `errormotion.datasets.build_errors`: name to array, or to (dims, array, attributes).
    component, reference, frame : str
        Attributes of the error dataset.
    functional_point : sequence of float, (3,)
        m.
    datum : Datum, optional
        What the errors are relative to; without one they are as the equation states them.
    sensitivity : ndarray, (place, 6), optional
        For errors along one known direction only: d = 1, and the effect of one unit of each freedom on it. The result
        has them as ``deviation`` (`errormotion.datasets.build_deviations`).
    recorded : tuple of str, and its dims
        The variable of the raw data that the readings are, and the dims in the order of the readings. With it, the
        framework simulates raw data.
    record : callable, optional
        For readings that are not a variable of the raw data, such as gradients of them: from raw data, readings without
        noise in the shape of the problem, and a generator to raw data with noise.
    reliability : bool
        Whether the result has residuals, redundancy and smallest detectable errors of its ``recorded`` readings.
    shared : str
        Group in the budget of the noise of the readings as far as places have it in common.
    what : str
        The readings, as the subject of a sentence of the notes: "the touches".
    noise_cause : str
        A remedy, for the note on readings that scatter more than stated.
    noise_size : callable, optional
        From a factor for the standard deviation of the noise to the noise in words: "1.3 um".
    noise_increases : bool
        Whether the uncertainties follow the residuals if these scatter more than stated.
    unit : str
        Of the readings, for notes: m or rad.
    resolution : float or ndarray, (r,), optional
        Step of the scale that the readings, or each of their numbers, are rounded to, in their unit; 0 for none. By
        default it is found from the readings.
    order : ndarray, (n,), optional
        Time or position of each reading. With it, noise that is correlated along this order is found and taken into
        account (`errormotion.estimation.checks.correlated`), and where as many readings as unknowns check nothing,
        noise beyond the stated one by its scatter about smooth curves over time
        (`errormotion.estimation.checks.slow_noise`).
    breaks : sequence of float
        Values of ``order`` at which what is measured may change abruptly; otherwise it is smooth.
    series : ndarray of int, (n,), optional
        The run or the channel of each reading; different ones are independent.
    correlation : float, optional
        Of neighbours, if it is known; otherwise it is estimated.
    refresh : callable, optional
        See `errormotion.estimation.fit.fit`.
    robust : bool
        Whether outliers among the readings are excluded, with a note, by one rule with its rate of false alarms.
    examined : Problem, optional
        Where all readings are used (``robust = False``): the problem in which outliers are searched, to name them in a
        note that doubts the uncertainties. Its noise should not contain them.
    suspects : callable, optional
        From a fit to what may have happened besides single outliers (`errormotion.estimation.checks.candidates`), which
        is then excluded or estimated as well.
    refuses_contradictions : bool
        Whether a contradiction that the readings do not resolve, such as a ball that has moved where all balls are
        needed, is refused; otherwise the readings are used, with a note.
    name : callable, optional
        From the index of a reading to its name in these notes: "sphere 2 at 30 deg, sensor 1".
    whole : bool
        Whether all numbers of a reading are wrong together; see `errormotion.estimation.checks.exclusions.cleaned`.
    structure : callable, optional
        What depends on the readings that are used; see there. ``problem`` fulfils it.
    undetermined : callable, optional
        From a problem whose readings do not determine its unknowns to a sentence on the reason, with a remedy.
    finish : callable, optional
        From the solution to one with whatever else follows from it: names, notes and variables of the result, or other
        errors. Called after each solution, also that of a plan and of a trial (`Solved.propagated`).
    extras : mapping of str to DataArray
        Further variables of the result that follow from the raw data.
    attributes : mapping
        Further arguments of `errormotion.datasets.build_errors`.
    attrs : mapping
        Further attributes of the error dataset.
    zero : float
        Time of the raw data that is time 0 of the result, s.
    raw_hash : str, optional
        Hash of the raw data, where their reading gave it; otherwise they are read once more.
    notes : sequence of str
        What the reader of the raw data noticed.
    doubts : sequence of str
        Further notes: why the uncertainties may be too small. No decision on a tolerance relies on them then.
    """

    problem: Problem
    places: Places
    dims: Sequence[str]
    coords: Mapping[str, Any]
    component: str
    functional_point: Sequence[float]
    reference: str
    freedoms: Sequence[str] = DOF
    frame: str = "machine"
    datum: Datum | None = None
    sensitivity: Array | None = None
    recorded: tuple[str, tuple[str, ...]] | None = None
    record: Callable[[xr.Dataset, Array, np.random.Generator], xr.Dataset] | None = None
    reliability: bool = True
    shared: str = "readings"
    what: str = "the readings"
    noise_cause: str = ""
    noise_size: Callable[[float], str] | None = None
    noise_increases: bool = True
    unit: str = "m"
    resolution: float | Array | None = None
    order: Array | None = None
    breaks: Sequence[float] = ()
    series: Index | None = None
    correlation: float | None = None
    refresh: Callable[[Problem, Any], Problem] | None = None
    robust: bool = True
    examined: Problem | None = None
    suspects: Callable[[Fit], Iterable[Candidate]] | None = None
    refuses_contradictions: bool = False
    name: Callable[[Index], str] | None = None
    whole: bool = False
    structure: Callable[[Problem], Problem] | None = None
    undetermined: Callable[[Problem], str] | None = None
    finish: Callable[[Solved], Solved] | None = None
    extras: Mapping[str, xr.DataArray] = field(default_factory=dict)
    attributes: Mapping[str, Any] = field(default_factory=dict)
    attrs: Mapping[str, Any] = field(default_factory=dict)
    zero: float = 0.0
    raw_hash: str | None = None
    notes: Sequence[str] = ()
    doubts: Sequence[str] = ()


@dataclass(frozen=True, eq=False)
class Solved:
    """The solution of a model.

    Attributes
    ----------
    observed : Observed
        Without outliers, which are not looked for any more.
    fit : Fit
        From which the errors follow.
    white : Fit
        With independent noise of the stated size, for residuals and reliability.
    rounding : Rounding, optional
        What rounding adds to the noise.
    factor : float
        Variance factor of the readings that the covariances of ``fit`` lack.
    scatter : Scatter
        What the residuals say about the noise.
    relative : Relative
        The errors with their datum.
    given : Problem
        The problem with all readings.
    cleaned : Cleaned, optional
        What was excluded; None if nothing was searched.
    propagated : bool
        Whether the errors have their covariance and sources. Those of a trial have values only: `Observed.finish` then
        only does what changes these.
    """

    observed: Observed
    fit: Fit
    white: Fit
    scatter: Scatter
    relative: Relative
    given: Problem
    cleaned: Cleaned | None = None
    rounding: Rounding | None = None
    propagated: bool = True
    factor: float = 1.0

    @property
    def fit_factor(self) -> float:
        """Variance factor that the noise in ``white`` lacks: 1 if it is a part of the fit, as beside priors."""
        return self.scatter.factor if self.white.problem.noise is self.observed.problem.noise else 1.0


def as_expected(observed: Observed) -> Observed:
    """Return a model of expected readings, which say nothing about their noise."""
    step = 0.0 if observed.resolution is None else observed.resolution
    return replace(observed, noise_increases=False, robust=False, examined=None, resolution=step, correlation=0.0)


class Model(Protocol):
    """The measurement model of a method."""

    def observe(self, raw: xr.Dataset, settings: Any) -> Observed:
        """Return what raw data, which follow their schema, mean; the only place that sees datasets and settings.

        Raises
        ------
        MethodError
            The data do not determine the result, with a remedy.
        """

    def expected(self, settings: Any) -> xr.Dataset:
        """Return raw data as a test with these settings would give them without noise, for errors of typical size.

        The size matters: an error of 0 hides every source that multiplies it.
        """

    def results(self, observed: Observed, fit: Fit, relative: Relative) -> Mapping[str, xr.DataArray]:
        """Return further variables of the result that follow from the solution."""
