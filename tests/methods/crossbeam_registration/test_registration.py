"""The pose between two scans: its sign, its precision against the bound, its honesty, and what is refused."""

from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from coded import raises
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import RigidTransform

from errormotion import compiling
from errormotion.kinematics import poses
from errormotion.methods.crossbeam_scan.identification.registration import kernels, prepare, register
from errormotion.methods.crossbeam_scan.identification.registration.comparison import lag_sums
from errormotion.methods.crossbeam_scan.identification.registration.freedoms import Extra
from errormotion.methods.crossbeam_scan.identification.registration.solver import Problem, State

registering = import_module("errormotion.methods.crossbeam_scan.identification.registration.register")

ORIGIN = np.zeros(3)
BLOCK_X, BLOCK_Y = 16 * 12.5e-6, 4 * 70e-6
TWIST = np.array([23e-6, -41e-6, 17e-6, 30e-6, -55e-6, 80e-6])
RARE = 27.9
"""Chi squared of six freedoms is larger once in 10 000 times."""


@pytest.fixture
def scanner(make_scanner):
    """Return a scanner of a part of the free-form artefact."""
    return make_scanner(rows=240, columns=960)


def chi2(found, truth):
    error = found.twist - truth
    return error @ np.linalg.solve(found.covariance, error)


def pairs(scanner, twist, seeds, *, jitter_z=0.0, spoil=None, speckle=0.0, family=11):
    """Register many pairs of scans with noise of their own; yield the results."""
    heights = scanner.true_heights(), scanner.true_heights(poses.displaced(twist))
    for seed in range(seeds):
        rng = np.random.default_rng([family, seed])
        maps = []
        for z in heights:
            if speckle:
                noise = gaussian_filter1d(rng.standard_normal(z.shape), speckle, axis=1)
                z = z + scanner.noise / noise.std() * noise
            z = scanner.noisy(rng, z, jitter_z)
            maps.append(prepare(z if spoil is None else spoil(rng, z), scanner.x, scanner.y))
        yield register(*maps, point=ORIGIN)


def nees(results, truth, covariance=None):
    """Mean squared error in units of the covariance, for one freedom: 1 where the covariance is right."""
    errors = np.array([r.twist - truth for r in results])
    C = [r.covariance for r in results] if covariance is None else [covariance] * len(errors)
    return np.mean([e @ np.linalg.solve(c, e) for e, c in zip(errors, C, strict=True)]) / 6


@pytest.mark.parametrize("freedom", range(6))
def test_pose_is_how_the_profiler_moved(scanner, freedom):
    twist = np.zeros(6)
    twist[freedom] = [150e-6, 150e-6, 150e-6, 2e-3, 2e-3, 2e-3][freedom]
    rng = np.random.default_rng(freedom)
    found = register(prepare(*scanner.scan(rng)), prepare(*scanner.scan(rng, poses.displaced(twist))), point=ORIGIN)
    assert chi2(found, twist) < RARE
    assert found.twist[freedom] / found.sigma[freedom] > 100


@pytest.mark.slow
def test_errors_are_at_the_bound_and_the_covariance_says_so(make_scanner):
    scanner = make_scanner(rows=200, columns=800)
    results = [found for family in (7, 11) for found in pairs(scanner, TWIST, 60, family=family)]
    bound = scanner.bound()
    # The mean of 120 values of chi2(6) / 6 scatters by sqrt(2 / 6 / 120) = 0.053; three of it.
    assert abs(nees(results, TWIST, bound) - 1.0) < 0.16
    assert abs(nees(results, TWIST) - 1.0) < 0.16
    # Lines are taken for jittering where they differ by four standard deviations: hardly ever by chance.
    assert sum(r.line_jitter != (0.0, 0.0) for r in results) <= 4
    np.testing.assert_allclose(np.mean([r.sigma for r in results], axis=0), np.sqrt(np.diag(bound)), rtol=0.06)


