"""Supported tilts of a calibration, for usual designs."""

from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets.calibrations.tilt_support import TiltSupport
from errormotion.kinematics.beams import tilt_vector

EVERY_10 = range(0, 360, 10)
EVERY_30 = range(0, 360, 30)
PUBLISHED = (0, 2, 4, 6, 8, 10, 90, 170, 172, 174, 176, 178, 180)
STEEPEST = 45.0


def grid(inclinations, rotations) -> Array:
    a, b = np.meshgrid(np.radians(list(inclinations)), np.radians(list(rotations)))
    return np.asarray(tilt_vector(a.ravel(), b.ravel()))


def scattered(count: int, seed: int = 0) -> Array:
    """Return tilts spread evenly over the disc up to 45 deg."""
    rng = np.random.default_rng(seed)
    return np.asarray(tilt_vector(np.arctan(np.sqrt(rng.uniform(0, 1, count))), rng.uniform(0, 2 * np.pi, count)))


def support(tilts: Array) -> TiltSupport:
    """Return the support of settings as in a calibration."""
    return _support(tilts.tobytes())


@lru_cache(maxsize=4)
def _support(tilts: bytes) -> TiltSupport:
    q = np.frombuffer(tilts).reshape(-1, 2)
    steepest = float(np.hypot(*q.T).max())
    return TiltSupport(q, gap=0.6 * steepest, margin=0.05 * steepest)


def held(tilts: Array, inclination: float, rotations=range(1, 360, 3)) -> NDArray[np.bool_]:
    return support(tilts).holds(tilt_vector(np.radians(inclination), np.radians(list(rotations))))


def without(inclinations, low, high):
    return [a for a in inclinations if not low < a < high]


FINE, COARSE = np.arange(0, 45.1, 2.5), np.arange(0, 45.1, 5.0)


@pytest.mark.parametrize(
    "tilts",
    [
        grid(COARSE, EVERY_10),
        grid(FINE, EVERY_10),
        grid(np.arange(0, 45.1, 7.5), EVERY_30),
        grid(np.arange(0, 45.1, 9.0), EVERY_30),
        grid(np.arange(0, 45.1, 15.0), EVERY_10),
        grid(without(COARSE, 20, 30), EVERY_10),
        scattered(400),
    ],
    ids=["10 x 5 deg", "10 x 2.5 deg", "30 x 7.5 deg", "30 x 9 deg", "10 x 15 deg", "one ring missing", "scattered"],
)
def test_an_even_design_is_supported_throughout(tilts: Array) -> None:
    # 42.5 deg: chords between settings 30 deg apart at 45 deg dip to 44 deg.
    assert all(held(tilts, inclination).all() for inclination in np.arange(0.0, 42.6, 2.5))
    assert support(tilts).holes() == []
    assert not held(tilts, 50.0).any()


@pytest.mark.parametrize(
    ("inclinations", "rotations", "low", "high"),
    [
        (without(COARSE, 20, 35), EVERY_10, 20, 35),
        (without(FINE, 20, 35), EVERY_10, 20, 35),
        (without(FINE, 20, 30), EVERY_10, 20, 30),
        (without(COARSE, 20, 35), EVERY_30, 20, 35),
        (without(COARSE, 15, 40), EVERY_10, 15, 40),
        (without(COARSE, -1, 10), EVERY_10, 0, 10),
        (without(FINE, -1, 10), EVERY_10, 0, 10),
        (without(COARSE, -1, 10), EVERY_30, 0, 10),
        ([40], EVERY_10, 0, 40),
        ([40], EVERY_30, 0, 40),
    ],
)
def test_a_hole_along_the_inclination_is_refused_completely(inclinations, rotations, low, high) -> None:
    tilts = grid(inclinations, rotations)
    # Within the margin of the settings around it, here 3 deg at right angles, a tilt is supported. Between settings
    # 30 deg apart the straight side lies by 3.4 % of its tilt farther in.
    for inclination in np.arange(low + 3.2 if low else 0.0, high * 0.965 - 3.1, 0.5):
        assert not held(tilts, inclination).any(), inclination
    [hole] = support(tilts).holes()
    assert np.degrees(hole.inclination) == pytest.approx([low, high])
    assert np.degrees(hole.rotation) == pytest.approx([0, 360])
    assert not support(tilts).holds(hole.middle)
    for beside in (low - 2.0, high + 2.0):
        if min(inclinations) < beside < max(inclinations):
            assert held(tilts, beside).all()


