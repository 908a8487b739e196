"""Outliers are found, or their target is excluded; correct readings are kept."""

import numpy as np
import pytest

from errormotion.methods.multilateration.networks import solve

STATION = np.array(
    [
        [-0.35, -0.3, -0.15],
        [0.36, -0.33, 0.02],
        [0.0, 0.37, -0.15],
        [0.02, 0.01, 0.4],
        [0.3, 0.3, 0.3],
        [-0.3, 0.2, 0.35],
    ]
)
FRINGE = 632.8e-9 / 2


def readings(n, m=60, noise=1e-6, seed=0):
    """Return nominal targets, true ones (errors of 5 um), and displacements."""
    rng = np.random.default_rng([3, seed])
    nominal = rng.uniform(-0.05, 0.05, (m, 3))
    true = nominal + rng.normal(0, 5e-6, (m, 3))
    d = np.linalg.norm(true - STATION[:n, None], axis=-1) - 0.1
    return nominal, d + rng.normal(0, noise, d.shape)


@pytest.mark.parametrize("n", [4, 6])
@pytest.mark.parametrize("by", [100e-6, -3e-3, 1.0])
@pytest.mark.parametrize("approximate", [True, False])
def test_one_wrong_distance_is_found(n, by, approximate):
    u, d = readings(n)
    right = solve(d, u, noise=1e-6)
    d[1, 7] += by
    network = solve(d, u, STATION[:n] if approximate else None, noise=1e-6)
    if n == 4 and by == 100e-6:
        # The residuals do not show which reading is wrong, and it is not wrong by far more than the machine is off.
        assert (network.left_out, network.undecided) == ((), (7,))
        d[:, 7] = np.nan
    else:
        assert (network.left_out, network.undecided) == (((1, 7),), ())
        d[1, 7] = np.nan
    # As if that reading had never been.
    without = solve(d, u, noise=1e-6)
    others = np.isfinite(without.target)
    assert np.array_equal(others, np.isfinite(network.target))
    assert np.abs(network.target - without.target)[others].max() < 1e-11
    assert right.left_out == ()


def test_a_fringe_is_found_with_noise_below_it():
    # lambda / 2 of He-Ne; an interferometer with 30 nm and six stations.
    u, d = readings(6, noise=30e-9)
    d[2, 9] += FRINGE
    network = solve(d, u, noise=30e-9)
    assert network.left_out == ((2, 9),)


def test_a_fringe_is_not_found_with_noise_of_one_micrometre():
    u, d = readings(4)
    d[2, 9] += FRINGE
    network = solve(d, u, noise=1e-6)
    assert network.left_out == ()
    assert network.undecided == ()


def test_a_target_is_excluded_if_the_wrong_reading_is_not_determined():
    # Four stations: all four residuals of the target are alike, and the machine itself is off by more than a fringe.
    u, d = readings(4, noise=30e-9)
    d[2, 9] += FRINGE
    network = solve(d, u, noise=30e-9)
    assert network.undecided == (9,)
    assert np.isnan(network.target[9]).all()
    assert any("station 3 of target 10" in note and "; 4 of them are not used" in note for note in network.notes)


def test_many_wrong_distances_of_all_sizes_are_found():
    u, d = readings(6)
    rng = np.random.default_rng(4)
    wrong = sorted((int(rng.integers(6)), int(i)) for i in rng.choice(60, 10, replace=False))
    for k, (j, i) in enumerate(wrong):
        d[j, i] += (-1) ** k * 10 ** rng.uniform(-4.5, -2)
    network = solve(d, u, noise=1e-6)
    assert sorted(network.left_out) == wrong
    assert network.sigma0 == pytest.approx(1.0, abs=4 / np.sqrt(2 * network.freedom))


def test_two_wrong_readings_of_one_target_are_found():
    u, d = readings(6)
    d[1, 7] += 200e-6
    d[4, 7] -= 90e-6
    assert sorted(solve(d, u, noise=1e-6).left_out) == [(1, 7), (4, 7)]


def test_correct_readings_are_kept():
    # One network in a thousand may lose one.
    lost = 0
    for seed in range(40):
        network = solve(*reversed(readings(4, 40, seed=seed)), noise=1e-6)
        lost += len(network.left_out) + len(network.undecided)
    assert lost == 0


def test_with_noise_stated_too_small_no_reading_is_ignored():
    u, d = readings(4, noise=5e-6)
    network = solve(d, u, noise=1e-6)
    assert network.left_out == ()
    assert network.undecided == ()
    assert network.sigma0 == pytest.approx(5.0, abs=4 * 5 / np.sqrt(2 * network.freedom))


@pytest.mark.parametrize(("n", "by"), [(4, 3e-3), (6, 100e-6)])
def test_a_residual_is_reading_minus_model_also_of_outliers(n, by):
    u, d = readings(n)
    d[1, 7] += by
    d[0, 12] = np.nan
    d[1:, 20] = np.nan
    network = solve(d, u, noise=1e-6)
    assert network.left_out == ((1, 7),)
    distance = np.linalg.norm(network.target - network.stations.position[:, None], axis=-1)
    model = distance - network.stations.dead_path[:, None]
    assert np.array_equal(np.isfinite(network.residual), np.isfinite(d) & np.isfinite(network.target[:, 0]))
    assert np.nanmax(np.abs(network.residual - (d - model))) < 1e-15
    # What was left out shows its whole error: its target lies where the others put it.
    assert network.residual[1, 7] == pytest.approx(by, abs=40e-6)
    assert np.isnan(network.redundancy[1, 7])


def test_without_robust_all_readings_are_used():
    u, d = readings(4)
    d[1, 7] += 100e-6
    network = solve(d, u, noise=1e-6, robust=False)
    assert network.left_out == ()
    assert network.sigma0 > 5
