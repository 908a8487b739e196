"""Identification by a measurement model: fit, noise, errors relative to their datum, and the error dataset."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import build_deviations, build_errors, plausibility, provenance
from errormotion.datasets.raw import variant_of
from errormotion.datasets.timing import start_of
from errormotion.errors import FitError, MethodError
from errormotion.estimation.checks import exclusions, resolution
from errormotion.estimation.checks.candidates import Candidate
from errormotion.estimation.checks.effects import information, solved
from errormotion.estimation.checks.exclusions import Cleaned, cleaned
from errormotion.estimation.checks.reliability import reliability
from errormotion.estimation.datum import Relative, relative
from errormotion.estimation.derivatives import column
from errormotion.estimation.fewest import fewest
from errormotion.estimation.fit import Fit, fit
from errormotion.estimation.linear.normal import SingularError
from errormotion.estimation.problem import Problem, Unknown
from errormotion.estimation.sources import Errors, errors_of
from errormotion.estimation.variance import expansion
from errormotion.kinematics.iso import DOF
from errormotion.measurement.noise import (
    beyond_of,
    estimated_noise,
    fitted,
    has_priors,
    neighbours_of,
    rounding_of,
    scaled,
    scatter_of,
    searchable,
    size_of_noise,
    steps_of,
)
from errormotion.measurement.observed import Model, Observed, Solved
from errormotion.plugins import MethodInfo

__all__ = ["Solved", "dataset", "identify", "of_readings", "reliability_of", "solve", "values_of"]


def solve(observed: Observed, *, sources: bool = True, start: Unknown | None = None) -> Solved:
    """Return the solution of a problem.

    Parameters
    ----------
    observed : Observed
    sources : bool
        Whether covariance and sources of the errors are wanted, and what readings that are all used look like; a trial
        needs values only.
    start : Unknown, optional
        Where the fit starts, such as the solution for similar readings.

    Raises
    ------
    MethodError
        The readings do not determine the unknowns, or neither noise nor redundancy is there.
    """
    try:
        given = observed.problem
        observed = replace(observed, resolution=steps_of(observed))
        observed, solution, search = _cleaned(observed if sources else replace(observed, examined=None), start)
        whole = beyond_of(observed, solution)
        if whole is not observed:
            observed, solution = whole, fitted(whole, whole.problem, solution)
        neighbours = neighbours_of(observed, solution)
        observed = replace(
            observed,
            correlation=neighbours.phi,
            notes=[*observed.notes, neighbours.note],
            doubts=[*observed.doubts, neighbours.doubt],
        )
        if neighbours.phi > 0:
            solution = fitted(observed, observed.problem, solution)
        scatter, final = scatter_of(observed, solution)
        # An estimated variance has a Student distribution (GUM, G.3.2).
        factor = (scatter.factor if final is solution else 1.0) * float(
            expansion(neighbours.freedom(scatter.freedom))
        ) ** 2
        base = observed.problem if final is solution else scaled(observed.problem, scatter.factor)
        rounding = rounding_of(observed, base, scatter.factor if final is solution else 1.0)
        if rounding is not None:
            observed = replace(
                observed, notes=[*observed.notes, resolution.sentence(observed.what, rounding, observed.unit)]
            )
            base, factor = scaled(base, factor, rounding.sd), 1.0
            final = fitted(observed, base, final)
        observed = replace(observed, doubts=[*observed.doubts, size_of_noise(observed, base, factor)])
        white = final if neighbours.phi == 0 or not sources else fitted(replace(observed, order=None), base, final)
        errors = errors_of(final, observed.places, factor=factor, shared=observed.shared, sources=sources)
        solved = Solved(
            observed=observed,
            fit=final,
            white=white,
            scatter=scatter,
            relative=related(observed, errors),
            given=given,
            cleaned=search,
            rounding=rounding,
            propagated=sources,
            factor=factor,
        )
        return solved if observed.finish is None else observed.finish(solved)
    except FitError as error:
        text = str(error)
        if isinstance(error.__cause__, SingularError) and observed.undetermined is not None:
            text = observed.undetermined(observed.problem)
        raise MethodError(f"{text[:1].upper()}{text[1:].rstrip('.')}.", code=error.code) from error


def _cleaned(observed: Observed, start: Unknown | None) -> tuple[Observed, Fit, Cleaned | None]:
    """Return what was observed without outliers, with a note on each, the fit, and what was found."""
    if not observed.robust:
        plain = fit(observed.problem, refresh=observed.refresh, what=observed.what, start=start)
        if observed.examined is not None:
            observed = replace(
                observed, examined=None, doubts=[*observed.doubts, *_examined(observed, observed.examined)]
            )
        return observed, plain, None
    problem, what = observed.problem, observed.what
    if not problem.noise.stated and has_priors(problem):
        # Else a unit of noise would hide what the readings say about the constants.
        problem = estimated_noise(
            fit(problem, refresh=observed.refresh, what=what), refresh=observed.refresh, what=what
        )[0].problem
    searched = searchable(observed, problem)
    try:
        search = cleaned(
            searched,
            suspects=observed.suspects,
            whole=observed.whole,
            name=observed.name,
            refresh=observed.refresh,
            structure=observed.structure,
            what=what,
        )
    except FitError as error:
        # Too many readings would have to be excluded, if all of them determine the unknowns.
        first = fit(searched, refresh=observed.refresh, what=what)
        suspects = () if observed.suspects is None else observed.suspects(first)
        raise _contradiction(what, [_likeliest(first, suspects)]) from error
    words = [" or ".join([each.words, *each.rivals]) for each in search.undecided]
    if words and observed.refuses_contradictions:
        raise _contradiction(what, words)
    name = what.removeprefix("the ")
    notes, doubts = exclusions.notes(search, name), exclusions.doubts(search, name)
    last = search.fit
    if searched is not problem:
        last = fitted(observed, replace(last.problem, noise=problem.noise), last)
    after = replace(
        observed,
        problem=last.problem,
        robust=False,
        notes=[*observed.notes, *notes],
        doubts=[*observed.doubts, *doubts],
    )
    return after, last, search


def _examined(observed: Observed, problem: Problem) -> list[str]:
    """Return a sentence on the outliers of readings that are all used."""
    try:
        search = cleaned(
            searchable(observed, problem),
            suspects=observed.suspects,
            whole=observed.whole,
            name=observed.name,
            what=observed.what,
        )
    except FitError:
        return [f"{observed.what[:1].upper()}{observed.what[1:]} contradict one another; all of them are used."]
    return exclusions.kept(search, observed.what.removeprefix("the "))


def _contradiction(what: str, words: list[str]) -> MethodError:
    return MethodError(
        f"{what[:1].upper()}{what[1:]} contradict one another ({'; '.join(filter(None, words)) or 'no likely cause'}), "
        "and without what is wrong they do not determine the result. Correct the cause and measure again, or remove "
        "what is wrong.",
        code="readings.contradict",
    )


def _likeliest(solution: Fit, suspects: Iterable[Candidate]) -> str:
    """Return the words of the candidate that decreases the sum of squares most."""
    best, words = 0.0, ""
    for each in suspects:
        design = each.design if each.design.ndim == 3 else each.design[:, None, :]
        u, N = information(solution, design)
        gain = float(np.ravel(solved(u[None], N[None])[1])[0])
        if gain > best:
            best, words = gain, each.words
    return words


def related(observed: Observed, errors: Errors) -> Relative:
    """Return errors relative to the datum of the model, with the fewest sources."""
    if observed.datum is None:
        none = np.zeros(0)
        relative_errors = Relative(errors, none, np.zeros((0, 0)), np.zeros((len(errors.sources), 0)))
    else:
        relative_errors = relative(errors, observed.datum, noise=observed.shared)
    return fewest(relative_errors)


def identify(model: Model, raw: xr.Dataset, settings: Any, info: MethodInfo) -> xr.Dataset:
    """Return the error dataset of raw data that follow their schema.

    Raises
    ------
    MethodError
        The data do not determine the result.
    """
    solved = solve(model.observe(raw, settings))
    steps = [f"least squares of {solved.observed.what}"]
    origin = provenance.make(settings, raw, None, steps=steps, raw_hash=solved.observed.raw_hash)
    return dataset(model, solved, raw, info, origin)


def dataset(
    model: Model, solved: Solved, raw: xr.Dataset, info: MethodInfo, origin: Any, *, planned: bool = False
) -> xr.Dataset:
    """Return the error dataset of a solution; with ``planned`` its values are 0 where they are known."""
    observed, datum = solved.observed, solved.relative
    shape = _shape(observed)
    notes, doubts = [*observed.notes], [*observed.doubts]
    if not planned:
        (doubts if solved.scatter.doubtful else notes).append(solved.scatter.note)
        tables = [table for table in getattr(model, "raw_schemas", ()) if table.id == raw.attrs.get("schema")]
        table = variant_of(raw, tables) if tables else None
        doubts += plausibility.of_raw(raw, table) if table else []
    if planned:
        zero = np.where(np.isfinite(datum.errors.value), 0.0, np.nan)
        datum = replace(datum, errors=replace(datum.errors, value=zero), coefficient=0.0 * datum.coefficient)
    errors = datum.errors
    names = _unique([source.name for source in errors.sources])
    common: dict[str, Any] = {
        "dims": observed.dims,
        "coords": observed.coords,
        "component": observed.component,
        "machine": "plan" if planned else str(raw.attrs.get("machine", "unknown")),
        "frame": observed.frame,
        "functional_point": np.asarray(observed.functional_point, dtype=float),
        "reference": f"{observed.reference} (planned, not measured)" if planned else observed.reference,
        "method": info.id,
        "method_version": info.version,
        "provenance": origin,
        "sources": names,
        "source_groups": [source.group for source in errors.sources],
        "source_ids": {name: s.identity for name, s in zip(names, errors.sources, strict=True) if s.identity},
        "extras": of_readings(solved, raw) | dict(observed.extras) | dict(model.results(observed, solved.fit, datum)),
        "start": "" if planned else start_of(raw, observed.zero),
        "measured": None if planned else raw.attrs,
        "notes": notes,
        "doubts": doubts,
        **observed.attributes,
    }
    if observed.sensitivity is not None:
        found = build_deviations(
            errors.value[:, 0].reshape(shape),
            errors.covariance[:, 0, 0].reshape(shape),
            observed.sensitivity.reshape(*shape, 6),
            influence=errors.influence.reshape(len(names), *shape),
            **common,
        )
    else:
        found = build_errors(
            _placed(errors.value, observed, shape),
            _square(errors.covariance, observed, shape),
            influence=_placed(errors.influence, observed, (len(names), *shape)),
            **common,
        )
    return found.assign_attrs(observed.attrs)


def values_of(solved: Solved) -> dict[str, Array]:
    """Return the values of a solution by the name of their variable, in the dims of the result."""
    observed, value = solved.observed, solved.relative.errors.value
    shape = _shape(observed)
    if observed.sensitivity is not None:
        return {"deviation": value[:, 0].reshape(shape)}
    return dict(zip(DOF, np.moveaxis(_placed(value, observed, shape), -1, 0), strict=True))


def of_readings(solved: Solved, raw: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return residuals, exclusions and reliability of the readings, over their dims in the raw data.

    Without the last dim, the numbers of a reading, if a reading of several numbers has one residual.
    """
    recorded, given, white = solved.observed.recorded, solved.given, solved.white
    numbers = column(given.readings)
    single = white.residual.shape[1] == 1 and numbers.shape[1] > 1
    if recorded is None or not solved.observed.reliability or not (single or white.residual.size == numbers.size):
        return {}
    name, dims = recorded
    unit = str(raw[name].attrs.get("units", "1"))
    dims = dims[:-1] if single else dims
    shape = tuple(raw.sizes[dim] for dim in dims)
    out = np.isfinite(numbers) & ~np.isfinite(column(white.problem.readings))
    residual = replace(white.problem, readings=given.readings).residuals(white.linear.at)
    parts: dict[str, tuple[Any, dict[str, str]]] = {
        "residual": (residual, {"units": unit, "long_name": "reading minus fitted, also of excluded readings"}),
        "left_out": ((out.any(axis=1) if single else out).astype(np.int8), {"long_name": "1 = excluded"}),
        **reliability_of(solved, unit),
    }
    return {
        name: xr.DataArray(values.reshape(shape), dims=dims, attrs=attrs) for name, (values, attrs) in parts.items()
    }


