"""Subject of the conformance kit: four planes of a sine gauge."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from errormotion.methods.beam_direction.layout import Face
from errormotion.methods.beam_direction.method import BeamDirection
from errormotion.methods.beam_direction.settings import BeamDirectionSettings
from errormotion.methods.beam_direction.simulation import simulate
from errormotion.plugins import MethodSubject


def subjects() -> tuple[MethodSubject, ...]:
    """Return the method on four planes, with the layout of the virtual machine."""
    planes = [
        Face(inclination=math.radians(20.0), rotation=math.radians(rotation)) for rotation in (0.0, 90.0, 180.0, 270.0)
    ]
    subject = MethodSubject(
        BeamDirection,
        partial(simulate, BeamDirectionSettings(planes=tuple(planes))),
        settings={
            "layout": {
                "nominal_direction": (np.sin(np.radians(20)), 0.0, -np.cos(np.radians(20))),
                "nominal_origin": (0.05, 0.0, -0.08),
                "pivot": (0.1, 0.05, 0.12),
            }
        },
        raw_vectors={
            "stage": "direction",
            "nominal_direction": "direction",
            "nominal_origin": "point",
            "nominal_normal": "direction",
            "triangulation_normal": "direction",
            "plane_point": "point",
        },
        optional=(
            *("nominal_origin", "nominal_normal", "triangulation_normal", "mid_range", "reading_range"),
            *("speckle", "plane_point", "plane_point_uncertainty"),
        ),
        measured=("distance",),
        seeds=150,
    )
    return (subject,)
