"""What distances do not determine is said in words: how many targets, which freedom, and what is special."""

import numpy as np
import pytest

from errormotion.errors import MethodError
from errormotion.methods.multilateration.bound import bound
from errormotion.methods.multilateration.determinacy import swapped_stations
from errormotion.methods.multilateration.solver import solve

GOOD = np.array([[-0.35, -0.3, -0.15], [0.36, -0.33, 0.02], [0.0, 0.37, -0.15], [0.02, 0.01, 0.4]])
FLAT = np.array([[0.3, 0.3, -0.2], [-0.3, 0.3, -0.2], [-0.3, -0.3, -0.2], [0.4, -0.2, -0.2]])
LINE = np.array([[0.3, 0.3, -0.2], [-0.3, 0.3, -0.2], [-0.1, 0.3, -0.2], [0.15, 0.3, -0.2]])


def targets(m=60):
    return np.random.default_rng(5).uniform(-0.05, 0.05, (m, 3))


def displacements(u, station, noise=1e-6):
    d = np.linalg.norm(u - station[:, None], axis=-1)
    return d + np.random.default_rng(6).normal(0, noise, d.shape)


def test_four_stations_need_ten_targets():
    u = targets(10)
    assert solve(displacements(u, GOOD), u, noise=1e-6).freedom == 0
    with pytest.raises(MethodError, match=r"at least 10 targets .* found 9 equations"):
        solve(displacements(u, GOOD)[:, :9], u[:9])


def test_five_stations_need_seven_targets():
    u = targets(7)
    station = np.vstack([GOOD, [0.3, 0.3, 0.3]])
    bound(u, station)
    with pytest.raises(MethodError, match="at least 7 targets seen by all 5 stations"):
        bound(u[:6], station)


def test_three_stations_are_too_few():
    u = targets()
    with pytest.raises(MethodError, match="at least four stations, found 3"):
        solve(displacements(u, GOOD[:3]), u)


def test_a_station_without_readings_is_named():
    u = targets()
    d = displacements(u, GOOD)
    d[2] = np.nan
    with pytest.raises(MethodError, match="found 0 of station 3"):
        solve(d, u)


def test_readings_lost_here_and_there_count_as_equations():
    u = targets(12)
    d = displacements(u, GOOD)
    d[1, :3] = np.nan
    with pytest.raises(MethodError, match="found 9 equations in 12 targets, of which 9 are seen by all"):
        solve(d, u)


@pytest.mark.parametrize("many", [60, 1000])
def test_stations_in_one_plane_leave_two_freedoms_loose_whatever_the_targets(many):
    u = targets(many)
    with pytest.raises(MethodError, match=r"found 2 freedoms loose .* the stations stand in one plane"):
        solve(displacements(u, FLAT), u, FLAT, noise=1e-6)
    with pytest.raises(MethodError, match="the stations stand in one plane"):
        bound(u, FLAT)


def test_a_fifth_station_in_the_plane_does_not_help():
    u = targets()
    station = np.vstack([FLAT, [0.0, 0.0, -0.2]])
    with pytest.raises(MethodError, match="the stations stand in one plane"):
        bound(u, station)


def test_stations_on_one_line_are_called_so():
    u = targets()
    with pytest.raises(MethodError, match="the stations stand on one line"):
        bound(u, LINE)


def test_stations_in_line_with_the_targets_are_called_so():
    # Two of four stations in the same direction, far from the targets: one of them says what the other does.
    u = 0.2 * targets()
    station = GOOD.copy()
    station[1] = 1.5 * station[0]
    with pytest.raises(MethodError, match="stations 1 and 2 stand in one line with the targets"):
        solve(displacements(u, station, 20e-6), u, station, noise=20e-6)


def test_the_loose_freedom_is_named():
    # Station 5 sees four targets close to one another: it alone is loose.
    u = targets()
    station = np.vstack([GOOD, [0.3, 0.3, 0.3]])
    seen = np.ones((5, 60), dtype=bool)
    seen[4, 4:] = False
    u[:4] = u[0] + 1e-4 * np.arange(4)[:, None] * [1.0, 0.3, -0.4]
    with pytest.raises(MethodError, match=r"loose \(.*\): station 5 "):
        bound(u, station, seen=seen)


def test_a_bad_layout_is_noted():
    u = targets(100)
    station = FLAT.copy()
    station[1, 2] -= 5e-3
    network = solve(displacements(u, station, 0.1e-6), u, station, noise=0.1e-6)
    assert any("times the noise" in note and "one plane" in note for note in network.notes)
    assert not solve(displacements(u, GOOD), u).notes


def test_a_target_in_the_stations_plane_is_noted():
    # Stations 1 to 3 see it, and it lies in their plane: nothing tells how far above it.
    station = np.array([[-0.3, -0.3, 0.0], [0.36, -0.33, 0.0], [0.0, 0.37, 0.0], [0.02, 0.01, 0.4]])
    u = targets()
    u[7] = [0.01, 0.02, 1e-3]
    d = displacements(u, station, 0.1e-6)
    d[3, 7] = np.nan
    network = solve(d, u, noise=0.1e-6)
    (note,) = [note for note in network.notes if "target 8" in note]
    assert "hardly determined" in note
    assert "one plane with the stations" in note
    assert network.target_covariance[7, 2, 2] > 20**2 * network.target_covariance[8, 2, 2]


def test_swapped_stations_are_noted_and_do_no_harm():
    u = targets()
    d = displacements(u, GOOD)
    rough = GOOD + np.random.default_rng(1).normal(0, 5e-3, GOOD.shape)
    right = solve(d, u, rough, noise=1e-6)
    swapped = solve(d[[2, 1, 0, 3]], u, rough, noise=1e-6)
    assert right.notes == ()
    (note,) = swapped.notes
    assert "the readings of station 1 are those of station 3" in note
    assert np.abs(right.target - swapped.target).max() < 1e-12
    assert np.abs(right.station[[2, 1, 0, 3]] - swapped.station).max() < 1e-9


def test_rough_places_that_are_merely_rough_are_not_called_swapped():
    assert swapped_stations(GOOD, GOOD + 0.1) == []
    assert swapped_stations(GOOD, None) == []
