from __future__ import annotations

from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import pytest
from scipy import stats

from errormotion.arrays import Array
from errormotion.estimation.blocks import Block, Noise
from errormotion.estimation.checks.exclusions import FALSE_ALARM, cleaned
from errormotion.estimation.checks.reliability import MASKED, POWER, non_centrality, reliability
from errormotion.estimation.fit import Fit, fit
from errormotion.estimation.problem import Problem

T = TypeVar("T")


class Line(NamedTuple, Generic[T]):
    line: T


def line(x: Array, y: Array, *, sd: float = 1.0, stated: bool = True) -> Problem:
    def equation(y: Array, u: Line[Array], c: Any) -> Array:
        return np.asarray(y - u.line[:, 0] - u.line[:, 1] * x)

    block = Block(start=np.zeros((1, 2)), index=np.zeros(x.size, dtype=int), scale=1.0, group="line")
    return Problem(
        equation=equation, readings=y, unknowns=Line(block), noise=Noise(sd=np.full(x.size, sd), stated=stated)
    )


def functions(found: Fit, *rows: list[float]) -> tuple[Array, Array]:
    return np.zeros((0, 1, len(rows))), np.array(rows).T


def test_redundancy_smallest_error_and_effect_have_the_closed_form() -> None:
    x = np.array([0.0, 1, 2, 3, 4, 12])
    X = np.stack([np.ones(6), x], axis=1)
    C = np.linalg.inv(X.T @ X) * 0.04
    h = np.einsum("ni,ij,nj->n", X, C, X) / 0.04
    found = fit(line(x, 0.2 * np.random.default_rng(0).standard_normal(6), sd=0.2))
    its = reliability(found, functions(found, [1, 0], [0, 1]))
    assert its.redundancy[:, 0] == pytest.approx(1 - h, rel=1e-8)
    delta = stats.norm.isf(FALSE_ALARM / 12) + stats.norm.ppf(POWER)
    smallest = 0.2 * delta / np.sqrt(1 - h)
    assert its.smallest[:, 0] == pytest.approx(smallest, rel=1e-8)
    assert its.effect[:, 0] == pytest.approx(smallest[:, None] * (X @ C) / 0.04, rel=1e-7)
    assert its.bias[:, 0] == pytest.approx(delta * np.sqrt(h / (1 - h)), rel=1e-7)
    # the bias is the largest effect on any function, in its standard uncertainties
    direction = C @ X.T
    of = np.abs(smallest * np.einsum("in,ij,jn->n", direction, np.linalg.inv(C), direction) / 0.04)
    own = of / np.sqrt(np.einsum("in,ij,jn->n", direction, np.linalg.inv(C), direction))
    assert its.bias[:, 0] == pytest.approx(own, rel=1e-6)
    assert its.worst[1][0] == (5, 0)


@pytest.mark.parametrize("stated", [True, False])
def test_the_smallest_error_is_found_with_the_stated_power(stated: bool) -> None:
    rng = np.random.default_rng(1)
    x = np.linspace(0, 1, 16)
    its = reliability(fit(line(x, rng.standard_normal(16), stated=stated)))
    found = 0
    for _ in range(150):
        y = rng.standard_normal(16)
        y[4] += its.smallest[4, 0]
        found += bool(cleaned(line(x, y, stated=stated)).excluded[4])
    assert stats.binom.cdf(found, 150, POWER) > 0.005
    assert stats.binom.sf(found - 1, 150, POWER) > 0.005


def test_the_effect_is_that_of_a_changed_reading() -> None:
    x = np.linspace(0, 1, 8)
    y = np.random.default_rng(2).standard_normal(8)
    found = fit(line(x, y))
    its = reliability(found, functions(found, [1, 0.5]))
    y = y.copy()
    y[2] += its.smallest[2, 0]
    moved = fit(line(x, y)).unknowns.line[0] - found.unknowns.line[0]
    assert its.effect[2, 0, 0] == pytest.approx(moved @ [1, 0.5], rel=1e-7)


def test_a_reading_that_nothing_checks_has_no_smallest_error() -> None:
    x = np.array([0.0, 0, 0, 1])
    found = fit(line(x, np.zeros(4)))
    its = reliability(found, functions(found, [1, 0], [0, 1]))
    assert np.isinf(its.smallest[3, 0])
    assert its.redundancy[3, 0] == pytest.approx(0, abs=1e-9)
    assert its.effect[3, 0, 1] == np.inf
    assert its.effect[3, 0, 0] == 0  # the level at 0 does not depend on it


def test_readings_that_mask_one_another_are_named() -> None:
    """Two distant readings determine the slope: their errors differ in the sign of the slope only."""
    x = np.concatenate([np.linspace(0, 1, 8), [60, 60.0]])
    found = fit(line(x, np.random.default_rng(3).standard_normal(10)))
    its = reliability(found)
    assert [pair[:2] for pair in its.masked] == [((8, 0), (9, 0))]
    X = np.stack([np.ones(10), x], axis=1)
    M = np.eye(10) - X @ np.linalg.pinv(X)
    assert its.masked[0][2] == pytest.approx(M[8, 9] / np.sqrt(M[8, 8] * M[9, 9]), rel=1e-7)
    assert abs(its.masked[0][2]) > MASKED
    assert its.complete


def test_the_non_centrality_of_many_degrees_is_that_of_the_normal_distribution() -> None:
    assert non_centrality(1e-5, 0.8) == pytest.approx(stats.norm.isf(5e-6) + stats.norm.ppf(0.8))
    assert non_centrality(1e-5, 0.8, 999) == pytest.approx(non_centrality(1e-5, 0.8), rel=0.02)
    d = non_centrality(1e-4, 0.8, 7)
    assert stats.nct.sf(stats.t.isf(5e-5, 7), 7, d) == pytest.approx(0.8, abs=1e-3)
    assert np.isinf(non_centrality(1e-4, 0.8, 0))
