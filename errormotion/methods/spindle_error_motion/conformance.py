"""Subjects of the conformance kit: five sensors with an index pulse, and a horizontal spindle with an encoder."""

from __future__ import annotations

from functools import partial

import numpy as np

from errormotion.kinematics.iso import direction_of
from errormotion.methods.spindle_error_motion.method import SpindleErrorMotion
from errormotion.methods.spindle_error_motion.settings import SpindleErrorMotionSettings
from errormotion.plugins import MethodSubject


def subjects() -> tuple[MethodSubject, ...]:
    """Return the subjects."""
    small = SpindleErrorMotionSettings(turns=48, sample_rate=3000.0, places=32, harmonics=8)
    horizontal = {"axis": "A", "sensors": "XYZ", "angle_from": "encoder", "spindle_speed": -3000.0}
    return (
        _subject("five sensors", small, ("position_uncertainty", "roundness", "index_time")),
        _subject(
            "horizontal",
            small.model_copy(update=horizontal),
            ("position_uncertainty", "roundness", "angle"),
        ),
    )


def _subject(name: str, settings: SpindleErrorMotionSettings, optional: tuple[str, ...]) -> MethodSubject:
    """Return a subject; its frame is turned about the axis only, whose letter states its direction."""
    x, y, z = map(float, 0.4 * np.eye(3)[direction_of(settings.axis)])
    return MethodSubject(
        SpindleErrorMotion,
        partial(SpindleErrorMotion().simulate, settings),
        raw_vectors={"sensor_position": "point", "sensor_direction": "direction", "axis_point": "point"},
        settings=settings.model_dump(exclude_unset=True),
        name=name,
        optional=optional,
        measured=("displacement",),
        compiles=True,
        motion=((x, y, z), (0.1, -0.2, 0.05)),
    )
