"""Readings whose noise is correlated along an order, such as time or position, and trends along it.

The noise of neighbours, in units of its standard deviation, follows ``e_t = phi e_(t-1) + w_t`` (AR(1)), with the step
as unit and ``phi^d`` for neighbours d steps apart. It is whitened by differences of neighbours,

    w_t = (e_t - phi e_(t-1)) / sqrt(1 - phi^2),    the first one of a series as it is,

so that every whitened number still belongs to one reading. phi is estimated by restricted likelihood, with the fixed
effects eliminated (Patterson and Thompson, Biometrika 58 (1971) 545; without, phi would be too small by (1 + 3 phi) / n
and more for every unknown), between 0 and 1, and with a prior that draws it to 0 as long as the readings are few.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.estimation.additions import with_linear
from errormotion.estimation.blocks import Index, Noise, Table
from errormotion.estimation.derivatives import by_rows, column
from errormotion.estimation.fit import Fit, fit
from errormotion.estimation.linear.system import linearised
from errormotion.estimation.problem import Problem, Unknown

__all__ = ["Correlated", "autoregressive", "coloured", "correlated", "effective_number", "lag_one", "with_trend"]

TYPICAL = 0.8
"""Standard deviation of artanh(phi) in its prior: two thirds of all phi below 0.66.

