"""Stations from the distances; and messages for readings that fit no position."""

import numpy as np
import pytest
from coded import raises

from errormotion.errors import MethodError
from errormotion.methods.multilateration.start import initial_stations

STATION = np.array([[-0.35, -0.3, -0.15], [0.36, -0.33, 0.02], [0.0, 0.37, -0.15], [0.02, 0.01, 0.4]])
FAR = 10 * STATION
CENTRE = np.array([1.0, 2.0, 0.5])


def targets(m=60, thickness=1.0):
    return np.random.default_rng(5).uniform(-0.05, 0.05, (m, 3)) * [1, 1, thickness] + CENTRE


def displacements(u, station=STATION, off=10e-6):
    """Return readings of targets close to the nominal ones, from stations about their centre."""
    true = u + np.random.default_rng(6).normal(0, off, u.shape)
    return np.linalg.norm(true - (station + CENTRE)[:, None], axis=-1) - 0.2


def start(d, u, station=None):
    return initial_stations(d, np.ones(d.shape), u, station)


def test_distances_determine_the_stations():
    u = targets()
    found = start(displacements(u), u)
    # Targets are 10 um off: curvature of 100 mm at 0.5 m is some 2.5 mm, so this is 1 % and less of the distance.
    assert np.linalg.norm(found.position - STATION - CENTRE, axis=1).max() < 5e-3
    assert np.abs(found.dead_path - 0.2).max() < 5e-3


def test_exact_targets_determine_exact_stations():
    u = targets()
    found = start(displacements(u, off=0.0), u)
    assert np.abs(found.position - STATION - CENTRE).max() < 1e-9


def test_wrong_approximate_positions_are_not_used():
    u = targets()
    found = start(displacements(u), u, np.zeros((4, 3)))
    assert np.linalg.norm(found.position - STATION - CENTRE, axis=1).max() < 5e-3


def test_20_per_cent_of_gross_outliers_have_no_effect():
    u = targets()
    d = displacements(u)
    rng = np.random.default_rng(8)
    for row in d:
        row[rng.choice(60, 12, replace=False)] += rng.uniform(-1, 1, 12)
    found = start(d, u)
    assert np.linalg.norm(found.position - STATION - CENTRE, axis=1).max() < 10e-3


def test_coplanar_targets_require_approximate_positions():
    u = targets(thickness=0.0)
    d = displacements(u, off=0.0)
    with raises("network.targets.in_plane"):
        start(d, u)
    found = start(d, u, STATION + CENTRE + 0.02)
    assert np.abs(found.position - STATION - CENTRE).max() < 1e-6


def test_targets_on_a_line_are_refused():
    u = targets() * [1, 0, 0]
    with raises("network.targets.on_line"):
        start(displacements(u), u)


@pytest.mark.parametrize("approximate", [None, STATION + CENTRE])
@pytest.mark.parametrize(
    ("factor", "of_targets", "message"),
    [
        (1e3, 1.0, "readings in mm, stated as m"),
        (1.0, 1e3, "targets in mm, stated as m"),
        (2.0, 1.0, "the optical path, twice the displacement"),
        (-1.0, 1.0, "opposite sign"),
    ],
)
def test_readings_in_another_unit_are_reported(approximate, factor, of_targets, message):
    u = targets()
    with pytest.raises(MethodError, match=message):
        start(factor * displacements(u), of_targets * u, approximate)


def test_a_reversed_sign_is_detected_with_far_stations():
    u = targets()
    d = displacements(u, FAR)
    assert np.isfinite(start(d, u).position).all()
    with pytest.raises(MethodError, match="opposite sign"):
        start(-d, u)


def test_targets_in_another_order_are_refused():
    u = targets()
    d = displacements(u)
    d[2] = d[2, ::-1]
    with pytest.raises(MethodError, match=r"readings of station 3 .* the same order"):
        start(d, u)


def test_few_readings_require_an_approximate_position():
    u = targets()
    d = displacements(u)
    weight = np.ones(d.shape)
    weight[1, 4:] = 0
    with raises("network.station.readings_too_few"):
        initial_stations(d, weight, u, None)
    found = initial_stations(d, weight, u, STATION + CENTRE)
    assert np.abs(found.position[1] - STATION[1] - CENTRE).max() < 1e-12
