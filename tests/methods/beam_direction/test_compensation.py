"""Iterative compensation of the inclination error."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from errormotion.errors import MethodError
from errormotion.kinematics.beams import tilt
from errormotion.methods.beam_direction.identification.compensation import Planes, Sensor, converge, uncompensated
from errormotion.methods.beam_direction.identification.origin import locate
from errormotion.methods.beam_direction.identification.propagation import closure_chi2, propagate
from errormotion.methods.beam_direction.identification.slopes import expected_covariance

U = np.array([0.34, 0.02, -0.94])
U /= np.linalg.norm(U)
T = np.array([0.02, 1.0, 0.01])
T /= np.linalg.norm(T)
NOMINAL = np.array([np.sin(np.radians(20)), 0, -np.cos(np.radians(20))])
P0 = np.array([0.01, -0.02, 0.05])
MIDDLE = 2e-3
STAGE = np.concatenate([np.outer(np.linspace(-5e-3, 5e-3, 12), e) for e in np.eye(3)])
C = expected_covariance(STAGE, 0.1e-6)


@dataclass(frozen=True)
class Polynomial:
    """Calibration with k = c . (1, q1, q1^2, q2^2), with the interface that the compensation uses."""

    coefficients: np.ndarray
    coefficient_covariance: np.ndarray

    def jacobian(self, q):
        q = np.asarray(q)
        return np.stack([np.ones(q.shape[:-1]), q[..., 0], q[..., 0] ** 2, q[..., 1] ** 2], axis=-1)

    def slope(self, q):
        J = self.jacobian(q)
        return J @ self.coefficients, np.sqrt(np.einsum("...i,ij,...j->...", J, self.coefficient_covariance, J))


K = np.array([1e-4, 4e-3, 2e-3, -1e-3])
A = np.random.default_rng(0).normal(size=(4, 4)) * 1e-5
TRUE = Polynomial(K, A @ A.T)


def normal(inclination, rotation):
    a, b = np.radians([inclination, rotation])
    return np.array([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])


FOUR = np.array([normal(20, 0), normal(20, 90), normal(20, 180), normal(30, 45)])
PAIR = FOUR[:2]


def read_planes(normals=FOUR, calibration=TRUE, rng=None):
    """Return the readings of a sensor with the inclination error of a calibration on planes through P0 + 3 mm U."""
    g = -normals / (normals @ U)[:, None]
    offsets = np.full(len(g), 3e-3)
    k = calibration.slope(tilt(U, T, normals))[0]
    y = np.column_stack([g * (1 + k)[:, None], offsets + (offsets - MIDDLE) * k])
    if rng is not None:
        y = y + rng.multivariate_normal(np.zeros(4), C, len(g))
    names = tuple(f"Plane {i + 1}" for i in range(len(g)))
    return Planes(names, y[:, :3], y[:, 3], np.tile(C, (len(g), 1, 1)))


def sensor(calibration=TRUE, roll=0.0):
    return Sensor(calibration, T, roll, MIDDLE)


def settled(planes=None, by=None, tolerance=1e-12, most=30):
    return converge(planes or read_planes(), NOMINAL, by or sensor(), tolerance, most)


@pytest.mark.parametrize("normals", [PAIR, FOUR])
def test_a_correct_calibration_results_in_the_true_direction(normals):
    planes = read_planes(normals)
    found = settled(planes)
    np.testing.assert_allclose(found.direction.direction, U, atol=1e-11)
    np.testing.assert_allclose(found.planes.offsets, 3e-3, atol=1e-13)
    assert 2 <= found.iterations <= 8
    # What is left without it: thousandths of a radian.
    assert np.linalg.norm(uncompensated(planes, NOMINAL).direction.direction - U) > 1e-3


def test_compensated_offsets_determine_the_zero_point():
    found = settled()
    points = np.tile(P0 + 3e-3 * U, (4, 1))
    origin = locate(found.direction, found.planes.offsets, found.planes.covariances, points, 1e-7)
    np.testing.assert_allclose(origin.origin, P0, atol=1e-10)


def test_calibration_and_mounting_propagate_through_all_iterations():
    """The influence of a source equals the change of direction and zero point when the source is changed."""
    planes, roll = read_planes(), 5e-3
    points = np.tile(P0 + 3e-3 * U, (4, 1))

    def beam(by):
        found = settled(planes, by)
        origin = locate(found.direction, found.planes.offsets, found.planes.covariances, points, 1e-7)
        return found, origin, np.concatenate([origin.origin, found.direction.direction])

    found, origin, _ = beam(sensor(roll=roll))
    influence = propagate(found, origin, 1e-7).influence
    assert found.groups == ("inclination calibration",) * 4 + ("triangulation plane",)
    by_coefficient = []
    for column in A.T:
        moved = [beam(sensor(Polynomial(K + sign * column, TRUE.coefficient_covariance)))[2] for sign in (1, -1)]
        by_coefficient.append((moved[0] - moved[1]) / 2)
    expected = np.array(by_coefficient).T @ np.array(by_coefficient)
    ours = influence[:4].T @ influence[:4]
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(ours / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.01)

    def rolled(angle):
        e1 = np.cross(T, U) / np.linalg.norm(np.cross(T, U))
        e2 = np.cross(U, e1)
        return Sensor(TRUE, np.cos(angle) * e2 - np.sin(angle) * e1, 0.0, MIDDLE)

    ahead, behind = beam(rolled(roll))[2], beam(rolled(-roll))[2]
    size = np.abs(influence[4]).max()
    np.testing.assert_allclose(np.abs(influence[4]), np.abs(ahead - behind) / 2, atol=0.02 * size)


@cache
def repeated(planes):
    """Return 200 measurements of the first planes, with noise and each with another error of the calibration."""
    rng, found = np.random.default_rng(5), []
    for _ in range(200):
        wrong = Polynomial(K + A @ rng.normal(size=4), TRUE.coefficient_covariance)
        found.append(settled(read_planes(FOUR[:planes], TRUE, rng), sensor(wrong), tolerance=1e-9))
    return found


@pytest.mark.parametrize("planes", [2, 4])
def test_noise_and_calibration_are_as_large_as_stated(planes):
    miss = [found.direction.direction - U for found in repeated(planes)]
    stated = propagate(repeated(planes)[-1], None, 0.0)
    total = stated.covariance[3:, 3:] + stated.influence[:, 3:].T @ stated.influence[:, 3:]
    nees = np.einsum("si,ij,sj->s", miss, np.linalg.pinv(total, rcond=1e-9, hermitian=True), miss)
    assert nees.mean() == pytest.approx(2, abs=3.5 * np.sqrt(4 / 200))


def test_uncertainty_of_the_closure_includes_the_calibration():
    # Planes miss closing by noise and by the calibration: chi-square counts both, with planes - 2 degrees of freedom.
    chi2 = [closure_chi2(propagate(found, None, 0.0)) for found in repeated(4)]
    assert np.mean(chi2) == pytest.approx(2, abs=3.5 * np.sqrt(4 / 200))


def test_too_few_iterations_are_refused_with_the_last_change():
    with pytest.raises(
        MethodError,
        match=r"in the last of 2 iterations the direction changed by \S+ rad; expected less .*the steps decrease",
    ):
        settled(most=2)


def test_an_error_that_is_too_steep_in_the_tilt_makes_the_steps_alternate():
    class Jump(Polynomial):
        """Small but so steep about the true tilt of the first plane that each step overshoots."""

        def slope(self, q):
            return -2e-3 * np.tanh(3e3 * (np.asarray(q)[:, 0] - self.coefficients[1] - 1e-4)), np.zeros(len(q))

    middle = tilt(U, T, PAIR)[0, 0]
    by = sensor(Jump(np.array([0.0, middle, 0.0, 0.0]), np.zeros((4, 4))))
    exact = read_planes(PAIR, Polynomial(np.zeros(4), np.zeros((4, 4))))
    with pytest.raises(
        MethodError, match=r"does not converge: in the last of 30 iterations .*the steps alternate.*less inclination"
    ):
        settled(exact, by)


def test_a_calibration_of_another_sensor_is_refused():
    with pytest.raises(
        MethodError, match=r"Plane 1: the inclination error of the calibration .* belongs to this sensor"
    ):
        settled(by=sensor(Polynomial(np.array([0.5, 0, 0, 0]), np.zeros((4, 4)))))
