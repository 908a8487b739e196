"""The warming crossbeam: its carriage follows the guide, and the seed determines both."""

from dataclasses import replace

import numpy as np
import pytest

from errormotion.twin import VirtualMachine

POSITIONS = -0.7 + 0.2 * np.arange(8)


@pytest.fixture
def gantry():
    """A gantry whose Y axis moves back and forth from time 0."""
    return VirtualMachine("gantry", seed=3)


def test_carriage_follows_its_guide(gantry):
    step = 1e-4
    ahead, behind, here = (gantry.crossbeam.twist(7200.0, POSITIONS + d) for d in (step, -step, 0.0))
    slope = (ahead - behind) / (2 * step)
    assert here[:, 3] == pytest.approx(slope[:, 2], abs=1e-11)
    assert here[:, 5] == pytest.approx(-slope[:, 0], abs=1e-11)


def test_carriage_may_rotate_relative_to_the_guide(gantry):
    own = np.array([0, 0, 0, 5e-6, 0, 0])
    turned = replace(gantry.crossbeam, own=own)
    more = turned.twist(1e6, POSITIONS) - gantry.crossbeam.twist(1e6, POSITIONS)
    assert more == pytest.approx(np.tile(own, (8, 1)), abs=1e-15)


def test_seed_determines_the_crossbeam(gantry):
    t, y = 3600.0, POSITIONS
    assert np.array_equal(VirtualMachine("gantry", seed=3).crossbeam.twist(t, y), gantry.crossbeam.twist(t, y))
    assert not np.array_equal(VirtualMachine("gantry", seed=4).crossbeam.twist(t, y), gantry.crossbeam.twist(t, y))
