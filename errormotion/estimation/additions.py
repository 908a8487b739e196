"""Unknowns added to a problem by their derivatives: a trend, a shift, an effect that the model does not contain."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.estimation.blocks import Block, Index
from errormotion.estimation.problem import Problem

__all__ = ["with_linear"]


def with_linear(
    problem: Problem,
    name: str,
    design: Array,
    *,
    index: Index | None = None,
    prior: float | Array | None = None,
    component: Sequence[str] = (),
    group: str = "",
) -> Problem:
    """Return a problem with one more table of unknowns, which explain ``design`` times their rows of the residuals.

    Parameters
    ----------
    problem : Problem
    name : str
        Of the table among the unknowns.
    design : ndarray, (n, k) or (n, m, k)
        Effect of the k unknowns that each reading sees on a residual: the new one is the old one minus the effect.
        (n, k) for one residual a reading.
    index : ndarray of int, (n,), optional
        The row of the table that each reading sees. Default: one row for all.
    prior, component, group
        See `Block`.

    Raises
    ------
    FitError
        The problem has unknowns of this name.
    """
    base = type(problem.unknowns)
    fields = problem.unknowns._fields
    if name in fields:
        raise FitError(f"expected a new name; the unknowns '{name}' exist", code="estimation.unknown.name_used")
    J = design[:, None, :] if design.ndim == 2 else design
    rows = np.zeros(len(J), dtype=np.intp) if index is None else index
    size = int(rows.max(initial=0)) + 1
    block = Block(
        start=np.zeros((size, J.shape[2])), index=rows, scale=1.0, prior=prior, component=component, group=group or name
    )
    given = problem.derivatives

    def equation(y: Array, x: Any, c: Any) -> Array:
        residual = problem.equation(y, base(*x[:-1]), c)
        added = np.einsum("nmk,nk->nm", J, x[-1])
        return np.asarray(residual - (added[:, 0] if residual.ndim == 1 else added))

    def derivatives(y: Array, x: Any, c: Any) -> Mapping[str, Array]:
        others = {} if given is None else given(y, base(*x[:-1]), c)
        return {**others, name: -J}

    more = cast("Any", namedtuple("Extended", [*fields, name]))
    return replace(problem, equation=equation, derivatives=derivatives, unknowns=more(*problem.unknowns, block))