@pytest.mark.parametrize("extra", [None, {"scale_z": np.inf}])
def test_a_short_last_step_needs_no_second_look(scanner, monkeypatch, extra):
    maps = []
    for heights in (scanner.true_heights(), scanner.true_heights(poses.displaced(TWIST))):
        maps.append(prepare(scanner.noisy(np.random.default_rng(len(maps)), heights), scanner.x, scanner.y))
    quick = register(*maps, extra=extra)
    monkeypatch.setattr(registering, "STRAIGHT", 0.0)
    slow = register(*maps, extra=extra)
    assert slow.iterations == quick.iterations + 1
    difference = quick.twist - slow.twist
    assert difference @ np.linalg.solve(slow.covariance, difference) < 0.01**2
    unit = np.outer(slow.sigma, slow.sigma)
    np.testing.assert_allclose(quick.covariance / unit, slow.covariance / unit, atol=1e-3)
    assert np.nanstd(quick.residual - slow.residual) < 1e-3 * slow.rms


@pytest.mark.parametrize(("part_x", "part_y"), [(0, 0), (0.25, 0.25), (0.5, 0.5), (0.5, 0), (0, 0.5), (0.8, 0.3)])
def test_no_bias_at_any_place_between_the_blocks(scanner, part_x, part_y):
    twist = np.array([part_x * BLOCK_X, part_y * BLOCK_Y, 5e-6, 20e-6, -30e-6, 40e-6])
    heights = scanner.true_heights(), scanner.true_heights(poses.displaced(twist))
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(2):
        noise = scanner.noise * rng.standard_normal((2, *heights[0].shape), dtype=np.float32)
        # Noise and its opposite: what is linear in it cancels, and what is left is bias.
        for sign in (1, -1):
            maps = [
                prepare((z + sign * n).astype(np.float32), scanner.x, scanner.y)
                for z, n in zip(heights, noise, strict=True)
            ]
            errors.append(register(*maps, point=ORIGIN).twist - twist)
    assert np.abs(np.mean(errors, axis=0) / np.sqrt(np.diag(scanner.bound()))).max() < 0.1


def test_honest_under_line_jitter_and_yaw_unharmed(scanner):
    results = list(pairs(scanner, TWIST, 16, jitter_z=0.5e-6))
    # 16 pairs: 1 +- 0.14, and the line variances are estimated from 100 rows of blocks.
    assert 0.7 < nees(results, TWIST) < 1.35
    # Two scans, each with 0.5 um.
    assert np.mean([r.line_jitter[0] for r in results]) == pytest.approx(0.5e-6 * 2**0.5, rel=0.2)
    yaw = np.std([r.twist[5] for r in results])
    assert yaw < 1.5 * np.sqrt(scanner.bound()[5, 5])


@pytest.mark.parametrize("seed", [2, 11, 25, 32])
def test_line_jitter_that_was_found_is_not_lost_again(make_scanner, motion, seed):
    """In these scans its own contribution to the residuals once hid it, at every third step."""
    scanner, rng = make_scanner(rows=100, columns=400), np.random.default_rng(seed)
    cold, warm = scanner.scan(rng, jitter_z=0.5e-6), scanner.scan(rng, motion, jitter_z=0.5e-6)
    assert register(prepare(*cold), prepare(*warm)).line_jitter[0] > 0.0


def test_honest_under_jitter_along_the_feed(make_scanner):
    scanner = make_scanner(rows=240, columns=480)
    results = []
    for seed in range(12):
        rng = np.random.default_rng([8, seed])
        cold = scanner.scan(rng, jitter_z=0.5e-6, jitter_y=2e-6)
        warm = scanner.scan(rng, poses.displaced(TWIST), jitter_z=0.5e-6, jitter_y=2e-6)
        results.append(register(prepare(*cold), prepare(*warm), point=ORIGIN))
    # 12 pairs: 1 +- 0.17; sixty rows tell the line variances to a tenth.
    assert 0.6 < nees(results, TWIST) < 1.5


def test_honest_under_speckle_that_neighbours_share(make_scanner):
    scanner = make_scanner(rows=240, columns=800)
    results = list(pairs(scanner, TWIST, 24, speckle=4.0))
    # 24 pairs: 1 +- 0.12.
    assert 0.7 < nees(results, TWIST) < 1.35
    assert nees(results, TWIST, scanner.bound()) > 5


