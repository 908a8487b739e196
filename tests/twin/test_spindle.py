"""The spindle with known error motions: its angle, its asynchronous motion, and what sensors read of a ball."""

import numpy as np
import pytest

from errormotion.twin.spindle import TAU, Spindle, displacements

R = 12.5e-3


@pytest.mark.parametrize("speed", [3000.0, -1200.0])
def test_pulses_are_at_whole_turns(speed):
    spindle = Spindle(speed=speed, ripple=(0.02, 13.0))
    pulses = spindle.pulses(1.0)
    turns = spindle.angle(pulses) / TAU
    np.testing.assert_allclose(turns, np.sign(speed) * np.arange(pulses.size), atol=1e-9)
    assert pulses.size == int(abs(spindle.angle(np.array([1.0]))[0]) / TAU) + 1


def test_the_asynchronous_motion_has_the_stated_size_and_no_mean_over_turns():
    spindle = Spindle(asynchronous=30e-9)
    angle = TAU * np.arange(200_000) / 100
    motion = spindle.other(angle, np.random.default_rng(1))[:, :3]
    # Half of the variance is three vibrations, whose size is exact; the scatter of the rest is that of 1e5 numbers
    np.testing.assert_allclose(motion.std(axis=0), 30e-9, rtol=0.02)
    assert np.abs(motion.reshape(2000, 100, 3).mean(axis=0)).max() < 5 * 30e-9 / np.sqrt(2000)


def test_a_displacement_across_the_line_of_sight_lowers_a_ball():
    """sqrt(R^2 - b^2) - R is -32 nm for b = 28.3 um and R = 12.5 mm."""
    b = np.sqrt(2 * R * 32e-9)
    motion = np.array([[0.0, b, 0.0, 0.0, 0.0, 0.0]])
    outward = displacements(motion, np.zeros(1), np.array([[1.0, 0, 0]]), np.array([[R, 0, 0]]), R)
    inward = displacements(motion, np.zeros(1), np.array([[-1.0, 0, 0]]), np.array([[R, 0, 0]]), R)
    assert outward[0, 0] == pytest.approx(-32e-9, rel=1e-5)
    assert inward[0, 0] == pytest.approx(32e-9, rel=1e-5)


def test_the_form_turns_with_the_spindle():
    """What is at +X at angle 0 is at +Y after a quarter of a turn."""
    form = (np.array([1.0, 3.0]), np.tile([20e-9, 50e-9], (2, 1)), np.tile([10e-9, 0.0], (2, 1)))
    place = np.array([[R, 0, 0], [0, R, 0]])
    read = displacements(np.zeros((2, 6)), np.array([0.0, TAU / 4]), place / R, place, R, form)
    assert read[0, 0] == pytest.approx(70e-9, abs=1e-15)
    assert read[1, 1] == pytest.approx(read[0, 0], abs=1e-15)
