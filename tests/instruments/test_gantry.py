"""A measurement on the virtual gantry: programs of the control, profiles of the profiler, and heat."""

import itertools
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pytest
from armed import CONTROLLER
from coded import raises

from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.instruments.controller.virtual import VirtualController
from errormotion.instruments.line_profiler.keyence_ljx import KeyenceLJX, LJXSettings
from errormotion.instruments.point_lds.optoncdt import OptoNCDT, OptoSettings
from errormotion.instruments.simulators import world
from errormotion.kinematics.poses import displaced
from errormotion.plugins.readings import Profiles
from errormotion.twin import VirtualMachine
from errormotion.twin.artefacts.pieces import circular_pocket, swept
from errormotion.twin.sensors.profiler import Disturbances, Profiler

CONTROL = "sim://gantry/controller?seed=3"
SMALL = "sim://gantry/profiler?seed=3&points=80&pitch=4e-4&encoder_step=500"
PERFECT = SMALL + "&disturbances=none"
STEP = 1e-7  # m: the Z unit
PROFILER = Profiler(80, 4e-4, disturbances=Disturbances.none())
PATIENT, FAST = LJXSettings(timeout=10.0), LJXSettings(timeout=0.3)
FEED = 25e-3  # m/s


def forwards(start: float, end: float) -> str:
    """A pass in +Y, in mm, without the return."""
    return f"%\nG90 G94 G21\nG1 Y{start} F1500\nG4 P2.0\nG1 Y{end}\nM30\n%"


WARM_UP = "G1 Y-600 F3600\nY600\nY-600\nM30"


@dataclass
class Pass:
    """Profiles of a pass, and the world's time at the end of each block."""

    blocks: list[Profiles]
    times: list[float]

    @property
    def heights(self) -> np.ndarray:
        return np.concatenate([block.heights for block in self.blocks])

    @property
    def encoder(self) -> np.ndarray:
        return np.concatenate([block.encoder for block in self.blocks])

    @property
    def line_times(self) -> np.ndarray:
        """Of each line: from the end of its block back at the measuring feed, s."""
        back = [(block.encoder[-1] - block.encoder) * 1e-6 / FEED for block in self.blocks]
        return np.concatenate([end - before for end, before in zip(self.times, back, strict=True)])


@contextmanager
def gantry(profiler: str = PERFECT, settings: LJXSettings = PATIENT) -> Iterator[tuple[VirtualController, KeyenceLJX]]:
    with VirtualController(CONTROL, CONTROLLER) as controller, KeyenceLJX(profiler, settings) as device:
        yield controller, device


