"""Subject of the conformance kit: a test with few sectors, for a duration of seconds."""

from __future__ import annotations

from functools import partial

from errormotion.methods.circular_test.method import CircularTest
from errormotion.methods.circular_test.schema import OPTIONAL
from errormotion.methods.circular_test.settings import CircularTestSettings
from errormotion.plugins import MethodSubject


def subjects() -> tuple[MethodSubject, ...]:
    """Return the subject."""
    settings = CircularTestSettings(samples=540, places=60)
    return (
        MethodSubject(
            CircularTest,
            partial(CircularTest().simulate, settings),
            raw_vectors={"centre": "point", "axis_direction": "direction"},
            settings=settings.model_dump(exclude_unset=True),
            optional=OPTIONAL,
            measured=("length",),
            seeds=120,
        ),
    )
