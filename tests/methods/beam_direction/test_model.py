"""The measurement model: zero point, inclination error, and sources that all planes have in common."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from beam_bound import bound
from beams_on_planes import COVARIANCE, NOISE, STAGE, beam_on, errors, gradients_of, normal, planes_of, solved

from errormotion.estimation.fit import fit
from errormotion.kinematics.beams import tilt
from errormotion.methods.beam_direction.identification.direction import solve
from errormotion.methods.beam_direction.identification.sensor import Sensor

U = np.array([0.34, 0.02, -0.94])
U /= np.linalg.norm(U)
T = np.array([0.02, 1.0, 0.01])
T /= np.linalg.norm(T)
NOMINAL = np.array([np.sin(np.radians(20)), 0, -np.cos(np.radians(20))])
P0 = np.array([0.05, -0.01, 0.2])
PLACE = np.array([0.1, 0.05, -0.1])
MIDDLE, POINT_U = 2e-3, 1e-6
NORMALS = np.array([normal(20, 0), normal(20, 90), normal(20, 180), normal(35, 45)])
POINTS = np.tile(P0 + PLACE + 4e-3 * U, (4, 1))


@dataclass(frozen=True)
class Polynomial:
    """Calibration with k = c . (1, q1, q1^2, q2^2), with the interface that the model uses."""

    coefficients: np.ndarray
    coefficient_covariance: np.ndarray

    def jacobian(self, q):
        q = np.asarray(q)
        return np.stack([np.ones(q.shape[:-1]), q[..., 0], q[..., 0] ** 2, q[..., 1] ** 2], axis=-1)

    def slope(self, q):
        return self.jacobian(q) @ self.coefficients

    def reference(self):
        return {"name": "polynomial", "hash": "0"}


K = np.array([1e-4, 4e-3, 2e-3, -1e-3])
A = np.random.default_rng(0).normal(size=(4, 4)) * 1e-5
TRUE = Polynomial(K, A @ A.T)


def measured(count=4, rng=None, *, calibration=None, scale=0.0, stage=0.0, turned=0.0, points=0.0):
    """Return planes that read the beam, with noise by a generator, and errors of the constants.

    A plane that lies off its point by delta along its normal reads g.P of its true place.
    """
    g = gradients_of(NORMALS[:count], U)
    off = points * (rng.normal(size=count) if rng is not None else np.zeros(count))
    place = P0 + PLACE * (1 + stage) - POINTS[:count]
    d = np.sum(g * place, axis=1) + np.linalg.norm(g, axis=1) * off
    normal_of_sensor = np.cos(turned) * T + np.sin(turned) * np.cross(U, T)
    k = 0.0 if calibration is None else calibration.slope(tilt(U, normal_of_sensor, NORMALS[:count]))
    factor = (1 + np.broadcast_to(k, count)) * (1 + scale)
    y = np.column_stack([factor[:, None] * g * (1 + stage), MIDDLE + factor * (d - MIDDLE)])
    if rng is not None:
        y = y + rng.multivariate_normal(np.zeros(4), COVARIANCE, count)
    return planes_of(y[:, :3], y[:, 3], centre=PLACE)


def sensor(calibration=TRUE, roll=0.0):
    return Sensor(calibration, T, roll, MIDDLE)


def beam_of(planes, points=POINTS, point_uncertainty=POINT_U, **constants):
    """Return the beam with uncertain constants and known points."""
    found = solve(beam_on(planes, mid_range=MIDDLE, **constants), NOMINAL).adjusted()
    points = np.full((len(planes.names), 3), np.nan) if points is None else points[: len(planes.names)]
    return replace(found, points=points, point_uncertainty=point_uncertainty)


def parameters(*args, **more):
    return errors(beam_of(*args, **more)).value[0]


def nees_of(misses, covariance):
    """Return the mean of e' C^-1 e; the direction keeps its length, so that the rank is less by one."""
    scale = np.sqrt(np.diag(covariance))
    inverse = np.linalg.pinv(covariance / np.outer(scale, scale), rcond=1e-9, hermitian=True)
    miss = np.array(misses) / scale
    return np.einsum("si,ij,sj->s", miss, inverse, miss).mean()


def test_exact_planes_determine_the_beam():
    np.testing.assert_allclose(parameters(measured()), [*P0, *U], atol=1e-12)
    assert fit(beam_of(measured()).problem()).chi2 < 1e-9


