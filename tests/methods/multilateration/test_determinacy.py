"""Undetermined freedoms are described: number of targets, freedom, and cause."""

import numpy as np
import pytest
from coded import raises

from errormotion.errors import MethodError
from errormotion.methods.multilateration.determinacy import swap_note, swapped_stations
from errormotion.methods.multilateration.networks import bound, solve

GOOD = np.array([[-0.35, -0.3, -0.15], [0.36, -0.33, 0.02], [0.0, 0.37, -0.15], [0.02, 0.01, 0.4]])
FLAT = np.array([[0.3, 0.3, -0.2], [-0.3, 0.3, -0.2], [-0.3, -0.3, -0.2], [0.4, -0.2, -0.2]])
LINE = np.array([[0.3, 0.3, -0.2], [-0.3, 0.3, -0.2], [-0.1, 0.3, -0.2], [0.15, 0.3, -0.2]])


def targets(m=60):
    return np.random.default_rng(5).uniform(-0.05, 0.05, (m, 3))


def displacements(u, station, noise=1e-6):
    d = np.linalg.norm(u - station[:, None], axis=-1)
    return d + np.random.default_rng(6).normal(0, noise, d.shape)


def test_four_stations_require_ten_targets():
    u = targets(10)
    assert solve(displacements(u, GOOD), u, noise=1e-6).freedom == 0
    with pytest.raises(MethodError, match=r"at least 10 targets .* found 9 equations"):
        solve(displacements(u, GOOD)[:, :9], u[:9])


def test_five_stations_require_seven_targets():
    u = targets(7)
    station = np.vstack([GOOD, [0.3, 0.3, 0.3]])
    bound(u, station)
    with pytest.raises(MethodError, match="at least 7 targets measured from all 5 stations"):
        bound(u[:6], station)


def test_three_stations_are_refused():
    u = targets()
    with raises("network.stations.too_few"):
        solve(displacements(u, GOOD[:3]), u)


def test_a_station_without_readings_is_refused():
    u = targets()
    d = displacements(u, GOOD)
    d[2] = np.nan
    with pytest.raises(MethodError, match="found 0 of station 3"):
        solve(d, u)


def test_missing_readings_reduce_the_number_of_equations():
    u = targets(12)
    d = displacements(u, GOOD)
    d[1, :3] = np.nan
    with pytest.raises(MethodError, match="found 9 equations from 12 targets, 9 of them measured from all"):
        solve(d, u)


@pytest.mark.parametrize("many", [60, 1000])
def test_coplanar_stations_leave_two_freedoms_undetermined_with_any_targets(many):
    u = targets(many)
    with pytest.raises(MethodError, match=r"found 2 undetermined freedoms .* the stations are in one plane"):
        solve(displacements(u, FLAT), u, FLAT, noise=1e-6)
    with pytest.raises(MethodError, match="the stations are in one plane"):
        bound(u, FLAT)


def test_a_fifth_station_in_the_plane_does_not_help():
    u = targets()
    station = np.vstack([FLAT, [0.0, 0.0, -0.2]])
    with pytest.raises(MethodError, match="the stations are in one plane"):
        bound(u, station)


@pytest.mark.parametrize("noise", [0.0, 1e-6])
def test_four_stations_at_one_position_are_reported(noise):
    u, station = targets(), np.tile(GOOD[:1], (4, 1))
    with pytest.raises(MethodError, match="stations 1 and 2 are nearly at the same position"):
        solve(displacements(u, station, noise), u, station, noise=1e-6)
    with pytest.raises(MethodError, match="stations 1 and 2 are nearly at the same position"):
        bound(u, station)


@pytest.mark.parametrize("height", [1e-15, 1e-12, 1e-9, 1e-6, 1e-4])
def test_nearly_coplanar_stations_are_refused(height):
    # Right-angled and doubled places, too: the information is singular to all its digits, or a little better.
    u, station = targets(), np.add(FLAT, np.outer([0, 0, 0, height], [0, 0, 1]))
    with pytest.raises(MethodError, match=r"2 undetermined freedoms .* the stations are in one plane"):
        bound(u, station)


@pytest.mark.parametrize("spread", [[1, 0, 0], [1, 1e-9, 1e-9], [0, 0, 0], [1e-12, 1e-12, 1e-12]])
def test_a_bound_of_targets_on_a_line_or_at_a_point_is_refused(spread):
    with pytest.raises(MethodError, match="undetermined freedoms"):
        bound(targets() * spread, GOOD)


def test_a_target_at_a_station_and_extreme_noise_are_refused():
    u = targets()
    with pytest.raises(MethodError, match="found one of zero"):
        bound(np.vstack([u, GOOD[:1]]), GOOD)
    with pytest.raises(MethodError, match="not finite"), np.errstate(over="ignore"):
        bound(u, GOOD, noise=1e-200)
    with raises("network.position.form"):
        bound(u, np.where(GOOD[0, 0] == GOOD, np.nan, GOOD))