def measure(controller: VirtualController, profiler: KeyenceLJX, lines: int, block: int = 10) -> Pass:
    stream, found = profiler.stream(block), Pass([], [])
    for profiles in itertools.islice(stream, lines // block):
        found.blocks.append(profiles)
        found.times.append(controller.state()["time"])
    stream.close()
    return found


def finish(controller: VirtualController) -> None:
    while controller.state()["running"]:
        controller.elapse(1.0)


def scan(controller: VirtualController, profiler: KeyenceLJX, start: float, end: float, lines: int) -> Pass:
    """A pass from the start in mm; without a client on the way to the start."""
    controller.run_program(f"G0 Y{start}\nM30")
    finish(controller)
    controller.run_program(forwards(start, end))
    return measure(controller, profiler, lines)


def one_scan(address: str, start: float, end: float, lines: int) -> Pass:
    with gantry(address) as (controller, profiler):
        return scan(controller, profiler, start, end, lines)


def same(heights: np.ndarray, expected: np.ndarray, most: float) -> bool:
    """Whether heights agree except for points at an outline, which rounding may assign to either side."""
    both = np.isfinite(heights) & np.isfinite(expected)
    assert (np.isfinite(heights) != np.isfinite(expected)).mean() < 1e-3
    return bool(np.abs(heights - expected)[both].max() <= most)


# ------------------------------------------------------------------ profiles


def test_a_pass_agrees_with_the_twin_for_the_same_lines() -> None:
    """Two artefacts, cold: heights to half a Z unit, counts at absolute multiples, no heights elsewhere."""
    found = one_scan(PERFECT + "&artefacts=0.1,0.25", 50, 300, 500)
    assert found.encoder.tolist() == list(range(50500, 300001, 500))
    crossbeam, y = VirtualMachine("gantry", seed=3).crossbeam, found.encoder * 1e-6
    for position in (0.1, 0.25):
        over = np.abs(y - position) < 0.033
        carriage = crossbeam.carriage(0.0, y[over], position, "axis")
        lines = crossbeam.lines(carriage, crossbeam.artefact_pose(3, position))
        truth = PROFILER.scan(swept(), lines)
        assert np.isfinite(truth).mean() > 0.8
        assert same(found.heights[over], truth, STEP / 2 + 1e-12)
        assert np.ptp(truth[np.isfinite(truth)]) > 3e-3
    nowhere = (np.abs(y - 0.1) > 0.033) & (np.abs(y - 0.25) > 0.033)
    assert np.isnan(found.heights[nowhere]).all()
    assert sum(block.dropped for block in found.blocks) == 0


def test_a_warm_pass_contains_the_true_error_of_each_line_at_its_time() -> None:
    with gantry(PERFECT + "&artefacts=0.1") as (controller, device):
        cold = scan(controller, device, 60, 140, 160)
        finish(controller)
        controller.run_program(WARM_UP)
        finish(controller)
        controller.elapse(3600.0)
        warm = scan(controller, device, 60, 140, 160)
        since = world("gantry", 3).warm_time(warm.line_times)
        machine = world("gantry", 3).machine
        assert world("gantry", 3).warm_time(cold.line_times).max() == 0
    assert 3600 < since[0] < since[-1] - 3 < 3700  # 80 mm at 25 mm/s
    assert cold.encoder.tolist() == warm.encoder.tolist()
    y, crossbeam = warm.encoder * 1e-6, machine.crossbeam
    truth = machine.crossbeam.twist(since, y)
    carriage = np.tile(np.eye(4), (y.size, 1, 1))
    carriage[:, 1, 3] = y
    carriage = carriage @ displaced(truth).as_matrix()
    expected = PROFILER.scan(swept(), crossbeam.lines(carriage, crossbeam.artefact_pose(3, 0.1)))
    assert same(warm.heights, expected, STEP / 2 + 1e-12)
    change = warm.heights - cold.heights
    assert np.nanmax(np.abs(change)) > 5e-6  # tens of um along slopes up to 0.5


def test_the_warm_up_starts_with_the_first_long_fast_move_and_continues() -> None:
    with VirtualController(CONTROL, CONTROLLER) as controller:
        here = world("gantry", 3)
        controller.run_program("G1 Y-600 F1500\nG0 Y0\nG1 Y100 F3600\nM30")
        finish(controller)
        controller.elapse(500.0)
        assert here.warm_time(controller.state()["time"]) == 0
        controller.run_program("G1 Y0 F1500\nY-600 F3600\nM30")
        begin = here.path.begin + 4.0  # 100 mm at 25 mm/s
        finish(controller)
        controller.elapse(100.0)
        now = controller.state()["time"]
        assert here.warm_time(now) == pytest.approx(now - begin)
        controller.run_program(forwards(0, 100))
        assert here.warm_time([begin - 1, begin, now]) == pytest.approx([0, 0, now - begin])
        finish(controller)
        controller.start([])  # cold again
        assert here.warm_time([0.0, 1e4]).tolist() == [0.0, 0.0]


def test_a_pocket_at_two_lifts_is_that_of_the_twin() -> None:
    program = "G0 Z{lift}\nG0 Y-20\nG4 P1\nG1 Y20 F1500\nM30"
    lifts = (0.166, 0.182)
    crossbeam = VirtualMachine("gantry", seed=3).crossbeam
    with gantry(PERFECT + "&artefacts=none&pocket=0.0") as (controller, device):
        for lift in lifts:
            controller.run_program(program.format(lift=lift * 1e3))
            found = measure(controller, device, 80)
            assert controller.state()["position"][2] == pytest.approx(lift)
            finish(controller)
            along = found.encoder * 1e-6
            truth = PROFILER.scan(circular_pocket(), crossbeam.pocket_lines(along, lift), key=(0,))
            assert np.isfinite(truth).mean() > 0.5
            assert same(found.heights, truth, STEP / 2 + 1e-12)


def test_noise_differs_between_scans_and_a_campaign_is_bit_identical() -> None:
    def campaign() -> list[np.ndarray]:
        with gantry(SMALL + "&disturbances=white&artefacts=0.1") as (controller, device):
            scans = []
            for _ in range(2):
                scans.append(scan(controller, device, 60, 140, 160).heights)
                finish(controller)
            return scans

    first, again = campaign(), campaign()
    assert np.array_equal(first, again, equal_nan=True)
    # white noise of 0.5 um and rounding to 0.1 um in both; 9000 points: 0.8 % one sigma
    assert np.nanstd(first[0] - first[1]) == pytest.approx(np.sqrt(2) * np.hypot(0.5e-6, STEP / np.sqrt(12)), rel=0.04)


def test_all_disturbances_are_the_default() -> None:
    found = one_scan(SMALL + "&artefacts=0.1", 80, 120, 80)
    there = np.isfinite(found.heights[:, 5:-5])
    assert 0.9 < there.mean() < 1  # some points are missing


def test_by_default_there_are_eight_artefacts() -> None:
    found = one_scan(PERFECT.replace("=500", "=5000"), -900, 900, 360)
    y = found.encoder[np.isfinite(found.heights).any(axis=1)] * 1e-6
    nearest = np.abs(np.subtract.outer(y, -0.7 + 0.2 * np.arange(8)))
    assert (nearest.min(axis=1) < 0.031).all()
    assert (np.bincount(nearest.argmin(axis=1)) >= 11).all()  # 60 mm of each


def test_a_separate_surface_is_also_available_on_the_gantry() -> None:
    with KeyenceLJX("sim://gantry/profiler?artefact=swept&points=80") as profiler:
        assert np.isfinite(profiler.read()).all()


# ------------------------------------------------------------------ the encoder


def test_profiles_are_only_taken_in_the_positive_direction() -> None:
    program = "G1 Y10 F1500\nY5\nG4 P1\nY12\nG0 Y0\nM30"
    with gantry(PERFECT + "&artefacts=none") as (controller, device):
        controller.run_program(program)
        found = measure(controller, device, 30)
    up, again = list(range(500, 10001, 500)), list(range(5500, 12001, 500))
    assert found.encoder.tolist() == (up + again)[:30]


def test_the_encoders_pitch_start_and_overflow() -> None:
    start = (1 << 31) - 1000
    address = f"sim://gantry/p?seed=3&points=8&artefacts=none&encoder_pitch=5e-7&encoder_step=100&encoder_start={start}"
    with gantry(address) as (controller, device):
        assert device.counts().encoder == start
        controller.run_program("G1 Y10 F1500\nM30")
        found = measure(controller, device, 100)
        assert (found.encoder % 100 == 0).all()
        assert np.diff(found.encoder).tolist() == [100] * 99
        assert found.encoder[-1] > 1 << 31
        y = controller.state()["position"][1]
        assert (found.encoder[-1] - start) * 5e-7 == pytest.approx(y, abs=1e-12)
        assert device.counts().encoder == found.encoder[-1] - (1 << 32)  # as reported by the profiler


# ------------------------------------------------------------------ the clock


def test_nothing_moves_before_an_undeclared_lead_in() -> None:
    begins = []
    with gantry(PERFECT + "&artefacts=none") as (controller, device):
        for _ in range(2):
            before = controller.state()
            answer = controller.run_program("G1 Y10 F1500\nG1 Y0\nM30")
            assert answer == {"duration": pytest.approx(0.8), "longest_lead_in": 2.5}
            controller.elapse(0.5)
            state = controller.state()
            assert (state["running"], state["position"]) == (True, before["position"])
            first = measure(controller, device, 1, block=1)  # the first line is 0.5 mm behind the start
            begins.append(first.times[0] - 0.5e-3 / FEED - before["time"])
            controller.elapse(answer["duration"] + answer["longest_lead_in"])
            assert not controller.state()["running"]
    assert 0.5 <= min(begins) < max(begins) <= 2.5


def test_the_clock_and_the_position_are_those_of_the_last_profile_that_was_read() -> None:
    with gantry(PERFECT + "&artefacts=none") as (controller, device):
        controller.run_program(forwards(10, 200))
        stream = device.stream(7)
        for _ in range(5):
            block = next(stream)
            assert controller.state()["position"][1] == pytest.approx(block.encoder[-1] * 1e-6, abs=1e-12)
            with pytest.raises(InstrumentError, match="advance the time while profiler stream"):
                controller.elapse(1.0)
        seen = controller.state()["time"]
        stream.close()
        state = controller.state()
        assert state["time"] == seen
        assert (state["running"], state["stepping"]) == (True, False)
        controller.elapse(2.0)
        assert controller.state()["position"][1] == pytest.approx(block.encoder[-1] * 1e-6 + 2.0 * FEED)
        finish(controller)
        assert controller.state()["position"] == [0.0, 0.2, 0.0]


def test_a_stream_ended_over_an_artefact_continues_with_the_next_profile() -> None:
    whole = one_scan(SMALL + "&artefacts=0.1", 60, 140, 150)
    with gantry(SMALL + "&artefacts=0.1") as (controller, device):
        parts = [scan(controller, device, 60, 140, 50)]
        parts += [measure(controller, device, lines) for lines in (30, 70)]
    assert np.concatenate([part.encoder for part in parts]).tolist() == whole.encoder.tolist()
    assert np.array_equal(np.concatenate([part.heights for part in parts]), whole.heights, equal_nan=True)


def test_a_profiler_may_wait_for_the_program() -> None:
    with gantry(PERFECT + "&artefacts=none") as (controller, device), ThreadPoolExecutor(1) as pool:
        stream = device.stream(10)
        first = pool.submit(next, stream)
        controller.run_program("G1 Y10 F1500\nM30")
        assert first.result().encoder.tolist() == list(range(500, 5001, 500))
        stream.close()


def test_without_motion_there_are_no_profiles() -> None:
    with gantry(PERFECT, FAST) as (controller, device):
        with raises("instrument.no_answer"):
            measure(controller, device, 1, block=1)
        controller.run_program("G1 Y2 F1500\nM30")
        with raises("instrument.no_answer"):
            measure(controller, device, 5, block=5)  # of the four that there are
        assert controller.state()["running"]
        finish(controller)
        assert device.counts().encoder == 2000


def test_a_profile_by_command_is_at_the_position_of_the_axis_and_moves_nothing() -> None:
    with gantry(PERFECT + "&artefacts=0.1") as (controller, device):
        assert np.isnan(device.read()).all()  # nothing is there
        controller.run_program("G0 Y110.0004\nM30")
        finish(controller)
        before, counts = controller.state(), device.counts()
        heights = [device.read() for _ in range(2)]
        assert controller.state() == before
        after = device.counts()
    assert (after.trigger - counts.trigger, after.encoder) == (2, counts.encoder) == (2, 110000)
    crossbeam, y = VirtualMachine("gantry", seed=3).crossbeam, np.array([0.1100004, 0.1100014])
    lines = crossbeam.lines(crossbeam.carriage(0.0, y, 0.1, "axis"), crossbeam.artefact_pose(3, 0.1))
    truth = PROFILER.scan(swept(), lines)[0]
    assert np.isfinite(truth).mean() > 0.5
    assert all(same(each, truth, STEP / 2 + 1e-12) for each in heights)


def test_profiles_by_command_have_their_own_noise() -> None:
    with gantry(SMALL + "&disturbances=white&artefacts=0.1") as (controller, device):
        controller.run_program("G0 Y110\nM30")
        finish(controller)
        change = device.read() - device.read()
    # the difference of two: white noise of 0.5 um and rounding to 0.1 um in both; 60 points or so: 9 % one sigma
    assert np.nanstd(change) == pytest.approx(np.sqrt(2) * np.hypot(0.5e-6, STEP / np.sqrt(12)), rel=0.4)


def test_profiles_by_command_before_and_within_a_scan_do_not_change_it() -> None:
    whole = one_scan(SMALL + "&artefacts=0.1", 60, 140, 160)
    with gantry(SMALL + "&artefacts=0.1") as (controller, device):
        device.read()
        first, stream, found = scan(controller, device, 60, 140, 50), device.stream(1), []
        for number in range(110 + 1):
            if number == 40:
                device.trigger()
            found.append(next(stream))
        stream.close()
    rest = Pass(found, [])
    encoder = np.concatenate([first.encoder, rest.encoder])
    (before,) = np.flatnonzero(np.diff(encoder) == 0)  # the profile at whose position it was taken
    assert np.delete(encoder, before + 1).tolist() == whole.encoder.tolist()
    heights = np.delete(np.concatenate([first.heights, rest.heights]), before + 1, axis=0)
    assert np.array_equal(heights, whole.heights, equal_nan=True)


def heard(profiler: str, timeout: float) -> tuple[Pass, int]:
    """A pass with a rest of 5 s, read by a client that queries again after silence; return the number of queries."""
    found, silences = Pass([], []), 0
    with gantry(profiler, LJXSettings(timeout=timeout)) as (controller, device):
        controller.run_program("G1 Y5.3 F1500\nG4 P5\nG1 Y30\nM30")
        while len(found.blocks) < 60:
            stream = device.stream(1)
            try:
                while len(found.blocks) < 60:
                    found.blocks.append(next(stream))
                    found.times.append(controller.state()["time"])
            except InstrumentTimeoutError:
                silences += 1
                assert silences < 200
            stream.close()
    return found, silences


def test_at_a_pace_a_rest_longer_than_the_time_limit_elapses_while_a_client_reads() -> None:
    """At a pace of 2 the rest takes 2.5 s, five times the time limit, enough for a busy computer."""
    calm, silences = heard(PERFECT + "&artefacts=none", 10.0)
    assert silences == 0
    paced, silences = heard(PERFECT + "&artefacts=none&pace=2", 0.5)
    assert silences > 0
    assert paced.encoder.tolist() == calm.encoder.tolist() == list(range(500, 30001, 500))
    assert paced.times[10:] == pytest.approx(calm.times[10:], abs=1e-9)  # behind the rest
    assert np.ptp(calm.times[9:11]) > 5.0


def test_at_a_pace_the_machine_moves_in_real_time() -> None:
    start = time.monotonic()
    with gantry(PERFECT + "&artefacts=none&pace=10") as (controller, device):
        controller.run_program("G1 Y40 F1500\nM30")
        found = measure(controller, device, 80)
    assert found.times[-1] > 1.6 + 0.5
    assert time.monotonic() - start > found.times[-1] / 10


# ------------------------------------------------------------------ commands


def test_a_refused_program_moves_nothing() -> None:
    with VirtualController(CONTROL, CONTROLLER) as controller:
        for text, message in [
            ("G1 Y100 F1500\nG1 Y901\nM30", r"refuses: Line 2 'G1 Y901': Y travels from -900 to 900 mm; found 901"),
            ("%\nG91\nM30", r"refuses: Line 2 'G91'"),
            ("G1 Y100 F1500", "check that it is complete"),
        ]:
            with pytest.raises(InstrumentError, match=message):
                controller.run_program(text)
            assert not controller.state()["running"]
        controller.elapse(60.0)
        assert controller.state()["position"] == [0.0, 0.0, 0.0]


def test_programs_wait_for_one_another() -> None:
    with VirtualController(CONTROL, CONTROLLER) as controller:
        controller.run_program(forwards(0, 100))
        with pytest.raises(InstrumentError, match="still running; wait"):
            controller.run_program(forwards(0, 100))
        controller.mount("sphere")
        with pytest.raises(InstrumentError, match="still running; wait"):
            controller.run_steps((0, 0, 0), (1, 0, 0), 20e-6, 2)
        finish(controller)
        controller.run_steps((0, 0, 0), (1, 0, 0), 20e-6, 2)
        with pytest.raises(InstrumentError, match="still stepping; wait"):
            controller.run_program(forwards(0, 100))


def test_a_new_schedule_stops_a_program_where_the_machine_is() -> None:
    with VirtualController(CONTROL, CONTROLLER) as controller:
        controller.run_program("G1 X1000 F6000\nM30")
        controller.elapse(5.0)
        there = controller.state()["position"]
        assert 0.2 < there[0] < 0.5  # 0.1 m/s for 2.5 to 4.5 s
        controller.start([])
        controller.elapse(60.0)
        state = controller.state()
        assert (state["position"], state["running"]) == (there, False)


# ------------------------------------------------------------------ faults


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ("&disturbances=some", "expected one of none, white, full"),
        ("&artefacts=0.1,here", "expected positions in m, separated by commas"),
        ("&artefacts=0.1,0.13", "66 mm or more apart along Y"),
        ("&artefacts=0.1,1.3", r"Y travels from -0\.9 to 0\.9 m; found 1\.3 m"),
        ("&pocket=0.1", "56 mm or more apart along Y; .* circular pocket"),
        ("&encoder_step=0", "found 1e-06 and 0"),
        ("&encoder_pitch=-1e-6", "a length in m above 0"),
        ("&artefact=ball", "expected one of swept, twin"),
    ],
)
def test_an_invalid_address_is_refused(params: str, message: str) -> None:
    with pytest.raises(InstrumentError, match=message):
        KeyenceLJX(SMALL + params).open()


