"""Pre-travel maps: what a ball tells of a probe, how well, and what it refuses."""

import math
from pathlib import Path

import numpy as np
import pytest
from coded import raises

from errormotion.arrays import Array
from errormotion.datasets import save
from errormotion.datasets.calibrations.pretravel import (
    ROWS,
    SCHEMA,
    PretravelMap,
    harmonics,
    terms_up_to,
    unit,
    violations,
)
from errormotion.errors import DatasetError
from errormotion.methods.normal_vector.identification.pretravel import (
    PretravelSettings,
    calibrating_touches,
    fit_pretravel,
)
from errormotion.twin import VirtualMachine
from errormotion.twin.artefacts.balls import Balls, Probe, seeded_balls, seeded_probe

TRAVEL = {"X": (-0.3, 0.3), "Y": (-0.25, 0.25), "Z": (0.0, 0.46)}
STRAIN = 15e-6


def touched(seed: int, count: int = 60) -> tuple[Array, PretravelSettings, Probe]:
    """Return touches of the first ball by a good probe, on a machine whose scales and right angles are a little off."""
    rng = np.random.default_rng([seed, 1])
    balls, probe = seeded_balls(rng, TRAVEL).first(1), seeded_probe(rng)
    touches = calibrating_touches(balls.nominal[0], balls.nominal_radius, probe.nominal_tip_radius, count=count)
    n = unit(np.array([touch.start for touch in touches]) - balls.nominal[0])
    off = rng.normal(0, STRAIN, (3, 3)) * np.tri(3)
    reach = balls.height(np.zeros(count, dtype=int), n) + probe.tip_radius - probe.pretravel(n)
    reach += probe.noise * rng.normal(size=count)
    return balls.centre[0] + (reach[:, None] * n) @ (np.eye(3) + off).T, settings(balls, probe), probe


def settings(balls: Balls, probe: Probe, **more: float) -> PretravelSettings:
    """Return what a good calibration knows: radii to 0.2 um."""
    known = {"ball_radius": float(balls.radius[0]), "ball_radius_uncertainty": 0.2e-6, "ball_roundness": 0.5e-6}
    return PretravelSettings(
        **{**known, "tip_radius": probe.tip_radius, "tip_radius_uncertainty": 0.2e-6, "strain": STRAIN, **more}
    )


def upper(seed: int, count: int = 200) -> Array:
    n = unit(np.random.default_rng([seed, 2]).normal(size=(count, 3)))
    n[:, 2] = np.abs(n[:, 2])
    return n


def test_harmonics_are_orthonormal_over_the_sphere() -> None:
    z, weight = np.polynomial.legendre.leggauss(12)
    azimuth = 2 * np.pi * np.arange(24) / 24
    across = np.sqrt(1 - z**2)
    n = np.stack(
        [np.outer(across, np.cos(azimuth)), np.outer(across, np.sin(azimuth)), np.repeat(z[:, None], 24, axis=1)], -1
    ).reshape(-1, 3)
    H = harmonics(n, *terms_up_to(5))
    gram = (H * np.repeat(weight / 48, 24)[:, None]).T @ H
    np.testing.assert_allclose(gram, np.eye(33), atol=1e-12)


def test_the_lobes_are_found_and_nothing_else_without_noise() -> None:
    _, known, probe = touched(3)
    n = unit(np.random.default_rng(0).normal((0.0, 0.0, 1.5), size=(60, 3)))
    contact = known.ball_radius + known.tip_radius
    points = [0.1, 0.2, 0.3] + (contact - probe.pretravel(n))[:, None] * n
    found = fit_pretravel(points, known)
    lobes = {
        (int(degree), int(order)): float(value)
        for degree, order, value in zip(
            found.dataset["degree"].values, found.dataset["order"].values, found.coefficients, strict=True
        )
    }
    assert lobes.pop((0, 0)) == pytest.approx(probe.mean, abs=1e-12)
    three = np.hypot(lobes.pop((3, 3)), lobes.pop((3, -3)))
    # sin(theta)^3 cos(3 phi) has the mean square 16/35/2 over the sphere
    assert three == pytest.approx(probe.lobing * np.sqrt(8 / 35), abs=1e-12)
    assert max(map(abs, lobes.values())) < 1e-12
    np.testing.assert_allclose(found.length(n)[0], probe.pretravel(n), atol=1e-12)
    np.testing.assert_allclose(found.met(points, n), [0.1, 0.2, 0.3] + contact * n, atol=1e-12)


def test_map_contains_the_truth_as_often_as_stated() -> None:
    seeds = 200
    deviation = np.empty((seeds, 200))
    highest = []
    for seed in range(seeds):
        points, known, probe = touched(seed)
        found = fit_pretravel(points, known)
        n = upper(seed)
        value, u = found.length(n)
        deviation[seed] = (value - probe.pretravel(n)) / u
        highest.append(int(found.dataset["degree"].max()))
    assert min(highest) >= 3  # the lobes, 1.5 um, stand far out of a noise of 0.25 um
    coverage = np.mean(np.abs(deviation) < 1.96)
    assert coverage == pytest.approx(0.95, abs=0.03)
    assert np.sqrt(np.mean(deviation**2)) == pytest.approx(1.0, abs=0.12)


