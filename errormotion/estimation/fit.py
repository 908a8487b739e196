"""Nonlinear generalised least squares with priors: Gauss-Newton on a problem stated by its equation.

The objective is ``Q = r' V^-1 r + sum ((x - x0) / sd)^2`` over readings and priors. Each step solves the normal
equations of the linearised problem and is halved until Q decreases. The iteration ends by the Newton decrement
``g' step``, the decrease of Q that the next step promises, and not by the size of the step: it has no unit. A decrement
that rounding of the numbers in the residuals explains ends it as well: with many or precise readings it is larger.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.estimation.linear.normal import Normal, SingularError
from errormotion.estimation.linear.numbering import Numbering
from errormotion.estimation.linear.system import Linear, linearised, white_of
from errormotion.estimation.problem import Problem, Unknown

__all__ = ["Fit", "fit"]

DECREMENT = 1e-14
"""Newton decrement that ends the iteration, in units of the variance factor: 1e-7 standard uncertainties.

The step after it is made as well, so that the remaining error is far smaller.
"""
STALLED = 1e-10
"""Newton decrement below which a step that gains no further digit is due to rounding."""
MAX_ITERATIONS = 50
HALVINGS = 20
ROUNDING = 1e-12
"""Increase of Q, relative to Q, that is regarded as rounding."""
_ROWS = 4096


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted problem. Covariances are for the noise in the problem.

    Attributes
    ----------
    linear : Linear
        The problem, linearised at the solution.
    normal : Normal
        Its factorised normal equations.
    """

    linear: Linear
    normal: Normal

    @property
    def problem(self) -> Problem:
        """The problem that was fitted."""
        return self.linear.problem

    @property
    def unknowns(self) -> Any:
        """The tables (size, width) of all unknowns, as a named tuple."""
        return type(self.problem.unknowns)(*self.linear.at.tables)

    @property
    def constants(self) -> Any:
        """The tables of all constants, the adjusted ones at their new values."""
        tables = self.problem.constant_tables(self.linear.at)
        return type(self.problem.constants)(*tables) if tables else ()

    @property
    def residual(self) -> Array:
        """Residuals of the equation, (n, m); NaN where missing."""
        return self.problem.residuals(self.linear.at)

    @property
    def chi2(self) -> float:
        """Q: weighted sum of squares of the readings and priors."""
        return self.linear.chi2 + self.linear.prior_square()

    @cached_property
    def freedom(self) -> int:
        """Degrees of freedom: used numbers, plus priors, minus unknowns, plus the freedoms of the gauge."""
        priors = unknowns = 0
        for block in self.problem.unknowns:
            priors += int(np.count_nonzero(block.information[block.freed]))
            unknowns += int(block.freed.sum())
        gauge = self.problem.gauge
        free = len(next(iter(gauge.values()))) if gauge else 0
        return int(self.linear.used.sum()) + priors - unknowns + free

    @cached_property
    def constant_derivatives(self) -> Mapping[str, Array]:
        """The stated derivatives of the residuals by constants that are not adjusted, by name."""
        problem, at = self.problem, self.linear.at
        if problem.constant_derivatives is None:
            return {}
        values = [*at.tables, *problem.constant_tables(at)]
        rows = [table.rows(value) for table, value in zip(problem.tables, values, strict=True)]
        return problem.constant_derivatives(
            problem.y, *problem.named(rows[: len(problem.unknowns)], rows[len(problem.unknowns) :])
        )

    @property
    def leverage(self) -> Array:
        """Diagonal of the hat matrix of the whitened numbers, (n, m): 1 minus the redundancy of each.

        A chain without border couples neighbours; its leverage is that of all rows together.
        """
        return np.diagonal(self.hat, axis1=1, axis2=2)

    @cached_property
    def hat(self) -> Array:
        """Hat matrix ``J C J'`` of the whitened numbers of each reading, (n, m, m)."""
        linear, normal = self.linear, self.normal
        n, m = linear.used.shape
        hat = np.zeros((n, m, m))
        # J C J' = J_L own J_L' + E E' with E = (J_B - J_L F) root
        shared = normal.shared
        for first in range(0, n, _ROWS):
            rows = np.arange(first, min(first + _ROWS, n))
            E = linear.effect(shared, normal.root, rows)
            hat[rows] = E @ np.swapaxes(E, 1, 2)
        if linear.numbering.local is not None:
            hat += self._local_hat()
        return hat

    def _local_hat(self) -> Array:
        linear, groups = self.linear, self.linear.numbering.of_local
        rows, A = linear.numbering.rows[groups.first], linear.local_matrix
        w, p = linear.local.shape[2:]
        C = np.empty((len(rows), w, p, w, p))
        for i in range(w):
            for j in range(w):
                C[:, i, :, j] = self.normal.local_covariance(rows[:, i], rows[:, j])
        AC = groups.spread(groups.each(A) @ C.reshape(-1, w * p, w * p), A.shape[1])
        return np.asarray(AC @ np.swapaxes(A, 1, 2))


