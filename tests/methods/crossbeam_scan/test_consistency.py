"""Artefacts that moved are found and named, at the ends too, and clean campaigns stay quiet."""

import numpy as np
import pytest
from coded import raises
from scipy.spatial.transform import RigidTransform

from errormotion.methods.crossbeam_scan.identification.artefacts import cold_repeats, moved_artefacts
from errormotion.methods.crossbeam_scan.identification.chain import carriage_adjoint
from errormotion.twin import VirtualMachine

PLACES = 0.35 + 0.2 * np.arange(8)
CYCLES = 60.0 * np.array([7, 15, 30, 45, 60, 90, 120, 150, 180])
#: of a registration in the profiler's frame with line jitter and speckle, m and rad
SIGMA = np.array([20e-9, 70e-9, 20e-9, 1e-6, 0.3e-6, 1e-6])
COVARIANCE = np.outer(SIGMA, SIGMA) * (0.5 * np.eye(6) + 0.5)
NAMES = ("EX", "EY", "EZ", "EA", "EB", "EC")


def noise(rng, *shape):
    return rng.normal(size=(*shape, 6)) @ np.linalg.cholesky(COVARIANCE).T


def campaign(seed, cycles=CYCLES, places=PLACES):
    """Errors in the profiler's frame, their covariance (half from the cold scans), and the way to the carriage."""
    rng = np.random.default_rng(seed)
    crossbeam = VirtualMachine("gantry", seed=seed).crossbeam
    to_carriage = carriage_adjoint(RigidTransform.from_matrix(crossbeam.pose), crossbeam.lever)
    errors = crossbeam.twist(cycles[:, None], places) @ np.linalg.inv(to_carriage).T
    t, n = errors.shape[:2]
    errors = errors + (noise(rng, t, n) + noise(rng, 1, n)) / np.sqrt(2)
    return errors, np.broadcast_to(COVARIANCE, (t, n, 6, 6)), to_carriage


def moved(time, places, errors, C, cold_share=0.5, **options):
    found = moved_artefacts(time, places, errors, C, cold_covariance=cold_share * np.asarray(C), **options)
    assert found.tested
    return [(one.artefact, one.since) for one in found.moved]


def step(size, freedom):
    return size * np.eye(6)[NAMES.index(freedom)]


# ---------------------------------------------------------------- cold repeats


def test_cold_repeats_alarm_as_often_as_stated():
    rng = np.random.default_rng(0)
    alarms = 0
    for _ in range(1000):
        found = cold_repeats(noise(rng, 2, 8), np.broadcast_to(COVARIANCE, (2, 8, 6, 6)), false_alarm=0.05)
        alarms += found.suspicious.any()
    # 50 expected with a standard deviation of 7
    assert 25 <= alarms <= 75


def test_cold_repeat_reports_the_artefact_scanned_at_a_wrong_position():
    twist = noise(np.random.default_rng(1), 1, 8)
    twist[0, 5] += step(1e-6, "EY")  # 14 sigma
    found = cold_repeats(twist, np.broadcast_to(COVARIANCE, (1, 8, 6, 6)))
    assert np.argwhere(found.suspicious).tolist() == [[0, 5]]
    assert found.probability[0, 5] < found.limit == 0.01 / 8


def test_stated_repeatability_of_the_machine_prevents_false_alarms():
    rng = np.random.default_rng(2)
    machine = np.array([0.5e-6] * 3 + [2e-6] * 3)
    twist = noise(rng, 1, 8) + machine * rng.normal(size=(1, 8, 6))
    C = np.broadcast_to(COVARIANCE, (1, 8, 6, 6))
    assert cold_repeats(twist, C).suspicious.all()
    assert not cold_repeats(twist, C, repeatability=(0.5e-6, 2e-6)).suspicious.any()


def test_cold_repeat_counts_only_known_freedoms_and_tests():
    twist = noise(np.random.default_rng(3), 1, 3)
    C = np.broadcast_to(COVARIANCE, (1, 3, 6, 6)).copy()
    twist[0, 0] = np.nan
    twist[0, 1, 4] = np.nan
    found = cold_repeats(twist, C)
    assert found.freedoms.tolist() == [[0, 5, 6]]
    assert np.isnan(found.score[0, 0])
    assert not found.suspicious[0, 0]
    assert found.limit == 0.01 / 2
    known = [0, 1, 2, 3, 5]
    expected = twist[0, 1, known] @ np.linalg.solve(COVARIANCE[np.ix_(known, known)], twist[0, 1, known])
    assert found.score[0, 1] == pytest.approx(expected, rel=1e-9)


# ---------------------------------------------------------------- moved artefacts


@pytest.mark.parametrize("freedom", NAMES)
@pytest.mark.parametrize(("artefact", "since"), [(1, 0), (3, 4), (6, 8)])
def test_step_of_5_um_or_20_urad_is_found_and_named_with_its_cycle(artefact, since, freedom):
    errors, C, _ = campaign(seed=10 * artefact + since)
    size = 5e-6 if freedom in NAMES[:3] else 20e-6
    errors[since:, artefact] += step(size, freedom)
    assert moved(CYCLES, PLACES, errors, C) == [(artefact, since)]


@pytest.mark.parametrize("artefact", [0, 7])
@pytest.mark.parametrize(("size", "freedom"), [(5e-6, "EX"), (5e-6, "EY"), (5e-6, "EZ"), (40e-6, "EA"), (40e-6, "EC")])
def test_artefact_at_the_end_is_found_by_a_greater_step(artefact, size, freedom):
    errors, C, _ = campaign(seed=artefact)
    errors[5:, artefact] += step(size, freedom)
    assert moved(CYCLES, PLACES, errors, C) == [(artefact, 5)]


