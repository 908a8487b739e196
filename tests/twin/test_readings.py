"""Readings of the sensors: exact geometry under the true motion, plus noise, runout, texture, warm-up and expansion."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from coded import raises
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from errormotion.twin import Event, StepProgram, VirtualMachine, intersections
from errormotion.twin.sensors.sensing import REPEATABILITY, SPECKLE, Sensing

RATE = 20000.0
MIN = 60.0
ALL = np.arange(5)


def noiseless(machine, **changes):
    frame = replace(machine.frame, noise=np.zeros(5))
    parts = {"seed": machine.seed, "frame": frame, "bar": machine.bar, "sphere_radius": machine.sphere_radius}
    return Sensing(**(parts | {"state": machine.state, "sensors_on_for": machine.sensors_on_for} | changes))


def exact(sensing, t):
    """Each sample separately: the bar rotated as a rigid body, exact intersection with the beam."""
    bar, frame = sensing.bar, sensing.frame
    point, axis = sensing.axis(t)
    angle = 2 * np.pi * sensing.state.schedule.turning(t)[:, 0]
    turn = Rotation.from_rotvec(angle[:, None] * axis)
    start = bar.eccentricity * np.array([np.cos(bar.eccentricity_angle), np.sin(bar.eccentricity_angle), 0])

    def leaning(tilt):
        lean = axis + turn.apply(np.cross([*tilt, 0.0], [0.0, 0.0, 1.0]))
        return lean / np.linalg.norm(lean, axis=1, keepdims=True)

    origin = frame.origins(sensing.state.warming("frame", t))
    beam = frame.true_direction[:, None, :]
    side = intersections.to_cylinder(origin[:4], beam[:4], point + turn.apply(start), leaning(bar.wobble), bar.radius)
    face = point + bar.axial_runout * np.cos(angle)[:, None] * axis
    end = intersections.to_plane(origin[4:], beam[4:], face, leaning(bar.face_tilt))
    place = np.mod(angle / (2 * np.pi), 1)
    grid = np.arange(bar.texture.shape[1] + 1) / bar.texture.shape[1]
    texture = [np.interp(place, grid, [*track, track[0]]) for track in bar.texture]
    return np.concatenate([side, end]) + texture + frame.warm_up_offset(t + sensing.sensors_on_for)


@pytest.mark.parametrize("time", [0.0, 0.5, 0.75, 10.0, 31.99, 300.0, 6000.0, 6060.0, 6060.3, 6120.0, 6120.45, 6200.0])
def test_samples_are_exact_to_a_nanometre(warming, time):
    sensing = noiseless(warming)
    i = int(time * RATE) + np.arange(400)
    out = np.empty((5, i.size))
    sensing.read_bar(out, i[0], RATE, ALL)
    assert np.max(np.abs(out - exact(sensing, i / RATE))) < 1e-9


@settings(max_examples=25, deadline=None)
@given(
    first=st.integers(0, 200_000), cuts=st.lists(st.integers(0, 900), max_size=6), rate=st.sampled_from([997.0, RATE])
)
def test_block_size_does_not_change_a_single_bit(first, cuts, rate):
    machine = VirtualMachine("cframe", seed=9)
    machine.start([Event(0, 15000), Event(10, compensation={"Z": False}), Event(33, 3000)])
    whole = machine.distances(first, 900, rate)
    edges = [0, *sorted(cuts), 900]
    again = VirtualMachine("cframe", seed=9)
    again.start(machine.state.schedule.events)
    parts = [again.distances(first + a, b - a, rate) for a, b in pairwise(edges)]
    assert np.array_equal(np.concatenate(parts, axis=1), whole)


def test_reading_of_a_channel_does_not_depend_on_the_others(warming):
    together = warming.distances(5000, 300, RATE)
    assert np.array_equal(warming.distances(5000, 300, RATE, ["Y2", "Z"]), together[[3, 4]])


def test_noise_is_the_stated_one_in_every_channel(warming):
    n = 100_000
    clean = np.empty((5, n))
    noiseless(warming).read_bar(clean, 40_000, RATE, ALL)
    noise = warming.distances(40_000, n, RATE) - clean
    assert noise.std(axis=1) == pytest.approx(warming.frame.noise, rel=5 / np.sqrt(2 * n))
    assert np.max(np.abs(np.corrcoef(noise) - np.eye(5))) < 5 / np.sqrt(n)


def test_runout_and_texture_vanish_in_the_mean_over_whole_turns(warming):
    sensing = noiseless(warming)
    first = int(3000 * RATE)
    out = np.empty((5, 10_000))  # half a second, 125 turns
    sensing.read_bar(out, first, RATE, ALL)
    assert np.all(np.ptp(out, axis=1) > 0.5e-6)
    still = sensing.still((first + np.arange(10_000)) / RATE).mean(axis=1)
    # what is left is of second order: eccentricity^2 / (4 radius) = 0.3 nm
    assert np.max(np.abs(out.mean(axis=1) - still)) < 1e-9


def test_runout_is_some_micrometres_once_per_turn(warming):
    out = np.empty((5, 20_000))
    noiseless(warming).read_bar(out, 40_000, RATE, ALL)
    spectrum = 2 * np.abs(np.fft.rfft(out, axis=1)) / out.shape[1]
    once = spectrum[:4, 250]
    assert np.all((once > 0.8e-6) & (once < 5e-6))


def test_pattern_repeats_every_turn(warming):
    out = np.empty((5, 160))  # two turns of 80 samples
    noiseless(warming).read_bar(out, int(100 * RATE), RATE, ALL)
    assert np.max(np.abs(out[:, 80:] - out[:, :80])) < 0.1e-9  # 4 ms of drift


def test_switching_the_compensation_of_z_lifts_the_end_face(warming):
    before = warming.distances(int(6059.5 * RATE), 10_000, RATE, ["Z"]).mean()
    after = warming.distances(int(6061 * RATE), 10_000, RATE, ["Z"]).mean()
    assert after - before == pytest.approx(29.3e-6, rel=0.03)


def test_cold_sensors_warm_up_by_ten_and_a_half_micrometres():
    cold, warm = VirtualMachine("cframe", 3, warm=False), VirtualMachine("cframe", 3)
    lack = cold.still_readings([0.0, 7200.0, 36000.0]) - warm.still_readings([0.0, 7200.0, 36000.0])
    assert lack[:, 0] == pytest.approx(-10.5e-6, rel=0.06)
    assert np.all(np.abs(lack[:, 1]) < 0.1e-6)  # settled after two hours
    assert np.all(np.abs(lack[:, 2]) < 1e-9)


def test_frame_expands_with_its_temperature(warming):
    t = [6000.0]
    rise = warming.state.warming("frame", t)[0]
    with_it = warming.still_readings(t)[:, 0]
    without = warming.still_readings(t, expansion=False)[:, 0]
    # sideways sensors back away from the bar, the lower one comes nearer; obliquity of 12 mrad and 30 mrad is 1e-3
    along = np.sum(warming.frame.true_expansion * warming.frame.nominal_direction, axis=1)
    expected = -along * rise
    assert with_it - without == pytest.approx(expected, rel=2e-3)


def test_the_true_expansion_is_a_tenth_off_the_drawn_one():
    ratios = []
    for seed in range(60):
        frame = VirtualMachine("cframe", seed).frame
        drawn = np.abs(frame.expansion).sum(axis=1)
        assert drawn == pytest.approx([2.1e-6, 2.1e-6, 2.4e-6, 2.4e-6, 1.3e-6])
        ratios.append(frame.true_expansion.sum(axis=1) / drawn)
    assert np.ptp(ratios, axis=1) == pytest.approx(0.0, abs=1e-12)  # one frame, one material
    assert np.std(ratios) == pytest.approx(0.1, rel=0.3)  # of 60 draws 9 % is chance


def test_out_of_range_is_nan(machine):
    far = replace(machine.frame, true_origin=machine.frame.true_origin - 1.5e-3 * machine.frame.nominal_direction)
    out = np.empty((5, 100))
    noiseless(machine, frame=far).read_bar(out, 0, RATE, ALL)
    assert np.isnan(out).all()
    near = replace(machine.frame, true_origin=machine.frame.true_origin + 1.5e-3 * machine.frame.nominal_direction)
    noiseless(machine, frame=near).read_bar(out, 0, RATE, ALL)
    assert np.isnan(out).all()


def scan(machine, channel=0, across=(0, 1, 0), begin=2.0, count=11, step=0.2e-3):
    """A scan at mid-range, symmetric to the nominal beam, at 1 kHz."""
    frame = machine.frame
    middle = frame.nominal_origin[channel] + (1e-3 + machine.sphere_radius) * frame.nominal_direction[channel]
    start = middle - (count - 1) / 2 * step * np.asarray(across)
    return StepProgram(start, across, step, count, begin=begin)


def rests(program, rate):
    """Samples inside each rest."""
    inner = slice(1, -1)
    return [
        np.arange(int(a * rate) + 2, int(b * rate) - 2)
        for a, b in zip(program.arrivals[inner], program.departures[inner], strict=True)
    ]


def test_readings_of_a_resting_sphere_follow_the_true_beam(machine):
    program = scan(machine)
    out = machine.distances(0, int(program.end * 1000), 1000.0, ["X1"], "sphere", program)[0]
    means = np.array([out[i].mean() for i in rests(program, 1000.0)])
    ideal = intersections.to_sphere(
        machine.frame.true_origin[0], machine.frame.true_direction[0], program.places[1:-1], machine.sphere_radius
    )
    # 0.5 um speckle, 0.3 um repeatability, some nm of drift with the air: five sigma
    assert np.max(np.abs(means - ideal)) < 5 * np.hypot(SPECKLE, REPEATABILITY)
    assert np.ptp(ideal) > 50e-6


def test_speckle_and_repeatability_do_not_average_out_in_time(machine):
    errors = []
    for k in range(6):
        program = scan(machine, begin=200.0 * k, count=101, step=20e-6)
        first = int(program.begin * 1000)
        out = machine.distances(first, int(program.duration * 1000), 1000.0, ["X1"], "sphere", program)[0]
        means = np.array([out[i - first].mean() for i in rests(program, 1000.0)])
        ideal = intersections.to_sphere(
            machine.frame.true_origin[0], machine.frame.true_direction[0], program.places[1:-1], machine.sphere_radius
        )
        errors.append(means - ideal - np.mean(means - ideal))
    sigma = np.std(errors)
    assert sigma == pytest.approx(np.hypot(SPECKLE, REPEATABILITY), rel=5 / np.sqrt(2 * 606))
    # another pass over the same places is another draw
    assert np.corrcoef(errors).max(initial=-1, where=~np.eye(6, dtype=bool)) < 5 / np.sqrt(101)


def test_sphere_stands_still_while_it_rests_and_moves_between(machine):
    program = scan(machine)
    sensing = noiseless(machine)
    out = np.empty((1, int(program.end * 1000)))
    sensing.read_sphere(out, 0, 1000.0, ALL[:1], program)
    places = rests(program, 1000.0)
    assert all(np.ptp(out[0, i]) < 1e-15 for i in places)
    between = out[0, places[0][-1] : places[1][0]]
    assert np.ptp(between) > 10e-6
    assert np.all(np.diff(between) <= 1e-9)  # towards the middle the sphere comes nearer


def test_sphere_readings_do_not_depend_on_block_size(machine):
    program = scan(machine)
    whole = machine.distances(0, 9000, 1000.0, None, "sphere", program)
    parts = [machine.distances(a, 600, 1000.0, None, "sphere", program) for a in range(0, 9000, 600)]
    assert np.array_equal(np.concatenate(parts, axis=1), whole, equal_nan=True)


def test_missed_sphere_has_no_reading(machine):
    program = scan(machine, count=3)
    assert np.isnan(machine.distances(0, 3000, 1000.0, ["X2"], "sphere", program)).all()


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ((0, 10, RATE, ["X3"]), "virtual.channels.unknown"),
        ((-1, 10, RATE), "virtual.samples.count"),
        ((0, 10, 0.0), "virtual.samples.count"),
        ((0, 10, RATE, None, "sphere"), "virtual.tool.unknown"),
        ((0, 10, RATE, None, "probe"), "virtual.tool.unknown"),
    ],
)
def test_invalid_requests_are_refused(machine, arguments, code):
    with raises(code):
        machine.distances(*arguments)
