"""Where the stations are, from the distances alone; and what readings look like that no station can have made."""

import numpy as np
import pytest

from errormotion.errors import MethodError
from errormotion.methods.multilateration.network.start import initial_stations

STATION = np.array([[-0.35, -0.3, -0.15], [0.36, -0.33, 0.02], [0.0, 0.37, -0.15], [0.02, 0.01, 0.4]])
FAR = 10 * STATION
CENTRE = np.array([1.0, 2.0, 0.5])


def targets(m=60, thickness=1.0):
    return np.random.default_rng(5).uniform(-0.05, 0.05, (m, 3)) * [1, 1, thickness] + CENTRE


def displacements(u, station=STATION, off=10e-6):
    """Readings of targets that lie near the nominal ones, from stations about their centre."""
    true = u + np.random.default_rng(6).normal(0, off, u.shape)
    return np.linalg.norm(true - (station + CENTRE)[:, None], axis=-1) - 0.2


def start(d, u, station=None):
    return initial_stations(d, np.ones(d.shape), u, station)


def test_distances_alone_tell_where_the_stations_are():
    u = targets()
    found = start(displacements(u), u)
    # Targets are 10 um off: curvature of 100 mm at 0.5 m is some 2.5 mm, so this is 1 % and less of the distance.
    assert np.linalg.norm(found.position - STATION - CENTRE, axis=1).max() < 5e-3
    assert np.abs(found.dead_path - 0.2).max() < 5e-3


def test_exact_targets_give_exact_stations():
    u = targets()
    found = start(displacements(u, off=0.0), u)
    assert np.abs(found.position - STATION - CENTRE).max() < 1e-9


def test_rough_places_far_off_are_not_followed():
    u = targets()
    found = start(displacements(u), u, np.zeros((4, 3)))
    assert np.linalg.norm(found.position - STATION - CENTRE, axis=1).max() < 5e-3


def test_a_fifth_of_gross_readings_is_borne():
    u = targets()
    d = displacements(u)
    rng = np.random.default_rng(8)
    for row in d:
        row[rng.choice(60, 12, replace=False)] += rng.uniform(-1, 1, 12)
    found = start(d, u)
    assert np.linalg.norm(found.position - STATION - CENTRE, axis=1).max() < 10e-3


def test_flat_targets_need_to_be_told_the_side():
    u = targets(thickness=0.0)
    d = displacements(u, off=0.0)
    with pytest.raises(MethodError, match="on which side of it a station is"):
        start(d, u)
    found = start(d, u, STATION + CENTRE + 0.02)
    assert np.abs(found.position - STATION - CENTRE).max() < 1e-6


def test_targets_on_a_line_are_refused():
    u = targets() * [1, 0, 0]
    with pytest.raises(MethodError, match="found them on one line"):
        start(displacements(u), u)


@pytest.mark.parametrize("rough", [None, STATION + CENTRE])
@pytest.mark.parametrize(
    ("factor", "of_targets", "message"),
    [
        (1e3, 1.0, "millimetres given as metres"),
        (1.0, 1e3, "targets in millimetres given as metres"),
        (2.0, 1.0, "the double path counted"),
        (-1.0, 1.0, "sign reversed"),
    ],
)
def test_readings_in_another_unit_are_called_so(rough, factor, of_targets, message):
    u = targets()
    with pytest.raises(MethodError, match=message):
        start(factor * displacements(u), of_targets * u, rough)


def test_far_stations_betray_a_reversed_sign_by_curvature():
    u = targets()
    d = displacements(u, FAR)
    assert np.isfinite(start(d, u).position).all()
    with pytest.raises(MethodError, match="sign reversed"):
        start(-d, u)


def test_targets_in_another_order_are_refused():
    u = targets()
    d = displacements(u)
    d[2] = d[2, ::-1]
    with pytest.raises(MethodError, match=r"readings of station 3 .* same order"):
        start(d, u)


def test_few_readings_need_a_rough_place():
    u = targets()
    d = displacements(u)
    weight = np.ones(d.shape)
    weight[1, 4:] = 0
    with pytest.raises(MethodError, match="at least 5 readings of station 2"):
        initial_stations(d, weight, u, None)
    found = initial_stations(d, weight, u, STATION + CENTRE)
    assert np.abs(found.position[1] - STATION[1] - CENTRE).max() < 1e-12
