"""Parameters beside the motion: found, weighed by their priors, and refused where a surface does not tell them."""

import numpy as np
import pytest
from coded import raises

from errormotion.errors import MethodError
from errormotion.kinematics import poses
from errormotion.methods.crossbeam_scan.identification.registration import prepare, register
from errormotion.methods.crossbeam_scan.identification.registration.freedoms import BASES

TWIST = np.array([23e-6, -41e-6, 17e-6, 30e-6, -55e-6, 80e-6])
CENTRE = np.array([0.2e-3, -0.3e-3, 0.5e-3])
FEED = {"feed_x": np.inf, "feed_y": np.inf, "feed_z": np.inf}
RARE = 33.7
"""Chi squared of nine freedoms is larger once in 10 000 times."""


@pytest.fixture
def scanner(make_scanner):
    """Return a scanner of a part of the free-form artefact."""
    return make_scanner(rows=280, columns=1120)


class Strained:
    """What a pose does and, after it, d = sum e G (P - CENTRE): what the scanner asks of a motion."""

    def __init__(self, values):
        self.stretch = np.eye(3) + sum(value * BASES[name] for name, value in values.items())

    def as_matrix(self):
        M = np.eye(4)
        M[:3, :3] = self.stretch
        M[:3, 3] = CENTRE - self.stretch @ CENTRE
        return M @ poses.displaced(TWIST, CENTRE).as_matrix()


def joint_error(found, values):
    """Error of twist and parameters about CENTRE, and chi squared by the stated covariance."""
    twist, extra, covariance = found.joint_at(CENTRE)
    error = np.concatenate([twist - TWIST, extra - [values.get(name, 0.0) for name in found.extra_names]])
    return error, error @ np.linalg.solve(covariance, error)


@pytest.mark.parametrize("jitter", [0.0, 0.3e-6])
@pytest.mark.parametrize("name", BASES)
def test_every_parameter_is_found(scanner, name, jitter):
    rng = np.random.default_rng(list(BASES).index(name))
    # Over a flat artefact feed_z is nearly the rotation EA: it shows by the relief alone.
    values = {name: 400e-6 if name == "feed_z" else 80e-6}
    cold, warm = scanner.scan(rng, jitter_z=jitter), scanner.scan(rng, Strained(values), jitter_z=jitter)
    found = register(prepare(*cold), prepare(*warm), extra={name: np.inf})
    assert found.extra_names == (name,)
    assert joint_error(found, values)[1] < RARE
    assert found.extra[0] / np.sqrt(found.joint_covariance[6, 6]) > 20
    np.testing.assert_array_equal(found.joint_covariance[:6, :6], found.covariance)


def test_free_drifts_of_the_feed_are_found_with_an_honest_covariance(make_scanner):
    scanner = make_scanner(rows=280, columns=1120)
    values = {"feed_x": 40e-6, "feed_y": -60e-6, "feed_z": 30e-6}
    heights = scanner.true_heights(), scanner.true_heights(Strained(values))
    joint, twists = [], []
    for seed in range(64):
        rng = np.random.default_rng([21, seed])
        maps = [prepare(scanner.noisy(rng, z), scanner.x, scanner.y) for z in heights]
        found = register(*maps, point=CENTRE, extra=FEED)
        error, chi2 = joint_error(found, values)
        joint.append(chi2 / 9)
        twists.append(error[:6] @ np.linalg.solve(found.covariance, error[:6]) / 6)
    # Means of 64 values of chi2(9) / 9 and chi2(6) / 6 scatter by 0.059 and 0.072; three of it.
    assert abs(np.mean(joint) - 1.0) < 0.18
    assert abs(np.mean(twists) - 1.0) < 0.22