def outliers(rng, z):
    wrong = rng.random(z.shape) < 0.05
    z[wrong] += rng.normal(0, 50e-6, wrong.sum()).astype(np.float32)
    return z


def speckles_missing(rng, z):
    z[rng.random(z.shape) < 0.05] = np.nan
    return z


def blobs_missing(rng, z):
    rows, columns = np.mgrid[: z.shape[0], : z.shape[1]]
    while np.isnan(z).mean() < 0.05:
        r, c, radius = rng.uniform(0, z.shape[0]), rng.uniform(0, z.shape[1]), rng.uniform(0.3e-3, 1.2e-3)
        z[((rows - r) * 70e-6) ** 2 + ((columns - c) * 12.5e-6) ** 2 < radius**2] = np.nan
    return z


@pytest.mark.slow
@pytest.mark.parametrize("spoil", [outliers, speckles_missing, blobs_missing])
def test_dirt_costs_little(scanner, spoil):
    results = list(pairs(scanner, TWIST, 10, spoil=spoil))
    # Errors at most 1.3 of the bound of clean scans, and honest.
    assert nees(results, TWIST, scanner.bound()) ** 0.5 < 1.3
    assert nees(results, TWIST) < 1.5


@pytest.mark.parametrize(
    "twist", [[2e-3, -1.4e-3, 0.3e-3, 0.02, -0.03, 0.03], [0, 2e-3, 0, 0.05, 0, 0], [-1e-3, 0, 1e-3, 0, 0.02, -0.05]]
)
def test_large_motions_are_found(scanner, twist):
    rng = np.random.default_rng(5)
    found = register(prepare(*scanner.scan(rng)), prepare(*scanner.scan(rng, poses.displaced(twist))), point=ORIGIN)
    assert chi2(found, np.array(twist)) < RARE


def test_swapped_scans_give_the_inverse(scanner, motion):
    rng = np.random.default_rng(6)
    cold, warm = prepare(*scanner.scan(rng)), prepare(*scanner.scan(rng, motion))
    there, back = register(cold, warm, point=ORIGIN), register(warm, cold, point=ORIGIN)
    # Both see the same noise, through other interpolations: far closer than their uncertainty.
    assert np.abs((there.twist + back.twist) / there.sigma).max() < 1.0


def test_twist_and_covariance_move_to_another_point(scanner, motion):
    rng = np.random.default_rng(7)
    cold, warm = prepare(*scanner.scan(rng)), prepare(*scanner.scan(rng, motion))
    lever = np.array([0.0, 0.0, 0.174])
    here, there = register(cold, warm, point=ORIGIN), register(cold, warm, point=lever)
    twist, covariance = here.at(lever)
    np.testing.assert_allclose(twist, there.twist, rtol=0, atol=1e-15)
    np.testing.assert_allclose(covariance, there.covariance, rtol=1e-9, atol=1e-24)


