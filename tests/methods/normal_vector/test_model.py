"""The measurement model: its derivatives, its covariance against the bound, its motions exact."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from probing_bound import bound

from errormotion.estimation.fit import fit
from errormotion.estimation.sources import Places, errors_of
from errormotion.methods.normal_vector.acquisition.touching import touch_normals
from errormotion.methods.normal_vector.identification.freedoms import Motion, rotated, undetermined
from errormotion.methods.normal_vector.identification.reading import Readings
from errormotion.methods.normal_vector.identification.spheres import Observations
from errormotion.methods.normal_vector.model import Probing, Unknowns, knot_weights

BALLS = {
    "XYZ": np.array([(1.0, -0.5, 0.1), (3.0, -0.6, 0.3), (2.0, 0.6, 0.15), (1.5, 0.1, 0.6)]),
    "Z": np.array([(-0.2, -0.2, 0.1), (0.2, -0.15, 0.1), (0.1, 0.2, 0.25), (-0.15, 0.15, 0.35)]),
    "YZ": np.array([(-0.2, -0.2, 0.1), (0.2, -0.15, 0.1), (0.1, 0.2, 0.25), (-0.15, 0.15, 0.35)]),
}
REACH, NOISE, INTERVAL = 15.5e-3, 0.25e-6, 600.0
DRIFT = np.array([2e-5, -3.5e-5, 5e-5, 6e-5, -8e-5, 4e-5])


def touches(axes, cycles=5, count=5, noise=0.0, drift=DRIFT, seed=0, duration=100.0, uneven=1.5e-6):
    """Touches of balls whose reaches differ by micrometres, while the machine moves along a parabola of time."""
    rng = np.random.default_rng(seed)
    ball = BALLS[axes]
    motion = Motion(axes, ball.mean(axis=0))
    normal = np.tile(touch_normals(count), (len(ball), 1, 1))
    reach = REACH + uneven * rng.normal(size=normal.shape[:2])
    begin = INTERVAL * np.arange(cycles)
    time = begin[:, None, None] + np.linspace(0, duration, reach.size).reshape(reach.shape)
    share = (time - time[0].mean()) / begin[-1]
    true = (share * (2 - share))[..., None] * drift
    true[0] = 0.0
    true[..., [k for k in range(6) if k not in motion.seen]] = 0.0
    way = np.full(time.shape, REACH)
    for _ in range(20):
        place = ball[:, None] + way[..., None] * normal
        way -= (
            np.linalg.norm(place + motion.error(true[..., list(motion.seen)], place) - ball[:, None], axis=-1) - reach
        )
    place = ball[:, None] + (way + noise * rng.normal(size=way.shape))[..., None] * normal
    weight = np.zeros((*time.shape, count))
    weight[..., range(count), range(count)] = 1.0
    middle = time.mean(axis=(1, 2))
    share = (middle - middle[0]) / begin[-1]
    at_cycle = (share * (2 - share))[:, None] * drift
    return Observations(place, weight, time, begin, touched=True), motion, at_cycle


def solved(seen, motion, interpolate=True):
    """Return the solution of the model for touches, as twists of six errors with their covariance."""
    names = [str(i + 1) for i in range(seen.valid.shape[1])]
    data = Readings(seen, names, motion.tool_axes, NOISE, None, np.full(len(names), np.nan), timed=True)
    probing = Probing(data, motion, interpolate)
    found = fit(probing.determined(probing.problem()), refresh=probing.refreshed)
    errors = errors_of(found, Places(lambda x, _: x.twist, len(seen.cycle_time)), shared="cold reference")
    rows = np.array(motion.seen)
    shared = np.einsum("skp,skq->kpq", errors.influence, errors.influence)
    whole = np.zeros((3, len(errors.value), 6, 6))
    for full, part in zip(whole, (errors.covariance, errors.own, shared), strict=True):
        full[:, rows[:, None], rows] = part
    twist = motion.full(found.unknowns.twist)
    return SimpleNamespace(
        fit=found, twist=twist, covariance=whole[0], own=whole[1], shared=whole[2], anchor=found.constants.centre,
        time=seen.mean_time, chi2=found.chi2, freedom=found.freedom,
    )  # fmt: skip


@pytest.mark.parametrize("axes", ["XYZ", "Z"])
@pytest.mark.parametrize("touched", [True, False])
def test_derivatives_of_the_model_are_those_of_its_equation(axes, touched):
    seen, motion, _ = touches(axes)
    if not touched:
        weight = np.broadcast_to(np.eye(3), (*seen.weight.shape[:2], 3, 3)).copy()
        centre = np.broadcast_to(BALLS[axes][:, None], (*weight.shape[:2], 3, 3)).copy()
        seen = Observations(centre, weight, seen.time[..., :3], seen.cycle_time, touched=False)
    data = Readings(seen, list("1234"), axes, NOISE, None, np.full(4, np.nan), timed=touched)
    problem = Probing(data, motion, interpolate=touched).problem()
    twist = np.tile(DRIFT[list(motion.seen)] * 1e-3, (len(problem.y), 1))  # the turn of a step is of second order
    rows = [twist, problem.unknowns.reach.rows(problem.unknowns.reach.start)]
    c = problem.named(rows, [each.rows(each.value) for each in problem.constants])[1]
    analytic = problem.derivatives(problem.y, Unknowns(*rows), c)
    for k, name in enumerate(Unknowns._fields):
        for col in range(rows[k].shape[1]):
            ends = []
            for sign in (1, -1):
                moved = [each.copy() for each in rows]
                moved[k][:, col] += sign * 1e-6
                ends.append(problem.equation(problem.y, Unknowns(*moved), c).reshape(len(problem.y), -1))
            np.testing.assert_allclose(analytic[name][..., col], (ends[0] - ends[1]) / 2e-6, atol=2e-7)


def test_analytic_derivative_by_the_readings_is_that_of_the_differences():
    seen, motion, _ = touches("XYZ", noise=NOISE)
    with_it = solved(seen, motion)
    problem = with_it.fit.problem
    without = replace(problem, derivatives=lambda *at: {
        name: J for name, J in problem.derivatives(*at).items() if name != "readings"
    })  # fmt: skip
    np.testing.assert_allclose(fit(without).unknowns.twist, with_it.fit.unknowns.twist, atol=1e-12)
    np.testing.assert_allclose(fit(without).chi2, with_it.chi2, rtol=1e-6)


@pytest.mark.parametrize("axes", ["XYZ", "Z", "YZ"])
@pytest.mark.parametrize("uneven", [0.0, 1.5e-6])
def test_motion_is_exact_without_noise_for_any_reaches(axes, uneven):
    seen, motion, true = touches(axes, uneven=uneven, duration=0.0)
    found = solved(seen, motion)
    rows = list(motion.seen)
    # Spheres through uneven reaches have their centres off by some of it: normals are off by 1e-4 at most, and so is
    # what they show of 50 um; turns have levers of 0.1 m on a C-frame.
    np.testing.assert_allclose(found.twist[:, :3], true[:, :3], atol=5e-9 if uneven else 1e-11)
    np.testing.assert_allclose(found.twist[:, rows], true[:, rows], atol=5e-8 if uneven else 1e-10)
    np.testing.assert_allclose(found.twist[:, [k for k in range(6) if k not in rows]], 0.0)
    np.testing.assert_allclose(found.anchor, BALLS[axes], atol=5e-6)  # reaches of 1.5 um shift their sphere


def test_rotation_of_a_milliradian_is_exact():
    drift = np.array([0, 0, 0, 1e-3, -0.7e-3, 0.5e-3])
    seen, motion, true = touches("XYZ", drift=drift, duration=0.0, uneven=0.0)
    # To first order the balls would be off by the square of the angle times 1 m: 1 um.
    np.testing.assert_allclose(solved(seen, motion).twist, true, atol=1e-10)


def test_rotation_preserves_lengths():
    rng = np.random.default_rng(1)
    rotation, vector = rng.normal(size=(2, 50, 3))
    np.testing.assert_allclose(np.linalg.norm(rotated(rotation, vector), axis=1), np.linalg.norm(vector, axis=1))
    np.testing.assert_allclose(rotated(np.zeros(3), vector), vector)
    np.testing.assert_allclose(rotated(np.array([0, 0, np.pi / 2]), np.array([1.0, 0, 0])), [0, 1, 0], atol=1e-15)


@pytest.mark.parametrize("axes", ["XYZ", "Z"])
@pytest.mark.parametrize("interpolate", [True, False])
def test_stated_covariance_is_the_bound(axes, interpolate):
    seen, motion, _ = touches(axes, noise=NOISE)
    found = solved(seen, motion, interpolate=interpolate)
    normal = np.tile(touch_normals(5), (4, 1, 1))
    times = {"time": found.time, "touch_time": seen.time} if interpolate else {"cycles": 5}
    least = bound(BALLS[axes][:, None] + REACH * normal, normal, motion, noise=NOISE, **times)
    rows = np.ix_(range(5), motion.seen, motion.seen)
    scale = np.sqrt(np.einsum("kii->ki", least[rows])[-1])
    # The balls have moved by 50 um, so that they are touched where the normal is 3e-3 another.
    np.testing.assert_allclose((found.covariance[rows] - least[rows]) / np.outer(scale, scale), 0.0, atol=3e-3)


def test_unknown_reach_of_each_touch_costs_no_more_than_one_radius_for_each_ball():
    normal, motion = np.tile(touch_normals(5), (4, 1, 1)), Motion("XYZ", BALLS["XYZ"].mean(axis=0))
    place = BALLS["XYZ"][:, None] + REACH * normal
    each, one = (bound(place, normal, motion, noise=NOISE, cycles=4, reach=reach)[1:] for reach in ("touch", "ball"))
    np.testing.assert_allclose(np.einsum("kii->ki", each), np.einsum("kii->ki", one), rtol=1e-6)


def test_half_of_the_variance_is_the_cold_cycles():
    seen, motion, _ = touches("XYZ", noise=NOISE)
    found = solved(seen, motion, interpolate=False)
    np.testing.assert_allclose(np.einsum("kii->ki", found.shared[1:]), np.einsum("kii->ki", found.own[1:]), rtol=1e-3)


def test_errors_are_as_large_as_their_covariance_says():
    total, freedoms, chi2, freedom = 0.0, 0, 0.0, 0
    for seed in range(60):
        seen, motion, true = touches("XYZ", noise=NOISE, seed=seed, drift=0.2 * DRIFT)
        found = solved(seen, motion)
        error = found.twist[2] - true[2]
        total += error @ np.linalg.solve(found.covariance[2], error)
        chi2, freedom, freedoms = chi2 + found.chi2, freedom + found.freedom, freedoms + 6
    # chi-square of 360 freedoms: 27 off is one standard deviation; of 60 x 56 freedoms: 82.
    assert abs(total - freedoms) < 3 * np.sqrt(2 * freedoms)
    assert abs(chi2 - freedom) < 3 * np.sqrt(2 * freedom)


def test_drift_within_a_cycle_would_smear_where_it_is_not_followed():
    seen, motion, true = touches("XYZ", duration=300.0, uneven=0.0)
    followed, not_followed = (solved(seen, motion, interpolate=way).twist[2] - true[2] for way in (True, False))
    assert np.abs(not_followed[3:]).max() > 1e-6
    # Only the last cycle's drift is not known, and what it says of its neighbours' touches.
    assert np.abs(followed).max() < 1e-2 * np.abs(not_followed).max()


def test_weights_between_the_cycles_follow_a_parabola():
    time = np.array([0.0, 600.0, 1300.0, 1900.0])
    at = time[:, None, None] + np.linspace(-50, 50, 6).reshape(2, 3)
    weights = knot_weights(time, at, interpolate=True)
    knots = np.pad(3 + 2e-3 * time - 1e-6 * time**2, 1)
    around = np.stack([knots[:-2], knots[1:-1], knots[2:]], axis=1)
    value = np.einsum("kbms,ks->kbm", weights, around)
    np.testing.assert_allclose(value[1:3], (3 + 2e-3 * at - 1e-6 * at**2)[1:3], rtol=1e-12)
    np.testing.assert_allclose(weights[0], 0.0)


def test_c_frame_does_not_determine_the_rotation_about_the_axis_of_its_tool():
    assert Motion("Z", np.zeros(3)).seen == (0, 1, 2, 3, 4)
    assert Motion("XYZ", np.zeros(3)).seen == Motion("YZ", np.zeros(3)).seen == (0, 1, 2, 3, 4, 5)
    assert Motion("", np.zeros(3)).seen == (0, 1, 2)
    flat = BALLS["Z"] * [1, 1, 0]
    assert undetermined(flat, Motion("Z", np.zeros(3))) == [3, 4]
    assert undetermined(flat, Motion("Z", np.array([0, 0, 0.2]))) == [0, 1, 3, 4]  # displacement is known at z = 0
    assert undetermined(flat, Motion("XYZ", np.zeros(3))) == []
