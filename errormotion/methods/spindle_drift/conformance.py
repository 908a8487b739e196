"""Subjects of the conformance kit: a drift, and a detection of its beams."""

from __future__ import annotations

import math
from functools import partial

from errormotion.methods.spindle_drift.method import SpindleDrift
from errormotion.methods.spindle_drift.settings import SpindleDriftSettings
from errormotion.methods.spindle_drift.simulation import simulate
from errormotion.plugins import MethodSubject

DURATION = 6000.0
"""Length of the drift, s: enough for a thermal drift of many times its uncertainty."""


def subjects() -> tuple[MethodSubject, ...]:
    """Return the two procedures of the method.

    The levels are heights on Z, and a beam along an axis has no rotation about itself. The frame of the drift is
    therefore turned about Z, that of the beams by a quarter turn about Z.
    """
    drift = MethodSubject(
        SpindleDrift,
        partial(simulate, SpindleDriftSettings(duration=DURATION)),
        name="drift",
        settings={"functional_point": (0.0, 0.0, 0.0)},
        setting_vectors={"functional_point": "point"},
        raw_vectors={
            "beam_origin": "point",
            "beam_direction": "direction",
            "beam_covariance": "covariance",
            "level": "z",
        },
        optional=("beam_covariance", "temperature", "spindle_speed"),
        measured=("distance",),
        motion=((0.0, 0.0, 0.5), (0.1, -0.2, 0.05)),
        seeds=120,
    )
    beams = MethodSubject(
        SpindleDrift,
        partial(simulate, SpindleDriftSettings(procedure="beam_detection")),
        name="beam_detection",
        settings={"procedure": "beam_detection"},
        raw_vectors={
            "sphere_centre": "point",
            "scan_direction": "direction",
            "nominal_origin": "point",
            "nominal_direction": "direction",
        },
        optional=("distance_noise",),
        measured=("distance",),
        motion=((0.0, 0.0, math.pi / 2), (0.1, -0.2, 0.05)),
        seeds=60,
    )
    return drift, beams