def reliability_of(solved: Solved, unit: str) -> dict[str, tuple[Array, dict[str, str]]]:
    """Return redundancy, smallest error that is found and its effect on the result, (n, m), with their attributes."""
    numbers = reliability(solved.white, factor=solved.fit_factor, pairs=False)
    return {
        "redundancy": (numbers.redundancy, {"units": "1", "long_name": "share of an error that the residual shows"}),
        "smallest_error": (
            numbers.smallest,
            {"units": unit, "long_name": "smallest gross error that would be found with a probability of 80 %"},
        ),
        "smallest_error_effect": (
            numbers.bias,
            {"units": "1", "long_name": "largest effect of this error on any result, in its standard uncertainties"},
        ),
    }


def _shape(observed: Observed) -> tuple[int, ...]:
    """Return the sizes of the dims of the result, from their coordinates; one without has the rest of the places."""
    sizes = []
    for dim in observed.dims:
        value = observed.coords.get(dim)
        sizes.append(0 if value is None else len(value[1]) if isinstance(value, tuple) else len(value))
    rest = observed.places.count // max(int(np.prod([size for size in sizes if size])), 1)
    return tuple(size or rest for size in sizes)


def _placed(values: Array, observed: Observed, shape: tuple[int, ...]) -> Array:
    """Return values (..., place, d) as (..., 6), NaN for the freedoms that the model does not determine."""
    placed = np.full((*values.shape[:-1], 6), np.nan)
    for k, name in enumerate(observed.freedoms):
        placed[..., DOF.index(name)] = values[..., k]
    return placed.reshape(*shape, 6)


def _square(covariance: Array, observed: Observed, shape: tuple[int, ...]) -> Array:
    """Return covariances (place, d, d) as (..., 6, 6)."""
    which = np.array([DOF.index(name) for name in observed.freedoms])
    square = np.full((len(covariance), 6, 6), np.nan)
    square[:, which[:, None], which] = covariance
    return square.reshape(*shape, 6, 6)


def _unique(names: list[str]) -> list[str]:
    """Return names with a number where one occurs several times."""
    seen: dict[str, int] = {}
    unique = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        unique.append(name if names.count(name) == 1 else f"{name} {seen[name]}")
    return unique
