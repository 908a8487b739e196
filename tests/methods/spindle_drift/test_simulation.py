"""Raw datasets for Monte Carlo: valid, with exactly the noise that they state, and from one machine."""

import numpy as np
import pytest
from coded import raises
from scipy.optimize import least_squares

from errormotion.datasets import validate
from errormotion.methods.spindle_drift import simulation
from errormotion.twin import Event, VirtualMachine, intersections
from errormotion.twin.sensors.sensing import REPEATABILITY, SPECKLE

T = np.linspace(1.0, 6240.0, 50)
MINUTE = 60.0


@pytest.fixture(scope="module")
def machine() -> VirtualMachine:
    """A cold machine at rest."""
    return VirtualMachine("cframe", seed=3)


@pytest.fixture(scope="module")
def warming() -> VirtualMachine:
    """15000 1/min; compensation of Z off after 101 min and of Y after 102 min."""
    machine = VirtualMachine("cframe", seed=3)
    machine.start(
        [
            Event(0, spindle_speed=15000),
            Event(101 * MINUTE, compensation={"Z": False}),
            Event(102 * MINUTE, compensation={"Y": False}),
        ]
    )
    return machine


@pytest.mark.parametrize("beams", ["true", "nominal"])
def test_drift_is_a_valid_raw_dataset(warming, beams):
    raw = simulation.raw_drift(warming, T, beams=beams, seed=1)
    validate(raw)
    assert not np.isnan(raw.distance).any()
    stated = getattr(warming.frame, f"{beams}_origin")
    assert np.array_equal(raw.beam_origin, stated)


def test_beams_can_be_given_with_their_covariance(warming):
    covariance = np.tile(np.diag([1e-12] * 3 + [1e-8] * 3), (5, 1, 1))
    given = (warming.frame.nominal_origin, warming.frame.nominal_direction, covariance)
    raw = simulation.raw_drift(warming, T, beams=given, seed=1)
    validate(raw)
    assert np.array_equal(raw.beam_covariance, covariance)


def test_unknown_beams_are_refused(warming):
    with raises("simulation.beams.form"):
        simulation.raw_drift(warming, T, beams="drawn", seed=1)


def test_beam_detection_is_a_valid_raw_dataset(machine):
    raw = simulation.raw_beam_detection(machine, seed=1)
    validate(raw)
    assert dict(raw.sizes) == {"channel": 5, "profile": 6, "step": 101, "direction": 3}


@pytest.mark.parametrize("averaged", [1, 100, 10000])
def test_drift_noise_is_exactly_the_stated_one(warming, averaged):
    still = warming.still_readings(T, expansion=False)
    raws = [simulation.raw_drift(warming, T, averaged=averaged, seed=s) for s in range(20)]
    noise = np.array([raw.distance.values - still for raw in raws])
    stated = float(raws[0].distance_noise)
    assert stated == pytest.approx(0.3e-6 / np.sqrt(averaged))
    assert noise.std() == pytest.approx(stated, rel=5 / np.sqrt(2 * noise.size))
    assert abs(noise.mean()) < 5 * stated / np.sqrt(noise.size)


def test_beam_detection_noise_is_the_stated_one(machine):
    raws = [simulation.raw_beam_detection(machine, seed=s) for s in range(5)]
    frame = machine.frame
    ideal = intersections.to_sphere(
        frame.true_origin[:, None, None, :],
        frame.true_direction[:, None, None, :],
        raws[0].sphere_centre.values,
        machine.sphere_radius,
    )
    noise = np.array([raw.distance.values for raw in raws]) - ideal
    stated = float(raws[0].distance_noise)
    assert stated == pytest.approx(np.hypot(SPECKLE, REPEATABILITY), rel=1e-4)
    # oblique incidence lets a position error count up to 3 % more than stated
    assert noise.std() == pytest.approx(stated, rel=0.01 + 5 / np.sqrt(2 * noise.size))


def test_noise_seed_changes_the_noise_and_nothing_else(warming):
    one, same, other = (simulation.raw_drift(warming, T, seed=s) for s in (1, 1, 2))
    assert one.identical(same)
    assert not np.array_equal(one.distance, other.distance)
    assert one.drop_vars("distance").identical(other.drop_vars("distance"))
    assert simulation.raw_beam_detection(warming, seed=1).identical(simulation.raw_beam_detection(warming, seed=1))


def test_systematic_effects_can_be_switched(warming):
    plain = simulation.raw_drift(warming, T, seed=1, radius_error=False)
    assert float(plain.bar_radius) == warming.bar.radius
    assert float(simulation.raw_drift(warming, T, seed=1).bar_radius) == warming.bar_radius
    expanding = simulation.raw_drift(warming, T, seed=1, expansion=True).distance - plain.distance
    assert float(expanding[0, -1]) > 1e-6
    cold = VirtualMachine("cframe", 3, warm=False)
    assert np.ptp(simulation.raw_drift(cold, T, seed=1).distance.values[0]) > 9e-6
    assert np.ptp(simulation.raw_drift(cold, T, seed=1, warm_up=False).distance.values[0]) < 3e-6


def test_readings_agree_with_the_truth(warming):
    # A bar fitted to the five readings, sample by sample, lies where the true twist says.
    raw = simulation.raw_drift(warming, T[[0, 20, 49]], averaged=10**12, seed=1, radius_error=False, warm_up=False)
    u, low, high = raw.beam_direction.values, *raw.level.values
    hits = raw.beam_origin.values[:, None] + raw.distance.values[..., None] * u[:, None]
    point, axis = warming.spindle_axis(raw.time)
    for k in range(raw.sizes["time"]):

        def off(p, k=k):
            at = np.array([p[0], p[1], 0.0]) * 1e-3
            along = np.array([p[2], p[3], 1.0])
            away = np.cross(hits[:4, k] - at, along / np.linalg.norm(along))
            return np.linalg.norm(away, axis=1) * 1e3 - float(raw.bar_radius) * 1e3

        x, y, a, b = least_squares(off, np.zeros(4), xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        for z in (low, high):
            true = point[k] + axis[k] * (z - point[k, 2]) / axis[k, 2]
            assert [x * 1e-3 + a * z, y * 1e-3 + b * z] == pytest.approx(true[:2], abs=1e-11)
        along = np.array([a, b, 1.0]) / np.linalg.norm([a, b, 1.0])
        foot = np.array([x, y, 0]) * 1e-3
        foot = foot + along * ((hits[4, k] - foot) @ along)
        assert foot == pytest.approx(point[k], abs=1e-11)