def test_any_points_on_the_planes_are_accepted():
    aside = POINTS + np.array([np.cross(n, [0.1, 0.7, 0.2]) * 0.02 for n in NORMALS])
    np.testing.assert_allclose(parameters(measured(), aside)[:3], P0, atol=1e-12)


@pytest.mark.parametrize("count", [3, 4])
def test_covariance_is_the_scatter_over_seeds_and_the_bound(count):
    rng, misses = np.random.default_rng(count), []
    for _ in range(300):
        found = errors(beam_of(measured(count, rng, points=POINT_U)))
        misses.append(found.value[0] - [*P0, *U])
    stages = [STAGE + PLACE] * count
    least = bound(stages, NORMALS[:count], U, NOISE, origin=P0, points=POINTS[:count], point_uncertainty=POINT_U)
    scale = np.sqrt(np.diag(least))
    np.testing.assert_allclose(
        found.covariance[0] / np.outer(scale, scale), least / np.outer(scale, scale), atol=2e-3
    )  # linearised at one noisy estimate
    assert nees_of(misses, found.covariance[0]) == pytest.approx(5, abs=3.5 * np.sqrt(10 / 300))


def test_a_plane_without_a_known_point_contributes_only_to_the_direction():
    points = np.where(np.arange(4)[:, None] == 3, np.nan, POINTS)
    np.testing.assert_allclose(parameters(measured(), points)[:3], P0, atol=1e-12)
    wrong = measured()
    wrong.value[3, 3] += 1e-3
    np.testing.assert_allclose(parameters(wrong, points), [*P0, *U], atol=1e-12)


def test_without_points_the_zero_point_is_unknown():
    found = parameters(measured(), None)
    assert np.isnan(found[:3]).all()
    np.testing.assert_allclose(found[3:], U, atol=1e-12)


@pytest.mark.parametrize("count", [2, 4])
def test_a_correct_calibration_results_in_the_true_direction(count):
    planes = measured(count, calibration=TRUE)
    found = solved(planes, NOMINAL, sensor=sensor(), mid_range=MIDDLE)
    np.testing.assert_allclose(found.state.direction, U, atol=1e-11)
    # What is left without it: thousandths of a radian.
    assert np.linalg.norm(solved(planes, NOMINAL).state.direction - U) > 1e-3


def test_compensated_offsets_determine_the_zero_point():
    np.testing.assert_allclose(parameters(measured(calibration=TRUE), sensor=sensor())[:3], P0, atol=1e-10)


def test_two_planes_show_nothing_of_the_constants():
    """Their effect on the direction is that of a changed calibration, angle or scale, without adjustment."""
    planes, roll, relative = measured(2, calibration=TRUE), 5e-3, 1e-4
    found = errors(beam_of(planes, None, sensor=sensor(roll=roll)))
    by_group = {one.group: one.effect[0, 3:] for one in found.sources if one.group == "triangulation plane"}
    calibrated = np.array([one.effect[0, 3:] for one in found.sources if one.group == "inclination calibration"])

    def moved(**more):
        both = [parameters(measured(2, calibration=TRUE), None, **more[sign])[3:] for sign in ("ahead", "behind")]
        ahead, behind = both
        return (ahead - behind) / 2

    columns = []
    for column in A.T:
        by = [sensor(Polynomial(K + sign * column, TRUE.coefficient_covariance)) for sign in (1, -1)]
        columns.append(moved(ahead={"sensor": by[0]}, behind={"sensor": by[1]}))
    expected = np.array(columns).T @ np.array(columns)
    np.testing.assert_allclose(calibrated.T @ calibrated, expected, atol=0.01 * np.abs(expected).max())
    rolled = [replace(sensor(), triangulation_normal=np.cos(a) * T + np.sin(a) * np.cross(U, T)) for a in (roll, -roll)]
    expected = moved(ahead={"sensor": rolled[0]}, behind={"sensor": rolled[1]})
    size = np.abs(expected).max()
    np.testing.assert_allclose(np.abs(by_group["triangulation plane"]), np.abs(expected), atol=0.02 * size)
    [scale] = errors(beam_of(measured(2), None, scale_uncertainty=relative)).sources
    expected = parameters(measured(2, scale=relative), None)[3:] - U
    np.testing.assert_allclose(np.abs(scale.effect[0, 3:]), np.abs(expected), rtol=0.01)
    assert scale.group == "scale of the sensor"


def test_stage_and_sensor_of_the_same_scale_error_have_the_same_direction():
    """Only the ratio of readings and positions counts."""
    np.testing.assert_allclose(
        parameters(measured(2, scale=1e-4), None), parameters(measured(2, stage=1e-4), None), atol=1e-12
    )