def test_step_is_measured_with_its_covariance():
    jump = np.array([3e-6, -2e-6, 1e-6, 15e-6, -5e-6, 10e-6])
    cycles, places, score = CYCLES[[0, 3, 6, 8]], PLACES[:6], []
    for seed in range(20):
        errors, C, _ = campaign(seed, cycles, places)
        errors[2:, 3] += jump
        (found,) = moved_artefacts(cycles, places, errors, C, cold_covariance=0.5 * C).moved
        off = found.step - jump
        score.append(off @ np.linalg.solve(found.covariance, off))
        assert found.probability < 1e-4
    # Chi-squared of 120 freedoms over 20 would be 6 +- 0.8. It is less, since the axis is smoother than the curves of
    # low order that predict it: the covariance is on the safe side by up to a factor of two in the standard deviation.
    assert 6 / 4 < np.mean(score) < 8


def test_campaigns_without_motion_raise_hardly_an_alarm_even_if_many_are_allowed():
    cycles, places = CYCLES[[0, 3, 6, 8]], PLACES[:6]
    campaigns = (campaign(seed, cycles, places)[:2] for seed in range(40))
    alarms = sum(bool(moved(cycles, places, *each, false_alarm=0.2)) for each in campaigns)
    # an exact test would raise 8; this one is on the safe side
    assert alarms <= 3


def test_rough_guide_is_not_taken_for_moved_artefacts():
    # White noise integrated twice, a new one each cycle, and hardly any noise of the scans: curvature that jumps about.
    rng = np.random.default_rng(4)
    fine = np.linspace(PLACES[0], PLACES[-1], 281)
    alarms = 0
    for _ in range(20):
        rough = np.cumsum(np.cumsum(rng.normal(size=(9, 6, fine.size)), axis=-1), axis=-1)
        gains = np.moveaxis(rough[..., ::40], -1, 1)
        errors = np.cumsum(gains, axis=0) + rng.normal(size=(9, 8, 6))
        alarms += bool(moved(CYCLES, PLACES, errors * 1e-8, np.broadcast_to(1e-16 * np.eye(6), (9, 8, 6, 6))))
    # order 3 would alarm in nearly all
    assert alarms <= 3


def test_several_moved_artefacts_are_found_with_the_worst_first():
    errors, C, _ = campaign(seed=5)
    errors[2:, 6] += step(5e-6, "EX")
    errors[4:, 2] += step(50e-6, "EY")
    errors[4:, 3] += step(30e-6, "EA")
    found = moved(CYCLES, PLACES, errors, C)
    assert sorted(found) == [(2, 4), (3, 4), (6, 2)]
    assert found[0] == (2, 4)


def test_motion_within_the_repeatability_is_not_reported():
    errors, C, _ = campaign(seed=6)
    errors[4:, 3] += step(2e-6, "EY")
    assert moved(CYCLES, PLACES, errors, C) == [(3, 4)]
    assert moved(CYCLES, PLACES, errors, C, repeatability=(2e-6, 5e-6)) == []


def test_missing_scans_do_not_hide_a_step():
    errors, C, _ = campaign(seed=7)
    errors[4:, 3] += step(5e-6, "EZ")
    errors[4, 3] = np.nan  # the first scan that would show it
    errors[2, 5] = errors[7, 0] = np.nan
    assert moved(CYCLES, PLACES, errors, C) == [(3, 5)]


def test_large_step_is_found_in_twists_at_the_carriage_too():
    errors, C, to_carriage = campaign(seed=8)
    errors[4:, 3] += step(20e-6, "EA")
    assert moved(CYCLES, PLACES, errors @ to_carriage.T, to_carriage @ C @ to_carriage.T) == [(3, 4)]


def test_part_of_the_cold_scan_need_not_be_known():
    errors, C, _ = campaign(seed=9)
    assert moved(CYCLES, PLACES, errors, C, cold_share=0.0) == []
    errors[4:, 3] += step(5e-6, "EZ")
    assert moved(CYCLES, PLACES, errors, C, cold_share=0.0) == [(3, 4)]


@pytest.mark.parametrize("artefacts", [0, 1, 3])
def test_too_few_artefacts_are_not_tested(artefacts):
    errors, C, _ = campaign(seed=0)
    errors[4:, 0] += step(1e-3, "EZ")
    found = moved_artefacts(CYCLES, PLACES[:artefacts], errors[:, :artefacts], C[:, :artefacts])
    assert found.moved == ()
    assert not found.tested


def test_artefact_without_scans_has_no_effect():
    errors, C, _ = campaign(seed=0)
    errors[4:, 0] += step(1e-3, "EZ")
    errors[:, 3:] = np.nan
    assert not moved_artefacts(CYCLES, PLACES, errors, C).tested


def test_large_step_is_found_with_four_artefacts():
    errors, C, _ = campaign(seed=1, places=PLACES[:4])
    errors[4:, 1] += step(100e-6, "EY")
    assert moved(CYCLES, PLACES[:4], errors, C) == [(1, 4)]


def test_wrong_inputs_are_refused():
    errors, C, _ = campaign(seed=0)
    with raises("scan.consistency.shape"):
        moved_artefacts(CYCLES[::-1], PLACES, errors, C)
    with raises("scan.consistency.shape"):
        moved_artefacts(CYCLES, PLACES, errors[..., :3], C)
    with raises("scan.consistency.repeatability"):
        moved_artefacts(CYCLES, PLACES, errors, C, repeatability=(-1e-6, 0.0))
    with raises("scan.consistency.false_alarm"):
        cold_repeats(errors, C, false_alarm=1.0)
    with raises("smoothing.variance.not_positive"):
        moved_artefacts(CYCLES, PLACES, errors, 0 * C)