@pytest.mark.slow
def test_any_stations_result_in_a_network_or_a_method_error():
    rng, refused = np.random.default_rng(0), 0
    for k in range(60):
        station = rng.normal(size=(4, 3)) * 10.0 ** rng.uniform(-8, 3, (4, 1))
        if k % 3 == 0:
            station[1] = station[0] * (1 + 10.0 ** rng.uniform(-16, -3))
        if k % 3 == 1:
            station[:, 2] = 10.0 ** rng.uniform(-18, -3) * rng.normal(size=4)
        u = rng.normal(size=(rng.integers(10, 30), 3)) * 10.0 ** rng.uniform(-6, 1)
        d = displacements(u, station)
        for work in (lambda u=u, station=station: bound(u, station), lambda u=u, d=d, s=station: solve(d, u, s)):
            try:
                assert np.isfinite(work().stations.position).all()
            except MethodError:
                refused += 1
    # Most of these are hopeless.
    assert refused > 60


def test_stations_on_one_line_are_reported():
    u = targets()
    with pytest.raises(MethodError, match="the stations are on one line"):
        bound(u, LINE)


def test_stations_in_line_with_the_targets_are_reported():
    # Two of four stations in the same direction, far from the targets: one of them says what the other does.
    u = 0.2 * targets()
    station = GOOD.copy()
    station[1] = 1.5 * station[0]
    with pytest.raises(MethodError, match="stations 1 and 2 are in one line with the targets"):
        solve(displacements(u, station, 20e-6), u, station, noise=20e-6)


def test_the_undetermined_freedom_is_described():
    # Station 5 sees four targets close to one another: it alone is loose.
    u = targets()
    station = np.vstack([GOOD, [0.3, 0.3, 0.3]])
    seen = np.ones((5, 60), dtype=bool)
    seen[4, 4:] = False
    u[:4] = u[0] + 1e-4 * np.arange(4)[:, None] * [1.0, 0.3, -0.4]
    with pytest.raises(MethodError, match=r"undetermined freedoms \(.*\): station 5 "):
        bound(u, station, seen=seen)


def test_an_unsuitable_layout_is_noted():
    u = targets(100)
    station = FLAT.copy()
    station[1, 2] -= 5e-3
    network = solve(displacements(u, station, 0.1e-6), u, station, noise=0.1e-6)
    assert any("times the noise" in note and "one plane" in note for note in network.notes)
    assert not solve(displacements(u, GOOD), u).notes


@pytest.mark.parametrize("n", [4, 5])
def test_a_target_in_the_stations_plane_does_not_move_the_others(n):
    station = np.array([[-0.3, -0.3, 0.0], [0.36, -0.33, 0.0], [0.0, 0.37, 0.0], [0.02, 0.01, 0.4], [0.3, 0.3, 0.3]])
    u = targets()
    u[7] = [0.01, 0.02, 1e-7]
    d = displacements(u, station[:n], 1e-6)
    d[3:, 7] = np.nan
    network = solve(d, u, noise=1e-6)
    d[:, 7] = np.nan
    without = solve(d, u, noise=1e-6)
    others = np.arange(60) != 7
    # It would be off by nearly a millimetre, and the mean of sixty targets by a sixtieth of that if it had a say.
    assert np.isnan(network.target[7]).all()
    assert np.abs(network.target[others] - without.target[others]).max() < 1e-11
    assert np.abs(network.stations.position - without.stations.position).max() < 1e-11
    assert np.allclose(network.covariance[others], without.covariance[others], rtol=1e-9, atol=1e-18)


def test_swapped_stations_are_noted_and_do_not_affect_the_targets():
    u = targets()
    d = displacements(u, GOOD)
    approximate = GOOD + np.random.default_rng(1).normal(0, 5e-3, GOOD.shape)
    right = solve(d, u, approximate, noise=1e-6)
    swapped = solve(d[[2, 1, 0, 3]], u, approximate, noise=1e-6)
    assert swap_note(right.stations.position, approximate) == []
    (note,) = swap_note(swapped.stations.position, approximate)
    assert "the readings of station 1 are those of station 3" in note
    assert np.abs(right.target - swapped.target).max() < 1e-12
    assert np.abs(right.stations.position[[2, 1, 0, 3]] - swapped.stations.position).max() < 1e-9


def test_inaccurate_approximate_positions_are_not_reported_as_swapped():
    assert swapped_stations(GOOD, GOOD + 0.1) == []
    assert swapped_stations(GOOD, None) == []
