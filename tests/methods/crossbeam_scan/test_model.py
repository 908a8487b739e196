"""Errors of the carriage from registrations: what comes back, what it is worth, and what the values have in common."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from errormotion.kinematics.twists import transform
from errormotion.measurement.drawing import independent_draws, moved
from errormotion.measurement.identification import solve
from errormotion.methods.crossbeam_scan.identification import chain, model
from errormotion.methods.crossbeam_scan.identification.chain import Rig, from_maps
from errormotion.methods.crossbeam_scan.identification.model import Campaign, slopes
from errormotion.methods.crossbeam_scan.identification.profiler_pose import calibration
from errormotion.methods.crossbeam_scan.identification.registrations import Registrations
from errormotion.methods.crossbeam_scan.planning import registration_covariance
from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings

TIMES = np.array([0.0, 1800.0, 7200.0])
PLACES = np.array([-0.6, -0.2, 0.2, 0.6])
#: one registration with line jitter, of an artefact as a plan assumes it, and its errors by strains
COVARIANCE, EFFECT = registration_covariance(CrossbeamScanSettings())
POSE_COVARIANCE = np.diag([1e-3, 1e-3, 1e-3, 1e-5, 1e-5, 1e-5]) ** 2
LEVER_UNCERTAINTY = np.full(3, 1e-3)
SHARE = 0.5
STRAINS = np.full(4, 20e-6)
RIG = (model.POSE, model.LEVER)


@pytest.fixture
def rig(gantry):
    """True pose and lever, with uncertainties of 1 mrad, 10 um and 1 mm."""
    pose = RigidTransform.from_matrix(gantry.crossbeam.pose)
    return Rig(pose, gantry.crossbeam.lever, POSE_COVARIANCE, LEVER_UNCERTAINTY)


def true_maps(crossbeam, times=TIMES, places=PLACES):
    """Return perfect registrations, (cycle, artefact, 9): the motion of the profiler and its drift."""
    pose, lever = RigidTransform.from_matrix(crossbeam.pose), crossbeam.lever
    to_profiler = np.linalg.inv(chain.carriage_adjoint(pose, lever))
    at = crossbeam.twist(times[:, None], places)
    slope = (crossbeam.twist(times[:, None], places + 1e-3) - crossbeam.twist(times[:, None], places - 1e-3)) / 2e-3
    motion = np.concatenate([transform(at, to_profiler), transform(slope, to_profiler)[..., :3]], axis=-1)
    return motion @ np.linalg.inv(from_maps(pose)).T


def registrations(maps, rng=None, noise=COVARIANCE, share=SHARE):
    """Return registrations of all cycles on the first: without noise, or with, of which the cold scan has a share."""
    shape = maps.shape[:2]
    twist = maps - maps[:1]
    if rng is not None:
        cold, own = rng.multivariate_normal(np.zeros(9), noise, (2, *shape))
        twist = twist + np.sqrt(share) * cold[:1] + np.sqrt(1 - share) * own
        twist[0] = 0.0
    known = (np.arange(shape[0]) > 0)[:, None]
    return replace(
        Registrations.empty(*shape, cold=0),
        twist=twist,
        covariance=np.tile(noise, (*shape, 1, 1)) * known[..., None, None],
        effect=np.tile(EFFECT, (*shape, 1, 1)),
        cold_share=np.broadcast_to(share * known, shape),
        bound=np.tile(0.5 * noise, (shape[1], 1, 1)),
    )


def campaign(found, rig, guide=None, strains=0.0 * STRAINS, height=0.05, places=PLACES):
    return Campaign(found, places, rig, guide, strains, height)


def carriage(found, rig, **options):
    """Return errors, their covariance, that by the registrations, and the influence by group, in (cycle, artefact)."""
    of = campaign(found, rig, **options)
    solved = solve(of.observed(coords={}, reference=""))
    errors = solved.relative.errors
    shape = (*of.shape, 6)
    influence = {}
    for source in errors.sources:
        influence.setdefault(source.group, []).append(source.effect.reshape(shape))
    known = of.determined
    return SimpleNamespace(
        values=errors.value.reshape(shape),
        covariance=np.where(known[..., None, None], errors.covariance.reshape(*shape, 6), np.nan),
        own=errors.own.reshape(*shape, 6),
        registered=of.of_registrations(solved),
        influence={group: np.array(effects) for group, effects in influence.items()},
        of=of,
        solved=solved,
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
    F = np.einsum("stki,tk->si", np.concatenate(list(found.influence.values())), weights)
    value = np.einsum("tki,tk->i", found.values, weights)
    return value, np.einsum("tkij,tk->ij", found.own, weights**2) + F.T @ F


@pytest.mark.parametrize("guide", [None, 1e-6])
def test_perfect_registrations_give_the_true_errors(gantry, rig, guide):
    found = carriage(registrations(true_maps(gantry.crossbeam)), rig, guide=guide)
    # all is linear; the guide of the twin bends as the spline does
    assert found.values == pytest.approx(gantry.crossbeam.twist(TIMES[:, None], PLACES), abs=1e-10)
    assert not found.values[0].any()
    assert not found.covariance[0].any()
    assert not any(effects[:, 0].any() for effects in found.influence.values())


@pytest.mark.parametrize("guide", [None, 1e-6])
def test_derivatives_by_what_is_known_are_those_of_the_equation(gantry, rig, guide):
    observed = campaign(registrations(true_maps(gantry.crossbeam)), rig, guide=guide, strains=STRAINS).observed(
        coords={}, reference=""
    )
    by_differences = replace(observed.problem, derivatives=None, constant_derivatives=None)
    given, found = (solve(one).relative.errors for one in (observed, replace(observed, problem=by_differences)))
    assert given.covariance == pytest.approx(found.covariance, rel=1e-6, abs=1e-22)
    for group in (*RIG, model.COLD, model.SCALE, model.MOUNT, model.EXPANSION):
        one, other = ([source.effect for source in each.sources if source.group == group] for each in (given, found))
        assert np.array(one) == pytest.approx(np.array(other), abs=1e-14)


@pytest.mark.parametrize("guide", [None, 1e-6])
def test_truth_lies_within_the_stated_uncertainty(gantry, rig, guide):
    """Registrations, pose, lever and strains are drawn; with a guide, the carriage leaves it as much as stated."""
    maps, truth = true_maps(gantry.crossbeam), gantry.crossbeam.twist(TIMES[:, None], PLACES)
    rng = np.random.default_rng(1)
    squares = []
    for _ in range(30):
        off = np.zeros((len(TIMES), len(PLACES), 6))
        if guide is not None:
            off[1:, :, [3, 5]] = rng.normal(0, guide, (len(TIMES) - 1, len(PLACES), 2))
        to_maps = np.linalg.inv(chain.carriage_adjoint(rig.pose, rig.lever) @ from_maps(rig.pose)[:6, :6])
        seen = maps.copy()
        seen[..., :6] += transform(off, to_maps)
        found = registrations(seen, rng)
        along, across, mount = np.tile(rng.normal(0, 20e-6, (3, len(TIMES), 1)), (1, 1, len(PLACES)))
        strain = np.stack([along, across, rng.normal(0, 20e-6, mount.shape), mount], axis=-1)
        strain[0] = 0.0
        true = campaign(found, rig, strains=STRAINS)
        found = replace(found, twist=found.twist.copy())
        found.twist[..., :6] += np.einsum("ckis,cks->cki", true.effect, strain)
        found = carriage(found, drawn(rig, rng), guide=guide, strains=STRAINS)
        squares.append(
            nees((found.values - truth - off)[1:].reshape(-1, 6), found.covariance[1:].reshape(-1, 6, 6)).mean()
        )
    # 30 campaigns of 4 artefacts by 6 freedoms in 2 cycles of which half the noise is common: 1 +- 0.04
    assert np.mean(squares) == pytest.approx(1, abs=0.15)


def difference(gantry, rig, first, second, maps, noise, draws=60):
    """Return NEES/6 of a difference of two values with their correlation, and without it."""
    weights = np.zeros((len(TIMES), len(PLACES)))
    weights[first], weights[second] = 1.0, -1.0
    known, _ = total(carriage(registrations(maps), rig), weights)
    rng = np.random.default_rng(2)
    squares = []
    for _ in range(draws):
        found = carriage(registrations(maps, rng, noise), drawn(rig, rng))
        value, C = total(found, weights)
        alone = sum(total(found, np.abs(w) * (weights == w))[1] for w in (1.0, -1.0))
        squares.append(nees([value - known] * 2, [C, alone]))
    return np.mean(squares, axis=0)


def test_values_at_two_times_share_the_cold_scan(gantry, rig):
    shared, apart = difference(gantry, rig, (2, 1), (1, 1), true_maps(gantry.crossbeam), COVARIANCE)
    # 60 draws of 6: 1 +- 0.07; half of the variance is common and falls out of the difference
    assert shared == pytest.approx(1, abs=0.22)
    assert apart < 0.75


@pytest.mark.slow
def test_values_at_two_positions_share_pose_and_lever(gantry, rig):
    shared, _ = difference(gantry, rig, (2, 0), (2, 3), true_maps(gantry.crossbeam), 1e-6 * COVARIANCE, draws=120)
    assert shared == pytest.approx(1, abs=0.16)
    alike = np.repeat(true_maps(gantry.crossbeam)[:, 1:2], len(PLACES), axis=1)
    shared, apart = difference(gantry, rig, (2, 0), (2, 3), alike, 1e-6 * COVARIANCE, draws=120)
    # where the axis moves alike at both, a wrong pose does the same to both
    assert shared == pytest.approx(1, abs=0.16)
    assert apart < 0.5


@pytest.mark.parametrize("guide", [None, 1e-6])
def test_influence_of_every_source_equals_a_solution_with_changed_values(gantry, rig, guide):
    # without residuals, which the derivatives of a fit neglect
    exact = registrations(true_maps(gantry.crossbeam))
    observed = campaign(exact, rig, guide=guide, strains=STRAINS).observed(coords={}, reference="")
    errors = solve(observed).relative.errors
    problem, seen = observed.problem, set()
    for group, count in independent_draws(problem).items():
        effects = np.array([source.effect for source in errors.sources if source.group == group])
        assert len(effects) == count
        for k in {0, count - 1}:
            ends = [moved(problem, problem.readings, {group: sign * np.eye(count)[k]}) for sign in (1.0, -1.0)]
            up, down = (solve(replace(observed, problem=end)).relative.errors.value for end in ends)
            # third order: 1 mrad cubed of 30 urad, over 2.2 m
            assert (up - down) / 2 == pytest.approx(effects[k], abs=1e-12 + 1e-5 * np.abs(effects[k]).max())
        seen |= {group} if np.abs(effects).max() > 1e-9 else set()
    assert seen == {model.POSE, model.LEVER, model.COLD, model.SCALE, model.EXPANSION, model.MOUNT}


def test_artefact_and_mount_that_expand_displace_the_surface_by_their_length(gantry, rig):
    of = campaign(registrations(true_maps(gantry.crossbeam)), rig, strains=STRAINS, height=0.08)
    found = carriage(of.registrations, rig, strains=STRAINS, height=0.08)
    flat = carriage(of.registrations, rig, strains=STRAINS, height=0.0)
    grown = found.influence[model.EXPANSION].sum(axis=0) - flat.influence[model.EXPANSION].sum(axis=0)
    # 20 um/m of 80 mm, along the line of sight. The strain of a larger warm artefact is negative: it makes it as
    # small as the cold one. With a larger strain, more of the reading is not a motion of the profiler.
    up = rig.pose.rotation.apply([0.0, 0.0, 1.0])
    assert grown[1:, :, :3] == pytest.approx(np.tile(-1.6e-6 * up, (2, 4, 1)), abs=1e-12)
    assert grown[..., 3:] == pytest.approx(0, abs=1e-15)
    mount = found.influence[model.MOUNT].sum(axis=0)[1:]
    assert mount[..., :3] == pytest.approx(np.tile(-20e-6 * rig.pose.translation, (2, 4, 1)), abs=1e-12)
    assert mount[..., 3:] == pytest.approx(0, abs=1e-15)


def test_exact_quantities_add_no_uncertainty(gantry, rig):
    exact = replace(rig, pose_covariance=None, lever_uncertainty=np.zeros(3))
    found = carriage(registrations(true_maps(gantry.crossbeam)), exact)
    assert set(found.influence) == {model.COLD}


@pytest.mark.parametrize("guide", [None, 1e-6])
def test_only_a_missing_registration_is_nan(gantry, rig, guide):
    whole = registrations(true_maps(gantry.crossbeam), np.random.default_rng(4))
    lacking = replace(whole, twist=whole.twist.copy(), covariance=whole.covariance.copy())
    lacking.twist[1, 1], lacking.covariance[1, 1] = np.nan, np.nan
    found, all_there = (carriage(one, rig, guide=guide) for one in (lacking, whole))
    gone = np.zeros(found.values.shape[:2], dtype=bool)
    gone[1, 1] = True
    for array in (found.values, found.covariance, found.registered):
        there = np.isfinite(array).reshape(*gone.shape, -1)
        np.testing.assert_array_equal(there, np.repeat(~gone[..., None], there.shape[-1], axis=-1))
    others = ~gone if guide is None else np.zeros_like(gone)  # the guide couples what shares a cold scan
    np.testing.assert_allclose(found.values[others], all_there.values[others], rtol=0, atol=1e-15)
    miss = np.abs(found.values - gantry.crossbeam.twist(TIMES[:, None], PLACES))
    u = np.sqrt(np.diagonal(found.covariance, axis1=-2, axis2=-1))
    assert np.all(miss[~gone] <= 5 * u[~gone])


def test_artefact_without_a_cold_scan_is_unknown_and_affects_no_other(gantry, rig):
    whole = registrations(true_maps(gantry.crossbeam), np.random.default_rng(5))
    whole.cold[1] = -1
    whole.twist[:, 1], whole.covariance[:, 1], whole.bound[1] = np.nan, np.nan, np.nan
    found = carriage(whole, rig, guide=1e-6)
    assert np.isnan(found.values[:, 1]).all()
    assert np.isnan(found.of.predicted()[1]).all()
    assert np.isfinite(np.delete(found.values, 1, axis=1)).all()
    assert np.isfinite(np.delete(found.of.predicted(), 1, axis=0)).all()


def test_guide_improves_the_least_determined_freedoms_most(gantry, rig):
    noisy = registrations(true_maps(gantry.crossbeam), np.random.default_rng(6))
    free, guided = (carriage(noisy, rig, guide=guide) for guide in (None, 1e-6))
    u = [np.sqrt(np.diagonal(one.registered[2, 1])) for one in (free, guided)]
    assert np.all(u[1] <= u[0] * (1 + 1e-9))
    # pitch of a line over its relief of millimetres, and what 2.2 m of lever make of it
    assert u[1][3] < 0.5 * u[0][3]
    assert u[1][1] < 0.5 * u[0][1]
    # the bound is that of half of the covariance
    assert np.all(np.diag(guided.of.predicted()[1]) < np.diag(guided.registered[2, 1]))


@pytest.mark.parametrize("guide", [0.1e-6, 1e-6])
def test_carriage_with_a_pitch_of_its_own_contradicts_its_guide(gantry, rig, guide):
    wild = replace(gantry.crossbeam, own=60e-6 * np.eye(6)[3])
    noisy, truth = registrations(true_maps(wild), np.random.default_rng(7)), wild.twist(TIMES[:, None], PLACES)
    found = {each: carriage(noisy, rig, guide=each) for each in (None, guide)}
    pitch = {
        each: np.abs(one.values - truth)[2, :, 3] / np.sqrt(one.covariance[2, :, 3, 3]) for each, one in found.items()
    }
    assert pitch[None].max() < 4
    assert pitch[guide].min() > 4
    assert found[guide].solved.scatter.doubtful
    assert "strain = 'free'" in found[guide].solved.scatter.note
    follows = carriage(registrations(true_maps(gantry.crossbeam), np.random.default_rng(7)), rig, guide=guide)
    assert not follows.solved.scatter.doubtful


def test_cold_scans_never_influence_more_than_the_variance():
    """One freedom is known a million times better than the others."""
    size = np.array([1e-9, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3])
    root = model._root(np.diag(size**2)[None])[0]
    assert np.all(np.sum(root**2, axis=1) <= size**2 * (1 + 1e-12))
    assert np.allclose(root @ root.T, np.diag(size**2), rtol=1e-6)


# ---------------------------------------------------------------- slopes of the guide

#: of (T, r) by a registration alone, m and rad: pitch shows by the relief only
SIGMA = np.array([30e-9, 40e-9, 20e-9, 3e-6, 0.1e-6, 0.3e-6])


def guided(rig, twist, sigma=SIGMA, guide=1e-6):
    """Return a campaign of one warm cycle with twists of the profiler (n, 6), and its solution."""
    places = np.linspace(-0.7, 0.7, 8)[: len(twist)]
    maps = np.zeros((2, len(twist), 9))
    W = from_maps(rig.pose)[:6, :6]
    maps[1, :, :6] = twist @ np.linalg.inv(W).T
    noise = np.eye(9) * 1e-12
    noise[:6, :6] = np.linalg.inv(W) @ np.diag(sigma**2) @ np.linalg.inv(W).T
    of = campaign(registrations(maps, noise=noise, share=0.0), rig, guide=guide, places=places)
    return of, of.solved_profiler(solve(of.observed(coords={}, reference="")))


@pytest.mark.parametrize("n", [1, 2, 3, 5, 8])
def test_any_number_of_artefacts_is_accepted(n, gantry, rig):
    places = np.linspace(-0.7, 0.7, 8)[:n]
    truth = transform(
        gantry.crossbeam.twist(7200.0, places), np.linalg.inv(chain.carriage_adjoint(rig.pose, rig.lever))
    )
    _, (twist, C, cold) = guided(rig, truth)
    miss = np.abs(twist[1] - truth) / np.sqrt(np.diagonal(C[1], axis1=1, axis2=2))
    assert miss.shape == (n, 6)
    assert miss.max() < (2.0 if n < 5 else 1e-3)  # the twin bends as cubics do, which a spline of enough points follows
    assert not cold[1].any()


def test_error_of_the_spline_is_included(rig):
    here = replace(rig, pose=RigidTransform.identity(), lever=np.zeros(3))
    places = np.linspace(-0.7, 0.7, 8)
    bent = np.zeros((8, 6))
    bent[:, 2] = 1e-6 * np.sin(2 * np.pi * places / 0.8)  # one wave over four artefacts
    slope = 1e-6 * 2 * np.pi / 0.8 * np.cos(2 * np.pi * places / 0.8)
    of, _ = guided(here, bent, sigma=np.full(6, 1e-10), guide=1e-9)
    missed = np.sqrt(np.mean((slopes(places)[0] @ bent[:, 2] - slope) ** 2))
    size = of.slopes[1][1]
    assert 0.5 * missed < size[0] < 5 * missed
    assert size[1] == pytest.approx(1e-9, rel=0.1)