def test_sums_are_those_of_the_equations(make_scanner, motion):
    scanner = make_scanner(rows=80, columns=320)
    rng = np.random.default_rng(8)
    cold, warm = prepare(*scanner.scan(rng)), prepare(*scanner.scan(rng, motion))
    problem = Problem.of(cold, warm)
    sums = problem.evaluate(State.of(motion))
    P = np.stack([*np.meshgrid(warm.x, warm.y), warm.height], axis=-1)
    X, Y, Z = np.moveaxis(motion.apply(P.reshape(-1, 3)).reshape(P.shape), -1, 0)
    # FITPACK's interpolating spline has the same "not a knot" ends.
    S = RectBivariateSpline(cold.y, cold.x, cold.height, s=0)
    r = np.where(np.isfinite(sums.residual), Z - S.ev(Y, X), np.nan)
    inside = np.isfinite(r) & (np.abs(X) < cold.x[-1]) & (np.abs(Y) < cold.y[-1])
    assert inside.sum() > 300
    np.testing.assert_allclose(sums.residual[inside], r[inside], rtol=0, atol=1e-12)
    n = np.stack([-warm.slope_x, -warm.slope_y, np.ones_like(X)], axis=-1) @ motion.rotation.as_matrix().T
    Sx, Sy = -n[..., 0] / n[..., 2], -n[..., 1] / n[..., 2]
    X, Y, Z = X - cold.centre[0], Y - cold.centre[1], Z - cold.centre[2]
    J = np.stack([-Sx, -Sy, np.ones_like(X), Y + Sy * Z, -X - Sx * Z, Sx * Y - Sy * X], axis=-1)
    w = np.where(np.isfinite(sums.residual), 1 / (warm.variance + cold.variance[0, 0]), 0.0)
    np.testing.assert_allclose(sums.A, np.einsum("rc,rci,rcj->rij", w, J, J), rtol=1e-9, atol=1e-9 * w.max() * 1e-6)
    # The derivative itself: r after a small further twist.
    step = np.array([2e-6, -1e-6, 3e-6, 1e-5, -2e-5, 3e-5])
    moved = problem.evaluate(problem.stepped(State.of(motion), step)).residual - sums.residual
    both = np.isfinite(moved)
    assert np.std((moved - J @ step)[both]) < 0.02 * np.std(moved[both])


def plane(X, Y):
    return 0.1 * X - 0.05 * Y, 0.1 + 0 * X, -0.05 + 0 * X


def sphere(X, Y, radius=30e-3):
    z = np.sqrt(radius**2 - X**2 - Y**2)
    return z - radius, -X / z, -Y / z


def cylinder(X, Y, radius=30e-3):
    z = np.sqrt(radius**2 - X**2)
    return z - radius, -X / z, 0 * X


def ridges(X, Y):
    z, zx, _ = sphere(X, 0 * Y)
    return z + 0.3e-3 * np.sin(500 * X), zx + 0.15 * np.cos(500 * X), 0 * X


@pytest.mark.parametrize(
    ("surface", "names"),
    [
        (plane, {"EX", "EY", "EC"}),
        (sphere, {"EX", "EY", "EC"}),
        (cylinder, {"EX", "EY"}),
        (ridges, {"EY"}),
    ],
)
@pytest.mark.parametrize("jitter", [0.0, 0.5e-6])
def test_artefacts_that_leave_freedoms_open_are_refused_by_name(make_scanner, surface, names, jitter):
    scanner = make_scanner(surface)
    rng = np.random.default_rng(9)
    cold, warm = (prepare(*scanner.scan(rng, jitter_z=jitter)) for _ in range(2))
    with raises("registration.freedoms.undetermined") as refusal:
        register(cold, warm)
    assert {name for name in ("EX", "EY", "EZ", "EA", "EB", "EC") if name in str(refusal.value)} == names


def test_a_plane_tells_its_three_freedoms_when_asked(make_scanner):
    flat = make_scanner(lambda X, Y: (0 * X, 0 * X, 0 * X))
    twist = np.array([0, 0, 12e-6, 40e-6, -20e-6, 0])
    rng = np.random.default_rng(10)
    cold, warm = prepare(*flat.scan(rng)), prepare(*flat.scan(rng, poses.displaced(twist)))
    found = register(cold, warm, point=cold.centre, loose="report")
    assert found.loose == ("EX", "EY", "EC")
    assert np.isnan(found.sigma[[0, 1, 5]]).all()
    known = [2, 3, 4]
    error = (found.twist - poses.displacement(poses.displaced(twist), cold.centre))[known]
    assert error @ np.linalg.solve(found.covariance[np.ix_(known, known)], error) < 21.1  # chi2(3), once in 10 000


def other(X, Y):
    return 1e-3 * np.sin(450 * X - 300 * Y), 0.45 * np.cos(450 * X - 300 * Y), -0.3 * np.cos(450 * X - 300 * Y)


def two_waves(X, Y):
    z, zx, zy = other(X, Y)
    return z + 0.8e-3 * np.cos(420 * Y), zx, zy - 0.336 * np.sin(420 * Y)