def test_free_parameters_cost_what_the_bound_says(scanner):
    rng = np.random.default_rng(2)
    maps = prepare(*scanner.scan(rng)), prepare(*scanner.scan(rng))
    found = register(*maps, point=CENTRE, extra=FEED)
    X, Y = np.meshgrid(scanner.x, scanner.y)
    Z, Sx, Sy = scanner.surface(X, Y)
    X, Y, Z = X - CENTRE[0], Y - CENTRE[1], Z - CENTRE[2]
    J = [-Sx, -Sy, np.ones_like(X), Y + Sy * Z, -X - Sx * Z, Sx * Y - Sy * X, -Sx * Y, -Sy * Y, Y]
    J = np.reshape(J, (9, -1))
    bound = 2 * scanner.noise**2 * np.linalg.inv(J @ J.T)
    # The noise is estimated from the residuals, with neighbours: to some per cent.
    np.testing.assert_allclose(np.sqrt(np.diag(found.joint_covariance)), np.sqrt(np.diag(bound)), rtol=0.08)


def test_a_tight_prior_makes_the_motion_rigid_and_a_wide_one_changes_nothing(scanner):
    rng = np.random.default_rng(3)
    maps = prepare(*scanner.scan(rng)), prepare(*scanner.scan(rng, poses.displaced(TWIST, CENTRE)))
    rigid = register(*maps, point=CENTRE)
    tight = register(*maps, point=CENTRE, extra=dict.fromkeys(FEED, 1e-12))
    np.testing.assert_allclose(tight.twist, rigid.twist, rtol=0, atol=1e-3 * rigid.sigma.min())
    np.testing.assert_allclose(tight.sigma, rigid.sigma, rtol=0.01)
    np.testing.assert_allclose(np.sqrt(np.diag(tight.joint_covariance))[6:], 1e-12, rtol=1e-3)
    free = register(*maps, point=CENTRE, extra=FEED)
    wide = register(*maps, point=CENTRE, extra=dict.fromkeys(FEED, 0.04))
    np.testing.assert_allclose(wide.joint_covariance, free.joint_covariance, rtol=1e-3, atol=1e-18)


def test_a_prior_weighs_as_a_measurement_of_zero(scanner):
    rng = np.random.default_rng(4)
    maps = prepare(*scanner.scan(rng)), prepare(*scanner.scan(rng, Strained({"feed_x": 5e-6})))
    free = register(*maps, point=CENTRE, extra={"feed_x": np.inf})
    sigma = np.sqrt(free.joint_covariance[6, 6])
    held = register(*maps, point=CENTRE, extra={"feed_x": sigma})
    assert held.extra[0] == pytest.approx(free.extra[0] / 2, rel=0.02)
    assert held.joint_covariance[6, 6] == pytest.approx(sigma**2 / 2, rel=0.02)


def test_result_moves_to_another_point(scanner):
    rng = np.random.default_rng(5)
    maps = prepare(*scanner.scan(rng)), prepare(*scanner.scan(rng, Strained({"feed_x": 3e-4, "expansion": 1e-4})))
    extra = {"feed_x": np.inf, "expansion": 1e-3}
    lever = np.array([0.01, 0.1, 0.174])
    here, there = register(*maps, extra=extra), register(*maps, extra=extra, point=lever)
    twist, values, covariance = here.joint_at(lever)
    np.testing.assert_allclose(twist, there.twist, rtol=0, atol=1e-15)
    np.testing.assert_allclose(values, there.extra, rtol=0, atol=1e-18)
    np.testing.assert_allclose(covariance, there.joint_covariance, rtol=1e-9, atol=1e-24)
    np.testing.assert_array_equal(here.at(lever)[1], covariance[:6, :6])

    # Both describe one and the same displacement.
    def moved(found, p):
        stretch = np.eye(3) + sum(e * BASES[n] for n, e in zip(found.extra_names, found.extra, strict=True))
        return found.point + stretch @ (found.pose.apply(p) - found.point)

    p = np.array([3e-3, -5e-3, 1e-3])
    np.testing.assert_allclose(moved(here, p), moved(there, p), rtol=0, atol=1e-15)


