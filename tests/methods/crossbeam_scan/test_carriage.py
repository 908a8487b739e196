"""Errors of the carriage from registrations: what comes back, what it is worth, and what the values have in common."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from errormotion.kinematics.twists import transform
from errormotion.methods.crossbeam_scan.identification import chain, strain
from errormotion.methods.crossbeam_scan.identification.carriage import Rig, carriage, cold_influence
from errormotion.methods.crossbeam_scan.identification.profiler_pose import calibration
from errormotion.methods.crossbeam_scan.identification.registrations import QUALITY, Registrations
from errormotion.methods.crossbeam_scan.planning import registration_covariance
from errormotion.methods.crossbeam_scan.settings import Settings

TIMES = np.array([0.0, 1800.0, 7200.0])
PLACES = np.array([-0.6, -0.2, 0.2, 0.6])
#: one registration with line jitter, of an artefact as a plan assumes it
COVARIANCE = registration_covariance(Settings())
POSE_COVARIANCE = np.diag([1e-3, 1e-3, 1e-3, 1e-5, 1e-5, 1e-5]) ** 2
LEVER_UNCERTAINTY = np.full(3, 1e-3)
SHARE = 0.5


@pytest.fixture
def rig(gantry):
    """True pose and lever, with uncertainties of 1 mrad, 10 um and 1 mm."""
    pose = RigidTransform.from_matrix(gantry.crossbeam.pose)
    return Rig(pose, gantry.crossbeam.lever, POSE_COVARIANCE, LEVER_UNCERTAINTY)


def true_maps(crossbeam, times=TIMES):
    """Return perfect registrations, (cycle, artefact, 9): the motion of the profiler and its drift."""
    pose, lever = RigidTransform.from_matrix(crossbeam.pose), crossbeam.lever
    to_profiler = np.linalg.inv(chain.carriage_adjoint(pose, lever))
    at = crossbeam.twist(times[:, None], PLACES)
    slope = (crossbeam.twist(times[:, None], PLACES + 1e-3) - crossbeam.twist(times[:, None], PLACES - 1e-3)) / 2e-3
    motion = np.concatenate([transform(at, to_profiler), transform(slope, to_profiler)[..., :3]], axis=-1)
    return motion @ np.linalg.inv(strain.from_maps(pose)).T


def registrations(maps, rng=None, noise=COVARIANCE):
    """Return registrations of all cycles on the first: without noise, or with; half of its variance is the cold scan's.

    Cycle 0 is the reference, zero and exact.
    """
    cycles, artefacts = maps.shape[:2]
    twist = maps - maps[:1]
    if rng is not None:
        cold, own = rng.multivariate_normal(np.zeros(9), noise, (2, cycles, artefacts))
        twist = twist + np.sqrt(SHARE) * cold[:1] + np.sqrt(1 - SHARE) * own
        twist[0] = 0.0
    C, share = np.tile(noise, (cycles, artefacts, 1, 1)), np.full((cycles, artefacts), SHARE)
    C[0], share[0] = 0.0, 0.0
    quality = {name: np.zeros((cycles, artefacts)) for name in QUALITY}
    return Registrations(
        cold=np.zeros(artefacts, dtype=int),
        twist=twist,
        covariance=C,
        cold_share=share,
        bound=np.tile(0.5 * noise, (artefacts, 1, 1)),
        reason=np.full((cycles, artefacts), "", dtype=object),
        quality=quality,
        time=np.tile(TIMES[:, None], (1, artefacts)),
    )


def drawn(rig, rng):
    """Return a rig whose pose and lever are off by their uncertainty."""
    p = calibration.parameters(rig.pose) + rng.multivariate_normal(np.zeros(6), rig.pose_covariance)
    return replace(rig, pose=calibration.pose(*p), lever=rig.lever + rng.normal(0, rig.lever_uncertainty))


def nees(miss, C):
    """Return chi-squared of each twist over its six freedoms."""
    unit = np.array([1e-6] * 6)
    return np.array([m @ np.linalg.solve(c / np.outer(unit, unit), m) / 6 for m, c in zip(miss / unit, C, strict=True)])


def total(found, weights):
    """Return value and covariance of a sum of weights (cycle, artefact) times errors, by what the values share."""
    cold = found.influence[len(chain.SOURCES) :]
    independent = found.covariance - np.einsum("stki,stkj->tkij", cold, cold)
    F = np.einsum("stki,tk->si", found.influence, weights)
    value = np.einsum("tki,tk->i", found.values, weights)
    return value, np.einsum("tkij,tk->ij", independent, weights**2) + F.T @ F


@pytest.mark.parametrize("guide", [None, 1e-6])
def test_perfect_registrations_give_the_true_errors(gantry, rig, guide):
    found = carriage(registrations(true_maps(gantry.crossbeam)), PLACES, rig, guide=guide)
    # all is linear; the guide of the twin bends as the spline does
    assert found.values == pytest.approx(gantry.crossbeam.twist(TIMES[:, None], PLACES), abs=1e-10)
    assert not found.values[0].any()
    assert not found.covariance[0].any()
    assert not found.influence[:, 0].any()


@pytest.mark.parametrize("guide", [None, 1e-6])
def test_truth_lies_within_the_stated_uncertainty(gantry, rig, guide):
    maps, truth = true_maps(gantry.crossbeam), gantry.crossbeam.twist(TIMES[:, None], PLACES)
    rng = np.random.default_rng(1)
    squares = []
    for _ in range(50):
        found = carriage(registrations(maps, rng), PLACES, drawn(rig, rng), guide=guide)
        rig_share = found.influence[: len(chain.SOURCES)]
        C = found.covariance + np.einsum("stki,stkj->tkij", rig_share, rig_share)
        squares.append(nees((found.values - truth)[1:].reshape(-1, 6), C[1:].reshape(-1, 6, 6)).mean())
    # 50 campaigns of 4 artefacts by 6 freedoms in 2 cycles of which half the noise is common: 1 +- 0.03
    if guide is None:
        assert np.mean(squares) == pytest.approx(1, abs=0.12)
    else:  # that the carriage follows its guide to 1 urad is a prior: the twin does so exactly
        assert 0.6 < np.mean(squares) < 1.1


def difference(gantry, rig, first, second, maps, noise, draws=120):
    """Return NEES/6 of a difference of two values with their correlation, and without it."""
    weights = np.zeros((len(TIMES), len(PLACES)))
    weights[first], weights[second] = 1.0, -1.0
    known, _ = total(carriage(registrations(maps), PLACES, rig, guide=None), weights)
    rng = np.random.default_rng(2)
    squares = []
    for _ in range(draws):
        found = carriage(registrations(maps, rng, noise), PLACES, drawn(rig, rng), guide=None)
        value, C = total(found, weights)
        alone = sum(total(found, np.abs(w) * (weights == w))[1] for w in (1.0, -1.0))
        squares.append(nees([value - known] * 2, [C, alone]))
    return np.mean(squares, axis=0)


def test_values_at_two_times_share_the_cold_scan(gantry, rig):
    shared, apart = difference(gantry, rig, (2, 1), (1, 1), true_maps(gantry.crossbeam), COVARIANCE)
    # 120 draws of 6: 1 +- 0.05; half of the variance is common and falls out of the difference
    assert shared == pytest.approx(1, abs=0.16)
    assert apart < 0.7


@pytest.mark.slow
def test_values_at_two_positions_share_pose_and_lever(gantry, rig):
    shared, _ = difference(gantry, rig, (2, 0), (2, 3), true_maps(gantry.crossbeam), 1e-6 * COVARIANCE)
    assert shared == pytest.approx(1, abs=0.16)
    alike = np.repeat(true_maps(gantry.crossbeam)[:, 1:2], len(PLACES), axis=1)
    shared, apart = difference(gantry, rig, (2, 0), (2, 3), alike, 1e-6 * COVARIANCE)
    # where the axis moves alike at both, a wrong pose does the same to both
    assert shared == pytest.approx(1, abs=0.16)
    assert apart < 0.5


def test_influence_of_pose_and_lever_equals_evaluation_with_changed_values(gantry, rig):
    noisy = registrations(true_maps(gantry.crossbeam), np.random.default_rng(3))
    found = carriage(noisy, PLACES, rig, guide=None)
    for k, (pose, lever) in enumerate(list(zip(*rig.changed(), strict=True))[: len(chain.SOURCES)]):
        again = carriage(noisy, PLACES, replace(rig, pose=pose, lever=lever), guide=None)
        # second order: 1 mrad squared of 30 urad, over 2.2 m
        assert again.values - found.values == pytest.approx(found.influence[k], abs=1e-10)
    assert np.abs(found.influence[: len(chain.SOURCES)]).max() > 1e-8


def test_exact_quantities_add_no_uncertainty(gantry, rig):
    exact = replace(rig, pose_covariance=None, lever_uncertainty=np.zeros(3))
    found = carriage(registrations(true_maps(gantry.crossbeam)), PLACES, exact, guide=None)
    assert not found.influence[: len(chain.SOURCES)].any()


@pytest.mark.parametrize("guide", [None, 1e-6])
def test_only_a_missing_registration_is_nan(gantry, rig, guide):
    whole = registrations(true_maps(gantry.crossbeam), np.random.default_rng(4))
    lacking = replace(whole, twist=whole.twist.copy(), covariance=whole.covariance.copy())
    lacking.twist[1, 1], lacking.covariance[1, 1] = np.nan, np.nan
    found, all_there = (carriage(one, PLACES, rig, guide=guide) for one in (lacking, whole))
    gone = np.zeros(found.values.shape[:2], dtype=bool)
    gone[1, 1] = True
    for name in ("values", "covariance", "drift", "profiler"):
        there = np.isfinite(getattr(found, name)).reshape(*gone.shape, -1)
        np.testing.assert_array_equal(there, np.repeat(~gone[..., None], there.shape[-1], axis=-1))
    assert np.isnan(found.influence[:, 1, 1]).all()
    others = ~gone if guide is None else np.tile([[True], [False], [True]], 4)  # the guide joins what is of one cycle
    np.testing.assert_array_equal(found.values[others], all_there.values[others])
    miss = np.abs(found.values - gantry.crossbeam.twist(TIMES[:, None], PLACES))
    u = np.sqrt(np.diagonal(found.covariance, axis1=-2, axis2=-1))
    assert np.all(miss[~gone] <= 5 * u[~gone])


def test_artefact_without_a_cold_scan_is_unknown_and_affects_no_other(gantry, rig):
    whole = registrations(true_maps(gantry.crossbeam), np.random.default_rng(5))
    whole.cold[1] = -1
    whole.twist[:, 1], whole.covariance[:, 1], whole.bound[1] = np.nan, np.nan, np.nan
    whole.cold_share[:, 1] = np.nan
    found = carriage(whole, PLACES, rig, guide=1e-6)
    assert np.isnan(found.values[:, 1]).all()
    assert np.isnan(found.predicted[1]).all()
    assert np.isfinite(np.delete(found.values, 1, axis=1)).all()
    assert np.isfinite(np.delete(found.predicted, 1, axis=0)).all()


def test_guide_improves_the_least_determined_freedoms_most(gantry, rig):
    noisy = registrations(true_maps(gantry.crossbeam), np.random.default_rng(6))
    free, guided = (carriage(noisy, PLACES, rig, guide=guide) for guide in (None, 1e-6))
    u = [np.sqrt(np.diagonal(one.covariance[2, 1])) for one in (free, guided)]
    assert np.all(u[1] <= u[0] * (1 + 1e-9))
    # pitch of a line over its relief of millimetres, and what 2.2 m of lever make of it
    assert u[1][3] < 0.5 * u[0][3]
    assert u[1][1] < 0.5 * u[0][1]
    # the bound, here half of the covariance, stays below what is stated
    assert np.all(np.linalg.eigvalsh(guided.covariance[2, 1] - guided.predicted[1]) > 0)


def test_guide_that_the_carriage_does_not_follow_causes_errors(gantry, rig):
    # 20 urad of pitch of its own against a stated 1 urad
    wild = replace(gantry.crossbeam, own=20e-6 * np.eye(6)[3])
    noisy, truth = registrations(true_maps(wild), np.random.default_rng(7)), wild.twist(TIMES[:, None], PLACES)
    pitch = {}
    for guide in (None, 1e-6):
        found = carriage(noisy, PLACES, rig, guide=guide)
        u = np.sqrt(np.diagonal(found.covariance, axis1=-2, axis2=-1))
        pitch[guide] = np.abs(found.values - truth)[2, :, 3] / u[2, :, 3]
    assert pitch[None].max() < 4
    assert pitch[1e-6].min() > 4


def test_cold_scans_never_influence_more_than_the_variance(gantry):
    """One freedom is known a million times better than the others, and the whole noise is that of the cold scan."""
    size = np.array([1e-9, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3])
    found = registrations(true_maps(gantry.crossbeam))
    found = replace(found, cold_share=np.ones_like(found.cold_share))
    covariance = np.tile(np.diag(size**2), (*found.cold_share.shape, 1, 1))
    shared = np.sum(cold_influence(covariance, found) ** 2, axis=0)
    assert np.all(shared <= size**2 * (1 + 1e-12))
    assert np.allclose(shared, size**2, rtol=1e-6)