def test_only_the_gantry_has_a_table() -> None:
    with raises("simulator.setting"):
        KeyenceLJX("sim://cframe/profiler?artefact=twin").open()


def test_dropped_profiles_over_an_artefact_are_nan_at_their_positions() -> None:
    address = PERFECT + "&artefacts=0.1"
    whole = one_scan(address, 60, 140, 150)
    holes = one_scan(address + "&fault=drop&fault_at=20&fault_every=9", 60, 140, 150)
    gone = np.arange(20, 150, 9)
    assert np.flatnonzero(np.isnan(holes.encoder)).tolist() == gone.tolist()
    kept = np.setdiff1d(np.arange(150), gone)
    assert np.array_equal(holes.heights[kept], whole.heights[kept], equal_nan=True)
    assert holes.times == whole.times


def test_one_clock_is_controlled_by_one_kind_of_device() -> None:
    slow = OptoSettings(rate=1500.0, timeout=10.0)
    with (
        gantry(PERFECT + "&artefacts=none") as (controller, device),
        OptoNCDT("sim://gantry/X1?seed=3", slow) as sensor,
    ):
        stream = sensor.stream()
        next(stream)
        with pytest.raises(InstrumentError, match="not possible in this mode"):
            device.read()
        stream.close()
        controller.run_program(forwards(0, 100))
        stream = device.stream(10)
        next(stream)
        with pytest.raises(InstrumentError, match="Another device controls the clock"):
            sensor.read()
        next(stream)
        stream.close()