def test_a_hole_along_the_inclination_may_be_part_of_a_ring() -> None:
    tilts = grid(FINE, EVERY_10)
    alpha, beta = np.degrees(np.arctan(np.hypot(*tilts.T))), np.degrees(np.arctan2(tilts[:, 1], tilts[:, 0]))
    missing = (alpha > 20.1) & (alpha < 34.9) & (beta > 5) & (beta < 175)
    q = tilt_vector(np.radians(27.5), np.radians([60.0, 90.0, 120.0, 200.0, 270.0, 355.0]))
    assert support(tilts[~missing]).holds(q).tolist() == [False, False, False, True, True, True]


def test_a_missing_sector_is_a_hole_if_it_is_wide() -> None:
    tilts = grid(COARSE, [b for b in EVERY_10 if not 50 < b < 130])
    assert not held(tilts, 35.0, range(56, 125)).any()
    assert held(tilts, 35.0, [*range(51), *range(130, 360)]).all()
    assert held(tilts, 10.0).all()
    [hole] = support(tilts).holes()
    assert np.degrees(hole.rotation) == pytest.approx([50, 130])


def test_the_published_design_leaves_four_holes_between_its_rotations() -> None:
    tilts = grid(np.arange(-45, 46, 5), PUBLISHED)
    rotations = [*range(11), 90, *range(170, 191), 270, *range(350, 360)]
    assert all(held(tilts, inclination, rotations).all() for inclination in range(46))
    assert all(held(tilts, inclination).all() for inclination in (0, 5, 10, 15))
    between = [b for b in range(360) if min(abs(b - known) for known in rotations) > 8]
    assert not any(held(tilts, inclination, between).any() for inclination in (27, 35, 43))
    holes = support(tilts).holes()
    found = [np.degrees(hole.rotation).round().astype(int).tolist() for hole in holes]
    assert found == [[10, 90], [90, 170], [190, 270], [270, 350]]


def test_a_wide_gap_in_few_scattered_settings_is_a_hole() -> None:
    tilts = scattered(300)
    tilts = tilts[np.hypot(*(tilts - [0.5, 0.0]).T) > 0.35]
    assert not support(tilts).holds([0.5, 0.0])
    assert support(tilts).holds([-0.5, 0.0])


@given(shift=st.floats(0, 360), jitter=st.integers(0, 2**31), design=st.sampled_from(["even", "hole"]))
@settings(max_examples=25, deadline=None)
def test_neither_the_zero_of_the_rotation_nor_small_misalignments_matter(shift, jitter, design) -> None:
    inclinations = without(COARSE, 20, 35) if design == "hole" else COARSE
    tilts = grid(inclinations, np.add(EVERY_10, shift))
    # 0.1 deg, as a gauge is set
    tilts = tilts + np.random.default_rng(jitter).normal(0.0, 0.0017, tilts.shape)
    for inclination in (25.0, 27.5, 30.0):
        assert (held(tilts, inclination) == (design == "even")).all()
    assert held(tilts, 10.0).all()
    assert held(tilts, 40.0).all()


@given(seed=st.integers(0, 2**31), count=st.integers(1, 60))
@settings(max_examples=40, deadline=None)
def test_settings_are_supported_and_tilts_outside_of_the_hull_are_not(seed, count) -> None:
    tilts = scattered(count, seed)
    found = support(tilts)
    assert found.holds(tilts).all()
    away = np.hypot(*tilts.T).max() + found.margin + 1e-6
    assert not found.holds(away * np.stack([np.cos(np.arange(6.0)), np.sin(np.arange(6.0))], axis=1)).any()
    assert found.holds([[np.nan, 0.0]]).tolist() == [False]