It matters for few readings only: with 15, a correlation of 0.5 is covered in 97 %, white noise in 99 %.
"""
LARGEST = 0.98
_STEP = 0.02
_PRECISION = 1e-3

AnyTable = TypeVar("AnyTable", bound=Table)


@dataclass(frozen=True, eq=False)
class Correlated:
    """A fit with correlated noise.

    Attributes
    ----------
    phi, u_phi : float
        Correlation of neighbours, and its standard uncertainty.
    independent : float
        Number of independent readings with as much information on a mean as all of these.
    gain : float
        Decrease of -2 log L against white noise.
    """

    phi: float
    u_phi: float
    independent: float
    gain: float
    _fitted: Callable[[float], Fit]

    @cached_property
    def fit(self) -> Fit:
        """The fit of the differences, see `autoregressive`."""
        return self._fitted(self.phi)

    def freedom_of(self, a: Array, b: Array) -> Array:
        """Return the degrees of freedom of the variances of linear functions of the unknowns, (k,).

        Parameters
        ----------
        a, b : ndarray, (R, p, k) and (q, k)
            Derivatives by the eliminated unknowns and by those of the border.

        Notes
        -----
        With the variance g, ``2 / freedom = 2 / f + (d log g / d phi)^2 u(phi)^2`` (Satterthwaite), where g is that for
        the noise estimated with phi; without the first term for a stated noise.
        """
        low = max(self.phi - _STEP, 0.0)
        logs = []
        for each in map(self._fitted, (low, low + 2 * _STEP)):
            x, z = each.normal.solve(a, b)
            g = np.einsum("rpk,rpk->k", a, x) + np.einsum("qk,qk->k", b, z)
            logs.append(np.log(g) + (0.0 if each.problem.noise.stated else np.log(each.chi2)))
        slope = (logs[1] - logs[0]) / (2 * _STEP)
        own = 0.0 if self.fit.problem.noise.stated else 2.0 / max(self.fit.freedom, 1)
        return np.asarray(2.0 / np.maximum(own + np.square(slope) * self.u_phi**2, 1e-12))


def correlated(white: Fit, order: Array, series: Index | None = None, *, typical: float = TYPICAL) -> Correlated:
    """Return the fit with noise that is correlated along an order, with the correlation that is most likely.

    Parameters
    ----------
    white : Fit
        With white noise.
    order : ndarray, (n,)
        Time or position of each reading; the median step is the unit of phi.
    series : ndarray of int, (n,), optional
        Readings of different series (runs, channels) are independent.
    typical : float
        See `TYPICAL`.
    """
    from scipy.optimize import minimize_scalar

    problem, at = white.problem, white.linear.at
    near = _linear(problem, at)

    @cache
    def deviance(phi: float) -> float:
        return _deviance(near, at, order, series, phi) + float(np.arctanh(phi) / typical) ** 2

    phi = 0.0
    if deviance(_STEP) < deviance(0.0):  # there is one minimum, which is at 0 if it increases from there
        best = minimize_scalar(deviance, bounds=(0.0, LARGEST), method="bounded", options={"xatol": _PRECISION})
        phi = float(best.x) if best.fun < deviance(0.0) else 0.0
    # curvature of -2 log L
    low = max(phi - _STEP, 0.0)
    points = np.array([low, low + _STEP, low + 2 * _STEP])
    values = [deviance(float(p)) for p in points]
    curvature = (values[0] - 2 * values[1] + values[2]) / _STEP**2
    n = max(int(white.linear.used.any(axis=1).sum()), 1)
    u_phi = float(np.sqrt(2.0 / max(curvature, 1e-3 * n)))
    return Correlated(
        phi=phi,
        u_phi=u_phi,
        independent=_independent(problem, order, series, phi),
        gain=max(deviance(0.0) - deviance(phi) + float(np.arctanh(phi) / typical) ** 2, 0.0),
        _fitted=lambda its: fit(autoregressive(problem, order, its, series), start=at),
    )


def _linear(problem: Problem, at: Unknown) -> Problem:
    """Return a problem with its derivatives at some values, which are computed once for all correlations."""
    if problem.derivatives is not None:
        return problem
    names = [*problem.unknowns._fields, *getattr(problem.constants, "_fields", ())]
    values = [*at.tables, *problem.constant_tables(at)]
    derivative_arrays = by_rows(
        lambda rows: problem.evaluate(problem.y, rows), problem.tables, values, range(len(names)), weighed=False
    )
    derivatives = dict(zip(names, derivative_arrays, strict=True))
    return replace(problem, derivatives=lambda *_: derivatives)


def autoregressive(problem: Problem, order: Array, phi: float, series: Index | None = None) -> Problem:
    """Return the problem of the differences of neighbours, whose noise is white.

    Parameters
    ----------
    problem : Problem
        With ``sd`` of its noise.
    order, series
        See `correlated`.
    phi : float
        Correlation of neighbours, 0 to 1.

    Returns
    -------
    Problem
        With the same unknowns and constants. Its readings are (n, 2 r): each with the one before. Readings of several
        numbers are used if all of them are known. Outliers are to be excluded before, since each appears twice.

    Raises
    ------
    FitError
        Readings of one series with the same order; a noise by ``root``.
    """
    if problem.noise.sd is None:
        raise FitError(
            "correlated noise: expected standard deviations of the readings (sd); found a root",
            code="estimation.noise.root",
        )
    chain = _Chain.of(problem, order, series)
    y = column(problem.readings)
    n, r = y.shape
    sd = np.asarray(problem.noise.sd, dtype=float)
    sd = np.array(np.broadcast_to(sd[:, None] if sd.ndim == 1 else sd, y.shape))
    power = np.where(chain.first, 0.0, float(phi) ** chain.distance) if phi > 0 else np.zeros(n)
    # e_t / sd_t - phi e_(t-1) / sd_(t-1), in the unit of e_t
    m = column(problem.equation(problem.y, *_rows(problem))).shape[1]
    ratio = sd / sd[chain.before] if m == r else np.ones((n, m))
    coefficient = power[:, None] * ratio
    scaled = sd * np.sqrt(1 - power**2)[:, None]
    tables = [chain.table(table) for table in problem.tables]
    count = len(problem.unknowns)

    def equation(y2: Array, x: Any, c: Any) -> Array:
        rows = [*x, *c]
        now = [chain.split(table, row, 0) for table, row in zip(problem.tables, rows, strict=True)]
        then = [chain.split(table, row, 1) for table, row in zip(problem.tables, rows, strict=True)]
        shape = problem.readings.shape
        its = column(problem.evaluate(y2[:, :r].reshape(shape), now))
        earlier = chain.scattered(y2[:, r:], y2[:, :r])
        last = column(problem.evaluate(earlier.reshape(shape), then))[chain.before]
        return np.asarray(its - coefficient * last)

    def derivatives(y2: Array, x: Any, c: Any) -> Mapping[str, Array]:
        rows = [chain.split(table, row, 0) for table, row in zip(problem.tables, [*x, *c], strict=True)]
        given = problem.derivatives
        if given is None:
            return {}
        by_name = {}
        named = problem.named(rows[:count], rows[count:])
        names = [*problem.unknowns._fields, *getattr(problem.constants, "_fields", ())]
        its_table = dict(zip(names, problem.tables, strict=True))
        for name, J in given(y2[:, :r].reshape(problem.readings.shape), *named).items():
            if name not in its_table:  # those by the readings
                continue
            weight = its_table[name].weight
            whole = J[:, :, None, :] if J.ndim == 3 else J
            whole = whole if weight is None else whole * weight[:, None, :, None]
            by_name[name] = np.concatenate([whole, -coefficient[:, :, None, None] * whole[chain.before]], axis=2)
        return by_name

    unknowns, constants = problem.named(tables[:count], tables[count:])  # type: ignore[arg-type]
    return replace(
        problem,
        equation=equation,
        readings=np.concatenate([y, y[chain.before]], axis=1),
        unknowns=unknowns,
        constants=constants,
        noise=Noise(sd=np.concatenate([scaled, np.zeros_like(scaled)], axis=1), stated=problem.noise.stated),
        reading_scale=np.tile(np.broadcast_to(np.asarray(problem.reading_scale, dtype=float), (r,)), 2),
        derivatives=None if problem.derivatives is None else derivatives,
    )


def coloured(z: Array, used: NDArray[np.bool_], order: Array, phi: float, series: Index | None = None) -> Array:
    """Return numbers that are correlated along an order from independent ones, (n, r).

    ``e_t = phi e_(t-1) + sqrt(1 - phi^2) z_t``; see `correlated`.
    """
    chain = _Chain.between(used, order, series)
    power = np.where(chain.first, 0.0, phi**chain.distance)[:, None]
    step = np.sqrt(1 - np.square(power)) * z
    noise = step.copy()
    at = np.flatnonzero(chain.first)
    while (at := chain.after[at][chain.after[at] >= 0]).size:  # one reading of each series at a time
        noise[at] = power[at] * noise[chain.before[at]] + step[at]
    return np.asarray(noise)


def with_trend(
    problem: Problem, order: Array, series: Index | None = None, *, name: str = "trend", group: str = "trend"
) -> Problem:
    """Return the problem with a linear trend of the residuals along an order, which is always estimated.

    A trend that is added only if it is significant leaves those that are not, and intervals that are too short; one
    that is always estimated makes them wider where the model is not orthogonal to it.

    Parameters
    ----------
    problem : Problem
    order : ndarray, (n,)
    series : ndarray of int, (n,), optional
        Each series has a trend of its own, about its mean; without, all have one.

    Returns
    -------
    Problem
        The unknown ``name`` is (series, m): the change over the range of the order of all readings.
    """
    which = np.zeros(len(order), dtype=np.intp) if series is None else series
    used = np.isfinite(column(problem.readings)).any(axis=1)
    count = np.maximum(np.bincount(which[used], minlength=int(which.max(initial=0)) + 1), 1)
    mean = np.bincount(which[used], weights=order[used], minlength=count.size) / count
    extent = float(np.ptp(order[used])) if used.any() else 0.0
    if not extent > 0:
        raise FitError(
            "expected readings at several instants for a trend; found one", code="estimation.trend.one_instant"
        )
    m = column(problem.equation(problem.y, *_rows(problem))).shape[1]
    design = ((order - mean[which]) / extent)[:, None, None] * np.eye(m)
    return with_linear(problem, name, design, index=which, group=group)


def lag_one(white: Fit, order: Array, series: Index | None = None) -> float:
    """Return the correlation of normalised residuals with their neighbours along an order; about 0 for white noise.

    ``sum (r_t r_(t-1)) / sum r^2``; the fit makes it smaller by about ``(unknowns + 1) / n``.
    """
    chain = _Chain.of(white.problem, order, series)
    r = np.where(white.linear.used, white.linear.residual, 0.0)
    follows = ~chain.first
    pairs = float(np.sum(r[follows] * r[chain.before[follows]]))
    return pairs / max(float(np.vdot(r, r)), 1e-300) * len(r) / max(int(follows.sum()), 1)


def effective_number(n: int, phi: float) -> float:
    """Return the number of independent readings with as much information on a mean as n with an AR(1) noise.

    ``1' R^-1 1 = (n - (n - 2) phi) / (1 + phi)``, with the correlation matrix R.
    """
    return (n - (n - 2) * phi) / (1 + phi) if n > 0 else 0.0


def _deviance(problem: Problem, at: Unknown, order: Array, series: Index | None, phi: float) -> float:
    """Return -2 log L of a correlation, with all unknowns and an unknown noise eliminated."""
    linear = linearised(autoregressive(problem, order, phi, series), at)
    normal, a, b = linear.normal()
    x, z = normal.solve(a[..., None], b[..., None])
    square = linear.chi2 + linear.prior_square() - float(np.vdot(a, x[..., 0])) - float(b @ z[:, 0])
    roots = np.diagonal(linear.whitener, axis1=1, axis2=2)[linear.used]
    determinants = -2 * float(np.log(roots).sum()) + normal.log_determinant
    if problem.noise.stated:
        return determinants + square
    freedom = int(linear.used.sum()) - sum(int(block.freed.sum()) for block in problem.unknowns)
    return determinants + max(freedom, 1) * float(np.log(max(square, 1e-300)))


def _independent(problem: Problem, order: Array, series: Index | None, phi: float) -> float:
    """Return the effective number of readings of all series."""
    chain = _Chain.of(problem, order, series)
    power = np.where(chain.first, 0.0, phi**chain.distance) if phi > 0 else np.zeros(len(order))
    # 1' R^-1 1 with the whitened ones (1 - phi) / sqrt(1 - phi^2)
    return float(np.sum(((1 - power) / (1 + power))[chain.used]))


def _rows(problem: Problem) -> tuple[Any, Any]:
    """Return the rows of all tables at the start, as the equation receives them."""
    values = [*problem.start.tables, *problem.constant_tables(problem.start)]
    rows = [table.rows(value) for table, value in zip(problem.tables, values, strict=True)]
    count = len(problem.unknowns)
    return problem.named(rows[:count], rows[count:])


@dataclass(frozen=True, eq=False)
class _Chain:
    """Neighbours along an order.

    Attributes
    ----------
    before : ndarray of int, (n,)
        The reading before each; itself for the first one.
    first, used : ndarray of bool, (n,)
    after : ndarray of int, (n,)
        The reading after each; -1 for the last one.
    distance : ndarray, (n,)
        From the one before, in median steps.
    """

    before: Index
    first: NDArray[np.bool_]
    used: NDArray[np.bool_]
    after: Index
    distance: Array

    @classmethod
    def of(cls, problem: Problem, order: Array, series: Index | None) -> _Chain:
        """Return the neighbours among the readings of a problem that are all known."""
        return cls.between(np.all(np.isfinite(column(problem.readings)), axis=1), order, series)

    @classmethod
    def between(cls, used: NDArray[np.bool_], order: Array, series: Index | None) -> _Chain:
        """Return the neighbours among the readings that are used, (n,)."""
        n = len(used)
        which = np.zeros(n, dtype=np.intp) if series is None else np.asarray(series)
        ranked = np.lexsort((order, which))
        ranked = ranked[used[ranked]]
        before, after = np.arange(n), np.full(n, -1, dtype=np.intp)
        pairs = which[ranked[1:]] == which[ranked[:-1]]
        late, early = ranked[1:][pairs], ranked[:-1][pairs]
        before[late], after[early] = early, late
        distance = np.ones(n)
        steps = np.asarray(order, dtype=float)[late] - np.asarray(order, dtype=float)[early]
        if steps.size:
            if steps.min() <= 0:
                raise FitError(
                    "expected different orders within a series; state the series of simultaneous readings",
                    code="estimation.series.order",
                )
            distance[late] = steps / np.median(steps)
        return cls(before, np.asarray(before == np.arange(n)), used, after, distance)

    def table(self, table: AnyTable) -> AnyTable:
        """Return the table of which each reading sees its rows and those of the reading before."""
        index = table.index2
        return replace(table, index=np.concatenate([index, index[self.before]], axis=1), weight=None)

    def split(self, table: Table, rows: Array, part: int) -> Array:
        """Return the rows of each reading as the equation needs them: its own (0), or as the next one sees them (1)."""
        w = table.slots
        seen = rows[:, :w] if part == 0 else self.scattered(rows[:, w:], rows[:, :w])
        if table.index.ndim == 1:
            return seen[:, 0]
        return seen if table.weight is None else np.asarray(np.einsum("nw,nwk->nk", table.weight, seen))

    def scattered(self, earlier: Array, now: Array) -> Array:
        """Return what each reading's successor has as the values before it; its own where there is none."""
        has = self.after >= 0
        values = now.copy()
        values[has] = earlier[self.after[has]]
        return values
