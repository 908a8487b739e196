"""The new program: its cuts follow the corrected path, and everything else is unchanged."""

import contextlib
import math
from collections.abc import Iterator
from random import Random

import numpy as np
import pytest
from coded import raises
from hypothesis import given, settings
from hypothesis import strategies as st
from nc_paths import ORIGINS, deviations, field, moves_of, rewritten, zero
from nc_programs import Programs

from errormotion.compensation.program.reading.items import LINE
from errormotion.compensation.program.reading.reader import Reader
from errormotion.compensation.program.writing import dividing, rewriting
from errormotion.compensation.program.writing.rewriting import Rewriting
from errormotion.errors import ProgramError

TOLERANCE = 1e-6
DIGITS = 0.5 * math.sqrt(3) * 2.54e-7
"""Rounding of an end to the last printed digit, in inches, m."""

HEAD = ["G21 G90 G17", "G0 X0 Y0 Z0", "F100"]
SEEDS = st.integers(0, 2**40)


def waves(p: np.ndarray) -> np.ndarray:
    """Return errors as of a machine: some 20 um, with periods of some 200 mm."""
    x, y = p[:, 0], p[:, 1]
    return np.stack([20e-6 * np.sin(y / 0.03), 15e-6 * np.sin(x / 0.05), -10e-6 * np.cos(x / 0.04)], axis=1)


bent = field(waves)
shift = field(lambda p: np.tile([1.2345e-5, -3e-6, 8e-6], (len(p), 1)))


@settings(max_examples=30, deadline=None)
@given(SEEDS)
def test_without_errors_the_program_is_unchanged(seed: int) -> None:
    lines = Programs(Random(seed)).lines(40)
    assert rewritten(lines, zero) == lines


@settings(max_examples=3, deadline=None)
@given(SEEDS)
def test_cuts_are_on_the_corrected_path(seed: int) -> None:
    lines = Programs(Random(seed)).lines(8)
    for text, away in deviations(lines, bent, tolerance=TOLERANCE):
        assert away <= TOLERANCE + 2 * DIGITS, text


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_a_reversed_correction_returns_the_original_program(seed: int) -> None:
    lines = Programs(Random(seed), plain=True).lines(20)
    back = field(lambda q: -waves(q - waves(q - waves(q - waves(q)))))
    there = [f"{line} (@{k})" if line else line for k, line in enumerate(lines)]
    again = rewritten(rewritten(there, bent), back)
    ends: dict[str, tuple[float, ...]] = {}
    tag = ""
    for item, text in zip(Reader(ORIGINS).items(again), again, strict=True):
        tag = text[text.index("(@") :] if "(@" in text else tag
        if hasattr(item, "end"):
            ends[tag] = item.frame.machine(item.end)
    for move in moves_of(there):
        tag = move.block.text[move.block.text.index("(@") :]
        assert math.dist(ends[tag], move.frame.machine(move.end)) <= 4 * DIGITS


def test_a_constant_correction_shifts_arcs() -> None:
    lines = [*HEAD, "G2 X20 Y0 I10", "G3 X20 Y0 I-3 J0", "G90.1 G2 X30 Y0 I25 J0"]
    new = rewritten(lines, shift)
    assert new[3:] == [
        "G2 X20.0123 Y-0.0030 I10",
        "G3 X20.0123 Y-0.0030 I-3 J0",
        "G90.1 G2 X30.0123 Y-0.0030 I25.0123 J-0.0030",
    ]


def test_no_more_pieces_than_the_tolerance_requires() -> None:
    def pieces(sag: float) -> int:
        parabola = field(lambda p: np.stack([0 * p[:, 0], sag * (p[:, 0] / 0.1) ** 2 * 4, 0 * p[:, 0]], axis=1))
        return len(rewritten([*HEAD, "G1 X100"], parabola, tolerance=1e-6, step=1e-4)) - len(HEAD)

    # A parabola of sag s over its length is within t of sqrt(s / t) chords.
    assert [pieces(1e-6 * n * n * 0.98) for n in (1, 2, 5, 9)] == [1, 2, 5, 9]


