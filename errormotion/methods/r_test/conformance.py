"""Subjects of the conformance kit: a table C with three spheres, and a table A with one sphere on its axis."""

from __future__ import annotations

from functools import partial

import numpy as np

from errormotion.kinematics.iso import direction_of
from errormotion.methods.r_test.method import RTest
from errormotion.methods.r_test.settings import RTestSettings
from errormotion.plugins import MethodSubject


def subjects() -> tuple[MethodSubject, ...]:
    """Return the subjects; a single sphere leaves no redundancy, so that its noise must be stated."""
    optional = ("position_uncertainty", "nest_uncertainty")
    return (
        _subject("three spheres", RTestSettings(), (*optional, "displacement_noise")),
        _subject("one sphere", RTestSettings(axis="A", spheres=1, angles=24), optional),
    )


def _subject(name: str, settings: RTestSettings, optional: tuple[str, ...]) -> MethodSubject:
    """Return a subject; its frame is turned about the axis only, whose letter states its direction."""
    x, y, z = map(float, 0.4 * np.eye(3)[direction_of(settings.axis)])
    return MethodSubject(
        RTest,
        partial(RTest().simulate, settings),
        raw_vectors={"sphere_position": "point", "sensor_direction": "direction", "axis_point": "point"},
        settings=settings.model_dump(exclude_unset=True),
        name=name,
        optional=optional,
        measured=("displacement",),
        motion=((x, y, z), (0.1, -0.2, 0.05)),
    )