def test_two_artefacts_are_no_pair(scanner, make_scanner):
    rng = np.random.default_rng(11)
    cold, warm = prepare(*scanner.scan(rng)), prepare(*make_scanner(two_waves).scan(rng))
    with raises("registration.scans.other_surface"):
        register(cold, warm)


@pytest.mark.parametrize("shift", [[5e-3, 0, 0], [0, 7e-3, 0]])
def test_a_scan_off_its_place_by_a_quarter_is_refused(scanner, shift):
    rng = np.random.default_rng(12)
    shifted = RigidTransform.from_translation(shift)
    with raises("registration.motion.too_large"):
        register(prepare(*scanner.scan(rng)), prepare(*scanner.scan(rng, shifted)))


def test_unknown_backends_are_refused(scanner):
    block_map = prepare(*scanner.scan(np.random.default_rng(0)))
    with raises("registration.unknown"):
        register(block_map, block_map, registration="icp")


def test_what_an_artefact_tells_is_the_sum_over_its_blocks(scanner):
    found = prepare(*scanner.scan(np.random.default_rng(13)))
    some = slice(2, None, 4)
    X, Y = np.meshgrid(found.x[some] - found.centre[0], found.y[some] - found.centre[1])
    Z, Sx, Sy = found.height[some, some] - found.centre[2], found.slope_x[some, some], found.slope_y[some, some]
    J = np.stack([-Sx, -Sy, np.ones_like(X), Y + Sy * Z, -X - Sx * Z, Sx * Y - Sy * X, -Sx * Y]).reshape(7, -1)
    terms = Extra.of({"feed_x": np.inf})
    of_slopes, of_noise = found.moments.information(terms.motions)
    np.testing.assert_allclose(of_slopes, J @ J.T, rtol=1e-12, atol=1e-12)
    # What noise of the slopes adds on average, here for the motion across along x, and the turn about z.
    assert of_noise[0, 0] == X.size
    assert of_noise[5, 5] == pytest.approx(np.sum(X**2 + Y**2))
    assert of_noise[6, 6] == pytest.approx(np.sum(Y**2))


def test_one_thread_and_several_and_array_operations_add_up_the_same(scanner, motion, monkeypatch):
    rng = np.random.default_rng(14)
    problem = Problem.of(prepare(*scanner.scan(rng)), prepare(*scanner.scan(rng, motion)))
    plain = problem.evaluate(State.of(motion))  # by array operations
    problem = replace(problem, cold=replace(problem.cold, compiled=True))
    alone = problem.evaluate(State.of(motion))
    np.testing.assert_allclose(plain.residual, alone.residual, rtol=0, atol=1e-15)
    np.testing.assert_allclose(plain.weight, alone.weight, rtol=1e-9)
    np.testing.assert_allclose(plain.A.sum(axis=0), alone.A.sum(axis=0), rtol=1e-9)
    monkeypatch.setattr(kernels, "MANY", 0)
    monkeypatch.setattr(compiling, "threads", lambda: 3)
    shared = problem.evaluate(State.of(motion))
    np.testing.assert_array_equal(shared.residual, alone.residual)
    np.testing.assert_allclose(shared.A, alone.A, rtol=1e-12)


def test_neighbours_are_multiplied_within_the_map():
    rng = np.random.default_rng(15)
    residual, weight = rng.standard_normal((2, 7, 9))
    weight = np.where(rng.random(weight.shape) < 0.2, 0.0, weight**2)
    residual[weight == 0] = np.nan
    r, known = np.sqrt(weight) * np.nan_to_num(residual), weight > 0
    sums, pairs = lag_sums(residual, weight, 2)
    for i in range(3):
        for j in range(-2, 3):
            there = [
                (r[p, q] * r[p + i, q + j], known[p, q] and known[p + i, q + j])
                for p in range(7 - i)
                for q in range(max(-j, 0), min(9 - j, 9))
            ]
            assert sums[i, j + 2] == pytest.approx(sum(product for product, _ in there), rel=1e-12, abs=1e-12)
            assert pairs[i, j + 2] == sum(both for _, both in there)