def test_a_program_is_written_while_it_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rewriting, "_MOVES", 50)
    read = []

    def source() -> Iterator[str]:
        for line in [*HEAD, *(f"G1 X{k % 7}" for k in range(400))]:
            read.append(line)
            yield line

    ahead = [len(read) - written for written, _ in enumerate(Rewriting(Reader(ORIGINS), zero).lines(source()), 1)]
    assert len(ahead) == len(HEAD) + 400
    assert max(ahead) <= 50 + len(HEAD)


def test_words_comments_and_codes_keep_their_order() -> None:
    lines = [*HEAD, "N10 g1 x100 y50 (to the side) M8 S800 f200 ; and on", "N20 X0 M0"]
    new = rewritten(lines, bent)
    assert new[3].startswith("N10 g1 X")
    assert new[3].endswith("(to the side) M8 S800 f200 ; and on")
    assert all(line.startswith("X") for line in new[4 : new.index(next(x for x in new if x.startswith("N20")))])
    assert "M0" not in new[-2]
    assert new[-1] == "M0"


def test_inverse_time_feed_is_divided_with_the_move() -> None:
    new = rewritten([*HEAD, "G93 G1 X100 Y100 F4"], bent)
    moves = moves_of(new)[1:]
    assert len(moves) > 2
    assert sum(1 / move.feed for move in moves) == pytest.approx(1 / 4, rel=1e-5)
    speeds = [math.dist(move.start, move.end) * move.feed for move in moves]
    assert max(speeds) / min(speeds) < 1.001


def test_offsets_set_from_a_position_are_unchanged() -> None:
    lines = [*HEAD, "G1 X10 Y10", "G92 X0 Y0", "G1 X5", "G10 L20 P0 Z3", "G1 Y5 Z2"]
    old, new = moves_of(lines), moves_of(rewritten(lines, shift))
    for before, after in zip(old, new, strict=True):
        assert after.frame.machine((0, 0, 0)) == pytest.approx(before.frame.machine((0, 0, 0)), abs=1e-7)
        assert np.subtract(after.frame.machine(after.end), before.frame.machine(before.end)) == pytest.approx(
            [1.23e-5, -3e-6, 8e-6], abs=1.01e-7
        )


def test_increments_do_not_drift() -> None:
    lines = [*HEAD, "G91 G1", *["G1 X0.00004 Y0.3", "G1 X0.1 Y-0.3"] * 500]
    old, new = moves_of(lines), moves_of(rewritten(lines, bent))
    end = np.array(old[-1].frame.machine(old[-1].end))
    meant = end + waves(end[None])[0]
    assert new[-1].frame.machine(new[-1].end) == pytest.approx(meant, abs=1.5e-7)


def test_an_axis_that_is_not_named_is_corrected_too() -> None:
    new = rewritten([*HEAD, "G1 X10"], field(lambda p: np.stack([0 * p[:, 0]] * 2 + [p[:, 0] * 1e-3], axis=1)))
    assert new[-1] == "G1 X10 Z0.0100"


def test_unchanged_moves_are_counted_with_their_lines() -> None:
    lines = ["G21 G90", "G0 Z50", "G0 X0 Y0", "G1 Z0 F100", "G53 G0 Z0", "G1 X5", "G38.2 Z-5"]
    made = Rewriting(Reader(ORIGINS), shift)
    new = list(made.lines(lines))
    assert made.summary.unchanged == {"unknown": (1, 2), "machine": (1, 5), "probe": (1, 7)}
    assert [new[k] for k in (1, 4, 6)] == [lines[k] for k in (1, 4, 6)]


def test_a_cut_from_an_uncorrected_position_is_counted() -> None:
    made = Rewriting(Reader(ORIGINS), bent)
    list(made.lines([*HEAD, "G53 G0 X30 Y40 Z0", "G1 X50"]))
    assert made.summary.uncorrected == (1, 5)


