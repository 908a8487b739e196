"""Subjects of the conformance kit: positioning with temperatures, all six freedoms, a moving axis, diagonals."""

from __future__ import annotations

from functools import partial
from typing import Literal

from errormotion.methods.linear_positioning.method import LinearPositioning
from errormotion.methods.linear_positioning.settings import (
    FREEDOMS,
    Diagonals,
    Freedom,
    LinearPositioningSettings,
    Moving,
)
from errormotion.plugins import MethodSubject

OPTIONAL = (
    *("zero_position", "functional_point", "length_uncertainty", "alignment_uncertainty"),
    *("temperature_uncertainty", "machine_expansion_uncertainty"),
)
RUNS, SEEDS = 12, 100
"""More runs than usual: with few runs, the Student distribution of a mean has wider tails than chi-square."""
MOTION = ((0.0, 0.0, 0.0), (0.1, -0.2, 0.05))


def subjects() -> tuple[MethodSubject, ...]:
    """Return the tests on a short axis and along short diagonals."""
    moving = LinearPositioningSettings(
        freedoms=("EX", "EB"), moving=Moving(cold=5, duration=7200.0, cooling=1800.0, interval=120.0)
    )
    warming = MethodSubject(
        LinearPositioning,
        partial(LinearPositioning().simulate, moving),
        raw_vectors={"end_position": "x", "functional_point": "point"},
        settings=moving.model_dump(exclude_unset=True),
        name="moving axis",
        optional=("functional_point", "length_uncertainty"),
        measured=("end_deviation", "end_position"),
        motion=MOTION,
        seeds=SEEDS,
    )
    return (_subject("positioning", "X", ("EX",)), _subject("six freedoms", "Y", FREEDOMS), warming, _diagonals())


def _diagonals() -> MethodSubject:
    names = ("PP0", "NP0", "PPP", "NNP")
    return MethodSubject(
        LinearPositioning,
        partial(
            LinearPositioning().simulate,
            LinearPositioningSettings(diagonals=Diagonals(names=names), runs=RUNS, count=7),
        ),
        raw_vectors={"stop_point": "point", "functional_point": "point"},
        settings={"diagonals": {"names": names}, "trials": 200},
        name="diagonals",
        optional=("functional_point", "length_uncertainty", "alignment_uncertainty"),
        measured=("diagonal_deviation", "stop_point"),
        seeds=SEEDS,
        motion=MOTION,
    )


def _subject(name: str, axis: Literal["X", "Y"], freedoms: tuple[Freedom, ...]) -> MethodSubject:
    coordinate: Literal["x", "y"] = "x" if axis == "X" else "y"
    return MethodSubject(
        LinearPositioning,
        partial(
            LinearPositioning().simulate, LinearPositioningSettings(freedoms=freedoms, axis=axis, runs=RUNS, count=7)
        ),
        raw_vectors={"target_position": coordinate, "zero_position": coordinate, "functional_point": "point"},
        settings={"freedoms": freedoms, "axis": axis, "trials": 200},
        name=name,
        optional=OPTIONAL,
        measured=("deviation", "target_position"),
        seeds=SEEDS,
        motion=MOTION,
    )
