"""The fewest sources with the same covariance, without rounding."""

from __future__ import annotations

import numpy as np
import pytest

from errormotion.arrays import Array
from errormotion.estimation.datum import Relative
from errormotion.estimation.fewest import NEGLIGIBLE, ROUNDING, fewest
from errormotion.estimation.sources import Errors, Source


def relative(effects: Array, of_h: Array, *, joined: str = "", own: float = 0.0) -> Relative:
    """Return errors with these effects (source, place, d) and (source, g)."""
    places, d = effects.shape[1:]
    sources = [Source(f"draw {k + 1}", "drift", each, joined=joined) for k, each in enumerate(effects)]
    errors = Errors(np.zeros((places, d)), np.tile(own * np.eye(d), (places, 1, 1)), sources)
    return Relative(errors, np.zeros(of_h.shape[1]), of_h.T @ of_h, of_h)


def whole(found: Relative) -> Array:
    """Return the covariance of all errors and coefficients by the sources."""
    flat = found.errors.influence.reshape(len(found.influence), -1)
    both = np.concatenate([flat, found.influence], axis=1)
    return np.asarray(both.T @ both)


@pytest.mark.parametrize("places", [3, 40])
def test_draws_that_nobody_names_are_joined_without_a_change_of_any_covariance(places: int) -> None:
    """30 runs act on a line in two ways only, and on its slope."""
    rng = np.random.default_rng(1)
    z = np.linspace(-1.0, 1.0, places)
    amount = rng.standard_normal((30, 2)) * [3e-6, 1e-6]
    effects = np.einsum("sk,kp->sp", amount, np.stack([np.ones(places), z]))[:, :, None]
    given = relative(effects, amount[:, 1:], joined="offset of the runs")
    found = fewest(given)
    assert [source.name for source in found.errors.sources] == ["offset of the runs", "offset of the runs 2"]
    assert whole(found) == pytest.approx(whole(given), rel=1e-9, abs=1e-22)
    assert found.errors.covariance == pytest.approx(given.errors.covariance, rel=1e-12)


def test_a_source_with_a_name_of_its_own_is_not_joined() -> None:
    effects = np.ones((3, 4, 1)) * [[[1.0]], [[2.0]], [[3.0]]]
    found = fewest(relative(effects, np.zeros((3, 0))))
    assert [float(source.effect[0, 0]) for source in found.errors.sources] == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(("size", "kept"), [(0.1 * NEGLIGIBLE, False), (10 * NEGLIGIBLE, True)])
def test_what_is_below_rounding_is_dropped_and_nothing_else(size: float, kept: bool) -> None:
    """A source may matter at one of many places, in one freedom: it is compared with the uncertainty there."""
    effects = np.zeros((1, 1000, 2))
    effects[0, 637, 1] = size
    found = fewest(relative(effects, np.zeros((1, 0)), own=1.0))
    assert len(found.errors.sources) == kept


def test_an_effect_is_exactly_0_where_it_is_rounding() -> None:
    effects = np.array([[[1.0], [0.1 * ROUNDING], [-0.1 * ROUNDING], [10 * ROUNDING]]])
    [source] = fewest(relative(effects, np.zeros((1, 0)), own=1.0)).errors.sources
    assert source.effect[:, 0].tolist() == [1.0, 0.0, 0.0, 10 * ROUNDING]


def test_a_source_of_the_coefficients_alone_is_kept() -> None:
    found = fewest(relative(np.zeros((2, 5, 1)), np.array([[2e-6], [0.0]]), own=1.0))
    assert [source.name for source in found.errors.sources] == ["draw 1"]
    assert found.influence == pytest.approx(np.array([[2e-6]]))


def test_unknown_values_stay_unknown() -> None:
    effects = np.ones((9, 4, 1))
    effects[:, 2] = np.nan
    found = fewest(relative(effects, np.zeros((9, 0)), joined="noise"))
    [one] = found.errors.sources
    assert np.isnan(one.effect[2, 0])
    assert np.abs(one.effect[[0, 1, 3], 0]) == pytest.approx(np.full(3, 3.0))
