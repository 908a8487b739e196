"""NC programs that the virtual control accepts, and refusals of others."""

import numpy as np
import pytest
from coded import raises

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.virtual_world.nc_program import interpret
from errormotion.twin.paths import Path

TRAVEL = {"X": (0.0, 4.0), "Y": (-0.9, 0.9), "Z": (0.0, 1.0)}
RAPID = 20.0 / 60


def run(*lines: str, start: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Path:
    return interpret("\n".join(lines), start, TRAVEL, RAPID)


def test_the_duration_of_a_measuring_pass_is_path_divided_by_feed() -> None:
    path = run(
        "%",
        "(cold pass; eight artefacts)",
        "N10 G90 G94 G21",
        "N20 G1 Y-750.000 F1500 ; to the start",
        "N30 G4 P2.0",
        "N40 Y750.5",
        "N50 G0 Y0",
        "N60 M30",
        "%",
    )
    assert path.times == pytest.approx(np.cumsum([0, 30, 2, 1500.5 / 25, 750.5 / 20000 * 60]))
    assert path.places[:, 1].tolist() == [0.0, -0.75, -0.75, 0.7505, 0.0]
    assert path.rapid.tolist() == [False, False, False, True]


def test_words_may_have_spaces_either_case_and_leading_zeros() -> None:
    path = run("g01x100.y+20Z.5f600", "G04 P.5", "G 00 X 0", "m02")
    assert path.places[-2].tolist() == [0.1, 0.02, 0.0005]
    assert path.times[1] == pytest.approx(np.linalg.norm([0.1, 0.02, 0.0005]) / 0.01)


def test_a_program_starts_at_the_present_position() -> None:
    path = run("G1 Y200 F1200", "M30", start=(1.0, 0.1, 0.5))
    assert path.places.tolist() == [[1.0, 0.1, 0.5], [1.0, 0.2, 0.5]]
    assert path.duration == pytest.approx(5.0)


def test_moves_without_travel_take_no_time_and_nothing_is_read_after_the_end() -> None:
    path = run("G1 Y0 F100", "G4 P0", "G0 Z0", "M30 (over)", "what stands here is not read")
    assert path.duration == 0
    assert path.places.shape == (1, 3)


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("G91", "use G90"),
        ("G20 G1 Y1", "inches"),
        ("M0", "remove the stop"),
        ("M01", "remove the stop"),
        ("G2 Y10 I5", "'G2' is not supported; supported are %"),
        ("G1.5 Y10", "'G1.5' is not supported"),
        ("M8", "'M8' is not supported"),
        ("M3 S1000", "a spindle is not available here"),
        ("M3", "expected the spindle speed"),
        ("M3 M5 S1000", "M3 and M5 in one line"),
        ("S1000", "expected M3 with it"),
        ("G31 Y10 F100", "a probe is not available here"),
        ("DPRNT[Y#5062[53]]", "a printer is not available here"),
        ("T1", "'T' is not supported"),
        ("O1234", "'O' is not supported"),
        ("G1 A10", "'A' is not supported"),
        ("G1 Y=10", "expected words .*found 'Y=10'"),
        ("/G1 Y10", "'/' is not a word"),
        ("(a comment without end", "expected words"),
        ("G1 Y10 Y20", "the same letter twice"),
        ("G0 G1 Y10", "G0 and G1 in one line"),
        ("G1 Y900.1", r"Y travels from -900 to 900 mm; found 900\.1"),
        ("G0 Z-0.5", r"Z travels from 0 to 1000 mm; found -0\.5"),
        ("G1 Y10 F0", r"at most 20000 mm/min; found 0"),
        ("G1 Y10 F20001", r"at most 20000 mm/min; found 20001"),
        ("G4", "expected a dwell such as G4 P2.5"),
        ("G4 X2.0", "expected a dwell"),
        ("G4 P-1", "expected a dwell"),
        ("G1 Y10 P5", "only with a dwell"),
    ],
)
def test_unknown_text_is_refused_with_its_line(line: str, why: str) -> None:
    with pytest.raises(InstrumentError, match=rf"^Line 3 '.*': .*{why}"):
        run("%", "G1 Y100 F1500", line, "M30")


def test_a_move_needs_its_kind_and_its_feed() -> None:
    with raises("machine.program.no_motion"):
        run("Y10", "M30")
    with raises("machine.program.no_feed"):
        run("G0 Y10", "G1 Y20", "M30")


def test_a_program_that_was_cut_off_is_refused() -> None:
    with raises("machine.program.no_end"):
        run("G1 Y100 F1500")
