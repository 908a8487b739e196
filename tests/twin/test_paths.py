"""Paths of the axes: positions over time, triggers of the encoder, and warm-up moves."""

import numpy as np
import pytest

from errormotion.twin.paths import Path

MM = 1e-3


def path(*moves: tuple[float, float, bool]) -> Path:
    """A path along Y from 0: (way in mm, feed in mm/min, whether rapid) each; a feed of 0 dwells for a second."""
    times, places, rapid = [0.0], [[0.0, 0.0, 0.0]], []
    for way, feed, fast in moves:
        times.append(times[-1] + (abs(way) / feed * 60 if feed else 1.0))
        places.append([0.0, places[-1][1] + way * MM, 0.0])
        rapid.append(fast)
    return Path(np.array(times), np.array(places), np.array(rapid, dtype=bool))


def test_positions_are_linear_in_time_and_constant_before_and_after() -> None:
    way = path((60, 3600, False), (0, 0, False), (-30, 3600, False)).beginning(10.0)
    assert (way.begin, way.end, way.duration) == pytest.approx((10.0, 12.5, 2.5))
    y = way.place([0.0, 10.0, 10.5, 11.5, 12.25, 99.0])[:, 1]
    assert y == pytest.approx(np.array([0, 0, 30, 60, 45, 30]) * MM)
    assert way.place(10.5).shape == (3,)


def test_the_encoder_triggers_at_every_multiple_in_the_positive_direction_once() -> None:
    way = path((1.0, 60, False), (0, 0, False), (1.1, 60, False), (-2.1, 60, False))
    assert way.pieces_forwards(-1.0) == [0, 2]
    assert way.pieces_forwards(1.0) == [2]  # the first has ended
    counts, times = zip(*(way.crossings(piece, 1e-6, 0, 100) for piece in (0, 2)), strict=True)
    assert np.concatenate(counts).tolist() == list(range(100, 2101, 100))  # 1000 and 2100 at the ends of pieces
    assert times[0] == pytest.approx(np.arange(1, 11) / 10)
    assert times[1] == pytest.approx(2.0 + np.arange(1, 12) / 10)


def test_triggers_are_multiples_of_the_count_not_of_the_position() -> None:
    counts, times = path((1.0, 60, False)).crossings(0, 1e-6, 30, 70)
    assert (counts % 70 == 0).all()
    assert times == pytest.approx((counts - 30) * 1e-3)
    assert (counts[0], counts[-1]) == (70, 980)
    below, _ = path((1.0, 60, False)).crossings(0, 1e-6, -500, 70)
    assert below.tolist() == list(range(-490, 491, 70))


def test_a_coarser_encoder_counts_less() -> None:
    counts, _ = path((1.0, 60, False)).crossings(0, 1e-5, 0, 7)
    assert counts.tolist() == [7 * k for k in range(1, 15)]


@pytest.mark.parametrize(
    ("moves", "begin"),
    [
        ([(300, 1500, False), (300, 3600, False)], 12.0),
        ([(300, 1500, False), (-300, 1500, False)], None),
        ([(150, 3600, False), (-150, 3600, False)], None),  # too short
        ([(-300, 20000, True)], None),  # rapid
        ([(-300, 2000, False)], 0.0),
        ([], None),
    ],
)
def test_fast_and_long_moves_that_are_not_rapid_warm_up(moves: list, begin: float | None) -> None:
    assert path(*moves).warm_up() == (begin if begin is None else pytest.approx(begin))


def test_a_resting_machine_triggers_nothing() -> None:
    rest = Path.resting((0.0, 0.1, 0.2))
    assert rest.place([-1.0, 5.0]).tolist() == [[0.0, 0.1, 0.2]] * 2
    assert rest.pieces_forwards(-np.inf) == []
    assert rest.duration == 0