def fit(
    problem: Problem,
    *,
    refresh: Callable[[Problem, Any], Problem] | None = None,
    what: str = "the readings",
    start: Unknown | None = None,
    numbering: Numbering | None = None,
) -> Fit:
    """Return the unknowns that minimise the weighted sum of squares.

    Parameters
    ----------
    problem : Problem
    refresh : callable, optional
        From the problem and the unknowns after a step (a named tuple of tables) to the problem of the next step, whose
        frozen quantities (normals, centres, weights) follow the unknowns.
    what : str
        What the readings are, for messages.
    start : Unknown, optional
        Where the iteration starts, such as the solution of a similar problem (``Fit.linear.at``).
    numbering : Numbering, optional
        Of a problem with the same index maps and estimated unknowns (``Fit.linear.numbering``).

    Raises
    ------
    FitError
        The readings do not determine the unknowns, which are named; or the iteration has not converged.
    """
    number = Numbering.of(problem) if numbering is None else numbering
    at = problem.start if start is None else start
    last = before = np.inf
    linear: Linear | None = None
    for _ in range(MAX_ITERATIONS):
        if linear is None or not problem.linear or refresh is not None:
            linear = linearised(problem, at, number)
            normal = _factorised(linear, what)
        unit = _unit(linear)
        step, decrement = _step(linear, normal)
        linear = _descended(linear, step)
        if problem.settled is not None:  # along the gauge, which changes no residual
            its = list(problem.settled(problem, type(problem.unknowns)(*linear.at.tables)))
            linear = replace(linear, at=replace(linear.at, tables=its))
        at = linear.at
        if refresh is not None:
            problem = refresh(problem, type(problem.unknowns)(*at.tables))
        # The next decrement, if it decreases as slowly as before
        expected = decrement * max(decrement / last, last / before) if np.isfinite(before) else decrement
        if min(decrement, expected) <= max(DECREMENT * unit, linear.rounding):
            break
        if decrement > 0.1 * last and decrement <= STALLED * unit:
            break
        last, before = decrement, last
    else:
        raise FitError(
            f"the fit to {what} has not converged after {MAX_ITERATIONS} iterations (the next step would still "
            f"decrease the sum of squares by {decrement:.2g}). Check units and the order of the readings",
            code="estimation.not_converged",
        )
    # The derivatives before the last step are those at the solution: it was far below the noise.
    if refresh is not None:
        linear = replace(linear, problem=problem)
        linear = replace(linear, residual=_whitened(linear))
    return Fit(linear, normal)


def _factorised(linear: Linear, what: str) -> Normal:
    """Return the factorised normal equations."""
    try:
        return linear.factorised()
    except SingularError as error:
        raise _undetermined(linear, error, what) from error


def _step(linear: Linear, normal: Normal) -> tuple[tuple[Array, Array], float]:
    """Return the step (R, p), (q,), and the Newton decrement."""
    a, b = linear.downhill()
    x, z = normal.solve(a[..., None], b[..., None])
    return (x[..., 0], z[:, 0]), float(np.vdot(a, x[..., 0]) + b @ z[:, 0])


def _descended(linear: Linear, step: tuple[Array, Array]) -> Linear:
    """Return the residuals after the step, or after the largest half of it that does not increase the sum."""
    before = linear.chi2 + linear.prior_square()
    # Residuals r with errors d of rounding have the sum r'r + 2 r'd.
    most = before * (1 + ROUNDING) + ROUNDING + 2 * np.sqrt(before * linear.rounding)
    fraction = 1.0
    for _ in range(HALVINGS):
        moved = replace(linear, at=linear.moved(fraction * step[0], fraction * step[1]))
        moved = replace(moved, residual=_whitened(moved))
        if moved.chi2 + moved.prior_square() <= most:  # False for NaN
            return moved
        fraction /= 2
    return moved


def _whitened(linear: Linear) -> Array:
    """Return the residuals in units of their noise, (n, m); 0 where missing."""
    raw = np.where(linear.used, linear.problem.residuals(linear.at), 0.0)
    return white_of(linear.whitener, raw)


def _unit(linear: Linear) -> float:
    """Return the variance factor of the readings, at least that of the rounding of their numbers.

    Readings that contradict a stated noise cannot be fitted to a fraction of it: their second derivatives, which the
    steps neglect, are multiplied by the residuals.
    """
    used = max(int(linear.used.sum()), 1)
    least = 1.0 if linear.problem.noise.stated else 0.0
    return max(least, linear.chi2 / used, linear.rounding / used)


def _undetermined(linear: Linear, error: SingularError, what: str) -> FitError:
    """Return the error that names the unknowns which the readings do not determine."""
    problem, number = linear.problem, linear.numbering
    names = []
    if error.rows.size and number.local is not None:
        name = problem.unknowns._fields[number.local]
        some = ", ".join(str(row + 1) for row in error.rows[:5]) + (", ..." if error.rows.size > 5 else "")
        names.append(f"{name} {some}")
    for name, border in zip(problem.unknowns._fields, number.border, strict=True):
        if border.size and np.isin(border, error.columns).any():
            rows = np.flatnonzero(np.isin(border, error.columns).any(axis=1))
            some = ", ".join(str(row + 1) for row in rows[:5]) + (", ..." if rows.size > 5 else "")
            names.append(f"{name} {some}")
    return FitError(
        f"{what} do not determine {' and '.join(names) or 'all unknowns'}. Measure more, or elsewhere",
        code="estimation.undetermined",
    )
