"""Scans that people mix up, cut off or write in other units: refused with what to do, or solved honestly."""

import numpy as np
import pytest
from coded import raises
from scipy.spatial.transform import RigidTransform

from errormotion.errors import MethodError
from errormotion.kinematics import poses
from errormotion.methods.crossbeam_scan.identification.registration import prepare, register

TWIST = np.array([23e-6, -41e-6, 17e-6, 30e-6, -55e-6, 80e-6])
RARE = 27.9
"""Chi squared of six freedoms is larger once in 10 000 times."""


@pytest.fixture
def pair(scanner):
    """Return a cold and a warm scan as the sensor gives them: heights, x, y."""
    rng = np.random.default_rng(31)
    return scanner.scan(rng), scanner.scan(rng, poses.displaced(TWIST))


def solved(cold, warm):
    """Return chi squared of the motion found."""
    found = register(prepare(*cold), prepare(*warm), point=np.zeros(3))
    error = found.twist - TWIST
    return error @ np.linalg.solve(found.covariance, error)


def test_a_flat_artefact_is_refused_with_the_freedoms_it_leaves(make_scanner):
    rng = np.random.default_rng(32)
    scanner = make_scanner(lambda X, Y: (0 * X, 0 * X, 0 * X))
    with raises("registration.freedoms.undetermined"):
        register(*(prepare(*scanner.scan(rng)) for _ in range(2)))


def test_a_scan_off_by_a_quarter_of_the_artefact_is_refused(scanner):
    rng = np.random.default_rng(33)
    off = RigidTransform.from_translation([0, scanner.y.size * 70e-6 / 4, 0])
    with raises("registration.motion.too_large"):
        register(prepare(*scanner.scan(rng)), prepare(*scanner.scan(rng, off)))


def test_a_scan_cut_a_quarter_later_is_solved_where_its_places_say_so(pair):
    cold, (z, x, y) = pair
    assert solved(cold, (z[100:], x, y[100:])) < RARE


@pytest.mark.parametrize("shift", [0.0, 0.05])
def test_the_same_cut_with_places_counted_from_its_own_start_is_refused(pair, shift):
    cold, (z, x, y) = pair
    with pytest.raises(MethodError, match="at the same position"):
        solved(cold, (z[100:], x, y[:300] + shift))


def test_places_in_millimetres_are_reported(pair):
    (z, x, y), _ = pair
    with pytest.raises(MethodError, match=r"millimetres.*divide by 1000"):
        prepare(z * 1e3, x * 1e3, y * 1e3)


@pytest.mark.parametrize("scale", [1e3, 1e-3])
def test_heights_in_another_unit_are_refused(pair, scale):
    cold, (z, x, y) = pair
    with pytest.raises(MethodError, match=r"same units|in metres|undetermined"):
        solved(cold, (z * np.float32(scale), x, y))


def test_a_feed_that_turned_back_is_refused(pair):
    (z, x, y), _ = pair
    back = np.concatenate([y[:250], y[100:250]])
    with pytest.raises(MethodError, match=r"expected y to rise.*index 250.*encoder"):
        prepare(z, x, back)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_reversed_places_are_refused(pair, axis):
    (z, x, y), _ = pair
    with pytest.raises(MethodError, match=f"expected {axis} to rise"):
        prepare(z, x[::-1] if axis == "x" else x, y[::-1] if axis == "y" else y)


def test_a_mirrored_profile_is_not_the_same_artefact(pair):
    cold, (z, x, y) = pair
    with raises("registration.scans.other_surface"):
        solved(cold, (z[:, ::-1], x, y))


def test_half_a_file_needs_its_own_places(pair):
    (z, x, y), _ = pair
    with raises("registration.heights.shape"):
        prepare(z[:200], x, y)


def test_half_of_the_profiles_are_solved_with_what_they_tell(pair):
    cold, (z, x, y) = pair
    whole = register(prepare(*cold), prepare(z, x, y))
    half = register(prepare(*cold), prepare(z[:200], x, y[:200]))
    assert solved(cold, (z[:200], x, y[:200])) < RARE
    # Half as many points tell a shift at best worse by the root of two, a turn about x by its cube.
    assert (half.sigma > 1.2 * whole.sigma).all()


def test_profiles_without_a_value_count_for_nothing(pair):
    cold, (z, x, y) = pair
    z = z.copy()
    z[170:] = np.nan
    assert solved(cold, (z, x, y)) < RARE
    assert register(prepare(*cold), prepare(z, x, y)).points <= 170 * x.size


def test_single_lost_profiles_are_no_harm(pair):
    cold, (z, x, y) = pair
    z = z.copy()
    z[3::7] = np.nan
    assert solved(cold, (z, x, y)) < RARE


def test_hardly_any_profile_is_refused(pair):
    (z, x, y), _ = pair
    z = np.where(np.arange(y.size)[:, None] < 3, z, np.nan)
    with raises("registration.heights.missing"):
        prepare(z, x, y)