@pytest.mark.parametrize(("noisy_cold", "share"), [(1.0, 0.5), (3.0, 0.9)])
def test_warm_scans_of_one_cold_scan_share_its_noise(make_scanner, noisy_cold, share):
    scanner = make_scanner(rows=100, columns=400)
    heights = scanner.true_heights(), scanner.true_heights(poses.displaced(TWIST))
    errors, stated = [], []
    for seed in range(40):
        rng = np.random.default_rng([22, seed])
        scanner.noise = noisy_cold * 0.5e-6
        cold = prepare(scanner.noisy(rng, heights[0]), scanner.x, scanner.y)
        scanner.noise = 0.5e-6
        pair = [register(cold, prepare(scanner.noisy(rng, heights[1]), scanner.x, scanner.y)) for _ in range(2)]
        truth = poses.displacement(poses.displaced(TWIST), pair[0].point)
        errors.append([np.linalg.solve(np.linalg.cholesky(r.covariance), r.twist - truth) for r in pair])
        stated.append([r.cold_share for r in pair])
    assert np.mean(stated) == pytest.approx(share, abs=0.01)
    first, second = np.moveaxis(errors, 1, 0)
    correlation = np.mean(first * second) / np.sqrt(np.mean(first**2) * np.mean(second**2))
    # Of 240 pairs of numbers: (1 - share^2) / sqrt(240) is its scatter; three of it.
    assert correlation == pytest.approx(share, abs=3 * (1 - share**2) / 240**0.5)


def test_unknown_names_are_refused_with_those_there_are(scanner):
    block_map = prepare(*scanner.scan(np.random.default_rng(0)))
    with pytest.raises(MethodError, match=r"feed_x, feed_y.*found 'feed'"):
        register(block_map, block_map, extra={"feed": np.inf})


@pytest.mark.parametrize("sigma", [0.0, -1.0, np.nan])
def test_priors_are_positive(scanner, sigma):
    block_map = prepare(*scanner.scan(np.random.default_rng(0)))
    with raises("registration.parameters.prior"):
        register(block_map, block_map, extra={"feed_x": sigma})


def test_clouds_know_no_extra_parameters(scanner):
    block_map = prepare(*scanner.scan(np.random.default_rng(0)))
    with raises("registration.parameters.not_allowed"):
        register(block_map, block_map, extra={"feed_x": np.inf}, registration="open3d_plane")


def refused_names(maps, extra):
    with pytest.raises(MethodError, match="undetermined") as refusal:
        register(*maps, extra=extra)
    return {name for name in BASES if name in str(refusal.value)}


def test_parameters_that_are_sums_of_one_another_are_refused_all_named(scanner):
    rng = np.random.default_rng(6)
    maps = [prepare(*scanner.scan(rng)) for _ in range(2)]
    asked = ("feed_x", "feed_y", "scale_x", "scale_z", "expansion")
    named = refused_names(maps, dict.fromkeys(asked, np.inf))
    assert named == {"feed_y", "scale_x", "scale_z", "expansion"}
    # One of them held by a prior is enough.
    register(*maps, extra={**dict.fromkeys(asked, np.inf), "expansion": 1e-6})


def exponential(X, Y):
    """A surface that is larger by a share where it is shifted along x."""
    z = 0.5e-3 * np.exp(150 * X) * np.cos(150 * Y)
    return z, 150 * z, -75e-3 * np.exp(150 * X) * np.sin(150 * Y)


def test_a_parameter_that_a_surface_does_not_tell_from_a_motion_is_refused(make_scanner):
    scanner = make_scanner(exponential)
    rng = np.random.default_rng(7)
    maps = [prepare(*scanner.scan(rng)) for _ in range(2)]
    register(*maps, extra={"feed_x": np.inf})
    assert refused_names(maps, {"scale_z": np.inf, "feed_x": np.inf}) == {"scale_z"}