SOURCES = {
    "calibration": {"sensor": sensor(roll=5e-3)},
    "scale": {"scale_uncertainty": 1e-4},
    "scales of the stage": {"stage_uncertainty": 3e-5},
    "all": {"sensor": sensor(roll=5e-3), "stage_uncertainty": 3e-5},
}


@cache
def repeated(name, count):
    """Return 200 measurements, each with another error of its constants: misses, last covariance, and chi-squares."""
    rng, misses, chi2 = np.random.default_rng(5), [], []
    constants = SOURCES[name]
    for _ in range(200):
        known = {
            "calibration": Polynomial(K + A @ rng.normal(size=4), TRUE.coefficient_covariance)
            if "sensor" in constants
            else None,
            "turned": constants["sensor"].normal_uncertainty * rng.normal() if "sensor" in constants else 0.0,
            "scale": constants.get("scale_uncertainty", 0.0) * rng.normal(),
            "stage": constants.get("stage_uncertainty", 0.0) * rng.normal(size=3),
        }
        beam = beam_of(measured(count, rng, points=POINT_U, **known), POINTS if count > 2 else None, **constants)
        found = errors(beam)
        misses.append(found.value[0] - [*P0, *U])
        chi2.append(fit(beam.problem()).chi2)
    return np.array(misses), found.covariance[0], np.array(chi2)


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 3, 4])
@pytest.mark.parametrize("name", SOURCES)
def test_noise_points_and_constants_are_as_large_as_stated(name, count):
    misses, covariance, chi2 = repeated(name, count)
    known = slice(3, 6) if count == 2 else slice(0, 6)
    freedom = 2 if count == 2 else 5
    nees = nees_of(misses[:, known], covariance[known, known])
    assert nees == pytest.approx(freedom, abs=3.5 * np.sqrt(freedom / 100))
    # Planes miss closing, and their points, by noise and by the constants: chi-square counts both.
    redundant = {2: 0, 3: 1, 4: 3}[count]
    assert chi2.mean() == pytest.approx(redundant, abs=3.5 * np.sqrt(2 * redundant / 200) + 1e-9)


@pytest.mark.parametrize("count", [3, 4])
def test_planes_around_the_beam_calibrate_the_scale(count):
    """The length of u is 1: with three planes or more the readings determine their own scale."""
    found = errors(beam_of(measured(count), scale_uncertainty=1e-3))
    without = errors(beam_of(measured(count)))
    u, least = (np.sqrt(np.diag(each.covariance[0])) for each in (found, without))
    assert (u[3:] < 2 * least[3:]).all()
    # Taken as it is, the scale error would turn the beam by as much as two planes let it.
    [scale] = errors(beam_of(measured(2), None, scale_uncertainty=1e-3)).sources
    assert np.linalg.norm(scale.effect[0, 3:]) > 20 * u[3:].max()


def test_identities_of_the_calibration_depend_on_the_tilts():
    beam = beam_of(measured(calibration=TRUE), sensor=sensor())
    other = beam_of(measured(3, calibration=TRUE), sensor=sensor())
    assert len(set(beam.component_identities)) == 4
    assert not set(beam.component_identities) & set(other.component_identities)
    assert beam_of(measured(calibration=TRUE), sensor=sensor()).component_identities == beam.component_identities


def test_components_state_the_covariance_of_the_slopes():
    q = tilt(U, T, NORMALS)
    components, _ = sensor().components(q)
    effects = TRUE.jacobian(q) @ components
    expected = TRUE.jacobian(q) @ TRUE.coefficient_covariance @ TRUE.jacobian(q).T
    np.testing.assert_allclose(effects @ effects.T, expected, atol=1e-9 * np.abs(expected).max())


def test_derivatives_are_those_of_single_changes():
    """One evaluation of all changed rows against the differences of the framework, both known to about 1e-6."""
    problem = beam_of(measured(rng=np.random.default_rng(1), calibration=TRUE), sensor=sensor(roll=5e-3)).problem()
    ours, differences = fit(problem), fit(replace(problem, derivatives=None))
    np.testing.assert_allclose(ours.unknowns.beam, differences.unknowns.beam, atol=1e-11)
    C = differences.normal.covariance
    scale = np.sqrt(np.diag(C))
    np.testing.assert_allclose(ours.normal.covariance / np.outer(scale, scale), C / np.outer(scale, scale), atol=1e-5)
