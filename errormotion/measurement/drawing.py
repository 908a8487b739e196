"""Random draws of the sources of a model: for the Monte Carlo evaluation, and for simulated raw data.

Readings are drawn about those measured, constants and priors about their values (JCGM 101): a trial is one fit of
arrays, without the reading of raw data. It therefore shows whether the linear propagation holds; the reading itself is
part of simulated data.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import provenance
from errormotion.estimation.checks.correlated import coloured
from errormotion.estimation.derivatives import along, column
from errormotion.estimation.problem import Problem
from errormotion.estimation.sources import errors_of
from errormotion.kinematics.iso import DOF
from errormotion.measurement.identification import Solved, dataset, related, solve, values_of
from errormotion.measurement.observed import Model, Observed, as_expected
from errormotion.plugins import MethodInfo, RandomSource, TrialModel, replaced

__all__ = ["READINGS", "independent_draws", "moved", "simulate", "standard_draw", "trial_model"]

READINGS = "readings"
"""The name of the noise among the sources."""


def trial_model(model: Model, raw: xr.Dataset, settings: Any, info: MethodInfo) -> TrialModel:
    """Return the readings of raw data and all sources of the model; each trial is a fit of arrays, of values only."""
    solved = solve(model.observe(raw, settings))
    result = dataset(model, solved, raw, info, provenance.make(settings, None, None, steps=["trial"]))
    result = result[[*DOF, *({"deviation"} & set(result))]]
    observed, problem = solved.observed, solved.observed.problem
    readings = column(problem.readings)
    # A trial has the noise that was found, and does not examine its readings.
    frozen = replace(as_expected(observed), correlation=observed.correlation, resolution=0.0)
    weighed = replace(problem, noise=replace(solved.white.problem.noise, stated=True))
    start = xr.Dataset({READINGS: (("reading", "number"), readings)})
    root, freedom = _noise(solved)
    sources: dict[str, RandomSource] = {}

    def noisy(data: xr.Dataset, its: Any, generator: np.random.Generator) -> tuple[xr.Dataset, Any]:
        size = 1.0 if np.isinf(freedom) else float(np.sqrt(freedom / generator.chisquare(freedom)))
        shift = _noisy(observed, root, generator.standard_normal(readings.shape)) * size
        if solved.rounding is not None:
            shift = shift + solved.rounding.sd * generator.standard_normal(readings.shape)
        return data.assign({READINGS: data[READINGS] + shift}), its

    groups = {source.group for source in solved.relative.errors.sources}
    of_readings = {observed.shared, *((observed.datum.group,) if observed.datum is not None else ())}
    sources[READINGS] = RandomSource(noisy, groups=tuple(sorted(of_readings & groups)), own=True)
    numbers = independent_draws(problem)
    for name, number in numbers.items():
        sources[name] = RandomSource(standard_draw(name, number), groups=(name,) if name in groups else ())

    def trial(data: xr.Dataset, _settings: Any) -> xr.Dataset:
        drawn = {name: np.asarray(data[name].values) for name in numbers if name in data}
        changed = moved(weighed, data[READINGS].values.reshape(problem.readings.shape), drawn)
        solved_trial = solve(replace(frozen, problem=changed), sources=False, start=solved.fit.linear.at)
        return replaced(result, values_of(solved_trial))

    return TrialModel(start, settings, sources, identify=trial)


def simulate(model: Model, settings: Any, seed: int, info: MethodInfo) -> tuple[xr.Dataset, xr.Dataset]:
    """Return raw data with every source of the model drawn once, and the true errors.

    The readings fulfil the equation for the expected errors and the drawn constants, and have noise.

    Raises
    ------
    ValueError
        The model does not state which variable the readings are (`Observed.recorded`), or how they are recorded.
    """
    generator = np.random.default_rng(seed)
    raw = model.expected(settings)
    observed = model.observe(raw, settings)
    problem = observed.problem
    exact = solve(as_expected(observed))
    drawn = {name: generator.standard_normal(number) for name, number in independent_draws(problem).items()}
    true = moved(problem, problem.readings, drawn, priors=False)
    y = _consistent(true, exact, drawn)
    measured = _recorded(observed, raw, y, generator)
    truth = dataset(model, exact, raw, info, provenance.make(settings, None, None, steps=["simulation"], seed=seed))
    # Errors may depend on the constants themselves, such as a lever: the truth has those that were drawn.
    linear = replace(exact.fit.linear, problem=replace(true, noise=exact.fit.problem.noise))
    stated, drawn_errors = (
        related(observed, errors_of(fit, observed.places, sources=False)).errors.value
        for fit in (exact.fit, replace(exact.fit, linear=linear))
    )
    errors = exact.relative.errors
    shifted = replace(errors, value=errors.value + (drawn_errors - stated))
    truth = replaced(truth, values_of(replace(exact, relative=replace(exact.relative, errors=shifted))))
    zero = truth.copy()
    for key in ("covariance", "influence", "deviation_variance", "deviation_influence"):
        if key in zero:
            zero[key] = zero[key].copy(data=np.where(np.isfinite(zero[key].values), 0.0, np.nan))
    made = json.dumps([{"id": f"model of {info.id}", "simulated": True}])
    return measured.assign_attrs(machine="simulated", instruments=made), zero.assign_attrs(machine="simulated")


def _recorded(observed: Observed, raw: xr.Dataset, y: Array, generator: np.random.Generator) -> xr.Dataset:
    """Return raw data with readings and their noise."""
    problem = observed.problem
    if observed.record is not None:
        return observed.record(raw, y, generator)
    if observed.recorded is None:
        raise ValueError("simulate: expected a model that states 'recorded', the variable of its readings, or 'record'")
    root = np.linalg.cholesky(problem.noise.covariance(column(y).shape))
    noisy = column(y) + (root @ generator.standard_normal((*column(y).shape, 1)))[..., 0]
    name, dims = observed.recorded
    shape = [raw.sizes[dim] for dim in dims]
    values = np.where(np.isfinite(column(problem.readings)), noisy, np.nan).reshape(shape)
    order = raw[name].dims
    return raw.assign({name: xr.DataArray(values, dims=dims, attrs=raw[name].attrs).transpose(*order)})


def independent_draws(problem: Problem) -> dict[str, int]:
    """Return the number of independent draws of each source by its group: constants, and priors of unknowns."""
    counts: dict[str, int] = {}
    for name, block in zip(problem.unknowns._fields, problem.unknowns, strict=True):
        count = int(np.count_nonzero(block.information[block.freed]))
        if count:
            counts[block.group or name] = counts.get(block.group or name, 0) + count
    for name, constant in zip(getattr(problem.constants, "_fields", ()), problem.constants, strict=True):
        if constant.sources:
            counts[constant.group or name] = counts.get(constant.group or name, 0) + constant.sources
    return counts


def standard_draw(name: str, number: int) -> Callable[..., tuple[xr.Dataset, Any]]:
    """Return the draw of standard normal numbers of one source."""

    def draw(data: xr.Dataset, its: Any, generator: np.random.Generator) -> tuple[xr.Dataset, Any]:
        return data.assign({name: ((f"{name} number",), generator.standard_normal(number))}), its

    return draw


def moved(problem: Problem, readings: Array, drawn: dict[str, Array], *, priors: bool = True) -> Problem:
    """Return the problem with other readings, and with constants and centres of priors moved by draws."""
    left = {name: list(np.asarray(values, dtype=float)) for name, values in drawn.items()}
    unknowns, constants = [], []
    for name, block in zip(problem.unknowns._fields, problem.unknowns, strict=True):
        which = block.freed & (block.information > 0)
        group = block.group or name
        if which.any() and group in left:
            start = block.start.copy()
            z = np.array([left[group].pop(0) for _ in range(int(which.sum()))])
            if priors:
                start[which] += z / np.sqrt(block.information[which])
            block = replace(block, start=start)
        unknowns.append(block)
    for name, constant in zip(getattr(problem.constants, "_fields", ()), problem.constants, strict=True):
        group = constant.group or name
        if constant.sources and group in left:
            z = np.array([left[group].pop(0) for _ in range(constant.sources)])
            constant = replace(constant, value=constant.value + constant.factor @ z)
        constants.append(constant)
    return replace(
        problem,
        readings=readings,
        unknowns=type(problem.unknowns)(*unknowns),
        constants=type(problem.constants)(*constants) if constants else problem.constants,
    )


def _consistent(true: Problem, exact: Solved, drawn: dict[str, Array]) -> Array:
    """Return readings that fulfil the equation for the unknowns of a solution and the constants of ``true``.

    The unknowns with a prior are drawn as well. The change of a reading is the least one that fulfils the equation,
    ``-L' (L L')^-1 r`` with ``L = dr/dy``.
    """
    at = exact.fit.linear.at
    tables, left = [], {name: list(values) for name, values in drawn.items()}
    for name, block, table in zip(true.unknowns._fields, true.unknowns, at.tables, strict=True):
        which = block.freed & (block.information > 0)
        its = table.copy()
        for row, col in np.argwhere(which):
            its[row, col] = block.start[row, col] + left[block.group or name].pop(0) / np.sqrt(
                block.information[row, col]
            )
        tables.append(its)
    rows = [
        table.rows(value)
        for table, value in zip(true.tables, [*tables, *(constant.value for constant in true.constants)], strict=True)
    ]
    y = column(true.y).copy()
    shape = true.readings.shape
    scale = np.broadcast_to(np.asarray(true.reading_scale, dtype=float), (y.shape[1],))
    for _ in range(4):
        r = column(true.evaluate(y.reshape(shape), rows))
        L = along(lambda at: true.evaluate(at.reshape(shape), rows), y, scale)
        y = y - (np.linalg.pinv(L) @ r[..., None])[..., 0]
    return y.reshape(shape)


def _noisy(observed: Observed, root: Array, z: Array) -> Array:
    """Return noise (n, r) from independent standard normal numbers, correlated along the order of the readings."""
    if observed.order is not None and observed.correlation:
        used = np.all(np.isfinite(column(observed.problem.readings)), axis=1)
        z = coloured(z, used, observed.order, observed.correlation, observed.series)
    return np.asarray((root @ z[..., None])[..., 0])


def _noise(solved: Solved) -> tuple[Array, float]:
    """Return square roots of the covariances of the readings, (n, r, r), and the degrees of freedom of their size."""
    problem = solved.observed.problem
    V = problem.noise.covariance(column(problem.readings).shape) * solved.scatter.factor
    return np.asarray(np.linalg.cholesky(V), dtype=float), solved.scatter.freedom
