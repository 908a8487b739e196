"""Where to put the planes: optimum against brute force, against the limit that theory sets, and within its limits."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from errormotion.errors import MethodError
from errormotion.methods.beam_direction import design
from errormotion.methods.beam_direction.direction import bound

BEAM = np.array([np.sin(np.radians(20)), 0.0, -np.cos(np.radians(20))])
LIMITS = design.Limits(
    beam=BEAM,
    beam_uncertainty=np.radians(0.3),
    reach=16e-3,
    travel=np.array([40e-3, 40e-3, 40e-3]),
    plate=80e-3,
    inclination=(0.0, np.radians(60)),
    rotation=(0.0, 2 * np.pi),
    max_inclination=np.radians(45),
    readings=180,
    noise=0.3e-6,
)
PAPER = np.radians([[20.0, 0.0], [20.0, 90.0]])


def planes(number):
    return np.radians([[20.0, 360.0 * i / number] for i in range(number)])


def expected(found, limits=LIMITS):
    """Return the worse angle's uncertainty by the Cramer-Rao bound of the places and planes themselves."""
    return design.worst_angle(
        design.across(limits.beam) @ bound(found.stages(), found.normals, limits.beam, limits.noise)
        @ design.across(limits.beam).T
    )  # fmt: skip


@pytest.fixture(scope="module")
def two():
    return design.optimise(LIMITS, PAPER)


def test_no_pair_of_planes_on_a_grid_is_better(two):
    angles = [(a, b) for a in np.arange(5, 61, 5.0) for b in np.arange(0, 360, 15.0)]
    grid = np.radians(angles)
    grid = grid[design.inclinations(design.plane_normals(grid), BEAM) <= LIMITS.max_inclination]
    half = np.array([0.5, 0.5])
    best = min(
        design.worst_angle(design.spread(grid[[i, j]], half, LIMITS)) for i, j in combinations(range(len(grid)), 2)
    )
    shares = two.readings.sum(axis=1) / LIMITS.readings
    assert design.worst_angle(design.spread(two.planes, shares, LIMITS)) < best


def test_the_limit_of_theory_is_nearly_met_and_never_beaten(two):
    limit = design.least_angle(LIMITS)
    for found in (two, design.optimise(LIMITS, planes(3))):
        shares = found.readings.sum(axis=1) / LIMITS.readings
        # Not quite met: the gauge's plane cannot be tilted both ways across the beam with strokes along the axes that
        # all lower the reading as the beam would (see the module), and some readings go to the stroke along Y.
        assert 1.0 < design.worst_angle(design.spread(found.planes, shares, LIMITS)) / limit < 1.4


def test_what_the_search_believes_is_what_the_places_bear_out(two):
    shares = two.readings.sum(axis=1) / LIMITS.readings
    believed = design.worst_angle(design.spread(two.planes, shares, LIMITS))
    # n equally spaced places have the variance L^2 (n + 1) / (12 (n - 1)): a little more than L^2 / 12.
    assert expected(two) == pytest.approx(believed, rel=0.1)
    assert expected(two) < believed


def test_the_optimum_beats_strokes_of_one_length_with_as_many_readings(two):
    usual = design.equal_strokes(PAPER, LIMITS)
    assert usual.readings.sum() == two.readings.sum() == LIMITS.readings
    assert expected(usual) > 3 * expected(two)


@pytest.mark.parametrize("number", [2, 3, 4])
def test_every_place_keeps_to_range_travel_and_plate(number):
    found = design.optimise(LIMITS, planes(number))
    assert found.readings.sum() == LIMITS.readings
    assert found.readings.min() >= design.LEAST_READINGS
    assert np.all(design.inclinations(found.normals, BEAM) <= LIMITS.max_inclination + 1e-9)
    for places, normal in zip(found.stages(), found.normals, strict=True):
        reading = -(places @ normal) / (normal @ BEAM)
        assert np.ptp(reading) <= LIMITS.reach * (1 + 1e-9)
        assert np.all(np.ptp(places, axis=0) <= LIMITS.travel * (1 + 1e-9))
        spot = places + reading[:, None] * BEAM
        assert np.ptp(spot @ normal) < 1e-12
        assert np.linalg.norm(spot, axis=1).max() <= LIMITS.plate / 2 * (1 + 1e-9)


def test_a_scale_error_of_the_sensor_needs_planes_all_around_the_beam():
    limits = replace(LIMITS, scale_uncertainty=2e-4)
    pair, three = (design.optimise(limits, planes(number)) for number in (2, 3))

    def uncertainty(found):
        return design.worst_angle(design.spread(found.planes, found.readings.sum(axis=1) / limits.readings, limits))

    # With two planes at 45 deg the scale error goes into the angle whole; with three it cancels.
    assert uncertainty(pair) > 0.9 * limits.scale_uncertainty
    assert uncertainty(three) < 0.1 * limits.scale_uncertainty


def test_an_inclination_error_that_grows_with_the_tilt_makes_the_planes_flatter():
    limits = replace(LIMITS, slope_uncertainty=lambda q: 1e-6 + 3e-4 * np.sum(q**2, axis=-1) ** 2)
    steepest = design.inclinations(design.optimise(limits, PAPER).normals, BEAM).max()
    assert steepest < np.radians(30)


def test_a_gauge_that_turns_a_little_only_is_used_within_what_it_turns():
    limits = replace(LIMITS, rotation=np.radians([60.0, 120.0]), inclination=np.radians([10.0, 45.0]))
    found = design.optimise(limits, np.radians([[20.0, 60.0], [20.0, 120.0]]))
    assert np.all(found.planes >= np.radians([10.0, 60.0]) - 1e-12)
    assert np.all(found.planes <= np.radians([45.0, 120.0]) + 1e-12)


def test_what_cannot_be_planned_is_refused():
    with pytest.raises(MethodError, match="expected two or more; found 1"):
        design.optimise(LIMITS, PAPER[:1])
    with pytest.raises(MethodError, match="need 18 readings or more; found 12"):
        design.optimise(replace(LIMITS, readings=12), PAPER)
    with pytest.raises(MethodError, match="looks down on the gauge"):
        design.optimise(replace(LIMITS, beam=-BEAM), PAPER)