def test_the_twins_probe_is_calibrated_on_the_twins_ball() -> None:
    machine = VirtualMachine("gantry", seed=5)
    balls, probe = machine.balls, machine.probe
    touches = calibrating_touches(balls.nominal[1], balls.nominal_radius, probe.nominal_tip_radius)
    points = [machine.contact(touch.start, touch.target, 0.0)[0] for touch in touches]
    found = fit_pretravel(points, settings(balls, probe))
    n = upper(0)
    value, u = found.length(n)
    true = probe.pretravel(n) + balls.radius[0] - balls.radius[1]  # the settings tell the radius of another ball
    assert np.abs((value - true) / u).max() < 4  # 200 correlated directions
    # The machine's own errors over the ball are of degree 2, of the size of the lobes; the lobes are of degree 3.
    three = (found.dataset["degree"].values == 3) & (np.abs(found.dataset["order"].values) == 3)
    amplitude = np.hypot(*found.coefficients[three]) / np.sqrt(8 / 35)
    spread = np.sqrt(np.diag(found.coefficient_covariance)[three].max() * 35 / 8)
    assert spread < 0.1e-6
    assert amplitude == pytest.approx(probe.lobing, abs=4 * spread)


def test_touches_are_spread_over_the_upper_half_along_the_normals() -> None:
    touches = calibrating_touches((0.1, 0.2, 0.3), 12.5e-3, 3e-3, count=50, standoff=2e-3, overtravel=1e-3)
    start, target = (np.array([getattr(touch, name) for touch in touches]) for name in ("start", "target"))
    n = unit(start - [0.1, 0.2, 0.3])
    assert n[:, 2].min() > 0
    np.testing.assert_allclose(np.linalg.norm(start - [0.1, 0.2, 0.3], axis=1), 17.5e-3)
    np.testing.assert_allclose(start - target, 3e-3 * n, atol=1e-15)
    angle = np.arccos(np.clip(n @ n.T - 2 * np.eye(50), -1, 1)).min(axis=1)
    assert angle.min() / angle.max() > 0.5


def test_wrong_touch_is_excluded_without_effect() -> None:
    points, known, _ = touched(7)
    good = fit_pretravel(points, known)
    spoilt = points.copy()
    spoilt[11] += [0.0, 0.0, 30e-6]
    spoilt[20] = np.nan
    found = fit_pretravel(spoilt, known)
    left_out = np.flatnonzero(found.dataset["left_out"])
    assert left_out.tolist() == [11]
    value, u = found.length(upper(1))
    np.testing.assert_array_less(np.abs(value - good.length(upper(1))[0]), 1.5 * u)


def test_only_directions_among_the_touches_are_supported() -> None:
    points, known, _ = touched(1)
    found = fit_pretravel(points, known)
    assert found.supported([[0, 0, 1], [1, 0, 0.2], [0, 0, -1], [0.5, 0, -1]]).tolist() == [True, True, False, False]


def test_too_few_or_lopsided_touches_are_refused() -> None:
    points, known, _ = touched(1)
    with raises("probing.touches.too_few"):
        fit_pretravel(points[:7], known)
    with raises("probing.touches.one_side"):
        fit_pretravel(np.repeat(points[:1], 20, axis=0) + 1e-9 * np.eye(3)[np.arange(20) % 3], known)


def test_a_map_is_saved_and_loaded(tmp_path: Path) -> None:
    points, known, _ = touched(1)
    made = fit_pretravel(points, known)
    path = made.save(tmp_path / "probe.nc")
    loaded = PretravelMap.load(path)
    np.testing.assert_array_equal(loaded.length(upper(0)), made.length(upper(0)))
    with pytest.raises(DatasetError, match="already exists"):
        made.save(path)
    with pytest.raises(DatasetError, match="no such file"):
        PretravelMap.load(tmp_path / "other.nc")
    foreign = save(made.dataset.assign_attrs(schema="else/1"), tmp_path / "else.nc")
    with pytest.raises(DatasetError, match=rf"expected a pre-travel map \({SCHEMA}\); found schema else/1"):
        PretravelMap.load(foreign)


@pytest.mark.parametrize(
    ("name", "factor", "message"),
    [
        ("coefficient", 1e6, "coefficient = .* m: expected"),
        ("coefficient_covariance", np.nan, "coefficient_covariance: expected numbers; found NaN"),
        ("coefficient_covariance", -1.0, "expected no negative variance"),
        ("degree", 0, "order: expected -degree to degree"),
    ],
)
def test_a_broken_map_is_refused(name: str, factor: float, message: str) -> None:
    points, known, _ = touched(1)
    made = fit_pretravel(points, known).dataset
    with pytest.raises(DatasetError, match=message):
        PretravelMap(made.assign({name: made[name] * factor}))
    assert violations(made) == []
    assert violations(made.drop_vars(name))


def test_the_reference_page_says_what_is_checked() -> None:
    page = (Path(__file__).parents[3] / "docs" / "reference" / "schemas.md").read_text()
    section = page.partition("\n## Pre-travel map")[2].partition("\n## ")[0]
    reported = [line for line in section.splitlines() if line.startswith("| `")]
    for row, line in zip(ROWS, reported, strict=True):
        limits = "" if math.isinf(row.low) else f"{row.low:g} to {row.high:g}"
        assert line == f"| `{row.name}` | {', '.join(row.dims)} | {row.unit} | yes | {limits} | {row.meaning} |"