def test_the_summary_states_the_changes() -> None:
    made = Rewriting(Reader(ORIGINS), shift)
    list(made.lines([*HEAD, "G1 X100", "G95 F0.1 S600", "X40", "G93 G1 X0 F2", "G94 G1 X1", "G4 P2"]))
    found = made.summary
    assert (found.read, found.written, found.cuts, found.rapids) == (9, 9, 4, 1)
    assert found.seconds == pytest.approx(60 + 60 + 30 + 2)
    assert found.unfed == 1
    assert found.length == pytest.approx(0.201)
    assert found.largest == pytest.approx(math.hypot(12.345e-6, 3e-6, 8e-6))
    assert len(found.positions) == 5
    assert np.allclose(found.offsets, [1.2345e-5, -3e-6, 8e-6])


def test_the_path_for_the_page_is_bounded() -> None:
    made = Rewriting(Reader(ORIGINS), bent)
    list(made.lines([*HEAD, *(f"G1 X{k % 90} Y{k % 70}.5" for k in range(9_000))]))
    assert 1000 < len(made.summary.positions) <= 4000


def test_positions_outside_the_measured_range_are_counted() -> None:
    def limited(places: np.ndarray, _: np.ndarray) -> object:
        found = shift(places, _)
        found.valid = places[:, 0] < 0.05
        return found

    made = Rewriting(Reader(ORIGINS), limited)
    list(made.lines([*HEAD, "G1 X10", "X90", "Y9", "X0"]))
    assert made.summary.outside == (3, 5)


def test_unknown_corrections_are_an_error() -> None:
    with raises("program.correction.unknown"):
        rewritten([*HEAD, "G1 X1"], field(lambda p: np.full_like(p, np.nan)))


@pytest.mark.parametrize("wrong", [{"tolerance": 0.0}, {"tolerance": math.nan}, {"step": 0.0}, {"step": math.inf}])
def test_invalid_settings_are_an_error(wrong: dict[str, float]) -> None:
    with pytest.raises(ProgramError, match="expected"):
        rewritten(HEAD, zero, **wrong)


def test_too_many_pieces_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dividing, "MAX_PIECES", 50)
    noise = field(lambda p: 1e-3 * np.sin(p * 1e7))
    with raises("program.points.too_many"):
        rewritten([*HEAD, "G2 X0 I0.1"], noise, tolerance=1e-8, step=1e-5)


def test_arcs_remain_arcs() -> None:
    new = moves_of(rewritten([*HEAD, "G0 X40", "G3 X40 Y0 I-40 J0"], bent))[2:]
    assert 4 <= len(new) <= 12
    assert all(move.kind > LINE for move in new)


def test_the_points_for_the_page_have_their_correction() -> None:
    for seed in range(3):
        made = Rewriting(Reader(ORIGINS), bent)
        list(made.lines(Programs(Random(seed)).lines(40)))
        found = made.summary
        assert np.abs(found.offsets - waves(found.positions)).max() < 2e-6
        assert found.largest <= np.linalg.norm(found.offsets, axis=1).max() + 2e-6


def test_a_line_does_not_exceed_the_length_that_controls_read() -> None:
    with pytest.raises(ProgramError, match=r"line 4 would exceed"):
        rewritten([*HEAD, "G1 X1 (" + "x" * 240 + ")"], shift)


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**40), st.data())
def test_altered_programs_are_read_or_rejected_with_the_line(seed: int, data: st.DataObject) -> None:
    lines = Programs(Random(seed)).lines(12)
    alphabet = st.text("GMXYZIJKRPFNSTHLDQO0123456789.-+ /%;()#[]<=ä\t", min_size=1, max_size=4)
    for _ in range(data.draw(st.integers(1, 4))):
        k = data.draw(st.integers(0, len(lines) - 1))
        at = data.draw(st.integers(0, len(lines[k])))
        lines[k] = lines[k][:at] + data.draw(alphabet) + lines[k][at + data.draw(st.integers(0, 2)) :]
    with contextlib.suppress(ProgramError):
        new = rewritten(lines, bent)
        assert len(new) >= len(lines)
        assert len(moves_of(new)) >= len(moves_of(lines))
