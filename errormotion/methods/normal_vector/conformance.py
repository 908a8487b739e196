"""Simulated warm-up with which the conformance kit examines the method."""

from __future__ import annotations

from functools import partial

from errormotion.methods.normal_vector.method import NormalVector
from errormotion.methods.normal_vector.settings import Event, NormalVectorSettings
from errormotion.methods.normal_vector.simulation import simulate
from errormotion.plugins import MethodSubject

FUNCTIONAL_POINT = (0.0, 0.0, 0.15)
"""m."""
WARM_UP = NormalVectorSettings(
    tool_axes="Z", functional_point=FUNCTIONAL_POINT, duration=3600.0, schedule=(Event(at=0.0, spindle_speed=12000.0),)
)


def subjects() -> tuple[MethodSubject, ...]:
    """Return the method on a C-frame whose table moves in X and Y, so that the frame is rotated about Z only.

    On a gantry all six errors are determined, but at 4 m the resolution of single precision is that of its touches.
    """
    centres = ((-0.24, -0.2, 0.06), (0.24, -0.19, 0.23), (0.23, 0.2, 0.09))
    subject = MethodSubject(
        NormalVector,
        partial(simulate, WARM_UP),
        settings={
            "tool_axes": "Z",
            "functional_point": FUNCTIONAL_POINT,
            "balls": tuple({"centre": centre} for centre in centres),
        },
        setting_vectors={"functional_point": "point"},
        raw_vectors={"touch": "point", "approach": "direction", "ball_nominal": "point"},
        optional=(
            *("touch_time", "touch_flag", "approach", "ball_radius", "ball_nominal", "touch_noise"),
            *("temperature", "spindle_speed", "feed"),
        ),
        measured=("touch",),
        motion=((0.0, 0.0, 0.5), (0.1, -0.2, 0.05)),
        seeds=120,
    )
    return (subject,)
