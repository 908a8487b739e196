"""The estimator of a method, stated by its equation alone, against the method's own solver."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import pytest

from errormotion.arrays import Array
from errormotion.estimation.blocks import Block, Noise
from errormotion.estimation.checks.candidates import steps
from errormotion.estimation.checks.exclusions import cleaned
from errormotion.estimation.fit import fit
from errormotion.estimation.problem import Problem
from errormotion.estimation.sources import Places, errors_of
from errormotion.methods.normal_vector.identification import moved, rigid
from errormotion.methods.normal_vector.identification.identify import fitted
from errormotion.methods.normal_vector.identification.reading import read
from errormotion.methods.normal_vector.settings import Settings
from errormotion.methods.normal_vector.simulation import simulate

T = TypeVar("T")


class Unknowns(NamedTuple, Generic[T]):
    twist: T
    reach: T


def model(seen: rigid.Observations, motion: Any, interpolate: bool) -> tuple[Problem, Any]:
    """Return the touches as a problem: |p + e(p, t) - b| = reach, with the twist between the cycles by three knots."""
    k, b, m = seen.valid.shape
    time = rigid.mean_time(seen) if interpolate else seen.cycle_time
    weight = rigid.knot_weights(time, seen.time, interpolate).reshape(-1, 3)
    cycle, ball, touch = (each.ravel() for each in np.meshgrid(*(np.arange(s) for s in (k, b, m)), indexing="ij"))
    knots = np.clip(cycle[:, None] + np.array([-1, 0, 1]), 0, k - 1)
    position = np.where(seen.valid[..., None], seen.position, np.nan).reshape(-1, 3)

    def with_centres(centre: Array) -> Problem:
        def equation(p: Array, x: Unknowns[Array], _: Any) -> Array:
            twist = np.zeros((len(p), 6))
            twist[:, list(motion.seen)] = x.twist
            true = p + motion.error(twist, motion.lever(p))
            return np.asarray(np.linalg.norm(true - centre[ball], axis=1) - x.reach[:, 0])

        width = len(motion.seen)
        unknowns = Unknowns(
            Block(
                start=np.zeros((k, width)), index=knots, weight=weight, scale=1.0, free=np.arange(k) > 0,
            ),
            Block(start=np.full((b * m, 1), 0.02), index=ball * m + touch, scale=0.01, group="cold reference"),
        )  # fmt: skip
        noise = 1.0 / np.sqrt(np.where(seen.valid, np.diagonal(seen.weight, axis1=2, axis2=3), 1.0))
        return Problem(
            equation=equation, readings=position, unknowns=unknowns, reading_scale=0.01,
            noise=Noise(sd=np.repeat(noise.reshape(-1, 1), 3, axis=1)),
        )  # fmt: skip

    centres = [seen.spheres[0]]

    def refresh(_: Problem, x: Unknowns[Array]) -> Problem:
        twist = np.zeros((k, 6))
        twist[:, list(motion.seen)] = x.twist
        at = rigid.at_times(weight.reshape(k, b, m, 3), twist)
        true = seen.position + motion.error(at, motion.lever(seen.position))
        centres.append(rigid._spheres(true, seen.valid, centres[-1])[0])
        return with_centres(centres[-1])

    return with_centres(centres[0]), refresh


@pytest.mark.parametrize(("tool_axes", "interpolate"), [("Z", True), ("XYZ", False)])
def test_touches_of_balls(tool_axes: Any, interpolate: bool) -> None:
    settings = Settings(tool_axes=tool_axes, duration=3600.0, robust=False, interpolate=interpolate)
    raw, _ = simulate(settings, 3)
    data, motion, _ = fitted(read(raw, settings, []), settings)
    expected = rigid.fit(data.seen, motion, interpolate=interpolate)
    problem, refresh = model(data.seen, motion, interpolate)
    found = fit(problem, refresh=refresh)
    seen = list(motion.seen)
    u = np.sqrt(np.diagonal(expected.covariance, axis1=1, axis2=2))[:, seen]
    off = np.abs(found.unknowns.twist - expected.twist[:, seen])[1:] / u[1:]
    errors = errors_of(found, Places(lambda x, c: x.twist, len(u)), shared="cold reference")
    ratio = np.sqrt(np.diagonal(errors.covariance, axis1=1, axis2=2))[1:] / u[1:]
    assert off.max() < 1e-5
    assert np.abs(ratio - 1).max() < 1e-5
    assert found.chi2 == pytest.approx(expected.chi2, rel=1e-7)
    assert found.freedom == expected.freedom


@pytest.mark.parametrize(("shift", "outliers"), [(0.0, 0), (2e-6, 0), (0.0, 2), (5e-6, 1)])
def test_outliers_and_balls_that_moved_are_those_of_the_method(shift: float, outliers: int) -> None:
    """A ball shifted from the middle on, and touches wrong by 12 standard deviations of their noise."""
    settings = Settings(duration=3600.0, robust=False, interpolate=False)
    raw, _ = simulate(settings, 3)
    data, motion, _ = fitted(read(raw, settings, []), settings)
    k, b, m = data.seen.valid.shape
    rng = np.random.default_rng(outliers)
    position = data.seen.position.copy()
    normal = position - data.seen.spheres[0][:, None]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    position[k // 2 :, 2] += shift / np.sqrt(3)
    for _ in range(outliers):
        at = (rng.integers(k), rng.integers(b - 1), rng.integers(m))
        position[at] += 12 * normal[at] / np.sqrt(data.seen.weight[(*at, at[2])])
    seen = replace(data.seen, position=position)
    expected = moved.clean(seen, motion, interpolate=False, stated=True, robust=True, smallest_move=1e-7)
    problem, refresh = model(seen, motion, False)
    cycle, ball, _ = (each.ravel() for each in np.meshgrid(*(np.arange(s) for s in (k, b, m)), indexing="ij"))
    search = steps(
        cycle.astype(float), ball, -normal.reshape(-1, 3), lambda i, t: f"ball {i}, cycle {t:g}", smallest=1e-7
    )
    found = cleaned(problem, suspects=search, refresh=refresh, name=lambda at: str(np.unravel_index(at[0], (k, b, m))))
    moves = [f"ball {each.ball}, cycle {each.cycle}" for each in expected.moves]
    assert [each.words for each in found.made if each.words.startswith("ball")] == moves
    wrong = expected.wrong.copy()
    for each in expected.moves:
        wrong[each.cycle :, each.ball] = True
    # besides, touches that explain an outlier nearly as well
    certain = found.excluded[:, 0].copy()
    for each in found.made:
        if each.rivals and not each.words.startswith("ball"):
            certain &= ~each.readings[:, 0]
    assert found.excluded[:, 0][wrong.ravel()].all()
    assert not certain[~wrong.ravel()].any()
    assert wrong.any() == bool(shift or outliers)
